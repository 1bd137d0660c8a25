"""The bytes behind a control table, with access rules: what a read returns and what a write is answered."""

from __future__ import annotations

from ..packets import StatusError
from ..registers import FIRST_RAM_ADDRESS, ControlTable, Register


class Memory:
    """Control table of one servo as bytes.

    `get` and `put` are the servo's own, unchecked access by name; `read` and `write` are the host's, by
    address, through indirect registers, with the rules of the protocol.
    """

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self.bytes = bytearray(table.size)
        self._row = {r.name: r for r in table.registers}
        self._pointer = {
            block.data + i: block.address + 2 * i for block in table.indirect for i in range(block.count)
        }
        for register in table.registers:
            self.put(register.name, register.default or 0)

    def get(self, name: str) -> int:
        """Signed count in a register."""
        r = self._row[name]
        return int.from_bytes(self.bytes[r.address : r.address + r.size], "little", signed=r.signed)

    def put(self, name: str, raw: int) -> None:
        """Set a register; a value outside the bytes is held at their limit, as a servo's own sensors do."""
        r = self._row[name]
        low, high = r.span
        raw = low if raw < low else high if raw > high else raw
        self.bytes[r.address : r.address + r.size] = raw.to_bytes(r.size, "little", signed=r.signed)

    def _place(self, address: int) -> int:
        """Address that an indirect data byte stands for; any other address itself."""
        pointer = self._pointer.get(address)
        return address if pointer is None else self.bytes[pointer] | self.bytes[pointer + 1] << 8

    def read(self, address: int, length: int) -> tuple[StatusError, bytes]:
        """Bytes from an address on; gaps between registers read as zero."""
        if length < 1 or address + length > self.table.size:
            return StatusError.ACCESS, b""
        return StatusError.NONE, bytes(self.bytes[self._place(a)] for a in range(address, address + length))

    def parse(self, address: int, data: bytes) -> tuple[StatusError, dict[Register, int]]:
        """Registers and counts that a write means, or the error that it is answered."""
        placed: dict[int, int] = {}
        for offset, byte in enumerate(data):
            if address + offset >= self.table.size:
                return StatusError.ACCESS, {}
            placed[self._place(address + offset)] = byte
        if not data:
            return StatusError.DATA_LENGTH, {}
        values: dict[Register, int] = {}
        for place in placed:
            r = self.table.at(place)
            if r is None or r.access == "R":
                return StatusError.ACCESS, {}
            if r not in values:
                span = range(r.address, r.address + r.size)
                if any(a not in placed for a in span):
                    return StatusError.DATA_LENGTH, {}
                values[r] = r.decode(bytes(placed[a] for a in span))
        return StatusError.NONE, values

    def check(self, register: Register, raw: int) -> StatusError:
        """Whether a value is in the range of the row, and within the registers that bound it.

        Position limits bind in position mode alone; the servo checks them.
        """
        low, high = register.minimum, register.maximum
        if (low is not None and raw < low) or (high is not None and raw > high):
            return StatusError.DATA_RANGE
        if register.bound and register.name != "goal_position":
            least, most = (-self.get(n[1:]) if n.startswith("-") else self.get(n) for n in register.bound)
            if not least <= raw <= most:
                return StatusError.DATA_LIMIT
        return StatusError.NONE

    def eeprom(self) -> bytes:
        """The part that survives a loss of power."""
        return bytes(self.bytes[:FIRST_RAM_ADDRESS])
