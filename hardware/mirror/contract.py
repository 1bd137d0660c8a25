"""The safety contract, step by step: what is looked at and written before a rig may move, and how it stops.

No servo gets torque before its goal is where it stands; every write here is answered or read back.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..driver import Block, Driver, Found, NoAnswer, Refused
from ..errors import BusError, HardwareError
from ..mapping import Bounds, Mapping
from ..rig import Rig
from ..tables.rows import POSITION

Array = NDArray[np.float64]
Phase = Literal["scan", "prepare", "torque on", "ramp", "stream", "stop"]

POSITION_MODE, CURRENT_POSITION_MODE = 3, 5
FEEDBACK = (
    "present_position",
    "present_velocity",
    "present_current|present_load",
    "hardware_error_status",
    "bus_watchdog",
    "torque_enable",
    "goal_position",
)
HARDWARE_ERRORS = {0: "input voltage", 2: "overheating", 3: "encoder", 4: "electrical shock", 5: "overload"}
_PROFILE_MARGIN = 1.25  # of the servo's own speed cap over the limit that goals keep
_APART = 0.1  # rad that servos on one joint may disagree
_HOT = 5.0  # K below the temperature limit at which the rig will not start


class RigFault(HardwareError):
    """Something is wrong with the rig: in which phase, and with which servo."""

    def __init__(self, phase: Phase, message: str, *, servo: int | None = None) -> None:
        super().__init__(message)
        self.phase, self.servo = phase, servo


@dataclass(frozen=True)
class Ready:
    """A rig that was checked and prepared.

    block: feedback of all servos in one read; present (ns,) [rad]; changed: EEPROM settings that were
    rewritten; torque: whether the servos held themselves already.
    """

    block: Block
    present: Array
    changed: tuple[str, ...]
    torque: bool


def error_names(bits: int) -> str:
    """Names of the bits of a hardware error status."""
    names = [name for bit, name in HARDWARE_ERRORS.items() if bits >> bit & 1]
    return " and ".join(names) or f"unknown error {bits:#04x}"


def scan(driver: Driver, rig: Rig, bounds: Bounds | None, *, take_over: bool = False) -> bool:
    """Whether torque is on; RigFault with every mismatch between the rig file and the servos found.

    With `bounds`, position limits of the servos that are narrower are mismatches too.
    """
    wrong: list[tuple[int, str]] = []
    on = []
    for item in rig.servos:
        id = item.id
        try:
            found = driver.ping(id)
            wrong += [(id, text) for text in _mismatches(driver, rig, id, found, take_over)]
            if found.table is not None and bounds is not None:
                wrong += [(id, text) for text in _too_narrow(driver, rig, id, bounds)]
            if found.table is not None and driver.read_raw(id, "torque_enable"):
                on.append(id)
        except (NoAnswer, Refused) as e:
            wrong.append((id, str(e)))
    if wrong:
        lines = "\n".join(f"  {text}" for _, text in wrong)
        count = "1 mismatch" if len(wrong) == 1 else f"{len(wrong)} mismatches"
        servo = wrong[0][0] if len({id for id, _ in wrong}) == 1 else None
        raise RigFault("scan", f"{rig.file}: the rig is not as described, {count}\n{lines}", servo=servo)
    return bool(on)


def _mismatches(driver: Driver, rig: Rig, id: int, found: Found, take_over: bool) -> Iterable[str]:
    item, label = next(s for s in rig.servos if s.id == id), rig.label(id)
    if found.model != item.model.lower():
        yield f"{label} is {found.model}, the rig file says {item.model}"
    if found.table is None:
        return
    if error := driver.read_raw(id, "hardware_error_status"):
        yield f"{label} reports a hardware error: {error_names(error)}; find the cause, then reboot it"
    if driver.read_raw(id, "torque_enable") and not take_over:
        yield f"{label} has its torque on already, perhaps by another program; --take-over accepts that"
    volts, low, high = (
        driver.read(id, n) for n in ("present_input_voltage", "min_voltage_limit", "max_voltage_limit")
    )
    if not low <= volts <= high:
        yield f"{label} has {volts:.1f} V; it works from {low:.1f} to {high:.1f} V"
    hot, limit = driver.read(id, "present_temperature"), driver.read(id, "temperature_limit")
    if hot > limit - _HOT:
        yield f"{label} has {hot:.0f} degC, its limit is {limit:.0f}; let it cool down"
    if driver.read_raw(id, "secondary_id") in rig.ids:
        shadow = driver.read_raw(id, "secondary_id")
        yield f"{label} has the secondary ID {shadow}, which is {rig.label(shadow)}; set it to 255"


def _too_narrow(driver: Driver, rig: Rig, id: int, bounds: Bounds) -> Iterable[str]:
    """Goals beyond a servo's own limits are refused without an answer: better to know before."""
    i = rig.ids.index(id)
    low, high = (driver.read(id, n) for n in ("min_position_limit", "max_position_limit"))
    if low > bounds.low[i] + POSITION or high < bounds.high[i] - POSITION:
        yield (
            f"{rig.label(id)} has position limits of {low:.3f} to {high:.3f} rad, the rig file asks for "
            f"{bounds.low[i]:.3f} to {bounds.high[i]:.3f}: narrow the range there, or widen the limits"
        )


