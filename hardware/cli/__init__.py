"""Commands for servos and rigs: `pantograph servo ...`."""

from . import service, simulate
from .common import app
from .motion import play_recording

__all__ = ["app", "play_recording", "service", "simulate"]
