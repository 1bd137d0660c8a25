"""Dynamixel Protocol 2.0: a packet is a frozen value with encode and decode; a parser makes packets of bytes.

Source: https://emanual.robotis.com/docs/en/dxl/protocol2/ and https://emanual.robotis.com/docs/en/dxl/crc/.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Literal

from .errors import BusError

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_ID = 252
ALERT = 0x80  # bit 7 of a status error: see the register hardware_error_status
MAX_LENGTH = 2048  # greatest LEN the parser believes; longer than any frame on a bus of 253 servos of 4 bytes

_STUFFED, _MARK = b"\xff\xff\xfd\xfd", b"\xff\xff\xfd"


class Instruction(IntEnum):
    """Instruction byte."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    BACKUP = 0x20
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class StatusError(IntEnum):
    """Low seven bits of the error byte of a status packet."""

    NONE = 0
    RESULT_FAIL = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class PacketError(BusError):
    """A frame is not a packet: says which part is wrong."""


def _crc_table() -> tuple[int, ...]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ 0x8005 if crc & 0x8000 else crc << 1
        table.append(crc & 0xFFFF)
    return tuple(table)


_CRC = _crc_table()


def crc16(data: bytes, crc: int = 0) -> int:
    """CRC-16: polynomial 0x8005, initial value 0, not reflected; `crc` continues an earlier one."""
    table = _CRC
    for byte in data:
        crc = ((crc << 8) & 0xFF00) ^ table[(crc >> 8) ^ byte]
    return crc


def stuff(body: bytes) -> bytes:
    """Instruction and params as they go on the wire: FF FF FD gets another FD."""
    return body.replace(_MARK, _STUFFED)


def unstuff(body: bytes) -> bytes:
    """Inverse of `stuff`."""
    return body.replace(_STUFFED, _MARK)


def is_stuffed(body: bytes) -> bool:
    """Whether every FF FF FD in a body is followed by the extra FD."""
    return body.count(_MARK) == body.count(_STUFFED)


@dataclass(frozen=True, slots=True)
class Packet:
    """One packet. A status packet (instruction 0x55) carries its error byte as the first of `params`."""

    id: int
    instruction: int
    params: bytes = b""

    def encode(self, *, stuffed: bool = True) -> bytes:
        """Bytes on the wire; `stuffed=False` as the official SDK sends them (it drops its stuffing).

        A fast read reply is a status packet of the broadcast ID and is never stuffed.
        """
        body = bytes((self.instruction,)) + self.params
        if stuffed and not self.is_fast_reply:
            body = stuff(body)
        frame = HEADER + bytes((self.id,)) + (len(body) + 2).to_bytes(2, "little") + body
        return frame + crc16(frame).to_bytes(2, "little")

    @classmethod
    def decode(cls, frame: bytes, *, lenient: bool = False) -> Packet:
        """Packet of one whole frame; PacketError says what is wrong. `lenient` takes an unstuffed body."""
        if len(frame) < 10 or frame[:4] != HEADER:
            raise PacketError(f"not a frame (header ff ff fd 00, at least 10 bytes): {frame[:16].hex(' ')}")
        length = frame[5] | frame[6] << 8
        if length != len(frame) - 7:
            raise PacketError(f"length field says {length}, the frame has {len(frame) - 7} bytes after it")
        found, computed = frame[-2] | frame[-1] << 8, crc16(frame[:-2])
        if found != computed:
            raise PacketError(f"CRC is {found:#06x}, the bytes give {computed:#06x}")
        body = frame[7:-2]
        if not (frame[4] == BROADCAST and body[0] == Instruction.STATUS):
            if not lenient and not is_stuffed(body):
                raise PacketError("ff ff fd in the body without the stuffing byte fd")
            body = unstuff(body) if is_stuffed(body) else body
        return cls(frame[4], body[0], body[1:])

    @property
    def is_status(self) -> bool:
        """Whether this is a reply."""
        return self.instruction == Instruction.STATUS

    @property
    def is_fast_reply(self) -> bool:
        """Whether this is the common reply to a fast sync or bulk read."""
        return self.instruction == Instruction.STATUS and self.id == BROADCAST

    @property
    def error(self) -> int:
        """Error number of a status packet without the alert bit."""
        return self.params[0] & ~ALERT if self.is_status and self.params else 0

    @property
    def alert(self) -> bool:
        """Whether the servo reports a hardware error."""
        return bool(self.is_status and self.params and self.params[0] & ALERT)

    @property
    def data(self) -> bytes:
        """Params of a status packet after the error byte; of an instruction, all of them."""
        return self.params[1:] if self.is_status else self.params


@dataclass(frozen=True, slots=True)
class Fault:
    """Bytes that are no packet: noise between packets, or a frame that broke a rule."""

    kind: Literal["noise", "header", "crc", "stuffing", "truncated"]
    data: bytes


