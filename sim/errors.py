"""Errors of the simulation side; one family with those of the models."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..models.errors import ModelError, PantographError, unknown

if TYPE_CHECKING:
    from .recording import Recording

__all__ = [
    "EngineError",
    "FilmError",
    "FilmWarning",
    "KeyingError",
    "ModelError",
    "PantographError",
    "RecordingError",
    "RunError",
    "SceneError",
    "unknown",
]


class SceneError(PantographError):
    """A scene file or object contradicts itself or its models; lists every mistake with its place."""


class KeyingError(PantographError):
    """Keys contradict themselves or what they key: times, shapes, kinds, ends of a loop, channels."""


class EngineError(PantographError):
    """An engine cannot do what the problem asks, or the run left the domain where it makes sense."""


class RunError(EngineError):
    """A run ended by an error in the middle, its cause; ``recording`` has what was computed until then."""

    def __init__(self, recording: Recording) -> None:
        super().__init__(recording.message)
        self.recording = recording


class RecordingError(PantographError):
    """A recording file is torn, foreign or of an unknown version."""


class FilmWarning(UserWarning):
    """A film leaves something of the model out."""


class FilmError(PantographError):
    """A picture or film could not be made: no GL library, an unwritable file, a bad size."""
