"""A small quadratic function's minimum between bounds, and how it moves with a linear term."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def bounded_minimum(
    H: Array, g: Array, G: Array, low: Array, high: Array, along: tuple[Array, Array] | None = None
) -> tuple[Array, Array]:
    """d (m,) that minimises d'H d/2 + g'd within [low, high], and how it moves (m, n) when g changes by
    G (m, n) and the bounds by ``along`` (m, n each; default: not at all).

    Projected Newton steps with their active set (D. Bertsekas, SIAM J. Control Optim. 20, 1982).
    """
    if len(g) == 1:
        one = min(max(-g[0] / H[0, 0], low[0]), high[0])
        if low[0] < one < high[0]:
            return np.array([one]), -G / H[0, 0]
        return np.array([one]), np.zeros_like(G) if along is None else along[0 if one <= low[0] else 1]
    both = np.asarray(np.linalg.solve(H, np.column_stack([g, G])), dtype=np.float64)
    d = -both[:, 0]
    if ((d >= low) & (d <= high)).all():
        return d, -both[:, 1:]
    d = np.clip(d, low, high)
    value = d @ (g + 0.5 * H @ d)
    for _ in range(50):
        free = _free(d, g + H @ d, low, high)
        if not len(free):
            break
        move = -np.linalg.solve(H[np.ix_(free, free)], (g + H @ d)[free])
        share, new, less = 1.0, d, value
        while share > 1e-6:
            new = d.copy()
            new[free] = np.clip(d[free] + share * move, low[free], high[free])
            less = new @ (g + 0.5 * H @ new)
            if less <= value:
                break
            share *= 0.5
        still = np.abs(new - d).max() <= 1e-12 * (1.0 + np.abs(d).max())
        d, value = new, less
        if still:
            break
    K = np.zeros_like(G) if along is None else np.where((d <= low)[:, None], *along)
    free = _free(d, g + H @ d, low, high)
    if len(free):
        K[free] = 0.0
        K[free] = -np.linalg.solve(H[np.ix_(free, free)], (G + H @ K)[free])
    return d, K


def _free(d: Array, slope: Array, low: Array, high: Array) -> NDArray[np.intp]:
    """Entries that no bound holds."""
    return np.flatnonzero(~(((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0))))
