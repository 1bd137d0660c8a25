"""How near and how far two frames of a tree can be: bounds that prove that goals cannot be met.

Between the anchors of consecutive turning joints a path has hops: vectors fixed in a link, up to the travel
of slides. Their lengths bound the distance of the ends, as in a polygon: [max(0, 2 max l - sum l), sum l].
A hinge's anchor may stand anywhere on its axis; every choice gives a bound. When all axes are parallel, the
height along them does not change and the polygon lies in a plane, where the bounds are attained. Two hops
with a hinge between them may count as one side, whose length its range bounds (law of cosines).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ... import rotations
from ...kinds import FREE, HINGE, SLIDE
from ...kinematics import Frame
from ..space import Space

Array = NDArray[np.float64]


class Travel(NamedTuple):
    """A slide within a hop: it adds s axis, low <= s <= high."""

    axis: Array
    low: float
    high: float


@dataclass(frozen=True)
class Hop:
    """Vector between two anchors in the link's frame: `vector` (3,) plus `travels`.

    `start`, `end`: directions of the hinges' axes at its ends in that frame, None for a ball or an end.
    """

    vector: Array
    travels: tuple[Travel, ...] = ()
    start: Array | None = None
    end: Array | None = None

    def lengths(self, shift: float = 0.0, shift_end: float = 0.0) -> tuple[float, float]:
        """Least and greatest length, the anchors shifted along their axes."""
        v = self.vector
        v = v if self.start is None else v - shift * self.start
        v = v if self.end is None else v + shift_end * self.end
        return _extremes(v, self.travels)


def _extremes(v: Array, travels: tuple[Travel, ...]) -> tuple[float, float]:
    """Least and greatest length of v plus travels: at a corner, and by bounded least squares."""
    if not travels:
        length = float(np.linalg.norm(v))
        return length, length
    ranges = [(t.low, t.high) for t in travels]
    if not np.isfinite(ranges).all():
        high = np.inf
    else:
        high = max(
            float(np.linalg.norm(v + sum(s * t.axis for s, t in zip(corner, travels, strict=True))))
            for corner in product(*ranges)
        )
    from scipy.optimize import lsq_linear

    A, bounds = np.column_stack([t.axis for t in travels]), np.array(ranges).T
    bounds[1] = np.maximum(bounds[1], bounds[0] + 1e-12)
    return float(np.sqrt(2 * lsq_linear(A, -v, bounds, tol=1e-14).cost)) * (1 - 1e-9), high


class Turn(NamedTuple):
    """A turning joint between two hops: kind, its frame R (3, 3) in the link before it in the tree, the range
    of its angle, and whether the path runs outward over it."""

    kind: int
    R: Array
    low: float
    high: float
    outward: bool = True


class Path(NamedTuple):
    """Hops from one frame to another and the joints between them."""

    hops: tuple[Hop, ...]
    turns: tuple[Turn, ...]


class Reach(NamedTuple):
    """Bounds on the distance of two points [m]."""

    low: float
    high: float

    def gap(self, distance: float) -> float:
        """How far a distance is outside the bounds [m]."""
        return max(0.0, self.low - distance, distance - self.high)


def placed(X: Array, nq: int, nv: int) -> Frame:
    """A frame fixed in the world at pose X (4, 4)."""
    return Frame("site", "world", nq, nv, (), X)


def at_point(p: Array, nq: int, nv: int) -> Frame:
    """A frame fixed in the world at a point, with the world's axes."""
    X = np.eye(4)
    X[:3, 3] = p
    return placed(X, nq, nv)


def offset(f: Frame, p: Array) -> Frame:
    """The frame at `p` in f."""
    X = np.eye(4)
    X[:3, 3] = p
    return replace(f, X_end=f.X_end @ X)


def path(a: Frame, b: Frame, space: Space, moved: NDArray[np.bool_], q: Array) -> Path | None:
    """The hops from `a` to `b`; joints outside `moved` stand as in q. None when a free joint is between."""
    shared = 0
    for i, j in zip(a.joints, b.joints, strict=False):
        if i.q != j.q:
            break
        shared += 1
    half_a, half_b = (hops_of(f, f.joints[shared:], space, moved, q) for f in (a, b))
    if half_a is None or half_b is None:
        return None
    (first_a, rest_a, turns_a), (first_b, rest_b, turns_b) = half_a, half_b
    back = tuple(Travel(-t.axis, t.low, t.high) for t in first_a.travels)
    middle = Hop(first_b.vector - first_a.vector, back + first_b.travels, first_a.end, first_b.end)
    turned = [
        Hop(-h.vector, tuple(Travel(-t.axis, t.low, t.high) for t in h.travels), h.end, h.start)
        for h in reversed(rest_a)
    ]
    inward = [t._replace(outward=False) for t in reversed(turns_a)]
    return Path((*turned, middle, *rest_b), (*inward, *turns_b))


