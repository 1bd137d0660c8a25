"""The servo bus: wire time, a million bytes of fuzz, the mirror. `make bench NAME=servo`.

A part is a function that returns figures; the last line is one JSON object of all of them.
"""

import sys
import time
from collections.abc import Iterator
from random import Random

from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler
from figures import Figure, at_most, main
from pantograph.hardware import packets as p
from pantograph.hardware.virtual import MemoryPort, Timing, VirtualBus, VirtualServo
from pantograph.hardware.virtual.parser import Parser
from rich.console import Console
from rich.progress import track
from rich.table import Table
from servo_mirror import cpu_cost, driver_wire_time, losses, real_time

GOAL, PRESENT = 116, 132
FUZZ_BYTES = 1_000_000
SDK = PacketHandler(2.0)


# Wire time.

TOLD = {  # notes on Dynamixel: servos, bit rate: sync and fast cycle [ms]
    (6, 57_600): (26.7, 20.8), (6, 1_000_000): (1.54, 1.20), (6, 2_000_000): (0.77, 0.60),
    (6, 3_000_000): (0.51, 0.40), (6, 4_000_000): (0.39, 0.30),
    (12, 57_600): (48.6, 35.4), (12, 1_000_000): (2.80, 2.04), (12, 2_000_000): (1.40, 1.02),
    (12, 3_000_000): (0.93, 0.68), (12, 4_000_000): (0.70, 0.51),
    (20, 57_600): (77.8, 54.9), (20, 1_000_000): (4.48, 3.16), (20, 2_000_000): (2.24, 1.58),
    (20, 3_000_000): (1.49, 1.05), (20, 4_000_000): (1.12, 0.79),
}  # fmt: skip


def cycle(count: int, baud: int, *, fast: bool, delay: int = 0, latency: float = 0.0) -> float:
    """Wire time [s] of one sync write and one sync read of positions through the SDK, from the ledger."""
    servos = [
        VirtualServo("xm430-w350", i, baud=baud, registers={"return_delay_time": delay})
        for i in range(1, count + 1)
    ]
    bus = VirtualBus(servos, timing=Timing(latency_timer=latency))
    port = MemoryPort(bus, baud)
    port.openPort()
    write, read = GroupSyncWrite(port, SDK, GOAL, 4), GroupSyncRead(port, SDK, PRESENT, 4)
    for servo in servos:
        write.addParam(servo.id, [0, 8, 0, 0])
        read.addParam(servo.id)
    if write.txPacket() or (read.fastSyncRead() if fast else read.txRxPacket()):
        raise RuntimeError(f"{count} servos at {baud:,} bit/s did not answer")
    return bus.ledger.total


def wire_time(console: Console) -> list[Figure]:
    """Ledger against bytes of the notes (28 + 21 N, with fast read 36 + 14 N) and their printed table."""
    table = Table(title="One cycle: sync write + sync read of position [ms]")
    for name in ("servos", "bit/s", "sync", "notes", "fast", "notes"):
        table.add_column(name, justify="right")
    bytes_off, table_off = 0.0, 0.0
    for (count, baud), told in TOLD.items():
        row = [str(count), f"{baud:,}"]
        for fast, size, said in ((False, 28 + 21 * count, told[0]), (True, 36 + 14 * count, told[1])):
            seconds = cycle(count, baud, fast=fast)
            exact = size * 10 / baud
            bytes_off = max(bytes_off, abs(seconds / exact - 1))
            half_a_digit = 0.05 if said > 10 else 0.005
            table_off = max(table_off, max(abs(seconds * 1e3 - said) - half_a_digit, 0.0) / said)
            row += [f"{seconds * 1e3:.3f}", f"{said:g}"]
        table.add_row(*row)
    console.print(table)
    delay = (cycle(12, 1_000_000, fast=False, delay=250) - cycle(12, 1_000_000, fast=False)) / (12 * 500e-6)
    rate = 1 / cycle(6, 1_000_000, fast=True, latency=16e-3)
    return [
        at_most("wire time, off the notes' bytes", 100 * bytes_off, 1.0, "%"),
        at_most("wire time, off the notes' table beyond its last digit", 100 * table_off, 1.0, "%"),
        at_most("return delay, off 0.5 ms a servo", 100 * abs(delay - 1), 1.0, "%"),
        Figure("loop rate with a latency timer of 16 ms", rate, "Hz", "50 to 62.5", 50 <= rate <= 62.5),
    ]


# Fuzz.


def packet(random: Random) -> p.Packet:
    """A packet with a body that likes to look like a header."""
    body = bytes(random.choice(b"\xff\xff\xfd\xfd\x00\x01\x55") for _ in range(random.randrange(12)))
    body += random.randbytes(random.randrange(20))
    instruction = random.choice([*p.Instruction])
    servo = random.choice([random.randrange(253), p.BROADCAST])
    if instruction == p.Instruction.STATUS:
        return p.status(servo % 253, random.randrange(256), body)
    return p.Packet(servo, instruction, body)


