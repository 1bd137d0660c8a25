"""From a rig to a driver: its serial port, or virtual servos in its place."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .driver import Driver
from .errors import HardwareError
from .ports import latency_of, open_port
from .rig import VIRTUAL, Rig
from .virtual import VirtualBus
from .virtual_rig import virtual_bus

Array = NDArray[np.float64]

REAL_MARGIN = 8e-3  # s beyond the wire's time: scheduling of host and adapter
TERMINAL_MARGIN = 100e-3  # s: a pseudo-terminal has another busy process behind it


def connect(
    rig: Rig,
    *,
    port: str | None = None,
    bus: VirtualBus | None = None,
    pose: Array | None = None,
    paced: bool = False,
) -> tuple[Driver, str]:
    """Driver of a rig and a note about its port.

    ``port`` replaces the rig's; ``bus`` are virtual servos to use in memory, made for port 'virtual' when
    missing, at joint values ``pose``; ``paced`` lets their time pass as on the wall.
    """
    name = port or rig.port
    if bus is None and name == VIRTUAL:
        bus = virtual_bus(rig, pose=pose)
    if bus is None and os.name == "posix" and not Path(name).exists():
        from .ports import serial_devices

        here = ", ".join(serial_devices()) or "none"
        raise HardwareError(
            f"no serial port {name}; serial devices here: {here}; without a rig, use --port {VIRTUAL}"
        )
    if bus is not None:
        opened, clock = open_port(name, rig.baud, bus=bus, paced=paced)
        return Driver(opened, clock, latency=bus.timing.latency_timer, label=rig.label), (
            "virtual servos in memory"
        )
    latency = latency_of(name)
    opened, clock = open_port(name, rig.baud)
    terminal = Path(name).resolve().parent.name == "pts"
    margin = TERMINAL_MARGIN if terminal else REAL_MARGIN
    return Driver(opened, clock, margin=margin, latency=latency.seconds, label=rig.label), latency.note
