"""What follows from the registers of a virtual servo: modes, goals, frames, torque, watchdog, errors.

Behaviour follows the e-manual pages of the X series; where they are silent or the notes of users disagree,
the choice is an argument of `Quirks` and set to the harsher case.
"""

from __future__ import annotations

from dataclasses import dataclass

from ..packets import StatusError
from ..registers import ControlTable, Register
from ..tables.rows import POSITION
from . import drive as d
from .drive import Drive, within_one_turn
from .mapping import counts, settings
from .memory import Memory

GOALS = ("goal_pwm", "goal_current", "goal_velocity", "goal_position")
GOALS_OF_MODE = {0: GOALS[1], 1: GOALS[2], 3: GOALS[3], 4: GOALS[3], 5: GOALS[3], 16: GOALS[0]}


@dataclass(frozen=True)
class Quirks:
    """What the manual leaves open.

    Args:
        goal_survives_torque_off: At torque-on the servo goes to the old goal (True, the dangerous case) or
            holds.
        effort_goals_open: After power-on and a change of mode Goal PWM and Goal Current stand at their
            limits in every mode, as the manual says: torque-on in PWM or current mode then runs at full
            power. False: zero in the mode that they drive.
        goal_limit_error: Answer to a goal position outside of the position limits.
        boot_time: Silence after a reboot [s].
        overload_ratio, overload_time: Overload is this part of the stall current for this long [s].
    """

    goal_survives_torque_off: bool = True
    effort_goals_open: bool = True
    goal_limit_error: StatusError = StatusError.DATA_LIMIT
    boot_time: float = 0.1
    overload_ratio: float = 0.8
    overload_time: float = 1.0


