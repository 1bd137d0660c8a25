# ruff: noqa: D102  (overridden methods are documented by Goal)
"""What animators ask for on top of goals: poles, soft reach, spread spines, locked feet, FK/IK blends."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models.naming import lookup, name_of
from .. import rotations
from ..errors import ModelError
from ..kinds import BALL, SCALAR
from .goals import Goal, Orientation, Pose, Position, Rows, Unit, vector
from .numeric.descend import descend
from .pose import Configurations, Kinematics, Moving
from .problem import Problem
from .space import Space
from .track import near_path
from .wholes import Posture

Array = NDArray[np.float64]
_LOCKED = 1e-7  # [m]
_EASED = 1e4  # weight of places on the way to a stance, beside one of the motion
_TURNED = 1e2  # of orientations in stances
_STEPS = 8  # that bring frames to their places


@dataclass(frozen=True, eq=False)
class Pole(Goal):
    """A limb bends towards a point: `mid` lies on the side of the line from `root` to `tip` where `pole` is.

    Residual [m]: the part of mid - root across the line, less its length along that of pole - root; it fades
    out as the limb straightens, where no side is left. Usually a wish, with a weight.
    """

    root: str
    mid: str
    tip: str
    pole: ArrayLike

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "pole", vector("pole", self.pole))

    def frames(self) -> tuple[str, ...]:
        return (self.root, self.mid, self.tip)

    def units(self) -> tuple[Unit, ...]:
        return ("m",) * 3

    def rows(self, c: Configurations) -> Rows:
        root, mid, tip = (c.frame(name) for name in self.frames())
        A, dA = _unit(tip.p - root.p, tip.Jv - root.Jv)
        m, dm = _across(mid.p - root.p, mid.Jv - root.Jv, A, dA)
        w, dw = _across(np.asarray(self.pole) - root.p, -root.Jv, A, dA)
        w, dw = _unit(w, dw)
        u, _ = _unit(m, dm)
        long = np.linalg.norm(m, axis=1)
        J = dm - w[:, :, None] * (u[:, None, :] @ dm) - long[:, None, None] * dw
        return Rows(m - long[:, None] * w, J)


def _unit(x: Array, dx: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 3) and their derivatives (n, 3, nv); zero stays zero."""
    long = np.maximum(np.linalg.norm(x, axis=1), 1e-9)
    u = x / long[:, None]
    return u, (dx - u[:, :, None] * (u[:, None, :] @ dx)) / long[:, None, None]


def _across(x: Array, dx: Array, A: Array, dA: Array) -> tuple[Array, Array]:
    """Part of x across the unit vectors A, with its derivative."""
    along = np.sum(x * A, axis=1)
    dalong = A[:, None, :] @ dx + x[:, None, :] @ dA
    return x - along[:, None] * A, dx - A[:, :, None] * dalong - along[:, None, None] * dA


@dataclass(frozen=True, eq=False)
class Spread(Goal):
    """Joints of one kind share a turn: each stands at its share of the whole, as the vertebrae of a spine.

    `shares`: one for every joint, any positive numbers; default all alike. Usually a wish, with a weight.
    """

    joints: tuple[str, ...]
    shares: tuple[float, ...] = ()

    @property
    def label(self) -> str:
        return self.name or "spread " + " ".join(self.joints)

    def frames(self) -> tuple[str, ...]:
        return ()

    def units(self) -> tuple[Unit, ...]:
        return ("rad",)

    def row_units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        kinds = {int(model.jnt_type[lookup(model, "joint", name)]) for name in self.joints}
        unit: Unit = "rad"
        return (unit,) * ((len(self.joints) - 1) * (3 if kinds == {BALL} else 1))

    def moved(self, kinematics: Kinematics) -> NDArray[np.bool_]:
        model = kinematics.model
        ids = [lookup(model, "joint", name) for name in self.joints]
        return np.isin(model.dof_jntid, ids)

    def rows(self, c: Configurations) -> Rows:
        model, shares = c.model, np.array(self.shares or (1.0,) * len(self.joints), dtype=float)
        if len(self.joints) < 2 or len(shares) != len(self.joints) or not (shares > 0).all():
            raise ModelError(f"{self.label}: needs two joints or more and a positive share for each")
        parts = [_coordinate(model, name, c.q) for name in self.joints]
        if len({r.shape[1] for r, _ in parts}) > 1:
            raise ModelError(f"{self.label}: joints of different kinds share nothing")
        shares = shares / shares.sum()
        scaled = [(r / s, J / s) for (r, J), s in zip(parts, shares, strict=True)]
        r = [b[0] - a[0] for a, b in pairwise(scaled)]
        J = [b[1] - a[1] for a, b in pairwise(scaled)]
        return Rows(np.concatenate(r, axis=1), np.concatenate(J, axis=1))


