"""One Runge-Kutta step of any tableau and its continuous extension."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from ..errors import EngineError
from .problems import Derivative, Problem
from .tableau import Array, Tableau


class Counted:
    """f of a problem, counting its calls."""

    def __init__(self, f: Derivative) -> None:
        self.f, self.calls = f, 0

    def __call__(self, t: float, y: Array) -> Array:
        """f(t, y)."""
        self.calls += 1
        return self.f(t, y)


@dataclass
class Step:
    """A computed step from (t, y) over h; f_end and the dense output are evaluated when first asked for.

    Attributes:
        t, h: start and length of the step [s]; h < 0 integrates backward.
        y, y_end: states at both ends, shape (ndim,); the latter is on the manifold.
        K: slopes of the stages and of those of the dense output, shape (s + m, ndim).
    """

    method: Tableau
    problem: Problem
    f: Counted
    t: float
    h: float
    y: Array
    y_end: Array
    K: Array
    t_end: float
    _f_end: Array | None = None
    _Q: Array | None = field(default=None, repr=False)

    @property
    def f_start(self) -> Array:
        """f at the start of the step, shape (ndim,)."""
        return np.asarray(self.K[0])

    @property
    def f_end(self) -> Array:
        """f at the end of the step: the last stage of an FSAL method, else the first of the next step."""
        if self._f_end is None:
            last = self.method.stages - 1
            self._f_end = self.K[last] if self.method.fsal else self.f(self.t_end, self.y_end)
        return self._f_end

    def at(self, theta: float) -> Array:
        """State at t + theta h for 0 <= theta <= 1, shape (ndim,); the ends are those of the step itself."""
        if theta <= 0:
            return self.y
        if theta >= 1:
            return self.y_end
        powers = (2 * theta - 1) ** np.arange(self.method.dense.P.shape[1])
        return self.problem.project(self.y + theta * self.h * (self.coefficients() @ powers))

    def coefficients(self) -> Array:
        """(Dense output - y) / (theta h) by powers of x, shape (ndim, degree); evaluates the extra stages."""
        if self._Q is None:
            s, dense = self.method.stages, self.method.dense
            for i, (row, c) in enumerate(zip(dense.A, dense.c, strict=True), start=s):
                is_end = i == s and not self.method.fsal
                self.K[i] = (
                    self.f_end
                    if is_end
                    else self.f(self.t + c * self.h, self.y + self.h * (row[:i] @ self.K[:i]))
                )
            self._Q = self.K.T @ dense.P
        return self._Q


def take_step(
    method: Tableau, problem: Problem, f: Counted, t: float, y: Array, t_end: float, f_start: Array
) -> Step:
    """One step of an explicit Runge-Kutta method from (t, y) to t_end, `f_start` being f(t, y)."""
    h = t_end - t
    K = np.empty((method.stages + len(method.dense.c), len(y)))
    K[0] = f_start
    for i in range(1, method.stages):
        K[i] = f(t + method.c[i] * h, y + h * (method.A[i, :i] @ K[:i]))
    y_end = problem.project(y + h * (method.b @ K[: method.stages]))
    return Step(method, problem, f, t, h, y, y_end, K, t_end)


class Interpolant:
    """Continuous solution over consecutive steps: (m,) times [s] -> (m, ndim) states."""

    def __init__(self, steps: Sequence[Step]) -> None:
        self.steps = steps
        self.sign = 1.0 if steps and steps[0].h > 0 else -1.0
        self.starts = np.array([step.t for step in steps])

    def __call__(self, t: ArrayLike) -> Array:
        """States at times t [s]; raises EngineError outside the solution."""
        times = np.atleast_1d(np.asarray(t, dtype=np.float64))
        first, last = (self.steps[0].t, self.steps[-1].t_end) if self.steps else (np.nan, np.nan)
        outside = ~((self.sign * times >= self.sign * first) & (self.sign * times <= self.sign * last))
        if outside.any():
            raise EngineError(f"{times[outside][0]} s is outside the solution, {first} s to {last} s")
        at = np.searchsorted(self.sign * self.starts, self.sign * times, side="right") - 1
        parts = [self.steps[i] for i in at]
        return np.array([part.at((x - part.t) / part.h) for part, x in zip(parts, times, strict=True)])
