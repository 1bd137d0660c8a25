"""Resolves what a scene names (laws, engines); with the command line the only place that sees everything."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from importlib import import_module
from typing import Any, cast

import mujoco

from .control import Law, Sampled
from .engines.interface import Engine, Problem, Role
from .errors import PantographError, SceneError, unknown
from .scene.angles import law_words
from .scene.schema import Scene


def _law(module: str, name: str) -> Callable[[], Callable[..., Law]]:
    """Finds a law of the controllers when it is asked for."""

    def find() -> Callable[..., Law]:
        return cast(
            "Callable[..., Law]", getattr(import_module(f"..controllers.{module}", __package__), name)
        )

    return find


LAWS: dict[str, Callable[[], Callable[..., Law]]] = {
    "pd": _law("pd", "PD"),
    "pid": _law("pid", "PID"),
    "computed-torque": _law("computed_torque", "ComputedTorque"),
    "operational-space": _law("operational_space", "OperationalSpace"),
    "impedance": _law("impedance", "Impedance"),
    "lqr": _law("lqr", "LQR"),
    "swing-up": _law("swing_up", "SwingUp"),
    "mpc": _law("predictive.linear", "MPC"),
    "nmpc": _law("predictive.nonlinear", "NMPC"),
}

_FAR_SEEING = ("mpc", "nmpc")


def make_law(
    name: str,
    problem: Problem,
    parameters: dict[str, Any],
    period: float = 0.002,
    *,
    model: mujoco.MjModel | None = None,
) -> Law:
    """The law ``name`` for a problem, sampled every ``period`` [s].

    A law takes what it needs of the problem by the names of its positional arguments, ``parameters``, in SI,
    by its keywords; those of :class:`~pantograph.controllers.reality.Loop` put it behind real sensors and
    drives, whose limits it knows.
    ``model`` is what the law believes the machine to be (default: what it is). Raises SceneError for an
    unknown law or parameter, or a bad value.
    """
    from ..controllers.drives import Drives
    from ..controllers.reality import LOOP_WORDS, with_reality

    check_law(name, parameters)
    if problem.live is not None and name in _FAR_SEEING:
        near = ", ".join(law for law in LAWS if law not in _FAR_SEEING)
        raise SceneError(
            f"law {name!r} looks far ahead, where live goals are not known yet; choose of: {near}"
        )
    factory, believed = LAWS[name](), model or problem.model
    offered = {
        "model": believed,
        "tracked": problem.dofs(Role.TRACKED),
        "keyed": problem.dofs(Role.KEYED),
        "q0": problem.state0.q,
        "clip": problem.clip,
        "period": period,
        "duration": problem.duration,
    }
    needed = [p.name for p in inspect.signature(factory).parameters.values() if p.kind != p.KEYWORD_ONLY]
    own = {word: value for word, value in parameters.items() if word not in LOOP_WORDS}
    reality = {word: value for word, value in parameters.items() if word in LOOP_WORDS}
    try:
        offered["top_speed"] = reality.get("top_speed")
        drives = Drives(believed, offered["tracked"], reality.get("saturation"), offered["top_speed"])
        offered["model"] = drives.told(believed)
        law = factory(*(offered[word] for word in needed), **own)
        tracked, keyed = offered["tracked"], offered["keyed"]
        return with_reality(law, believed, tracked, problem.state0.q, period, reality, keyed, problem.clip)
    except (TypeError, PantographError) as e:
        raise SceneError(str(e)) from e


def make_controls(scene: Scene, problem: Problem, period: float | None) -> Sampled | None:
    """The scene's controller for a problem, sampled every ``period`` [s] (PD along the keys when the scene
    names none); None without a period: nothing is controlled. Raises SceneError as :func:`make_law`."""
    if period is None:
        return None
    name = scene.controller.law if scene.controller else "pd"
    law = make_law(name, problem, law_words(scene, problem.model), period)
    return Sampled(law, problem, period)


def known_words(name: str) -> tuple[str, ...]:
    """Parameters of the law ``name``, those of sensors and drives last. Raises SceneError for no law."""
    from ..controllers.reality import LOOP_WORDS

    if name not in LAWS:
        raise SceneError(unknown("law", name, LAWS, where="pantograph.controllers"))
    own = (p.name for p in inspect.signature(LAWS[name]()).parameters.values() if p.kind == p.KEYWORD_ONLY)
    return (*own, *LOOP_WORDS)


def check_law(name: str, parameters: dict[str, Any]) -> None:
    """Raise SceneError when there is no such law, or it has no such parameter."""
    known = known_words(name)
    for word in parameters:
        if word not in known:
            raise SceneError(unknown("parameter", word, known, where=f"law {name!r}"))


def make_engine(name: str) -> Engine:
    """The engine ``name``."""
    if name == "kinematic":
        from .engines.kinematic import KinematicEngine

        return KinematicEngine()
    if name == "contact":
        from .engines.contact import ContactEngine

        return ContactEngine()
    if name == "smooth":
        from .engines.smooth import SmoothEngine

        return SmoothEngine()
    raise SceneError(unknown("engine", name, ("kinematic", "smooth", "contact"), where="this Pantograph"))
