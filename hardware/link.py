"""Questions and answers on a serial bus: frames, timeouts, retries, over the official SDK's packet handler.

Of dynamixel_sdk 4.1.0 the packet handler's txPacket and rxPacket are used, not its group classes, which give
up a whole sync read for one missing servo, wait 35 ms for it, and drop every error byte. Also guarded here:

- txPacket computes byte stuffing and drops it, so that a goal such as -131073 leaves as an ambiguous frame:
  the body is stuffed before (`_sdk_stuffs` asks the installed SDK whether it has learnt to).
- rxPacket may raise IndexError on odd bytes, and leaves `is_using` set when the port raises.
- Its timeouts assume a latency timer of 16 ms: they are set here, from the bytes expected.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence
from functools import cache
from typing import Any, NamedTuple

from . import packets
from .errors import BusError
from .exchange import NoAnswer, Refused, Reply, Statistics
from .packets import ALERT, BROADCAST, Packet, StatusError
from .ports import BITS_PER_BYTE, Clock

FRAME = 9  # bytes of a packet around its body: instruction and params
STATUS = 11  # of a status packet around its data
FACTORY_RETURN_DELAY = 500e-6  # s
SCAN_SLOT = 3e-3  # s that each possible ID gets in a broadcast ping, as in the SDK

_HINT = {
    StatusError.RESULT_FAIL: "it could not carry it out",
    StatusError.INSTRUCTION: "it does not know the instruction",
    StatusError.CRC: "the packet reached it corrupted",
    StatusError.DATA_RANGE: "the value is out of the register's range",
    StatusError.DATA_LENGTH: "the value has the wrong length",
    StatusError.DATA_LIMIT: "the value is beyond a limit that another register sets",
    StatusError.ACCESS: "no access: read only, or EEPROM, which is locked while torque is on",
}


class Question(NamedTuple):
    """A read of many servos: body of its packet, bytes of data by servo, the longest return delay [s]."""

    body: bytes
    lengths: dict[int, int]
    delay: float
    fast: bool


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


class Link:
    """One end of a bus; the thread that made it owns it.

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
        self.alerts: dict[int, bool] = {}
        self._handler = _sdk().PacketHandler(2.0)
        self._ok: int = _sdk().COMM_SUCCESS
        self._owner = threading.get_ident()
        self._stuff = not _sdk_stuffs()

    def close(self) -> None:
        """Close the port. Servos stay as they are."""
        self.port.closePort()

    def adopt(self) -> None:
        """Make the calling thread the owner, once the old one is done."""
        self._owner = threading.get_ident()

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

    def _collect(self, wanted: Mapping[int, int]) -> dict[int, Reply]:
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
                raise Refused(id, error, f"{self.label(id)} refused: {hint(error)}")
            return reply
        self.statistics.missing[id] += 1
        raise NoAnswer(
            id,
            f"{self.label(id)} does not answer at {self.port.getBaudRate():,} bit/s "
            f"(asked {self.retries + 1} times): is it powered, is its ID {id}, its bit rate this one?",
        )

    def ask_many(self, question: Question) -> dict[int, Reply]:
        """Send a read of many servos, once; the answers of those that gave one."""
        lengths, fast = question.lengths, question.fast
        count, data = len(lengths), sum(lengths.values())
        self.send(BROADCAST, question.body)
        expected = data + (8 + 4 * count if fast else STATUS * count)
        self._wait(FRAME + len(question.body), expected, count, question.delay)
        if fast:
            replies = self._collect_fast(lengths)
            self.statistics.lost += len(replies) < count
        else:
            replies = self._collect(lengths)
            self.statistics.lost += count - len(replies) if replies else 1
        return replies

    def ask_everybody(self) -> dict[int, Reply]:
        """Answers to a broadcast ping, by ID. Takes the time of 253 slots, about a second on a real bus."""
        self.send(BROADCAST, bytes((packets.Instruction.PING,)))
        wire = (STATUS + 3) * 253 * BITS_PER_BYTE / self.port.getBaudRate()
        self.port.setPacketTimeoutMillis((wire + SCAN_SLOT * 253 + self.margin) * 1e3)
        return self._collect(dict.fromkeys(range(253), 3))

    def _collect_fast(self, lengths: Mapping[int, int]) -> dict[int, Reply]:
        """Blocks of a fast reply; of a broken one, those in front of the break."""
        size = 8 + sum(4 + n for n in lengths.values())
        frame, whole = self._receive(fast=True)
        while not whole and self.port.packet_timeout != 0 and len(frame) < size:
            frame, whole = self._receive(fast=True)
        self.port.is_using = False
        blocks = packets.fast_blocks(bytes(frame), list(lengths.values()), whole=whole)
        if not blocks and not whole:
            self.statistics.timeouts += 1
        replies = {id: Reply(error, data) for error, id, data in blocks if id in lengths}
        self.alerts |= {id: bool(reply.error & ALERT) for id, reply in replies.items()}
        return replies


def hint(error: int) -> str:
    """What an error number of a status packet means."""
    return _HINT.get(StatusError(error), f"error {error}") if error in _HINT else f"error {error}"