def prepare(driver: Driver, rig: Rig, mapping: Mapping, bounds: Bounds, *, torque: bool) -> Ready:
    """Settings, profiles, feedback block, goal := present: everything but torque."""
    changed: dict[str, list[int]] = {}
    for i, item in enumerate(rig.servos):
        id = item.id
        driver.write_raw(id, "status_return_level", 2)
        driver.write_raw(id, "bus_watchdog", 0)  # a tripped one refuses goals
        mode = CURRENT_POSITION_MODE if item.current else POSITION_MODE
        for name, raw in (("drive_mode", 0), ("operating_mode", mode), ("return_delay_time", 0)):
            found = driver.read_raw(id, name)
            if found != raw:
                if torque:
                    raise RigFault(
                        "prepare",
                        f"{rig.label(id)} has {name} {found}, {raw} is needed; EEPROM is locked while torque "
                        "is on: release it first ('pantograph servo stop --limp')",
                        servo=id,
                    )
                driver.write_raw(id, name, raw)
                changed.setdefault(f"{name} {found} -> {raw}", []).append(id)
        driver.return_delay[id] = driver.read(id, "return_delay_time")
        # After the mode: changing it puts profiles and gains back.
        _write_at_least_one(driver, id, "profile_velocity", _PROFILE_MARGIN * bounds.velocity[i])
        acceleration = item.profile_acceleration
        if acceleration:
            _write_at_least_one(driver, id, "profile_acceleration", acceleration * rig.unit)
        else:
            driver.write_raw(id, "profile_acceleration", 0)
        if item.gain is not None:
            driver.write_raw(id, "position_p_gain", item.gain)
        if item.current:
            driver.write(id, "goal_current", item.current)
    block = driver.map_block(rig.ids, FEEDBACK)
    present = np.array([_goal_to_present(driver, rig, id) for id in rig.ids])
    apart = mapping.disagreement(present)
    if np.max(np.abs(apart)) > _APART:
        id = rig.ids[int(np.argmax(np.abs(apart)))]
        raise RigFault(
            "prepare",
            f"{rig.label(id)} is {np.max(np.abs(apart)):.3f} rad from where the other servo of its joint "
            "puts it: they would fight; check direction and zero",
            servo=id,
        )
    notes = tuple(f"{what} on servo {', '.join(map(str, ids))}" for what, ids in changed.items())
    return Ready(block, present, notes, torque)


def _write_at_least_one(driver: Driver, id: int, name: str, value: float) -> None:
    """A profile register of 0 means no limit: never round down to it."""
    row = driver.register(id, name)
    high = row.maximum if row.maximum is not None else row.span[1]
    driver.write_raw(id, name, min(max(1, row.from_si(value)), high))


def _goal_to_present(driver: Driver, rig: Rig, id: int) -> float:
    """Write goal := present and read it back; the present position [rad]."""
    raw = driver.read_raw(id, "present_position")
    try:
        driver.write_raw(id, "goal_position", raw)
    except Refused as e:
        low, high = (driver.read(id, n) for n in ("min_position_limit", "max_position_limit"))
        at = driver.register(id, "present_position").to_si(raw)
        raise RigFault(
            "prepare",
            f"{rig.label(id)} stands at {at:.3f} rad, its limits are {low:.3f} to {high:.3f} rad: move it "
            f"inside by hand, or widen them ({e})",
            servo=id,
        ) from None
    if (goal := driver.read_raw(id, "goal_position")) != raw:
        raise RigFault("prepare", f"{rig.label(id)} keeps its goal at {goal}, asked for {raw}", servo=id)
    return driver.register(id, "present_position").to_si(raw)


