"""What a scene asks of a fit: its keys, the machine of its table [fit], and contacts."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import joint_names, lookup, names_of
from ...sim.clip import Clip
from ...sim.engines.interface import Role
from ...sim.errors import PantographError
from ...sim.explain import ideal_drives
from ...sim.kinds import FREE
from ...sim.plan import Plan, make_plan
from ...sim.scene.angles import in_si, law_words
from ...sim.scene.fitting import FitItem
from ...sim.scene.schema import ControllerItem, Scene
from .check import curves_of
from .contact import Phase
from .ends import resting
from .machine import Machine, machine

LIMITS = ("velocity", "acceleration", "jerk", "force", "top_speed", "ampere")
_ANGLES = ("velocity", "acceleration", "jerk", "top_speed")  # of hinges, in the unit of the scene's angles


class Task(NamedTuple):
    """The plan of the scene, its keys, its machine, the arguments of :func:`~.spacetime.fit`, how near a
    proof has to be [rad, m], and the scene's controller with its words in SI."""

    plan: Plan
    clip: Clip
    machine: Machine
    hard: tuple[float, ...]
    phases: tuple[Phase, ...]
    words: dict[str, Any]
    within: float
    controller: ControllerItem | None


def task_of(scene: Scene, **given: Any) -> Task:
    """The task of a scene; what is ``given`` and not None goes before its table [fit].

    Limits by joint go before those of the scene joint by joint; under the name "" they stand for all joints
    that are not named. Where the scene's angles are degrees, limits of hinges but of force are. Free joints
    have no drive. Raises PantographError for names of no joint or site, for limits that are not positive, and
    for hard times without a key.
    """
    item = scene.fit or FitItem()
    degree = scene.angle == "degree"
    said = {**dict(item), **{word: value for word, value in given.items() if value is not None}}
    plan = make_plan(_tracked(make_plan(scene)))
    model = plan.problem.model
    driven = _driven(model, said["passive"])
    limits = {word: _by_joint(model, driven, said[word], getattr(item, word)) for word in LIMITS}
    ranges = {**(item.position or {}), **(said["position"] or {})}
    if degree:
        limits |= {word: in_si(model, limits[word]) for word in _ANGLES}
        low, high = (in_si(model, {name: ends[k] for name, ends in ranges.items()}) for k in (0, 1))
        ranges = {name: (low[name], high[name]) for name in ranges}
    able = machine(
        model,
        position=ranges,
        driven=driven,
        current=math.inf if said["current"] is None else said["current"],
        **limits,
    )
    phases = tuple(Phase(p.start, p.stop, tuple(p.sites), p.friction, p.ground) for p in item.phases)
    words = {w: said[w] for w in ("effort", "deviation", "step", "tolerance")}
    clip, at_rest = plan.problem.clip, said["at_rest"]
    # what is said is meant exactly, and what keys say may be slowed down
    words["at_rest"] = at_rest if at_rest is not None else resting(clip, None, scene.duration)
    controller = scene.controller
    if controller is not None:
        controller = controller.model_copy(update=law_words(scene, model))
    _on_keys(clip, said["hard"])
    return Task(plan, clip, able, tuple(said["hard"]), phases, words, said["within"], controller)


def _on_keys(clip: Clip, hard: Sequence[float]) -> None:
    """Raise PantographError for a time at which no joint has a key."""
    curves = [curve for track in clip.tracks.values() for curve in curves_of(track)]
    times = np.unique(np.concatenate([curve.times for curve in curves])) if curves else np.zeros(0)
    for t in hard:
        if len(times) and np.abs(times - t).min() > 1e-6:
            near = times[np.argsort(np.abs(times - t))[:8]]
            raise PantographError(
                f"no key to pass through at {t:g} s; keys near it: "
                f"{', '.join(f'{k:g}' for k in np.sort(near))} s"
            )


def unlimited(task: Task) -> list[str]:
    """Keyed joints whose actuators no controller can use, and which have no limit of force, in words."""
    setup, able = task.plan.setup, task.machine
    limited = np.isfinite(able.force_high - able.force_low)
    roles = setup.roles.copy()
    roles[task.plan.problem.model.dof_jntid[limited]] = Role.PASSIVE
    return ideal_drives(replace(setup, roles=roles))


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
