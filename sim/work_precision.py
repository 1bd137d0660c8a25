"""What does an error cost? Engines and methods over steps and tolerances, against a far tighter reference."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from .accuracy import difference

Array = NDArray[np.float64]

TOLERANCES = tuple(10.0 ** -np.arange(3, 14))
ROUNDING = 1e-8
"""An error below this that stops falling is taken for rounding."""
SURE = 1e-3
"""Up to here [rad, m] a reference says where a motion goes."""


@dataclass(frozen=True, eq=False)
class Case:
    """Motion of a model from an initial state under constant controls.

    Attributes:
        name: in tables and figures.
        model: compiled model; what it has is what is simulated.
        q, v: initial state, shapes (nq,), (nv,).
        duration: [s].
        ctrl: constant controls, shape (nu,); zero when None.
        frames: the error is looked at after this many equal spans.
        scale: size of the motion [rad, m]; absolute tolerances are relative to it.
    """

    name: str
    model: mujoco.MjModel
    q: Array
    v: Array
    duration: float
    ctrl: Array | None = None
    frames: int = 50
    scale: float = 1.0

    @property
    def times(self) -> Array:
        """Times of the frames [s], the start included, shape (frames + 1,)."""
        return np.linspace(0.0, self.duration, self.frames + 1)


@dataclass(frozen=True, eq=False)
class Motion:
    """States at the frames, shapes (frames + 1, nq) and (frames + 1, nv), and what they cost."""

    q: Array
    v: Array
    evaluations: int

    @property
    def finite(self) -> bool:
        """The motion reached its end."""
        return bool(np.isfinite(self.q).all() and np.isfinite(self.v).all())


class Runner(Protocol):
    """One method of one engine, by steps [s] or by tolerances."""

    @property
    def engine(self) -> str:
        """The engine's name."""
        ...

    @property
    def method(self) -> str:
        """The method's name."""
        ...

    @property
    def knob(self) -> str:
        """What is turned: "step" or "tolerance"."""
        ...

    @property
    def order(self) -> int:
        """Power of the setting that errors go with."""
        ...

    def settings(self) -> Iterable[float]:
        """Steps or tolerances from coarse to fine."""
        ...

    def run(self, setting: float) -> Motion:
        """The motion of the case at that step or tolerance."""
        ...


@dataclass(frozen=True)
class Row:
    """One point of the table.

    Attributes:
        engine, method, knob, setting: what ran; `setting` is a step [s] or a tolerance.
        error: global error; NaN where the motion did not reach its end.
        cpu_s: processor time of a run, the least of several [s].
        first_s: time of the first run of this method on the clock [s]: it includes compilation.
        evaluations: of the equations of motion.
        estimate: of the error, from this method's own next finer run (of the finest: next coarser), without
            the reference: by extrapolation for steps, as a difference for tolerances.
    """

    engine: str
    method: str
    knob: str
    setting: float
    error: float
    cpu_s: float
    first_s: float
    evaluations: int
    estimate: float = math.nan


@dataclass(frozen=True, eq=False)
class Reference:
    """The motion that errors are measured against.

    Attributes:
        motion: states at the frames.
        uncertainty: its own error: largest difference to another method's at its tightest.
        source: what computed it, in words.
        sure_until: when that difference first exceeds `SURE` [s]; infinite when it never does.
    """

    motion: Motion
    uncertainty: float
    source: str
    sure_until: float = math.inf


def distances(case: Case, motion: Motion, other: Motion) -> Array:
    """Largest difference of any rotation [rad] or translation [m] of a joint at each frame."""
    return np.maximum(*difference(case.model, other.q, motion.q))


def trajectory_error(case: Case, motion: Motion, reference: Motion) -> float:
    """Largest difference over all frames of any rotation [rad] or translation [m] of a joint."""
    if not motion.finite:
        return float("nan")
    return float(distances(case, motion, reference).max(initial=0.0))


def sure_until(case: Case, motion: Motion, other: Motion) -> float:
    """When two motions are first more than `SURE` apart [s]; infinite when they never are."""
    apart = distances(case, motion, other) > SURE
    return float(case.times[np.argmax(apart)]) if apart.any() else math.inf


