"""A half-duplex bus of virtual servos on a virtual clock, with a ledger of the time on the wire."""

from __future__ import annotations

import heapq
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

from ..errors import HardwareError
from ..packets import BROADCAST, Instruction, Packet, fast_length, fast_reply, status
from .drive import PERIOD
from .faults import NO_FAULTS, FaultDice, FaultPlan, Upset
from .parser import MAX_LENGTH, Parser
from .servo import ENCODER, OVERHEATING, OVERLOAD, SHOCK, VOLTAGE, VirtualServo

BITS_PER_BYTE = 10  # 8 data bits, a start bit and a stop bit
BYTE_GAP = (
    1.5e-3  # s without a byte after which a servo gives up a frame (reported by users, not in the manual)
)

_ERROR_BITS: dict[Upset, int] = {
    "overload": OVERLOAD,
    "overheating": OVERHEATING,
    "undervoltage": VOLTAGE,
    "electrical shock": SHOCK,
    "encoder": ENCODER,
}


@dataclass(frozen=True)
class Timing:
    """Times of an adapter and its bus [s] that are not bytes.

    Args:
        latency_timer: Of the USB adapter: received bytes wait this long for more before they reach the host
            (an FTDI chip has 16 ms until it is set to 1 ms; it sends at once when `packet` bytes are
            there).
        packet: Bytes that a USB packet carries.
        turnaround: Change of direction of a half-duplex line, before a servo's first byte.
        usb: Way of a transfer from host to adapter.
    """

    latency_timer: float = 0.0
    packet: int = 62
    turnaround: float = 0.0
    usb: float = 0.0


@dataclass
class Ledger:
    """Where the time on the bus went [s]; `total` is what a transaction of the real bus would have taken."""

    instruction_bytes: int = 0
    status_bytes: int = 0
    instructions: int = 0
    statuses: int = 0
    wire: float = 0.0
    return_delay: float = 0.0
    turnaround: float = 0.0
    latency: float = 0.0
    usb: float = 0.0

    @property
    def total(self) -> float:
        """Everything that keeps the bus busy or the host waiting."""
        return self.wire + self.return_delay + self.turnaround + self.latency + self.usb

    def clear(self) -> None:
        """Start a new account."""
        self.__init__()  # type: ignore[misc]


@dataclass(order=True)
class Delivery:
    """Bytes on the way to the host: when they arrive, and by how much a fault holds them back [s]."""

    time: float
    order: int
    data: bytes = field(compare=False)
    held: float = field(compare=False, default=0.0)


