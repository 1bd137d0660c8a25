"""The official SDK on virtual servos, in memory and on a pseudo-terminal; wire time; faults."""

import os
import select
import subprocess
import sys
import termios
import textwrap
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from dynamixel_sdk import (
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    DXL_HIBYTE,
    DXL_HIWORD,
    DXL_LOBYTE,
    DXL_LOWORD,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
    PacketHandler,
    PortHandler,
)
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.hardware import packets as p
from pantograph.hardware.errors import BusError, HardwareError
from pantograph.hardware.packets import Packet
from pantograph.hardware.virtual import (
    CablePull,
    FaultPlan,
    MemoryPort,
    PtyServer,
    ServoFault,
    Timing,
    VirtualBus,
    VirtualServo,
    WireFault,
    serve,
)
from pantograph.hardware.virtual.parser import Parser
from serial import Serial, SerialException

TORQUE, LED, GOAL, PRESENT = 64, 65, 116, 132
SDK = PacketHandler(2.0)


@dataclass
class Lane:
    """A bus as a program of the SDK sees it."""

    port: Any
    bus: VirtualBus
    wait: Callable[[float], None]


def servos(
    count: int, model: str = "xm430-w210", *, baud: int = 1_000_000, **registers: int
) -> list[VirtualServo]:
    return [VirtualServo(model, i, baud=baud, firmware=48, registers=registers) for i in range(1, count + 1)]


def memory(bus: VirtualBus, baud: int = 1_000_000) -> Lane:
    port = MemoryPort(bus, baud)
    assert port.openPort()
    return Lane(port, bus, bus.advance)


@pytest.fixture(autouse=True)
def patience(monkeypatch) -> None:
    """In real time the SDK's 34 ms are too short on a machine that tests other things meanwhile."""
    monkeypatch.setattr("dynamixel_sdk.port_handler.LATENCY_TIMER", 60)


@pytest.fixture(params=["memory", "pty"])
def lane(request) -> Iterator[Callable[..., Lane]]:
    """Makes a lane of servos; the pseudo-terminal is opened by the SDK's own PortHandler."""
    cleanup: list[Callable[[], None]] = []

    def make(chain: list[VirtualServo], **options: Any) -> Lane:
        bus = VirtualBus(chain, **options)
        if request.param == "memory":
            return memory(bus)
        server = serve(bus)
        port = PortHandler(server.port)
        assert port.openPort() and port.setBaudRate(1_000_000)
        cleanup.extend([server.close, port.closePort])
        return Lane(port, bus, time.sleep)

    yield make
    for step in reversed(cleanup):
        step()


def word_bytes(value: int) -> list[int]:
    """As the SDK's examples cut a goal into bytes."""
    low, high = DXL_LOWORD(value), DXL_HIWORD(value)
    return [DXL_LOBYTE(low), DXL_HIBYTE(low), DXL_LOBYTE(high), DXL_HIBYTE(high)]


def torque_on(lane: Lane, *ids: int) -> None:
    for i in ids:
        result, error = SDK.write1ByteTxRx(lane.port, i, TORQUE, 1)
        assert SDK.getTxRxResult(result) == "[TxRxResult] Communication success!"
        assert SDK.getRxPacketError(error) == ""


def arrive(lane: Lane, goals: dict[int, int], present: Callable[[int], int]) -> None:
    """Poll as the examples do, until every servo is within 20 counts."""
    for _ in range(400):
        if all(abs(goal - present(i)) <= 20 for i, goal in goals.items()):
            return
        lane.wait(0.01)
    raise AssertionError({i: present(i) for i in goals})


# Programs in the manner of the SDK's examples for protocol 2.0.


def test_ping(lane):
    there = lane(servos(1))
    number, result, error = SDK.ping(there.port, 1)
    assert (number, result, error) == (1030, COMM_SUCCESS, 0)
    number, result, _ = SDK.ping(there.port, 2)
    assert SDK.getTxRxResult(result) == "[TxRxResult] There is no status packet!"