class Interrupted(KeyboardInterrupt):
    """A KeyboardInterrupt in the middle of a sweep; `rows` is what was measured until then."""

    def __init__(self, rows: list[Row]) -> None:
        super().__init__()
        self.rows = rows


def sweep(
    runner: Runner,
    error: Callable[[Motion], float],
    apart: Callable[[Motion, Motion], float],
    *,
    floor: float,
    budget_s: float,
    until: float = math.inf,
) -> list[Row]:
    """Rows of one method from coarse to fine; `apart` measures two motions as `error` does one.

    They end where the error is at `floor` or no longer falls by rounding, where a run costs `budget_s` or all
    together four times that, and where one fails that is finer than one that did not; but dear ones not
    before there are two, whose difference is an estimate. No run begins after `until` (`perf_counter`).
    """
    rows: list[Row] = []
    motions: list[Motion] = []
    stalled, total = 0, 0.0

    def estimated() -> list[Row]:
        found = _estimates(runner, motions, apart) if rows else []
        return [replace(row, estimate=estimate) for row, estimate in zip(rows, found, strict=True)]

    try:
        for setting in runner.settings():
            if time.perf_counter() > until:
                break
            row, motion, spent = _measured(runner, setting, rows[0].first_s if rows else None, budget_s)
            row = replace(row, error=error(motion))
            total += spent
            best = min((r.error for r in rows if np.isfinite(r.error)), default=np.inf)
            rows, motions = [*rows, row], [*motions, motion]
            stalled = stalled + 1 if best < ROUNDING and row.error >= best else 0
            failed = not np.isfinite(row.error) and np.isfinite(best)
            dear = len(rows) > 1 and (row.cpu_s > budget_s or total > 4 * budget_s)
            if dear or row.error < floor or stalled == 2 or failed:
                break
    except KeyboardInterrupt as stop:
        motions = motions[: len(rows)]
        raise Interrupted(estimated()) from stop
    return estimated()


def _measured(
    runner: Runner, setting: float, first_s: float | None, budget_s: float
) -> tuple[Row, Motion, float]:
    """A row without its error, the motion, and the processor time that all its runs took [s]."""
    wall = time.perf_counter()
    motion, cpu = _timed(runner, setting)
    if first_s is None:
        first_s = time.perf_counter() - wall
        motion, cpu = _timed(runner, setting)
    spent = cpu
    for _ in range(4):
        if spent > budget_s / 4:
            break
        again = _timed(runner, setting)[1]
        cpu, spent = min(cpu, again), spent + again
    nan = float("nan")
    row = Row(runner.engine, runner.method, runner.knob, setting, nan, cpu, first_s, motion.evaluations)
    return row, motion, spent


def _estimates(
    runner: Runner, motions: Sequence[Motion], apart: Callable[[Motion, Motion], float]
) -> list[float]:
    """Error of each motion from its finer neighbour, of the last from its coarser one.

    With a factor r between the errors of neighbours, theirs are r / (r - 1) and 1 / (r - 1) of what lies
    between them (Hairer, Norsett, Wanner, Solving Ordinary Differential Equations I, II.4).
    """
    ratios = [(a / b) ** runner.order for a, b in pairwise(runner.settings())]
    found = [apart(a, b) * r / (r - 1.0) for (a, b), r in zip(pairwise(motions), ratios, strict=False)]
    return [*found, found[-1] / ratios[len(found) - 1] if found else math.nan]


def by_method(rows: Iterable[Row]) -> dict[tuple[str, str, str], list[Row]]:
    """Rows by (engine, method, knob), in their order."""
    found: dict[tuple[str, str, str], list[Row]] = {}
    for row in rows:
        found.setdefault((row.engine, row.method, row.knob), []).append(row)
    return found


def _timed(runner: Runner, setting: float) -> tuple[Motion, float]:
    began = time.process_time()
    motion = runner.run(setting)
    return motion, time.process_time() - began
