"""A keyed path by a length of its own: where it stops, where it turns back, its derivatives in between.

By a length p a point moves at q' r with r = dp/dt and accelerates with q' dr/dt + q'' r^2. Jerk is finite
only while q' and q'' are continuous: where either jumps, r must be zero, and, since r has its least value
there, dr/dt as well. Where a path goes back the way it came q' changes sign, and r passes zero with the
acceleration as it is.

That p is the length of the path: where keys ease in or out, their slowness is no property of the path. But
where joints turn at nearly the same time the path is a hairpin, which is smooth in the time of the keys and
not in its length: there p goes on with the time of the keys.
"""

from __future__ import annotations

from collections.abc import Iterable
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from ....models import dof_names
from ....sim.clip import Clip, Motion
from ..check import knots

Array = NDArray[np.float64]
_INSIDE = 1e-5  # of a piece: where the direction of a path that rests at its end is looked at
TURN = 1e-3  # change of direction that is a corner
_BACK = 1e-5  # and that is none where a path goes back the way it came
_BEND = 1e-5  # change of curvature that is a jump, relative to the largest beside it

_REST = 1e-6  # part of the largest speed, or acceleration, that is none
_SHARP = 0.03  # part of the time around it that a turn takes which is a hairpin


class Corner(NamedTuple):
    """A time s [s] of a clip at which its path rests, or has to: with ``back`` for a moment on its way back,
    else without acceleration. ``why`` tells what makes it stop; empty where the keys rest as well."""

    s: float
    back: bool
    why: str


class Measure(NamedTuple):
    """What p is: dp/ds = sqrt(|dq/ds|^2 + sum b_k^2), b_k a bump of ``height`` (k,) [1/s] that ends ``width``
    (k,) [s] before and after the ``hairpins`` (k,) [s]. ``edges`` are times [s] that nodes are put at."""

    edges: Array
    hairpins: Array
    width: Array
    height: Array

    def rate(self, at: Motion, s: Array) -> tuple[Array, Array]:
        """dp/ds and d2p/ds2 (n, 1) where the clip moves as ``at`` at times s (n,)."""
        y = np.clip((s[:, None] - self.hairpins) / self.width, -1.0, 1.0)
        b = self.height * (1.0 - y**2) ** 4
        slope = -8.0 * self.height * y * (1.0 - y**2) ** 3 / self.width
        square = np.sum(at.v**2, axis=1) + np.sum(b**2, axis=1)
        rate = np.maximum(np.sqrt(square), 1e-150)
        bend = (np.sum(at.v * at.a, axis=1) + np.sum(b * slope, axis=1)) / rate
        return rate[:, None], bend[:, None]

    def by(self, at: Motion, s: Array) -> Motion:
        """q, dq/dp, d2q/dp2 from motion by time of the clip."""
        rate, bend = self.rate(at, s)
        way = at.v / rate
        across = at.a - way * bend
        rounding = 1e-13 * np.abs(at.a).max(axis=1, keepdims=True)
        return Motion(at.q, way, np.where(np.abs(across) > rounding, across, 0.0) / rate**2)


class Path(NamedTuple):
    """A path by p, on n pieces from ``s`` (n + 1,) of the clip: lengths (n,), and motion by p (q, q', q'') at
    the beginning and the end of each, with q''' (n, nv) there."""

    s: Array
    length: Array
    begin: Motion
    end: Motion
    third: tuple[Array, Array]
    rate: Array  # (n + 1,): dp/ds
    back: NDArray[np.bool_]  # (n + 1,): nodes where the path turns back


def corners(
    clip: Clip, jerky: NDArray[np.bool_], still: list[tuple[float, float]], *, keep: bool
) -> list[Corner]:
    """All corners between the ends of a clip whose freedoms ``jerky`` (nv,) have a limit on jerk; ``still``
    are the times between which nothing moves. With ``keep`` the rests of the keys are stops as well."""
    breaks = clip.breaks_between(clip.start, clip.end)
    at = np.union1d(breaks, _rests(clip, slowest(clip)))
    for a, b in still:
        at = at[(at < a) | (at > b)]
    edges = np.unique([t for ends in still for t in ends if clip.start < t < clip.end])
    out = [Corner(float(t), False, "") for t in edges]
    if len(at):
        out += _judged(clip, jerky, at, np.union1d(edges, [clip.start, clip.end]), keep)
    return sorted(out)


