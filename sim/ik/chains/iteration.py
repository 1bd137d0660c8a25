"""One iteration towards goals as an expression graph: down to them, or along them to what is wished.

    down:   d = -P J^T (J P J^T + lambda I)^-1 e,  lambda = mu min(e.e, 1) + least      (`numeric.descend`)
    along:  least |K d + k|^2 + s |d + w|^2 with J d = -e, so that for all rows together
            d = -P (w + B^T y),  (B P B^T + S) y = b - B P w,  B = [J; K], b = [e; k], S = [0; s I]
            (sequential quadratic programming with Gauss-Newton's Hessian, `numeric.settle`)

e, k are weighted residuals of goals to meet and of wishes, w the way from q0. The first is the second
without wishes and with w = 0, so that both are one program. P holds freedoms at their limits: those that
-J^T e pushes outward, or those named by `hold`, which also names rows at the edge of their room. With fewer
freedoms than rows the first comes from the freedoms' side, and there is no second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...compile.graph import Graph, Node, Scalar, absolute, clip, cos, less, maximum, minimum, sin, sqrt
from ...compile.tape import Tape
from .algebra import dot, log_quaternion, multiplied, scaled, solved, total
from .layout import Layout, Split, Weights, split
from .rows import Row, difference, problem_rows
from .seen import Scene

if TYPE_CHECKING:
    from ..problem import Problem

Array = NDArray[np.float64]
LONGEST = 1.0  # [rad, or the model's length]: a step further than this leaves the linear model
LEAST = 1e-15
_FIRM = 1e-13  # damping along the goals, where their rows depend on each other
_SHARES = 0.1, 8.0
_TINY = 1e-300  # stands for zero


def rows_tape(problem: Problem, at: Layout) -> tuple[Tape, list[tuple[int, int]]]:
    """Program (q, a) -> (r, J): all residuals without weights, and the entries of J listed beside it.

    Rows of wishes follow those of the problem, on the way along the goals.
    """
    graph = Graph()
    q, a = graph.inputs("q", problem.space.nq), graph.inputs("a", at.size)
    given = split(at, a)
    rows = problem_rows(Scene(problem, q), given.aims)
    if at.along and problem.wished is not None:
        rows += problem_rows(Scene(problem.wished, q), given.soft_aims)
    entries = [(i, v) for i, row in enumerate(rows) for v in row.J]
    values = [x for row in rows for x in row.J.values()]
    tape = Tape.build({"q": len(q), "a": at.size}, {"r": [row.r for row in rows], "J": values})
    return tape, entries


def iteration_tape(problem: Problem, at: Layout) -> Tape:
    """Program (q, mu, hold, past, before, a) -> (next, cost, worst, value, longest, held, now, step).

    next: q after the step d, or a share of it; cost, worst, value at q: e.e, the largest residual over its
    tolerance, k.k + s w.w; longest: entry of d. For the way along the goals what the next call wants: held,
    limits that hold from then on (scalars, balls, rows with room; 1 or 0), the share taken with d.d, and d.
    """
    graph, nq = Graph(), problem.space.nq
    q, mu, hold = graph.inputs("q", nq), graph.inputs("mu", 1), graph.inputs("hold", at.holds)
    past, before = graph.inputs("past", 2), graph.inputs("before", at.steps)
    given = split(at, graph.inputs("a", at.size))
    rows = problem_rows(Scene(problem, q), given.aims)
    worst: Scalar = 0.0
    for i, inverse in given.share.items():
        worst = maximum(worst, absolute(rows[i].r) * inverse)
    edges = dict(zip(map(int, at.banded), hold[at.holds - len(at.banded) :], strict=True))
    e, J = _weighted(rows, given.hard, edges, given.pull)
    cost = total(x * x for x in e)
    gradient = {v: total(x * row[v] for x, row in zip(e, J, strict=True) if v in row) for v in _columns(J)}
    way: dict[int, Scalar] = {}
    k: list[Scalar] = []
    K: list[dict[int, Scalar]] = []
    if at.along:
        far, _ = difference(problem.space, q, list(given.q0))
        way = {int(v): given.pull * far[v] for v in at.moved}
        if problem.wished is not None:
            k, K = _weighted(problem_rows(Scene(problem.wished, q), given.soft_aims), given.soft)
    holds = _Holds(problem, q, at, given, hold)
    raw = [*J, *K]
    B = holds.projected(raw, gradient)
    damping = (
        mu[0] * minimum(cost, 1.0)
        + LEAST
        + _FIRM * given.pull * (sqrt(given.s) if problem.wished is not None else 1.0)
    )
    held: list[Scalar] = [0.0] * at.holds
    if at.along or len(e) <= len(gradient):
        y = _multipliers([*e, *k], B, holds.project(way), [damping] * len(e) + [damping + given.s] * len(k))
        full = _along(holds.project(way), B, y)
        if at.along:
            held = holds.following(_along(way, raw, y)) + _edges(rows, given.hard, edges, y)
    else:
        full = _by_freedoms(e, B, list(gradient), damping)
    longest: Scalar = 0.0
    for x in full.values():
        longest = maximum(longest, absolute(x))
    d = [full[int(v)] for v in at.moved] if at.along else []
    short = _share(past, dot(d, before), given.pull) * minimum(1.0, LONGEST / maximum(longest, _TINY))
    following = moved(problem, q, given, {v: short * x for v, x in full.items()})
    value = total(x * x for x in k) + given.s * total(x * x for x in way.values())
    sizes = {"q": nq, "mu": 1, "hold": at.holds, "past": 2, "before": at.steps, "a": at.size}
    outputs = {"next": following, "cost": [cost], "worst": [worst], "value": [value], "longest": [longest],
               "held": held, "now": [short, dot(d, d)], "step": d}  # fmt: skip
    return Tape.build(sizes, outputs)


def _share(past: Sequence[Node], inner: Scalar, pull: Scalar) -> Scalar:
    """What to take of a step d on the way along the goals, from the last share and step d' and d.d'.

    Gauss-Newton's Hessian lacks the goals' curvature, so that its steps are too long or too short:
    share <- share d'.d' / d'.(d' - d)  (Barzilai & Borwein 1988).
    """
    share, square = past
    change = square - inner
    curved = less(1e-6 * square, change) * pull
    ratio = share * square / maximum(change, _TINY)
    return 1.0 + curved * (clip(ratio, *_SHARES) - 1.0)


def _weighted(
    rows: list[Row], given: Weights, edges: dict[int, Node] | None = None, pull: Scalar = 0.0
) -> tuple[list[Scalar], list[dict[int, Scalar]]]:
    """Residuals and Jacobian as the solver sees them (`Problem.weighted`).

    Rows with room count beyond it; on the way along the goals where `edges` says, and from the edge.
    """
    e: list[Scalar] = []
    J: list[dict[int, Scalar]] = []
    for i, w in given.weight.items():
        x: Scalar = rows[i].r
        live: Scalar = w
        if i in given.band:
            band, outside = given.band[i], less(given.band[i], absolute(x))
            beyond = x - minimum(maximum(x, -band), band)
            edge = pull * edges[i] if edges is not None and i in edges else 0.0
            x = (1.0 - pull) * beyond + edge * (x - _side(x) * band)
            live = w * ((1.0 - pull) * outside + edge)
        e.append(w * x)
        J.append({v: live * y for v, y in rows[i].J.items() if isinstance(y, Node) or y != 0.0})
    return e, J


def _side(r: Scalar) -> Scalar:
    return 1.0 - 2.0 * less(r, 0.0)


def _edges(rows: list[Row], given: Weights, edges: dict[int, Node], y: list[Scalar]) -> list[Scalar]:
    """Which rows are at the edge of their room from now on: those beyond it, and those pushed against it."""
    out: list[Scalar] = []
    for i, multiplier in zip(given.weight, y, strict=False):
        if i in edges:
            pushed = 1.0 - less(multiplier * _side(rows[i].r), 0.0)
            out.append(maximum(edges[i] * pushed, less(given.band[i], absolute(rows[i].r))))
    return out


def _columns(J: list[dict[int, Scalar]]) -> list[int]:
    return sorted({v for row in J for v in row})


class _Holds:
    """Limits that hold: going down those that the gradient pushes outward, going along the named ones."""

    def __init__(self, problem: Problem, q: Sequence[Node], at: Layout, given: Split, hold: Sequence[Node]):
        self.problem, self.q, self.at, self.given = problem, q, at, given
        self.named = dict(zip([*map(int, at.scalars), *(b.v for b in at.balls)], hold, strict=False))
        self.free: dict[int, Scalar] = {}
        self.axes: dict[int, list[Scalar]] = {}  # outward, of balls at their limits
        self.lost: dict[int, list[Scalar]] = {}  # the same, zero where nothing is held

    def projected(self, rows: list[dict[int, Scalar]], g: dict[int, Scalar]) -> list[dict[int, Scalar]]:
        """Rows of a Jacobian without what is held (`Space.free_directions`)."""
        pull = self.given.pull
        for v in map(int, self.at.scalars):
            x, slope = self.q[self.problem.space.q_of_v[v]], g.get(v, 0.0)
            low = (1.0 - less(self.given.low[v], x)) * less(0.0, slope)
            held = low + (1.0 - less(x, self.given.high[v])) * less(slope, 0.0)
            self.free[v] = 1.0 - (minimum(held, 1.0) * (1.0 - pull) + pull * self.named[v])
        for ball in self.at.balls:
            phi, _ = log_quaternion(self.q[ball.q : ball.q + 4])
            angle = sqrt(dot(phi, phi))
            axis = scaled(1.0 / maximum(angle, _TINY), phi)
            at_limit = 1.0 - less(angle, (1 - 1e-12) * self.given.limit[ball.v])
            self.axes[ball.v] = scaled(at_limit, axis)
            outward = less(dot(axis, [g.get(ball.v + k, 0.0) for k in range(3)]), 0.0)
            held = outward * (1.0 - pull) + pull * self.named[ball.v]
            self.lost[ball.v] = scaled(at_limit * held, axis)
        return [self.project(row) for row in rows]

    def project(self, row: dict[int, Scalar]) -> dict[int, Scalar]:
        """A row or a tangent without what is held."""
        out = {v: self.free[v] * x if v in self.free else x for v, x in row.items()}
        for first, axis in self.lost.items():
            three = [first + k for k in range(3)]
            if any(v in row for v in three):
                along = dot([out.get(v, 0.0) for v in three], axis)
                out |= {v: out.get(v, 0.0) - along * x for v, x in zip(three, axis, strict=True)}
        return out

    def following(self, wanted: dict[int, Scalar]) -> list[Scalar]:
        """Which limits hold from now on: those that the step, were nothing held, would cross."""
        out: list[Scalar] = []
        for v in map(int, self.at.scalars):
            x, d = self.q[self.problem.space.q_of_v[v]], wanted.get(v, 0.0)
            low = (1.0 - less(self.given.low[v], x)) * less(d, 0.0)
            out.append(low + (1.0 - less(x, self.given.high[v])) * less(0.0, d))
        for ball in self.at.balls:
            d3 = [wanted.get(ball.v + k, 0.0) for k in range(3)]
            out.append(less(0.0, dot(self.axes[ball.v], d3)))
        return out


def _multipliers(
    e: list[Scalar], B: list[dict[int, Scalar]], way: dict[int, Scalar], damping: list[Scalar]
) -> list[Scalar]:
    """y with (B B^T + damping) y = e - B w."""
    A = [
        [total(x * B[k][v] for v, x in row.items() if v in B[k]) for k in range(i + 1)]
        for i, row in enumerate(B)
    ]
    b = [x - total(y * way[v] for v, y in row.items() if v in way) for x, row in zip(e, B, strict=True)]
    return solved(A, damping, b)


def _along(way: dict[int, Scalar], B: list[dict[int, Scalar]], y: list[Scalar]) -> dict[int, Scalar]:
    """-(w + B^T y) by freedom."""
    return {
        v: -(way.get(v, 0.0) + total(row[v] * x for row, x in zip(B, y, strict=True) if v in row))
        for v in sorted({*_columns(B), *way})
    }


def _by_freedoms(
    e: list[Scalar], J: list[dict[int, Scalar]], columns: list[int], damping: Scalar
) -> dict[int, Scalar]:
    """-(J^T J + damping)^-1 J^T e by freedom."""
    A = [
        [total(row[v] * row[w] for row in J if v in row and w in row) for w in columns[: i + 1]]
        for i, v in enumerate(columns)
    ]
    b = [total(x * row[v] for x, row in zip(e, J, strict=True) if v in row) for v in columns]
    return {v: -x for v, x in zip(columns, solved(A, [damping] * len(b), b), strict=True)}


def moved(problem: Problem, q: Sequence[Node], given: Split, d: dict[int, Scalar]) -> list[Scalar]:
    """q after the step d, inside the limits (`Space.step`)."""
    space, out = problem.space, list[Scalar](q)
    for i, v in zip(space.scalar_q, space.scalar_v, strict=True):
        if v in d:
            x = q[i] + d[v]
            out[i] = clip(x, given.low[v], given.high[v]) if v in given.low else x
    for i, v in space.shifts:
        for k in range(3):
            out[i + k] = q[i + k] + d.get(v + k, 0.0)
    for ball in space.balls:
        if ball.v in d:
            phi = [d[ball.v + k] for k in range(3)]
            half = 0.5 * sqrt(dot(phi, phi))
            turn = [cos(half), *scaled(0.5 * sin(half) / maximum(half, _TINY), phi)]
            quat = multiplied(q[ball.q : ball.q + 4], turn)
            quat = scaled(1.0 / sqrt(dot(quat, quat)), quat)
            out[ball.q : ball.q + 4] = _inside(quat, given.limit.get(ball.v))
    return out


def _inside(quat: list[Scalar], limit: Node | None) -> list[Scalar]:
    """A unit quaternion turned back to `limit` [rad] when it is further."""
    if limit is None:
        return quat
    phi, _ = log_quaternion(quat)
    angle = sqrt(dot(phi, phi))
    half = 0.5 * minimum(limit, angle)
    back = [cos(half), *scaled(sin(half) / maximum(angle, _TINY), phi)]
    over = less(limit, angle)
    return [x + over * (y - x) for x, y in zip(quat, back, strict=True)]
