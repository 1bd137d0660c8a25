"""Work against precision of whole scenes: keyed joints, servos and sampled controllers included.

Each engine is judged against its own far tighter run, so that its error is one of discretisation; how far the
engines' physics lie apart (soft limits, friction) is told beside it.
"""

from __future__ import annotations

import time
from collections.abc import Iterable
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
from .work_precision import TOLERANCES, Case, Motion, Reference, sure_until, trajectory_error

FRAMES = 50
TIGHT = 1e-12
"""Tolerance of the smooth engine's reference."""
LONGEST = 0.1
"""Longest step that is tried [s]."""
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
        # what friction is smoothed over follows from the step, also where it is no step
        step = setting if by_steps else (plan.period or case.duration / case.frames) / 2**6
        problem = replace(
            plan.problem,
            step=step,
            tolerance=None if by_steps else setting,
            integrator=self.method,
            sample_every=round(case.duration / case.frames / step),
            duration=case.duration,
        )
        controls = make_controls(plan.setup.scene, problem, plan.period)
        engine = make_engine(self.engine)
        try:
            segment = engine.run(problem, (0.0, case.duration), controls)
        except Broken as broken:  # at this setting
            segment = broken.segment
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


def scene_runners(plan: Plan, case: Case) -> tuple[list[SceneWork], list[str]]:
    """All methods of the engines that can run the scene, and why an engine cannot."""
    found: list[SceneWork] = []
    notes = []
    for engine, methods in (("smooth", TABLEAUS), ("contact", INTEGRATORS)):
        if engine == "smooth" and can_touch(plan.problem.model):
            notes.append("no smooth engine: bodies may touch; without contacts it could run the scene")
            continue
        trial = SceneWork(plan, case, engine, FINEST[engine])
        try:
            trial.run(next(iter(trial.settings())))
        except EngineError as error:
            notes.append(f"no {engine} engine: {error}")
        else:
            found += [SceneWork(plan, case, engine, name) for name in methods]
            if engine == "smooth":
                pairs = [name for name, tableau in TABLEAUS.items() if tableau.adaptive]
                found += [SceneWork(plan, case, engine, name, "tolerance") for name in pairs]
    return found, notes


def scene_references(
    engines: Iterable[str], plan: Plan, case: Case, *, budget_s: float
) -> dict[str, Reference]:
    """The reference of each engine: two methods at a tight tolerance, where it has any; or steps that halve
    until two runs agree to 1e-10, or one costs `budget_s`. Where contacts and limits make the last halving
    hardly better than the one before, the larger difference is the uncertainty.

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
            if uncertainty < 1e-10 or time.process_time() - began > budget_s:
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
