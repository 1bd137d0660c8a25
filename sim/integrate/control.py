"""Choice of the steps: a fixed grid, or lengths that follow a tolerance."""

import math
from dataclasses import dataclass, field

import numpy as np

from ..errors import EngineError
from .problems import Problem
from .solution import Status
from .steps import Counted, Step, take_step
from .tableau import EPS, Array, Tableau
from .tableaus import TABLEAUS

SAFETY = 0.9
"""Aim at this fraction of the step that would just meet the tolerance."""
SHRINK, GROW = 0.2, 8.0
"""Limits of the change from one step to the next."""


@dataclass(frozen=True)
class End:
    """How and why an integration ended, in words."""

    status: Status
    message: str


class FixedSteps:
    """Steps from one point of a grid to the next.

    Attributes:
        grid: ends of the steps [s], monotone, shape (n + 1,).
    """

    rejected = 0

    def __init__(self, grid: Array) -> None:
        self.grid = grid
        self.sign = 1.0 if grid[-1] > grid[0] else -1.0
        self._ascending = self.sign * grid

    def tighter(self) -> "FixedSteps":
        """Half the steps."""
        halves = (self.grid[:-1] + self.grid[1:]) / 2
        return FixedSteps(np.sort(np.concatenate([self.grid, halves]))[:: int(self.sign)])

    def step(
        self, method: Tableau, problem: Problem, f: Counted, t: float, y: Array, f0: Array
    ) -> Step | End:
        """The step to the next point of the grid, or why it failed."""
        following = np.searchsorted(self._ascending, self.sign * t + 4 * EPS * abs(t), side="right")
        step = take_step(method, problem, f, t, y, float(self.grid[following]), f0)
        return step if np.all(np.isfinite(step.y_end)) else diverged(step)


@dataclass
class AdaptiveSteps:
    """Steps whose estimated error meets a tolerance, with proportional-integral control of their length.

    h_new = h * 0.9 * err^(-0.7 / k) * err_previous^(0.4 / k), with err ~ h^k the error in units of the
    tolerance (Gustafsson; Hairer & Wanner II, IV.2).
    """

    t_end: float
    rtol: float
    atol: Array
    rejected: int = 0
    h: float = 0.0
    previous: float = field(default=1.0, repr=False)

    def tighter(self) -> "AdaptiveSteps":
        """A hundredth of the tolerances, not below what doubles resolve."""
        return AdaptiveSteps(self.t_end, max(self.rtol / 100, 100 * EPS), self.atol / 100)

    def step(
        self, method: Tableau, problem: Problem, f: Counted, t: float, y: Array, f0: Array
    ) -> Step | End:
        """The longest step that the tolerance allows, or why there is none."""
        k = method.error_exponent or 1
        if self.h == 0:
            self.h = initial_step(f, t, y, f0, self.t_end - t, k, self.rtol, self.atol)
        grow = GROW
        while True:
            left = self.t_end - t
            # Stretch or halve the last steps rather than leave a sliver.
            h = self.h if abs(left) > 2 * self.h else abs(left) / (1 if abs(left) <= 1.01 * self.h else 2)
            t_end = self.t_end if h == abs(left) else t + float(np.copysign(h, left))
            step = take_step(method, problem, f, t, y, t_end, f0)
            error = error_norm(step, self.rtol, self.atol)
            if error <= 1:
                error = max(error, 1e-10)
                factor = SAFETY * error ** (-0.7 / k) * self.previous ** (0.4 / k)
                self.h, self.previous = h * min(max(factor, SHRINK), grow), error
                return step
            self.rejected += 1
            finite = np.isfinite(error)
            self.h = h * (min(max(SAFETY * error ** (-1 / k), SHRINK), SAFETY) if finite else 0.1)
            grow = 1.0
            if self.h < 10 * np.spacing(abs(t)):
                if not finite:
                    return diverged(step)
                worst = int(np.argmax(np.abs(step.f_start) / (self.atol + self.rtol * np.abs(y))))
                return End(
                    Status.STEP_TOO_SMALL,
                    f"at t = {t:.9g} s the tolerance asks for steps below the resolution of time; component "
                    f"{worst} changes fastest ({step.f_start[worst]:.3g} /s): a singularity, a discontinuity "
                    "or a tolerance that doubles cannot meet",
                )


def diverged(step: Step) -> End:
    """The failure of a step whose state or slopes are not finite, by the first component that went."""
    method = step.method
    for c, slopes in zip(method.c, step.K[: method.stages], strict=True):
        if len(bad := np.flatnonzero(~np.isfinite(slopes))):
            return End(
                Status.DIVERGED, f"component {bad[0]} of f is not finite at t = {step.t + c * step.h:.9g} s"
            )
    bad = np.flatnonzero(~np.isfinite(step.y_end))
    where = f"component {bad[0]} of the state" if len(bad) else "the error estimate"
    return End(Status.DIVERGED, f"{where} is not finite at t = {step.t_end:.9g} s")


