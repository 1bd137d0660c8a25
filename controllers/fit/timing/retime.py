"""The fastest, or the nearest, timing of a path that a machine can follow."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....models import dof_names
from ....sim.clip import Clip, FreeTrack, Motion, Track
from ....sim.curves import Curve
from ....sim.errors import PantographError
from ..check import Report, Trace, Violation, by_piece, check, follow, report
from ..ends import AtRest, resting
from ..machine import Machine
from .grid import Grid, even
from .path import Corner, uneven
from .smooth import smooth

Array = NDArray[np.float64]
_ROUNDS, _NEAR = 5, 1.003  # of cutting pieces, until limits hold to this between points
_POWERS = {"velocity": 1.0, "acceleration": 2.0, "jerk": 3.0}  # of the slowdown by which they fall
_ENOUGH = 1e-3  # part by which a motion may be slowed too much
_TIGHT = 5e-7  # part of a limit that may be exceeded


@dataclass(frozen=True, eq=False)
class RetimedCurve(Curve):
    """A curve c followed with another timing: c(s(t)), s a parabola on each piece between knots."""

    base: Curve
    s: Array
    rate: Array
    bend: Array

    @property
    def dof(self) -> int:
        """Degrees of freedom of the curve."""
        return self.base.dof

    def _piece(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array, Array]:
        rate, bend = self.rate[i] + self.bend[i] * s, self.bend[i]
        # rounding must not carry the end of a piece over a break of the curve below, nor onto its other side
        at = np.clip(self.s[i] + (self.rate[i] + 0.5 * self.bend[i] * s) * s, self.s[i], self.s[i + 1])
        q, v, a = self.base(at)
        late = self._ends_at_knots[i] & (at > 0.5 * (self.s[i] + self.s[i + 1]))
        if late.any():
            q[late], v[late], a[late] = self.base(at[late], left=True)
        return q, v * rate[:, None], v * bend[:, None] + a * (rate**2)[:, None]

    @cached_property
    def _ends_at_knots(self) -> NDArray[np.bool_]:
        """Pieces (n,) that end at a knot of the curve below, or near one."""
        knots, ends = self.base.knots, self.s[1:]
        after = np.searchsorted(knots, ends)
        near = [knots[np.clip(k, 0, len(knots) - 1)] for k in (after - 1, after)]
        apart = np.abs(near - ends).min(axis=0)
        return np.asarray(apart <= 1e-9 * (1.0 + np.abs(ends)))


class Stop(NamedTuple):
    """Where the machine has to stop on its way: time of the keys ``s`` [s], new time ``t``, and why."""

    s: float
    t: float
    why: str


@dataclass(frozen=True, eq=False)
class Retimed:
    """A clip with a possible timing, its ``duration`` [s], and the report on a grid ten times finer than the
    one it was computed on. ``t`` (n,) are the new times of the old times ``s`` (n,). ``stops``: where the
    path makes the machine stop, though the keys do not. ``slowed``: by how much the whole was slowed for what
    lies between the points of the grid."""

    clip: Clip
    duration: float
    report: Report
    s: Array
    t: Array
    stops: tuple[Stop, ...]
    slowed: float


def retime(
    clip: Clip, machine: Machine, *, keep: bool = False, points: int = 1000, at_rest: AtRest = True
) -> Retimed:
    """The timing of ``clip`` that is fastest, or with ``keep`` nearest to its own: nowhere faster than keyed,
    and as it is where that is possible.

    Limits of velocity, acceleration, force (with the motor's top speed, and dry friction) and current hold;
    the path, the time of the first key, and stretches where nothing moves stay as they are. It starts and
    ends ``at_rest``, or at the keyed speed or slower (False; None: where the keys do, see
    :func:`~..ends.resting`). It stops where the path has a corner, as linear keys have, and with a limit on
    jerk where its curvature jumps, as it does at the keys of curves that are not natural or clamped; the
    motion is then quintics through points of the path. Raises PantographError where the path itself is
    impossible (positions out of range, a pose that the drives cannot hold), for
    freedoms without a drive, and where no timing is found.
    """
    tree = machine.model.dof_treeid
    loose = np.flatnonzero(~machine.driven & np.isin(tree, tree[clip.dofs]))
    if len(loose):
        names = dof_names(machine.model)
        raise PantographError(
            f"retiming needs a drive at every joint of what moves, and nothing drives {names[loose[0]]!r}: "
            "fit the motion instead (--how fit)"
        )
    if not clip.end > clip.start:
        raise PantographError("there is nothing to retime: no joint has two keys")
    for name, track in clip.tracks.items():
        if isinstance(track, FreeTrack):
            raise PantographError(f"joint {name!r} is free: no machine moves it along keys; fit the motion")
    ends = resting(clip, at_rest)
    if keep and (same := check(clip, machine, points=10 * points, at_rest=ends)).possible:
        t = np.array([clip.start, clip.end])
        return Retimed(clip, clip.end - clip.start, same, t, t, (), 1.0)
    grid = Grid(clip, machine, even(clip, machine, points))
    x = grid.fastest(keep, ends)
    if np.isfinite(machine.jerk[clip.dofs]).any() or uneven(clip, grid.pauses(), keep=keep):
        at, s, corners = smooth(clip, machine, grid, x, keep=keep, ends=ends, points=points)
        return _slowed(at, s, corners, machine)
    for _ in range(_ROUNDS):
        at = _parabolas(grid, x)
        found = _slowed(at, grid.s, grid.corners(), machine)
        coarse = by_piece(machine, *at(1.0)) > _NEAR if found.slowed > _NEAR else np.zeros(0, dtype=bool)
        if not coarse.any() or len(grid.s) > 8 * points:
            break
        grid = Grid(clip, machine, np.union1d(grid.s, 0.5 * (grid.s[1:] + grid.s[:-1])[coarse]))
        x = grid.fastest(keep, ends)
    return found


def _parabolas(grid: Grid, x: Array) -> Callable[[float], tuple[Array, Clip]]:
    """Times and the clip of squared rates x (n + 1,), by how much it is slowed."""
    rate = np.sqrt(x)
    steps = 2.0 * grid.h / np.maximum(rate[:-1] + rate[1:], 1e-300)
    bend = 0.5 * np.diff(x) / grid.h

    def at(slow: float) -> tuple[Array, Clip]:
        t = grid.s[0] + np.concatenate([[0.0], np.cumsum(steps)]) * slow
        tracks: dict[str, Track] = {}
        for name, track in grid.clip.tracks.items():
            assert isinstance(track, Curve)
            times = np.interp(np.clip(track.times, grid.s[0], grid.s[-1]), grid.s, t)
            tracks[name] = RetimedCurve(
                times, track.values, t, "hold", "hold", track, grid.s, rate / slow, bend / slow**2
            )
        return t, Clip(grid.clip.model, tracks, grid.clip.q0)

    return at


def _slowed(
    at: Callable[[float], tuple[Array, Clip]], s: Array, corners: list[Corner], machine: Machine
) -> Retimed:
    """The clip ``at`` the least slowdown with which it holds on a grid ten times finer."""
    low, slow, high, exact = 1.0, 1.0, np.inf, False
    t, clip = at(1.0)
    trace = follow(clip, t, jerk=machine.asks_jerk)
    for _ in range(40):
        found = report(_at_pace(trace, slow), machine, keyed=clip.dofs)
        over = [v for v in found.violations if v.kind != "position"]
        if max((v.share for v in over), default=0.0) <= 1.0 + _TIGHT:
            if exact or slow <= low * (1.0 + _ENOUGH):
                break
            high, slow = slow, float(np.sqrt(low * slow))
            continue
        low = slow
        if not np.isfinite(over[0].share) or low > 100.0:
            raise PantographError(f"no timing was found that holds between points of the path: {over[0]}")
        exact = np.isinf(high) and all(v.kind in _POWERS for v in over)
        slow = slow * max(map(_slowdown, over)) if np.isinf(high) else float(np.sqrt(low * high))
        if high <= low * (1.0 + _ENOUGH):
            slow, exact = high, True
    out_of_range = [v for v in found.violations if v.kind == "position"]
    if out_of_range and out_of_range[0].value > 1e-9:
        raise PantographError(f"no timing helps: {out_of_range[0]}; change the keys, or fit the motion")
    t, clip = at(slow)
    stops = tuple(Stop(c.s, float(np.interp(c.s, s, t)), c.why) for c in corners if c.why)
    return Retimed(clip, float(t[-1] - t[0]), found, s, t, stops, slow)


def _at_pace(trace: Trace, slow: float) -> Trace:
    """The same motion, so many times as long."""
    (q, v, a), jerk = trace.motion, trace.jerk
    return Trace(trace.t * slow, Motion(q, v / slow, a / slow**2), None if jerk is None else jerk / slow**3)


def _slowdown(v: Violation) -> float:
    """By how much a motion is slowed that exceeds one limit: a force has a part that does not fall at all."""
    return float(v.share ** (1.0 / _POWERS[v.kind])) if v.kind in _POWERS else 1.0 + 2.0 * (v.share - 1.0)
