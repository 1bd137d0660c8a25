"""The driver over the official SDK: SI units, whole-rig transactions, partial answers, traps guarded."""

from __future__ import annotations

import os
import threading

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.hardware import service
from pantograph.hardware.driver import Driver, NoAnswer, Refused
from pantograph.hardware.errors import BusError, HardwareError, RegisterError
from pantograph.hardware.link import _sdk_stuffs
from pantograph.hardware.packets import Packet
from pantograph.hardware.ports import SerialPort, latency_of, open_port
from pantograph.hardware.virtual import (
    NO_FAULTS,
    CablePull,
    FaultPlan,
    ServoFault,
    Timing,
    VirtualBus,
    VirtualServo,
    WireFault,
    serve,
)
from pantograph.hardware.virtual.parser import Parser

BAUD = 1_000_000
POSITION = ["present_position"]


def make(count=4, *, model="xm430-w350", faults=NO_FAULTS, firmware=44, delay=0, strict=False, **more):
    """Driver of servos 1, 2, ... at distinct positions; firmware 44 has no fast reads."""
    servos = [
        VirtualServo(
            model,
            i,
            baud=BAUD,
            position=0.1 * i,
            firmware=firmware,
            registers={"return_delay_time": delay},
            **more,
        )
        for i in range(1, count + 1)
    ]
    bus = VirtualBus(servos, faults=faults, lenient=not strict)
    port, clock = open_port("virtual", BAUD, bus=bus)
    driver = Driver(port, clock)
    return driver, bus


def pinged(*args, **kwargs):
    driver, bus = make(*args, **kwargs)
    ids = [s.id for s in bus.servos]
    for id in ids:
        driver.ping(id)
        driver.return_delay[id] = driver.read(id, "return_delay_time")
    return driver, bus, ids


def heard(replies: dict) -> list[int]:
    return sorted(replies)


def test_reads_and_writes_in_si_with_signs() -> None:
    driver, bus, _ = pinged(2)
    assert abs(driver.read(1, "present_position") - 0.1) < 1e-3
    driver.write(2, "goal_position", -0.5)
    assert bus[2].get("goal_position") == 2048 - 326
    driver.write_raw(1, "operating_mode", 4)
    driver.write(1, "goal_position", -9.0)  # more than a turn below zero: negative counts
    assert driver.read_raw(1, "goal_position") == bus[1].get("goal_position") < 0
    with pytest.raises(RegisterError, match="goal_position"):
        driver.read(1, "goal_positon")


def test_refusals_say_which_servo_and_why() -> None:
    driver, _, _ = pinged(2)
    driver.write_raw(1, "torque_enable", 1)
    with pytest.raises(Refused, match=r"servo 1 refused 0 +for drive_mode: no access.*locked while torque"):
        driver.write_raw(1, "drive_mode", 0)
    with pytest.raises(Refused, match="servo 2 refused 7 rad for goal_position: the value is beyond a limit"):
        driver.write(2, "goal_position", 7.0)
    with pytest.raises(NoAnswer, match="servo 9 does not answer at 1,000,000"):
        driver.ping(9)
    with pytest.raises(HardwareError, match="ping it first"):
        driver.read(3, "present_position")


@pytest.mark.parametrize("firmware", [44, 45])
def test_whole_rig_in_one_transaction_each(firmware: int) -> None:
    driver, bus, ids = pinged(12, firmware=firmware)
    block = driver.block(ids, POSITION)
    bus.ledger.clear()
    driver.sync_write(ids, "goal_position", [2048 + i for i in ids])
    values = block.decode(driver.read_block(block))[:, 0]
    assert bus.ledger.instructions == 2
    assert np.allclose(values, 0.1 * np.array(ids), atol=1e-3)
    assert [s.get("goal_position") for s in bus.servos] == [2048 + i for i in ids]
    size = 28 + 21 * 12 if firmware < 45 else 36 + 14 * 12  # bytes of the notes
    assert np.isclose(bus.ledger.total, size * 10 / BAUD)
    assert np.isclose(driver.cycle_time(block), bus.ledger.total)


def test_scattered_registers_come_in_one_block() -> None:
    names = ("present_position", "present_current|present_load", "hardware_error_status", "goal_position")
    driver, bus, ids = pinged(3)
    block = driver.map_block(ids, names)
    bus[2].fail(0x20)
    bus.ledger.clear()
    values = block.decode(driver.read_block(block))
    assert bus.ledger.instructions == 1
    assert np.allclose(values[:, 0], 0.1 * np.array(ids), atol=1e-3)
    assert list(values[:, 2]) == [0, 0x20, 0] and driver.alerts == {1: False, 2: True, 3: False}


