"""Scenes, engines, recordings, films: the front door of Pantograph.

>>> from pantograph.sim import Scene, run
>>> recording = run(Scene(duration=2.0, models=[{"file": "pendulum"}], initial={"position": {"hinge": 1.0}}))
>>> recording.q.shape
(251, 1)
"""

from .errors import EngineError, FilmError, ModelError, PantographError, RecordingError, RunError, SceneError
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
    "ModelError",
    "PantographError",
    "Plan",
    "Recording",
    "RecordingError",
    "RunError",
    "Scene",
    "SceneError",
    "load",
    "load_scene",
    "make_plan",
    "parse_scene",
    "plot",
    "run",
    "shoot",
]