def _judged(clip: Clip, jerky: NDArray[np.bool_], at: Array, ends: Array, keep: bool) -> list[Corner]:
    """The corners among times ``at`` (n,)."""
    every = np.union1d(at, ends)
    gaps, where = np.diff(every), np.searchsorted(every, at)
    left, right = clip.evaluate(at, left=True), clip.evaluate(at)
    exact = [by_length(left), by_length(right)]
    whole = clip.evaluate(np.linspace(clip.start, clip.end, 501))
    slow = _REST * np.abs(whole.v).max()
    rests = np.minimum(np.abs(left.v).max(axis=1), np.abs(right.v).max(axis=1)) <= slow
    eased = np.maximum(np.abs(left.a), np.abs(right.a)).max(axis=1) <= 1e-3 * np.abs(whole.a).max()
    broken = np.isin(at, clip.breaks_between(clip.start, clip.end))
    # the slower, the less is left of directions' digits
    reach = np.where(rests, 1e2, 1.0) * _INSIDE * np.minimum(gaps[where - 1], gaps[where])
    near, far = ([by_length(clip.evaluate(at + k * reach)) for k in (-d, d)] for d in (1.0, 30.0))
    names, out = dof_names(clip.model), []
    for i, s in enumerate(at):
        before, after = (side.v[i] for side in near)
        bends = [side.a[i] for side in (near if rests[i] else exact)]
        least = max(1.0, *(float(np.abs(side.a[i]).max()) for side in far))
        hairpin = max(float(np.abs(side.a[i]).max()) for side in near) > 5.0 * least
        jump = np.abs(bends[1] - bends[0]) > (1e-2 if rests[i] else _BEND) * (1.0 + np.abs(bends).max())
        turn = np.abs(after - before) > TURN
        if np.abs(after + before).max() <= _BACK and not hairpin:
            out.append(Corner(float(s), True, ""))
        elif rests[i] and (broken[i] or eased[i]):
            if turn.any() or hairpin or (jump & jerky).any() or keep:
                out.append(Corner(float(s), False, ""))
        elif turn.any() and broken[i]:
            out.append(Corner(float(s), False, corner(n for n, d in zip(names, turn, strict=True) if d)))
        elif (jump & jerky).any() and broken[i]:
            who = [n for n, j in zip(names, jump & jerky, strict=True) if j]
            out.append(Corner(float(s), False, f"the curvature of {_listed(who)} jumps"))
    return out


def corner(who: Iterable[str]) -> str:
    """Why a path stops at a corner that the joints ``who`` make."""
    return f"a corner of {_listed(list(who))}"


