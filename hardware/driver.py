"""The servos of one bus in SI units, over the packet handler of the official SDK.

Of dynamixel_sdk 4.1.0 the packet handler's txPacket and rxPacket are used, not its group classes, which give
up a whole sync read for one missing servo, wait 35 ms for it, and drop every error byte. Also guarded here:

- txPacket computes byte stuffing and drops it, so that a goal such as -131073 leaves as an ambiguous frame:
  the body is stuffed before (`_sdk_stuffs` asks the installed SDK whether it has learnt to).
- rxPacket may raise IndexError on odd bytes, and leaves `is_using` set when the port raises.
- Its timeouts assume a latency timer of 16 ms: they are set here, from the bytes expected.
- Values are unsigned there: registers carry their sign.
"""

from __future__ import annotations

import struct
import threading
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from . import packets
from .errors import BusError, HardwareError
from .exchange import Block, Found, NoAnswer, Refused, Reply, Statistics
from .packets import ALERT, BROADCAST, Packet, StatusError
from .ports import BITS_PER_BYTE, Clock
from .registers import BAUD_RATES, ControlTable, Register, control_table

Array = NDArray[np.float64]

__all__ = ["Block", "Driver", "Found", "NoAnswer", "Refused", "Reply", "Statistics"]

FRAME = 10  # bytes of a packet around its params
STATUS = 11  # the same with the error byte
FACTORY_RETURN_DELAY = 500e-6  # s
SCAN_SLOT = 3e-3  # s that each possible ID gets in a broadcast ping, as in the SDK

_PACK = {(1, False): "B", (1, True): "b", (2, False): "H", (2, True): "h", (4, False): "I", (4, True): "i"}
_HINT = {
    StatusError.RESULT_FAIL: "it could not carry it out",
    StatusError.INSTRUCTION: "it does not know the instruction",
    StatusError.CRC: "the packet reached it corrupted",
    StatusError.DATA_RANGE: "the value is out of the register's range",
    StatusError.DATA_LENGTH: "the value has the wrong length",
    StatusError.DATA_LIMIT: "the value is beyond a limit that another register sets",
    StatusError.ACCESS: "no access: read only, or EEPROM, which is locked while torque is on",
}


class _Question(NamedTuple):
    """A read of many servos: instruction, bytes of its frame and of the answers, return delay [s]."""

    body: bytes
    sent: int
    expected: int
    delay: float


@cache
def _sdk() -> Any:
    import dynamixel_sdk

    return dynamixel_sdk


class _Sink:
    """A port that swallows bytes, to see what the SDK sends."""

    is_using = False

    def __init__(self) -> None:
        self.sent = b""

    def clearPort(self) -> None:
        pass

    def writePort(self, packet: Sequence[int]) -> int:
        self.sent = bytes(packet)
        return len(packet)


@cache
def _sdk_stuffs() -> bool:
    """Whether the installed SDK stuffs what it sends (4.1.0 does not)."""
    sink = _Sink()
    _sdk().PacketHandler(2.0).txPacket(sink, _frame(1, b"\x03\x74\x00\xff\xff\xfd\xff", stuffed=False))
    return b"\xff\xff\xfd\xfd" in sink.sent


def _frame(id: int, body: bytes, *, stuffed: bool) -> list[int]:
    """A frame without its CRC, which txPacket fills in."""
    if stuffed and b"\xff\xff\xfd" in body:
        body = packets.stuff(body)
    size = len(body) + 2
    return list(packets.HEADER + bytes((id, size & 0xFF, size >> 8)) + body + b"\0\0")


