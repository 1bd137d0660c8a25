"""Scenes, engines, recordings, films: the front door of Pantograph.

>>> from pantograph.sim import Scene, run
>>> recording = run(Scene(duration=2.0, models=[{"file": "pendulum"}], initial={"position": {"hinge": 1.0}}))
>>> recording.q.shape
(251, 1)

What it names is imported when it is asked for: who uses machine code or inverse kinematics alone does not
wait for scenes, and the command line can be interrupted from its first moment.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .control import Law, Target
    from .errors import (
        EngineError,
        FilmError,
        ModelError,
        PantographError,
        RecordingError,
        RunError,
        SceneError,
    )
    from .plan import Plan, make_plan
    from .plots import plot
    from .recording import ErrorEstimate, Recording, load
    from .run import run
    from .scene.load import load_scene, parse_scene
    from .scene.schema import Scene
    from .shoot import shoot

__all__ = [
    "EngineError",
    "ErrorEstimate",
    "FilmError",
    "Law",
    "ModelError",
    "PantographError",
    "Plan",
    "Recording",
    "RecordingError",
    "RunError",
    "Scene",
    "SceneError",
    "Target",
    "load",
    "load_scene",
    "make_plan",
    "parse_scene",
    "plot",
    "run",
    "shoot",
]

_HOME = {"plot": "plots", "run": "run", "shoot": "shoot", "Scene": "scene.schema"}
_HOME |= dict.fromkeys([name for name in __all__ if name.endswith("Error")], "errors")
_HOME |= dict.fromkeys(["Law", "Target"], "control")
_HOME |= dict.fromkeys(["Plan", "make_plan"], "plan")
_HOME |= dict.fromkeys(["ErrorEstimate", "Recording", "load"], "recording")
_HOME |= dict.fromkeys(["load_scene", "parse_scene"], "scene.load")


class _FrontDoor(ModuleType):
    """Finds the names of `__all__` in their modules, once each (PEP 562 leaves `run`, also a module, out)."""

    def __getattr__(self, name: str) -> Any:
        if name not in _HOME:
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        import_module("..models", self.__name__)  # first: it says why MuJoCo does not load, where it does not
        value = getattr(import_module(f".{_HOME[name]}", self.__name__), name)
        self.__dict__[name] = value
        return value

    def __setattr__(self, name: str, value: Any) -> None:
        # the import system hands over the modules `run` and `shoot` where the functions belong
        if not (name in _HOME and isinstance(value, ModuleType)):
            super().__setattr__(name, value)

    def __dir__(self) -> list[str]:
        return sorted({*super().__dir__(), *__all__})


sys.modules[__name__].__class__ = _FrontDoor