def test_models_with_other_indirect_addresses_share_a_bulk_read() -> None:
    servos = [
        VirtualServo("xl330-m288", 1, baud=BAUD, position=0.3),
        VirtualServo("xm430-w350", 2, baud=BAUD, position=-0.4),
    ]
    bus = VirtualBus(servos)
    port, clock = open_port("virtual", BAUD, bus=bus)
    driver = Driver(port, clock)
    for id in (1, 2):
        driver.ping(id)
    block = driver.map_block([1, 2], ["present_position", "goal_position"])
    assert not block.uniform
    bus.ledger.clear()
    assert np.allclose(block.decode(driver.read_block(block))[:, 0], [0.3, -0.4], atol=1e-3)
    assert bus.ledger.instructions == 1


@pytest.mark.parametrize("firmware", [44, 45])
@pytest.mark.parametrize("missing", [1, 3, 6])
def test_one_missing_servo_costs_only_itself(firmware: int, missing: int) -> None:
    """It silences those behind it in the chain; they are asked again, without it in front."""
    driver, bus, ids = pinged(6, firmware=firmware)
    bus[missing].dead = True
    block = driver.block(ids, POSITION)
    begin = bus.time
    replies = driver.read_block(block, retries=1)
    assert heard(replies) == [i for i in ids if i != missing]
    assert driver.statistics.missing[missing] == 1
    assert bus.time - begin < 0.02  # not the SDK's 35 ms for each
    assert np.isnan(block.decode(replies)[missing - 1, 0])


@pytest.mark.parametrize("kind", ["lost", "truncated", "corrupted", "noise", "duplicated", "late"])
@pytest.mark.parametrize("firmware", [44, 45])
def test_partial_answers_are_used_and_never_wrong(kind: str, firmware: int) -> None:
    plan = FaultPlan(wire=(WireFault(kind, 0.15, direction="status", start=0.05),), seed=3)
    driver, bus, ids = pinged(6, faults=plan, firmware=firmware)
    block = driver.block(ids, POSITION)
    bus.advance_to(0.05)
    whole = 0
    for _ in range(60):
        replies = driver.read_block(block, retries=2)
        values = block.decode(replies)[:, 0]
        there = ~np.isnan(values)
        assert np.allclose(values[there], 0.1 * np.array(ids)[there], atol=1e-3)
        whole += len(replies) == len(ids)
    assert whole > 45
    assert bus.dice.count[kind] > 3


def test_broken_fast_reply_gives_the_blocks_before_the_break() -> None:
    driver, bus, ids = pinged(6, firmware=45)
    bus[4].dead = True
    assert heard(driver.read_block(driver.block(ids, POSITION), retries=0)) == [1, 2, 3]


@settings(max_examples=60, deadline=None)
@given(
    st.lists(
        st.one_of(st.just(-131073), st.just(-164097), st.integers(-(2**31), 2**31 - 1)),
        min_size=1,
        max_size=4,
    )
)
def test_goals_that_look_like_headers_are_stuffed(goals: list[int]) -> None:
    """-131073 is FF FF FD FF: the SDK sends it as it is; strict servos would drop the packet."""
    driver, bus = make(len(goals), strict=True)
    ids = [s.id for s in bus.servos]
    sent: list[bytes] = []
    real = bus.send

    def spy(data: bytes, baud: int) -> None:
        sent.append(data)
        real(data, baud)

    bus.send = spy
    for id in ids:
        driver.ping(id)
    driver.sync_write(ids, "goal_position", goals)
    (packet,) = Parser().feed(sent[-1])
    assert isinstance(packet, Packet)
    expected = b"".join(
        bytes((i,)) + g.to_bytes(4, "little", signed=True) for i, g in zip(ids, goals, strict=True)
    )
    assert packet.params[4:] == expected


def test_the_sdk_is_asked_whether_it_stuffs() -> None:
    _sdk_stuffs.cache_clear()
    assert _sdk_stuffs() is False  # 4.1.0; a later one may do it, and then the driver must not


def test_short_replies_do_not_raise_index_errors() -> None:
    """A status without params answers a read of data, as a servo with an error does."""
    driver, bus, _ = pinged(1)
    bus[1].read = lambda address, length: (bus[1].memory.read(address, length)[0], b"")
    with pytest.raises(NoAnswer):
        driver.read(1, "present_position")
    assert driver.statistics.strays > 0


def test_index_errors_of_the_sdk_are_broken_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    driver, _, _ = pinged(1)
    real, failures = driver._handler.rxPacket, iter([True, False, False])

    def odd(port, fast):
        if next(failures):
            raise IndexError("list index out of range")
        return real(port, fast)

    monkeypatch.setattr(driver._handler, "rxPacket", odd)
    assert abs(driver.read(1, "present_position") - 0.1) < 1e-3


