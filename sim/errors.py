"""Errors of the simulation side; one family with those of the models."""

from ..models.errors import ModelError, PantographError, unknown

__all__ = [
    "EngineError",
    "FilmError",
    "FilmWarning",
    "KeyingError",
    "ModelError",
    "PantographError",
    "RecordingError",
    "SceneError",
    "unknown",
]


class SceneError(PantographError):
    """A scene file or object contradicts itself or its models; lists every mistake with its place."""


class KeyingError(PantographError):
    """Keys contradict themselves or what they key: times, shapes, kinds, ends of a loop, channels."""


class EngineError(PantographError):
    """An engine cannot do what the problem asks, or the run left the domain where it makes sense."""


class RecordingError(PantographError):
    """A recording file is torn, foreign or of an unknown version."""


class FilmWarning(UserWarning):
    """A film leaves something of the model out."""


class FilmError(PantographError):
    """A picture or film could not be made: no GL library, an unwritable file, a bad size."""