def hops_of(
    f: Frame, joints: tuple[Any, ...], space: Space, moved: NDArray[np.bool_], q: Array
) -> tuple[Hop, list[Hop], list[Turn]] | None:
    """First hop to `f` from the common frame's origin, the others, and the turning joints between; None
    with a free joint."""
    hops: list[Hop] = []
    turns: list[Turn] = []
    T, travels, start = np.eye(4), [], None
    for joint in joints:
        kind = int(joint.type)
        if not moved[joint.v]:
            T = stood(T, joint, q)
            continue
        T = T @ joint.X
        if kind == FREE:
            return None
        if kind == SLIDE:
            travels.append(
                Travel(T[:3, 2], space.low[joint.v] - joint.rest, space.high[joint.v] - joint.rest)
            )
        else:
            end = T[:3, 2] if kind == HINGE else None
            hops.append(Hop(T[:3, 3].copy(), tuple(travels), start, end))
            low, high = (space.low[joint.v], space.high[joint.v]) if kind == HINGE else (-np.inf, np.inf)
            turns.append(Turn(kind, T[:3, :3].copy(), low - joint.rest, high - joint.rest))
            T, travels, start = np.eye(4), [], np.array([0.0, 0.0, 1.0]) if kind == HINGE else None
    hops.append(Hop((T @ f.X_end)[:3, 3], tuple(travels), start, None))
    return hops[0], hops[1:], turns


def stood(T: Array, joint: Any, q: Array) -> Array:
    """Pose (4, 4) behind a joint that stands at q (nq,), from the pose before it; a free joint's is in q."""
    X = np.eye(4)
    kind = int(joint.type)
    if kind == SLIDE:
        X[2, 3] = q[joint.q] - joint.rest
    elif kind == HINGE:
        X[:3, :3] = rotations.to_matrix(rotations.exp(np.array([0.0, 0.0, q[joint.q] - joint.rest])))
    else:
        at = joint.q + (3 if kind == FREE else 0)
        X[:3, :3] = rotations.to_matrix(rotations.normalize(q[at : at + 4]))
        if kind == FREE:
            X[:3, 3] = q[joint.q : joint.q + 3]
            return X
    return np.asarray(T @ joint.X @ X)


def reach(p: Path) -> Reach:
    """Bounds on the distance of the path's ends."""
    flat = planar(p)
    if flat is not None:
        height, polygon = flat
        low = np.hypot(height.low, polygon.low)
        return Reach(float(low), float(np.hypot(height.high, polygon.high)))
    return _tightest(p, [h.lengths() for h in p.hops], [_shortest(p)], flat=False)


def _tightest(
    p: Path, lengths: list[tuple[float, float]], others: list[list[tuple[float, float]]], *, flat: bool
) -> Reach:
    """The best of the polygons whose sides are hops, or pairs of hops with the hinge between them."""
    sides = [lengths, *others, *(_merged(p, lengths, first, flat) for first in (0, 1))]
    bounds = [_polygon(side) for side in sides]
    return Reach(max(b.low for b in bounds), min(b.high for b in bounds))


def _merged(p: Path, lengths: list[tuple[float, float]], first: int, flat: bool) -> list[tuple[float, float]]:
    """Sides with hops 2i + first and the next one taken together over their hinge, within its range."""
    out, i = list(lengths[:first]), first
    while i < len(lengths):
        pair = p.hops[i : i + 2]
        if len(pair) == 2 and p.turns[i].kind == HINGE and not pair[0].travels and not pair[1].travels:
            out.append(_across(pair[0].vector, pair[1].vector, p.turns[i], flat))
            i += 2
        else:
            out.append(lengths[i])
            i += 1
    return out


def _across(one: Array, two: Array, turn: Turn, flat: bool) -> tuple[float, float]:
    """Least and greatest |u + Rz(th) w| over a hinge's range, u and w before and after it in its frame."""
    u, w = (one, two) if turn.outward else (-two, -one)
    u = turn.R.T @ u
    if flat:
        u, w = u * [1.0, 1.0, 0.0], w * [1.0, 1.0, 0.0]
    a, b = u[0] * w[0] + u[1] * w[1], u[1] * w[0] - u[0] * w[1]
    base = float(u @ u + w @ w + 2 * u[2] * w[2])
    peak = float(np.arctan2(b, a))
    size = 2 * float(np.hypot(a, b))
    if turn.high - turn.low >= 2 * np.pi:
        values = [base - size, base + size]
    else:
        turns = [peak + np.pi * k for k in range(-6, 7)]
        angles = [turn.low, turn.high, *(t for t in turns if turn.low <= t <= turn.high)]
        values = [base + size * float(np.cos(t - peak)) for t in angles]
    return float(np.sqrt(max(0.0, min(values)))), float(np.sqrt(max(0.0, *values)))


