"""Where the numbers of a problem are in the arguments of its compiled iteration."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compile.graph import Node, Scalar
from ..space import Ball
from .rows import aims

if TYPE_CHECKING:
    from ..problem import Problem

Array = NDArray[np.float64]
_FAR = 1e300  # stands for infinity


class Layout(NamedTuple):
    """Where the numbers of a problem are in the arguments of its compiled iteration.

    Arguments are: aims, weights and inverse tolerances of live rows, bands, limits, then for the way along
    the goals aims, weights and bands of wishes, s, whether to go along at all (1 or 0), and q0.
    """

    aims: int
    moved: NDArray[np.intp]  # freedoms
    live: NDArray[np.intp]  # rows that count
    banded: NDArray[np.intp]  # rows with room
    scalars: NDArray[np.intp]  # freedoms of moved hinges and slides with limits
    balls: tuple[Ball, ...]  # moved balls with limits
    soft_aims: int
    soft: NDArray[np.intp]  # wished rows that count
    soft_banded: NDArray[np.intp]
    along: bool
    nq: int

    @property
    def size(self) -> int:
        """Number of arguments."""
        down = self.aims + 2 * len(self.live) + len(self.banded) + 2 * len(self.scalars) + len(self.balls)
        rest = self.soft_aims + len(self.soft) + len(self.soft_banded) + 2 + self.nq
        return down + (rest if self.along else 0)

    @property
    def steps(self) -> int:
        """Number of freedoms on the way along the goals."""
        return len(self.moved) if self.along else 0

    @property
    def holds(self) -> int:
        """Number of limits that can hold."""
        return len(self.scalars) + len(self.balls) + len(self.banded)


def layout(problem: Problem) -> Layout:
    """The layout of a problem; all problems of one structure share it."""
    model, space, wished = problem.model, problem.space, problem.wished
    limited = model.jnt_limited[model.dof_jntid].astype(bool)
    scalars = [v for v in space.scalar_v if problem.moved[v] and limited[v]]
    balls = tuple(b for b in space.balls if problem.moved[b.v] and limited[b.v])
    live, banded = _counting(problem)
    free = np.flatnonzero(problem.moved)
    along = len(live) <= len(free)
    none = np.zeros(0, dtype=int)
    soft, soft_banded = (none, none) if wished is None or not along else _counting(wished)
    return Layout(
        len(aims(problem)), free, live, banded, np.array(scalars, dtype=int), balls,
        0 if wished is None or not along else len(aims(wished)), soft, soft_banded, along, space.nq,
    )  # fmt: skip


def _counting(problem: Problem) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows that count, and among them those with room."""
    live = np.flatnonzero(np.isfinite(problem.tolerance))
    return live, live[problem.band[live] > 0]


def arguments(problem: Problem, at: Layout, *, q0: Array | None = None, s: float = 1.0) -> Array:
    """The numbers to go down to a problem's goals, or along them to its wishes and, by s, to q0 (nq,)."""
    live, space, wished = at.live, problem.space, problem.wished
    now = {b.v: b.limit for b in space.balls}
    parts = [
        aims(problem), problem.weight[live], np.where(problem.judged, 1.0 / problem.tolerance, 0.0)[live],
        problem.band[at.banded], space.low[at.scalars], space.high[at.scalars],
        np.array([now[b.v] for b in at.balls]),
    ]  # fmt: skip
    if at.along:
        off = q0 is None
        if wished is not None:
            parts += [aims(wished), wished.weight[at.soft] * (not off), wished.band[at.soft_banded]]
        parts += [np.array([s, 0.0 if off else 1.0]), problem.model.qpos0 if q0 is None else q0]
    return np.asarray(np.clip(np.concatenate(parts), -_FAR, _FAR))


class Weights(NamedTuple):
    """Weights of rows, and room of those that have some, by row."""

    weight: dict[int, Node]
    band: dict[int, Node]


class Split(NamedTuple):
    """Arguments as symbols, by row or by freedom."""

    aims: Sequence[Node]
    hard: Weights
    share: dict[int, Node]
    low: dict[int, Node]
    high: dict[int, Node]
    limit: dict[int, Node]
    soft_aims: Sequence[Node]
    soft: Weights
    s: Scalar
    pull: Scalar
    q0: Sequence[Node]


def split(at: Layout, a: Sequence[Node]) -> Split:
    """The arguments as they lie."""
    rest = iter(a)

    def next_few(n: int) -> list[Node]:
        return [next(rest) for _ in range(n)]

    def taken(keys: Sequence[int] | NDArray[np.intp]) -> dict[int, Node]:
        return {int(k): next(rest) for k in keys}

    goal, weight, share, band = next_few(at.aims), taken(at.live), taken(at.live), taken(at.banded)
    low, high, limit = taken(at.scalars), taken(at.scalars), taken([b.v for b in at.balls])
    if not at.along:
        return Split(goal, Weights(weight, band), share, low, high, limit, [], Weights({}, {}), 1.0, 0.0, [])
    soft_aims, soft = next_few(at.soft_aims), Weights(taken(at.soft), taken(at.soft_banded))
    s, pull = next_few(2)
    return Split(goal, Weights(weight, band), share, low, high, limit, soft_aims, soft, s, pull,
                  next_few(at.nq))  # fmt: skip
