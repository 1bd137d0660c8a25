"""Which of many linear limits matter: those at the corners of the hull that their rows span."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

Array = NDArray[np.float64]
_FEW = 8  # rows of which none is looked for


def needed(rows: Array, positive: tuple[bool, ...]) -> NDArray[np.bool_]:
    """Mask (n, m) of the rows p (n, m, d) of p y <= 1 from which, at each of n places, all others follow.

    A row follows from others if and only if it lies in the hull of these and zero (they are polar to what
    they allow); where y cannot be negative, ``positive`` (d,), from any with a larger coefficient, too.
    Rows that are zero are never needed, rows that are not finite always.
    """
    out: NDArray[np.bool_] = np.any(rows != 0.0, axis=2)
    for mine, at in zip(out, rows, strict=True):
        some = np.flatnonzero(mine & np.isfinite(at).all(axis=1))
        size = np.abs(at[some]).max(axis=0, initial=0.0)
        wide = size > 0.0
        if len(some) <= _FEW or not wide.any():
            continue
        points = at[np.ix_(some, wide)] / size[wide]
        below = [points]
        for axis in np.flatnonzero(np.array(positive)[wide]):
            lower = points.copy()
            lower[:, axis] = -2.0  # below all: a row is no copy of itself
            below.append(lower)
        every = np.concatenate([*below, np.zeros((1, points.shape[1]))])
        mine[some] = _corners(every)[: len(some)]
    return out


def _corners(points: Array) -> NDArray[np.bool_]:
    """Which of points (m, d) are corners of their hull; all if they have none."""
    out = np.ones(len(points), dtype=bool)
    if points.shape[1] == 1:
        out[:] = False
        out[[points.argmin(), points.argmax()]] = True
        return out
    try:
        corners = ConvexHull(points).vertices
    except QhullError:  # all in one plane
        return out
    out[:] = False
    out[corners] = True
    return out