def test_broadcast_ping(lane):
    chain = [VirtualServo("xl430-w250", 9, baud=1_000_000, firmware=47), *servos(2)]
    found, result = SDK.broadcastPing(lane(chain).port)
    assert result == COMM_SUCCESS
    assert found == {1: [1030, 48], 2: [1030, 48], 9: [1060, 47]}


def test_read_write(lane):
    there = lane(servos(1))
    torque_on(there, 1)
    for goal in (2300, 1900):
        assert SDK.write4ByteTxRx(there.port, 1, GOAL, goal) == (COMM_SUCCESS, 0)
        arrive(there, {1: goal}, lambda i: SDK.read4ByteTxRx(there.port, i, PRESENT)[0])
    assert SDK.write1ByteTxRx(there.port, 1, TORQUE, 0) == (COMM_SUCCESS, 0)


def test_errors_read_as_the_manual_says(lane):
    there = lane(servos(1))
    torque_on(there, 1)
    _, error = SDK.write1ByteTxRx(there.port, 1, 11, 4)
    assert "Writing or Reading is not available to target address" in SDK.getRxPacketError(error)
    _, error = SDK.write4ByteTxRx(there.port, 1, GOAL, 5000)
    assert "The data value exceeds the limit value" in SDK.getRxPacketError(error)
    _, error = SDK.write2ByteTxRx(there.port, 1, GOAL, 5)
    assert "The data length does not match" in SDK.getRxPacketError(error)
    there.bus[1].fail(0x20)
    _, _, error = SDK.ping(there.port, 1)
    assert "Hardware error occurred" in SDK.getRxPacketError(error)


@pytest.mark.parametrize("fast", [False, True])
def test_sync_read_write(lane, fast):
    there = lane(servos(3))
    torque_on(there, 1, 2, 3)
    goals = {1: 2200, 2: 1900, 3: 2100}
    write = GroupSyncWrite(there.port, SDK, GOAL, 4)
    read = GroupSyncRead(there.port, SDK, PRESENT, 4)
    for i, goal in goals.items():
        assert write.addParam(i, word_bytes(goal)) and read.addParam(i)
    assert write.txPacket() == COMM_SUCCESS

    def present(i: int) -> int:
        assert (read.fastSyncRead() if fast else read.txRxPacket()) == COMM_SUCCESS
        assert read.isAvailable(i, PRESENT, 4)
        return read.getData(i, PRESENT, 4)

    arrive(there, goals, present)


@pytest.mark.parametrize("fast", [False, True])
def test_bulk_read_write(lane, fast):
    there = lane(servos(2))
    torque_on(there, 1)
    write, read = GroupBulkWrite(there.port, SDK), GroupBulkRead(there.port, SDK)
    assert write.addParam(1, GOAL, 4, word_bytes(2200))
    assert write.addParam(2, LED, 1, [1])
    assert read.addParam(1, PRESENT, 4) and read.addParam(2, LED, 1)
    assert write.txPacket() == COMM_SUCCESS

    def present(i: int) -> int:
        assert (read.fastBulkRead() if fast else read.txRxPacket()) == COMM_SUCCESS
        assert read.getData(2, LED, 1) == 1
        return read.getData(i, PRESENT, 4)

    arrive(there, {1: 2200}, present)


def test_indirect_address(lane):
    """Goal position and LED in one write, position and moving in one read, as the example does."""
    there = lane(servos(1))
    for i, address in enumerate([*range(GOAL, GOAL + 4), LED]):
        assert SDK.write2ByteTxRx(there.port, 1, 168 + 2 * i, address) == (COMM_SUCCESS, 0)
    for i, address in enumerate([*range(PRESENT, PRESENT + 4), 122]):
        assert SDK.write2ByteTxRx(there.port, 1, 578 + 2 * i, address) == (COMM_SUCCESS, 0)
    torque_on(there, 1)
    write, read = GroupSyncWrite(there.port, SDK, 224, 5), GroupSyncRead(there.port, SDK, 634, 5)
    assert write.addParam(1, [*word_bytes(2250), 1]) and read.addParam(1)
    assert write.txPacket() == COMM_SUCCESS
    assert SDK.read1ByteTxRx(there.port, 1, LED) == (1, COMM_SUCCESS, 0)

    def present(i: int) -> int:
        assert read.txRxPacket() == COMM_SUCCESS
        assert read.getData(i, 638, 1) in (0, 1)
        return read.getData(i, 634, 4)

    arrive(there, {1: 2250}, present)


