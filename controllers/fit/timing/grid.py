"""The limits of a machine along a path, and the fastest way through them: two passes over a grid.

Along a path q(s) with x = (ds/dt)^2 and u = d2s/dt2 constant on each piece of a grid, limits are linear in
(u, x): backwards over the grid goes the largest x from which the rest can still be done, forwards the largest
acceleration that stays below it (H. Pham, Q.-C. Pham, A new approach to time-optimal path parameterization,
IEEE Trans. Robotics 34, 2018). Limits hold at both ends of each piece; friction and the falling force of
motors, which go with sqrt(x), are bounded from above by their tangent at the last solution, so that each
round is feasible and faster than the one before.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....models import dof_names
from ....sim.clip import Clip, Motion
from ....sim.errors import PantographError
from ..check import rigid
from ..machine import Machine
from .path import TURN, Corner, Path, corner, reversals

Array = NDArray[np.float64]
_FLOOR = 1e-9  # x below this part of its bound counts as standing still when sqrt(x) is bounded


def even(clip: Clip, machine: Machine, points: int) -> Array:
    """Times of a clip, ``points`` even pieces, its breaks, and where joints with friction turn back."""
    breaks = clip.breaks_between(clip.start, clip.end)
    s = np.union1d(np.linspace(clip.start, clip.end, points + 1), breaks)
    s = np.union1d(s, reversals(clip, machine.rubs))
    return np.asarray(s[np.append(True, np.diff(s) > 1e-9 * (clip.end - clip.start))])


class _Lift(NamedTuple):
    """Joint forces push u + square x + drag sqrt(x) + weight (n, nv) along a path, dry friction of what moves
    in ``weight``; what friction may bear of them where a joint rests, ``held``."""

    push: Array
    square: Array
    drag: Array
    weight: Array
    held: Array


class Grid:
    """The path on a grid, with rows a u + b x + e sqrt(x) <= c of the limits at both ends of each piece.

    It is taken by the time of the keys at times s (n + 1,), or by the length of the path ``along`` them.
    """

    def __init__(self, clip: Clip, machine: Machine, s: Array, along: Path | None = None) -> None:
        self.clip, self.machine, self.s = clip, machine, s
        self.h, self.pace = np.diff(s), np.ones(len(s))
        begin, end = clip.evaluate(s[:-1]), clip.evaluate(s[1:], left=True)
        gap = np.abs(begin.q[1:] - end.q[:-1]).max(axis=1, initial=0.0) > 1e-9
        if gap.any():
            raise PantographError(f"no timing helps: the path jumps at {self.s[1:-1][gap][0]:.4g} s")
        if along is not None:
            begin, end, self.h, self.pace = along.begin, along.end, along.length, along.rate**2
        self.ends = (begin, end)
        # of the 2^n signs of forces whose sum a battery bounds few matter: those of the weight, and to these
        # come the ones that a solution has
        self.signs = np.zeros((0, clip.model.nv))
        if np.isfinite(machine.current):
            loaded = np.where(machine.ampere > 0, self._lift(begin, end).weight, 0.0)
            self.signs = np.unique(np.sign(loaded), axis=0)
        self._lay()
        speed = np.maximum(np.abs(begin.v), 1e-150)
        cap0 = np.min((machine.velocity / speed) ** 2, axis=1)
        cap1 = np.min((machine.velocity / np.maximum(np.abs(end.v), 1e-150)) ** 2, axis=1)
        self.cap = _neighbourly(np.minimum(np.append(cap0, np.inf), np.append(np.inf, cap1)))
        top = np.max(np.abs(np.vstack([begin.v, end.v])), initial=0.0)
        still = np.abs(begin.v).max(axis=1) + np.abs(end.v).max(axis=1) <= 1e-9 * top
        self.still = still
        resting = np.append(still, False) | np.append(False, still)
        self.cap = np.where(resting, np.minimum(self.cap, 1.0), np.minimum(self.cap, 1e8))
        # where the path has a corner, nothing but a stop goes round it
        self.turn = np.abs(begin.v[1:] - end.v[:-1])
        self.cornered = self.turn.max(axis=1, initial=0.0) > (1e-6 * top if along is None else TURN)
        self.cap[1:-1][self.cornered] = 0.0
        self.moving = (
            bool(np.any(np.abs(begin.v[0]) > 1e-9 * top)),
            bool(np.any(np.abs(end.v[-1]) > 1e-9 * top)),
        )

    def _lay(self) -> None:
        """Rows of all limits at both ends of each piece."""
        begin, end = self.ends
        rows0, rows1 = self.rows(begin, end), self.rows(end, begin)
        # at the end of a piece x has become x + 2 h u
        a1 = rows1[0] + 2.0 * self.h[:, None] * rows1[1]
        self.a, self.b, self.c, self.e = (
            np.concatenate(pair, axis=1)
            for pair in ((rows0[0], a1), (rows0[1], rows1[1]), (rows0[2], rows1[2]), (rows0[3], rows1[3]))
        )
        self.half = rows0[0].shape[1]
        self._ease(begin, end)
        self.curved = bool(np.any(self.e > 0))

    def _ease(self, begin: Motion, end: Motion) -> None:
        """Beside a rest that keys ease into x would rise without bound, and not in a straight line: on the
        piece beside it it does not fall (rise) away from there (towards it)."""
        top = [
            1e-6 * float(np.abs(np.vstack([b, e])).max(initial=0.0))
            for b, e in ((begin.v, end.v), (begin.a, end.a))
        ]
        for at, sign, k in ((begin, -1.0, 0), (end, 1.0, self.half)):
            rests = (np.abs(at.v).max(axis=1) <= top[0]) & (np.abs(at.a).max(axis=1) <= top[1])
            a = np.where(rests, sign, 0.0)[:, None]
            row = (a, np.zeros_like(a), np.where(rests, 0.0, 1.0)[:, None], np.zeros_like(a))
            for name, more in zip("abce", row, strict=True):
                old = getattr(self, name)
                setattr(self, name, np.insert(old, [k], more, axis=1))
            self.half += k == 0

    def pauses(self) -> list[tuple[float, float]]:
        """Times between which nothing moves."""
        edges = np.flatnonzero(np.diff(np.concatenate([[0], self.still.astype(int), [0]])))
        return [(float(self.s[a]), float(self.s[b])) for a, b in edges.reshape(-1, 2)]

    def corners(self) -> list[Corner]:
        """Where the path has a corner and does not rest as it is."""
        moves = ~(self.still[1:] | self.still[:-1]) & self.cornered
        names = dof_names(self.clip.model) if moves.any() else ()
        top = 1e-6 * float(self.turn.max(initial=0.0))
        return [
            Corner(
                float(self.s[k + 1]),
                False,
                corner(n for n, d in zip(names, self.turn[k], strict=True) if d > top),
            )
            for k in np.flatnonzero(moves)
        ]

    def rows(self, at: Motion, other: Motion) -> tuple[Array, Array, Array, Array]:
        """a, b, c, e (n, rows) of the limits at one end of pieces of the path, ``other`` their other end."""
        m = self.machine
        a: list[Array] = []
        b: list[Array] = []
        c: list[Array] = []
        e: list[Array] = []

        def add(ai: Array, bi: Array, ci: Array | float, ei: Array | float = 0.0) -> None:
            for into, value in ((a, ai), (b, bi), (c, ci), (e, ei)):
                into.append(np.broadcast_to(value, ai.shape))

        for dof in np.flatnonzero(np.isfinite(m.acceleration)):
            for sign in (1.0, -1.0):
                add(sign * at.v[:, dof], sign * at.a[:, dof], m.acceleration[dof])
        limited = np.isfinite(m.force_high - m.force_low)
        if limited.any() or np.isfinite(m.current):
            self._force_rows(at, other, limited, add)
        if not a:
            zero = np.zeros(len(at.v))
            add(zero, zero, 1.0)
        return tuple(np.stack(x, axis=1) for x in (a, b, c, e))  # type: ignore[return-value]

    def _lift(self, at: Motion, other: Motion) -> _Lift:
        """What forces are made of at one end of pieces, from four inverse dynamics; where a joint turns back
        friction is that of the piece."""
        machine, zero = self.machine, np.zeros_like(at.v)
        weight = rigid(Motion(at.q, zero, zero), machine)
        push = rigid(Motion(at.q, zero, at.v), machine) - weight
        forth = rigid(Motion(at.q, at.v, at.a), machine)
        back = rigid(Motion(at.q, -at.v, at.a), machine)
        way = at.v + other.v
        moves = np.abs(way) > 1e-9 * np.abs(at.v).max(initial=0.0)
        held = np.where(moves, 0.0, machine.friction)
        dry = np.where(moves, machine.friction * np.sign(way), 0.0)
        return _Lift(push, 0.5 * (forth + back) - weight, 0.5 * (forth - back), weight + dry, held)

    def _force_rows(  # type: ignore[no-untyped-def]
        self, at: Motion, other: Motion, limited: NDArray[np.bool_], add
    ) -> None:
        machine = self.machine
        push, square, drag, weight, held = self._lift(at, other)
        for dof in np.flatnonzero(limited):
            low, high, top = machine.force_low[dof], machine.force_high[dof], machine.top_speed[dof]
            beyond = np.maximum(weight[:, dof] - high, low - weight[:, dof]) - held[:, dof]
            if (beyond > 0).any():
                k = int(np.argmax(beyond))
                joint = machine.model.joint(int(machine.model.dof_jntid[dof])).name
                raise PantographError(
                    f"no timing helps: joint {joint!r} cannot hold the pose at {self.s[k]:.3f} s, "
                    f"{weight[k, dof]:.4g} N m or N against {high if weight[k, dof] > 0 else low:.4g}"
                    + (", dry friction counted" if machine.friction[dof] else "")
                )
            for sign, limit in ((1.0, high), (-1.0, -low)):
                # a motor loses force only in the direction it moves
                forth = sign * at.v[:, dof] > 0
                fall = np.where(forth, limit * np.abs(at.v[:, dof]) / top, 0.0)
                curve = np.maximum(sign * drag[:, dof] + fall, 0.0)
                room = limit + held[:, dof] - sign * weight[:, dof]
                add(sign * push[:, dof], sign * square[:, dof], room, curve)
        if np.isfinite(machine.current):
            for w in self.signs * machine.ampere:
                add(push @ w, square @ w, machine.current - weight @ w, np.maximum(drag @ w, 0.0))

    def _unseen(self, x: Array) -> Array:
        """Signs (k, nv) of forces with which x (n + 1,) draws more than the battery gives, without a row."""
        machine = self.machine
        u = (0.5 * np.diff(x) / self.h)[:, None]
        tau = []
        for k, y in enumerate((x[:-1, None], x[1:, None])):
            push, square, drag, weight, _ = self._lift(self.ends[k], self.ends[1 - k])
            tau.append(push * u + square * y + drag * np.sqrt(y) + weight)
        every = np.where(machine.ampere > 0, np.concatenate(tau), 0.0)
        over = every[np.abs(every) @ machine.ampere > machine.current * (1.0 + 1e-9)]
        new = np.unique(np.sign(over), axis=0)
        return new[[not (row == self.signs).all(axis=1).any() for row in new]]

    def fastest(self, keep: bool, at_rest: tuple[bool, bool]) -> Array:
        """The largest possible x (n + 1,) at the grid's times, with tangents of the last solution's roots."""
        while True:
            x = self._settled(keep, at_rest)
            new = self._unseen(x) if np.isfinite(self.machine.current) else np.zeros((0, 0))
            if not len(new):
                return x
            self.signs = np.vstack([self.signs, new])
            self._lay()

    def _settled(self, keep: bool, at_rest: tuple[bool, bool]) -> Array:
        x = self.solve(keep, at_rest)
        for _ in range(6 if self.curved else 0):
            better = self.solve(keep, at_rest, about=x)
            done = np.abs(better - x).max() <= 1e-4 * x.max()
            x = better
            if done:
                break
        return x

    def solve(self, keep: bool, at_rest: tuple[bool, bool], about: Array | None = None) -> Array:
        """The largest possible x (n + 1,) at the grid's times."""
        cap = np.minimum(self.cap, self.pace) if keep else self.cap.copy()
        b, c, a = self.b, self.c, self.a
        if self.curved:
            # e sqrt(x) <= e (sqrt(y) + (x - y) / (2 sqrt(y))): y the last solution, or where e alone is all
            y0, y1 = self._tangents(about, cap)
            y = np.concatenate(
                [np.repeat(y0[:, None], self.half, 1), np.repeat(y1[:, None], self.half, 1)], 1
            )
            slope = self.e / (2.0 * np.sqrt(y))
            b, c = b + slope, c - 0.5 * self.e * np.sqrt(y)
            a = a.copy()
            a[:, self.half :] += 2.0 * self.h[:, None] * slope[:, self.half :]
        first, last = (
            (0.0 if moving else cap[k]) if rest else min(self.pace[k], cap[k])
            for k, rest, moving in zip((0, -1), at_rest, self.moving, strict=True)
        )
        return _passes(a, b, c, self.h, cap, first, last, self.s)

    def _tangents(self, about: Array | None, cap: Array) -> tuple[Array, Array]:
        if about is not None:
            floor = _FLOOR * max(float(about.max()), 1e-300)
            y = np.maximum(about, floor)
            return y[:-1], y[1:]
        # first guess: where friction and the fall of force take half of what there is
        half = self.half
        with np.errstate(divide="ignore"):
            room = np.where(self.e > 0, 0.5 * self.c / np.maximum(self.e, 1e-300), np.inf) ** 2
        y0 = np.minimum(room[:, :half].min(axis=1), cap[:-1])
        y1 = np.minimum(room[:, half:].min(axis=1), cap[1:])
        top = max(float(np.max(np.minimum(y0, 1e6))), 1e-300)
        return np.clip(y0, _FLOOR * top, 1e6), np.clip(y1, _FLOOR * top, 1e6)