class Driver:
    """Talks to the servos on one port; the thread that made it owns it.

    Args:
        port: Open port, see `ports`.
        clock: Of that port.
        retries: How often a question is asked again.
        margin: Time beyond the wire's that an answer may take [s]: scheduling, USB.
        latency: Of the adapter's latency timer [s].
        label: Name of a servo for messages.
    """

    def __init__(
        self,
        port: Any,
        clock: Clock,
        *,
        retries: int = 2,
        margin: float = 4e-3,
        latency: float = 0.0,
        label: Callable[[int], str] = lambda id: f"servo {id}",
    ) -> None:
        self.port, self.clock, self.retries, self.label = port, clock, retries, label
        self.margin = margin + 2 * latency
        self.statistics = Statistics()
        self.tables: dict[int, ControlTable] = {}
        self.firmware: dict[int, int] = {}
        self.return_delay: dict[int, float] = {}
        self.alerts: dict[int, bool] = {}
        self._handler = _sdk().PacketHandler(2.0)
        self._ok: int = _sdk().COMM_SUCCESS
        self._owner = threading.get_ident()
        self._stuff = not _sdk_stuffs()
        self._kept: tuple[Block, bool, _Question] | None = None

    def close(self) -> None:
        """Close the port. Servos stay as they are."""
        self.port.closePort()

    def adopt(self) -> None:
        """Make the calling thread the owner, once the old one is done."""
        self._owner = threading.get_ident()

    # Packets.

    def send(self, id: int, body: bytes) -> None:
        """Send an instruction; BusError when the port does not take it."""
        if threading.get_ident() != self._owner:
            raise BusError(
                f"port {self.port.port_name} belongs to another thread; a bus has one, see Driver.adopt"
            )
        self.port.is_using = False  # left set by the SDK when a port raised
        self.statistics.sent += 1
        result = self._handler.txPacket(self.port, _frame(id, body, stuffed=self._stuff))
        if result != self._ok:
            raise BusError(f"port {self.port.port_name}: {self._handler.getTxRxResult(result)}")

    def _wait(self, sent: int, expected: int, answers: int, delay: float) -> None:
        """Start the timeout for the answers of an instruction."""
        wire = (sent + expected) * BITS_PER_BYTE / self.port.getBaudRate()
        self.port.setPacketTimeoutMillis((wire + answers * delay + self.margin) * 1e3)

    def _receive(self, *, fast: bool = False) -> tuple[list[int], bool]:
        """Bytes of one frame and whether they are whole."""
        try:
            frame, result = self._handler.rxPacket(self.port, fast)
        except IndexError:
            frame, result = [], None
        if result == self._ok and len(frame) >= STATUS:
            self.statistics.received += 1
            return frame, True
        if len(frame) > 0:
            self.statistics.corrupt += 1
        return frame, False

    def _collect(self, wanted: dict[int, int]) -> dict[int, Reply]:
        """Status packets of the wanted servos (ID -> length of data), until all are there or time is up."""
        replies: dict[int, Reply] = {}
        port = self.port
        while len(replies) < len(wanted):
            frame, whole = self._receive()
            if whole:
                id = frame[4]
                reply = Reply(frame[8], bytes(frame[9 : 5 + (frame[5] | frame[6] << 8)]))
                if (
                    id in wanted
                    and id not in replies
                    and (reply.error & ~ALERT or len(reply.data) == wanted[id])
                ):
                    replies[id] = reply
                    self.alerts[id] = bool(reply.error & ALERT)
                else:
                    self.statistics.strays += 1
            elif port.packet_timeout == 0:
                self.statistics.timeouts += 1
                break
        port.is_using = False
        return replies

    def ask(self, packet: Packet, length: int = 0) -> Reply:
        """Send an instruction to one servo until it answers; NoAnswer after the retries, Refused on error."""
        id = packet.id
        body = bytes((packet.instruction,)) + packet.params
        for attempt in range(self.retries + 1):
            if attempt:
                self.statistics.retries += 1
            self.send(id, body)
            self._wait(FRAME + len(body), STATUS + length, 1, FACTORY_RETURN_DELAY)
            reply = self._collect({id: length}).get(id)
            if reply is None:
                self.statistics.lost += 1
                continue
            error = reply.error & ~ALERT
            if error == StatusError.CRC and attempt < self.retries:
                continue  # the wire's fault, not the caller's
            if error:
                raise Refused(id, error, f"{self.label(id)} refused: {_hint(error)}")
            return reply
        self.statistics.missing[id] += 1
        raise NoAnswer(
            id,
            f"{self.label(id)} does not answer at {self.port.getBaudRate():,} bit/s "
            f"(asked {self.retries + 1} times): is it powered, is its ID {id}, its bit rate this one?",
        )

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
                f"{self.label(id)} refused {row.to_si(raw):.4g} {row.unit} for {name}: {_hint(e.error)}",
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
        question = self._question(block, ids, fast)
        self.send(BROADCAST, question.body)
        self._wait(question.sent, question.expected, len(ids), question.delay)
        if fast:
            replies = self._collect_fast(ids, block.layout.size)
            self.statistics.lost += len(replies) < len(ids)
            return replies
        size = block.layout.size
        replies = self._collect(dict.fromkeys(ids, size))
        self.statistics.lost += len(ids) - len(replies) if replies else 1
        return replies

    def _question(self, block: Block, ids: Sequence[int], fast: bool) -> _Question:
        """The packet of a read; that of the block kept last is made once."""
        whole = ids is block.ids
        if whole and self._kept is not None and self._kept[0] is block and self._kept[1] == fast:
            return self._kept[2]
        if block.uniform:
            packet = packets.sync_read(*block.spans[ids[0]], ids, fast=fast)
        else:
            packet = packets.bulk_read((i, *block.spans[i]) for i in ids)
        data = len(ids) * block.layout.size
        question = _Question(
            bytes((packet.instruction,)) + packet.params,
            FRAME + len(packet.params),
            (8 + 4 * len(ids) if fast else STATUS * len(ids)) + data,
            max(self.return_delay.get(i, FACTORY_RETURN_DELAY) for i in ids),
        )
        if whole:
            self._kept = (block, fast, question)
        return question

    def _collect_fast(self, ids: Sequence[int], length: int) -> dict[int, Reply]:
        """Blocks of a fast reply; of a broken one, those in front of the break whose own CRC holds."""
        frame, whole = self._receive(fast=True)
        while not whole and self.port.packet_timeout != 0 and len(frame) < 8 + (length + 4) * len(ids):
            frame, whole = self._receive(fast=True)
        self.port.is_using = False
        replies: dict[int, Reply] = {}
        data = bytes(frame)
        if len(data) < 8 or data[4] != BROADCAST or data[7] != packets.Instruction.STATUS:
            if not whole:
                self.statistics.timeouts += 1
            return replies
        crc, done = 0, 0
        for place in range(8, len(data) - length - 3, length + 4):
            error, id = data[place], data[place + 1]
            end = place + 2 + length
            if not whole:
                crc = packets.crc16(data[done:end], crc)
                if crc != data[end] | data[end + 1] << 8:
                    break
                crc, done = packets.crc16(data[end : end + 2], crc), end + 2
            if id in ids:
                replies[id] = Reply(error, data[place + 2 : end])
                self.alerts[id] = bool(error & ALERT)
        return replies

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
        """Everybody at this bit rate, by ID. Takes the time of 253 slots, about a second on a real bus."""
        self.send(BROADCAST, bytes((packets.Instruction.PING,)))
        wire = 14 * 253 * BITS_PER_BYTE / self.port.getBaudRate()
        self.port.setPacketTimeoutMillis((wire + SCAN_SLOT * 253 + self.margin) * 1e3)
        return {
            i: self._found(i, r.data) for i, r in sorted(self._collect(dict.fromkeys(range(253), 3)).items())
        }

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


def _hint(error: int) -> str:
    return _HINT.get(StatusError(error), f"error {error}") if error in _HINT else f"error {error}"
