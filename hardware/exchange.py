"""What travels between driver and servos: replies, blocks of registers, counts of packets, refusals."""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import BusError, HardwareError
from .registers import ControlTable

Array = NDArray[np.float64]


class NoAnswer(BusError):
    """A servo did not answer."""

    def __init__(self, servo: int, message: str) -> None:
        super().__init__(message)
        self.servo = servo


class Refused(HardwareError):
    """A servo answered with an error."""

    def __init__(self, servo: int, error: int, message: str) -> None:
        super().__init__(message)
        self.servo, self.error = servo, error


class Reply(NamedTuple):
    """What a servo answered: error byte and data."""

    error: int
    data: bytes


@dataclass(frozen=True)
class Found:
    """A servo that answered a ping; `table` is None for a model without a control table here."""

    id: int
    baud: int
    number: int
    firmware: int
    table: ControlTable | None

    @property
    def model(self) -> str:
        """Model name, or its number when unknown."""
        return self.table.model if self.table else f"unknown model {self.number}"


@dataclass
class Statistics:
    """Packets so far.

    lost: answers that did not come, or came broken (one, when nobody answered a question to many); strays:
    answers nobody waited for; missing, by servo: answers that did not come after all retries.
    """

    sent: int = 0
    received: int = 0
    lost: int = 0
    corrupt: int = 0
    strays: int = 0
    timeouts: int = 0
    retries: int = 0
    missing: Counter[int] = field(default_factory=Counter)


@dataclass(frozen=True)
class Block:
    """Registers that are read from many servos at once, and how their bytes become numbers.

    Args:
        names: Registers, in order.
        ids: Servos, in order.
        spans: (address, length) by servo.
        layout: Of the bytes, the same for all.
        zero, scale: (servos, registers): SI value = (count - zero) * scale.
        fast: Every firmware answers fast sync reads.
    """

    names: tuple[str, ...]
    ids: tuple[int, ...]
    spans: dict[int, tuple[int, int]]
    layout: struct.Struct
    zero: Array
    scale: Array
    fast: bool

    @cached_property
    def uniform(self) -> bool:
        """Whether one sync read reaches all; else it takes a bulk read."""
        return len(set(self.spans.values())) == 1

    @cached_property
    def silence(self) -> tuple[float, ...]:
        """Row of counts of a servo that did not answer: NaN."""
        return (np.nan,) * len(self.names)

    def counts(self, replies: dict[int, Reply]) -> list[tuple[float, ...]]:
        """Signed counts, a row of registers for each servo; `silence` for one that did not answer."""
        unpack, size, silence = self.layout.unpack, self.layout.size, self.silence
        return [
            unpack(r.data) if (r := replies.get(i)) is not None and len(r.data) == size else silence
            for i in self.ids
        ]

    def si(self, counts: Sequence[Any] | Array) -> Array:
        """SI values of counts (..., servos, registers)."""
        return (np.array(counts, dtype=float) - self.zero) * self.scale

    def decode(self, replies: dict[int, Reply]) -> Array:
        """Values (servos, registers) in SI; a row of NaN for a servo that did not answer."""
        return self.si(self.counts(replies))