def torque_on(driver: Driver, rig: Rig) -> None:
    """Arm every watchdog, then give torque, servo by servo, and look whether each took it."""
    for id in rig.ids:
        row = driver.register(id, "bus_watchdog")
        driver.write_raw(id, "bus_watchdog", max(1, row.from_si(rig.watchdog)))
    for id in rig.ids:
        driver.write_raw(id, "torque_enable", 1)
        if not driver.read_raw(id, "torque_enable"):
            error = driver.read_raw(id, "hardware_error_status")
            why = f" for a hardware error: {error_names(error)}" if error else ""
            raise RigFault("torque on", f"{rig.label(id)} does not take torque{why}", servo=id)
        if error := driver.read_raw(id, "hardware_error_status"):
            raise RigFault(
                "torque on", f"{rig.label(id)} reports a hardware error: {error_names(error)}", servo=id
            )


def release(driver: Driver, rig: Rig) -> dict[int, str]:
    """Torque off, everywhere; by ID, what could not be confirmed."""
    with suppress(BusError):
        for _ in range(2):  # the quickest word first: one packet to all, unanswered
            driver.sync_write(rig.ids, "torque_enable", [0] * len(rig.ids))

    def let_go(id: int) -> None:
        driver.write_raw(id, "torque_enable", 0)

    return _each(driver, rig, "let go", let_go, torque=0)


def freeze(driver: Driver, rig: Rig, *, at_present: bool) -> dict[int, str]:
    """Hold: goal := present (or keep the goal), watchdog off, torque on; by ID, what could not be confirmed.

    A servo that cannot be reached keeps its watchdog, which stops it.
    """

    def hold(id: int) -> None:
        if driver.read_raw(id, "bus_watchdog") < 0:
            # clearing a tripped one could start an old goal
            raise RigFault("stop", _TRIPPED, servo=id)
        if at_present:
            driver.write_raw(id, "goal_position", driver.read_raw(id, "present_position"))
        driver.write_raw(id, "bus_watchdog", 0)

    return _each(driver, rig, "hold", hold, torque=1)


_TRIPPED = "stands already, since its bus watchdog tripped; its torque stays on"


def _each(driver: Driver, rig: Rig, what: str, act: Callable[[int], None], *, torque: int) -> dict[int, str]:
    """Do it to every servo, then look at every servo again: torque as wanted, no error."""

    def look(id: int) -> None:
        error, now = (driver.read_raw(id, n) for n in ("hardware_error_status", "torque_enable"))
        state = f"its torque is {'on' if now else 'off'}"
        if error:
            raise RigFault("stop", f"reports a hardware error: {error_names(error)}; {state}", servo=id)
        if now != torque:
            raise RigFault("stop", f"did not {what}: {state}", servo=id)
        if torque and driver.read_raw(id, "bus_watchdog") < 0:
            raise RigFault("stop", _TRIPPED, servo=id)

    failed: dict[int, str] = {}
    left = f"its watchdog stops it in {rig.watchdog:g} s, its torque may stay on"
    for step in (act, look):
        for id in rig.ids:
            if id in failed:
                continue
            try:
                step(id)
            except RigFault as e:
                failed[id] = str(e)
            except Refused as e:
                failed[id] = f"did not {what}: {e}"
            except NoAnswer:
                failed[id] = f"did not confirm to {what}; {left}"
            except BusError as e:
                failed[id] = f"is out of reach ({e}); {left}"
    return failed


def sentences(rig: Rig, failed: dict[int, str]) -> list[str]:
    """What could not be confirmed, in words: those with the same trouble together."""
    together: dict[str, list[int]] = {}
    for id, trouble in failed.items():
        together.setdefault(trouble, []).append(id)
    return [f"{', '.join(map(rig.label, ids))}: {trouble}" for trouble, ids in together.items()]
