"""The front door of integration: one function for every method, own or foreign."""

import time
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from ..errors import EngineError
from .control import AdaptiveSteps, End, FixedSteps, steps_for
from .events import Crossing, Event, Watch
from .handed import handed
from .peers import PEERS, solve_by_peer
from .problems import Problem
from .solution import Occurrence, Solution, Stats, Status
from .steps import Counted, Interpolant, Step
from .tableau import EPS, Array, Tableau
from .tableaus import tableau_of

ACCUMULATION = 1e-8
"""A jump that recurs within this fraction of the time span has come to rest."""


def solve(
    problem: Problem,
    t_span: tuple[float, float],
    y0: ArrayLike,
    *,
    method: str | Tableau = "dopri5",
    step: float | None = None,
    rtol: float | None = None,
    atol: float | Array | None = None,
    t_eval: ArrayLike | None = None,
    events: Sequence[Event] = (),
    dense: bool = False,
    error: bool = False,
    max_steps: int = 10_000_000,
) -> Solution:
    """Integrate an initial value problem.

    A `Smooth.problem` is integrated forward by its compiled loops, a hundred times as fast as step by step,
    where there are no events, no `dense` and no function that controls, and for a tolerance where `t_eval` is
    given and prescribed motion is constant.

    Args:
        problem: the right-hand side.
        t_span: first and last time [s]; the last may be the earlier one.
        y0: state at the first time, shape (ndim,).
        method: a name of `TABLEAUS`, a tableau, or a foreign solver: "scipy:DOP853" and SciPy's others, or
            "torch:dopri5" and torchdiffeq's others (extra `torch`; its rk4 is the 3/8 rule).
        step: fixed step [s]; the last one is cut to end the span.
        rtol: relative tolerance of a step; equals `atol` where only that is given. Both are 1e-6 by default.
        atol: absolute tolerance of a step, scalar or shape (ndim,); equals `rtol` where only that is given.
        t_eval: times of the output [s], in the order of integration, inside the span; the ends of all steps
            when None.
        events: zero crossings to locate, to stop at, or to jump at.
        dense: keep the continuous solution as `Solution.interpolant`.
        error: estimate the global error: by extrapolation from half the step (Hairer, Norsett & Wanner I,
            II.4) or from a hundredth of the tolerances; its cost is in `Solution.error_stats`.
        max_steps: give up after so many; compiled loops count those that are done again, too.

    Raises:
        EngineError: contradictory or unusable arguments. A failure underway raises nothing: the solution
            tells it in `status` and `message` and keeps what was computed.
    """
    y0 = np.array(y0, dtype=np.float64)
    span = (float(t_span[0]), float(t_span[1]))
    times = checked_times(t_eval, span)
    if y0.shape != (problem.ndim,):
        raise EngineError(f"y0 has shape {y0.shape}, the problem needs ({problem.ndim},)")
    if not np.all(np.isfinite(y0)):
        raise EngineError(
            f"y0 is not finite: component {np.flatnonzero(~np.isfinite(y0))[0]} is not a number"
        )
    if isinstance(method, str) and method.partition(":")[0] in PEERS:
        if error or max_steps != 10_000_000:
            raise EngineError(f"error and max_steps are for Pantograph's own methods, not for {method}")
        return solve_by_peer(
            problem,
            span,
            y0,
            method,
            step=step,
            rtol=rtol,
            atol=atol,
            times=times,
            events=events,
            dense=dense,
        )
    foreign = [f"{peer}:{name}" for peer, names in PEERS.items() for name in names]
    tableau = tableau_of(method, where="solve", others=foreign)
    control = steps_for(tableau, span, step=step, rtol=rtol, atol=atol)
    solution = _run(problem, span, tableau, control, events, max_steps, y0, times, dense=dense)
    if not error:
        return solution
    finer = _run(problem, span, tableau, control.tighter(), events, max_steps, y0, solution.t)
    return _with_error(solution, finer, tableau.order if step is not None else None)


def checked_times(t_eval: ArrayLike | None, span: tuple[float, float]) -> Array | None:
    """The output times as an array inside the span; rounding at its ends is forgiven.

    Raises:
        EngineError: the span is empty, or a time is outside it or out of order.
    """
    t0, t1 = span
    if not (np.isfinite(t0) and np.isfinite(t1)) or t0 == t1:
        raise EngineError(f"t_span = ({t0}, {t1}) is no span of time: give two different, finite times")
    if t_eval is None:
        return None
    times = np.atleast_1d(np.array(t_eval, dtype=np.float64))
    sign = np.sign(t1 - t0)
    slack = 4 * EPS * max(abs(t0), abs(t1))
    inside = (sign * (times - t0) >= -slack) & (sign * (times - t1) <= slack)
    if not inside.all():
        raise EngineError(f"t_eval has {times[~inside][0]} s, outside the span from {t0} s to {t1} s")
    if np.any(sign * np.diff(times) < 0):
        order = "ascend" if sign > 0 else "descend"
        raise EngineError(f"t_eval must {order}, as the span from {t0} s to {t1} s does")
    return np.clip(times, min(span), max(span))


def _run(
    problem: Problem,
    span: tuple[float, float],
    method: Tableau,
    control: FixedSteps | AdaptiveSteps,
    events: Sequence[Event],
    max_steps: int,
    y0: Array,
    times: Array | None,
    *,
    dense: bool = False,
) -> Solution:
    """By the problem's compiled loops, or step by step where these cannot do it."""
    if not events and not dense:
        whole = handed(problem, span, method, control, y0, times, max_steps)
        if whole is not None:
            return whole
    return _Loop(problem, span, method, control, events, max_steps).run(y0, times, dense=dense)


