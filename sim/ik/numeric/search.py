"""Restarts: seeded random starts of damped least squares, until one meets the goals or none is left."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..chains.solver import racer_of
from ..problem import Problem
from .descend import Descent, descend

Array = NDArray[np.float64]
_BLOCKS = (6, 24, 64)  # starts side by side, growing while nothing is found
_MOST = 10_000  # iterations of a compiled search, each in all lanes: some thousand starts


class Search:
    """One search over starts: what it found, what came nearest, and what it cost.

    Attributes:
        used, iterations: random starts and iterations so far.
        ends: costs of all attempts that failed.
        hopeless: asked once after the first starts; if it says so, few more are tried, for the nearest pose.
    """

    def __init__(
        self,
        problem: Problem,
        start: Array,
        *,
        restarts: int,
        seed: int,
        hopeless: Callable[[], bool] | None = None,
    ):
        self.problem, self.start, self.restarts, self.hopeless = problem, start, restarts, hopeless
        self.used = self.iterations = 0
        self.ends: list[float] = []
        self._seed = seed
        self._all: list[Descent] = []

    def solutions(self, first: Array) -> Array:
        """Configurations (k, nq) that meet the problem: from `first` (k, nq), the start, then random starts.

        All that were found, so possibly many alike; none (0, nq) when all restarts failed.
        """
        space, moved = self.problem.space, self.problem.moved
        found = [np.zeros((0, space.nq))]
        inside = first[space.excess(first).max(axis=1, initial=0.0) <= 1e-9]
        if len(inside):
            found.append(self._attempt(inside, iterations=12))
        if not len(found[-1]):
            starts = np.stack([self.start, space.middle(self.start, moved)])
            found.append(self._attempt(starts, iterations=40, first=True))
        if not len(found[-1]):
            if self.hopeless is not None and self.hopeless():
                self.restarts = min(self.restarts, sum(_BLOCKS[:2]))
            else:
                found.append(self._raced())
        blocks = iter(_BLOCKS)
        size = next(blocks)
        while self.used < self.restarts and not sum(map(len, found)):
            n = min(size, self.restarts - self.used)
            found.append(self._attempt(self._random(n), first=True))
            size = next(blocks, size)
        return np.concatenate(found)

    def more(self, n: int) -> Array:
        """Further solutions (k, nq), from the start, mid-range and n random starts."""
        middle = self.problem.space.middle(self.start, self.problem.moved)
        return self._attempt(np.concatenate([self.start[None], middle[None], self._random(n)]))

    def _random(self, n: int) -> Array:
        self.used += n
        return self.problem.space.random(self.rng, n, self.start, self.problem.moved)

    def _raced(self) -> Array:
        """A solution by compiled searches, where the goal is a pose of one chain."""
        racer = racer_of(self.problem, self.start)
        if racer is None:
            return np.zeros((0, self.problem.space.nq))
        middle = self.problem.space.middle(self.start, self.problem.moved)
        q, spent = racer(np.stack([self.start, middle]), most=_MOST)
        self.iterations += spent
        return self._attempt(q, iterations=12) if len(q) else q

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
        """How many failed attempts ended as near as the nearest, within 0.1 %."""
        if not self.ends:
            return 0
        least = min(self.ends)
        return int(np.sum(np.array(self.ends) <= least * 1.001 + 1e-15))