def test_reboot(lane):
    there = lane(servos(1))
    SDK.write1ByteTxRx(there.port, 1, LED, 1)
    there.bus[1].fail(0x20)
    assert SDK.reboot(there.port, 1) == (COMM_SUCCESS, 0)
    assert SDK.ping(there.port, 1)[1] == COMM_RX_TIMEOUT  # it boots
    there.wait(0.15)
    assert SDK.read1ByteTxRx(there.port, 1, LED) == (0, COMM_SUCCESS, 0)


def test_factory_reset(lane):
    """All but the ID is reset, the rate falls back to 57,600 and is set again."""
    there = lane(servos(1))
    assert SDK.factoryReset(there.port, 1, 0x01) == (COMM_SUCCESS, 0)
    there.wait(0.15)
    assert SDK.ping(there.port, 1)[1] == COMM_RX_TIMEOUT
    assert there.port.setBaudRate(57_600)
    assert SDK.read1ByteTxRx(there.port, 1, 8) == (1, COMM_SUCCESS, 0)
    assert SDK.write1ByteTxRx(there.port, 1, 8, 3) == (COMM_SUCCESS, 0)
    assert there.port.setBaudRate(1_000_000)
    assert SDK.read1ByteTxRx(there.port, 1, 8) == (3, COMM_SUCCESS, 0)


def test_clear_multi_turn(lane):
    there = lane(servos(1, operating_mode=4))
    torque_on(there, 1)
    SDK.write4ByteTxRx(there.port, 1, GOAL, 2048 + 4096)
    arrive(there, {1: 2048 + 4096}, lambda i: SDK.read4ByteTxRx(there.port, i, PRESENT)[0])
    there.wait(0.2)
    before = SDK.read4ByteTxRx(there.port, 1, PRESENT)[0]
    assert SDK.clearMultiTurn(there.port, 1) == (COMM_SUCCESS, 0)
    assert SDK.read4ByteTxRx(there.port, 1, PRESENT)[0] == pytest.approx(before - 4096, abs=2)


def test_reg_write_and_action(lane):
    there = lane(servos(2))
    for i in (1, 2):
        result, error = SDK.regWriteTxRx(there.port, i, LED, 1, [1])
        assert (result, error) == (COMM_SUCCESS, 0)
    assert [s.get("led") for s in there.bus.servos] == [0, 0]
    assert SDK.action(there.port, 0xFE) == COMM_SUCCESS
    there.wait(0.02)
    assert [s.get("led") for s in there.bus.servos] == [1, 1]


def test_sdk_goal_that_needs_stuffing(lane):
    """-131073 leaves the SDK as an ambiguous frame: lenient servos understand it, strict ones are silent."""
    there = lane(servos(1, operating_mode=4))
    assert SDK.write4ByteTxRx(there.port, 1, GOAL, -131073) == (COMM_SUCCESS, 0)
    assert there.bus[1].get("goal_position") == -131073
    strict = lane(servos(1, operating_mode=4), lenient=False)
    assert SDK.write4ByteTxRx(strict.port, 1, GOAL, -131073)[0] == COMM_RX_TIMEOUT
    assert SDK.write4ByteTxRx(strict.port, 1, GOAL, -131074) == (COMM_SUCCESS, 0)


def test_status_data_that_needs_stuffing(lane):
    there = lane(servos(1, operating_mode=4))
    there.bus[1].memory.put("goal_position", -131073)
    value, result, _ = SDK.read4ByteTxRx(there.port, 1, GOAL)
    assert (value - (1 << 32), result) == (-131073, COMM_SUCCESS)


