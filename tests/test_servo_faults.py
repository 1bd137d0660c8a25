"""Every fault in every phase: nothing moves uncommanded, the promised stop, a message with names."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from pantograph.hardware.connect import connect
from pantograph.hardware.mapping import make_mapping
from pantograph.hardware.mirror import Session
from pantograph.hardware.rig import parse_rig
from pantograph.hardware.virtual import (
    MOTORS,
    NO_FAULTS,
    CablePull,
    FaultPlan,
    Gear,
    ServoFault,
    VirtualBus,
    VirtualServo,
    WireFault,
)

RIG = """
name = "test rig"
rate = 50.0
watchdog = 0.1
ramp_velocity = 1.0
servos = [
    { name = "left", id = 1, model = "xm430-w350" },
    { name = "right", id = 2, model = "xm430-w350" },
    { name = "tip", id = 3, model = "xl430-w250" },
]
[[joints]]
joint = "elbow"
servos = [{ servo = "left" }, { servo = "right", direction = -1 }]
range = [-1.5, 1.5]
velocity = 3.0
park = -0.2
[[joints]]
joint = "wrist"
servo = "tip"
park = 0.1
"""
START = np.array([0.3, -0.2])  # where the rig stands: joints
PHASES = ("scan", "torque on", "ramp", "stream", "stop")
VICTIM, VICTIM_LABEL = 2, "servo 2 'right' (joint elbow)"
DURATION = 0.8
SPEED_CAP = 3.0  # rad/s: no servo may be faster, in whatever goes wrong


class Watched(Gear):
    """A gear that remembers where it was."""

    def __init__(self, model: str, position: float) -> None:
        super().__init__(MOTORS[model].inertia, MOTORS[model].coulomb, position=position)
        self.path = [position]

    def step(self, dt: float, torque: float) -> tuple[float, float]:
        out = super().step(dt, torque)
        if dt:
            self.path.append(out[0])
        return out


def make_rig(faults: FaultPlan = NO_FAULTS, firmware: int | None = None):
    rig = parse_rig(RIG)
    s = make_mapping(rig).servo(START)
    plants = [Watched(item.model, float(x)) for item, x in zip(rig.servos, s, strict=True)]
    servos = [
        VirtualServo(item.model, item.id, baud=rig.baud, plant=p, firmware=firmware)
        for item, p in zip(rig.servos, plants, strict=True)
    ]
    for s in servos:  # a goal left over from yesterday: torque on alone would jump to it
        s.write(s.table["goal_position"].address, (1024).to_bytes(4, "little"))
    return rig, VirtualBus(servos, faults=faults), plants


def target(t: float) -> np.ndarray:
    """Joint values of the streamed motion."""
    return START + np.array([0.4, -0.3]) * np.sin(2 * t)


def play(faults: FaultPlan = NO_FAULTS, stop: str = "hold", firmware: int | None = None):
    rig, bus, plants = make_rig(faults, firmware)
    driver, _ = connect(rig, bus=bus)
    session = Session(rig, driver, stop=stop)
    first = session.mapping.servo(START + 0.2)
    begin = target(0.0)

    def servo_target(t: float) -> np.ndarray:
        return session.mapping.servo(target(t) - begin + START + 0.2)

    outcome = session.run(first, servo_target, DURATION)
    end = bus.time
    bus.advance(0.5)
    settled = [len(p.path) for p in plants]
    bus.advance(1.0)
    return outcome, bus, plants, session, end, settled


@cache
def clean(stop: str, firmware: int | None):
    return play(stop=stop, firmware=firmware)


def moment(phase: str, stop: str, firmware: int | None) -> float:
    """A time in the middle of a phase of a run without faults; the stop as it begins."""
    outcome, _, _, _, end, _ = clean(stop, firmware)
    begins = [t for _, t in outcome.phases] + [end]
    i = [p for p, _ in outcome.phases].index(phase)
    if phase == "stop":
        return begins[i] + 1e-6
    return 0.5 * (begins[i] + begins[i + 1])


def wire(kind: str):
    return lambda t: FaultPlan(wire=(WireFault(kind, servo=VICTIM, direction="status", start=t, delay=0.03),))


def servo(kind: str):
    return lambda t: FaultPlan(servos=(ServoFault(kind, VICTIM, t),))


WIRE = ("lost", "late", "truncated", "corrupted", "duplicated", "noise")
FAULTS = {
    **{k: wire(k) for k in WIRE},
    "dead servo": servo("dead"),
    **{k: servo(k) for k in ("overload", "overheating", "undervoltage", "electrical shock", "watchdog")},
    "cable pulled": lambda t: FaultPlan(cable=(CablePull(t),)),
}
HARMLESS = {"duplicated", "noise"}  # the bus gets over them
CASES = [(f, p, "hold") for f in FAULTS for p in PHASES]
CASES += [
    (f, p, s)
    for f in ("lost", "dead servo", "overload", "cable pulled")
    for p in PHASES[2:]
    for s in ("park", "limp")
]
TABLE: dict[tuple[str, str, str], str] = {}


def assert_no_uncommanded_motion(outcome, bus, plants, session, end, settled) -> None:
    """Shafts stay between start and goals, within the speed cap, and stand in the end."""
    goals = np.array([session.mapping.servo(START), *outcome.log.goal])
    for i, plant in enumerate(plants):
        path = np.array(plant.path)
        low, high = goals[:, i].min() - 0.02, goals[:, i].max() + 0.02
        assert path.min() > low and path.max() < high, f"servo {i + 1} left the commanded range"
        assert np.max(np.abs(np.diff(path))) < SPEED_CAP * 1.3e-3, f"servo {i + 1} jumped"
        assert np.ptp(path[settled[i] :]) < 2e-3, f"servo {i + 1} still moves after the stop"
    ramp = [t for p, t in outcome.phases if p == "ramp"]
    if not ramp:
        for i, plant in enumerate(plants):
            assert np.ptp(plant.path) < 4e-3, f"servo {i + 1} moved before the ramp"


def assert_promised_stop(outcome, bus, fault: str, phase: str, stop: str) -> None:
    """Everybody who could be reached did what was promised; who could not was stopped by the watchdog."""
    began = any(p == "ramp" for p, _ in outcome.phases)
    for s in bus.servos:
        if not any(p == "torque on" for p, _ in outcome.phases):
            assert not s.get("torque_enable")
            continue
        reachable = fault != "cable pulled" and not (s.id == VICTIM and s.dead)
        deaf = s.id == VICTIM and fault in ("lost", "late", "truncated", "corrupted")
        if not reachable:
            assert s.dead or s.get("bus_watchdog") == -1 or not s.get("torque_enable") or not began
        elif not began or stop == "limp" or (stop == "park" and outcome.status == "done"):
            assert not s.get("torque_enable"), f"servo {s.id} should be limp"
        elif s.id != VICTIM or fault in HARMLESS:
            assert s.get("torque_enable") and s.get("bus_watchdog") == 0, f"servo {s.id} should hold"
        elif not deaf:  # a servo in error: without torque, or held
            assert not s.get("torque_enable") or s.get("bus_watchdog") in (0, -1)


@pytest.mark.parametrize(("fault", "phase", "stop"), CASES)
def test_fault_matrix(fault: str, phase: str, stop: str) -> None:
    # A firmware without fast sync reads: every servo answers in a packet of its own, which the fault can hit.
    firmware = 44 if fault in WIRE else None
    plan = FAULTS[fault](moment(phase, stop, firmware))
    outcome, bus, plants, session, end, settled = play(plan, stop, firmware)
    assert_no_uncommanded_motion(outcome, bus, plants, session, end, settled)
    assert_promised_stop(outcome, bus, fault, phase, stop)
    told = " ".join([outcome.message, *outcome.unconfirmed])
    TABLE[fault, phase, stop] = f"{outcome.status:<12}{outcome.phase:<10} {outcome.stop[:22]:<24}{told[:80]}"
    # A watchdog that tripped before the start is cleared then; one that trips between the stop's look and its
    # word to disarm is cleared by that word, and the servo holds as the others do.
    cleared = fault == "watchdog" and (phase == "scan" or (phase == "stop" and outcome.status == "done"))
    if fault in HARMLESS or cleared:
        assert outcome.status == "done", told
        return
    assert outcome.status == "fault"
    assert VICTIM_LABEL in told
    if phase in ("ramp", "stream"):
        assert outcome.phase == phase
        assert "stop" not in outcome.log.phase  # a rig with a faulty servo does not go and park
        began = dict(outcome.phases)["stop"]
        assert began - moment(phase, stop, firmware) < 7 * 0.02


def test_print_fault_matrix(capsys: pytest.CaptureFixture[str]) -> None:
    """The matrix as a table for people (pytest -s -k matrix)."""
    with capsys.disabled():
        print()
        for (fault, phase, stop), row in TABLE.items():
            print(f"{fault:<17}{phase:<11}{stop:<5}| {row.splitlines()[0]}")
    assert set(TABLE) <= set(CASES)


@pytest.mark.parametrize("stop", ["hold", "limp"])
def test_a_pulled_cable_is_told_once_for_all_with_what_becomes_of_the_torque(stop: str) -> None:
    outcome, bus, *_ = play(FaultPlan(cable=(CablePull(moment("stream", stop, None)),)), stop)
    (told,) = outcome.unconfirmed
    assert all(f"servo {s.id} " in told for s in bus.servos)
    assert "its watchdog stops it in 0.1 s, its torque may stay on" in told
    assert [s.get("torque_enable") for s in bus.servos] == [1, 1, 1]
    assert outcome.stop == "left to the watchdogs: no servo confirmed anything"


@pytest.mark.parametrize("stop", ["hold", "limp"])
def test_a_servo_in_error_is_told_with_its_torque(stop: str) -> None:
    """Overheating takes its torque; the others do as promised."""
    plan = FaultPlan(servos=(ServoFault("overheating", VICTIM, moment("stream", stop, None)),))
    outcome, bus, *_ = play(plan, stop)
    assert outcome.unconfirmed == [
        f"{VICTIM_LABEL}: reports a hardware error: overheating; its torque is off"
    ]
    assert f"but {VICTIM_LABEL}" in outcome.stop
    others = int(stop == "hold")
    assert [s.get("torque_enable") for s in bus.servos] == [others, 0, others]
