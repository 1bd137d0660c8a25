"""The driver and the mirror: CPU cost of a cycle, ten minutes of packet loss, a loop in real time.

Parts of `make bench NAME=servo`; each returns figures.
"""

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from dynamixel_sdk import PacketHandler
from figures import Figure, at_most
from pantograph.hardware.connect import connect
from pantograph.hardware.mirror import Session
from pantograph.hardware.mirror.contract import prepare
from pantograph.hardware.mirror.loop import Log, Loop
from pantograph.hardware.packets import Instruction
from pantograph.hardware.rig import Rig, parse_rig
from pantograph.hardware.virtual import FaultPlan, VirtualBus, WireFault
from pantograph.hardware.virtual_rig import virtual_bus
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

SERVOS = 12
MINUTES = 10.0
RATE = 50.0
LOSS = 0.01
REAL_RATE, REAL_SECONDS = 100.0, 15.0


def make_rig(count: int = SERVOS, rate: float = RATE, servos: str = "xm430-w350") -> Rig:
    """Joints j1, j2, ... with a servo each."""
    text = f"name = 'bench'\nrate = {rate}\nwatchdog = 0.2\nramp_velocity = 1.0\nservos = [\n"
    text += (
        "".join(f"{{ name = 's{i}', id = {i}, model = '{servos}' }},\n" for i in range(1, count + 1)) + "]\n"
    )
    joints = (
        f"[[joints]]\njoint = 'j{i}'\nservo = 's{i}'\nvelocity = 4.0\nrange = [-3, 3]\n"
        for i in range(1, count + 1)
    )
    return parse_rig(text + "".join(joints))


def wave(t: float, count: int) -> np.ndarray:
    """Servo angles of a smooth motion [rad]."""
    return 0.5 * np.sin(1.5 * t + 0.5 * np.arange(count))


# CPU cost.


class Canned:
    """A port that answers at once, with the bytes that the same question was answered before."""

    def __init__(self, real: object) -> None:
        self.real, self.port_name = real, "canned"
        self.answers: dict[int, bytes] = {}
        self.is_using = False
        self.packet_timeout = 0.0
        self._ready, self._place = b"", 0

    def record(self, data: bytes, answer: bytes) -> None:
        self.answers[data[7]] = answer

    def getBaudRate(self) -> int:
        return self.real.getBaudRate()

    def clearPort(self) -> None:
        self._ready, self._place = b"", 0

    def writePort(self, packet: list[int]) -> int:
        self._ready, self._place = self.answers.get(packet[7], b""), 0
        return len(packet)

    def readPort(self, length: int) -> bytes:
        out = self._ready[self._place : self._place + length]
        self._place += len(out)
        return out

    def setPacketTimeoutMillis(self, msec: float) -> None:
        self.packet_timeout = msec

    def setPacketTimeout(self, length: int) -> None:
        self.packet_timeout = 1000.0

    def isPacketTimeout(self) -> bool:
        self.packet_timeout = 0.0
        return True


class Frozen:
    """A clock that stands still: nothing is ever late."""

    def now(self) -> float:
        return 0.0

    def sleep_until(self, t: float) -> None:
        pass


def ready_loop(firmware: int) -> tuple[Loop, Canned]:
    """A control loop of 12 servos on a canned port: position, velocity, current, errors, goal read back."""
    rig = make_rig()
    bus = virtual_bus(rig, firmware=firmware)
    driver, _ = connect(rig, bus=bus)
    session = Session(rig, driver)
    for id in rig.ids:
        driver.ping(id)
    ready = prepare(driver, rig, session.mapping, session.bounds, torque=False)
    for id in rig.ids:
        driver.write_raw(id, "torque_enable", 1)
    loop = Loop(driver, rig, session.bounds, ready, Log())
    port = driver.port
    canned = Canned(port)
    frames: list[bytes] = []
    send, receive = bus.send, port.readPort

    def spy_send(data: bytes, baud: int) -> None:
        frames.append(data)
        send(data, baud)

    answer = bytearray()

    def spy_receive(length: int) -> bytes:
        data = receive(length)
        answer.extend(data)
        return data

    bus.send, port.readPort = spy_send, spy_receive
    loop.cycle(loop.goal, driver.clock.now(), "stream")
    canned.record(frames[-1], bytes(answer))
    driver.port, driver.clock = canned, Frozen()
    loop._health_due = 1e9
    return loop, canned