def _polygon(lengths: list[tuple[float, float]]) -> Reach:
    """Bounds on the distance of the ends of a chain of sides with lengths in ranges."""
    total = sum(high for _, high in lengths)
    low = max(0.0, max(a - (total - b) for a, b in lengths)) if np.isfinite(total) else _open_low(lengths)
    return Reach(low, total)


def _open_low(lengths: list[tuple[float, float]]) -> float:
    """Least distance when some side may be endlessly long: only that side itself can still keep it away."""
    endless = [i for i, (_, b) in enumerate(lengths) if not np.isfinite(b)]
    if len(endless) > 1:
        return 0.0
    a, _ = lengths[endless[0]]
    return max(0.0, a - sum(b for i, (_, b) in enumerate(lengths) if i != endless[0]))


def _shortest(p: Path) -> list[tuple[float, float]]:
    """Lengths of the hops with the hinges' anchors where the whole is shortest (a convex problem)."""
    hinges = [i for i, turn in enumerate(p.turns) if turn.kind == HINGE]
    if not hinges or any(not np.isfinite([t.low, t.high]).all() for h in p.hops for t in h.travels):
        return [h.lengths() for h in p.hops]
    from scipy.optimize import minimize

    def lengths(s: Array) -> list[tuple[float, float]]:
        at = dict(zip(hinges, s, strict=True))
        return [h.lengths(at.get(i - 1, 0.0), at.get(i, 0.0)) for i, h in enumerate(p.hops)]

    found = minimize(lambda s: sum(high for _, high in lengths(s)), np.zeros(len(hinges)), method="Powell")
    return lengths(np.atleast_1d(found.x))


class Range(NamedTuple):
    """Bounds on the size of a component [m]."""

    low: float
    high: float


def planar(p: Path) -> tuple[Range, Reach] | None:
    """Height of the end over the start along the common axis, and distance across it; None if not planar."""
    if not p.turns or any(turn.kind != HINGE for turn in p.turns):
        return None
    for i, hop in enumerate(p.hops):
        if 0 < i < len(p.hops) - 1 and not _parallel(hop.start, hop.end):
            return None
    heights, lengths = [0.0, 0.0], []
    sign = 1.0
    for hop in p.hops:
        n = hop.start if hop.start is not None else hop.end
        assert n is not None
        if any(not (_parallel(t.axis, n) or abs(float(t.axis @ n)) < 1e-12) for t in hop.travels):
            return None
        up = sign * float(hop.vector @ n)
        along = [sorted((sign * float(t.axis @ n) * t.low, sign * float(t.axis @ n) * t.high))
                 for t in hop.travels if _parallel(t.axis, n)]  # fmt: skip
        heights[0] += up + sum(a for a, _ in along)
        heights[1] += up + sum(b for _, b in along)
        across = tuple(t for t in hop.travels if not _parallel(t.axis, n))
        lengths.append(_extremes(hop.vector - float(hop.vector @ n) * n, across))
        if hop.start is not None and hop.end is not None and float(hop.start @ hop.end) < 0:
            sign = -sign
    low = max(0.0, heights[0], -heights[1])
    return Range(low, max(abs(heights[0]), abs(heights[1]))), _tightest(p, lengths, [], flat=True)


def _parallel(a: Array | None, b: Array | None) -> bool:
    return a is not None and b is not None and float(np.linalg.norm(np.cross(a, b))) < 1e-10


def turning_gap(p_axes: Array | None, free_ball: bool, R: Array, quat: Array) -> float:
    """Least angle [rad] between `quat` and what a frame at R (3, 3) reaches by turning about one direction.

    `p_axes` (3,) is that direction in the world, None for a frame that does not turn.
    """
    if free_ball:
        return 0.0
    R_T = rotations.to_matrix(quat)
    if p_axes is None:
        return float(np.linalg.norm(rotations.log(rotations.from_matrix(R_T.T @ R))))
    kept, wanted = R.T @ p_axes, R_T.T @ p_axes  # the direction seen from the frame never changes
    return float(np.arctan2(np.linalg.norm(np.cross(kept, wanted)), kept @ wanted))
