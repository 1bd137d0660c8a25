"""Restarts: seeded random starts of damped least squares, until one meets the goals or none is left."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from itertools import product

import numpy as np
from numpy.typing import NDArray

from ..chains.solver import racer_of
from ..goals import Pose, Position
from ..problem import Problem
from .descend import LONGEST, Descent, descend

Array = NDArray[np.float64]
AT_LIMIT = 1e-6  # [rad or m] beyond a limit: clipped, it may still be right
_FAR = 10.0  # [lengths of the problem] that bounded steps may not come
_FEW = 4  # joints whose ranges are looked at end by end
_BLOCKS = (6, 24, 64)  # starts side by side, growing while nothing is found


class Search:
    """One search over starts: what it found, what came nearest, and what it cost.

    Starts follow from `seed` alone: several numbers name a search of a part of the question.

    Attributes:
        used, iterations: random starts and iterations so far; never more starts than `restarts`.
        ends: costs of all attempts that failed; brought: of the best of them after `nearest.brought`.
        direct: whether a closed form, or the start itself, led to a solution, and not far away.
        hopeless: asked once after the first starts; if it says so, few more are tried, for the nearest pose.
    """

    def __init__(
        self,
        problem: Problem,
        start: Array,
        *,
        restarts: int,
        seed: tuple[int, ...],
        hopeless: Callable[[], bool] | None = None,
    ):
        self.problem, self.start, self.restarts, self.hopeless = problem, start, restarts, hopeless
        self.used = self.iterations = 0
        self.direct = False
        self.ends: list[float] = []
        self.brought: list[float] = []
        self._seed, self._asked = seed, restarts
        self._all: list[Descent] = []

    def part(self, problem: Problem, restarts: int, number: int) -> Search:
        """A search of a part of the question, by `number`, with no more restarts than this one was given."""
        restarts = min(restarts, self._asked)
        return Search(problem, self.start, restarts=restarts, seed=(*self._seed, number))

    def solutions(self, first: Array) -> Array:
        """Configurations (k, nq) that meet the problem: from `first` (k, nq), the start, then random starts.

        All that were found, so possibly many alike; none (0, nq) when all restarts failed.
        """
        space = self.problem.space
        found = [np.zeros((0, space.nq))]
        inside = first[space.excess(first).max(axis=1, initial=0.0) <= AT_LIMIT]
        if len(inside):
            found.append(self._attempt(inside, iterations=12))
            self.direct = len(found[-1]) > 0
        if not len(found[-1]):
            starts = np.stack([self.start, self._carried()])
            found.append(self._attempt(starts, iterations=40, first=True))
            end = self._all[-1]
            self.direct = bool(end.met[0]) and self._near(end.q[:1])
        blocks = iter(_BLOCKS)
        size = next(blocks)
        if (
            not len(found[-1]) and self.restarts
        ):  # a few starts cost less than to ask whether more are in vain
            n, size = min(size, self.restarts), next(blocks)
            found.append(self._attempt(self._random(n), first=True))
        if not len(found[-1]):
            if self.hopeless is not None and self.hopeless():
                self.restarts = min(self.restarts, sum(_BLOCKS[:2]))
            else:
                found.append(self._raced())
        while self.used < self.restarts and not sum(map(len, found)):
            n = min(size, self.restarts - self.used)
            found.append(self._attempt(self._random(n), first=True))
            size = next(blocks, size)
        return np.concatenate(found)

    def _carried(self) -> Array:
        """Mid-range, with floating bodies carried to where their first goal of a place is, if that is far."""
        q = self.problem.space.middle(self.start, self.problem.moved)
        for k, v in self.problem.space.shifts:
            for goal in self.problem.goals if self.problem.moved[v] else ():
                if isinstance(goal, (Position, Pose)) and goal.relative_to is None:
                    frame = self.problem.kinematics.frame(goal.at)
                    place = np.asarray(goal.target if isinstance(goal, Position) else goal.position)
                    way = place - frame.pose(q)[:3, 3]
                    if v in frame.dofs and np.linalg.norm(way) > _FAR * self.problem.scale:
                        q[k : k + 3] += way
                        break
        return q

    def _near(self, q: Array) -> bool:
        """Whether q (1, nq) is no further from the start than a linear model reaches."""
        return bool(np.abs(self.problem.space.difference(q, self.start)).max(initial=0.0) <= LONGEST)

    def more(self, n: int) -> Array:
        """Further solutions (k, nq), from the start, mid-range and n random starts, or what is left."""
        n = max(0, min(n, self.restarts - self.used))
        middle = self.problem.space.middle(self.start, self.problem.moved)
        return self._attempt(np.concatenate([self.start[None], middle[None], self._random(n)]))

    def spread(self) -> Array:
        """Solutions (k, nq) from ends and middles of few joints' ranges, where nearest poses often are."""
        space, moved = self.problem.space, self.problem.moved
        columns = np.flatnonzero(moved & np.isfinite(space.low) & np.isfinite(space.high))
        scalar = columns[np.isin(columns, space.scalar_v)]
        if not 0 < len(scalar) <= _FEW:
            return np.zeros((0, space.nq))
        low, high = space.low[scalar], space.high[scalar]
        levels = [(low[k], 0.5 * (low[k] + high[k]), high[k]) for k in range(len(scalar))]
        q = np.tile(self.start, (3 ** len(scalar), 1))
        q[:, space.q_of_v[scalar]] = list(product(*levels))
        return self._attempt(q)

    def _random(self, n: int) -> Array:
        self.used += n
        return self.problem.space.random(self.rng, n, self.start, self.problem.moved)

    def _raced(self) -> Array:
        """A solution by a compiled search, where the goal is a pose of one chain."""
        racer = racer_of(self.problem, self.start)
        if racer is None:
            return np.zeros((0, self.problem.space.nq))
        n = max(0, self.restarts - sum(_BLOCKS[:2]))  # the rest go all the way, for the nearest pose
        middle = self.problem.space.middle(self.start, self.problem.moved)
        starts = self.problem.space.random(self.rng, n, self.start, self.problem.moved)
        found = racer(np.concatenate([self.start[None], middle[None], starts]))
        self.used += max(0, found.starts - 2)
        self.iterations += found.iterations
        return self._attempt(found.q, iterations=12) if len(found.q) else found.q

    def _attempt(self, q: Array, *, first: bool = False, iterations: int = 100) -> Array:
        end = descend(self.problem, q, first=first, iterations=iterations)
        self.iterations += end.iterations
        self.ends += end.cost[~end.met].tolist()
        self._all.append(end)
        return end.q[end.met]

    @property
    def best(self) -> Descent:
        """The nearest ends so far, nearest first (at most 12)."""
        if len(self._all) > 1:
            q, r, cost, met = (np.concatenate([end[k] for end in self._all]) for k in (0, 1, 2, 4))
            self._all = [Descent(q, r, cost, 0, met)]
        end = self._all[0]
        order = np.argsort(end.cost, kind="stable")[:12]
        self._all = [Descent(end.q[order], end.r[order], end.cost[order], 0, end.met[order])]
        return self._all[0]

    @cached_property
    def rng(self) -> np.random.Generator:
        """Where random starts come from."""
        return np.random.default_rng(self._seed)

    def agreed(self) -> int:
        """How many failed attempts, or the best of them brought to their ends, came equally near."""
        return max(_alike(self.ends), _alike(self.brought))


def _alike(costs: list[float]) -> int:
    """How many are the least, within 0.1 %."""
    return int(np.sum(np.array(costs) <= min(costs) * 1.001 + 1e-15)) if costs else 0
