"""Forward kinematics of one frame over many configurations at once: pose, Jacobian, velocity, acceleration.

A frame knows the joints between itself and the world, and nothing else of the model is computed. Angular
rows come before linear ones, as in MuJoCo's six-vectors; all are in world axes. Inside, arrays are laid out
(column, row, configuration), so that a constant pose is one matrix product and a hinge mixes two columns.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from enum import IntEnum
from math import prod
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..models.errors import ModelError
from ..models.naming import lookup, name_of

Array = NDArray[np.float64]
FrameKind = Literal["body", "site", "geom", "camera"]

_CHUNK = 4096  # configurations worked on at a time: their poses stay in the processor's cache


class _Type(IntEnum):
    """Values of mjtJoint."""

    FREE = 0
    BALL = 1
    SLIDE = 2
    HINGE = 3


class _Joint(NamedTuple):
    """A joint of the chain, in a frame at its anchor with z along its axis.

    `X` (4, 4) is the pose of that frame, before the joint moves, in the moved frame of the joint before.
    """

    type: _Type
    X: Array
    q: int
    v: int
    rest: float


@dataclass(frozen=True, eq=False)
class Frame:
    """A body, site, geom or camera of a model with the chain of joints that moves it; made by `frame`.

    Configurations q are (..., nq), velocities v and accelerations a (..., nv); results have the same leading
    shape. Quaternions in q need not be of unit length. ModelError for arrays of another width.
    """

    kind: FrameKind
    name: str
    nq: int
    nv: int
    joints: tuple[_Joint, ...]
    X_end: Array

    @property
    def dofs(self) -> NDArray[np.intp]:
        """Indices of the degrees of freedom that move the frame, in the order of the chain."""
        width = {_Type.FREE: 6, _Type.BALL: 3, _Type.SLIDE: 1, _Type.HINGE: 1}
        return np.array([j.v + k for j in self.joints for k in range(width[j.type])], dtype=np.intp)

    def pose(self, q: ArrayLike) -> Array:
        """X_WF (..., 4, 4): the frame in the world."""

        def fill(out: Array, q: Array) -> None:
            *_, T = self._walk(q)
            out[:, :3, :] = T.transpose(2, 1, 0)
            out[:, 3, :] = [0.0, 0.0, 0.0, 1.0]

        return _batched(fill, (4, 4), (q, self.nq))

    def jacobian(self, q: ArrayLike) -> Array:
        """J_WF (..., 6, nv): angular and linear velocity of the frame's origin per unit of v."""

        def fill(out: Array, q: Array) -> None:
            *at_joints, T = self._walk(q)
            out[:] = 0.0
            for joint, at in zip(self.joints, at_joints, strict=True):
                arm, v = T[3] - at[3], joint.v
                if joint.type == _Type.SLIDE:
                    out[:, 3:, v] = at[2].T
                    continue
                if joint.type == _Type.FREE:
                    out[:, 3:, v : v + 3] = np.eye(3)
                    v += 3
                for k, axis in enumerate(at[2:3] if joint.type == _Type.HINGE else at[:3]):
                    out[:, :3, v + k] = axis.T
                    out[:, 3:, v + k] = _cross(axis, arm).T

        return _batched(fill, (6, self.nv), (q, self.nq))

    def velocity(self, q: ArrayLike, v: ArrayLike) -> Array:
        """(..., 6): angular velocity [rad/s], then velocity of the origin [m/s], in world axes."""

        def fill(out: Array, q: Array, v: Array) -> None:
            w, p = self._rates(self._walk(q), v)
            out[:, :3], out[:, 3:] = w.T, p.T

        return _batched(fill, (6,), (q, self.nq), (v, self.nv))

    def acceleration(self, q: ArrayLike, v: ArrayLike, a: ArrayLike) -> Array:
        """(..., 6): angular acceleration [rad/s^2], then that of the origin [m/s^2], in world axes.

        The derivative of `velocity` along a motion with v and a = dv/dt; gravity has no part in it.
        """

        def fill(out: Array, q: Array, v: Array, a: Array) -> None:
            w, p = self._second_rates(self._walk(q), v, a)
            out[:, :3], out[:, 3:] = w.T, p.T

        return _batched(fill, (6,), (q, self.nq), (v, self.nv), (a, self.nv))

    def _walk(self, q: Array) -> Iterator[Array]:
        """Poses (4 columns, 3, n) after each joint of the chain, then of the frame, for q (nq, n)."""
        T = np.eye(4)[:, :3, None] * np.ones(q.shape[1])
        for joint in self.joints:
            T = _move(joint, _offset(T, joint.X), q)
            yield T
        yield _offset(T, self.X_end)

    def _rates(self, walk: Iterator[Array], v: Array) -> tuple[Array, Array]:
        """Angular velocity and velocity (3, n) of the frame, from origin to origin along the chain."""
        w = p = np.zeros((3, 1))
        origin = np.zeros((3, 1))
        for joint, T in zip(self.joints, walk, strict=False):
            p = p + _cross(w, T[3] - origin)
            spin, slip = _joint_rates(joint, T, v)
            w = w if spin is None else w + spin
            p = p if slip is None else p + slip
            origin = T[3]
        *_, T = walk
        return w, p + _cross(w, T[3] - origin)

    def _second_rates(self, walk: Iterator[Array], v: Array, a: Array) -> tuple[Array, Array]:
        """Angular acceleration and acceleration (3, n) of the frame, from origin to origin along the chain.

        With r from one origin to the next: p'' += al × r + w × (w × r), and a joint adds its own rates
        and the turning of its axis, w × spin; Coriolis' 2 w × slip for a slide (Craig 2005, ch. 6.3).
        """
        w = al = pp = np.zeros((3, 1))
        origin = np.zeros((3, 1))
        for joint, T in zip(self.joints, walk, strict=False):
            r = T[3] - origin
            pp = pp + _cross(al, r) + _cross(w, _cross(w, r))
            spin, slip = _joint_rates(joint, T, v)
            dspin, dslip = _joint_rates(joint, T, a)
            if slip is not None and dslip is not None:
                pp = pp + dslip + 2 * _cross(w, slip)
            if spin is not None and dspin is not None:
                al = al + dspin + _cross(w, spin)
                w = w + spin
            origin = T[3]
        *_, T = walk
        r = T[3] - origin
        return al, pp + _cross(al, r) + _cross(w, _cross(w, r))


