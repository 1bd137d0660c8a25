"""The same scene under several laws: as modelled, then disturbed, on as many processes as there are."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from multiprocessing import current_process
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ...sim.compile.program import workers
from ...sim.engines.common import place_of
from ...sim.engines.interface import Role
from ...sim.errors import PantographError
from ...sim.plan import Plan, make_plan
from ...sim.scene.schema import Scene
from ...sim.scene.schema.scene import ControllerItem
from ..gains import whole
from ..trial import Disturbance, Figures, Trial, failed, run_trial
from .disturb import Spread, disturbances
from .processes import GUARD, Crew
from .variants import PERIOD, Variant, variants

Array = NDArray[np.float64]
_AS_MODELLED = Disturbance()


@dataclass(frozen=True)
class Row:
    """One variant: figures of the undisturbed run, ``nominal``, and of the ``disturbed`` ones in order, and
    the ``period`` [s] of its samples."""

    variant: Variant
    nominal: Figures
    disturbed: tuple[Figures, ...]
    period: float

    @property
    def failed(self) -> int:
        """Disturbed runs that diverged."""
        return sum(f.status != "done" for f in self.disturbed)

    @property
    def robust(self) -> float:
        """Largest RMS error [rad, m] of all runs; infinite when one diverged."""
        return max(f.rms for f in (self.nominal, *self.disturbed))


@dataclass(frozen=True, eq=False)
class Comparison:
    """Rows in the order asked for, disturbances, and the samples of undisturbed runs by variant.

    ``unfit`` says of variants without a row why they cannot control this scene; ``uncounted`` are joints
    left to physics whose errors no figure counts, having neither keys nor a goal. A ``status`` of
    "interrupted" leaves rows of what was done of all ``asked`` runs: disturbances are those that all laws
    have met.
    """

    rows: tuple[Row, ...]
    disturbances: tuple[Disturbance, ...]
    period: float
    trials: Mapping[str, Trial]
    unfit: Mapping[str, str] = field(default_factory=dict)
    uncounted: tuple[str, ...] = ()
    status: str = "done"
    asked: int = 0

    @property
    def done(self) -> int:
        """Runs that these rows tell of."""
        return sum(1 + len(row.disturbed) for row in self.rows)


def compare(
    scene: Scene,
    laws: Sequence[str],
    *,
    sweep: Mapping[str, Sequence[Any]] | None = None,
    trials: int = 0,
    mass: float = 0.1,
    friction: float = 0.0,
    push: float = 0.2,
    start: float = 0.0,
    seed: int = 0,
    processes: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Run ``scene`` under each of ``laws``: once as modelled, ``trials`` times disturbed (the same for all).

    A disturbed machine has its masses changed by up to the part ``mass``, each body's on its own, damping and
    dry friction of its joints by up to the part ``friction``, joint forces of up to ``push`` of what its
    drives can give (or of its weight, of ideal drives) for a tenth of the scene, and starts with joints off
    by up to ``start`` in the scene's units and the same a second. ``sweep`` gives lists of parameter values:
    for every law, each combination of those that it has is a variant; "period" [s] is the controller's own. A
    law gets every word of the scene's controller that it knows. The law "ilc" is the scene's own, or ``of``,
    after ``repeats`` runs from which it learned: on each machine anew, before it is pushed.

    Joints with a goal in the scene's controller count beside tracked ones, under every law. Undisturbed runs
    are timed one after the other, those of a sweep and disturbed ones share the processors: with
    ``processes`` > 1 all are run apart from this process, by default those that can be at once. Ctrl-C leaves
    what was done, with status "interrupted". Raises PantographError for laws, words and sizes that make no
    sense, and when none of the laws fits. A script that asks for several processes needs
    ``if __name__ == "__main__":``; without, a warning says so and one process does it all.
    """
    if getattr(current_process(), "_inheriting", False):  # as multiprocessing itself asks
        raise PantographError(GUARD)
    spread = Spread(trials, mass, friction, push, start, seed)
    count = workers() if processes is None else whole("processes", processes)
    bench = _Bench(scene)
    plan = bench.plan({})
    chosen, drawn = variants(scene, laws, sweep or {}), disturbances(plan, spread)
    if processes is None and not (trials or sweep):
        count = 1
    found: dict[tuple[int, int], Trial] = {}
    unfit: dict[str, str] = {}
    total, status = len(chosen) * (1 + trials), "done"

    def take(job: _Job, result: Trial | str) -> None:
        if isinstance(result, str):
            unfit[job.variant.name] = result
        else:
            found[job.row, job.case] = result
        if progress:
            progress(len(found) + len(unfit) * (1 + trials), total)

    try:
        with Crew(min(count, total), _begin, (scene, scene._base)) as crew:
            first = [_Job(i, 0, variant, _AS_MODELLED) for i, variant in enumerate(chosen)]
            for job, result in crew.each(first, _there, bench, together=bool(sweep)):
                take(job, result)
            fit = [job for job in first if job.variant.name not in unfit]
            rest = [
                replace(job, case=k, disturbance=by) for k, by in enumerate(drawn, start=1) for job in fit
            ]
            for job, result in crew.each(rest, _there, bench):
                take(job, result)
    except KeyboardInterrupt:
        status = "interrupted"
    if not found and status == "done":
        raise PantographError("; ".join(dict.fromkeys(unfit.values())))
    assert plan.period is not None
    return Comparison(
        status=status,
        rows=_rows(chosen, found, unfit, trials, plan.period),
        disturbances=tuple(drawn[: _met(chosen, found, unfit, trials)]),
        period=plan.period,
        trials={v.name: found[i, 0] for i, v in enumerate(chosen) if (i, 0) in found},
        unfit=unfit,
        uncounted=_uncounted(plan, found),
        asked=total,
    )