def _listed(names: list[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")


def slowest(clip: Clip) -> Array:
    """Times between breaks at which the keyed motion is slowest for a moment."""
    edges = np.concatenate([[clip.start], clip.breaks_between(clip.start, clip.end), [clip.end]])
    found = [np.zeros(0)]
    for a, b in pairwise(edges):
        s = np.linspace(a, b, max(12, int(4000 * (b - a) / (clip.end - clip.start))) + 1)[1:-1]
        at = clip.evaluate(s)
        gain = np.sum(at.v * at.a, axis=1)
        k = np.flatnonzero((gain[:-1] <= 0) & (gain[1:] >= 0))
        found.append(_zeros(clip, s[k], s[k + 1]))
    return np.unique(np.concatenate(found))


def _zeros(clip: Clip, low: Array, high: Array) -> Array:
    """Where v . a changes its sign between times (n,), by halving."""
    for _ in range(52 if len(low) else 0):
        middle = 0.5 * (low + high)
        at = clip.evaluate(middle)
        below = np.sum(at.v * at.a, axis=1) < 0
        low, high = np.where(below, middle, low), np.where(below, high, middle)
    return high


def reversals(clip: Clip, dofs: NDArray[np.bool_]) -> Array:
    """Times at which one of the freedoms ``dofs`` (nv,) turns back, where its friction does."""
    edges = np.concatenate([[clip.start], clip.breaks_between(clip.start, clip.end), [clip.end]])
    found = [np.zeros(0)]
    for a, b in pairwise(edges) if dofs.any() else ():
        s = np.linspace(a, b, max(12, int(4000 * (b - a) / (clip.end - clip.start))) + 1)[1:-1]
        v = clip.evaluate(s).v
        for dof in np.flatnonzero(dofs):
            for k in np.flatnonzero(v[:-1, dof] * v[1:, dof] < 0):
                zero = brentq(lambda x, i=dof: clip.evaluate(x).v[i], s[k], s[k + 1], xtol=1e-15)
                found.append(np.array([zero]))
    return np.unique(np.concatenate(found))


def uneven(clip: Clip, still: list[tuple[float, float]], *, keep: bool) -> bool:
    """Whether the keys rest or change their speed at once on a way that goes on, or ease into a rest more
    than a parabola would: the time of the keys is then no measure of the path."""
    at = knots(clip)
    left, right = clip.evaluate(at, left=True), clip.evaluate(at)
    slow, gentle = (_REST * np.abs(right.v).max(), 1e-3 * np.abs(right.a).max())
    rests = np.maximum(np.abs(left.v), np.abs(right.v)).max(axis=1) <= slow
    moves = np.ones(len(at), dtype=bool)
    for a, b in still:
        moves &= (at < a) | (at > b)
    inner = moves & (at > clip.start) & (at < clip.end)
    through = at[inner & (rests | (np.abs(right.v - left.v).max(axis=1) > slow))]
    eased = rests & moves & (np.minimum(np.abs(left.a).max(axis=1), np.abs(right.a).max(axis=1)) <= gentle)
    eased[0] = rests[0] and moves[0] and np.abs(right.a[0]).max() <= gentle
    eased[-1] = rests[-1] and moves[-1] and np.abs(left.a[-1]).max() <= gentle
    if eased.any() or not len(through):
        return bool(eased.any())
    stops = [c.s for c in corners(clip, np.zeros(clip.model.nv, dtype=bool), still, keep=keep)]
    return not np.isin(through, stops).all()


def _rests(clip: Clip, slowest: Array) -> Array:
    """Times at which everything rests: knots, where that is eased into, and what lies between."""
    span = clip.end - clip.start
    top = np.abs(clip.evaluate(np.linspace(clip.start, clip.end, 501)).v).max()

    def still(s: Array) -> Array:
        s = s[(s > clip.start + 1e-9 * span) & (s < clip.end - 1e-9 * span)]
        return np.asarray(s[np.abs(clip.evaluate(s).v).max(axis=1, initial=0.0) <= _REST * top])

    at, other = still(knots(clip)), still(slowest)
    near = np.min(np.abs(other[:, None] - at), axis=1, initial=np.inf)
    return np.union1d(at, other[near > 1e-3 * span])


def stretches(
    clip: Clip, corners: list[Corner], still: list[tuple[float, float]]
) -> list[tuple[float, float, bool]]:
    """(begin, end, moves) of what is between stops."""
    edges = np.unique([clip.start, clip.end, *(c.s for c in corners if not c.back)])
    return [
        (float(a), float(b), not any(x <= 0.5 * (a + b) <= y for x, y in still)) for a, b in pairwise(edges)
    ]


def measure(clip: Clip, start: float, stop: float, found: list[Corner], slowest: Array) -> Measure:
    """The p of a stretch from ``start`` to ``stop`` [s] with the corners ``found`` and the times at which the
    clip is :func:`slowest`."""
    s, known = slowest, np.unique([start, stop, *(c.s for c in found), *_rests(clip, slowest)])
    inner = known[(known >= start) & (known <= stop)]
    s = s[(s > start) & (s < stop)]
    room = np.min(np.abs(s[:, None] - inner), axis=1)
    at = clip.evaluate(s)
    v, a = np.linalg.norm(at.v, axis=1), np.linalg.norm(at.a, axis=1)
    width = np.minimum(0.8 * room, 0.2 * (stop - start))
    sharp = (v <= _SHARP * a * width) & (room > 1e-3 * (stop - start))
    return Measure(inner, s[sharp], width[sharp], 0.3 * (a * width)[sharp])


def even_nodes(clip: Clip, by: Measure, points: int) -> Array:
    """Times of a stretch, as even by p as by time, its edges and the clip's knots among them.

    Slow parts of keyed motion are often where it turns.
    """
    start, stop = float(by.edges[0]), float(by.edges[-1])
    inner = knots(clip)
    fixed = _apart(np.union1d(by.edges, inner[(inner > start) & (inner < stop)]))
    s = np.union1d(np.linspace(start, stop, 20 * points + 1), fixed)
    p = np.append(0.0, np.cumsum(_lengths(clip, by, s)))
    even = p / p[-1] + (s - start) / (stop - start)
    parts = [
        np.linspace(a, b, max(3, round(0.5 * points * (b - a))) + 1)[1:-1]
        for a, b in pairwise(np.interp(fixed, s, even))
    ]
    nodes = _apart(np.union1d(np.interp(np.concatenate(parts), even, s), fixed))
    # the shorter a piece, the more rounding of positions is in its accelerations
    short = _lengths(clip, by, nodes) < 1e-5 * p[-1]
    last = np.isin(nodes, fixed)
    return np.asarray(nodes[last | ~(np.append(short, False) | np.append(False, short))])


def _apart(nodes: Array) -> Array:
    """Ascending times without those that are the same up to rounding."""
    return np.asarray(nodes[np.append(True, np.diff(nodes) > 1e-9 * (nodes[-1] - nodes[0]))])


def path(clip: Clip, by: Measure, nodes: Array, back: list[float]) -> Path:
    """A part of a clip by its length, over times ``nodes`` (n + 1,)."""
    first, last, h = nodes[:-1], nodes[1:], np.diff(nodes)
    rate = np.vstack(
        [
            by.rate(clip.evaluate(first), first)[0],
            by.rate(clip.evaluate(nodes[-1:], left=True), nodes[-1:])[0],
        ]
    )

    def side(s: Array, way: Array, left: bool) -> tuple[Motion, Array]:
        """Motion by p at nodes, and q''': where everything rests from nearby, the slower the farther."""
        now = clip.evaluate(s, left=left)
        moves = np.linalg.norm(now.v, axis=1, keepdims=True) > 1e-4 * rate.max()
        near = s + np.where(moves[:, 0], _INSIDE, 0.02) * way
        far = s + np.where(moves[:, 0], 0.01, 0.2) * way
        one, two = (by.by(clip.evaluate(x), x) for x in (near, far))
        third = (two.a - one.a) / _way(clip, by, near, far)
        return Motion(*(np.where(moves, a, b) for a, b in zip(by.by(now, s), one, strict=True))), third

    begin, third = side(first, h, False)
    end, last_third = side(last, -h, True)
    lengths = _lengths(clip, by, nodes)
    return Path(nodes, lengths, begin, end, (third, last_third), rate[:, 0], np.isin(nodes, back))


def by_length(at: Motion) -> Motion:
    """q, dq/dp, d2q/dp2 from motion by time of the clip, p the length of its path."""
    none = np.zeros(0)
    return Measure(none, none, none, none).by(at, np.zeros(len(at.v)))


def _way(clip: Clip, by: Measure, start: Array, stop: Array) -> Array:
    """Lengths (n, 1) of short ways."""
    middle = 0.5 * (start + stop)
    return np.asarray(by.rate(clip.evaluate(middle), middle)[0] * (stop - start)[:, None])


def _lengths(clip: Clip, by: Measure, s: Array) -> Array:
    """Lengths (n,) of the path between times s (n + 1,), by Gauss's rule of five points."""
    x, w = np.polynomial.legendre.leggauss(5)
    h = np.diff(s)
    at = (s[:-1, None] + 0.5 * h[:, None] * (x + 1.0)).ravel()
    return np.asarray(0.5 * h * (by.rate(clip.evaluate(at), at)[0].reshape(-1, 5) @ w))
