"""What leaving the contacts out of a scene would gain, measured."""

from __future__ import annotations

import copy
import statistics
from dataclasses import replace

import mujoco

from .engines.touch import can_touch
from .plan import Plan, plan_setup
from .run import run

_WALL = 0.1  # s; that a run of each kind takes about
_FIRST = 20  # steps that tell how long others take
_REPEATS = 3


def gain_without_contacts(plan: Plan) -> str | None:
    """How much less time a simulated second takes without contacts, from the same start, in a sentence.

    None where the plan computes none. Equations are compiled before, which is not counted. Takes about a
    second.
    """
    if plan.engine.what != "contact" or not can_touch(plan.setup.model):
        return None
    without = _without_contacts(plan)
    first = min(plan.problem.steps, _FIRST)
    _cost(without, first)
    steps = round(_WALL / (_cost(plan, first) * plan.problem.step))
    steps = max(first, min(plan.problem.steps, steps))
    pairs = [(_cost(plan, steps), _cost(without, steps)) for _ in range(_REPEATS)]
    cost, less = (statistics.median(side) for side in zip(*pairs, strict=True))
    span = f"measured over the first {steps * plan.problem.step:.3g} s"
    if cost < 1.05 * less:
        return f'physics.contacts = "none" would gain nothing ({span})'
    times = f"{cost / less:.0f}" if cost > 10 * less else f"{cost / less:.2g}"
    return (
        f'physics.contacts = "none" takes {times} times less time a simulated second: '
        f"{1e3 * less:.3g} ms with the {without.engine.what} engine instead of {1e3 * cost:.3g} ms ({span})"
    )


def _without_contacts(plan: Plan) -> Plan:
    setup = plan.setup
    model, scene = copy.copy(setup.model), setup.scene
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    physics = scene.physics.model_copy(update={"contacts": "none"})
    return plan_setup(replace(setup, model=model, scene=scene.model_copy(update={"physics": physics})))


def _cost(plan: Plan, steps: int) -> float:
    """Seconds of work a simulated second, over the first steps; building apart."""
    h = plan.problem.step
    recording = run(replace(plan, problem=replace(plan.problem, duration=steps * h)))
    return float(recording.stats["wall_s"]) / (int(recording.stats["steps"]) * h)
