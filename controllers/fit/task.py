"""What a scene asks of a fit: its keys, the machine of its table [fit], and contacts."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import joint_names, lookup, names_of
from ...sim.clip import Clip
from ...sim.kinds import FREE
from ...sim.plan import Plan, make_plan
from ...sim.scene.fitting import FitItem
from ...sim.scene.schema import Scene
from .contact import Phase
from .machine import Machine, machine

LIMITS = ("velocity", "acceleration", "jerk", "force", "top_speed", "ampere")


class Task(NamedTuple):
    """The plan of the scene, its keys, its machine, the arguments of :func:`~.spacetime.fit`, and how near a
    proof has to be [rad, m]."""

    plan: Plan
    clip: Clip
    machine: Machine
    hard: tuple[float, ...]
    phases: tuple[Phase, ...]
    words: dict[str, Any]
    within: float


def task_of(scene: Scene, **given: Any) -> Task:
    """The task of a scene; what is ``given`` and not None goes before its table [fit].

    Limits by joint go before those of the scene joint by joint; under the name "" they stand for all joints
    that are not named. Free joints have no drive. Raises PantographError for names of no joint or site, and
    for limits that are not positive.
    """
    item = scene.fit or FitItem()
    said = {**dict(item), **{word: value for word, value in given.items() if value is not None}}
    plan = make_plan(_tracked(make_plan(scene)))
    model = plan.problem.model
    driven = _driven(model, said["passive"])
    able = machine(
        model,
        position={**(item.position or {}), **(said["position"] or {})},
        driven=driven,
        current=math.inf if said["current"] is None else said["current"],
        **{word: _by_joint(model, driven, said[word], getattr(item, word)) for word in LIMITS},
    )
    phases = tuple(Phase(p.start, p.stop, tuple(p.sites), p.friction, p.ground) for p in item.phases)
    words = {w: said[w] for w in ("effort", "deviation", "step", "tolerance", "at_rest")}
    return Task(plan, plan.problem.clip, able, tuple(said["hard"]), phases, words, said["within"])


def _by_joint(model: mujoco.MjModel, driven: NDArray[np.bool_], given: Any, scene: Any) -> Any:
    """A limit of all driven joints and those of some, as limits by joint."""
    if not isinstance(given, dict) or given is scene:
        return given
    named = {name: value for name, value in given.items() if name}
    if set(given) == {""}:
        return given[""]
    rest = given.get("", scene)
    if not isinstance(rest, dict):
        joints = joint_names(model)
        every = () if rest is None else [joints[j] for j in np.unique(model.dof_jntid[driven])]
        rest = dict.fromkeys(every, rest)
    return {**rest, **named}


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