class Parser:
    """Incremental parser: bytes in, packets and faults out, independent of how the bytes are cut into chunks.

    It never raises and never waits for a frame that cannot come: a frame that breaks a rule gives up one
        byte and the rest is scanned again, so that a packet inside a broken frame is found as soon as its
        last byte is there.

    Args:
        lenient: Accept frames whose body is not stuffed, as the official SDK sends them; strict drops them,
            as the protocol says.
    """

    NOISE_PIECE = 256  # bytes of noise reported in one fault at most

    def __init__(self, *, lenient: bool = False) -> None:
        self.lenient = lenient
        self._buffer = bytearray()
        self._noise = bytearray()

    @property
    def pending(self) -> int:
        """Bytes held back because they may begin a packet."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet | Fault]:
        """Packets and faults that these bytes complete, in order."""
        self._buffer += data
        return self._scan(at_end=False)

    def flush(self) -> list[Packet | Fault]:
        """What is left when no more bytes come: a waiting frame is given up, held-back bytes become noise."""
        out = self._scan(at_end=True)
        if self._noise:
            out.append(Fault("noise", bytes(self._noise)))
            self._noise.clear()
        return out

    def _scan(self, *, at_end: bool) -> list[Packet | Fault]:
        out: list[Packet | Fault] = []
        buffer = self._buffer
        while buffer:
            start = buffer.find(HEADER)
            if start < 0:
                self._drop(len(buffer) - (0 if at_end else _header_prefix(buffer)), out)
                break
            self._drop(start, out)
            verdict = self._frame(at_end)
            if verdict is None:
                break
            if self._noise:
                out.append(Fault("noise", bytes(self._noise)))
                self._noise.clear()
            out.append(verdict)
            if isinstance(verdict, Fault):
                self._drop(1, out)
            else:
                del buffer[: 7 + (buffer[5] | buffer[6] << 8)]
        return out

    def _frame(self, at_end: bool) -> Packet | Fault | None:
        """Judge the frame at the head of the buffer; None while it is incomplete."""
        buffer = self._buffer
        available = len(buffer)
        if available < 7:
            return Fault("truncated", bytes(buffer)) if at_end else None
        length = buffer[5] | buffer[6] << 8
        if buffer[4] in (0xFD, 0xFF) or not 3 <= length <= MAX_LENGTH:
            return Fault("header", bytes(buffer[:7]))
        end = 7 + length
        fast = buffer[4] == BROADCAST and available > 7 and buffer[7] == Instruction.STATUS
        if self.lenient or fast:
            if (inner := self._inner_end(end)) is not None:
                return Fault("truncated", bytes(buffer[:inner]))
        elif (mark := self._unstuffed(end)) is not None:
            return Fault("stuffing", bytes(buffer[: mark + 4]))
        if available < end:
            return Fault("truncated", bytes(buffer)) if at_end else None
        frame = bytes(buffer[:end])
        if crc16(frame[:-2]) != frame[-2] | frame[-1] << 8:
            return Fault("crc", frame)
        return Packet.decode(frame, lenient=True)

    def _unstuffed(self, end: int) -> int | None:
        """Place of the first FF FF FD in the body, not followed by FD: there another packet begins."""
        buffer = self._buffer
        place = 7
        while (place := buffer.find(_MARK, place, end - 2)) >= 0:
            if place + 3 >= len(buffer):
                return None
            if buffer[place + 3] != 0xFD:
                return place
            place += 4
        return None

    def _inner_end(self, end: int) -> int | None:
        """Where the first whole packet inside the waiting frame ends, if it ends before the frame does."""
        buffer = self._buffer
        first: int | None = None
        place = 4
        while (place := buffer.find(HEADER, place, end)) >= 0:
            if place + 10 <= len(buffer):
                length = buffer[place + 5] | buffer[place + 6] << 8
                inner = place + 7 + length
                whole = 3 <= length <= MAX_LENGTH and inner <= min(len(buffer), end - 1)
                if whole and (first is None or inner < first):
                    frame = bytes(buffer[place:inner])
                    if crc16(frame[:-2]) == frame[-2] | frame[-1] << 8:
                        first = inner
            place += 1
        return first

    def _drop(self, count: int, out: list[Packet | Fault]) -> None:
        """Move bytes to the noise, reporting full pieces so that memory stays bounded."""
        self._noise += self._buffer[:count]
        del self._buffer[:count]
        while len(self._noise) >= self.NOISE_PIECE:
            out.append(Fault("noise", bytes(self._noise[: self.NOISE_PIECE])))
            del self._noise[: self.NOISE_PIECE]


def _header_prefix(buffer: bytearray) -> int:
    """How many last bytes could begin a header."""
    return next((n for n in (3, 2, 1) if buffer.endswith(HEADER[:n])), 0)


# The instructions, as packets. Addresses and lengths are two bytes, little endian.


def _words(*values: int) -> bytes:
    return b"".join(v.to_bytes(2, "little") for v in values)


def status(servo: int, error: int = 0, data: bytes = b"") -> Packet:
    """Reply of a servo; `error` is a StatusError, with ALERT when the hardware reports an error."""
    return Packet(servo, Instruction.STATUS, bytes((error,)) + data)


def ping(servo: int = BROADCAST) -> Packet:
    """Ping; the reply holds model number (2 bytes) and firmware version."""
    return Packet(servo, Instruction.PING)


def read(servo: int, address: int, length: int) -> Packet:
    """Read bytes."""
    return Packet(servo, Instruction.READ, _words(address, length))


def write(servo: int, address: int, data: bytes) -> Packet:
    """Write bytes."""
    return Packet(servo, Instruction.WRITE, _words(address) + data)


def reg_write(servo: int, address: int, data: bytes) -> Packet:
    """Write bytes when the action comes."""
    return Packet(servo, Instruction.REG_WRITE, _words(address) + data)


def action(servo: int = BROADCAST) -> Packet:
    """Execute what `reg_write` registered."""
    return Packet(servo, Instruction.ACTION)


def factory_reset(servo: int, keep: Literal["nothing", "id", "id and baud"]) -> Packet:
    """Reset the control table."""
    return Packet(
        servo, Instruction.FACTORY_RESET, bytes(({"nothing": 0xFF, "id": 0x01, "id and baud": 0x02}[keep],))
    )


def reboot(servo: int) -> Packet:
    """Restart a servo; the only way out of a shutdown."""
    return Packet(servo, Instruction.REBOOT)


def clear_turns(servo: int) -> Packet:
    """Bring the present position back into one turn; the servo must stand still."""
    return Packet(servo, Instruction.CLEAR, b"\x01\x44\x58\x4c\x22")


def backup(servo: int, what: Literal["store", "restore"]) -> Packet:
    """Store the control table in the backup area, or restore it; torque must be off."""
    return Packet(servo, Instruction.BACKUP, bytes(({"store": 1, "restore": 2}[what],)) + b"CTRL")


def sync_read(address: int, length: int, servos: Sequence[int], *, fast: bool = False) -> Packet:
    """Read the same registers of many servos; `fast` asks for one common reply."""
    instruction = Instruction.FAST_SYNC_READ if fast else Instruction.SYNC_READ
    return Packet(BROADCAST, instruction, _words(address, length) + bytes(servos))


def sync_write(address: int, length: int, data: Mapping[int, bytes]) -> Packet:
    """Write the same registers of many servos; nobody answers."""
    blocks = b"".join(bytes((servo,)) + block for servo, block in data.items())
    return Packet(BROADCAST, Instruction.SYNC_WRITE, _words(address, length) + blocks)


def bulk_read(wanted: Iterable[tuple[int, int, int]], *, fast: bool = False) -> Packet:
    """Read (servo, address, length) of each."""
    instruction = Instruction.FAST_BULK_READ if fast else Instruction.BULK_READ
    return Packet(BROADCAST, instruction, b"".join(bytes((s,)) + _words(a, n) for s, a, n in wanted))


def fast_reply(blocks: Sequence[tuple[int, int, bytes]]) -> bytes:
    """Bytes on the wire of a fast read reply with (error, servo, data) of each.

    One frame of the broadcast ID: LEN = 1 + sum(4 + n_i); after each block a CRC over everything so far.
    """
    length = 1 + sum(4 + len(data) for _, _, data in blocks)
    frame = HEADER + bytes((BROADCAST,)) + _words(length) + bytes((Instruction.STATUS,))
    for error, servo, data in blocks:
        frame += bytes((error, servo)) + data
        frame += crc16(frame).to_bytes(2, "little")
    return frame


def fast_blocks(reply: Packet, lengths: Sequence[int]) -> list[tuple[int, int, bytes]]:
    """(error, servo, data) of each block in a fast read reply; PacketError when the lengths do not add up.

    Inner CRCs were covered by the CRC of the frame and are skipped.
    """
    total = sum(4 + n for n in lengths) - 2  # the last CRC is the frame's
    if not reply.is_fast_reply or len(reply.params) != total:
        raise PacketError(
            f"a fast read of {list(lengths)} bytes answers {total} bytes, got {len(reply.params)}"
        )
    blocks, place = [], 0
    for n in lengths:
        block = reply.params[place : place + 2 + n]
        blocks.append((block[0], block[1], block[2:]))
        place += 4 + n
    return blocks
