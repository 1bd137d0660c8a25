"""A rig that does what a scene does: the safety contract, the loop, live and recorded sources, the report."""

from .contract import RigFault
from .play import judge, mirror_live, mirror_recording
from .record import MirrorReport, Timing, Tracking
from .session import Outcome, Session

__all__ = [
    "MirrorReport",
    "Outcome",
    "RigFault",
    "Session",
    "Timing",
    "Tracking",
    "judge",
    "mirror_live",
    "mirror_recording",
]