def sdk_alone(canned: Canned, loop: Loop, *, fast: bool) -> float:
    """Seconds that the SDK's own packet handler takes for the same two transactions."""
    handler = PacketHandler(2.0)
    ids = list(loop.rig.ids)
    address, length = loop.ready.block.spans[ids[0]]
    goals = [x for i in ids for x in (i, 0, 8, 0, 0)]
    begin = time.perf_counter()
    handler.syncWriteTxOnly(canned, 116, 4, goals, len(goals))
    handler.syncReadTx(canned, address, length, ids, len(ids), fast)
    if fast:
        handler.fastSyncReadRx(canned, 0xFE, (length + 4) * len(ids))
    else:
        for id in ids:
            handler.readRx(canned, id, length)
    return time.perf_counter() - begin


def cpu_cost(console: Console) -> list[Figure]:
    """A whole cycle of the mirror's loop against the SDK's share of it, by turns in one run."""
    table = Table(title=f"CPU of one cycle of {SERVOS} servos [ms]: goals out, 17 bytes of each back")
    for name in ("read", "whole cycle", "the SDK alone", "own", "spread of own"):
        table.add_column(name, justify="right")
    figures = []
    for fast, name in ((False, "sync"), (True, "fast sync")):
        loop, canned = ready_loop(45 if fast else 44)
        whole, sdk = [], []
        for _ in range(1500):
            begin = time.perf_counter()
            loop.cycle(loop.goal, 0.0, "stream")
            whole.append(time.perf_counter() - begin)
            sdk.append(sdk_alone(canned, loop, fast=fast))
        assert np.isfinite(loop.log.feedback).all()
        own = np.array(whole) - np.array(sdk)
        median = float(np.median(own))
        low, high = np.quantile(own, [0.1, 0.9])
        row = [name, np.median(whole), np.median(sdk), median]
        table.add_row(row[0], *(f"{1e3 * x:.3f}" for x in row[1:]), f"{1e3 * low:.3f} to {1e3 * high:.3f}")
        figures += [
            at_most(f"own CPU of a cycle, {SERVOS} servos, {name} read", 1e3 * median, 0.5, "ms"),
            at_most(
                f"own CPU of a cycle over the SDK's, {name} read", median / float(np.median(sdk)), 1.0, ""
            ),
        ]
    console.print(table)
    return figures


# Wire time of the driver.


def driver_wire_time(console: Console) -> list[Figure]:
    """The driver's own cycle of positions on the ledger, against the bytes of the notes."""
    worst = 0.0
    for firmware, size in ((44, 28 + 21 * SERVOS), (45, 36 + 14 * SERVOS)):
        rig = make_rig()
        bus = virtual_bus(rig, firmware=firmware)
        driver, _ = connect(rig, bus=bus)
        for id in rig.ids:
            driver.ping(id)
            driver.write_raw(id, "return_delay_time", 0)
            driver.return_delay[id] = 0.0
        block = driver.block(rig.ids, ["present_position"])
        bus.ledger.clear()
        driver.sync_write(rig.ids, "goal_position", [2048] * SERVOS)
        heard = driver.read_block(block)
        assert len(heard) == SERVOS
        worst = max(worst, abs(bus.ledger.total / (size * 10 / rig.baud) - 1))
        worst = max(worst, abs(driver.cycle_time(block) / bus.ledger.total - 1))
    return [at_most(f"driver: position cycle of {SERVOS} servos, off the notes", 100 * worst, 1.0, "%")]


# Ten minutes of losses.


class Truth:
    """What was really lost on the bus, and the fastest that any shaft moved in 1 ms."""

    def __init__(self, bus: VirtualBus) -> None:
        self.lost_goals: list[int] = []  # cycle in which each lost goal packet was sent
        self.lost_answers = 0
        self.cycle = -1
        self.same = False
        self._last = b""
        apply = bus.dice.apply

        def spy(frame: bytes, servo: int, direction: str, now: float) -> list[tuple[float, bytes]]:
            goal = direction == "instruction" and frame[7] == Instruction.SYNC_WRITE
            if goal:
                self.cycle += 1
                changed, self._last = frame != self._last, frame
            pieces = apply(frame, servo, direction, now)
            if not pieces and goal and changed:
                self.lost_goals.append(self.cycle)
            elif not pieces and not goal:
                self.lost_answers += 1
            return pieces

        bus.dice.apply = spy


