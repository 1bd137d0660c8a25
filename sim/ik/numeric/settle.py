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

_REST = 1e-10  # longest entry of a step that counts as none


class Settled(NamedTuple):
    """Configuration (nq,), value of the wishes there, iterations."""

    q: Array
    value: float
    iterations: int


def settle(problem: Problem, q: Array, wish: Wish, *, iterations: int = 60) -> Settled:
    """Least squares of `wish` from q (nq,), which meets `problem`, along its self-motions inside the limits.

    Each step is a quadratic programme in the null space of the hard rows, followed by a return onto them
    (sequential quadratic programming on the constraint manifold); the last two tell how much of it to take,
    and a step that does not help is cut.
    """
    x, cap, done = q[None], 0.5, 0
    rows = wish(x)
    value = float(np.sum(rows.r**2))
    before: Array | None = None
    share = 1.0
    for done in range(1, iterations + 1):  # noqa: B007
        step = _step(problem, x, rows, cap)
        if step is None or np.abs(step).max() < _REST:
            break
        share = 1.0 if before is None else _share(share, before, step)
        smaller = [min(share, 1.0) * 0.5**k for k in range(5)]
        for part in [share, *smaller] if share > 1.0 else smaller:
            trial = _returned(problem, problem.space.step(x, part * step[None]))
            rows_trial = None if trial is None else wish(trial)
            lower = np.inf if rows_trial is None else float(np.sum(rows_trial.r**2))
            if lower < value:
                break
        if trial is None or rows_trial is None or lower >= value:
            cap, before = 0.25 * min(cap, float(np.abs(step).max())), None
            if cap < 1e-8:
                break
            continue
        x, rows, value, cap, before, share = trial, rows_trial, lower, min(2 * cap, 1.0), step, part
    return Settled(x[0], value, done)


def worth(problem: Problem, q: Array, start: Array, faint: float) -> Array:
    """Value (k,) of the wishes beside a problem and of nearness to `start` (nq,) at q (k, nq)."""
    far = problem.space.difference(q, start)[:, problem.moved]
    value = faint**2 * np.sum(far * far, axis=1)
    if problem.wished is not None:
        value += np.sum(problem.wished.weighted(problem.beside(q)).r ** 2, axis=1)
    return np.asarray(value)


def _share(share: float, before: Array, step: Array) -> float:
    """What to take of a step after `share` of the one before (Barzilai & Borwein 1988; see `iteration`)."""
    square = float(before @ before)
    change = square - float(before @ step)
    return float(np.clip(share * square / change, 0.1, 8.0)) if change > 1e-6 * square else 1.0


def settle_near(problem: Problem, q: Array, start: Array, wish: Wish, *, faint: float) -> list[Settled]:
    """`settle` from each row of q (k, nq) for the wishes of the problem and nearness to `start` (nq,).

    `wish` are their rows, those of nearness `faint` times the distance. In machine code where the problem has
    some, and where that has come to rest at what meets the goals and serves the wishes better than q.
    """
    slow: list[Settled] = []
    while (quick := problem.prepared(build=True)) is None or not quick.machine.layout.along:
        if len(slow) == len(q):
            return slow
        slow.append(settle(problem, q[len(slow)], wish))
    q = q[len(slow) :]
    machine = quick.machine
    first = worth(problem, q, start, faint)
    far = machine.settle(q, machine.arguments(problem, q0=start, s=faint**2))
    rest = (far.step < _REST / faint) & (far.worst <= 1.0)
    fine = rest & (far.value <= first * 1.001 + 1e-6)  # q may meet its goals by their tolerances alone
    x, value = far.q, far.value
    if (far.worst[fine] > 1e-6).any():  # wishes that pull hard leave the goals open by rounding
        x = descend(problem, far.q, iterations=8).q
        value = worth(problem, x, start, faint)
    fine &= problem.met(problem.raw(x).r)
    return slow + [
        Settled(x[i], float(value[i]), int(far.iterations[i])) if fine[i] else settle(problem, q[i], wish)
        for i in range(len(q))
    ]


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
    H = J.T @ J
    H += (1e-9 + 1e-14 * np.trace(H)) * np.eye(len(H))
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
