"""Resolves what a scene names (laws, engines); with the command line the only place that sees everything."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

from .control import Law
from .engines.interface import Engine, Problem, Role
from .errors import PantographError, SceneError, unknown


def _pd() -> Callable[..., Law]:
    from ..controllers.pd import PD

    return PD


LAWS: dict[str, Callable[[], Callable[..., Law]]] = {"pd": _pd}


def make_law(name: str, problem: Problem, parameters: dict[str, Any]) -> Law:
    """The law ``name`` for a problem. Raises SceneError for an unknown law or parameter, or a bad value."""
    check_law(name, parameters)
    try:
        return LAWS[name]()(problem.model, problem.dofs(Role.TRACKED), problem.state0.q, **parameters)
    except (TypeError, PantographError) as e:
        raise SceneError(str(e)) from e


def check_law(name: str, parameters: dict[str, Any]) -> None:
    """Raise SceneError when there is no such law, or it has no such parameter."""
    if name not in LAWS:
        raise SceneError(unknown("law", name, LAWS, where="pantograph.controllers"))
    known = [p.name for p in inspect.signature(LAWS[name]()).parameters.values() if p.kind == p.KEYWORD_ONLY]
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
    raise SceneError(unknown("engine", name, ("kinematic", "contact"), where="this Pantograph"))
