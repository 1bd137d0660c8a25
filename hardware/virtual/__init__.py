"""Virtual servos and buses: the whole path to the hardware without hardware."""

from .bus import Ledger, Timing, VirtualBus
from .faults import NO_FAULTS, CablePull, FaultPlan, ServoFault, WireFault
from .firmware import Quirks
from .motor import MOTORS, Gear, Motor, Plant, joints
from .port import MemoryPort
from .pty import PtyServer, serve
from .servo import VirtualServo

__all__ = [
    "MOTORS",
    "NO_FAULTS",
    "CablePull",
    "FaultPlan",
    "Gear",
    "Ledger",
    "MemoryPort",
    "Motor",
    "Plant",
    "PtyServer",
    "Quirks",
    "ServoFault",
    "Timing",
    "VirtualBus",
    "VirtualServo",
    "WireFault",
    "joints",
    "serve",
]