def test_easy_sdk():
    """The SDK's own high-level face, on a pseudo-terminal."""
    from dynamixel_easy_sdk import Connector, OperatingMode

    with serve(VirtualBus(servos(2))) as server:
        connector = Connector(server.port, 1_000_000)
        motors = connector.createAllMotors()
        assert [m.id for m in motors] == [1, 2]
        for motor in motors:
            motor.setOperatingMode(OperatingMode.EXTENDED_POSITION)
            motor.enableTorque()
        motors[0].setGoalPosition(2300)
        group = connector.createGroupExecutor()
        group.addCmd(motors[0].stageSetGoalPosition(2300))
        group.addCmd(motors[1].stageSetGoalPosition(1800))
        group.executeWrite()
        group.addCmd(motors[0].stageGetPresentPosition())
        group.addCmd(motors[1].stageGetPresentPosition())
        deadline = time.monotonic() + 5
        while time.monotonic() < deadline:
            a, b = group.executeRead()
            if abs(a - 2300) <= 20 and abs(b - 1800) <= 20:
                break
        else:
            raise AssertionError((a, b))
        motors[0].disableTorque()
        motors[0].changeID(5)
        assert motors[0].ping() == 1030
        connector.closePort()


# The bus.


def test_wrong_rate_meets_silence(lane):
    there = lane(servos(1))
    for rate in (57_600, 115_200, 2_000_000, 3_000_000, 4_000_000):
        assert there.port.setBaudRate(rate)
        assert SDK.ping(there.port, 1)[1] == COMM_RX_TIMEOUT
    assert there.port.setBaudRate(1_000_000)
    assert SDK.ping(there.port, 1)[1] == COMM_SUCCESS


@pytest.mark.parametrize("fast", [False, True])
def test_a_missing_servo_breaks_the_chain(lane, fast):
    """Servos before it answer, those after it do not; the SDK drops everything."""
    there = lane(servos(4))
    there.bus[3].dead = True
    read = GroupSyncRead(there.port, SDK, PRESENT, 4)
    for i in (1, 2, 3, 4):
        read.addParam(i)
    result = read.fastSyncRead() if fast else read.txRxPacket()
    assert result == (COMM_RX_CORRUPT if fast else COMM_RX_TIMEOUT)
    assert not read.isAvailable(1, PRESENT, 4)
    assert there.bus.ledger.statuses == (1 if fast else 2)


def replies(bus: VirtualBus, packet: p.Packet, baud: int = 1_000_000) -> list[p.Packet]:
    """Everything that comes back within a second of virtual time."""
    bus.send(packet.encode(), baud)
    bus.advance(1.0)
    return [e for e in Parser().feed(bus.receive()) if isinstance(e, p.Packet)]


def test_replies_come_in_the_order_of_the_request():
    bus = VirtualBus(servos(5)[::-1])
    assert [r.id for r in replies(bus, p.sync_read(PRESENT, 4, [4, 1, 3]))] == [4, 1, 3]
    assert [r.id for r in replies(bus, p.bulk_read([(5, 7, 1), (2, 7, 1)]))] == [5, 2]
    assert [r.id for r in replies(bus, p.ping())] == [1, 2, 3, 4, 5]
    (fast,) = replies(bus, p.sync_read(7, 1, [4, 1, 3], fast=True))
    assert p.fast_blocks(fast.encode(), [1, 1, 1]) == [(0, 4, b"\4"), (0, 1, b"\1"), (0, 3, b"\3")]
    assert replies(bus, p.write(p.BROADCAST, LED, b"\1")) == []
    assert all(s.get("led") == 1 for s in bus.servos)


def test_old_firmware_does_not_know_fast_reads():
    bus = VirtualBus([VirtualServo("xm430-w350", 1, baud=1_000_000, firmware=44)])
    assert replies(bus, p.sync_read(7, 1, [1], fast=True)) == []
    assert len(replies(bus, p.sync_read(7, 1, [1]))) == 1
    unknown = VirtualBus([VirtualServo("mx-64", 1, baud=1_000_000)])
    assert replies(unknown, p.sync_read(7, 1, [1], fast=True)) == []


