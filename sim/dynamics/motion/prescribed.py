"""Prescribed motion as piecewise polynomials, so that compiled code has it at any time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import chebyshev
from numpy.typing import ArrayLike, NDArray

from ...errors import EngineError

Array = NDArray[np.float64]

TERMS = 16
"""Chebyshev coefficients of a piece."""
RESOLVED = 1e-13
"""The last coefficients of a piece are at most this part of the largest value of their column."""
NARROWEST = 1e-12
"""Pieces are not halved below this part of the time span: what is in there is a break."""
JUMP = 1e-9
"""Values that differ by more than this part of their column's largest jump."""
BEND = 1e-7
"""The same for what a piece changes by its slope; that of resolved pieces is known to 1e-10."""
CLOSE = 1e-6
"""Pieces shorter than this part of the time span close in on something that is not smooth."""
_SHARE = 0.1  # of the largest component, that one of the same kind is rounded as at least
MOST = 100_000
"""Pieces that are tried at most."""

# Chebyshev points of the first kind do not touch a piece's ends, where values may jump.
_POINTS = np.cos(np.pi * (np.arange(TERMS) + 0.5) / TERMS)[::-1]
_TO_COEFFICIENTS = np.linalg.inv(chebyshev.chebvander(_POINTS, TERMS - 1))


@dataclass(frozen=True, eq=False)
class Pieces:
    """Polynomials sum_k c_k T_k(x) between knots, x from -1 to 1.

    Attributes:
        knots: shape (m + 1,) [s].
        coefficients: shape (m, width, terms).
        breaks: knots where a value or a derivative jumps, by index; the first and the last are none.
    """

    knots: Array
    coefficients: Array
    breaks: NDArray[np.intp]

    def __call__(self, t: ArrayLike, *, left: bool = False) -> Array:
        """Values (n, width) at times `t` (n,); where they jump, from the right or from the `left`."""
        times = np.asarray(t, dtype=float)
        found = np.searchsorted(self.knots, times, "left" if left else "right")
        piece = np.clip(found - 1, 0, len(self.knots) - 2)
        low, high = self.knots[piece], self.knots[piece + 1]
        x = (2.0 * times - low - high) / (high - low)
        return np.asarray(
            np.einsum("nwk,nk->nw", self.coefficients[piece], chebyshev.chebvander(x, self.terms - 1))
        )

    @property
    def terms(self) -> int:
        """Coefficients of a polynomial."""
        return int(self.coefficients.shape[2])


def constant(value: Array, t0: float, t1: float) -> Pieces:
    """`value` (width,) at all times."""
    return Pieces(np.array([t0, t1]), np.array(value, dtype=float)[None, :, None], np.zeros(0, np.intp))


def pieces_of(
    motion: Callable[[Array], ArrayLike],
    width: int,
    t0: float,
    t1: float,
    breaks: ArrayLike = (),
    knots: ArrayLike = (),
    scale: Callable[[Array], Array] = np.asarray,
) -> Pieces:
    """`motion`, times (n,) -> (n, width), from t0 to t1 as polynomials that agree with it to rounding.

    Pieces are halved until their polynomials are resolved; where that never happens is a break, beside those
    given. `knots`, where its own pieces are known to end, spare halving down to them. `scale` makes of the
    largest values of the columns what their rounding is measured by. Raises EngineError for a motion of
    another shape, one that is not finite, or one that is too wild.
    """
    given = np.unique(np.asarray(breaks, dtype=float))
    inner = np.union1d(given, np.asarray(knots, dtype=float))
    ends = np.concatenate([[t0], inner[(inner > t0) & (inner < t1)], [t1]])
    low, high = ends[:-1], ends[1:]
    done: list[tuple[Array, Array, Array]] = []
    largest = np.zeros(width)
    count = 0
    while len(low):
        values = _sampled(motion, width, low, high)
        largest = np.maximum(largest, np.abs(values).max(axis=(0, 1)))
        c = np.einsum("kp,npw->nwk", _TO_COEFFICIENTS, values)
        tail = np.abs(c[:, :, -2:]).max(axis=2)
        fine = (tail <= RESOLVED * scale(largest)).all(axis=1)
        tiny = ~fine & (high - low <= NARROWEST * (t1 - t0))
        done.append((low[fine], high[fine], c[fine]))
        count += len(low)
        if count > MOST:
            raise EngineError(
                f"the prescribed motion needs more than {MOST} pieces: it is too wild between "
                f"{low[~fine][0]:.6g} s and {high[~fine][-1]:.6g} s for steps that follow a tolerance"
            )
        low, high = low[~fine & ~tiny], high[~fine & ~tiny]
        middle = 0.5 * (low + high)
        low, high = np.concatenate([low, middle]), np.concatenate([middle, high])
    return _joined(done, given, t0, t1, scale(largest))