class VirtualBus:
    """Servos on one line.

    Args:
        servos: Any models; two with one ID answer together and garble each other.
        timing: Of the adapter.
        faults: What goes wrong.
        lenient: Servos accept instructions whose body is not stuffed, as the official SDK sends them.
        paced: The clock waits for the wire; False when real time moves it (pseudo-terminal): wire time is
            then kept in the ledger alone.

    Host bytes go in with `send`, come back with `receive`; `advance` moves the clock. All is deterministic.
    """

    def __init__(
        self,
        servos: Iterable[VirtualServo],
        *,
        timing: Timing = Timing(),
        faults: FaultPlan = NO_FAULTS,
        lenient: bool = True,
        paced: bool = True,
    ) -> None:
        self.servos = list(servos)
        self.paced = paced
        self.timing, self.faults = timing, faults
        self.dice = FaultDice(faults)
        self.ledger = Ledger()
        self.time = 0.0
        self._parser = Parser(lenient=lenient)
        self._last_byte = 0.0
        self._periods = 0
        self._order = 0
        self._deliveries: list[Delivery] = []
        self._sent: list[tuple[float, bytes, float]] = []  # start on the wire, bytes, held back by a fault
        self._pending = sorted((f for f in faults.servos), key=lambda f: f.start)
        self._revivals: list[tuple[float, int]] = []

    def __getitem__(self, id: int) -> VirtualServo:
        """Servo with an ID; HardwareError lists what is there."""
        for servo in self.servos:
            if servo.id == id:
                return servo
        there = ", ".join(str(s.id) for s in self.servos) or "none"
        raise HardwareError(f"no servo with ID {id} on this bus; it has: {there}")

    # Time.

    def advance(self, seconds: float) -> None:
        """Let time pass: servos move, watchdogs run."""
        self.advance_to(self.time + seconds)

    def advance_to(self, time: float) -> None:
        """Let time pass until `time` [s]; a time in the past changes nothing."""
        if time <= self.time:
            return
        self.time = time
        servos = self.servos
        while (self._periods + 1) * PERIOD <= time + 1e-12:
            self._periods += 1
            if self._pending or self._revivals:
                self._upset(self._periods * PERIOD)
            for servo in servos:
                servo.step()

    def _upset(self, now: float) -> None:
        """Let the servo faults of the plan happen."""
        while self._pending and self._pending[0].start <= now:
            fault = self._pending.pop(0)
            servo = self[fault.servo]
            if fault.kind == "dead":
                servo.dead = True
                self._revivals.append((fault.stop, self.servos.index(servo)))
            elif fault.kind == "watchdog":
                servo.trip_watchdog()
            else:
                servo.fail(_ERROR_BITS[fault.kind])
        for stop, index in [r for r in self._revivals if r[0] <= now]:
            self.servos[index].revive()
            self._revivals.remove((stop, index))

    # The host's side.

    def send(self, data: bytes, baud: int) -> None:
        """Host writes bytes at a bit rate [bit/s]: the clock passes their wire time, replies are queued."""
        self.ledger.instruction_bytes += len(data)
        self.ledger.usb += self.timing.usb
        self._pass(self.time + self.timing.usb)
        if self.paced and self.time - self._last_byte > BYTE_GAP:
            self._parser.flush()
        start = self.time
        self._wire(len(data), baud)
        if not self.faults.unplugged(start):
            end = start
            for delay, piece in self.dice.apply(data, _frame_id(data), "instruction", start):
                end = max(end, start + delay) + len(piece) * BITS_PER_BYTE / baud
                self._pass(end)
                self._last_byte = self.time
                for packet in self._parser.feed(piece):
                    if isinstance(packet, Packet) and not packet.is_status:
                        self.ledger.instructions += 1
                        end = max(end, self._answer(packet, baud))
                        self._deliver(baud)
        self._pass(start + len(data) * BITS_PER_BYTE / baud)

    def _pass(self, time: float) -> None:
        if self.paced:
            self.advance_to(time)

    @property
    def next_delivery(self) -> float | None:
        """Time at which the next bytes reach the host [s]; None when none are under way."""
        return self._deliveries[0].time if self._deliveries else None

    def receive(self) -> bytes:
        """Bytes that have reached the host by now."""
        out = b""
        while self._deliveries and self._deliveries[0].time <= self.time + 1e-12:
            out += heapq.heappop(self._deliveries).data
        return out

    def deliveries(self) -> list[Delivery]:
        """Everything on the way to the host, whenever it would arrive; taken from the queue."""
        out = sorted(self._deliveries)
        self._deliveries.clear()
        return out

    def _wire(self, count: int, baud: int) -> None:
        self.ledger.wire += count * BITS_PER_BYTE / baud

    # The servos' side.

    def _answer(self, packet: Packet, baud: int) -> float:
        """Let the servos execute an instruction and reply; the time when the line is free again."""
        hearing = [s for s in self.servos if s.awake and s.baud == baud]
        for servo in hearing:
            servo.feed()
        now = self.time
        if packet.instruction >= Instruction.SYNC_READ and packet.id != BROADCAST:
            return now  # instructions to a group go to the broadcast ID alone
        match packet.instruction:
            case Instruction.SYNC_WRITE | Instruction.BULK_WRITE:
                _group_write(hearing, packet)
                return now
            case Instruction.SYNC_READ | Instruction.BULK_READ:
                for servo, frame in self._chain(hearing, packet):
                    now = self._reply(frame, servo, now, baud)
                return now
            case Instruction.FAST_SYNC_READ | Instruction.FAST_BULK_READ:
                return self._fast(hearing, packet, now, baud)
        replies = [
            (s, r) for s in hearing if s.answers_to(packet.id) and (r := s.execute(packet)) is not None
        ]
        if packet.id == BROADCAST:
            if packet.instruction != Instruction.PING:
                return now
            for servo, reply in sorted(replies, key=lambda pair: pair[1].id):
                now = self._reply(reply.encode(), servo, now, baud)
            return now
        if len(replies) > 1:  # one ID twice: both talk at once, the bits mix
            frames = [reply.encode() for _, reply in replies]
            mixed = bytes(_mix(column) for column in zip(*frames, strict=False))
            return self._reply(mixed, replies[0][0], now, baud)
        for servo, reply in replies:
            now = self._reply(reply.encode(), servo, now, baud)
        return now

    def _chain(self, hearing: list[VirtualServo], packet: Packet) -> Iterator[tuple[VirtualServo, bytes]]:
        """Replies to a sync or bulk read, in request order, up to the first servo that is missing."""
        for id, address, length in wanted(packet):
            servo = _find(hearing, id)
            link = servo.reply_to_read(address, length) if servo else None
            if servo is None or link is None:
                return
            yield servo, status(id, link[0], link[1]).encode()

    def _fast(self, hearing: list[VirtualServo], packet: Packet, now: float, baud: int) -> float:
        """The common frame of a fast read; it breaks off at the first servo that is missing or too old."""
        requests = list(wanted(packet))
        length = fast_length(size for _, _, size in requests)
        blocks: list[tuple[int, int, bytes]] = []
        for id, address, size in requests:
            servo = _find(hearing, id)
            read = servo.reply_to_read(address, size) if servo and servo.reads_fast else None
            if read is None:
                break
            blocks.append((read[0], id, read[1].ljust(size, b"\0")))
        first = _find(hearing, requests[0][0]) if blocks else None
        if first is None or length > MAX_LENGTH:
            return now
        return self._reply(fast_reply(blocks, length), first, now, baud)

    def _reply(self, frame: bytes, servo: VirtualServo, now: float, baud: int) -> float:
        """Put a reply on the wire; when its last byte has passed."""
        timing, ledger = self.timing, self.ledger
        ledger.return_delay += servo.return_delay
        ledger.turnaround += timing.turnaround
        ledger.status_bytes += len(frame)
        ledger.statuses += 1
        start = now + servo.return_delay + timing.turnaround
        self._wire(len(frame), baud)
        end = start + len(frame) * BITS_PER_BYTE / baud
        if not self.faults.unplugged(start):
            for delay, piece in self.dice.apply(frame, frame[4], "status", start):
                self._sent.append((start + delay, piece, delay))
        return end

    def _deliver(self, baud: int) -> None:
        """Queue what the servos sent: full USB packets as they fill, the rest when the latency timer ends.

        The timer starts with the first byte that waits.
        """
        pieces, self._sent = sorted(self._sent, key=lambda p: p[0]), []
        timer = self.timing.latency_timer
        byte = BITS_PER_BYTE / baud
        waiting, deadline, last = bytearray(), 0.0, 0.0
        for start, data, held in pieces:
            if timer == 0 or held:
                self._queue(data, start + len(data) * byte + timer, held)
                continue
            for i, value in enumerate(data, 1):
                last = start + i * byte
                if waiting and last > deadline:
                    self._queue(bytes(waiting), deadline, 0.0)
                    waiting.clear()
                if not waiting:
                    deadline = last + timer
                waiting.append(value)
                if len(waiting) == self.timing.packet:
                    self._queue(bytes(waiting), last, 0.0)
                    waiting.clear()
        if waiting:
            self._queue(bytes(waiting), deadline, 0.0)
            self.ledger.latency += deadline - last

    def _queue(self, data: bytes, time: float, held: float) -> None:
        if data:
            self._order += 1
            heapq.heappush(self._deliveries, Delivery(time, self._order, data, held))


