"""Clips: the keyed motion of a model, one track a joint, evaluated as whole arrays of q, v and a."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from types import MappingProxyType
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

from ..models.naming import joint_names, lookup, name_of
from .curves import Array, Curve, frozen
from .errors import KeyingError, unknown
from .rotation_curves import RotationCurve

_FREE, _BALL = int(mujoco.mjtJoint.mjJNT_FREE), int(mujoco.mjtJoint.mjJNT_BALL)
_JOINT_KINDS = {_FREE: "free joint", _BALL: "ball joint", 2: "slide joint", 3: "hinge joint"}


class Motion(NamedTuple):
    """Motion of a model: q (..., nq), v and a (..., nv), a = dv/dt in MuJoCo's coordinates."""

    q: Array
    v: Array
    a: Array


@dataclass(frozen=True)
class FreeTrack:
    """Track of a free joint: position [m] and orientation in the world frame, either or both keyed."""

    position: Curve | None = None
    rotation: RotationCurve | None = None


Track = Curve | FreeTrack


class _Channel(NamedTuple):
    """A curve and the columns it fills: qpos and dof addresses."""

    curve: Curve
    q: slice
    v: slice


class Clip:
    """Keyed motion of `model`: `tracks` by joint name, and `q0` (nq,), where everything else stays.

    Hinge and slide joints take a curve of one number, ball joints a RotationCurve, free joints a FreeTrack.
    A joint without a name goes by its number, as `joint3`. `q0` defaults to the model's `qpos0`. Raises
    KeyingError listing every track that does not fit.
    """

    def __init__(self, model: mujoco.MjModel, tracks: Mapping[str, Track], q0: ArrayLike | None = None):
        self.model = model
        self.tracks = MappingProxyType(dict(tracks))
        self.q0: Array = frozen(np.array(model.qpos0 if q0 is None else q0, dtype=float))
        if self.q0.shape != (model.nq,):
            raise KeyingError(f"q0 must have shape ({model.nq},), not {self.q0.shape}")
        mistakes = [text for name, track in self.tracks.items() if (text := self._mistake(name, track))]
        if mistakes:
            raise KeyingError("\n".join(mistakes))

    def evaluate(self, t: ArrayLike, *, left: bool = False) -> Motion:
        """Motion at times `t` [s] of any shape; at breaks from the right, or from the `left`.

        Coordinates without keys stay at `q0` with v = a = 0.
        """
        t = np.asarray(t, dtype=float)
        q = np.broadcast_to(self.q0, (*t.shape, self.model.nq)).copy()
        v = np.zeros((*t.shape, self.model.nv))
        a = np.zeros_like(v)
        for curve, columns_q, columns_v in self._channels:
            q[..., columns_q], v[..., columns_v], a[..., columns_v] = curve(t, left=left)
        return Motion(q, v, a)

    def with_coupled(self) -> "Clip":
        """This clip with the joints added that the model's active joint equalities tie to keyed ones.

        The follower's q, v, a follow from the leader's by the chain rule; ties of ties included. A tie given
        from follower to leader is inverted when it is straight (q1 = c0 + c1 q2), else KeyingError.
        """
        tracks, ties = dict(self.tracks), _ties(self.model)
        while new := [tie for tie in ties if tie.leader in tracks and tie.follower not in tracks]:
            follower, leader, polynomial = new[0]
            if polynomial is None:
                raise KeyingError(
                    f"joint {leader!r} is tied to {follower!r} by a curved polynomial, which gives "
                    f"{leader!r} from {follower!r} only: key {follower!r} instead"
                )
            tracks[follower] = _follow(tracks[leader], polynomial)
        return Clip(self.model, tracks, self.q0)

    @cached_property
    def dofs(self) -> NDArray[np.bool_]:
        """Mask (nv,) of the keyed degrees of freedom."""
        return _mask(self.model.nv, [channel.v for channel in self._channels])

    @cached_property
    def qpos_mask(self) -> NDArray[np.bool_]:
        """Mask (nq,) of the keyed coordinates."""
        return _mask(self.model.nq, [channel.q for channel in self._channels])

    @property
    def start(self) -> float:
        """Time of the first key of all [s]; 0 without keys."""
        return min((channel.curve.start for channel in self._channels), default=0.0)

    @property
    def end(self) -> float:
        """Time of the last key of all [s]; 0 without keys."""
        return max((channel.curve.end for channel in self._channels), default=0.0)

    @cached_property
    def breaks(self) -> Array:
        """Times where q, v or a of any channel jumps; of loops, those of the first period."""
        return _union([channel.curve.breaks for channel in self._channels])

    def breaks_between(self, t0: float, t1: float) -> Array:
        """Times strictly between `t0` and `t1` where q, v or a of any channel jumps, all turns of loops."""
        return _union([channel.curve.breaks_between(t0, t1) for channel in self._channels])

    def knots_between(self, t0: float, t1: float) -> Array:
        """Times strictly between `t0` and `t1` where a piece of any channel ends, all turns of loops."""
        return _union([channel.curve.knots_between(t0, t1) for channel in self._channels])

    @cached_property
    def _channels(self) -> tuple[_Channel, ...]:
        channels = []
        for name, track in self.tracks.items():
            joint = lookup(self.model, "joint", name)
            q, v = int(self.model.jnt_qposadr[joint]), int(self.model.jnt_dofadr[joint])
            if not isinstance(track, FreeTrack):
                channels.append(_Channel(track, slice(q, q + track.dim), slice(v, v + track.dof)))
                continue
            if track.position is not None:
                channels.append(_Channel(track.position, slice(q, q + 3), slice(v, v + 3)))
            if track.rotation is not None:
                channels.append(_Channel(track.rotation, slice(q + 3, q + 7), slice(v + 3, v + 6)))
        return tuple(channels)

    def _mistake(self, name: str, track: Track) -> str | None:
        """What is wrong with a track, or None."""
        names = joint_names(self.model)
        if name not in names:
            return unknown("joint", name, names)
        kind = int(self.model.jnt_type[names.index(name)])
        if kind == _FREE:
            if not isinstance(track, FreeTrack):
                fits, needs = False, "a FreeTrack of a position and a rotation curve"
            else:
                p, r = track.position, track.rotation
                fits = p is None or p.dim == 3
                fits = fits and (r is None or isinstance(r, RotationCurve))
                needs = "a position of three numbers and a RotationCurve"
        elif kind == _BALL:
            fits, needs = isinstance(track, RotationCurve), "a RotationCurve (keyed_rotation)"
        else:
            fits = isinstance(track, Curve) and track.dim == 1
            needs = "a curve of one number"
        if fits:
            return None
        got = f"{type(track).__name__} of {track.dim}" if isinstance(track, Curve) else type(track).__name__
        return f"{_JOINT_KINDS[kind]} {name!r} needs {needs}, not {got}"


