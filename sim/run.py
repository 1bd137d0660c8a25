"""The main flow: scene, plan, engine, recording."""

from __future__ import annotations

import platform
from collections.abc import Callable
from importlib.metadata import version
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from .accuracy import estimate_error
from .checks import check_frames
from .compose import make_controls, make_engine
from .control import Law, Sampled, Target
from .engines.common import Broken
from .engines.derive import derive
from .engines.interface import Array, Engine, Role, Segment
from .errors import EngineError, RunError
from .plan import Plan, make_plan
from .recording import Recording, model_to_bytes
from .scene.build import Setup
from .scene.schema import Scene

_UNCHECKED = "not searched for overlaps and crossed limits: interrupted"


def run(
    scene: Scene | Plan | str | Path,
    *,
    error: bool = False,
    law: Law | None = None,
    progress: Callable[[float], None] | None = None,
) -> Recording:
    """Compute a scene: a Scene, its Plan, or the path of a scene file.

    ``error`` adds an estimate of the discretisation error, billed apart. ``law`` is one of your own, sampled
    in place of the scene's, at its controller's period. ``progress`` is told the simulated time [s]. A run
    that diverges or is interrupted returns what it has, with a status and message. Raises SceneError for a
    scene with mistakes, EngineError for what the engine cannot do, and RunError, with what it has, when the
    controller or the engine fails on the way.
    """
    plan = scene if isinstance(scene, Plan) else make_plan(scene)
    problem = plan.problem
    engine = make_engine(plan.engine.what)
    controls = _controls(plan, law)
    failure: BaseException | None = None
    try:
        segment = engine.run(problem, (0.0, problem.steps * problem.step), controls, progress=progress)
    except Broken as broken:
        segment, failure = broken.segment, broken.__cause__
    remarks: tuple[str, ...] = ()
    if controls is not None and segment.status == "done":
        remarks = controls.remarks(segment.q[-1])
    recording = _recorded(plan, segment, engine if error else None, law, remarks)
    if failure is not None:
        raise RunError(recording) from failure
    return recording


def _controls(plan: Plan, law: Law | None) -> Sampled | None:
    """The scene's controller, or ``law`` in its place."""
    if law is None:
        return make_controls(plan.setup.scene, plan.problem, plan.period)
    if plan.period is None:
        raise EngineError("a law needs joints to drive: name them in the scene's roles.tracked")
    if isinstance(law, type) or not (callable(law) and hasattr(law, "start")):
        raise EngineError(
            f"a law is an object with start() and __call__(t, q, v, target, memory), not {law!r}"
        )
    return Sampled(_Checked(law, plan.problem.model.nv), plan.problem, plan.period)


class _Checked:
    """A law of one's own: what it gives is looked at, so that no number is taken for all joints."""

    def __init__(self, law: Law, nv: int) -> None:
        self.law, self.nv = law, nv

    def __getattr__(self, name: str) -> Any:
        return getattr(self.law, name)

    def start(self) -> Any:
        return self.law.start()

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: Any) -> tuple[Array, Any]:
        given = self.law(t, q, v, target, memory)
        if not (isinstance(given, tuple) and len(given) == 2):
            raise EngineError(f"a law returns its forces and its memory, not {type(given).__name__}")
        tau = np.asarray(given[0], dtype=float)
        if tau.shape != (self.nv,):
            raise EngineError(f"a law gives a force for each of {self.nv} freedoms, not shape {tau.shape}")
        return tau, given[1]


def _recorded(
    plan: Plan, segment: Segment, engine: Engine | None, law: Law | None, remarks: tuple[str, ...]
) -> Recording:
    """The recording of a segment, with what its law remarked, and, where the ``engine`` for it is given, an
    estimate of its error."""
    problem, setup = plan.problem, plan.setup
    status, message, estimate = segment.status, segment.message, None
    told = [*plan.notes, *remarks]
    notes = [*told, _UNCHECKED]
    missed: dict[str, Array] = {}
    try:
        derived = derive(problem, segment)
        missed = _missed(setup, segment)
        seen = check_frames(setup, segment.t, segment.q)
        notes = [*told, *_sentences(setup, missed, segment.t), *seen]
        if engine is not None and status == "done" and segment.stats["steps"]:
            estimate = estimate_error(engine, problem, segment, _controls(plan, law))
    except EngineError as e:
        notes.append(f"no error estimate: {e}")
    except KeyboardInterrupt:
        # the motion is there: what belongs to it is worth the moment that it takes
        derived = derive(problem, segment)
        if status == "done":
            status, message = "interrupted", "interrupted after the simulation; the motion is whole"
    return Recording(
        t=segment.t,
        q=segment.q,
        v=segment.v,
        a=derived.a,
        tau=derived.tau,
        ctrl=derived.ctrl,
        kinetic=derived.kinetic,
        potential=derived.potential,
        normal=derived.normal,
        keyed=problem.dofs(Role.KEYED),
        tracked=problem.dofs(Role.TRACKED),
        tick_t=segment.tick_t,
        tick_ctrl=segment.tick_ctrl,
        tick_qfrc=segment.tick_qfrc,
        events=segment.events,
        status=status,
        message=message,
        stats=segment.stats,
        notes=tuple(notes),
        scene=setup.scene.model_dump(mode="json", exclude_defaults=True) | {"format": setup.scene.format},
        versions=_versions(),
        model_bytes=model_to_bytes(problem.model),
        error=estimate,
        goals=tuple(missed),
        missed=np.stack([*missed.values()], axis=1) if missed else np.zeros((len(segment.t), 0, 2)),
    )


def _missed(setup: Setup, segment: Segment) -> dict[str, Array]:
    """How far the motion is from the scene's goals: by goal, (n, 2) [m], [rad]."""
    if not (setup.scene.goals and len(segment.t)):
        return {}
    from .scene.goals import deviations

    return deviations(setup.scene, setup.model, segment.t, segment.q)


def _sentences(setup: Setup, missed: dict[str, Array], t: Array) -> list[str]:
    if not missed:
        return []
    from .scene.goals import sentences

    return sentences(setup.scene, setup.model, missed, t)


def _versions() -> dict[str, str]:
    return {
        "pantograph": version("pantograph-sim"),
        "mujoco": mujoco.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
    }