def _neighbourly(cap: Array) -> Array:
    """Bounds of x (n + 1,) that hold between nodes, too, where q' rises from nearly nothing.

    With q' straight from g to 1 on [0, 1] and x from k to 1, q' sqrt(x) has its largest value at 1 if
    k <= 3 - 2 g, and g is the root of the bounds' ratio. Where g is not small, smaller pieces do.
    """
    with np.errstate(invalid="ignore", divide="ignore"):
        slope = np.sqrt(cap[1:] / cap[:-1])
    fall = np.where(slope < 0.6, 3.0 - 2.0 * slope, np.inf)
    rise = np.where(slope > 1.0 / 0.6, 3.0 - 2.0 / slope, np.inf)
    out = cap.copy()
    for i in range(1, len(out)):
        out[i] = min(out[i], rise[i - 1] * out[i - 1])
    for i in range(len(out) - 2, -1, -1):
        out[i] = min(out[i], fall[i] * out[i + 1])
    return np.asarray(out)


def _passes(a: Array, b: Array, c: Array, h: Array, cap: Array, first: float, last: float, s: Array) -> Array:
    """Backward and forward pass over rows a u + b x <= c of each piece.

    Rows with a > 0 bound u from above by p + r x, those with a < 0 from below. Both passes are then chains
    x_i = min(own_i, min_k (slope_ik x_(i+-1) + offset_ik)), which is all that runs in sequence.
    """
    n = len(h)
    flat = np.abs(a) <= 1e-13 * np.maximum(np.abs(a).max(axis=1, keepdims=True), 1e-300)
    with np.errstate(divide="ignore", invalid="ignore"):
        alone = np.where(flat & (b > 0), c / np.where(b > 0, b, 1.0), np.inf).min(axis=1)
    p, r = c / np.where(flat, 1.0, a), -b / np.where(flat, 1.0, a)
    up, down = (a > 0) & ~flat, (a < 0) & ~flat
    half = (0.5 / h)[:, None]
    zero = np.zeros((n, 1))
    up_p, up_r = np.where(up, p, np.inf), np.where(up, r, 0.0)
    down_p = np.hstack([np.where(down, p, -np.inf), zero])  # the last: x must not fall below zero
    down_r = np.hstack([np.where(down, r, 0.0), -half])
    own = _own_bounds(up_p, up_r, down_p, down_r, np.minimum(cap[:-1], alone))
    # what x may be so that one of the lower bounds on u leads to the next x or below
    slope = half + down_r
    bound = np.isfinite(down_p) & (slope > 0)
    gain = np.where(bound, half / np.where(bound, slope, 1.0), 0.0)
    offset = np.where(
        bound, -np.where(np.isfinite(down_p), down_p, 0.0) / np.where(bound, slope, 1.0), np.inf
    )
    reach = np.empty(n + 1)
    reach[n] = x = min(last, cap[n])
    for i in range(n - 1, -1, -1):
        reach[i] = x = min(own[i], (gain[i] * x + offset[i]).min())
    lost = np.flatnonzero(reach < -1e-9 * max(1.0, float(reach.max())))
    if len(lost):
        raise PantographError(f"no timing helps: the path cannot be followed at {s[lost[-1]]:.4f} s")
    reach = np.maximum(reach, 0.0)
    gain, offset = 1.0 + 2.0 * h[:, None] * up_r, 2.0 * h[:, None] * up_p
    path = np.empty(n + 1)
    path[0] = x = min(first, reach[0])
    for i in range(n):
        path[i + 1] = x = max(min(reach[i + 1], (gain[i] * x + offset[i]).min()), 0.0)
    return path


def _own_bounds(up_p: Array, up_r: Array, down_p: Array, down_r: Array, x: Array) -> Array:
    """Largest x (n,) up to ``x`` at which the bounds on u leave any u, for every piece by itself.

    The gap between least upper and greatest lower line is concave in x: Newton's method from above.
    """
    x, rows = x.copy(), np.arange(len(x))
    for _ in range(100):
        upper, lower = up_p + up_r * x[:, None], down_p + down_r * x[:, None]
        j, k = upper.argmin(axis=1), lower.argmax(axis=1)
        gap = upper[rows, j] - lower[rows, k]
        slope = up_r[rows, j] - down_r[rows, k]
        narrow = gap < -1e-14 * np.maximum(np.abs(lower[rows, k]), 1.0)
        if not narrow.any():
            break
        new = np.where(slope < 0, x - gap / np.where(slope < 0, slope, 1.0), -1.0)
        step = narrow & (new < x)
        if not step.any():
            break
        x = np.where(step, new, x)
    return x
