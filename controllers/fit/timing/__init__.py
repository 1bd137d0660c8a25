"""Timing of a path that stays as it is: the fastest that a machine can follow, or the nearest to the keys."""

from .retime import Retimed, Stop, retime

__all__ = ["Retimed", "Stop", "retime"]
