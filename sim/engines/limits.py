"""Joint limits as one-sided bounds, for engines that locate the moment when a joint meets one."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from .interface import Array, Problem, Role

_MOST = 10  # impacts at one moment that throw joints back; another stops them

STILL = 1e-3
"""Speed [rad/s, m/s] that no rebound is slower than: a joint that would leave its limit more slowly stays."""


def in_words(restitution: float) -> str:
    """What limits do to the joints that meet them."""
    if not restitution:
        return "hard stops (restitution 0)"
    slow = f"stops where these would be slower than {STILL:g} rad/s or m/s"
    return f"rebounds with restitution {restitution:g}, and {slow}"


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


def complementary(W: Array, b: Array) -> Array:
    """x >= 0 with W x + b >= 0 and x (W x + b) = 0, W symmetric and positive definite: the smallest
    x W x / 2 + b x."""
    from scipy.optimize import nnls

    if not len(b):
        return np.zeros(0)
    L = np.linalg.cholesky(W)
    return np.asarray(nnls(L.T, -np.linalg.solve(L, b))[0])


def rebound(W: Array, u: Array, restitution: float) -> tuple[Array, Array]:
    """Impulses of an impact of joints that come with velocities `u` away from their limits, and theirs after.

    Impulses p >= 0 give u+ = u + W p, W = J M^-1 J', with W p + (1 + e) u >= 0 and p (W p + (1 + e) u) = 0
    (Newton's restitution e): the kinetic energy changes by (1 - e) p u / 2 <= 0. Where that throws one joint
    at another's limit, another impact follows.
    """
    u, impulse = u.copy(), np.zeros(len(u))
    for again in range(_MOST + 1):
        closing = -float(u.min(initial=0.0))
        if again and closing <= 1e-12 * (1.0 + np.abs(u).max()):
            break
        e = restitution if restitution * closing > STILL and again < _MOST else 0.0
        p = complementary(W, (1.0 + e) * u)
        impulse += p
        u = np.where(p > 0.0, -e * u, u + W @ p)  # the one where the other would be it to rounding
    return impulse, u


def slack(force: Array) -> Array:
    """What a limit may pull before it lets go [N, N m]: more than rounding, so that it does so once."""
    return np.asarray(1e-9 * (1.0 + np.abs(force)))


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

    def suspect(self, q: Array, v: Array, step: float) -> NDArray[np.bool_]:
        """Whether each limit (n, limits) is passed, or may be, in the n steps between states q (n + 1, nq).

        It may when the joint came nearer at the step's start, goes away at its end, and is near enough.
        """
        _, _, side = self._arrays
        gap, closing = self.gaps(q), side * v[:, [limit.dof for limit in self.each]]
        turned = (closing[:-1] > 0) & (closing[1:] < 0)
        near = np.minimum(gap[:-1], gap[1:]) < step * (closing[:-1] - closing[1:])
        return np.asarray((gap[1:] < 0) | (turned & near))

    def _far(self, q: Array, v: Array, step: float) -> bool:
        """Whether no limit can be suspect: all are farther than any joint comes in a step and back."""
        least, speed = np.minimum.reduce(self.gaps(q), None), np.maximum.reduce(np.abs(v), None)
        return bool(least > 2.0 * step * speed)

    def near(
        self, q0: Array, v0: Array, q1: Array, v1: Array, step: float, resting: tuple[Limit, ...]
    ) -> list[Limit]:
        """Limits that a step from (q0, v0) to (q1, v1) passes or may pass, those of joints at rest aside."""
        if not self.each:
            return []
        still = {limit.joint for limit in resting}
        found = np.flatnonzero(self.suspect(np.stack([q0, q1]), np.stack([v0, v1]), step)[0])
        return [self.each[i] for i in found if self.each[i].joint not in still]

    def doubtful(
        self, q: Array, v: Array, step: float, resting: tuple[Limit, ...]
    ) -> NDArray[np.bool_] | None:
        """Whether each of n steps between states q (n + 1, nq) passes a limit, or may; None if none does."""
        if not self.each or self._far(q, v, step):
            return None
        found = self.suspect(q, v, step)
        still = {limit.joint for limit in resting}
        found[:, [i for i, limit in enumerate(self.each) if limit.joint in still]] = False
        return np.asarray(found.any(axis=1))


def limits_of(problem: Problem) -> Limits:
    """Limits that are part of the scene's physics, of joints that are not keyed."""
    from ..dynamics.support import limited_joints

    m = problem.model
    out: list[Limit] = []
    for j in limited_joints(m, keyed=np.flatnonzero(problem.roles == Role.KEYED).tolist()):
        at = int(m.jnt_qposadr[j]), int(m.jnt_dofadr[j])
        low, high = (float(x) for x in m.jnt_range[j])
        out += [Limit(j, *at, low, -1), Limit(j, *at, high, 1)]
    return Limits(tuple(out))
