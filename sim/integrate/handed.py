"""Integrations handed to a problem's own compiled loops, where nothing has to be looked at underway."""

import time
from typing import NamedTuple, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from .control import AdaptiveSteps, End, FixedSteps, initial_step
from .problems import Problem
from .solution import Solution, Stats, Status
from .steps import Counted, take_step
from .tableau import EPS, Array, Tableau

CHUNK = 4096
"""Steps of one length taken by one call."""


class Followed(NamedTuple):
    """What `CompiledProblem.follow` comes to: states (n, ndim) at its times, as far as `reached` [s]."""

    y: Array
    reached: float
    status: Status
    evaluations: int
    steps: int
    rejected: int


@runtime_checkable
class CompiledProblem(Problem, Protocol):
    """A problem with compiled loops; both answer None where theirs cannot do it.

    Equal steps give equal results to rounding; on a manifold, FSAL methods to their own error.
    """

    def march(
        self, method: Tableau, t: float, y: Array, step: float, steps: int, /
    ) -> tuple[Array, int] | None:
        """States (steps + 1, ndim) at the ends of equal steps from (t, y), and the evaluations they took."""

    def follow(
        self, method: Tableau, times: Array, y: Array, rtol: float, atol: Array, h: float, most: int, /
    ) -> Followed | None:
        """States at two or more ascending `times` from y at the first, first step `h`, `most` steps."""


def handed(
    problem: Problem,
    span: tuple[float, float],
    method: Tableau,
    control: FixedSteps | AdaptiveSteps,
    y0: Array,
    times: Array | None,
    max_steps: int,
) -> Solution | None:
    """The solution by the problem's compiled loops; None where it has none that can do this."""
    if not isinstance(problem, CompiledProblem) or span[0] > span[1]:
        return None
    begun = time.perf_counter()
    y = problem.project(y0)
    if isinstance(control, FixedSteps):
        found = _marched(problem, method, control.grid, y, times, max_steps)
    else:
        found = None if times is None else _followed(problem, span, method, control, y, times, max_steps)
    if found is None:
        return None
    t, states, end, cost = found
    stats = Stats(*cost, time.perf_counter() - begun)
    return Solution(t=t, y=states, status=end.status, stats=stats, events=(), message=end.message)


_Found = tuple[Array, Array, End, tuple[int, int, int]]


def _marched(
    problem: CompiledProblem, method: Tableau, grid: Array, y: Array, times: Array | None, max_steps: int
) -> _Found | None:
    """Over the grid; what `times` has between its points by the method's continuous extension."""
    last = min(len(grid) - 1, max_steps)
    wanted = np.arange(last + 1) if times is None else _rows(grid, times)
    needed = np.unique(wanted)
    states, evaluations, done = np.full((len(needed), len(y)), np.nan), 0, 0
    end = End(Status.FINISHED, f"reached t = {grid[-1]:.9g} s")
    if last < len(grid) - 1:
        end = End(Status.TOO_MANY_STEPS, f"{max_steps} steps reached only t = {grid[last]:.9g} s")
    for first, count in _pieces(grid[: last + 1]):
        step = (grid[first + count] - grid[first]) / count
        path = problem.march(method, float(grid[first]), y, float(step), count)
        if path is None:
            return None
        evaluations += path[1]
        sound = np.isfinite(path[0]).all(axis=1)
        good = count + 1 if sound.all() else int(np.argmin(sound))
        here = (needed >= first) & (needed < first + good)
        states[here] = path[0][needed[here] - first]
        done, y = first + good - 1, path[0][good - 1]
        if good <= count:
            bad = np.flatnonzero(~np.isfinite(path[0][good]))[0]
            end = End(
                Status.DIVERGED, f"component {bad} of y is not finite at t = {grid[first + good]:.9g} s"
            )
            break
    f = Counted(problem.f)
    if times is None:
        return grid[: done + 1].copy(), states[: done + 1], end, (evaluations, done, 0)
    kept = int(np.searchsorted(times, grid[done] * (1 + 4 * EPS * np.sign(grid[done])), "right"))
    out = states[np.searchsorted(needed, wanted[:kept])]
    between = np.flatnonzero(~_near(times[:kept], grid[wanted[:kept]]))
    for k in np.unique(wanted[between]):
        t, y = float(grid[k]), states[np.searchsorted(needed, k)]
        part = take_step(method, problem, f, t, y, float(grid[k + 1]), f(t, y))
        for i in between[wanted[between] == k]:
            out[i] = part.at((times[i] - t) / part.h)
    return times[:kept].copy(), out, end, (evaluations + f.calls, done, 0)


def _near(times: Array, points: Array) -> NDArray[np.bool_]:
    near: NDArray[np.bool_] = np.abs(times - points) <= 4 * EPS * np.abs(times)
    return near


def _rows(grid: Array, times: Array) -> Array:
    """For each time the index of the point of the grid that it is, or of the last one before it."""
    before = np.clip(np.searchsorted(grid, times, "right") - 1, 0, len(grid) - 1)
    after = np.minimum(before + 1, len(grid) - 1)
    return np.where(_near(times, grid[after]), after, before)


def _pieces(grid: Array) -> list[tuple[int, int]]:
    """First step and number of steps of each stretch of equal steps, none longer than `CHUNK`."""
    lengths = np.diff(grid)
    rounding = 8 * EPS * np.abs(grid).max()
    edges = np.flatnonzero(np.abs(np.diff(lengths)) > rounding) + 1
    starts = np.unique(np.concatenate([[0], edges, np.arange(0, len(lengths), CHUNK)])).astype(int)
    return list(zip(starts.tolist(), np.diff(np.append(starts, len(lengths))).tolist(), strict=True))


def _followed(
    problem: CompiledProblem,
    span: tuple[float, float],
    method: Tableau,
    control: AdaptiveSteps,
    y: Array,
    times: Array,
    max_steps: int,
) -> _Found | None:
    """To the tolerance, recorded at `times`."""
    f, (t0, t1) = Counted(problem.f), span
    f0 = f(t0, y)
    if not np.isfinite(f0).all():
        return None  # who steps by hand says where
    k = method.error_exponent or 1
    h = initial_step(f, t0, y, f0, t1 - t0, k, control.rtol, control.atol)
    at = np.unique(np.concatenate([[t0], times, [t1]]))
    path = problem.follow(method, at, y, control.rtol, np.broadcast_to(control.atol, y.shape), h, max_steps)
    if path is None:
        return None
    kept = len(times)
    if path.status is not Status.FINISHED:
        kept = int(np.searchsorted(times, path.reached, "right"))
    messages = {
        Status.FINISHED: f"reached t = {t1:.9g} s",
        Status.TOO_MANY_STEPS: f"{max_steps} steps, {path.rejected} of them done again, reached only "
        f"t = {path.reached:.9g} s",
        Status.STEP_TOO_SMALL: f"at t = {path.reached:.9g} s the tolerance asks for steps below the "
        "resolution of time: a singularity, a discontinuity or a tolerance that doubles cannot meet",
        Status.DIVERGED: f"y or f is not finite after t = {path.reached:.9g} s",
    }
    cost = (path.evaluations + f.calls, path.steps, path.rejected)
    return (
        times[:kept].copy(),
        path.y[np.searchsorted(at, times[:kept])],
        End(path.status, messages[path.status]),
        cost,
    )
