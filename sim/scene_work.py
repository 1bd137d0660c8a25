"""Work against precision of whole scenes: keyed joints, servos and sampled controllers included.

Each engine is judged against its own far tighter run, so that its error is one of discretisation; how far the
engines' physics lie apart (soft limits, friction) is told beside it.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from .compose import make_controls, make_engine
from .engines.common import Broken
from .engines.contact import INTEGRATORS
from .engines.interface import Role
from .engines.touch import can_touch
from .errors import EngineError
from .integrate import TABLEAUS
from .integrate.problems import constraints_of
from .plan import Plan
from .scene_foreign import SceneForeign, problem_at, why_not_foreign
from .work_precision import TOLERANCES, Case, Motion, Reference, Runner, sure_until, trajectory_error
from .work_runners import FOREIGN

FRAMES = 50
TIGHT = 1e-12
"""Tolerance of the smooth engine's reference."""
LONGEST = 0.1
"""Longest step that is tried [s]."""
USUAL = ("dopri5", "rk4", "implicitfast", "dop853", "euler", "DOP853")
"""Methods that are tried first, for when time runs out."""
FINEST = {"smooth": "dop853", "contact": "rk4"}
"""The method of each engine's reference."""


@dataclass(frozen=True, eq=False)
class SceneWork:
    """One method of one engine on a scene, by fixed steps or by tolerance (see `work_precision.Runner`)."""

    plan: Plan
    case: Case
    engine: str
    method: str
    knob: str = "step"

    @property
    def order(self) -> int:
        """Power of the setting that errors go with."""
        if self.knob == "tolerance":
            return 1
        if self.engine == "smooth":
            return TABLEAUS[self.method].order
        # at contacts and limits no method keeps its order
        return 4 if self.method == "rk4" and not constraints_of(self.case.model) else 1

    def settings(self) -> Iterable[float]:
        """The controller's period, or a frame's time, and its halves below `LONGEST`; or tolerances."""
        if self.knob == "tolerance":
            return TOLERANCES
        step = self.plan.period or self.case.duration / self.case.frames
        while step > LONGEST:
            step /= 2
        return [step / 2**k for k in range(12)]

    def run(self, setting: float) -> Motion:
        """The motion of the scene in steps of `setting` [s], or to that tolerance."""
        plan, case = self.plan, self.case
        by_steps = self.knob == "step"
        problem = problem_at(plan, case, setting if by_steps else None)
        problem = replace(problem, tolerance=None if by_steps else setting, integrator=self.method)
        controls = make_controls(plan.setup.scene, problem, plan.period)
        engine = make_engine(self.engine)
        try:
            segment = engine.run(problem, (0.0, case.duration), controls)
        except Broken as broken:  # at this setting
            segment = broken.segment
        if segment.status == "interrupted":
            raise KeyboardInterrupt
        q, v = (
            np.full((case.frames + 1, case.model.nq), np.nan),
            np.full((case.frames + 1, case.model.nv), np.nan),
        )
        n = min(len(segment.t), case.frames + 1)
        q[:n], v[:n] = segment.q[:n], segment.v[:n]
        return Motion(q, v, int(segment.stats.get("evaluations", 0)))


def scene_case(plan: Plan) -> Case:
    """The scene's motion with frames at whole periods of its controller."""
    problem, frames = plan.problem, FRAMES
    duration = problem.duration
    if plan.period is not None:
        every = max(1, round(duration / FRAMES / plan.period))
        frames = max(1, int(duration / (every * plan.period) + 1e-9))
        duration = frames * every * plan.period
    scene = plan.setup.scene
    name = scene.title or Path(scene._file).stem
    return Case(name, problem.model, problem.state0.q, problem.state0.v, duration, frames=frames)


def is_free(plan: Plan) -> bool:
    """Whether the scene is motion from a state under constant controls, without constraints: a `Case`."""
    problem = plan.problem
    keyed = bool(np.any(problem.roles == Role.KEYED))
    driven = plan.period is not None or bool(problem.servo) or bool(problem.wrenches)
    return not (keyed or driven or constraints_of(problem.model))


