"""The methods of a report, one after another, within the time there is."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeAlias

from .work_precision import Interrupted, Motion, Row, Runner, sweep
from .work_runners import FOREIGN

Error: TypeAlias = Callable[[Motion], float]
Apart: TypeAlias = Callable[[Motion, Motion], float]


@dataclass(frozen=True)
class Work:
    """What a report may do.

    Attributes:
        engines: asked for.
        budget_s: processor time of a run [s].
        begun: when it began (`time.perf_counter`) [s].
        limit_s: time on the clock after which no run begins [s].
        progress: told what is at work.
    """

    engines: Sequence[str]
    budget_s: float
    begun: float
    limit_s: float
    progress: Callable[[str], None] | None

    @property
    def until(self) -> float:
        """When to begin no more runs."""
        return self.begun + self.limit_s

    @property
    def half(self) -> float:
        """When to refine references no more."""
        return self.begun + self.limit_s / 2

    def tell(self, what: str) -> None:
        """Say what is at work."""
        if self.progress is not None:
            self.progress(what)

    def sweeps(
        self, found: Sequence[Runner], measures: Callable[[Runner], tuple[Error, Apart, float]]
    ) -> tuple[tuple[Row, ...], tuple[str, ...], str]:
        """Rows of all runners, notes on what there was no time for, and the report's status.

        `measures` gives for a runner the error of a motion, what lies between two, and where errors end.
        """
        rows: list[Row] = []
        for n, runner in enumerate(found):
            if time.perf_counter() > self.until:
                return tuple(rows), (_left("no time was left for", found[n:]),), "done"
            self.tell(f"{runner.engine} {runner.method} by {runner.knob} ({n + 1} of {len(found)})")
            error, apart, floor = measures(runner)
            try:
                rows += sweep(runner, error, apart, floor=floor, budget_s=self.budget_s, until=self.until)
            except Interrupted as stop:
                rows += stop.rows
                notes = (_left("interrupted during or before", found[n:]),)
                return tuple(rows), notes, "interrupted"
        return tuple(rows), (), "done"


def _left(why: str, found: Sequence[Runner]) -> str:
    """What was left out, by engine."""
    names: dict[str, list[str]] = {}
    for runner in found:
        names.setdefault(runner.engine, []).append(
            runner.method
            + (" (adaptive)" if runner.knob == "tolerance" and runner.engine == "smooth" else "")
        )
    return f"{why} " + "; ".join(f"{engine} {', '.join(methods)}" for engine, methods in names.items())


def physics(engine: str) -> str:
    """The engine whose equations an engine's rows are about: foreign solvers get the smooth one's."""
    return "smooth" if engine in FOREIGN else engine
