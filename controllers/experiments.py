"""Experiments: the same scene under several laws, as modelled and disturbed, in one table and one picture."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass, replace
from itertools import product
from multiprocessing import current_process, get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..models import names_of
from ..sim.compile.program import workers
from ..sim.compose import check_law, known_words
from ..sim.engines.interface import Role
from ..sim.errors import PantographError
from ..sim.plan import Plan, make_plan
from ..sim.scene.schema import Scene
from ..sim.scene.schema.scene import ControllerItem
from .gains import force_limits, positive
from .nominal import Nominal
from .reality import LOOP_WORDS
from .trial import ILC, ILC_WORDS, Disturbance, Figures, Trial, run_trial

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_TASK_WORDS = ("goal", "site", "axes")  # parameters that say what to do, not how
_PERIOD = "period"  # no parameter of a law: the controller's own


@dataclass(frozen=True)
class Variant:
    """A law with its parameters, and what it is called in tables."""

    law: str
    words: Mapping[str, Any]
    name: str

    @property
    def own(self) -> dict[str, Any]:
        """Parameters of the law itself."""
        return {word: value for word, value in self.words.items() if word != _PERIOD}


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
    """Rows in the order asked for, disturbances, and the samples of undisturbed runs by variant."""

    rows: tuple[Row, ...]
    disturbances: tuple[Disturbance, ...]
    period: float
    trials: Mapping[str, Trial]


def compare(
    scene: Scene,
    laws: Sequence[str],
    *,
    sweep: Mapping[str, Sequence[Any]] | None = None,
    trials: int = 0,
    mass: float = 0.1,
    friction: float = 0.0,
    push: float = 0.2,
    seed: int = 0,
    processes: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Run ``scene`` under each of ``laws``: once as modelled, ``trials`` times disturbed (the same for all).

    A disturbed machine has its masses changed by up to the part ``mass``, each body's on its own, damping and
    dry friction of its joints by up to the part ``friction``, and joint forces of up to ``push`` of what its
    drives can give (or of its weight, of ideal drives) for a tenth of the scene. ``sweep`` gives lists of
    parameter values: for every law, each combination of those that it has is a variant; "period" [s] is the
    controller's own. The scene's own controller parameters go to its own law, to the others those that say
    what to do (a goal, a site) and those of sensors and drives. The law "ilc" is the scene's own, or ``of``,
    after ``repeats`` runs from which it learned: on each machine anew, before it is pushed. Undisturbed runs
    are timed one after the other, those of a sweep and disturbed ones share the processors. Raises SceneError
    for laws and parameters that do not fit. A script that asks for several processes needs
    ``if __name__ == "__main__":``; without, a warning says so and one process does it all.
    """
    if getattr(current_process(), "_inheriting", False):  # as multiprocessing itself asks
        raise PantographError(_GUARD)
    plan = _plan(scene)
    variants = _variants(scene, laws, sweep or {})
    disturbances = tuple(_disturbances(plan, trials, mass, push, seed, friction))
    total = len(variants) * (1 + len(disturbances))
    done = 0

    def tell() -> None:
        nonlocal done
        done += 1
        if progress:
            progress(done, total)

    found: dict[tuple[int, int], Trial] = {}
    if not sweep:
        for i, variant in enumerate(variants):
            found[i, 0] = run_trial(plan, variant.law, variant.own, Disturbance())
            tell()
    cases = (Disturbance(), *disturbances)
    jobs = [job for job in product(range(len(variants)), range(len(cases))) if job not in found]
    for job, trial in _spread(scene, variants, cases, jobs, processes or workers()):
        found[job] = trial
        tell()
    rows = tuple(
        Row(
            v,
            found[i, 0].figures,
            tuple(found[i, j].figures for j in range(1, len(cases))),
            v.words.get(_PERIOD, plan.period),
        )
        for i, v in enumerate(variants)
    )
    assert plan.period is not None
    nominal = {v.name: found[i, 0] for i, v in enumerate(variants)}
    return Comparison(rows, disturbances, plan.period, nominal)