def frame(model: mujoco.MjModel, kind: FrameKind, name: str) -> Frame:
    """The frame of a body, site, geom or camera, by name.

    Raises ModelError for a name that does not exist (lists what does), and for frames that the joints alone
    do not determine: on a mocap body, or a camera that tracks.
    """
    if kind not in ("body", "site", "geom", "camera"):
        raise ModelError(f"no frames of kind {kind!r}; there are: body, camera, geom, site")
    index = lookup(model, kind, name)
    X_end: Array = np.eye(4)
    body = index
    if kind != "body":
        prefix = {"site": "site", "geom": "geom", "camera": "cam"}[kind]
        body = int(getattr(model, f"{prefix}_bodyid")[index])
        X_end = _pose(getattr(model, f"{prefix}_pos")[index], getattr(model, f"{prefix}_quat")[index])
    if kind == "camera" and model.cam_mode[index] != int(mujoco.mjtCamLight.mjCAMLIGHT_FIXED):
        raise ModelError(f"camera {name!r} tracks: its pose does not follow from its body alone")
    joints: list[_Joint] = []
    X: Array = np.eye(4)
    for b in _path(model, body):
        if model.body_mocapid[b] >= 0:
            raise ModelError(
                f"{kind} {name!r} hangs on body {name_of(model, 'body', b)!r}, which is moved as a mocap body"
            )
        X = X @ _pose(model.body_pos[b], model.body_quat[b])
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            joint_type, q = _Type(int(model.jnt_type[j])), int(model.jnt_qposadr[j])
            A = np.eye(4) if joint_type == _Type.FREE else _anchor(model.jnt_pos[j], model.jnt_axis[j])
            joints.append(_Joint(joint_type, X @ A, q, int(model.jnt_dofadr[j]), float(model.qpos0[q])))
            X = np.asarray(np.linalg.inv(A), dtype=float)
    return Frame(kind, name, model.nq, model.nv, tuple(joints), X @ X_end)


