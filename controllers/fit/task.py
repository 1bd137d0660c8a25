"""What a scene asks of a fit: its keys, the machine of its table [fit], and contacts."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import lookup, names_of
from ...sim.clip import Clip
from ...sim.kinds import FREE
from ...sim.plan import Plan, make_plan
from ...sim.scene.fitting import FitItem
from ...sim.scene.schema import Scene
from .contact import Phase
from .machine import Machine, machine

LIMITS = ("velocity", "acceleration", "jerk", "force", "top_speed", "ampere")


class Task(NamedTuple):
    """The plan of the scene, its keys, its machine, and the arguments of :func:`~.collocate.fit`."""

    plan: Plan
    clip: Clip
    machine: Machine
    hard: tuple[float, ...]
    phases: tuple[Phase, ...]
    words: dict[str, Any]


def task_of(scene: Scene, **given: Any) -> Task:
    """The task of a scene; what is ``given`` and not None or empty goes before its table [fit].

    Free joints have no drive. Raises PantographError for names of no joint or site, and for limits that are
    not positive.
    """
    item = scene.fit or FitItem()
    said = {**dict(item), **{word: value for word, value in given.items() if value}}
    plan = make_plan(_tracked(make_plan(scene)))
    model = plan.problem.model
    able = machine(
        model,
        driven=_driven(model, said["passive"]),
        current=said["current"] or math.inf,
        **{word: said[word] for word in LIMITS},
    )
    phases = tuple(Phase(p.start, p.stop, tuple(p.sites), p.friction, p.ground) for p in item.phases)
    words = {w: said[w] for w in ("effort", "deviation", "step", "tolerance", "at_rest")}
    return Task(plan, plan.problem.clip, able, tuple(said["hard"]), phases, words)


def _tracked(plan: Plan) -> Scene:
    """The scene with its joints tracked: for keyed ones a plan leaves out actuators, and contacts."""
    model, scene = plan.problem.model, plan.setup.scene
    names = names_of(model, "joint")
    mine = [n for n in plan.problem.clip.tracks if int(model.jnt_type[names.index(n)]) != FREE]
    return scene.model_copy(update={"roles": scene.roles.model_copy(update={"tracked": mine, "keyed": []})})


def _driven(model: mujoco.MjModel, passive: list[str]) -> NDArray[np.bool_]:
    """Mask (nv,) of the freedoms with a drive: all but those of free joints and of the ``passive`` ones."""
    driven = np.asarray(model.jnt_type[model.dof_jntid] != FREE)
    for name in passive:
        driven[model.dof_jntid == lookup(model, "joint", name)] = False
    return driven
