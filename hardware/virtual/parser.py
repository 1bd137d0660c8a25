"""Bytes as they arrive at a servo, made into packets and faults."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from ..packets import BROADCAST, HEADER, MARK, Instruction, Packet, crc16

MAX_LENGTH = 2048  # greatest LEN the parser believes; longer than any frame on a bus of 253 servos of 4 bytes


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
        while (place := buffer.find(MARK, place, end - 2)) >= 0:
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