@dataclass(frozen=True, eq=False)
class CoupledCurve(Curve):
    """The curve p(q) of a joint that is tied to a `leader` with curve q, p a `polynomial`."""

    leader: Curve
    polynomial: Polynomial

    def _piece(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array, Array]:
        x, dx, ddx = self.leader._piece(i, s)
        slope, curvature = self.polynomial.deriv(1)(x), self.polynomial.deriv(2)(x)
        return self.polynomial(x), slope * dx, slope * ddx + curvature * dx**2


class _Tie(NamedTuple):
    """A follower's coordinate as a polynomial of its leader's; None where none exists."""

    follower: str
    leader: str
    polynomial: Polynomial | None


def _ties(model: mujoco.MjModel) -> list[_Tie]:
    """Active joint equalities of `model`, read forwards and backwards.

    MuJoCo: q1 - qpos0_1 = c0 + c1 x + ... + c4 x^4, x = q2 - qpos0_2 (documentation of equality/joint).
    """
    ties = []
    for e in np.flatnonzero((model.eq_type == int(mujoco.mjtEq.mjEQ_JOINT)) & (model.eq_active0 != 0)):
        joint1, joint2 = model.eq_obj1id[e], model.eq_obj2id[e]
        if joint2 < 0:
            continue
        name1, name2 = (name_of(model, "joint", int(j)) for j in (joint1, joint2))
        rest1, rest2 = model.qpos0[model.jnt_qposadr[[joint1, joint2]]]
        c = Polynomial(model.eq_data[e, :5])
        ties.append(_Tie(name1, name2, rest1 + c(Polynomial([-rest2, 1.0]))))
        c0, c1 = (float(x) for x in c.coef[:2])
        if c.coef[2:].any():
            ties.append(_Tie(name2, name1, None))
        elif c1:
            ties.append(_Tie(name2, name1, Polynomial([rest2 - (rest1 + c0) / c1, 1.0 / c1])))
    return ties


def _follow(leader: Track, polynomial: Polynomial) -> CoupledCurve:
    assert isinstance(leader, Curve)
    values = frozen(polynomial(leader.values))
    return CoupledCurve(leader.times, values, leader.knots, leader.before, leader.after, leader, polynomial)


def _mask(n: int, columns: list[slice]) -> NDArray[np.bool_]:
    mask = np.zeros(n, dtype=bool)
    for c in columns:
        mask[c] = True
    mask.setflags(write=False)
    return mask


def _union(times: list[Array]) -> Array:
    return frozen(np.unique(np.concatenate([np.empty(0), *times])))