def error_norm(step: Step, rtol: float, atol: Array) -> float:
    """Estimated error of a step in units of the tolerance, root mean square over the components.

    Source: Hairer, Norsett & Wanner I, eq. (4.11), and II.10 for the combined estimate of DOP853.
    """
    method, K = step.method, step.K[: step.method.stages]
    scale = atol + rtol * np.maximum(np.abs(step.y), np.abs(step.y_end))
    assert method.b_error is not None
    high = _rms(step.h * (method.b_error @ K) / scale)
    if method.b_error_low is None or high == 0:
        return high
    low = _rms(step.h * (method.b_error_low @ K) / scale)
    return high * high / float(np.hypot(high, 0.1 * low))


def _rms(x: Array) -> float:
    return float(np.linalg.norm(x)) / float(np.sqrt(len(x)))


def initial_step(
    f: Counted, t: float, y: Array, f0: Array, span: float, k: int, rtol: float, atol: Array
) -> float:
    """Length of the first step, from the sizes of y, y' and y'' (Hairer, Norsett & Wanner I, II.4, p. 169).

    Args:
        f: right-hand side; one evaluation is spent.
        t: start [s].
        y: state there, shape (ndim,).
        f0: f(t, y).
        span: signed length of the time span [s], not exceeded.
        k: the error of a step goes with h^k.
        rtol: relative tolerance.
        atol: absolute tolerance, shape (ndim,) or scalar.

    Returns:
        A positive length [s].
    """
    scale = atol + rtol * np.abs(y)
    d0, d1 = _rms(y / scale), _rms(f0 / scale)
    h0 = min(1e-6 if d0 < 1e-5 or d1 < 1e-5 else 0.01 * d0 / d1, abs(span))
    signed = float(np.copysign(h0, span))
    d2 = _rms((f(t + signed, y + signed * f0) - f0) / scale) / h0
    steepest = max(d1, d2)
    h1 = max(1e-6, 1e-3 * h0) if steepest <= 1e-15 else (0.01 / steepest) ** (1 / k)
    return float(min(100 * h0, h1, abs(span)))


def steps_for(
    method: Tableau,
    span: tuple[float, float],
    *,
    step: float | None,
    rtol: float | None,
    atol: float | Array | None,
) -> FixedSteps | AdaptiveSteps:
    """Step control from the arguments of `solve`.

    Raises:
        EngineError: a step and a tolerance, a tolerance without an error estimate, or unusable values.
    """
    if step is not None:
        if rtol is not None or atol is not None:
            raise EngineError(
                f"step={step} asks for fixed steps, rtol={rtol}, atol={atol} for steps by tolerance: give one"
            )
        return FixedSteps(fixed_grid(span, step))
    if not method.adaptive:
        pairs = ", ".join(name for name, tableau in TABLEAUS.items() if tableau.adaptive)
        raise EngineError(
            f"{method.name} does not estimate its error, so it cannot follow a tolerance: "
            f"give step=0.001 (seconds), or take one of {pairs}"
        )
    rtol, absolute = tolerances(rtol, atol)
    return AdaptiveSteps(span[1], rtol, absolute)


def tolerances(rtol: float | None, atol: float | Array | None) -> tuple[float, Array]:
    """Both tolerances from what was given: a missing one equals the other, 1e-6 where neither is.

    Raises:
        EngineError: `atol` is not positive, or `rtol` negative or finer than doubles.
    """
    if rtol is None:
        rtol = 1e-6 if atol is None else float(np.min(atol))
    absolute = np.asarray(rtol if atol is None else atol, dtype=np.float64)
    if not (0 <= rtol < math.inf and absolute.min() > 0 and absolute.max() < math.inf):
        raise EngineError(f"rtol={rtol}, atol={atol}: atol must be positive, rtol not negative, both finite")
    if 0 < rtol < 10 * EPS:
        raise EngineError(f"rtol={rtol} is below what doubles resolve: give at least {10 * EPS:.1e}")
    return rtol, absolute


def length_of_time(name: str, value: float) -> float:
    """`value`, a positive number of seconds.

    Raises:
        EngineError: it is none.
    """
    if not (math.isfinite(value) and value > 0):
        raise EngineError(f"{name}={value} is not a length of time: give a positive number of seconds")
    return float(value)


def fixed_grid(span: tuple[float, float], step: float) -> Array:
    """Ends of fixed steps over a span, both ends of it included; the last step may be shorter.

    Raises:
        EngineError: the step is not a positive number.
    """
    t0, t1 = span
    step = length_of_time("step", step)
    count = max(1, int(np.ceil(abs(t1 - t0) / step - 1e-9)))
    grid = t0 + np.copysign(step, t1 - t0) * np.arange(count + 1)
    grid[-1] = t1
    return np.asarray(grid)
