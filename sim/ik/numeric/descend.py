"""Damped least squares over a batch of configurations inside their limits, and Newton's method at its end."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..chains.machine import Prepared
from ..goals import Rows
from ..problem import Problem

Array = NDArray[np.float64]
LONGEST = 1.0  # [rad, or the model's length]: a step further than this leaves the linear model
_STALL = 8  # iterations without progress that end an attempt
_PROGRESS = 0.99
_SHARP = 1e-12  # weighted residuals below this are met to rounding


class Descent(NamedTuple):
    """Where a batch ended: q (n, nq), residuals r (n, m) without weights, cost (n,), iterations, met (n,)."""

    q: Array
    r: Array
    cost: Array
    iterations: int
    met: NDArray[np.bool_]


def descend(problem: Problem, q: Array, *, iterations: int = 100, first: bool = False) -> Descent:
    """Levenberg-Marquardt from every row of `q` (n, nq), freedoms at their limits held while pushed outward.

    The damping follows the cost (Fan & Yuan 2005: local convergence stays fast where the Jacobian loses
    rank). Stops when all rows have met their goals or stalled; with `first`, as soon as one has met them.
    The same in machine code where the problem has some.
    """
    quick, q = problem.prepared(build=True), problem.space.clip(q)
    if quick is not None:
        return _compiled(problem, quick, q, iterations, first)
    return _descend(problem, q, iterations, first)


def _compiled(problem: Problem, quick: Prepared, q: Array, iterations: int, first: bool) -> Descent:
    ends = quick.machine.descend(q, quick.a, iterations=iterations, first=first)
    r = problem.raw(ends.q).r
    met = problem.met(r)
    if first and met.any():  # what would have met the goals when the quickest did
        met &= ends.iterations <= ends.iterations[met].min()
    return Descent(ends.q, r, ends.cost, int(ends.iterations.max(initial=0)), met)


def _descend(problem: Problem, q: Array, iterations: int, first: bool) -> Descent:
    space, n = problem.space, len(q)
    raw = problem.raw(q)
    w = problem.weighted(raw)
    cost = _square(w.r)
    r = raw.r
    damping, stall = np.full(n, 1e-2), np.zeros(n, dtype=int)
    live = ~_settled(problem, r, cost)
    done = 0
    while done < iterations and live.any() and not (first and problem.met(r).any()):
        k = np.flatnonzero(live)
        d = _steps(problem, q[k], Rows(w.r[k], w.J[k]), damping[k] * np.minimum(cost[k], 1.0) + 1e-15)
        trial = space.step(q[k], d)
        raw_k = problem.raw(trial)
        w_k = problem.weighted(raw_k)
        cost_k = _square(w_k.r)
        better = cost_k < cost[k]
        progress = cost_k < _PROGRESS * cost[k]
        b = k[better]
        q[b], r[b], cost[b], w.r[b], w.J[b] = (
            trial[better], raw_k.r[better], cost_k[better], w_k.r[better], w_k.J[better],
        )  # fmt: skip
        damping[k] = np.clip(damping[k] * np.where(better, 0.2, 6.0), 1e-12, 1e12)
        stall[k] = np.where(progress, 0, stall[k] + 1)
        live[k] = (stall[k] < _STALL) & ~_settled(problem, r[k], cost[k])
        done += 1
    return Descent(q, r, cost, done, problem.met(r))


def _settled(problem: Problem, r: Array, cost: Array) -> NDArray[np.bool_]:
    """Judged rows met far below their tolerance and nothing wished left to gain: no step is worth taking."""
    tight = (np.abs(r) <= 1e-3 * problem.tolerance) | ~problem.judged
    return np.asarray((tight.all(axis=1) & (cost < 1e-18)) | (cost < 1e-26))


def _square(r: Array) -> Array:
    return np.asarray(np.sum(r * r, axis=1))


def held_projection(problem: Problem, q: Array, g: Array, J: Array) -> tuple[Array, NDArray[np.bool_]]:
    """J (n, m, nv) without what limits hold, and the mask (n, nv) of freedoms that are not held."""
    mask, blocked = problem.space.free_directions(q, g)
    mask = mask & problem.moved
    J = J * mask[:, None, :]
    for ball, axis in blocked:
        part = J[:, :, ball.v : ball.v + 3]
        J[:, :, ball.v : ball.v + 3] = part - (part @ axis[:, :, None]) * axis[:, None, :]
    return J, mask


def _steps(problem: Problem, q: Array, w: Rows, damping: Array) -> Array:
    """Damped Gauss-Newton steps (n, nv), through the smaller of J^T J and J J^T."""
    g = (w.r[:, None, :] @ w.J)[:, 0]
    J, _ = held_projection(problem, q, g, w.J)
    columns = np.flatnonzero(problem.moved)
    J = J[:, :, columns]
    n, m, nv = J.shape
    d = np.zeros((n, problem.space.nv))
    JT = J.transpose(0, 2, 1)
    if m <= nv:
        A = J @ JT + damping[:, None, None] * np.eye(m)
        d[:, columns] = -(JT @ solved(A, w.r[:, :, None]))[:, :, 0]
    else:
        A = JT @ J + damping[:, None, None] * np.eye(nv)
        d[:, columns] = -solved(A, JT @ w.r[:, :, None])[:, :, 0]
    longest = np.abs(d).max(axis=1, initial=0.0)
    return np.asarray(d * np.minimum(1.0, LONGEST / np.maximum(longest, 1e-300))[:, None])


def solved(A: Array, b: Array) -> Array:
    """A^-1 b for semidefinite A (..., k, k), a little more than that where rounding leaves it singular."""
    try:
        return np.asarray(np.linalg.solve(A, b))
    except np.linalg.LinAlgError:
        more = 1e-12 * np.trace(A, axis1=-2, axis2=-1)[..., None, None] + 1e-300
        return np.asarray(np.linalg.solve(A + more * np.eye(A.shape[-1]), b))


def tighten(problem: Problem, q: Array, *, steps: int = 4) -> Array:
    """q (nq,) after undamped Gauss-Newton steps of least norm, while these bring judged rows nearer."""
    x, columns = q[None], np.flatnonzero(problem.moved)
    w = problem.weighted(problem.raw(x))
    for _ in range(steps if len(columns) else 0):
        if np.abs(w.r).max(initial=0.0) < _SHARP:
            break
        J, _ = held_projection(problem, x, np.zeros((1, problem.space.nv)), w.J)
        d = np.zeros(problem.space.nv)
        d[columns] = -np.linalg.lstsq(J[0][:, columns], w.r[0], rcond=1e-9)[0]
        trial = problem.space.step(x, d[None])
        w_trial = problem.weighted(problem.raw(trial))
        if not np.abs(w_trial.r).max(initial=0.0) < np.abs(w.r).max(initial=0.0):
            break
        x, w = trial, w_trial
    return np.asarray(x[0])