def mutate(data: bytes, random: Random) -> bytes:
    """Cut, flip, insert or double."""
    out = bytearray(data)
    for _ in range(random.randint(1, 3)):
        place = random.randrange(len(out)) if out else 0
        match random.randrange(4):
            case 0:
                del out[place:]
            case 1 if out:
                out[place] ^= 1 << random.randrange(8)
            case 2:
                out[place:place] = random.randbytes(random.randint(1, 4))
            case _:
                out[place:place] = out[:place]
    return bytes(out)


def pieces(random: Random, size: int) -> Iterator[bytes]:
    """About `size` bytes: noise, packets, packets without stuffing, broken packets."""
    sent = 0
    while sent < size:
        frame = packet(random).encode(stuffed=random.random() < 0.7)
        kind = random.random()
        data = random.randbytes(random.randint(1, 60)) if kind < 0.3 else frame
        data = mutate(frame, random) if kind > 0.6 else data
        sent += len(data)
        yield data


def swallowed(junk: bytes, frame: bytes) -> bool:
    """Whether the junk announces a frame that ends inside the next one, with a CRC that fits by chance."""
    stream = junk + frame
    for start in range(len(junk)):
        if stream[start : start + 4] == p.HEADER and start + 7 <= len(stream):
            end = start + 7 + int.from_bytes(stream[start + 5 : start + 7], "little")
            crc = int.from_bytes(stream[end - 2 : end], "little")
            if len(junk) < end <= len(stream) and p.crc16(stream[start : end - 2]) == crc:
                return True
    return False


def fuzz_parser(console: Console) -> list[Figure]:
    """After every piece a packet is sent that the parser must deliver with its last byte.

    One broken frame in 65,536 has a CRC that fits: it is a packet, and may eat the beginning of the next.
    """
    figures = []
    for lenient in (False, True):
        random = Random(20260101)
        parser = Parser(lenient=lenient)
        raised = missed = eaten = probes = fed = 0
        start = time.perf_counter()
        for data in track([*pieces(random, FUZZ_BYTES)], f"parser, lenient={lenient}", console=console):
            probe = packet(random)
            frame = probe.encode()
            probes += 1
            fed += len(data) + len(frame)
            cut = random.randrange(len(frame))
            try:
                parser.feed(data)
                parser.feed(frame[:cut])
                found = parser.feed(frame[cut:])
            except Exception as error:
                console.print(f"[red]{error!r}[/red] at {data.hex(' ')}")
                raised += 1
                continue
            if not found or found[-1] != probe:
                chance = swallowed(data, frame)
                eaten += chance
                missed += not chance
        seconds = time.perf_counter() - start
        mode = "lenient" if lenient else "strict"
        console.print(f"{mode} parser: {fed:,} bytes, {probes:,} probes, {fed / seconds / 1e6:.1f} MB/s")
        figures += [
            Figure(f"fuzz, {mode} parser: bytes", fed, "bytes", ">= 1e6", fed >= FUZZ_BYTES),
            at_most(f"fuzz, {mode} parser: exceptions", raised, 0, ""),
            at_most(f"fuzz, {mode} parser: packets not found at once", missed, 0, ""),
            at_most(f"fuzz, {mode} parser: packets eaten by a CRC that fits by chance", eaten, 3, ""),
        ]
    return figures


def fuzz_bus(console: Console) -> list[Figure]:
    """Servos execute what the noise happens to say; afterwards each answers at its own ID and rate."""
    random = Random(7)
    servos = [
        VirtualServo(m, i, baud=1_000_000, registers={"return_delay_time": 0})
        for i, m in enumerate(("xl330-m288", "xl430-w250", "xm430-w350", "mx-106"), 1)
    ]
    bus = VirtualBus(servos)
    raised = silent = sent = 0
    for data in track([*pieces(random, FUZZ_BYTES)], "bus", console=console):
        sent += len(data)
        try:
            bus.send(data, 1_000_000)
        except Exception as error:
            console.print(f"[red]{error!r}[/red] at {data.hex(' ')}")
            raised += 1
    bus.advance(1.0)
    for servo in servos:
        bus.receive()
        bus.send(p.ping(servo.id).encode(), servo.baud)
        bus.advance(0.1)
        same = sum(s.id == servo.id and s.baud == servo.baud for s in servos)
        answers = [e for e in Parser().feed(bus.receive()) if isinstance(e, p.Packet)]
        silent += same == 1 and [a.id for a in answers] != [servo.id]
    return [
        Figure("fuzz, bus: bytes", sent, "bytes", ">= 1e6", sent >= FUZZ_BYTES),
        at_most("fuzz, bus: exceptions", raised, 0, ""),
        at_most("fuzz, bus: servos silent afterwards", silent, 0, ""),
    ]


PARTS = {
    part.__name__: part
    for part in (wire_time, fuzz_parser, fuzz_bus, driver_wire_time, cpu_cost, losses, real_time)
}

if __name__ == "__main__":
    sys.exit(main("servo", PARTS))
