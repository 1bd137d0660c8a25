"""The nearest pose to goals that cannot be met, and what is best beside it.

Three things count, each as far as those before it allow: equalities of the model, goals, wishes. Weights of
different size stand for the order while a search goes on; at the end the first two are made exact.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ..goals import Rows
from ..problem import Problem
from ..space import Space
from .descend import Descent, descend, held_projection, solved
from .search import Search
from .settle import Settled, Wish, settle

Array = NDArray[np.float64]
_CLOSED = 1e3  # residuals of equalities beside those of goals
_CRAWL = 20  # iterations of Gauss and Newton before those of Newton
_FIRST = 1e2  # residuals of goals beside those of wishes


def sharpen(problem: Problem, q: Array, *, iterations: int = 40) -> Descent:
    """Nearest pose, from q (nq,) near it, with the model's equalities closed; `Descent` of one."""
    x = _along_loops(problem, q) if problem.loops else q
    x = _newton(problem, x, _goals(problem), None, iterations)
    if problem.loops:
        x = _closed(problem, x)
    raw = problem.raw(x[None])
    return Descent(x[None], raw.r, _square(problem.weighted(raw).r), iterations, problem.met(raw.r))


def brought(search: Search) -> Descent:
    """The best of the nearest poses that a search came to, after `sharpen`."""
    ends = [sharpen(search.problem, q) for q in search.best.q[:4]]
    search.brought = [float(end.cost[0]) for end in ends]
    return min(ends, key=lambda end: float(end.cost[0]))


def settle_least(held: Problem, q: Array, wish: Wish) -> Settled:
    """Least |wish|^2 among what meets `held`, from q (nq,) that does; exact where much of the wish remains.

    The end of `settle` by Newton's method on heavier rows of `held` beside the wish. What these weights leave
    open is closed along the normals, so that the value is off by the square of that.
    """
    end = settle(held, q, wish, iterations=_CRAWL)

    def rows(x: Array) -> Rows:
        w, k = held.weighted(held.raw(x)), wish(x)
        parts = zip((_CLOSED * w.r, _CLOSED * w.J), k, strict=True)
        return Rows(*(np.concatenate(pair, axis=1) for pair in parts))

    back = descend(held, _newton(held, end.q, rows, None, 40)[None], iterations=20)
    value = float(_square(wish(back.q).r)[0])
    return Settled(back.q[0], value, end.iterations) if back.met[0] and value < end.value else end


def settle_nearest(problem: Problem, end: Descent, wish: Wish, *, iterations: int = 40) -> Array:
    """The nearest pose (nq,) that serves `wish` best, from a nearest one."""
    goals = _goals(problem)

    def firm(q: Array) -> Rows:
        rows = goals(q)
        return Rows(_FIRST * rows.r, _FIRST * rows.J)

    x = sharpen(problem, _newton(problem, end.q[0], firm, wish, iterations))
    best = x if x.cost[0] <= end.cost[0] * (1 + 1e-6) + 1e-16 else end
    return np.asarray(best.q[0])


def _goals(problem: Problem) -> Wish:
    """Weighted rows, those of equalities heavier."""
    heavy = np.ones(problem.m)
    for group in problem.groups:
        if group.goal is None:
            heavy[group.rows] = _CLOSED

    def rows(q: Array) -> Rows:
        w = problem.weighted(problem.raw(q))
        return Rows(w.r * heavy, w.J * heavy[:, None])

    return rows


def _along_loops(problem: Problem, q: Array) -> Array:
    """q (nq,) taken onto the equalities and along them towards the goals, where these can be closed."""
    loops, x = problem.closures(), _closed(problem, q)
    if not loops.met(loops.raw(x[None]).r)[0]:
        return q
    return settle(loops, x, lambda y: problem.weighted(problem.raw(y))).q


def _closed(problem: Problem, q: Array) -> Array:
    """q (nq,) moved onto the model's equalities, or as it is where they cannot be closed."""
    end = descend(problem.closures(), q[None], iterations=20)
    return np.asarray(end.q[0] if end.met[0] else q)


def _newton(problem: Problem, q: Array, rows: Wish, wish: Wish | None, iterations: int) -> Array:
    """Newton's method for the least |rows|^2 + |wish|^2 inside the limits, from q (nq,).

    Gauss-Newton crawls where a residual stays (a stretched arm); the curvature of the kinematics, from
    central differences of the gradient, gives the quadratic end. Levenberg's shift keeps it a descent.
    `wish` counts as Gauss and Newton have it.
    """
    space, columns = problem.space, np.flatnonzero(problem.moved)
    open_space = Space(problem.model, limits=False)  # a derivative wants both sides, also at limits
    x, shift = space.clip(q[None]), 1e-6
    w, k = rows(x), None if wish is None else wish(x)
    cost = _value(w, k)
    for _ in range(iterations):
        g = w.r[0] @ w.J[0] + (0.0 if k is None else k.r[0] @ k.J[0])
        _, mask = held_projection(problem, x, g[None], w.J)
        free = columns[mask[0][columns]]
        if not len(free) or np.abs(g[free]).max() < 1e-14:
            break
        H = _hessian(open_space, rows, x[0], free)
        if k is not None:
            H = H + k.J[0][:, free].T @ k.J[0][:, free]
        P = _unblocked(problem, x, g)[np.ix_(free, free)]
        H, down = P @ H @ P + np.eye(len(free)) - P, P @ g[free]
        least = float(np.linalg.eigvalsh(H)[0])
        lower = np.inf
        for _ in range(12):
            A = H + (max(0.0, -least) * 1.1 + shift) * np.eye(len(free))
            d = np.zeros(space.nv)
            d[free] = -solved(A, down[:, None])[:, 0]
            d *= min(1.0, 0.5 / max(np.abs(d).max(), 1e-300))
            trial = space.step(x, d[None])
            w_trial, k_trial = rows(trial), None if wish is None else wish(trial)
            if (lower := _value(w_trial, k_trial)) < cost:
                break
            shift *= 10
        if not lower < cost:
            break
        gain = cost - lower
        x, w, k, cost, shift = trial, w_trial, k_trial, lower, max(shift * 0.1, 1e-14)
        if gain < (1e-15 if wish is None else 1e-12) * cost:
            break
    return np.asarray(x[0])


def _unblocked(problem: Problem, q: Array, g: Array) -> Array:
    """Projection (nv, nv) that takes out the turns of balls at their limits that -g (nv,) pushes outward."""
    P = np.eye(problem.space.nv)
    for ball, axis in problem.space.free_directions(q, g[None])[1]:
        P[ball.v : ball.v + 3, ball.v : ball.v + 3] -= np.outer(axis[0], axis[0])
    return P


def _value(w: Rows, k: Rows | None) -> float:
    return float(_square(w.r)[0]) + (0.0 if k is None else float(_square(k.r)[0]))


def _square(r: Array) -> Array:
    return np.asarray(np.sum(r * r, axis=1))


def _hessian(space: Space, rows: Callable[[Array], Rows], q: Array, free: NDArray[np.intp]) -> Array:
    """Second derivative (k, k) of half the cost of rows along the freedoms `free`."""
    h, k = 1e-5, len(free)
    d = np.zeros((2 * k, space.nv))
    d[np.arange(k), free], d[np.arange(k, 2 * k), free] = h, -h
    w = rows(space.step(np.tile(q, (len(d), 1)), d))
    g = (w.r[:, None, :] @ w.J)[:, 0][:, free]
    H = (g[:k] - g[k:]) / (2 * h)
    return np.asarray(0.5 * (H + H.T))