def scale_of_motion(nq: int, nv: int) -> Callable[[Array], Array]:
    """`pieces_of`'s scale for rows that begin with q (nq), v (nv), a (nv) of rotations among others: what
    rounding leaves of a component that should be zero is that of the others."""

    def scale(largest: Array) -> Array:
        out, ends = largest.copy(), (nq, nq + nv, nq + 2 * nv)
        q, v, a = (slice(end - width, end) for end, width in zip(ends, (nq, nv, nv), strict=True))
        speed = largest[v].max(initial=0.0)
        for part, least in ((q, largest[q].max(initial=0.0)), (v, speed)):
            out[part] = np.maximum(out[part], _SHARE * least)
        out[a] = np.maximum(out[a], _SHARE * max(largest[a].max(initial=0.0), speed**2))
        return out

    return scale


def _sampled(motion: Callable[[Array], ArrayLike], width: int, low: Array, high: Array) -> Array:
    """Values (n, points, width) inside the pieces."""
    times = 0.5 * ((high + low)[:, None] + (high - low)[:, None] * _POINTS)
    values = np.asarray(motion(times.ravel()), dtype=float)
    if values.shape != (times.size, width):
        raise EngineError(f"w gives shape {values.shape} for {times.size} times; expected (times, {width})")
    if not np.isfinite(values).all():
        bad = times.ravel()[~np.isfinite(values).all(axis=1)][0]
        raise EngineError(f"w is not finite at t = {bad:.9g} s")
    return values.reshape(*times.shape, width)


def _joined(
    done: list[tuple[Array, Array, Array]], given: Array, t0: float, t1: float, scale: Array
) -> Pieces:
    """Pieces in order; a jump lies in the middle of the gap that it has left, its sides go on up to there."""
    low, high, c = (np.concatenate([part[k] for part in done]) for k in range(3))
    order = np.argsort(low)
    low, high, c = low[order], high[order], c[order]
    parts, knots, jumps = [], [t0], []
    for i, (a, b) in enumerate(zip(np.append(low, t1), np.append(t0, high), strict=True)):
        if a > b:  # a gap between the pieces i - 1 and i
            sides = ([b] if i > 0 else []) + ([a] if i < len(low) else [])
            middle = {2: 0.5 * (a + b)}.get(len(sides))
            for side in sides:
                parts.append(_held(c[i - 1] if side == b else c[i], 1.0 if side == b else -1.0))
            if middle is not None:
                jumps.append(middle)
            knots += [middle, a] if middle is not None else [a]
        if i < len(low):
            parts.append(c[i])
            knots.append(high[i])
    coefficients, edges = np.stack(parts), np.array(knots)
    coefficients[np.abs(coefficients) <= 1e-15 * scale[:, None]] = 0.0
    used = np.flatnonzero(coefficients.any(axis=(0, 1)))
    coefficients = np.ascontiguousarray(coefficients[:, :, : used[-1] + 1 if len(used) else 1])
    broken = _leaps(coefficients, np.diff(edges), scale) | np.isin(edges[1:-1], np.append(given, jumps))
    _close_in(np.diff(edges), t1 - t0, broken)
    return Pieces(edges, coefficients, np.flatnonzero(broken) + 1)


def ends(c: Array) -> tuple[Array, Array]:
    """Values (m, width) of polynomials (m, width, terms) at x = -1 and x = 1."""
    signs = 1.0 - 2.0 * (np.arange(c.shape[2]) % 2)
    return (c * signs).sum(axis=2), c.sum(axis=2)


def _close_in(length: Array, span: float, broken: NDArray[np.bool_]) -> None:
    """Mark the inner knots on which ever shorter pieces close in: a slope changes there, in the shortest."""
    narrow = np.flatnonzero(length < CLOSE * span)
    for group in np.split(narrow, np.flatnonzero(np.diff(narrow) > 1) + 1) if len(narrow) else ():
        knot = int(group[int(np.argmin(length[group]))])  # inner knot k lies between the pieces k and k + 1
        if 0 < knot <= len(broken) and not broken[max(0, group[0] - 1) : group[-1] + 1].any():
            broken[knot - 1] = True


def _leaps(c: Array, length: Array, largest: Array) -> NDArray[np.bool_]:
    """Whether values or slopes differ between the two sides of each inner knot."""
    low, high = ends(c)
    leap = np.abs(low[1:] - high[:-1]) > JUMP * largest
    slope = 2.0 * chebyshev.chebder(c, axis=2) / length[:, None, None]
    low, high = ends(slope)
    shorter = np.minimum(length[1:], length[:-1])[:, None]
    bend = np.abs(low[1:] - high[:-1]) * shorter > BEND * largest
    return np.asarray((leap | bend).any(axis=1))


def _held(c: Array, x: float) -> Array:
    """The constants that polynomials (width, terms) have at one end of their piece, x = 1 or -1."""
    out = np.zeros_like(c)
    out[:, 0] = (c * x ** np.arange(c.shape[1])).sum(axis=1)
    return out