def _coordinate(model: mujoco.MjModel, name: str, q: Array) -> tuple[Array, Array]:
    """Coordinate (n, 1), or rotation vector (n, 3) of a ball, and its Jacobian."""
    j = lookup(model, "joint", name)
    kind, at, v = int(model.jnt_type[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    J = np.zeros((len(q), 3 if kind == BALL else 1, model.nv))
    if kind == BALL:
        phi = rotations.log(q[:, at : at + 4])
        J[:, :, v : v + 3] = rotations.inverse_right_jacobian(phi)
        return phi, J
    if kind not in SCALAR:
        raise ModelError(f"joint {name!r} is free: it has no share of a turn")
    J[:, 0, v] = 1.0
    return q[:, at : at + 1] - model.qpos0[at], J


def soften(root: ArrayLike, target: ArrayLike, reach: float, softness: float) -> Array:
    """A target drawn in so that a limb of length `reach` from `root` never snaps straight (Nicholas 2010).

    Within reach - softness nothing changes; beyond, the distance approaches `reach` exponentially, C1.
    """
    if not 0 < softness < reach:
        raise ModelError(f"softness must be positive and below the reach {reach:g} m, not {softness:g}")
    root, target = np.asarray(root, dtype=float), np.asarray(target, dtype=float)
    away = target - root
    far = float(np.linalg.norm(away))
    easy = reach - softness
    if far <= easy:
        return target.copy()
    return np.asarray(root + away / far * (easy + softness * (1.0 - np.exp(-(far - easy) / softness))))


def blend(
    model: mujoco.MjModel,
    q_fk: ArrayLike,
    q_ik: ArrayLike,
    share: ArrayLike,
    *,
    joints: Sequence[str] | None = None,
) -> Array:
    """From a keyed motion (k, nq) to a solved one: `share` (k,) or a number, 0 for FK, 1 for IK.

    Every joint goes along its shortest way, so that limits that both keep are kept. `joints` limits the blend
    to a limb; the others stay keyed.
    """
    space = Space(model)
    fk, ik = np.atleast_2d(np.asarray(q_fk, dtype=float)), np.atleast_2d(np.asarray(q_ik, dtype=float))
    if fk.shape != ik.shape or fk.shape[1] != model.nq or np.size(share) not in (1, len(fk)):
        raise ModelError(
            f"a blend needs two motions of {model.nq} columns (nq) and one length, and a share for each row; "
            f"these have shapes {fk.shape}, {ik.shape} and {np.shape(share)}"
        )
    d = space.difference(ik, fk) * np.broadcast_to(np.asarray(share, dtype=float), (len(fk),))[:, None]
    if joints is not None:
        ids = [lookup(model, "joint", name) for name in joints]
        d = d * np.isin(model.dof_jntid, ids)
    out = space.step(fk, d)
    return out if np.ndim(q_fk) == 2 else out[0]


class Locked(NamedTuple):
    """A motion with locked frames.

    q (k, nq); `slip` (k,) [m]: how far a locked frame is from its place; `met` (k,): all was held.
    """

    q: Array
    slip: Array
    met: NDArray[np.bool_]


def lock(
    model: mujoco.MjModel,
    t: ArrayLike,
    q: ArrayLike,
    stances: Mapping[str, Sequence[tuple[float, float]]],
    *,
    ease: float = 0.15,
    joints: Sequence[str] | None = None,
) -> Locked:
    """A motion q (k, nq) at times t (k,) with frames held still in the world: feet that do not slide.

    Places are kept at all times t, to 1e-7 m; orientations as far as the limb's joints and the motion allow
    (many legs have only five). The whole is smooth, as near to the motion as that leaves it. Between the
    times a curve through the result leaves the places a little, the less the denser they are: give 120 a
    second and more where a curve of the answer must stand still to a tenth of a millimetre.

    Args:
        model: constant.
        t, q: the motion, as keyed or captured.
        stances: for every frame (a site, or `body:foot`) the times between which it stands; it keeps the pose
            that it has in the middle of them.
        ease: time to leave the motion before a stance and to return after it [s].
        joints: that may move for it; default those between the frame and the free joint above it.

    Where a leg is too short for its place, `met` is False there and `slip` tells by how much. Raises
    ModelError for times that are not evenly spaced, or stances that end before they start.
    """
    t, q = np.asarray(t, dtype=float), np.array(q, dtype=float)
    if q.shape != (t.size, model.nq) or not np.isfinite(q).all():
        raise ModelError(f"a motion at {t.size} times is {t.size} x {model.nq} finite numbers, not {q.shape}")
    space, kinematics = Space(model), Kinematics(model)
    out, slip, met = space.clip(q), np.zeros(len(t)), np.ones(len(t), dtype=bool)
    places = {name: _places(kinematics, name, t, q, list(spans)) for name, spans in stances.items()}
    wanted = [
        [w for n in stances if (w := _eased(kinematics, n, float(x), q[k], places[n], ease)) is not None]
        for k, x in enumerate(t)
    ]
    touched = [k for k, goals in enumerate(wanted) if goals]
    if not touched:
        return Locked(out, slip, met)
    moving = _limb_joints(model, kinematics, list(stances)) if joints is None else list(joints)
    rows = [_row(goals, q[k]) for k, goals in enumerate(wanted)]
    smooth = near_path(model, rows, t, out, moving)
    for k in touched:
        out[k] = smooth[k]
        held = [Position(pose.at, pose.position, tolerance=_LOCKED) for pose, locked in wanted[k] if locked]
        if held:
            problem = Problem(model, held, space, joints=moving, kinematics=kinematics)
            others = np.concatenate(
                [space.clip(q[k][None]), _carried(space, out[max(k - 1, 0)], smooth[k], problem)]
            )
            out[k], slip[k] = _stood(problem, smooth[k], others)
            met[k] = slip[k] <= _LOCKED * 2
    return Locked(out, slip, met)


def _row(goals: Sequence[tuple[Pose, bool]], q: Array) -> list[Goal]:
    """Goals of an instant: places of locked frames; wishes: places on the way, orientations, the motion q."""
    out: list[Goal] = [Posture(q, weight=1.0)]
    for pose, locked in goals:
        out.append(Position(pose.at, pose.position, weight=None if locked else _EASED))
        out.append(Orientation(pose.at, pose.quat, weight=_TURNED))
    return out


def _stood(problem: Problem, q: Array, others: Array) -> tuple[Array, float]:
    """q (nq,) changed least until frames are at their places, or as near as can be, also from other starts
    (n, nq); and how far they are [m]."""
    x = q[None]
    for _ in range(_STEPS):
        r = problem.raw(x)
        if problem.met(r.r)[0]:
            break
        x = problem.space.step(x, np.linalg.lstsq(r.J[0], -r.r[0], rcond=1e-4)[0][None])
    if not problem.met(problem.raw(x).r)[0]:
        ends = descend(problem, np.concatenate([q[None], others]))
        away = np.abs(problem.space.difference(ends.q, q[None])).max(axis=1)
        x = ends.q[int(np.argmin(np.where(ends.met, away, 1e3 + ends.cost)))][None]
    r = problem.raw(x).r[0]
    return np.asarray(x[0]), max(float(np.linalg.norm(r[group.rows])) for group in problem.groups)


class _Stance(NamedTuple):
    """A stretch of time and the pose that is kept in it."""

    start: float
    end: float
    p: Array
    quat: Array


def _places(
    kinematics: Kinematics, name: str, t: Array, q: Array, spans: list[tuple[float, float]]
) -> list[_Stance]:
    out = []
    for start, end in spans:
        if not start < end:
            raise ModelError(f"a stance of {name!r} must end after it starts: {start:g} s, {end:g} s")
        middle = int(np.argmin(np.abs(t - 0.5 * (start + end))))
        f = _at(kinematics, name, q[middle])
        out.append(_Stance(start, end, f.p[0], rotations.from_matrix(f.R[0])))
    return out


def _at(kinematics: Kinematics, name: str, q: Array) -> Moving:
    return kinematics.at(q[None]).frame(name)


def _eased(
    kinematics: Kinematics, name: str, t: float, q: Array, places: list[_Stance], ease: float
) -> tuple[Pose, bool] | None:
    """Where the frame belongs at time t, and whether it is locked there; None where the motion is free."""
    shares = [(_share(t, place, ease), place) for place in places]
    share, place = max(shares, key=lambda pair: pair[0], default=(0.0, None))
    if share <= 0.0 or place is None:
        return None
    f = _at(kinematics, name, q)
    quat = rotations.from_matrix(f.R[0])
    turn = rotations.log(rotations.multiply(rotations.conjugate(quat), place.quat))
    p = f.p[0] + share * (place.p - f.p[0])
    return Pose(name, p, rotations.multiply(quat, rotations.exp(share * turn))), share >= 1.0


def _share(t: float, place: _Stance, ease: float) -> float:
    """1 within a stance, smoothly 0 `ease` away from it."""
    away = max(place.start - t, t - place.end, 0.0)
    if ease <= 0:
        return float(away == 0)
    x = max(0.0, 1.0 - away / ease)
    return x * x * (3 - 2 * x)


def _carried(space: Space, before: Array, q: Array, problem: Problem) -> Array:
    """q (nq,) with the limb as it was `before`, (1, nq)."""
    return space.step(q[None], space.difference(before[None], q[None]) * problem.moved)


def _limb_joints(model: mujoco.MjModel, kinematics: Kinematics, names: Sequence[str]) -> list[str]:
    """Joints that move some frame, free joints apart."""
    mask = np.zeros(model.nv, dtype=bool)
    for name in names:
        mask[kinematics.frame(name).dofs] = True
    ids = dict.fromkeys(int(j) for j in model.dof_jntid[mask])
    return [name_of(model, "joint", j) for j in ids if int(model.jnt_type[j]) in (*SCALAR, BALL)]
