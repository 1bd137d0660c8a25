"""A virtual servo: what a bus and the world see of it, around its firmware and drive."""

from __future__ import annotations

from math import inf

from ..errors import HardwareError
from ..packets import ALERT, BROADCAST, MAX_ID, Packet, StatusError
from ..registers import FIRST_RAM_ADDRESS, control_table
from ..tables.rows import VELOCITY
from .drive import PERIOD, Drive
from .firmware import Firmware, Quirks
from .instructions import execute
from .mapping import counts, report
from .motor import MOTORS, Gear, Motor, Plant

VOLTAGE, OVERHEATING, ENCODER, SHOCK, OVERLOAD = 0x01, 0x04, 0x08, 0x10, 0x20
SLOW = 10  # control periods between updates of voltage, temperature and protection


class VirtualServo(Firmware):
    """One servo on a virtual bus.

    Kept but without effect: feedforward gains, PWM slope, acceleration limit, external ports, LED, a
    protocol type other than 2.0, and restoring RAM at startup.

    Args:
        model: Name or number of a model that has a control table.
        id: 0 to 252.
        baud: Bit rate [bit/s]; factory value 57,600.
        position: Shaft angle at power-on [rad], zero in the middle of the turn.
        plant: What the shaft drives; a bare gear when None.
        motor: Constants; those of the model when None.
        firmware: Version; the first that answers fast reads when None.
        supply: Voltage [V]; the recommended one when None.
        ambient: Temperature [degC].
        quirks: What the manual leaves open; the harsher cases when None.
        registers: Values in counts, by name, in place of the factory's; those of RAM last until a reboot.

    Raises:
        RegisterError: no such model or register, or a value that does not fit it.
        HardwareError: the model does not have the bit rate.
    """

    def __init__(
        self,
        model: str | int,
        id: int = 1,
        *,
        baud: int = 57_600,
        position: float = 0.0,
        plant: Plant | None = None,
        motor: Motor | None = None,
        firmware: int | None = None,
        supply: float | None = None,
        ambient: float = 25.0,
        quirks: Quirks | None = None,
        registers: dict[str, int] | None = None,
    ) -> None:
        table = control_table(model)
        motor = motor or MOTORS[table.model]
        plant = plant or Gear(motor.inertia, motor.coulomb, position=position)
        supply = motor.voltage if supply is None else supply
        super().__init__(table, Drive(motor, plant, supply=supply, ambient=ambient), quirks or Quirks())
        self.dead = False
        self._overload = 0.0
        self._periods = 0
        self._boot_until = -inf
        self._registered: tuple[int, bytes, bool] | None = None
        self._backup: bytes | None = None
        self.firmware = firmware or self.table.fast_read_firmware or 45
        self._factory()
        self.memory.put("id", id)
        self.memory.put("baud_rate", self._baud_value(baud))
        given = {self.table[name]: raw for name, raw in (registers or {}).items()}
        for row, raw in given.items():
            row.encode(raw)
            if row.area == "EEPROM":
                self.memory.put(row.name, raw)
        self._power_on()
        for row, raw in given.items():
            if row.area == "RAM":
                self._set(row, raw)

    # State that a bus and a test look at.

    @property
    def id(self) -> int:
        """ID, register 7."""
        return self.memory.get("id")

    @property
    def baud(self) -> int:
        """Bit rate [bit/s]."""
        return self.table.bauds[self.memory.get("baud_rate")]

    @property
    def return_delay(self) -> float:
        """Time before a reply [s]."""
        return self.memory.get("return_delay_time") * 2e-6

    @property
    def awake(self) -> bool:
        """Whether the servo is powered, alive and done booting."""
        return not self.dead and self.time >= self._boot_until

    def get(self, name: str) -> int:
        """Signed count in a register as the host would read it now; RegisterError for an unknown name."""
        row = self.table[name]
        self._refresh()
        return self.memory.get(row.name)

    def si(self, name: str) -> float:
        """Register in SI units."""
        return self.table[name].to_si(self.get(name))

    @property
    def ids(self) -> tuple[int, ...]:
        """Own ID, and the shadow ID when there is one."""
        own, shadow = self.id, self.memory.get("secondary_id")
        return (own, shadow) if shadow <= MAX_ID and shadow != own else (own,)

    def answers_to(self, id: int) -> bool:
        """Whether a packet with this ID is executed here (own ID, shadow ID or broadcast)."""
        return id == BROADCAST or id in self.ids

    @property
    def reads_fast(self) -> bool:
        """Whether the firmware answers fast sync and bulk reads; where no source says, it does not."""
        first = self.table.fast_read_firmware
        return first is not None and self.firmware >= first

    def revive(self) -> None:
        """Power comes back after a dead time."""
        self.dead = False
        self.reboot()

    # Time.

    def step(self) -> None:
        """Advance one control period of 1 ms."""
        self.time += PERIOD
        if self.dead:
            self.drive.settings.torque = False
        self.drive.step()
        self._periods += 1
        if self._periods % SLOW == 0:
            self.drive.warm(SLOW * PERIOD)
            self._protect(SLOW * PERIOD)
        watchdog = self._watchdog_period
        if watchdog and self.drive.settings.torque and self.time - self._fed > watchdog:
            self.trip_watchdog()

    def _protect(self, dt: float) -> None:
        drive, memory = self.drive, self.memory
        if drive.temperature > memory.get("temperature_limit"):
            self.fail(OVERHEATING)
        volts = round(drive.voltage * 10)
        if not memory.get("min_voltage_limit") <= volts <= memory.get("max_voltage_limit"):
            self.fail(VOLTAGE)
        heavy = abs(drive.current) >= self.quirks.overload_ratio * drive.motor.stall_current
        self._overload = self._overload + dt if heavy else 0.0
        if self._overload > self.quirks.overload_time:
            self.fail(OVERLOAD)

    # Power and factory values.

    def _baud_value(self, baud: int) -> int:
        for value, rate in self.table.bauds.items():
            if rate == baud:
                return value
        known = ", ".join(f"{b:,}" for b in self.table.bauds.values())
        raise HardwareError(f"{self.table.model} has no bit rate {baud:,}; it has: {known}")

    def _factory(self) -> None:
        """Factory values of EEPROM and RAM; a velocity limit without a source becomes the no-load speed."""
        for row in self.table.registers:
            self.memory.put(row.name, row.default or 0)
        if self.table["velocity_limit"].default is None:
            self.memory.put("velocity_limit", round(self.drive.motor.no_load_speed / VELOCITY))
        self.memory.put("firmware_version", self.firmware)

    def _power_on(self) -> None:
        """RAM as after power-on: turns are lost, goals are where the servo is."""
        memory = self.memory
        for row in self.table.registers:
            if row.address >= FIRST_RAM_ADDRESS:
                memory.put(row.name, row.default or 0)
        if "backup_ready" in self.table:
            memory.put("backup_ready", int(self._backup is not None))
        self._latched, self._registered, self._overload = 0, None, 0.0
        self.drive.halted = False
        self.drive.settings.reverse = bool(memory.get("drive_mode") & 1)
        self._apply_settings()
        self._reset_turns()
        self._default_goals()
        if "startup_configuration" in self.table and memory.get("startup_configuration") & 1:
            self._torque(True)
        self._fresh = -1.0

    def reboot(self) -> None:
        """Restart: RAM is as after power-on, errors are forgotten, nothing is heard for the boot time."""
        self._power_on()
        self._boot_until = self.time + self.quirks.boot_time

    # What instructions do.

    def execute(self, packet: Packet) -> Packet | None:
        """Carry out an instruction for this servo; the reply, or None when there is none.

        Sync and bulk instructions, whose replies form a chain, are the bus's; it calls `write` and
        `reply_to_read`.
        """
        return execute(self, packet)

    def error_byte(self, error: StatusError) -> int:
        """Error byte of a reply: the number, and the alert bit while a hardware error is latched."""
        return error | (ALERT if self._latched else 0)

    def _refresh(self) -> None:
        if self._fresh != self.time:
            self._fresh = self.time
            report(self.memory, self.drive, self.time)

    def read(self, address: int, length: int) -> tuple[StatusError, bytes]:
        """Bytes as the host reads them."""
        self._refresh()
        return self.memory.read(address, length)

    def reply_to_read(self, address: int, length: int) -> tuple[int, bytes] | None:
        """(Error byte, data) for a link of a sync or bulk read, or None when replies are switched off."""
        if self.memory.get("status_return_level") == 0:
            return None
        error, data = self.read(address, length)
        return self.error_byte(error), data

    def write(self, address: int, data: bytes, *, shadow: bool = False) -> StatusError:
        """Write as the host does: all of the registers or none; the error that it is answered."""
        error, values = self.memory.parse(address, data)
        if error:
            return error
        for row, raw in values.items():
            if error := self._refusal(row, raw, shadow):
                return error
        for row, raw in values.items():
            self._set(row, raw)
        return StatusError.NONE

    def register(self, address: int, data: bytes, *, shadow: bool = False) -> StatusError:
        """Keep a write until the action comes."""
        error, _ = self.memory.parse(address, data)
        if not error:
            self._registered = (address, data, shadow)
            self.memory.put("registered_instruction", 1)
        return error

    def act(self) -> StatusError:
        """Do the write that was registered."""
        if self._registered is None:
            return StatusError.INSTRUCTION
        address, data, shadow = self._registered
        self._registered = None
        self.memory.put("registered_instruction", 0)
        return self.write(address, data, shadow=shadow)

    def clear_turns(self) -> StatusError:
        """Bring the present position back into one turn; the servo must stand still."""
        if self.get("moving"):
            return StatusError.RESULT_FAIL
        self._reset_turns()
        self.memory.put("goal_position", counts(self.drive.position))
        self._apply_settings()
        self.drive.hold()
        return StatusError.NONE

    def factory_reset(self, keep: tuple[str, ...]) -> StatusError:
        """Factory values but for the registers to keep, then a reboot."""
        kept = {name: self.memory.get(name) for name in keep}
        self._factory()
        for name, raw in kept.items():
            self.memory.put(name, raw)
        self.reboot()
        return StatusError.NONE

    def store(self) -> StatusError:
        """Keep the EEPROM in the backup area; torque must be off."""
        if self.drive.settings.torque:
            return StatusError.RESULT_FAIL
        self._backup = self.memory.eeprom()
        if "backup_ready" in self.table:
            self.memory.put("backup_ready", 1)
        return StatusError.NONE

    def restore(self) -> StatusError:
        """Bring the EEPROM back from the backup area and reboot; torque must be off."""
        if self.drive.settings.torque or self._backup is None:
            return StatusError.RESULT_FAIL
        self.memory.bytes[:FIRST_RAM_ADDRESS] = self._backup
        self.reboot()
        return StatusError.NONE