def wanted(packet: Packet) -> Iterator[tuple[int, int, int]]:
    """(ID, address, length) that a sync or bulk read asks for; broken params end the list."""
    p = packet.params
    if packet.instruction in (Instruction.SYNC_READ, Instruction.FAST_SYNC_READ):
        if len(p) >= 4:
            for id in p[4:]:
                yield id, p[0] | p[1] << 8, p[2] | p[3] << 8
    else:
        for i in range(0, len(p) - 4, 5):
            yield p[i], p[i + 1] | p[i + 2] << 8, p[i + 3] | p[i + 4] << 8


def _blocks(packet: Packet) -> Iterator[tuple[int, int, bytes]]:
    """(ID, address, data) of a sync or bulk write."""
    p = packet.params
    if packet.instruction == Instruction.SYNC_WRITE:
        if len(p) >= 4:
            address, size = p[0] | p[1] << 8, p[2] | p[3] << 8
            for i in range(4, len(p) - size, 1 + size):
                yield p[i], address, p[i + 1 : i + 1 + size]
        return
    place = 0
    while place + 5 <= len(p):
        size = p[place + 3] | p[place + 4] << 8
        data = p[place + 5 : place + 5 + size]
        if len(data) < size:
            return
        yield p[place], p[place + 1] | p[place + 2] << 8, data
        place += 5 + size


def _group_write(hearing: list[VirtualServo], packet: Packet) -> None:
    members: dict[int, list[VirtualServo]] = {}
    for servo in hearing:
        for id in servo.ids:
            members.setdefault(id, []).append(servo)
    for id, address, data in _blocks(packet):
        for servo in members.get(id, ()):
            servo.write(address, data, shadow=servo.id != id)


def _find(servos: list[VirtualServo], id: int) -> VirtualServo | None:
    return next((s for s in servos if s.id == id), None)


def _mix(column: tuple[int, ...]) -> int:
    """Byte that two drivers of an idle-high line leave: a zero bit wins."""
    out = 0xFF
    for byte in column:
        out &= byte
    return out


def _frame_id(data: bytes) -> int:
    return data[4] if len(data) > 4 else BROADCAST