def figure(comparison: Comparison) -> Figure:
    """Errors over time and forces of the undisturbed runs, and the RMS error of all runs, a law a colour."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    chart = Figure(figsize=(10, 9), layout="constrained")
    (top, middle, bottom), floor = chart.subplots(3, 1), np.inf
    for i, row in enumerate(comparison.rows):
        trial, colour = comparison.trials[row.variant.name], colormaps["tab10"](i % 10)
        look = {"color": colour, "ls": ("-", "--", ":")[i % 3]}  # equal motions stay both visible
        size = np.maximum(np.sqrt(np.sum(trial.error**2, axis=1)), 1e-15)
        top.semilogy(trial.t, size, label=row.variant.name, **look)
        floor = min(floor, float(np.percentile(size, 2)))
        middle.plot(trial.t, np.sqrt(np.sum(trial.tau**2, axis=1)), **look)
        dots = [f.rms for f in row.disturbed]
        bottom.plot([i] * len(dots), dots, "o", color=colour, alpha=0.4, ms=5)
        bottom.plot([i], [row.nominal.rms], "_", color=colour, ms=24, mew=3)
    top.set_ylim(bottom=floor)
    top.set_ylabel("error of all joints [rad, m]")
    middle.set_ylabel("forces of all joints [N m, N]")
    bottom.set_ylabel("RMS error [rad, m]")
    middle.set_xlabel("time [s]")
    bottom.set_yscale("log")
    names = [row.variant.name.replace(" ", "\n", 1) for row in comparison.rows]
    slant = {"rotation": 20, "ha": "right"} if len(names) > 4 else {}
    bottom.set_xticks(range(len(names)), names, fontsize=9, **slant)
    bottom.set_title("as modelled (bars) and disturbed (dots)", fontsize=10)
    top.legend(fontsize=8, ncols=3)
    for ax in (top, middle, bottom):
        ax.grid(alpha=0.3)
    return chart


def learning(comparison: Comparison) -> Figure:
    """RMS error of every repeat from which laws of the comparison learned."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    chart = Figure(figsize=(8, 4), layout="constrained")
    ax = chart.subplots()
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    for name, trial in comparison.trials.items():
        if trial.learned is not None:
            errors = trial.learned.errors
            ax.semilogy(range(1, len(errors) + 1), errors, "o-", label=name)
    ax.set_xlabel("repeat")
    ax.set_ylabel("RMS error [rad, m]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3, which="both")
    return chart


def _plan(scene: Scene, words: Mapping[str, Any] | None = None) -> Plan:
    """The plan of a scene, with another period where ``words`` say so."""
    if words and _PERIOD in words:
        item, base = scene.controller or ControllerItem(), scene._base
        period = positive("period", words[_PERIOD])
        scene = scene.model_copy(update={"controller": item.model_copy(update={"period": period})})
        scene._base = base
    plan = make_plan(scene)
    if plan.period is None:
        raise PantographError(
            "this scene has nothing to control: give joints the role 'tracked', as in [roles] tracked = [...]"
        )
    return plan


def _variants(scene: Scene, laws: Sequence[str], sweep: Mapping[str, Sequence[Any]]) -> list[Variant]:
    out: list[Variant] = []
    for word in sweep:
        if word != _PERIOD and not any(word in _words_of(law, _base(scene)) for law in laws):
            _check(laws[0], _base(scene), {word: None})
    for law in laws:
        words = _told(scene, _base(scene) if law == ILC else law) | (
            {"of": _base(scene)} if law == ILC else {}
        )
        able = (_PERIOD, *_words_of(law, _base(scene)))
        known = {word: values for word, values in sweep.items() if word in able}
        for values in product(*known.values()):
            chosen = dict(zip(known, values, strict=True))
            label = " ".join([law, *(f"{k}={v}" for k, v in chosen.items())])
            out.append(Variant(law, words | chosen, label))
            _check(law, _base(scene), out[-1].own)
    return out


def _base(scene: Scene) -> str:
    """The law that learns."""
    return scene.controller.law if scene.controller else "pd"


def _told(scene: Scene, law: str) -> dict[str, Any]:
    """What the scene tells a law: all if it is its own, else what to do and what sensors and drives are."""
    own = scene.controller.parameters if scene.controller else {}
    if scene.controller and law == scene.controller.law:
        return own
    return {w: own[w] for w in own if w in LOOP_WORDS or (w in _TASK_WORDS and w in known_words(law))}


def _words_of(law: str, base: str) -> tuple[str, ...]:
    return (*ILC_WORDS, *known_words(base)) if law == ILC else known_words(law)


def _check(law: str, base: str, words: Mapping[str, Any]) -> None:
    """Raise SceneError for words that a law, or the one that learns, does not know."""
    if law != ILC:
        check_law(law, dict(words))
        return
    check_law(str(words.get("of", base)), {w: x for w, x in words.items() if w not in ILC_WORDS})


def _disturbances(
    plan: Plan, trials: int, mass: float, push: float, seed: int, friction: float = 0.0
) -> list[Disturbance]:
    m, rng, out = plan.problem.model, np.random.default_rng(seed), []
    tracked = plan.problem.dofs(Role.TRACKED)
    low, high = force_limits(m)
    able = np.minimum(-low, high)
    q0 = plan.problem.state0.q
    able = np.where(np.isfinite(able), able, np.abs(Nominal(m).weight(q0)).max(initial=1.0))
    duration = plan.problem.duration
    for k in range(trials):
        factors = 1.0 + mass * rng.uniform(-1.0, 1.0, m.nbody)
        forces = np.where(tracked, push * able * rng.uniform(-1.0, 1.0, m.nv), 0.0)
        start = float(rng.uniform(0.1, 0.7) * duration)
        body = int(np.argmax(np.abs(factors - 1.0)))
        heavy = f"{names_of(m, 'body')[body]} x {factors[body]:.3f}"
        rubs = tuple(1.0 + friction * rng.uniform(-1.0, 1.0, m.nv)) if friction else ()
        rough = f", friction x {min(rubs):.2f} to {max(rubs):.2f}" if rubs else ""
        say = f"#{k} of seed {seed}: {heavy}{rough}, push at {start:.2f} s"
        out.append(Disturbance(tuple(factors), rubs, tuple(forces), start, start + 0.1 * duration, say))
    return out


def _spread(
    scene: Scene,
    variants: list[Variant],
    cases: tuple[Disturbance, ...],
    jobs: list[tuple[int, int]],
    processes: int,
) -> Iterator[tuple[tuple[int, int], Trial]]:
    """Pairs (job, trial) as they are done, by several processes; with samples where nothing disturbs."""
    left = list(jobs)
    if processes > 1 and len(jobs) > 1:
        try:
            with ProcessPoolExecutor(min(processes, len(jobs)), mp_context=get_context("spawn")) as pool:
                pending = {
                    pool.submit(_remote, scene, scene._base, variants[i], cases[j]): (i, j) for i, j in jobs
                }
                for done in as_completed(pending):
                    trial = done.result()
                    left.remove(pending[done])
                    yield pending[done], trial
        except BrokenProcessPool:
            warnings.warn(f"processes ended before they began; one goes on alone: {_GUARD}", stacklevel=3)
    for i, j in left:
        yield (i, j), run_trial(_plan(scene, variants[i].words), variants[i].law, variants[i].own, cases[j])


_GUARD = (
    'processes import the script that starts them: put what it does under if __name__ == "__main__":, or ask '
    "for processes=1"
)
_PLANS: dict[str, Plan] = {}
_NONE = np.zeros(0)


def _remote(scene: Scene, base: Path | None, variant: Variant, disturbance: Disturbance) -> Trial:
    """One run in a process of its own, which keeps the plan for the next one."""
    key = f"{variant.words.get(_PERIOD)} {scene.model_dump_json()}"
    if key not in _PLANS:
        scene._base = base
        _PLANS[key] = _plan(scene, variant.words)
    trial = run_trial(_PLANS[key], variant.law, variant.own, disturbance)
    return trial if disturbance == Disturbance() else replace(trial, t=_NONE, error=_NONE, tau=_NONE)
