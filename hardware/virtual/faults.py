"""Faults of a bus and its servos as frozen data, drawn from a seed: the same plan gives the same run."""

from __future__ import annotations

from dataclasses import dataclass
from random import Random
from typing import Literal

from ..errors import HardwareError
from ..packets import HEADER

Wire = Literal["lost", "late", "truncated", "corrupted", "duplicated", "noise"]
Upset = Literal["dead", "overload", "overheating", "undervoltage", "electrical shock", "encoder", "watchdog"]
Direction = Literal["instruction", "status", "both"]

WIRE_FAULTS: tuple[Wire, ...] = ("lost", "late", "truncated", "corrupted", "duplicated", "noise")


@dataclass(frozen=True)
class WireFault:
    """Packets that suffer on the wire.

    Args:
        kind: lost (never arrives), late (by `delay`; a late instruction holds the host up as well),
            truncated (its end is missing), corrupted (a flipped bit), duplicated (comes twice) or noise
            (stray bytes before it).
        probability: Of each packet that matches.
        direction: Packets to the servos, from them, or both. A lost instruction is heard by no servo; a
            lost status was heard by the other servos, so that a chain of replies goes on.
        servo: Only packets with this ID; None for all. Broadcast instructions have ID 254.
        start, stop: Only in this span of bus time [s].
        delay: Of a late packet [s].
    """

    kind: Wire
    probability: float = 1.0
    direction: Direction = "both"
    servo: int | None = None
    start: float = 0.0
    stop: float = float("inf")
    delay: float = 0.005

    def __post_init__(self) -> None:
        if self.kind not in WIRE_FAULTS:
            raise HardwareError(f"no wire fault {self.kind!r}; there are: {', '.join(WIRE_FAULTS)}")
        if not 0 <= self.probability <= 1:
            raise HardwareError(f"probability of {self.kind!r} is {self.probability}; it must be in [0, 1]")

    def matches(self, servo: int, direction: str, time: float) -> bool:
        """Whether a packet may suffer from this fault."""
        return (
            self.direction in (direction, "both")
            and self.servo in (None, servo)
            and self.start <= time < self.stop
        )


@dataclass(frozen=True)
class ServoFault:
    """What happens to one servo at a time [s]: dead until `stop`, or a hardware error that latches."""

    kind: Upset
    servo: int
    start: float
    stop: float = float("inf")


@dataclass(frozen=True)
class CablePull:
    """The cable to the host is out from `start` to `stop` [s]; servos keep their power."""

    start: float
    stop: float = float("inf")


@dataclass(frozen=True)
class FaultPlan:
    """All that goes wrong on a bus, and the seed that chance is drawn from."""

    wire: tuple[WireFault, ...] = ()
    servos: tuple[ServoFault, ...] = ()
    cable: tuple[CablePull, ...] = ()
    seed: int = 0

    def unplugged(self, time: float) -> bool:
        """Whether the cable is out."""
        return any(c.start <= time < c.stop for c in self.cable)


NO_FAULTS = FaultPlan()


class FaultDice:
    """Applies a plan to packets on the wire, with one random stream."""

    def __init__(self, plan: FaultPlan) -> None:
        self.plan = plan
        self._random = Random(plan.seed)
        self.count: dict[Wire, int] = dict.fromkeys(WIRE_FAULTS, 0)

    def apply(self, frame: bytes, servo: int, direction: str, time: float) -> list[tuple[float, bytes]]:
        """What arrives instead of a frame: (delay [s], bytes) of each piece, in order."""
        pieces = [(0.0, frame)]
        for fault in self.plan.wire:
            if fault.matches(servo, direction, time) and self._random.random() < fault.probability:
                self.count[fault.kind] += 1
                pieces = self._apply(fault, pieces)
        return pieces

    def _apply(self, fault: WireFault, pieces: list[tuple[float, bytes]]) -> list[tuple[float, bytes]]:
        if fault.kind == "lost":
            return []
        if fault.kind == "late":
            return [(delay + fault.delay, data) for delay, data in pieces]
        if fault.kind == "duplicated":
            return pieces + pieces
        if fault.kind == "noise":
            noise = self._random.randbytes(self._random.randint(1, 12)).replace(HEADER, b"")
            return [(0.0, noise), *pieces]
        return [(delay, self._spoil(fault.kind, data)) for delay, data in pieces]

    def _spoil(self, kind: str, data: bytes) -> bytes:
        if not data:
            return data
        if kind == "truncated":
            return data[: self._random.randrange(len(data))]
        place, bit = self._random.randrange(len(data)), 1 << self._random.randrange(8)
        return data[:place] + bytes((data[place] ^ bit,)) + data[place + 1 :]