def _met(
    chosen: list[Variant], found: Mapping[tuple[int, int], Trial], unfit: Mapping[str, str], trials: int
) -> int:
    """How many disturbances, the first ones, all laws that fit have met."""
    fit = [i for i, variant in enumerate(chosen) if variant.name not in unfit]
    missing = [k for k in range(1, trials + 1) if any((i, k) not in found for i in fit)]
    return missing[0] - 1 if missing else trials


def _rows(
    chosen: list[Variant],
    found: Mapping[tuple[int, int], Trial],
    unfit: Mapping[str, str],
    trials: int,
    period: float,
) -> tuple[Row, ...]:
    cases = range(1, 1 + _met(chosen, found, unfit, trials))
    return tuple(
        Row(v, found[i, 0].figures, tuple(found[i, k].figures for k in cases), v.words.get(PERIOD, period))
        for i, v in enumerate(chosen)
        if (i, 0) in found
    )


def _uncounted(plan: Plan, found: Mapping[tuple[int, int], Trial]) -> tuple[str, ...]:
    """Passive joints that count in no trial."""
    m = plan.problem.model
    counted = {name for trial in found.values() for name in trial.joints}
    names = [name_of(m, "joint", int(j)) for j in np.flatnonzero(plan.problem.roles == Role.PASSIVE)]
    return tuple(name for name in names if name not in counted)


@dataclass(frozen=True)
class _Job:
    """A run: of which row, under which disturbance, the 0th being none."""

    row: int
    case: int
    variant: Variant
    disturbance: Disturbance


class _Bench:
    """Runs jobs of a scene; plans are made once a period."""

    def __init__(self, scene: Scene) -> None:
        self.scene, self._plans = scene, dict[Any, Plan]()

    def plan(self, words: Mapping[str, Any]) -> Plan:
        """The plan of the scene, with another period where ``words`` say so."""
        period = words.get(PERIOD)
        if period not in self._plans:
            scene = self.scene
            if period is not None:
                item = (scene.controller or ControllerItem()).model_copy(update={"period": float(period)})
                scene = scene.model_copy(update={"controller": item})
                scene._base = self.scene._base
            self._plans[period] = make_plan(scene)
            if self._plans[period].period is None:
                raise PantographError(
                    "this scene has nothing to control: give joints the role 'tracked', as in [roles] "
                    "tracked = [...]"
                )
        return self._plans[period]

    def __call__(self, job: _Job) -> Trial | str:
        """A trial, without samples where it is disturbed; or why its law cannot control this scene."""
        variant, by = job.variant, job.disturbance
        try:
            trial = run_trial(self.plan(variant.words), variant.law, variant.own, by)
        except Exception as error:
            return place_of(error) if job.case == 0 else failed(place_of(error))
        return trial if job.case == 0 else trial.brief


_BENCH: list[_Bench] = []  # of a process of its own


def _begin(scene: Scene, base: Path | None) -> None:
    scene._base = base
    _BENCH[:] = [_Bench(scene)]


def _there(job: _Job) -> Trial | str:
    return _BENCH[0](job)