def test_two_servos_with_one_id_garble_each_other():
    bus = VirtualBus([*servos(1), VirtualServo("xl430-w250", 1, baud=1_000_000)])
    assert replies(bus, p.ping(1)) == []
    assert bus.ledger.status_bytes > 0


def test_sync_write_reaches_a_group_by_its_shadow_id():
    bus = VirtualBus(servos(3, secondary_id=50))
    assert replies(bus, p.sync_write(LED, 1, {50: b"\1"})) == []
    assert [s.get("led") for s in bus.servos] == [1, 1, 1]


def test_unknown_servo_is_named():
    with pytest.raises(HardwareError, match=r"no servo with ID 9 on this bus; it has: 1, 2"):
        VirtualBus(servos(2))[9]


# Wire time.

NOTES = {  # servos: {bit rate: (sync, fast) in ms}, with two or three digits
    6: {57_600: (26.7, 20.8), 1_000_000: (1.54, 1.20), 2_000_000: (0.77, 0.60), 3_000_000: (0.51, 0.40)},
    12: {57_600: (48.6, 35.4), 1_000_000: (2.80, 2.04), 2_000_000: (1.40, 1.02), 4_000_000: (0.70, 0.51)},
    20: {57_600: (77.8, 54.9), 1_000_000: (4.48, 3.16), 3_000_000: (1.49, 1.05), 4_000_000: (1.12, 0.79)},
}


BARE = Timing()


def cycle(count: int, baud: int, *, fast: bool, delay: int = 0, timing: Timing = BARE) -> tuple[float, float]:
    """Ledger and clock [s] of one sync write and sync read of position by the SDK."""
    there = memory(VirtualBus(servos(count, baud=baud, return_delay_time=delay), timing=timing), baud)
    write, read = GroupSyncWrite(there.port, SDK, GOAL, 4), GroupSyncRead(there.port, SDK, PRESENT, 4)
    for i in range(1, count + 1):
        write.addParam(i, word_bytes(2048))
        read.addParam(i)
    start = there.bus.time
    assert write.txPacket() == COMM_SUCCESS
    assert (read.fastSyncRead() if fast else read.txRxPacket()) == COMM_SUCCESS
    return there.bus.ledger.total, there.bus.time - start


@pytest.mark.parametrize(("count", "baud"), [(n, b) for n, rates in NOTES.items() for b in rates])
def test_wire_time_is_the_notes(count, baud):
    for fast, told, size in zip(
        (False, True), NOTES[count][baud], (28 + 21 * count, 36 + 14 * count), strict=True
    ):
        ledger, clock = cycle(count, baud, fast=fast)
        assert ledger == pytest.approx(size * 10 / baud, rel=1e-9)
        assert clock == pytest.approx(ledger, rel=1e-9)
        assert ledger * 1e3 == pytest.approx(told, rel=0.01)


def test_return_delay_and_latency_timer_cost_what_they_cost():
    bare, _ = cycle(12, 1_000_000, fast=False)
    delayed, clock = cycle(12, 1_000_000, fast=False, delay=250)
    assert delayed - bare == pytest.approx(12 * 500e-6)
    assert clock == pytest.approx(delayed)
    slow, clock = cycle(6, 1_000_000, fast=True, timing=Timing(latency_timer=16e-3))
    assert 1 / clock == pytest.approx(60, rel=0.1)
    assert clock == pytest.approx(slow)
    turned, _ = cycle(12, 1_000_000, fast=False, timing=Timing(turnaround=10e-6, usb=125e-6))
    assert turned - bare == pytest.approx(12 * 10e-6 + 2 * 125e-6)


def test_full_usb_packets_do_not_wait_for_the_timer():
    """62 bytes and more leave at once: a read of 51 bytes (a frame of 62) is not held back, one of 50 is."""
    for size, waits in ((50, True), (51, False)):
        bus = VirtualBus(servos(1, return_delay_time=0), timing=Timing(latency_timer=16e-3))
        bus.send(p.read(1, 64, size).encode(), 1_000_000)
        arrival = bus.next_delivery - bus.time
        assert (arrival > 16e-3) == waits