def _path(model: mujoco.MjModel, body: int) -> list[int]:
    """Bodies from below the world to `body`."""
    path = []
    while body:
        path.append(body)
        body = int(model.body_parentid[body])
    return path[::-1]


def _pose(p: ArrayLike, quat: ArrayLike) -> Array:
    """X (4, 4) of a position and a quaternion."""
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, np.array(quat, dtype=float))
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = R.reshape(3, 3), p
    return X


def _anchor(p: ArrayLike, axis: ArrayLike) -> Array:
    """Pose at `p` with z along `axis`."""
    quat = np.empty(4)
    mujoco.mju_quatZ2Vec(quat, np.array(axis, dtype=float))
    return _pose(p, quat)


def _offset(T: Array, X: Array) -> Array:
    """Poses T (4, 3, n) times a constant pose X (4, 4)."""
    return np.asarray((X.T @ T.reshape(4, -1)).reshape(T.shape))


def _move(joint: _Joint, T: Array, q: Array) -> Array:
    """Pose (4, 3, n) at the joint's anchor after the joint moved by its part of q (nq, n)."""
    if joint.type == _Type.HINGE:
        c, s = _cos_sin(q[joint.q] - joint.rest)
        x, y = T[0].copy(), T[1]
        T[0] *= c
        T[0] += s * y
        T[1] *= c
        T[1] -= s * x
    elif joint.type == _Type.SLIDE:
        T[3] += (q[joint.q] - joint.rest) * T[2]
    elif joint.type == _Type.BALL:
        R = _rotation_columns(q[joint.q : joint.q + 4])
        T[:3] = np.einsum("krn,jkn->jrn", T[:3], R)
    else:
        T[:3] = _rotation_columns(q[joint.q + 3 : joint.q + 7])
        T[3] = q[joint.q : joint.q + 3]
    return T


def _cos_sin(angle: Array) -> tuple[Array, Array]:
    """Cosine and sine, to 1e-15, by the tangent of half the angle: NumPy vectorises that, not the two."""
    t = np.tan(0.5 * angle)
    tt = t * t
    d = 1.0 / (1.0 + tt)
    return (1.0 - tt) * d, 2.0 * t * d


def _rotation_columns(quat: Array) -> Array:
    """Columns (3 columns, 3, n) of the rotation matrices of quaternions (4, n) of any length."""
    w, x, y, z = quat / np.linalg.norm(quat, axis=0)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)],
            [2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)],
            [2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def _joint_rates(joint: _Joint, T: Array, v: Array) -> tuple[Array | None, Array | None]:
    """What a joint with velocities v (nv, n) adds to angular velocity and to velocity (3, n), or None."""
    k = joint.v
    if joint.type == _Type.HINGE:
        return T[2] * v[k], None
    if joint.type == _Type.SLIDE:
        return None, T[2] * v[k]
    if joint.type == _Type.BALL:
        return np.einsum("krn,kn->rn", T[:3], v[k : k + 3]), None
    return np.einsum("krn,kn->rn", T[:3], v[k + 3 : k + 6]), v[k : k + 3]


def _cross(x: Array, y: Array) -> Array:
    """x × y for (3, n)."""
    return np.stack([x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]])


def _batched(fill: Callable[..., None], shape: tuple[int, ...], *inputs: tuple[ArrayLike, int]) -> Array:
    """Results (..., *shape) that `fill(out, *transposed inputs)` writes chunk by chunk."""
    arrays = [np.asarray(x, dtype=float) for x, _ in inputs]
    for label, array, (_, width) in zip("qva", arrays, inputs, strict=False):
        if array.ndim == 0 or array.shape[-1] != width:
            raise ModelError(f"{label} of shape {array.shape} does not fit: the model needs (..., {width})")
    lead = np.broadcast_shapes(*(x.shape[:-1] for x in arrays))
    n = prod(lead)
    flat = [np.broadcast_to(x, (*lead, x.shape[-1])).reshape(n, x.shape[-1]) for x in arrays]
    out = np.empty((n, *shape))
    for i in range(0, n, _CHUNK):
        part = slice(i, i + _CHUNK)
        fill(out[part], *(np.ascontiguousarray(x[part].T) for x in flat))
    return out.reshape(*lead, *shape)
