"""Ways out of configurations where no first-order step serves: saddles of the goals' cost.

A stretched arm whose goal lies inwards along it has J'r = 0 with r != 0: every step that looks at first
derivatives alone stands still for ever. There the Hessian of 1/2 |r|^2, J'J + sum r_i d2r_i, has a direction
of negative curvature, along which the cost falls (Nocedal & Wright, Numerical Optimization, sec. 3.4). Where
the goal lies beyond reach it has none: a stretched arm is the nearest there is, and stays.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .problem import Problem

Array = NDArray[np.float64]
_BY = 1e-4  # [rad or m] of differences of J'r: their error is about 1e-8 of the Hessian
_CURVED = 1e-7  # of the Hessian's size: less is that error
_WAYS = 3  # directions that are tried


def ways_down(problem: Problem, q: Array, weight: Array, free: NDArray[np.bool_]) -> Array:
    """Unit directions (k, nv) of negative curvature of 1/2 |weight r|^2 at q (nq,), steepest first, each
    followed by its opposite; none (0, nv) at a minimum. Only the freedoms in `free` (nv,) move.

    Of a direction and its opposite, which descend alike where J'r = 0, the one comes first whose largest
    component is positive: the same answer every time.
    """
    columns, nv = np.flatnonzero(free), problem.model.nv
    n = len(columns)
    if n == 0:
        return np.zeros((0, nv))
    d = np.zeros((2 * n, nv))
    d[np.arange(n), columns] = _BY
    d[n + np.arange(n), columns] = -_BY
    around = problem.space.step(np.repeat(q[None], 2 * n, axis=0), d)
    w = problem.weighted(problem.raw(around))
    slopes = np.einsum("kmv,km->kv", w.J * weight[:, None], w.r * weight)[:, columns]
    moved = problem.space.difference(around[:n], around[n:])[np.arange(n), columns]
    keep = moved > 0.5 * _BY  # of a freedom without room there is nothing to know
    H = (slopes[:n] - slopes[n:])[keep][:, keep] / moved[keep][:, None]
    if not (H.size and np.isfinite(H).all()):
        return np.zeros((0, nv))
    curvature, along = np.linalg.eigh(0.5 * (H + H.T))
    out = []
    for k in np.flatnonzero(curvature < -_CURVED * np.abs(curvature).max())[:_WAYS]:
        way = np.zeros(nv)
        way[columns[keep]] = along[:, k]
        largest = way[int(np.argmax(np.abs(way) > np.abs(way).max() * (1 - 1e-9)))]
        out += [way * np.sign(largest), -way * np.sign(largest)]
    return np.array(out).reshape(-1, nv)
