"""An explicit Runge-Kutta method as data: its Butcher tableau, which checks itself."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

EPS = float(np.finfo(np.float64).eps)
# Coefficients are rounded to doubles, so that sums of s of them agree to a few units in the last place.
ROUNDING = 64 * EPS


def frozen(values: ArrayLike) -> Array:
    """Read-only float64 copy of `values`."""
    array = np.array(values, dtype=np.float64)
    array.setflags(write=False)
    return array


def stages(rows: Sequence[Sequence[float]], width: int) -> Array:
    """Matrix of stage coefficients from rows whose trailing zeros are left out, shape (len(rows), width)."""
    return frozen([[*row, *[0.0] * (width - len(row))] for row in rows])


@dataclass(frozen=True, eq=False)
class Dense:
    """Continuous extension of a step: y(t + theta h) = y + theta h sum_ij P[i, j] x^j k_i, x = 2 theta - 1.

    Here 0 <= theta <= 1; powers of x cancel far less than those of theta. The stages are the s of the step
    followed by m extra ones, k_i = f(t + c_i h, y + h sum_j A_ij k_j), computed only in steps that are looked
    into. Unless the method is FSAL the first extra stage is f at its end, which the next step needs.

    Attributes:
        order: the extension satisfies the continuous order conditions up to this order: its error within one
            step is O(h^(order + 1)).
        A: coefficients of the extra stages, shape (m, s + m).
        c: their nodes, shape (m,).
        P: polynomial weights of all stages, shape (s + m, degree).
    """

    order: int
    A: Array
    c: Array
    P: Array


@dataclass(frozen=True, eq=False)
class Tableau:
    """Explicit Runge-Kutta method of s stages.

    One step is k_i = f(t + c_i h, y + h sum_j A_ij k_j), y_new = y + h sum_i b_i k_i.

    Attributes:
        name: the name `solve` knows it by.
        A: stage coefficients, strictly lower triangular, shape (s, s).
        b: weights, shape (s,).
        c: nodes, the row sums of A, shape (s,).
        order: order p of the solution that is propagated.
        b_error: weights of the error estimate h sum_i b_error_i k_i, that is b minus the weights of the
            embedded method, shape (s,); None for a method without one.
        error_order: order of the embedded method; the estimate is O(h^(error_order + 1)).
        b_error_low: weights of a second, cruder estimate. With e and e_low the norms of both, the
            error of the step is e^2 / sqrt(e^2 + 0.01 e_low^2) (Hairer, Norsett & Wanner I, II.10).
        error_exponent: power of h that the estimated error of a step goes with: error_order + 1, and 8 for
            the combined estimate of DOP853.
        fsal: the last stage is f at the end of the step, so that the next step may begin with it.
        dense: the continuous extension.
        source: where the coefficients come from.

    Raises:
        ValueError: the coefficients contradict each other (shapes, row sums, triangularity, consistency).
    """

    name: str
    A: Array
    b: Array
    c: Array
    order: int
    dense: Dense
    b_error: Array | None = None
    error_order: int | None = None
    b_error_low: Array | None = None
    error_exponent: int | None = None
    fsal: bool = False
    source: str = ""

    def __post_init__(self) -> None:
        s, m = len(self.b), len(self.dense.c)
        shapes = {"A": (self.A, (s, s)), "c": (self.c, (s,)), "dense.A": (self.dense.A, (m, s + m))}
        if self.b_error is not None:
            shapes["b_error"] = (self.b_error, (s,))
        if self.b_error_low is not None:
            shapes["b_error_low"] = (self.b_error_low, (s,))
        for field, (array, shape) in shapes.items():
            if array.shape != shape:
                raise ValueError(f"tableau {self.name}: {field} has shape {array.shape}, expected {shape}")
        if self.dense.P.ndim != 2 or len(self.dense.P) != s + m:
            raise ValueError(f"tableau {self.name}: dense.P needs {s + m} rows, one for each stage")
        if len({x is None for x in (self.b_error, self.error_order, self.error_exponent)}) > 1:
            raise ValueError(f"tableau {self.name}: b_error, error_order and error_exponent go together")
        rows = np.vstack([np.hstack([self.A, np.zeros((s, m))]), self.dense.A])
        nodes = np.concatenate([self.c, self.dense.c])
        if np.any(np.triu(rows)):
            raise ValueError(
                f"tableau {self.name}: A is not strictly lower triangular: not an explicit method"
            )
        self._require("row sums of A equal c", rows.sum(1) - nodes, np.abs(rows).sum(1))
        self._require("b sums to 1", self.b.sum() - 1, np.abs(self.b).sum())
        self._require(
            "dense.P at theta = 1 is b",
            self.dense.P.sum(1) - np.concatenate([self.b, np.zeros(m)]),
            np.abs(self.dense.P).sum(1),
        )
        if self.b_error is not None:
            self._require("b_error sums to 0", self.b_error.sum(), np.abs(self.b_error).sum())
        end = self.A[-1] if self.fsal else self.dense.A[0, :s]
        if not np.array_equal(end, self.b):
            raise ValueError(f"tableau {self.name}: the stage at the end of the step must have the row b")

    def _require(self, law: str, residual: ArrayLike, scale: ArrayLike) -> None:
        worst = np.max(np.abs(residual) - ROUNDING * np.maximum(scale, 1.0))
        if worst > 0:
            raise ValueError(f"tableau {self.name}: {law} is violated by {np.max(np.abs(residual)):.3g}")

    @property
    def stages(self) -> int:
        """Number of stages s of a step, without those of the dense output."""
        return len(self.b)

    @property
    def adaptive(self) -> bool:
        """The method estimates its own error, so that its step can follow a tolerance."""
        return self.b_error is not None


def hermite(b: Array, *, fsal: bool, order: int) -> Dense:
    """Cubic Hermite extension through both ends and their slopes, of order min(order, 3).

    y = y0 + (3 theta^2 - 2 theta^3)(y1 - y0) + (theta - 2 theta^2 + theta^3) h f0 + (theta^3 - theta^2) h f1
    (Hairer, Norsett & Wanner I, II.6), over theta and in powers of x = 2 theta - 1.
    """
    s, m = len(b), 0 if fsal else 1
    P = np.zeros((s + m, 3))
    P[:s] += np.outer(b, (1.0, 1 / 2, -1 / 2))
    P[0] += (1 / 4, -1 / 2, 1 / 4)
    P[-1] += (-1 / 4, 0.0, 1 / 4)
    A = np.zeros((m, s + m))
    A[:, :s] = b
    return Dense(order=min(order, 3), A=frozen(A), c=frozen(np.ones(m)), P=frozen(P))
