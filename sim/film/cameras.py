"""Cameras of a film: fixed, tracking, orbiting, or one of the model file; keyed by functions of time."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import FilmError, unknown
from .lights import Curve, vector

Floats = NDArray[np.floating]

KINDS = ("fixed", "tracking", "orbit", "model")
_FOVY = float(np.deg2rad(35.0))


@dataclass(frozen=True)
class Camera:
    """A camera; `position`, `target`, `fovy`, `roll`, `radius`, `elevation` may be functions of time (s).

    - fixed: at `position`, looking at `target`.
    - tracking: at `position` (an offset along the world's axes) from the body or site `frame`, looking at it.
      Its path is smoothed over `smoothing` seconds by `follow`.
    - orbit: on a circle of `radius` about `frame` (or about `target` when no frame is given), `elevation`
      (rad) above it, once round in `period` seconds (negative: clockwise), from `azimuth` (rad, 0 = +x).
    - model: the model file's camera `frame`, which may ride on a body.

    `fovy` is the full vertical angle of view, `roll` a turn about the line of sight, both in radians.
    """

    name: str = "camera"
    kind: Literal["fixed", "tracking", "orbit", "model"] = "fixed"
    position: ArrayLike | Curve = (2.0, -2.0, 1.5)
    target: ArrayLike | Curve = (0.0, 0.0, 0.0)
    frame: str | None = None
    fovy: float | Callable[[float], float] | None = None
    roll: float | Callable[[float], float] = 0.0
    radius: float | Callable[[float], float] = 2.0
    elevation: float | Callable[[float], float] = 0.35
    period: float = 10.0
    azimuth: float = -np.pi / 2
    smoothing: float = 0.25

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise FilmError(
                f"camera {self.name!r}: kind {self.kind!r} does not exist; there are: {', '.join(KINDS)}"
            )
        if self.kind in ("tracking", "model") and not self.frame:
            raise FilmError(
                f"camera {self.name!r}: a {self.kind} camera needs `frame`, the name of what it follows"
            )
        if self.kind == "orbit" and self.period == 0:
            raise FilmError(f"camera {self.name!r}: the period of an orbit cannot be 0 s")

    def pose(self, t: float, data: mujoco.MjData) -> tuple[Floats, float]:
        """Pose X_WC (4, 4) and vertical angle of view (rad) at time `t`, for the pose computed in `data`.

        Camera axes as in OpenGL: x right, y up, looking along -z. Raises FilmError for an unknown frame or
        when position and target coincide.
        """
        if self.kind == "model":
            return self._model_pose(t, data)
        if self.kind == "fixed":
            position = vector(self.position, t, 3, f"position of camera {self.name!r}")
            target = vector(self.target, t, 3, f"target of camera {self.name!r}")
        elif self.kind == "tracking":
            target = self._followed(data)
            position = target + vector(self.position, t, 3, f"position of camera {self.name!r}")
        else:
            centre = vector(self.target, t, 3, f"target of camera {self.name!r}")
            target = self._followed(data) if self.frame else centre
            angle = self.azimuth + 2 * np.pi * t / self.period
            height = _number(self.elevation, t)
            toward = [np.cos(height) * np.cos(angle), np.cos(height) * np.sin(angle), np.sin(height)]
            position = target + _number(self.radius, t) * np.array(toward)
        if np.allclose(position, target, rtol=0, atol=1e-9):
            raise FilmError(f"camera {self.name!r}: position and target coincide at t = {t:.3f} s")
        return look_at(position, target, roll=_number(self.roll, t)), self._angle(t, _FOVY)

    def follow(self, model: mujoco.MjModel, t: Floats, q: Floats) -> "Camera":
        """This camera, with the path of what it follows smoothed over the whole motion t (n,), q (n, nq).

        A Gaussian of standard deviation `smoothing` seconds, applied without delay. Cameras that follow
        nothing, or whose `smoothing` is 0, come back as they are.
        """
        if self.kind not in ("tracking", "orbit") or not self.frame or self.smoothing <= 0 or len(t) < 2:
            return self
        data = mujoco.MjData(model)
        path = np.empty((len(t), 3))
        for i, q_i in enumerate(q):
            data.qpos[:] = q_i
            mujoco.mj_kinematics(model, data)
            path[i] = self._followed(data)
        times = np.asarray(t, dtype=float)
        smooth = _smoothed(times, path, self.smoothing)

        def centre(now: float) -> Floats:
            return np.array([np.interp(now, times, smooth[:, axis]) for axis in range(3)])

        if self.kind == "orbit":
            return replace(self, frame=None, target=centre)
        offset = self.position
        return replace(
            self,
            kind="fixed",
            frame=None,
            target=centre,
            position=lambda now: centre(now) + vector(offset, now, 3, f"position of camera {self.name!r}"),
        )

    @classmethod
    def auto(cls, model: mujoco.MjModel, q_frames: Floats, *, aspect: float = 4 / 3) -> "Camera":
        """A fixed camera, from the front right and a little above, that holds the motion q_frames (n, nq).

        When the motion travels further than a few times the model's own size, a camera that travels along.
        `aspect` is the picture's width over its height.
        """
        corners = motion_corners(model, np.atleast_2d(np.asarray(q_frames, dtype=float)))
        low, high = corners.min(axis=1), corners.max(axis=1)
        middle, size = (low + high) / 2, float(np.median(np.linalg.norm(high - low, axis=1)))
        travel = float(np.linalg.norm(np.ptp(middle, axis=0)))
        direction = np.array([0.62, -1.0, 0.42])
        direction /= np.linalg.norm(direction)
        body = _moving_root(model)
        if travel > 3 * size and body:
            distance = _distance(corners - middle[:, None], direction, aspect)
            return cls("auto", "tracking", position=1.2 * distance * direction, frame=body)
        centre = (low.min(axis=0) + high.max(axis=0)) / 2
        distance = _distance(corners - centre, direction, aspect)
        return cls("auto", "fixed", position=centre + distance * direction, target=centre)

    def _angle(self, t: float, default: float) -> float:
        fovy = default if self.fovy is None else _number(self.fovy, t)
        if not 0 < fovy < np.pi:
            raise FilmError(
                f"camera {self.name!r}: fovy must lie between 0 and pi rad, not {fovy} at t = {t:.3f} s"
            )
        return fovy

    def _followed(self, data: mujoco.MjData) -> Floats:
        """World position of the followed body or site."""
        model, name = data.model, self.frame or ""
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body >= 0:
            return np.array(data.xpos[body])
        site = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name)
        if site >= 0:
            return np.array(data.site_xpos[site])
        known = [model.body(i).name for i in range(model.nbody)] + [
            model.site(i).name for i in range(model.nsite)
        ]
        raise FilmError(f"camera {self.name!r}: " + unknown("body or site", name, [n for n in known if n]))

    def _model_pose(self, t: float, data: mujoco.MjData) -> tuple[Floats, float]:
        model = data.model
        camera = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_CAMERA, self.frame or "")
        if camera < 0:
            known = [model.cam(i).name for i in range(model.ncam)]
            raise FilmError(
                f"camera {self.name!r}: " + unknown("camera", self.frame or "", [n for n in known if n])
            )
        X_WC = np.eye(4)
        X_WC[:3, :3] = data.cam_xmat[camera].reshape(3, 3) @ _turn(_number(self.roll, t))
        X_WC[:3, 3] = data.cam_xpos[camera]
        return X_WC, self._angle(t, float(np.deg2rad(model.cam_fovy[camera])))


def look_at(position: ArrayLike, target: ArrayLike, *, roll: float = 0.0) -> Floats:
    """Pose X_WC (4, 4) at `position` looking at `target` along -z, world z up (y when looking along z)."""
    eye = np.asarray(position, dtype=float)
    back = eye - np.asarray(target, dtype=float)
    back /= np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    if np.linalg.norm(right) < 1e-6:
        right = np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    X_WC = np.eye(4)
    X_WC[:3, :3] = np.column_stack([right, np.cross(back, right), back]) @ _turn(roll)
    X_WC[:3, 3] = eye
    return X_WC


def motion_corners(model: mujoco.MjModel, q: Floats, *, most: int = 64) -> Floats:
    """Corners (k, n, 3) of the boxes round all drawn geoms, at up to `most` poses of q (m, nq).

    Planes and height fields are left out unless nothing else is there.
    """
    from .drawing import drawn_geoms  # drawing knows which geoms are seen

    geoms = np.array([g for g in drawn_geoms(model) if model.geom_rbound[g] > 0], dtype=int)
    grounds = (mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_HFIELD)
    solid = geoms[~np.isin(model.geom_type[geoms], grounds)]
    geoms = solid if len(solid) else geoms
    signs = np.array(list(np.ndindex(2, 2, 2))) * 2.0 - 1.0
    local = model.geom_aabb[geoms, None, :3] + signs * model.geom_aabb[geoms, None, 3:]
    data = mujoco.MjData(model)
    found = []
    for row in np.unique(np.linspace(0, len(q) - 1, most).astype(int)):
        data.qpos[:] = q[row]
        mujoco.mj_kinematics(model, data)
        if len(geoms):
            R_WG = data.geom_xmat[geoms].reshape(-1, 3, 3)
            corners = data.geom_xpos[geoms, None] + np.einsum("gij,gcj->gci", R_WG, local)
        else:
            corners = data.xpos[:, None] + 0.1 * signs
        found.append(corners.reshape(-1, 3))
    return np.array(found)


def _distance(points: Floats, direction: Floats, aspect: float) -> float:
    """How far along `direction` from the origin a camera sees all points (..., 3), with a margin."""
    in_camera = points.reshape(-1, 3) @ look_at(direction, np.zeros(3))[:3, :3]
    slope = 0.86 * np.tan(_FOVY / 2)
    needed = np.maximum(np.abs(in_camera[:, 0]) / (slope * aspect), np.abs(in_camera[:, 1]) / slope)
    return max(float(np.max(needed + in_camera[:, 2])), 1e-3)


def _moving_root(model: mujoco.MjModel) -> str:
    """The name of the first body that can move freely or, without one, of the first that can move."""
    free = [j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE]
    bodies = [int(model.jnt_bodyid[j]) for j in free] or [int(b) for b in model.jnt_bodyid[:1]] or [0]
    return str(model.body(bodies[0]).name)


def _smoothed(t: Floats, path: Floats, sigma: float) -> Floats:
    """Gaussian mean over time; the weights are of the times themselves, so uneven samples are allowed."""
    smooth = np.empty_like(path)
    first = np.searchsorted(t, t - 4 * sigma)
    last = np.searchsorted(t, t + 4 * sigma, side="right")
    for i in range(len(t)):
        near = slice(first[i], last[i])
        weight = np.exp(-0.5 * ((t[near] - t[i]) / sigma) ** 2)
        smooth[i] = weight @ path[near] / weight.sum()
    return smooth


def _turn(angle: float) -> Floats:
    cosine, sine = np.cos(angle), np.sin(angle)
    return np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])


def _number(value: float | Callable[[float], float], t: float) -> float:
    return float(value(t) if callable(value) else value)
