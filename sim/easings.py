"""Easings: the shape of the way from one key to the next, as piecewise polynomials on [0, 1].

An easing e maps s in [0, 1] to e(0) = 0, e(1) = 1; a curve between two keys is q0 + (q1 - q0) e(s). Being
polynomials, they have exact derivatives and become pieces of a curve by scaling their coefficients.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.polynomial import Polynomial
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]


def evaluate_pieces(coefficients: Array, i: NDArray[np.intp], s: Array) -> tuple[Array, Array, Array]:
    """Value and first two derivatives (n, d) of piece `i` (n,) at local time `s` (n,), by Horner's rule.

    `coefficients` is (degree + 1, pieces, d), highest power first, as in SciPy's PPoly.
    """
    s = s[:, None]
    p = coefficients[0, i]
    dp = np.zeros_like(p)
    half_ddp = np.zeros_like(p)
    for c in coefficients[1:]:
        half_ddp = half_ddp * s + dp
        dp = dp * s + p
        p = p * s + c[i]
    return p, dp, 2.0 * half_ddp


@dataclass(frozen=True, eq=False)
class Easing:
    """A piecewise polynomial on [0, 1]: `knots` (m + 1,), `coefficients` (degree + 1, m), highest first."""

    knots: Array
    coefficients: Array

    def __call__(self, s: ArrayLike) -> tuple[Array, Array, Array]:
        """Value, slope and curvature at `s` in [0, 1] (any shape), from the right at inner knots."""
        s = np.asarray(s, dtype=float)
        flat = s.ravel()
        i = np.clip(np.searchsorted(self.knots, flat, side="right") - 1, 0, len(self.knots) - 2)
        e, de, dde = evaluate_pieces(self.coefficients[:, :, None], i, flat - self.knots[i])
        return e.reshape(s.shape), de.reshape(s.shape), dde.reshape(s.shape)


def _easing(pieces: Sequence[Any], inner_knots: Sequence[float] = ()) -> Easing:
    """Easing from polynomials in s (not in local time), one a piece."""
    knots = np.array([0.0, *inner_knots, 1.0])
    degree = max(p.degree() for p in pieces)
    coefficients = np.zeros((degree + 1, len(pieces)))
    for k, p in enumerate(pieces):
        local = p(Polynomial([knots[k], 1.0])).coef
        coefficients[degree + 1 - len(local) :, k] = local[::-1]
    coefficients[-1, 0] = 0.0  # e(0) = 0 exactly, so that curves meet their keys
    knots.setflags(write=False)
    coefficients.setflags(write=False)
    return Easing(knots, coefficients)


_s = Polynomial([0.0, 1.0])
_back = 2.70158 * _s**3 - 1.70158 * _s**2  # goes back by a tenth of the way (Penner 2002)
_g = 7.5625  # fall from 1 with rebounds to 1/4, 1/16, 1/64 (restitution 1/2) at rest exactly at s = 1

EASINGS = MappingProxyType(
    {
        "smooth": _easing([10 * _s**3 - 15 * _s**4 + 6 * _s**5]),  # minimum jerk (Flash & Hogan 1985)
        "ease_in": _easing([_s**3]),
        "ease_out": _easing([1 - (1 - _s) ** 3]),
        "ease_in_out": _easing([4 * _s**3, 1 - 4 * (1 - _s) ** 3], [0.5]),
        "back_in": _easing([_back]),
        "back_out": _easing([1 - _back(1 - _s)]),
        "bounce": _easing(
            [
                _g * _s**2,
                _g * (_s - 6 / 11) ** 2 + 3 / 4,
                _g * (_s - 9 / 11) ** 2 + 15 / 16,
                _g * (_s - 21 / 22) ** 2 + 63 / 64,
            ],
            [4 / 11, 8 / 11, 10 / 11],
        ),
    }
)
"""Easings by name. smooth starts and ends at rest without a jump of acceleration; ease_in and ease_out are
cubic; back_in takes a run-up and back_out overshoots, both by 10%; bounce drops onto the second key."""
