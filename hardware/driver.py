"""The servos of one bus in SI units. Values are unsigned on the wire: registers carry their sign."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import packets
from .errors import HardwareError
from .exchange import Block, Found, NoAnswer, Refused, Reply, Statistics
from .link import FACTORY_RETURN_DELAY, STATUS, Link, Question, hint
from .packets import BROADCAST
from .ports import BITS_PER_BYTE, Clock
from .registers import BAUD_RATES, ControlTable, Register, control_table

Array = NDArray[np.float64]

__all__ = ["Block", "Driver", "Found", "NoAnswer", "Refused", "Reply", "Statistics"]

_PACK = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h", (4, False): "I", (4, True): "i"}


class Driver(Link):
    """A link that knows the servos at its other end: their registers by name, all of them at once.

    Arguments as of `Link`.
    """

    def __init__(self, port: Any, clock: Clock, **options: Any) -> None:
        super().__init__(port, clock, **options)
        self.tables: dict[int, ControlTable] = {}
        self.firmware: dict[int, int] = {}
        self.return_delay: dict[int, float] = {}
        self._kept: tuple[Block, bool, Question] | None = None

    # One servo.

    def ping(self, id: int) -> Found:
        """Model and firmware of a servo; remembers its control table."""
        return self._found(id, self.ask(packets.ping(id), 3).data)

    def _found(self, id: int, data: bytes) -> Found:
        number, firmware = data[0] | data[1] << 8, data[2]
        try:
            self.tables[id] = control_table(number)
        except HardwareError:
            self.tables.pop(id, None)
        self.firmware[id] = firmware
        return Found(id, self.port.getBaudRate(), number, firmware, self.tables.get(id))

    def register(self, id: int, name: str) -> Register:
        """Row of a servo's control table; the servo must have been pinged or scanned."""
        if id not in self.tables:
            raise HardwareError(f"the model of {self.label(id)} is not known yet; ping it first")
        return self.tables[id][name]

    def read_raw(self, id: int, name: str) -> int:
        """Signed count in a register."""
        row = self.register(id, name)
        return row.decode(self.ask(packets.read(id, row.address, row.size), row.size).data)

    def read(self, id: int, name: str) -> float:
        """Register in SI units."""
        return self.register(id, name).to_si(self.read_raw(id, name))

    def write(self, id: int, name: str, value: float) -> None:
        """Write a register in SI units; see `write_raw`."""
        self.write_raw(id, name, self.register(id, name).from_si(value))

    def write_raw(self, id: int, name: str, raw: int) -> None:
        """Write a count and make sure that it arrived: by the answer, or by reading back when none comes.

        Raises Refused with the reason, NoAnswer for a servo that is silent.
        """
        row = self.register(id, name)
        try:
            self.ask(packets.write(id, row.address, row.encode(raw)))
        except Refused as e:
            raise Refused(
                id,
                e.error,
                f"{self.label(id)} refused {row.to_si(raw):.4g} {row.unit} for {name}: {hint(e.error)}",
            ) from None
        except NoAnswer:
            if self.read_raw(id, name) != raw:  # silent on purpose (status return level), or really lost
                raise

    def write_bytes(self, id: int, address: int, data: bytes) -> None:
        """Write neighbouring registers in one packet."""
        self.ask(packets.write(id, address, data))

    # The whole rig.

    def block(self, ids: Sequence[int], names: Sequence[str]) -> Block:
        """One register, or neighbours in the table, as a block for all servos.

        Names are `a|b` where models differ: the first that a model has.
        """
        rows = {id: [self._pick(id, n) for n in names] for id in ids}
        spans = {}
        for id, list_ in rows.items():
            end = list_[0].address
            for row in list_:
                if row.address != end:
                    raise HardwareError(f"{row.name} does not follow its neighbour; map the block instead")
                end += row.size
            spans[id] = (list_[0].address, end - list_[0].address)
        return self._block(ids, names, rows, spans)

    def map_block(self, ids: Sequence[int], names: Sequence[str]) -> Block:
        """Scattered registers as one block, through each servo's indirect registers, which this writes."""
        rows = {id: [self._pick(id, n) for n in names] for id in ids}
        spans = {}
        for id, list_ in rows.items():
            addresses = [a for row in list_ for a in range(row.address, row.address + row.size)]
            run = self.tables[id].indirect[0]
            if len(addresses) > run.count:
                raise HardwareError(
                    f"{self.label(id)} has {run.count} indirect registers, {len(addresses)} are wanted"
                )
            self.write_bytes(id, run.address, struct.pack(f"<{len(addresses)}H", *addresses))
            spans[id] = (run.data, len(addresses))
        return self._block(ids, names, rows, spans)

    def _pick(self, id: int, name: str) -> Register:
        choices = name.split("|")
        table = self.tables.get(id)
        return self.register(id, next((n for n in choices if table and n in table), choices[0]))

    def _block(
        self,
        ids: Sequence[int],
        names: Sequence[str],
        rows: dict[int, list[Register]],
        spans: dict[int, tuple[int, int]],
    ) -> Block:
        first = rows[ids[0]]
        layout = struct.Struct("<" + "".join(_PACK[r.size, r.signed] for r in first))
        zero = np.array([[float(r.zero) for r in rows[i]] for i in ids])
        scale = np.array([[r.scale for r in rows[i]] for i in ids])
        fast = len(ids) > 1 and len(set(spans.values())) == 1 and all(self._reads_fast(i) for i in ids)
        return Block(tuple(names), tuple(ids), spans, layout, zero, scale, fast)

    def _reads_fast(self, id: int) -> bool:
        first = self.tables[id].fast_read_firmware
        return first is not None and self.firmware.get(id, 0) >= first

    def read_block(self, block: Block, *, retries: int | None = None) -> dict[int, Reply]:
        """Read a block of all servos in one transaction; who did not answer is asked again, then left out.

        A fast sync read where every firmware has it. A servo that is missing silences those behind it: it is
        asked last the next time.
        """
        replies = self._read_many(block, block.ids, fast=block.fast)
        for _ in range(self.retries if retries is None else retries):
            missing = [i for i in block.ids if i not in replies]
            if not missing:
                break
            self.statistics.retries += 1
            replies |= self._read_many(block, missing[1:] + missing[:1], fast=False)
        for id in block.ids:
            if id not in replies:
                self.statistics.missing[id] += 1
        return replies

    def _read_many(self, block: Block, ids: Sequence[int], *, fast: bool) -> dict[int, Reply]:
        return self.ask_many(self._question(block, ids, fast))

    def _question(self, block: Block, ids: Sequence[int], fast: bool) -> Question:
        """The packet of a read; that of the block kept last is made once."""
        whole = ids is block.ids
        if whole and self._kept is not None and self._kept[0] is block and self._kept[1] == fast:
            return self._kept[2]
        if block.uniform:
            packet = packets.sync_read(*block.spans[ids[0]], ids, fast=fast)
        else:
            packet = packets.bulk_read((i, *block.spans[i]) for i in ids)
        question = Question(
            bytes((packet.instruction,)) + packet.params,
            dict.fromkeys(ids, block.layout.size),
            max(self.return_delay.get(i, FACTORY_RETURN_DELAY) for i in ids),
            fast,
        )
        if whole:
            self._kept = (block, fast, question)
        return question

    def sync_write(self, ids: Sequence[int], name: str, counts: Sequence[int]) -> None:
        """Write a register of many servos in one packet, in signed counts; nobody answers."""
        row = self.register(ids[0], name)
        pairs = [x for pair in zip(ids, counts, strict=True) for x in pair]
        layout = _sync_layout(row.size, row.signed, len(ids))
        self.send(BROADCAST, layout.pack(packets.Instruction.SYNC_WRITE, row.address, row.size, *pairs))

    def sync_read(self, ids: Sequence[int], name: str) -> Array:
        """Register of many servos (n,) in SI; NaN where no answer came."""
        block = self.block(ids, [name])
        return np.asarray(block.decode(self.read_block(block))[:, 0])

    def cycle_time(self, block: Block, *, goals: bool = True) -> float:
        """Time on the wire of a goal sync write and a read of a block [s]; the latency timer is not in it."""
        n, size = len(block.ids), sum(s[1] for s in block.spans.values())
        head = 14 + (n if block.uniform else 5 * n - 4)
        fast = block.fast
        status_ = 8 + 4 * n + size if fast else STATUS * n + size
        count = head + status_ + ((14 + 5 * n) if goals else 0)
        delays = [self.return_delay.get(i, FACTORY_RETURN_DELAY) for i in block.ids]
        wire = count * BITS_PER_BYTE / float(self.port.getBaudRate())
        return wire + (max(delays) if fast else sum(delays))

    # Finding servos.

    def broadcast_ping(self) -> dict[int, Found]:
        """Everybody at this bit rate, by ID. Takes about a second on a real bus."""
        return {id: self._found(id, reply.data) for id, reply in sorted(self.ask_everybody().items())}

    def scan(
        self, bauds: Iterable[int] = BAUD_RATES.values(), *, progress: Callable[[int], None] | None = None
    ) -> list[Found]:
        """Servos at every bit rate that the port can do, each twice asked; the old bit rate comes back."""
        before = self.port.getBaudRate()
        found: list[Found] = []
        try:
            for baud in bauds:
                if progress:
                    progress(baud)
                if self.port.setBaudRate(baud):
                    first = self.broadcast_ping()
                    found += ({**first, **self.broadcast_ping()} if first else first).values()
        finally:
            self.port.setBaudRate(before)
        return found


@cache
def _sync_layout(size: int, signed: bool, count: int) -> struct.Struct:
    """Instruction, address, length, then ID and value of each servo."""
    return struct.Struct("<BHH" + ("B" + _PACK[size, signed]) * count)