def test_a_timeout_costs_virtual_time_only():
    there = memory(VirtualBus(servos(1)))
    start = time.perf_counter()
    assert SDK.read4ByteTxRx(there.port, 9, PRESENT)[1] == COMM_RX_TIMEOUT
    assert 0.034 < there.bus.time < 0.036
    assert time.perf_counter() - start < 0.03


# Faults.


def test_a_run_is_the_same_every_time():
    def run() -> list[object]:
        plan = FaultPlan(tuple(WireFault(k, 0.1) for k in ("lost", "late", "corrupted", "noise")), seed=7)
        there = memory(VirtualBus(servos(3), faults=plan))
        out: list[object] = [SDK.read4ByteTxRx(there.port, i % 3 + 1, PRESENT)[1:] for i in range(100)]
        return [*out, there.bus.time, there.bus.ledger, there.bus.dice.count]

    first = run()
    assert first == run()
    assert first[0] != (0, COMM_SUCCESS) and COMM_RX_TIMEOUT in [r[0] for r in first[:100]]


@pytest.mark.parametrize(
    ("kind", "direction", "outcome"),
    [
        ("lost", "instruction", COMM_RX_TIMEOUT),
        ("lost", "status", COMM_RX_TIMEOUT),
        ("late", "status", COMM_RX_TIMEOUT),
        ("corrupted", "instruction", None),
        ("corrupted", "status", None),
        ("truncated", "status", None),
        ("duplicated", "status", COMM_SUCCESS),
        ("noise", "status", COMM_SUCCESS),
        ("noise", "instruction", COMM_SUCCESS),
    ],
)
def test_wire_faults(lane, kind, direction, outcome):
    """A write is done or not, and the host learns it or not, as the fault says; afterwards all is well."""
    plan = FaultPlan((WireFault(kind, 1.0, direction, servo=1, stop=0.6, delay=0.35),), seed=3)
    there = lane(servos(2), faults=plan)
    result, _ = SDK.write1ByteTxRx(there.port, 1, LED, 1)
    if outcome is not None:
        assert result == outcome
    else:
        assert result in (COMM_RX_TIMEOUT, COMM_RX_CORRUPT)
    assert there.bus.dice.count[kind] >= 1
    done = direction == "status" or kind == "noise"
    assert there.bus[1].get("led") == (1 if done else 0)
    there.wait(max(0.0, 0.8 - there.bus.time))
    assert SDK.read1ByteTxRx(there.port, 1, LED) == (int(done), COMM_SUCCESS, 0)
    assert SDK.ping(there.port, 2)[1] == COMM_SUCCESS


def test_duplicated_packets_come_twice():
    bus = VirtualBus(servos(1), faults=FaultPlan((WireFault("duplicated", 1.0, "status"),)))
    assert [r.id for r in replies(bus, p.ping(1))] == [1, 1]
    bus = VirtualBus(servos(1), faults=FaultPlan((WireFault("duplicated", 1.0, "instruction"),)))
    assert [r.id for r in replies(bus, p.ping(1))] == [1, 1]
    assert bus.ledger.instructions == 2


def test_a_late_reply_answers_the_wrong_question():
    """The trap that a driver must guard against: the SDK takes a stale status for the present one."""
    plan = FaultPlan((WireFault("late", 1.0, "status", stop=0.001, delay=0.03414),))
    there = memory(VirtualBus(servos(1), faults=plan))
    assert SDK.read1ByteTxRx(there.port, 1, 7)[1] == COMM_RX_TIMEOUT
    value, result, _ = SDK.read1ByteTxRx(there.port, 1, LED)
    assert (value, result) == (1, COMM_SUCCESS)  # the ID, not the LED


def test_lost_packets_are_as_frequent_as_asked():
    there = memory(VirtualBus(servos(1), faults=FaultPlan((WireFault("lost", 0.05, "status"),), seed=1)))
    results = [SDK.read1ByteTxRx(there.port, 1, 7)[1] for _ in range(2000)]
    lost = results.count(COMM_RX_TIMEOUT)
    assert lost == there.bus.dice.count["lost"]
    assert lost == pytest.approx(100, abs=40)  # four standard deviations


