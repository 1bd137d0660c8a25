"""Dynamixel Protocol 2.0: a packet is a frozen value with encode and decode.

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
MARK = b"\xff\xff\xfd"  # what a header begins with; in a body, an extra FD follows it

_STUFFED = MARK + b"\xfd"


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
    return body.replace(MARK, _STUFFED)


def unstuff(body: bytes) -> bytes:
    """Inverse of `stuff`."""
    return body.replace(_STUFFED, MARK)


def is_stuffed(body: bytes) -> bool:
    """Whether every FF FF FD in a body is followed by the extra FD."""
    return body.count(MARK) == body.count(_STUFFED)


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


def fast_reply(blocks: Sequence[tuple[int, int, bytes]], length: int | None = None) -> bytes:
    """Bytes on the wire of a fast read reply with (error, servo, data) of each.

    One frame of the broadcast ID: LEN = 1 + sum(4 + n_i); after each block a CRC over everything so far. A
    reply that breaks off has a greater LEN than its blocks: ``length``.
    """
    length = fast_length(len(data) for _, _, data in blocks) if length is None else length
    frame = HEADER + bytes((BROADCAST,)) + _words(length) + bytes((Instruction.STATUS,))
    for error, servo, data in blocks:
        frame += bytes((error, servo)) + data
        frame += crc16(frame).to_bytes(2, "little")
    return frame


def fast_length(lengths: Iterable[int]) -> int:
    """LEN of a fast read reply with so many bytes of data from each servo."""
    return 1 + sum(4 + n for n in lengths)


def fast_blocks(frame: bytes, lengths: Sequence[int], *, whole: bool = False) -> list[tuple[int, int, bytes]]:
    """(error, servo, data) of the blocks of a fast read reply, up to the first that is cut off or broken.

    ``lengths`` are the bytes of data asked of each servo. Each block's CRC covers everything before it; those
    inside a ``whole`` frame, whose own CRC holds, are not looked at.
    """
    blocks: list[tuple[int, int, bytes]] = []
    if len(frame) < 8 or frame[4] != BROADCAST or frame[7] != Instruction.STATUS:
        return blocks
    crc, done, place = 0, 0, 8
    for n in lengths:
        end = place + 2 + n
        if end + 2 > len(frame):
            break
        if not whole:
            crc = crc16(frame[done:end], crc)
            if crc != frame[end] | frame[end + 1] << 8:
                break
            crc, done = crc16(frame[end : end + 2], crc), end + 2
        blocks.append((frame[place], frame[place + 1], frame[place + 2 : end]))
        place = end + 2
    return blocks