class Firmware:
    """A control table that governs a drive."""

    def __init__(self, table: ControlTable, drive: Drive, quirks: Quirks) -> None:
        self.table, self.drive, self.quirks = table, drive, quirks
        self.memory = Memory(table)
        self.time = 0.0
        self._latched = 0  # hardware error bits
        self._offset = 0  # homing offset in effect
        self._watchdog_period = 0.0
        self._fed = 0.0  # time of the last instruction
        self._fresh = -1.0  # time of the last report of the drive

    def feed(self) -> None:
        """The servo heard an instruction packet: its bus watchdog starts again."""
        self._fed = self.time

    def trip_watchdog(self) -> None:
        """Stop as the bus watchdog does: motion off, profiles 0, goals locked."""
        self.memory.put("bus_watchdog", -1)
        self.memory.put("profile_velocity", 0)
        self.memory.put("profile_acceleration", 0)
        goal = GOALS_OF_MODE[self.memory.get("operating_mode")]
        if goal != "goal_position":
            self.memory.put(goal, 0)
        self._apply_settings()
        self.drive.halt()

    def fail(self, bit: int) -> None:
        """Latch a hardware error; one that the shutdown register selects takes the torque away."""
        self._latched |= bit
        self.memory.put("hardware_error_status", self._latched)
        if self._latched & self.memory.get("shutdown"):
            self.memory.put("torque_enable", 0)
            self._apply_settings()

    def _default_goals(self) -> None:
        """Goals after power-on or a change of mode: the position is the present one, limits are open."""
        memory, mode = self.memory, self.memory.get("operating_mode")
        shut = not self.quirks.effort_goals_open
        memory.put("goal_pwm", 0 if shut and mode == d.PWM_MODE else memory.get("pwm_limit"))
        if self.table.has_current:
            memory.put("goal_current", 0 if shut and mode == d.CURRENT_MODE else memory.get("current_limit"))
        memory.put("goal_velocity", 0)
        memory.put("goal_position", counts(self.drive.position))
        self._apply_settings()
        self.drive.hold()

    def _reset_turns(self) -> None:
        """Report the shaft within one turn, homing offset added."""
        offset = self.memory.get("homing_offset")
        if self.memory.get("operating_mode") == d.POSITION_MODE and abs(offset) > 1024:
            offset = 0
        sign = -1.0 if self.drive.settings.reverse else 1.0
        self.drive.place(within_one_turn(sign * self.drive.shaft) + offset * POSITION)
        self._offset = offset

    def _apply_settings(self) -> None:
        """Let the drive follow the registers; called after every change of one."""
        watchdog = self.memory.get("bus_watchdog")
        self._watchdog_period = watchdog * 0.02 if watchdog > 0 else 0.0
        self._fresh = -1.0
        self.drive.settings = settings(self.memory, reverse=self.drive.settings.reverse)

    def _torque(self, on: bool) -> None:
        if on and self._latched & self.memory.get("shutdown"):
            return  # only a reboot recovers
        was = self.drive.settings.torque
        self.memory.put("torque_enable", int(on))
        if on and not was:
            if self.memory.get("operating_mode") == d.POSITION_MODE:
                self._reset_turns()
            self._fed = self.time
            self.drive.hold()
            if not self.quirks.goal_survives_torque_off:
                self.memory.put("goal_position", counts(self.drive.position))
            self._apply_settings()
            if not self.drive.halted:
                self.drive.plan()
        self._apply_settings()

    def _refusal(self, row: Register, raw: int, shadow: bool) -> StatusError:
        if row.area == "EEPROM" and (self.drive.settings.torque or shadow):
            return StatusError.ACCESS
        if row.name in GOALS and self.memory.get("bus_watchdog") == -1:
            return StatusError.DATA_RANGE
        if row.name == "bus_watchdog" and raw and self.memory.get(row.name) == -1:
            return StatusError.DATA_RANGE  # only 0 clears it
        if row.name == "operating_mode" and raw not in self.table.modes:
            return StatusError.DATA_RANGE
        if row.name == "goal_position":
            mode = self.memory.get("operating_mode")
            if mode == d.POSITION_MODE:
                low, high = self.memory.get("min_position_limit"), self.memory.get("max_position_limit")
                return StatusError.NONE if low <= raw <= high else self.quirks.goal_limit_error
            if abs(raw) > 1_048_575:
                return StatusError.DATA_RANGE
        return self.memory.check(row, raw)

    def _set(self, row: Register, raw: int) -> None:
        """Store a value and do what follows from it."""
        name = row.name
        if name == "torque_enable":
            self._torque(bool(raw))
            return
        tripped = name == "bus_watchdog" and self.memory.get(name) == -1
        self.memory.put(name, raw)
        if name == "bus_watchdog":
            self._fed = self.time
            self._apply_settings()
            if tripped and raw == 0:
                self._resume()
        elif name == "operating_mode":
            self._change_mode()
        elif name in ("homing_offset", "drive_mode"):
            self._change_frame()
        elif name in GOALS:
            self._new_goal(name)
        else:
            self._apply_settings()

    def _resume(self) -> None:
        self.memory.put("goal_position", counts(self.drive.position))
        self._apply_settings()
        self.drive.resume()

    def _change_mode(self) -> None:
        """Profiles and gains fall back to their defaults (manual: Operating Mode)."""
        for row in self.table.registers:
            if row.name.endswith("_gain") or row.name.startswith("profile_"):
                self.memory.put(row.name, row.default or 0)
        self._apply_settings()
        if self.memory.get("operating_mode") == d.POSITION_MODE:
            self._reset_turns()
        self._default_goals()

    def _change_frame(self) -> None:
        """Homing offset or reverse mode: the same shaft angle reads differently, turns are kept."""
        drive = self.drive
        actual = drive.position - self._offset * POSITION
        offset = self.memory.get("homing_offset")
        if self.memory.get("operating_mode") == d.POSITION_MODE and abs(offset) > 1024:
            offset = 0
        reverse = bool(self.memory.get("drive_mode") & 1)
        if reverse != drive.settings.reverse:
            drive.settings.reverse = reverse
            actual = -actual
        drive.place(actual + offset * POSITION)
        self._offset = offset
        self._apply_settings()
        drive.hold()

    def _new_goal(self, name: str) -> None:
        active = GOALS_OF_MODE[self.memory.get("operating_mode")]
        if name == active and self.memory.get("drive_mode") & 8 and not self.drive.settings.torque:
            self._torque(True)
        self._apply_settings()
        if name == active and self.drive.settings.torque:
            self.drive.plan()