def test_a_port_that_raised_can_be_used_again() -> None:
    driver, bus, _ = pinged(1, faults=FaultPlan(cable=(CablePull(1.0, 2.0),)))
    bus.advance_to(1.5)
    with pytest.raises(BusError, match="cable was pulled"):
        driver.read(1, "present_position")
    bus.advance_to(2.5)
    assert abs(driver.read(1, "present_position") - 0.1) < 1e-3


def test_a_silent_write_is_confirmed_by_reading_back() -> None:
    driver, bus, _ = pinged(1)
    driver.write_raw(1, "status_return_level", 1)
    driver.write(1, "goal_position", 0.25)
    assert bus[1].get("goal_position") == 2048 + 163


def test_another_thread_is_refused() -> None:
    driver, _, _ = pinged(1)
    caught: list[Exception] = []

    def other() -> None:
        try:
            driver.read(1, "present_position")
        except BusError as e:
            caught.append(e)

    thread = threading.Thread(target=other)
    thread.start()
    thread.join()
    assert "another thread" in str(caught[0])


def test_scan_finds_servos_at_every_rate_and_restores_its_own() -> None:
    rates = {1: 57_600, 7: 57_600, 2: 1_000_000, 9: 4_000_000}
    bus = VirtualBus([VirtualServo("xm430-w350", i, baud=b) for i, b in rates.items()])
    port, clock = open_port("virtual", 115_200, bus=bus)
    driver = Driver(port, clock)
    seen: list[int] = []
    found = driver.scan(progress=seen.append)
    assert {f.id: f.baud for f in found} == rates
    assert all(f.model == "xm430-w350" for f in found) and len(seen) == 8
    assert port.getBaudRate() == 115_200


def test_ids_and_rates_change_only_when_safe() -> None:
    driver, bus, _ = pinged(2)
    with pytest.raises(HardwareError, match="ID 2 is taken"):
        service.set_id(driver, 1, 2)
    service.set_id(driver, 1, 7)
    assert {s.id for s in bus.servos} == {7, 2}
    driver.write_raw(2, "torque_enable", 1)
    with pytest.raises(HardwareError, match="holds torque"):
        service.set_baud(driver, 2, 57_600)
    with pytest.raises(HardwareError, match="has no bit rate 1_234"):
        service.set_baud(driver, 7, 1_234)
    service.set_baud(driver, 7, 57_600)
    assert bus[7].baud == 57_600 and driver.read(7, "present_position") is not None


def test_monitor_leaves_out_who_is_silent() -> None:
    driver, bus, ids = pinged(3)
    bus[1].fail(0x24)
    bus[3].dead = True
    states = service.look(driver, ids)
    assert sorted(states) == [1, 2]
    assert states[1].errors == "overheating and overload" and not states[2].errors
    assert abs(states[2].position - 0.2) < 1e-3 and states[2].voltage == 12.0


def test_latency_timer_is_waited_for() -> None:
    bus = VirtualBus([VirtualServo("xm430-w350", 1, baud=BAUD)], timing=Timing(latency_timer=0.016))
    port, clock = open_port("virtual", BAUD, bus=bus)
    assert Driver(port, clock, latency=0.016).ping(1).id == 1
    with pytest.raises(NoAnswer):
        Driver(port, clock, retries=0).ping(1)


def test_real_serial_port_on_a_pseudo_terminal() -> None:
    with serve(VirtualBus([VirtualServo("xl430-w250", 3, baud=BAUD, position=0.5)])) as server:
        assert latency_of(server.port).seconds == 0
        port, clock = open_port(server.port, BAUD)
        driver = Driver(port, clock, margin=0.05)
        assert driver.ping(3).model == "xl430-w250"
        assert abs(driver.read(3, "present_position") - 0.5) < 2e-3
        with pytest.raises(BusError, match="in use by another program"):
            open_port(server.port, BAUD)
        server.unplug()
        with pytest.raises(BusError):
            for _ in range(3):
                driver.read(3, "present_position")
        driver.close()
    with pytest.raises(BusError, match="cannot open port"):
        SerialPort("/dev/there-is-no-such-port").openPort()


def test_dead_servo_comes_back() -> None:
    driver, bus, _ = pinged(1, faults=FaultPlan(servos=(ServoFault("dead", 1, 0.2, 0.5),)))
    bus.advance_to(0.3)
    with pytest.raises(NoAnswer):
        driver.ping(1)
    bus.advance_to(0.9)
    assert driver.ping(1).id == 1


def test_every_call_on_a_device_that_has_gone_says_so() -> None:
    master, slave = os.openpty()
    port = SerialPort(os.ttyname(slave))
    port.openPort()
    os.close(slave)
    os.close(master)
    for call in (port.clearPort, lambda: port.readPort(4), lambda: port.writePort(b"x")):
        with pytest.raises(BusError, match=r"is gone .*is the cable in"):
            call()
    assert not port.setBaudRate(57_600)
    port.closePort()
