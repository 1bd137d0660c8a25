"""What a person does to single servos: change ID or bit rate, look at them, stop them."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

from . import packets
from .driver import Driver, NoAnswer
from .errors import HardwareError
from .mirror.contract import error_names


@dataclass(frozen=True)
class ServoState:
    """A servo at a glance, in SI; load is in ampere, or a ratio of the stall torque; errors as words."""

    id: int
    position: float
    goal: float
    velocity: float
    load: float
    temperature: float
    voltage: float
    torque: bool
    errors: str


def look(driver: Driver, ids: list[int]) -> dict[int, ServoState]:
    """State of servos that answer. Present values come in one read each, errors and torque in another."""
    out: dict[int, ServoState] = {}
    load = "present_current|present_load"
    fast = driver.block(ids, [load, "present_velocity", "present_position"])
    slow = driver.block(ids, ["present_input_voltage", "present_temperature"])
    goals, errors, torque = (
        driver.block(ids, [n]) for n in ("goal_position", "hardware_error_status", "torque_enable")
    )
    replies = [driver.read_block(b) for b in (fast, slow, goals, errors, torque)]
    values = [b.decode(r) for b, r in zip((fast, slow, goals, errors, torque), replies, strict=True)]
    for k, id in enumerate(ids):
        if any(id not in r for r in replies):
            continue
        a, b, goal, error, on = (v[k] for v in values)
        out[id] = ServoState(
            id,
            position=float(a[2]),
            goal=float(goal[0]),
            velocity=float(a[1]),
            load=float(a[0]),
            temperature=float(b[1]),
            voltage=float(b[0]),
            torque=bool(on[0]),
            errors=error_names(int(error[0])) if error[0] else "",
        )
    return out


def set_id(driver: Driver, old: int, new: int) -> None:
    """Change an ID; HardwareError when the new one is taken, impossible, or the servo holds torque."""
    if not 0 <= new <= packets.MAX_ID:
        raise HardwareError(f"an ID is 0 to {packets.MAX_ID}, got {new}")
    driver.ping(old)
    _need_limp(driver, old)
    if old == new:
        return
    try:
        taken = driver.ping(new)
    except NoAnswer:
        pass
    else:
        raise HardwareError(f"ID {new} is taken already, by a {taken.model}; two servos need two IDs")
    with suppress(NoAnswer):  # it may answer with its new ID; the ping decides
        driver.write_raw(old, "id", new)
    driver.ping(new)


def set_baud(driver: Driver, id: int, baud: int) -> None:
    """Change the bit rate of a servo, and the port's with it; HardwareError lists the rates of its model."""
    found = driver.ping(id)
    if found.table is None:
        raise HardwareError(f"servo {id} is of an {found.model}; its bit rates are not known")
    _need_limp(driver, id)
    values = {rate: value for value, rate in found.table.bauds.items()}
    if baud not in values:
        known = ", ".join(f"{b:_}" for b in values)
        raise HardwareError(f"{found.model} has no bit rate {baud:_}; it has: {known}")
    before = driver.port.getBaudRate()
    with suppress(NoAnswer):  # the answer may come at the new rate; the ping decides
        driver.write_raw(id, "baud_rate", values[baud])
    if not driver.port.setBaudRate(baud):
        driver.port.setBaudRate(before)
        raise HardwareError(f"the port cannot do {baud:_} bit/s")
    driver.ping(id)


def _need_limp(driver: Driver, id: int) -> None:
    if driver.read_raw(id, "torque_enable"):
        raise HardwareError(
            f"{driver.label(id)} holds torque, which locks its EEPROM; release it first: "
            "'pantograph servo stop --limp'"
        )
