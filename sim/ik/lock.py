"""Feet that do not slide: frames of a motion held still in the world while they stand.

Before a stance the frame is led to its place, and afterwards back, without a jump in acceleration (along the
quintic 10 x^3 - 15 x^4 + 6 x^5). A cubic spline through exact instants dt apart then leaves the place by
O(dt^3) at most: instants are put between the given ones until it stays within the tolerance.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models.naming import name_of
from .. import rotations
from ..clip import Clip
from ..errors import ModelError
from ..kinds import BALL, SCALAR
from .goals import Goal, Orientation, Position
from .numeric.descend import descend
from .pose import Kinematics
from .problem import Problem
from .space import Space
from .spline import smooth_clip
from .stream import frozen
from .track import evenly, near_path
from .wholes import Posture

Array = NDArray[np.float64]
_LOCKED = 1e-7  # [m] at instants
_EASED = 1e4  # weight of places on the way to a stance, beside one of the motion
_TURNED = 1e2  # of orientations in stances
_STEPS = 8  # that bring frames to their places
_BETWEEN = 8  # times between two instants at which the curve is looked at
_FINEST = 1 / 400  # [s]
_BESIDE, _KINK = 4, 0.035  # instants, [s]: how far a spline's kink where a leg gets too short may reach


@dataclass(frozen=True)
class Slide:
    """A stretch of a stance in which a frame slides: its leg is too short, or at its limits.

    The frame is `far` [m] from its place at the `worst` time.
    """

    frame: str
    start: float
    end: float
    worst: float
    far: float

    def __str__(self) -> str:
        return (
            f"{self.frame} slides between {self.start:.3f} s and {self.end:.3f} s, "
            f"{1e3 * self.far:.3g} mm at {self.worst:.3f} s"
        )


@dataclass(frozen=True)
class Locked:
    """A motion with locked frames.

    Attributes:
        t (n,), q (n, nq): instants, those given and evenly spaced ones between them, and configurations; a
            natural spline through them holds the frames at every time.
        slip (n,): how far the curve leaves a locked frame from its place, at most, between the neighbours of
            an instant [m].
        met (n,): it is within the tolerance there.
        slides: stretches where it is not.
    """

    model: mujoco.MjModel = field(repr=False)
    t: Array
    q: Array
    slip: Array
    met: NDArray[np.bool_]
    slides: tuple[Slide, ...]

    def clip(self) -> Clip:
        """The motion as curves of all joints that move: natural splines through `q`."""
        space = Space(self.model, limits=False)
        moving = np.ptp(space.difference(self.q, self.q[:1]), axis=0) > 1e-12
        joints = sorted({int(j) for j in self.model.dof_jntid[moving]})
        return smooth_clip(self.model, self.t, self.q, joints)


def lock(
    model: mujoco.MjModel,
    t: ArrayLike,
    q: ArrayLike,
    stances: Mapping[str, Sequence[tuple[float, float]]],
    *,
    ease: float = 0.15,
    joints: Sequence[str] | None = None,
    tolerance: float = 1e-4,
) -> Locked:
    """A motion q (k, nq) at times t (k,) with frames held still in the world: feet that do not slide.

    The curve through the answer keeps the places at every time within the stances; orientations are kept as
    far as the limb's joints and the motion allow (many legs have only five). The whole is smooth, as near to
    the motion as that leaves it.

    Args:
        model: constant.
        t, q: the motion, as keyed or captured; between its times it is the natural spline through them.
        stances: for every frame (a site, or `body:foot`) the times between which it stands; it keeps the pose
            that it has in the middle of them.
        ease: time to leave the motion before a stance and to return after it [s].
        joints: that may move for it; default those between the frame and the free joint above it.
        tolerance: how far the curve may leave a place between instants [m].

    Where a leg is too short for its place the answer is as near as it comes; `slides` tells when and by how
    much. Raises ModelError for times that are not evenly spaced, no stances, and stances that end before they
    start, overlap or lie outside the motion.
    """
    t, q = np.asarray(t, dtype=float), np.array(q, dtype=float)
    evenly(t)
    if q.shape != (t.size, model.nq) or not np.isfinite(q).all():
        raise ModelError(f"a motion at {t.size} times is {t.size} x {model.nq} finite numbers, not {q.shape}")
    _check(t, stances, ease, tolerance)
    given = smooth_clip(model, t, q, range(model.njnt))
    line = _Line(model, given, stances, ease, joints)
    finer, motion = 1, given
    while True:
        fine = np.linspace(t[0], t[-1], finer * (len(t) - 1) + 1)
        out = line.held(fine, motion)
        motion = smooth_clip(model, fine, out, range(model.njnt))
        drifts = [line.drift(motion, fine, place) for place in line.places]
        slip = np.max([drift.slip(fine) for drift in drifts], axis=0)
        if fine[1] - fine[0] <= _FINEST or not any(drift.coarse(fine, tolerance) for drift in drifts):
            break
        finer *= 2
    slides = [slide for drift in drifts for slide in drift.slides(tolerance)]
    slides.sort(key=lambda slide: slide.start)
    fine, out, around = frozen(fine), frozen(out), frozen(_around(slip))
    met = around <= tolerance
    met.setflags(write=False)
    return Locked(model, fine, out, around, met, tuple(slides))


def _around(slip: Array) -> Array:
    """Of stretches between instants (n - 1,), the larger at every instant (n,)."""
    return np.asarray(np.maximum(np.concatenate([[0.0], slip]), np.concatenate([slip, [0.0]])))


def _check(
    t: Array, stances: Mapping[str, Sequence[tuple[float, float]]], ease: float, tolerance: float
) -> None:
    if not stances:
        raise ModelError('no frame stands; give stances as {"left_foot": [(0.2, 0.5)]}')
    if not (np.isfinite(ease) and ease >= 0):
        raise ModelError(f"the time to ease in and out is finite and not negative, not {ease:g} s")
    if not tolerance > 10 * _LOCKED:
        raise ModelError(
            f"places are kept to {_LOCKED:g} m at instants; a tolerance of {tolerance:g} m is none"
        )
    for name, spans in stances.items():
        if not len(spans):
            raise ModelError(f"{name!r} has no stance; leave it out, or say from when to when it stands")
        for start, end in spans:
            if not start < end:
                raise ModelError(f"a stance of {name!r} must end after it starts: {start:g} s, {end:g} s")
            if start < t[0] - 1e-9 or end > t[-1] + 1e-9:
                raise ModelError(
                    f"a stance of {name!r} from {start:g} s to {end:g} s is not within the motion, "
                    f"{t[0]:g} s to {t[-1]:g} s"
                )
        ordered = sorted(spans)
        for (_, end), (start, _) in pairwise(ordered):
            if start <= end:
                raise ModelError(
                    f"stances of {name!r} overlap: one ends at {end:g} s, the next starts at {start:g} s"
                )


class _Place(NamedTuple):
    """A frame, the time it stands, and the pose that it keeps."""

    frame: str
    start: float
    end: float
    p: Array
    quat: Array

    def widened(self, t: Array) -> _Place:
        """The stance from the last of instants t (n,) before it to the first after it."""
        before, after = t[t <= self.start + 1e-9], t[t >= self.end - 1e-9]
        return self._replace(start=float(before.max(initial=t[0])), end=float(after.min(initial=t[-1])))

    def share(self, t: Array, ease: float) -> Array:
        """1 within the stance, smoothly 0 `ease` away from it."""
        away = np.maximum(np.maximum(self.start - t, t - self.end), 0.0)
        if ease <= 0:
            return np.asarray(away == 0, dtype=float)
        x = np.maximum(0.0, 1.0 - away / ease)
        return np.asarray(x**3 * (10 - 15 * x + 6 * x * x))


class _Drift(NamedTuple):
    """How far (m,) [m] a curve is from a place at times (m,) of its stance."""

    place: _Place
    times: Array
    far: Array

    def slip(self, t: Array) -> Array:
        """The most between instants t (n,): (n - 1,)."""
        out = np.zeros(len(t) - 1)
        at = np.clip(np.searchsorted(t, self.times + 1e-9) - 1, 0, len(t) - 2)
        np.maximum.at(out, at, self.far)
        return out

    def coarse(self, t: Array, tolerance: float) -> bool:
        """Whether finer instants than t (n,) serve: it slips between some that are far from those where the
        place is out of reach."""
        at = np.abs(self.times - t[np.clip(np.searchsorted(t, self.times - 1e-9), 0, len(t) - 1)]) < 1e-8
        lost = self.times[at & (self.far > 10 * _LOCKED)]
        slips = self.times[self.far > tolerance]
        apart = np.abs(slips[:, None] - lost).min(axis=1, initial=np.inf)
        return bool((apart > min(_BESIDE * (t[1] - t[0]), _KINK)).any())

    def slides(self, tolerance: float) -> list[Slide]:
        """Stretches of more than the tolerance [m]; short ways between two of them belong to both."""
        over = np.flatnonzero(self.far > tolerance)
        if not len(over):
            return []
        out = []
        for part in np.split(over, np.flatnonzero(np.diff(self.times[over]) > _KINK) + 1):
            k = part[int(np.argmax(self.far[part]))]
            start, end, worst = (float(self.times[x]) for x in (part[0], part[-1], k))
            out.append(Slide(self.place.frame, start, end, worst, float(self.far[k])))
        return out


class _Wanted(NamedTuple):
    """Where a frame belongs at an instant, and whether it is locked there."""

    frame: str
    p: Array
    quat: Array
    locked: bool


class _Line:
    """A motion and the places that frames keep in it."""

    def __init__(
        self,
        model: mujoco.MjModel,
        given: Clip,
        stances: Mapping[str, Sequence[tuple[float, float]]],
        ease: float,
        joints: Sequence[str] | None,
    ) -> None:
        self.model, self.given, self.ease = model, given, ease
        self.space, self.kinematics = Space(model), Kinematics(model)
        self.joints = _limb_joints(model, self.kinematics, list(stances)) if joints is None else list(joints)
        self.places = []
        for name, spans in stances.items():
            for start, end in sorted(spans):
                f = self.kinematics.at(given.evaluate(np.array([0.5 * (start + end)])).q).frame(name)
                self.places.append(_Place(name, start, end, f.p[0], rotations.from_matrix(f.R[0])))

    def held(self, t: Array, motion: Clip) -> Array:
        """Configurations (n, nq) at instants t (n,), found from a motion before."""
        q = self.given.evaluate(t).q
        wanted = self._wanted(t, q)
        near = self.space.clip(motion.evaluate(t).q)
        smooth = near_path(
            self.model, [_row(ws, x) for ws, x in zip(wanted, q, strict=True)], t, near, self.joints
        )
        out = self.space.clip(q)
        for k, ws in enumerate(wanted):
            held = [Position(w.frame, w.p, tolerance=_LOCKED) for w in ws]
            if held:
                problem = Problem(
                    self.model, held, self.space, joints=self.joints, kinematics=self.kinematics
                )
                before = out[max(k - 1, 0)]
                others = np.concatenate(
                    [self.space.clip(q[k : k + 1]), _carried(self.space, before, smooth[k], problem)]
                )
                out[k] = _stood(problem, smooth[k], others)
        return out

    def _wanted(self, t: Array, q: Array) -> list[list[_Wanted]]:
        """What every instant asks for; the instants around a stance's ends belong to it."""
        c = self.kinematics.at(q)
        out: list[list[_Wanted]] = [[] for _ in t]
        for name in dict.fromkeys(place.frame for place in self.places):
            f, mine = c.frame(name), [place.widened(t) for place in self.places if place.frame == name]
            quat = rotations.from_matrix(f.R)
            shares = np.array([place.share(t, self.ease) for place in mine])
            for k in np.flatnonzero(shares.max(axis=0) > 0.0):
                place, share = mine[int(shares[:, k].argmax())], float(shares[:, k].max())
                turn = rotations.log(rotations.multiply(rotations.conjugate(quat[k]), place.quat))
                turned = rotations.multiply(quat[k], rotations.exp(share * turn))
                out[k].append(_Wanted(name, f.p[k] + share * (place.p - f.p[k]), turned, share >= 1.0))
        return out

    def drift(self, motion: Clip, t: Array, place: _Place) -> _Drift:
        """How far the curve through instants t (n,) is from a place, at and between them."""
        fine = np.unique(np.concatenate([t, np.linspace(t[0], t[-1], _BETWEEN * (len(t) - 1) + 1)]))
        times = np.concatenate([[place.start], fine[(fine > place.start) & (fine < place.end)], [place.end]])
        p = self.kinematics.frame(place.frame).pose(motion.evaluate(times).q)[:, :3, 3]
        return _Drift(place, times, np.asarray(np.linalg.norm(p - place.p, axis=1)))


def _row(wanted: Sequence[_Wanted], q: Array) -> list[Goal]:
    """Goals of an instant: places of locked frames; wishes: places on the way, orientations, the motion q."""
    out: list[Goal] = [Posture(q, weight=1.0)]
    for w in wanted:
        out.append(Position(w.frame, w.p, weight=None if w.locked else _EASED))
        out.append(Orientation(w.frame, w.quat, weight=_TURNED))
    return out


def _stood(problem: Problem, q: Array, others: Array) -> Array:
    """q (nq,) changed least until frames are at their places, or as near as can be, also from other starts
    (n, nq)."""
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
    return np.asarray(x[0])


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
