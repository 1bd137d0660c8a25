"""Control tables of Dynamixel servos as frozen rows, with conversion between raw counts and SI units.

The rows themselves are data in `tables/`, with the manual page of every model. Position zero is the middle of
the turn (2048 counts), as in the `.model` files of the official SDK.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, cached_property
from types import MappingProxyType
from typing import Literal

from .errors import RegisterError, unknown

Area = Literal["EEPROM", "RAM"]
Access = Literal["R", "RW"]

FIRST_RAM_ADDRESS = 64  # registers below are EEPROM, locked while torque is on


@dataclass(frozen=True, slots=True)
class Register:
    """One row of a control table.

    Args:
        name: Manual's name in snake case, `goal_position`.
        address: First byte.
        size: Bytes, 1, 2 or 4; little endian.
        signed: Two's complement.
        unit: Of the converted value: rad, rad/s, rad/s^2, A, V, V/s, s, degC, or "" (a count or ratio).
        scale: Unit per count.
        access: R or RW.
        default: Factory value in counts; None where the manual states none.
        minimum, maximum: Range of a write in counts; None where another register bounds it or nothing does.
        bound: Names of the registers that bound a write, (low, high); a leading minus negates.
        zero: Count at which the SI value is zero.
    """

    name: str
    address: int
    size: int
    signed: bool
    unit: str
    scale: float
    access: Access
    default: int | None = None
    minimum: int | None = None
    maximum: int | None = None
    bound: tuple[str, str] | None = None
    zero: int = 0

    @property
    def area(self) -> Area:
        """EEPROM (kept without power, locked while torque is on) or RAM."""
        return "EEPROM" if self.address < FIRST_RAM_ADDRESS else "RAM"

    @property
    def span(self) -> tuple[int, int]:
        """Least and greatest count that the bytes can hold."""
        bits = 8 * self.size
        return (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if self.signed else (0, (1 << bits) - 1)

    def to_si(self, raw: float) -> float:
        """Value in `unit` of a signed count (arrays pass through)."""
        return (raw - self.zero) * self.scale

    def from_si(self, value: float) -> int:
        """Nearest count of a value in `unit`; RegisterError when the bytes cannot hold it."""
        raw = round(value / self.scale) + self.zero
        self._check_span(raw, f"{value:g} {self.unit}")
        return raw

    def encode(self, raw: int) -> bytes:
        """Little-endian bytes of a signed count; RegisterError when it does not fit."""
        self._check_span(raw, str(raw))
        return raw.to_bytes(self.size, "little", signed=self.signed)

    def decode(self, data: bytes) -> int:
        """Signed count in little-endian bytes; RegisterError when there are not exactly `size`."""
        if len(data) != self.size:
            raise RegisterError(
                f"register {self.name!r} has {self.size} bytes, got {len(data)}: {data.hex(' ')}"
            )
        return int.from_bytes(data, "little", signed=self.signed)

    def sign(self, unsigned: int) -> int:
        """Signed count of the unsigned number that the official SDK returns."""
        bits = 8 * self.size
        return unsigned - (1 << bits) if self.signed and unsigned >> (bits - 1) else unsigned

    def time_based(self) -> Register:
        """The row as it reads while Drive Mode selects time-based profiles: milliseconds."""
        if self.name not in ("profile_acceleration", "profile_velocity"):
            raise RegisterError(
                f"register {self.name!r} does not depend on the profile type; only profile_* do"
            )
        return replace(self, unit="s", scale=1e-3)

    def _check_span(self, raw: int, given: str) -> None:
        low, high = self.span
        if not low <= raw <= high:
            raise RegisterError(
                f"{given} does not fit register {self.name!r} ({self.size} bytes): {low} to {high} counts, "
                f"{self.to_si(low):.4g} to {self.to_si(high):.4g} {self.unit}"
            )


@dataclass(frozen=True)
class IndirectBlock:
    """A run of indirect registers: address entries of 2 bytes, data entries of 1 byte."""

    first: int  # number in the manual of the first entry
    address: int
    data: int
    count: int


@dataclass(frozen=True)
class ControlTable:
    """Control table of one servo model.

    Args:
        model: Name, `xm430-w350`.
        number: Model number that a ping returns.
        page: Manual page that the rows were read from.
        registers: Rows in order of address.
        bauds: Bit rate [bit/s] by value of the baud_rate register.
        modes: Operating modes that the model knows.
        indirect: Runs of indirect registers.
        fast_read_firmware: First firmware version that answers fast sync read; None where no source says.
        unsourced: Names of registers whose default has no source for this model.
    """

    model: str
    number: int
    page: str
    registers: tuple[Register, ...]
    bauds: Mapping[int, int]
    modes: frozenset[int]
    indirect: tuple[IndirectBlock, ...]
    fast_read_firmware: int | None
    unsourced: frozenset[str] = frozenset()

    def __getitem__(self, name: str) -> Register:
        """Row of that name; RegisterError lists what exists."""
        try:
            return self._by_name[name]
        except KeyError:
            raise RegisterError(unknown("register", name, self._plain_names, where=self.model)) from None

    def __contains__(self, name: object) -> bool:
        return name in self._by_name

    def at(self, address: int) -> Register | None:
        """Row whose bytes hold an address, or None for a gap."""
        return self._by_address.get(address)

    @property
    def has_current(self) -> bool:
        """Whether the model measures and controls current (else register 126 is a load in percent)."""
        return "present_current" in self

    @property
    def size(self) -> int:
        """Bytes in the table: one past the last address."""
        last = self.registers[-1]
        return last.address + last.size

    @cached_property
    def _by_name(self) -> dict[str, Register]:
        return {r.name: r for r in self.registers}

    @cached_property
    def _by_address(self) -> dict[int, Register]:
        return {a: r for r in self.registers for a in range(r.address, r.address + r.size)}

    @property
    def _plain_names(self) -> list[str]:
        """Names without the long runs of indirect registers, for messages."""
        return [n for n in self._by_name if not n.startswith("indirect_") or n.endswith("_1")]


def model_names() -> tuple[str, ...]:
    """Names of every servo model that has a table."""
    from .tables.models import MODELS

    return tuple(MODELS)


@cache
def control_table(model: str | int) -> ControlTable:
    """Control table by model name (`xm430-w350`, any case) or number (1020); RegisterError lists them."""
    from .tables.models import MODELS, build

    if isinstance(model, int):
        for name, row in MODELS.items():
            if row.number == model:
                return control_table(name)
        numbers = ", ".join(f"{row.number} {name}" for name, row in MODELS.items())
        raise RegisterError(f"no control table for model number {model}; known: {numbers}")
    if model in MODELS:
        return build(model)
    if model.lower() in MODELS:
        return control_table(model.lower())
    raise RegisterError(unknown("servo model", model, MODELS, where="Pantograph"))


BAUD_RATES: Mapping[int, int] = MappingProxyType(
    {0: 9_600, 1: 57_600, 2: 115_200, 3: 1_000_000, 4: 2_000_000, 5: 3_000_000, 6: 4_000_000, 7: 4_500_000}
)
"""Bit rate by value of register 8, manual `baud-rate`."""