def _with_error(solution: Solution, finer: Solution, order: int | None) -> Solution:
    """Attach the difference to a finer solution at the same times.

    Of steps h and h/2, y_h - y = (y_h - y_(h/2)) 2^p / (2^p - 1) to leading order; a solution to a hundredth
    of the tolerance stands for the exact one.
    """
    scale = 1.0 if order is None else 2.0**order / (2.0**order - 1)
    estimate = np.full_like(solution.y, np.nan)
    n = min(len(finer.t), len(solution.t))
    estimate[:n] = scale * (solution.y[:n] - finer.y[:n])
    # Where a jump happens either side of it may be meant.
    estimate[np.isin(solution.t, [o.t for o in solution.events if o.y_after is not o.y])] = np.nan
    if solution.status == finer.status == Status.EVENT and len(solution.t):
        estimate[n:] = scale * (solution.events[-1].y - finer.events[-1].y)
    return replace(solution, error=estimate, error_stats=finer.stats)


class _Loop:
    """The loop over steps, with output, events and failures; the length of steps is up to `control`."""

    def __init__(
        self,
        problem: Problem,
        span: tuple[float, float],
        method: Tableau,
        control: FixedSteps | AdaptiveSteps,
        events: Sequence[Event],
        max_steps: int,
    ) -> None:
        self.problem, self.span, self.method, self.control = problem, span, method, control
        self.events, self.watch, self.max_steps = events, Watch(events), max_steps
        self.sign = 1.0 if span[1] > span[0] else -1.0
        self.f = Counted(problem.f)
        self.steps = 0
        self.occurrences: list[Occurrence] = []
        self.kept: list[Step] = []
        self.t_out: list[float] = []
        self.y_out: list[Array] = []
        self.times: Array | None = None

    def run(self, y0: Array, times: Array | None, *, dense: bool = False) -> Solution:
        began = time.perf_counter()
        self.times = times
        with np.errstate(over="ignore", invalid="ignore"):
            end = self._integrate(self.problem.project(y0), dense=dense)
        return Solution(
            t=np.array(self.t_out),
            y=np.array(self.y_out).reshape(len(self.y_out), self.problem.ndim),
            status=end.status,
            stats=Stats(self.f.calls, self.steps, self.control.rejected, time.perf_counter() - began),
            events=tuple(self.occurrences),
            message=end.message,
            interpolant=Interpolant(self.kept) if dense else None,
        )

    def _integrate(self, y: Array, *, dense: bool) -> End:
        t, t_last = self.span
        if self.times is None or self.times[:1] == t:
            self._emit(t, y)
        f0 = self.f(t, y)
        if not np.all(np.isfinite(f0)):
            bad = np.flatnonzero(~np.isfinite(f0))[0]
            return End(Status.DIVERGED, f"component {bad} of f is not finite at the start, t = {t:.9g} s")
        while self.sign * (t_last - t) > 0:
            if self.steps >= self.max_steps:
                return End(Status.TOO_MANY_STEPS, f"{self.max_steps} steps reached only t = {t:.9g} s")
            step = self.control.step(self.method, self.problem, self.f, t, y, f0)
            if isinstance(step, End):
                return step
            self.steps += 1
            happened = [self._occurrence(c, step) for c in self.watch.crossings(step)] if self.events else []
            self.occurrences += happened
            stop = happened[-1] if happened and self.events[happened[-1].event].interrupts else None
            self._output(step, step.t_end if stop is None else stop.t)
            if dense:
                step.coefficients()
                self.kept.append(step)
            if stop is None:
                t, y = step.t_end, step.y_end
                f0 = step.f_end if self.sign * (t_last - t) > 0 else f0
                continue
            if end := self._end_at(stop):
                return end
            t, y = stop.t, stop.y_after
            self.watch.restart()
            f0 = self.f(t, y)
            if self.times is None:
                self._emit(t, y)
        return End(Status.FINISHED, f"reached t = {t_last:.9g} s")

    def _occurrence(self, crossing: Crossing, step: Step) -> Occurrence:
        event = self.events[crossing.event]
        t, y = step.t + crossing.theta * step.h, step.at(crossing.theta)
        after = y if event.jump is None else np.array(event.jump(t, y), dtype=np.float64)
        return Occurrence(crossing.event, event.name or f"event {crossing.event}", t, y, after)

    def _end_at(self, stop: Occurrence) -> End | None:
        """The end of the integration when this occurrence means one."""
        if self.events[stop.event].terminal:
            return End(Status.EVENT, f"{stop.name} at t = {stop.t:.9g} s")
        before = [o.t for o in self.occurrences[:-1] if o.event == stop.event]
        if before and abs(stop.t - before[-1]) < ACCUMULATION * abs(self.span[1] - self.span[0]):
            return End(
                Status.ACCUMULATED, f"{stop.name} recurs ever faster: at rest from t = {stop.t:.9g} s on"
            )
        return None

    def _output(self, step: Step, t_end: float) -> None:
        if self.times is None:
            self._emit(t_end, step.at((t_end - step.t) / step.h))
            return
        while (n := len(self.t_out)) < len(self.times) and self.sign * self.times[n] <= self.sign * t_end:
            self._emit(self.times[n], step.at((self.times[n] - step.t) / step.h))

    def _emit(self, t: float, y: Array) -> None:
        self.t_out.append(float(t))
        self.y_out.append(y)