def losses(console: Console) -> list[Figure]:
    """50 Hz over ten virtual minutes with 1 % of all packets lost: what was lost, seen, and felt."""
    count = 6
    rig = make_rig(count)
    seconds = 60 * MINUTES
    plan = FaultPlan(wire=(WireFault("lost", LOSS, start=2.5, stop=seconds),), seed=11)
    bus = virtual_bus(rig, pose=wave(0.0, count), faults=plan, firmware=44)
    truth = Truth(bus)
    driver, _ = connect(rig, bus=bus)
    fastest = 0.0
    shafts = np.array([s.drive.shaft for s in bus.servos])
    step = bus.servos[-1].step

    def watch() -> None:
        nonlocal fastest, shafts
        step()
        now = np.array([s.drive.shaft for s in bus.servos])
        fastest, shafts = max(fastest, float(np.abs(now - shafts).max())), now

    bus.servos[-1].step = watch
    session = Session(rig, driver)
    with Progress(console=console, transient=True) as progress:
        task = progress.add_task("ten minutes of losses", total=seconds)

        def target(t: float) -> np.ndarray:
            progress.update(task, completed=t)
            return wave(t, count)

        outcome = session.run(wave(0.0, count), target, seconds)
    log, seen = outcome.log, driver.statistics
    feedback = outcome.ready.block.si(log.feedback)[:, :, 0]
    heard = np.isfinite(feedback).any(axis=1)
    visible = sum(bool(heard[c]) for c in truth.lost_goals if c < len(heard))
    error = (feedback - np.array(log.goal))[[p == "stream" for p in log.phase]]
    lag = float(np.nanmax(np.abs(error)))
    console.print(
        f"{len(log.goal):,} cycles, {bus.dice.count['lost']:,} packets lost: {len(truth.lost_goals)} goals "
        f"({visible} visible, {log.lost_goals} seen), {truth.lost_answers} questions and answers "
        f"({seen.lost} seen); oldest goal {log.oldest_goal} cycles, farthest behind a goal {lag:.3f} rad, "
        f"{outcome.status}"
    )
    finished, lost = outcome.status == "done", bus.dice.count["lost"]
    least = round(100 * MINUTES)
    fair = 1.25 * float(max(session.bounds.velocity)) * 1e-3
    return [
        Figure("ten minutes, 1 % lost: finished", float(finished), "", "1", finished),
        Figure("ten minutes: packets lost", lost, "", f"> {least}", lost > least),
        at_most("ten minutes: visible lost goals not counted", abs(visible - log.lost_goals), 0, ""),
        at_most("ten minutes: lost answers not counted", abs(truth.lost_answers - seen.lost), 0, ""),
        at_most("ten minutes: oldest goal", log.oldest_goal, 5, "cycles"),
        at_most("ten minutes: fastest shaft over 1 ms, of the profile's cap", fastest / fair, 1.1, ""),
        at_most("ten minutes: farthest behind a goal", lag, 0.2, "rad"),
    ]


# Real time.


def real_time(console: Console) -> list[Figure]:
    """100 Hz to 12 servos behind a pseudo-terminal, served by a process of its own."""
    rig = make_rig(rate=REAL_RATE)
    with tempfile.TemporaryDirectory() as folder:
        link = Path(folder) / "bus"
        command = "from pantograph.hardware.cli import app; app()"
        server = subprocess.Popen(
            [sys.executable, "-c", command, "simulate", *["xm430-w350"] * SERVOS, "--link", str(link)],
            stdout=subprocess.PIPE,
            text=True,
        )
        try:
            server.stdout.readline()
            driver, _ = connect(rig, port=str(link))
            session = Session(rig, driver, stop="limp")
            console.print(f"{REAL_SECONDS:.0f} s in real time ...")
            outcome = session.run(
                np.zeros(SERVOS), lambda t: wave(t, SERVOS) - wave(0.0, SERVOS), REAL_SECONDS
            )
            driver.close()
        finally:
            server.terminate()
            server.wait(10)
    log = outcome.log
    stream = [i for i, p in enumerate(log.phase) if p == "stream"]
    due, begun, ended = (np.array(x)[stream] for x in (log.due, log.begun, log.ended))
    jitter, busy = begun - due, ended - begun
    rate = float((len(stream) - 1) / (begun[-1] - begun[0]))
    console.print(
        f"{outcome.status} {outcome.message}: {rate:.2f} Hz, {log.skipped} skipped; jitter median "
        f"{1e3 * np.median(jitter):.3f}, 99 % {1e3 * np.quantile(jitter, 0.99):.3f}, "
        f"greatest {1e3 * jitter.max():.3f} ms; "
        f"busy median {1e3 * np.median(busy):.2f} ms; load of the machine {os.getloadavg()[0]:.1f} "
        f"on {os.cpu_count()} cores"
    )
    return [
        Figure("real time: rate kept over 15 s", rate, "Hz", ">= 99", rate >= 99),
        at_most("real time: jitter, 99th percentile", 1e3 * float(np.quantile(jitter, 0.99)), 5.0, "ms"),
        at_most("real time: jitter, median", 1e3 * float(np.median(jitter)), 0.5, "ms"),
    ]
