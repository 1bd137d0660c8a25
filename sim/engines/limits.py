"""Joint limits as one-sided bounds, for engines that locate the moment when a joint meets one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import mujoco
import numpy as np

from ..kinds import SCALAR
from .interface import Array, Problem, Role


@dataclass(frozen=True)
class Limit:
    """One side of a joint's range: the joint may not pass ``bound`` in the direction ``side`` (1 or -1)."""

    joint: int
    qpos: int
    dof: int
    bound: float
    side: int

    def gap(self, q: Array) -> float:
        """Distance [rad, m] left to the bound at state q (nq,)."""
        return float(self.side * (self.bound - q[self.qpos]))


@dataclass(frozen=True)
class Limits:
    """All limits of a run."""

    each: tuple[Limit, ...]

    @cached_property
    def _arrays(self) -> tuple[Array, Array, Array]:
        qpos = np.array([limit.qpos for limit in self.each], dtype=int)
        return qpos, np.array([x.bound for x in self.each]), np.array([x.side for x in self.each])

    def gaps(self, q: Array) -> Array:
        """Distances (n, limits) left at states q (n, nq)."""
        qpos, bound, side = self._arrays
        return np.asarray(side * (bound - q[:, qpos]))

    def passed(self, q: Array, resting: tuple[Limit, ...]) -> list[Limit]:
        """Limits that state q (nq,) has passed, those on which joints rest aside."""
        if not self.each:
            return []
        found = np.flatnonzero(self.gaps(q[None])[0] < 0)
        return [self.each[i] for i in found if self.each[i] not in resting]

    def first_passed(self, q: Array, resting: tuple[Limit, ...]) -> int | None:
        """Index of the first of states q (n, nq) that has passed a limit; None when none has."""
        if not self.each:
            return None
        beyond = self.gaps(q) < 0
        if resting:
            beyond[:, [self.each.index(limit) for limit in resting]] = False
        found = np.flatnonzero(beyond.any(axis=1))
        return int(found[0]) if len(found) else None


def limits_of(problem: Problem) -> Limits:
    """Limits that are part of the scene's physics, of joints that are not keyed."""
    m = problem.model
    off = int(mujoco.mjtDisableBit.mjDSBL_LIMIT) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    out: list[Limit] = []
    for j in range(0 if m.opt.disableflags & off else m.njnt):
        if m.jnt_limited[j] and int(m.jnt_type[j]) in SCALAR and problem.roles[j] != Role.KEYED:
            at = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
            low, high = (float(x) for x in m.jnt_range[j])
            out += [Limit(j, *at, low, -1), Limit(j, *at, high, 1)]
    return Limits(tuple(out))
