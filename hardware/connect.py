"""From a rig to a driver: its serial port, or virtual servos in its place."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from .driver import Driver
from .errors import HardwareError
from .ports import latency_of, open_port, serial_devices
from .rig import VIRTUAL, Rig
from .virtual import VirtualBus
from .virtual_rig import virtual_bus

Array = NDArray[np.float64]

_REAL_MARGIN = 8e-3  # s beyond the wire's time: scheduling of host and adapter
_TERMINAL_MARGIN = 100e-3  # s: a pseudo-terminal has another busy process behind it


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
    if bus is None:
        return open_driver(name, rig.baud, label=rig.label)
    opened, clock = open_port(name, rig.baud, bus=bus, paced=paced)
    driver = Driver(opened, clock, latency=bus.timing.latency_timer, label=rig.label)
    return driver, "virtual servos in memory"


def open_driver(
    port: str, baud: int, *, label: Callable[[int], str] = lambda id: f"servo {id}"
) -> tuple[Driver, str]:
    """Driver of a serial port at a bit rate, with the times of its adapter, and a note about it.

    ``label`` names a servo in messages. Raises HardwareError for a device that is not there.
    """
    if os.name == "posix" and not Path(port).exists():
        here = ", ".join(serial_devices()) or "none"
        raise HardwareError(
            f"no serial port {port}; serial devices here: {here}; without a rig, use --port {VIRTUAL}"
        )
    latency = latency_of(port)
    opened, clock = open_port(port, baud)
    terminal = Path(port).resolve().parent.name == "pts"
    margin = _TERMINAL_MARGIN if terminal else _REAL_MARGIN
    return Driver(opened, clock, margin=margin, latency=latency.seconds, label=label), latency.note