@pytest.mark.parametrize(
    ("kind", "bit"),
    [
        ("overload", 0x20),
        ("overheating", 0x04),
        ("undervoltage", 0x01),
        ("electrical shock", 0x10),
        ("encoder", 8),
    ],
)
def test_hardware_errors_on_demand(lane, kind, bit):
    there = lane(servos(2), faults=FaultPlan(servos=(ServoFault(kind, 1, 0.25),)))
    torque_on(there, 1, 2)
    there.wait(0.3 - there.bus.time)
    value, _, error = SDK.read1ByteTxRx(there.port, 1, 70)
    assert (value, error) == (bit, 0x80)
    shut = bool(52 & bit)
    assert SDK.read1ByteTxRx(there.port, 1, TORQUE)[0] == (0 if shut else 1)
    assert SDK.read1ByteTxRx(there.port, 2, 70) == (0, COMM_SUCCESS, 0)


def test_a_servo_dies_and_comes_back(lane):
    there = lane(servos(2), faults=FaultPlan(servos=(ServoFault("dead", 1, 0.3, 0.9),)))
    torque_on(there, 1)
    there.wait(0.35 - there.bus.time)
    assert SDK.ping(there.port, 1)[1] == COMM_RX_TIMEOUT
    assert SDK.ping(there.port, 2)[1] == COMM_SUCCESS
    there.wait(max(0.0, 1.1 - there.bus.time))
    assert SDK.read1ByteTxRx(there.port, 1, TORQUE) == (0, COMM_SUCCESS, 0)


def test_watchdog_on_demand_and_by_silence(lane):
    there = lane(servos(2, bus_watchdog=0), faults=FaultPlan(servos=(ServoFault("watchdog", 1, 0.02),)))
    torque_on(there, 1, 2)
    assert SDK.write1ByteTxRx(there.port, 2, 98, 15) == (COMM_SUCCESS, 0)
    for _ in range(10):
        there.wait(0.05)
        assert SDK.read1ByteTxRx(there.port, 1, 98)[1] == COMM_SUCCESS  # any packet feeds every servo
    assert there.bus[1].get("bus_watchdog") == -1
    assert there.bus[2].get("bus_watchdog") == 15
    there.wait(0.35)
    assert there.bus[2].get("bus_watchdog") == -1


def test_a_pulled_cable_in_memory():
    there = memory(VirtualBus(servos(1), faults=FaultPlan(cable=(CablePull(0.1, 0.2),))))
    assert SDK.ping(there.port, 1)[1] == COMM_SUCCESS
    there.wait(0.1)
    with pytest.raises(BusError, match="cable"):
        SDK.ping(there.port, 1)
    there.port.is_using = False
    there.wait(0.1)
    assert SDK.ping(there.port, 1)[1] == COMM_SUCCESS


def test_a_pulled_cable_on_the_terminal(tmp_path):
    link = tmp_path / "ttyUSB"
    with serve(VirtualBus(servos(1)), link=link) as server:
        port = PortHandler(server.port)
        assert port.openPort() and SDK.ping(port, 1)[1] == COMM_SUCCESS
        server.unplug()
        with pytest.raises((SerialException, OSError)):
            SDK.ping(port, 1)
        assert not link.exists()
        port.closePort()
        server.plug()
        again = PortHandler(server.port)
        assert again.openPort() and SDK.ping(again, 1)[1] == COMM_SUCCESS
        again.closePort()
    assert not link.is_symlink()


def test_a_link_does_not_replace_a_file(tmp_path):
    (tmp_path / "notes").write_text("mine")
    with pytest.raises(BusError, match="is no link"):
        PtyServer(VirtualBus([]), link=tmp_path / "notes")
    assert (tmp_path / "notes").read_text() == "mine"