def scene_runners(
    plan: Plan, case: Case, engines: Sequence[str] = ("smooth", "mujoco")
) -> tuple[list[Runner], list[str]]:
    """Methods of the engines asked for that can run the scene, the usual ones first; and why others cannot.

    "mujoco" is the contact engine here, under its own name.
    """
    found: dict[str, list[Runner]] = {}
    notes = []
    for engine in ("smooth", "contact"):
        asked = [e for e in engines if (e == "mujoco") == (engine == "contact")]
        if not asked:
            continue
        why = _why_not(engine, plan, case)
        others = [e for e in asked if e != "smooth"] if engine == "smooth" else []
        if why:
            notes += [f"no {engine} engine: {why}"] if engine in asked or engine == "contact" else []
            notes += [f"no {other}: it solves the smooth engine's equations; {why}" for other in others]
            continue
        if engine == "contact":
            found[engine] = [SceneWork(plan, case, engine, name) for name in INTEGRATORS]
        elif "smooth" in asked:
            pairs = [name for name, tableau in TABLEAUS.items() if tableau.adaptive]
            found["smooth"] = [SceneWork(plan, case, engine, name) for name in TABLEAUS]
            found["smooth"] += [SceneWork(plan, case, engine, name, "tolerance") for name in pairs]
        if others and (why := why_not_foreign(plan, case)):
            notes += [f"no {other}: {why}" for other in others]
        else:
            found |= {e: [SceneForeign(plan, case, name) for name in FOREIGN[e]] for e in others}
    rank = {name: k for k, name in enumerate(USUAL)}
    ordered = sorted(
        (r for each in found.values() for r in each), key=lambda r: rank.get(r.method, len(rank))
    )
    return ordered, notes


def _why_not(engine: str, plan: Plan, case: Case) -> str:
    """Why an engine cannot run the scene, found by its first step; empty when it can."""
    if engine == "smooth" and can_touch(plan.problem.model):
        return "bodies may touch; without contacts it could run the scene"
    trial = SceneWork(plan, case, engine, FINEST[engine])
    try:
        trial.run(next(iter(trial.settings())))
    except EngineError as error:
        return str(error)
    return ""


def scene_references(
    engines: Iterable[str], plan: Plan, case: Case, *, budget_s: float, until: float = math.inf
) -> dict[str, Reference]:
    """The reference of each engine: two methods at a tight tolerance, where it has any; or steps that halve
    until two runs agree to 1e-10, one costs `budget_s`, or it is past `until` (`time.perf_counter`). Where
    contacts and limits make the last halving hardly better than the one before, the larger difference is the
    uncertainty.

    Raises:
        EngineError: a reference did not reach the end.
    """
    references = {}
    for engine in engines:
        if engine == "smooth" and (found := _by_tolerance(plan, case)):
            references[engine] = found
            continue
        runner = SceneWork(plan, case, engine, FINEST[engine])
        settings = list(runner.settings())
        motions, uncertainty, step = [runner.run(settings[1])], float("nan"), settings[1]
        gaps: list[float] = []
        for step in settings[2:]:
            began = time.process_time()
            motions.append(runner.run(step))
            gaps.append(trajectory_error(case, *motions[-2:]))
            uncertainty = gaps[-1] if len(gaps) < 2 or gaps[-1] < 0.3 * gaps[-2] else max(gaps[-2:])
            dear = time.process_time() - began > budget_s or time.perf_counter() > until
            if uncertainty < 1e-10 or dear:
                break
        if not np.isfinite(uncertainty):
            raise EngineError(
                f"{case.name}: the {engine} engine's reference did not reach {case.duration:g} s"
            )
        source = f"{engine} engine, {runner.method} at {step:.3g} s; uncertainty by twice that step"
        sure = sure_until(case, *motions[-2:])
        references[engine] = Reference(motions[-1], uncertainty, source, sure)
    return references


def _by_tolerance(plan: Plan, case: Case) -> Reference | None:
    """The smooth engine's reference; None where a method does not reach the end."""
    names = ("verner98", "dop853")
    motions = [SceneWork(plan, case, "smooth", name, "tolerance").run(TIGHT) for name in names]
    uncertainty = trajectory_error(case, *motions)
    if not np.isfinite(uncertainty):
        return None
    source = f"smooth engine, verner98 to {TIGHT:g}; uncertainty by dop853"
    return Reference(motions[0], uncertainty, source, sure_until(case, *motions))
