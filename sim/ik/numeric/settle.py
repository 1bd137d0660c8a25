"""Among configurations that meet the hard goals, the one that serves wishes and preferences best."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ... import rotations
from ..goals import Rows
from ..problem import Problem
from ..space import Space
from .descend import descend
from .qp import minimise

Array = NDArray[np.float64]
Wish = Callable[[Array], Rows]  # q (n, nq) -> weighted rows to make small


class Settled(NamedTuple):
    """Configuration (nq,), value of the wishes there, iterations."""

    q: Array
    value: float
    iterations: int


def settle(problem: Problem, q: Array, wish: Wish, *, iterations: int = 60) -> Settled:
    """Least squares of `wish` from q (nq,), which meets `problem`, along its self-motions inside the limits.

    Each step is a quadratic programme in the null space of the hard rows, followed by a return onto them;
    a step that does not help is cut (sequential quadratic programming on the constraint manifold).
    """
    x, cap, done = q[None], 0.5, 0
    rows = wish(x)
    value = float(np.sum(rows.r**2))
    for done in range(1, iterations + 1):  # noqa: B007
        step = _step(problem, x, rows, cap)
        if step is None or np.abs(step).max() < 1e-10:
            break
        trial = _returned(problem, problem.space.step(x, step[None]))
        lower = np.inf
        if trial is not None:
            rows_trial = wish(trial)
            lower = float(np.sum(rows_trial.r**2))
        if trial is None or lower >= value:
            cap = 0.25 * min(cap, float(np.abs(step).max()))
            if cap < 1e-9:
                break
            continue
        gain = value - lower
        x, rows, value, cap = trial, rows_trial, lower, min(2 * cap, 1.0)
        if gain < 1e-14 * max(value, 1e-12):
            break
    return Settled(x[0], value, done)


def _returned(problem: Problem, q: Array) -> Array | None:
    """Back onto the hard goals, or None."""
    if not problem.m:
        return q
    found = descend(problem, q, iterations=15)
    return found.q if found.met[0] else None


def _step(problem: Problem, x: Array, rows: Rows, cap: float) -> Array | None:
    """Step (nv,) of a quadratic model, at most `cap` a freedom, inside the limits and along the hard rows."""
    space, columns = problem.space, np.flatnonzero(problem.moved)
    hard = problem.weighted(problem.raw(x)).J[0][:, columns]
    Z = null_space(hard)
    if not Z.shape[1]:
        return None
    J = rows.J[0][:, columns] @ Z
    H = J.T @ J + 1e-9 * np.eye(Z.shape[1])
    A, b = limit_rows(space, x[0], cap)
    z = minimise(H, J.T @ rows.r[0], A[:, columns] @ Z, np.maximum(b, 0.0)).x
    d = np.zeros(space.nv)
    d[columns] = Z @ z
    return d


def null_space(J: Array) -> Array:
    """Orthonormal columns Z with J Z = 0, singular values below 1e-7 of the largest counted as zero."""
    if not J.size:
        return np.eye(J.shape[1])
    _, s, Vt = np.linalg.svd(J)
    rank = int(np.sum(s > 1e-7 * max(float(s[0]), 1e-9)))
    return np.asarray(Vt[rank:].T)


def limit_rows(space: Space, q: Array, cap: float | Array) -> tuple[Array, Array]:
    """A (k, nv), b (k,): A d <= b keeps a step d from q (nq,) inside the limits and below `cap`."""
    x = np.zeros(space.nv)
    x[space.scalar_v] = q[space.scalar_q]
    scalar = np.isin(np.arange(space.nv), space.scalar_v)
    high = np.where(scalar, np.minimum(space.high - x, cap), cap)
    low = np.where(scalar, np.minimum(x - space.low, cap), cap)
    A, b = [np.eye(space.nv), -np.eye(space.nv)], [high, low]
    for ball in space.balls:
        phi = rotations.log(q[ball.q : ball.q + 4])
        angle = float(np.linalg.norm(phi))
        if np.isfinite(ball.limit) and angle > 1e-9:
            row = np.zeros((1, space.nv))
            row[0, ball.v : ball.v + 3] = phi / angle
            A.append(row)
            b.append(np.array([ball.limit - angle]))
    return np.concatenate(A), np.concatenate(b)