def test_a_server_in_a_process_of_its_own(tmp_path):
    link = tmp_path / "ttyUSB"
    program = f"""
        from pantograph.hardware.virtual import PtyServer, VirtualBus, VirtualServo
        PtyServer(VirtualBus([VirtualServo("xl330-m288", 4, baud=1_000_000)]), link={str(link)!r}).run()
    """
    process = subprocess.Popen([sys.executable, "-c", textwrap.dedent(program)])
    try:
        deadline = time.monotonic() + 20
        while not link.exists() and time.monotonic() < deadline:
            time.sleep(0.02)
        port = PortHandler(str(link))
        assert port.openPort()
        assert SDK.ping(port, 4)[0] == 1200
        port.closePort()
    finally:
        process.kill()
        process.wait()


@pytest.mark.parametrize("lenient", [True, False])
def test_half_a_frame_is_forgotten(lenient):
    """After a gap in time, or at once when the next frame begins."""
    for gap in (0.0, 0.01):
        bus = VirtualBus(servos(1), lenient=lenient)
        bus.send(p.write(1, LED, bytes(100)).encode()[:20], 1_000_000)
        bus.advance(gap)
        assert [r.id for r in replies(bus, p.ping(1))] == [1]


awkward = st.sampled_from([*b"\xff\xff\xfd\x00\x01\x02\xfe\x03\x82\x83\x92\x93\x8a\x9a\x07\x09"])


@settings(max_examples=150, deadline=None)
@given(st.lists(st.one_of(awkward, st.integers(0, 255)), max_size=60).map(bytes), st.booleans())
def test_no_bytes_break_a_bus(data, lenient):
    bus = VirtualBus(servos(2), lenient=lenient)
    bus.send(data, 1_000_000)
    bus.advance(0.01)
    assert [r.id for r in replies(bus, p.ping(2))][-1:] == [2]


instructions = [i for i in p.Instruction if i not in (p.Instruction.REBOOT, p.Instruction.FACTORY_RESET)]


@settings(max_examples=200, deadline=None)
@given(st.sampled_from([1, 2, 254]), st.sampled_from(instructions), st.binary(max_size=30))
def test_no_params_break_a_bus(servo, instruction, params):
    bus = VirtualBus(servos(2))
    bus.send(p.Packet(servo, instruction, params).encode(), 1_000_000)
    bus.advance(0.01)
    assert all(0 <= s.id <= 252 for s in bus.servos)
    bus.receive()
    there = {s.id for s in bus.servos if s.baud == 1_000_000}
    if len(there) == 2:
        assert {r.id for r in replies(bus, p.ping())} == there


def test_a_rate_that_no_constant_names():
    """4.5 Mbit/s is a custom rate for the terminal, known to the servos."""
    with (
        serve(VirtualBus(servos(1, baud=4_500_000))) as server,
        Serial(server.port, 4_500_000, timeout=1) as port,
    ):
        port.write(p.ping(1).encode())
        assert Packet.decode(port.read(14)).id == 1
        port.baudrate = 4_000_000
        port.timeout = 0.2
        port.write(p.ping(1).encode())
        assert port.read(14) == b""


def test_a_link_into_nowhere_is_refused(tmp_path):
    with pytest.raises(BusError, match="nowhere"):
        PtyServer(VirtualBus([]), link=tmp_path / "nowhere" / "tty")


def test_terminal_is_raw_for_programs_that_do_not_make_it_so():
    """A program that sets the rate alone gets its reply byte for byte, without waiting for a line to end."""
    with serve(VirtualBus([VirtualServo("xm430-w210", 13, firmware=10)])) as server:
        fd = os.open(server.port, os.O_RDWR | os.O_NOCTTY)
        try:
            state = termios.tcgetattr(fd)
            state[4] = state[5] = termios.B57600
            termios.tcsetattr(fd, termios.TCSANOW, state)
            os.write(fd, p.ping(13).encode())
            assert select.select([fd], [], [], 5)[0]
            assert Packet.decode(os.read(fd, 100)) == p.status(13, 0, b"\x06\x04\x0a")
        finally:
            os.close(fd)
