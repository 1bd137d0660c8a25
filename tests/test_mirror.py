"""Mirroring: the safety contract step by step, the schedule, the record, live runs, teleoperation."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from pantograph.hardware.connect import connect
from pantograph.hardware.limits import MotionRefused
from pantograph.hardware.mapping import make_mapping
from pantograph.hardware.mirror import RigFault, Session, mirror_live, mirror_recording
from pantograph.hardware.mirror.teleop import teleoperate
from pantograph.hardware.rig import RigError, load_rig, parse_rig
from pantograph.hardware.virtual import FaultPlan, VirtualBus, VirtualServo, WireFault
from pantograph.hardware.virtual_rig import virtual_bus
from pantograph.models.library import data_robots
from pantograph.sim.recording import load
from pantograph.sim.run import run
from pantograph.sim.scene.schema import Scene
from test_servo_faults import RIG, START, Watched, make_rig, play

needs_data = pytest.mark.skipif(
    "dynamixel_2r" not in data_robots(), reason="the data folder with wx250s and dynamixel_2r is not there"
)
MODEL = """<mujoco><option gravity="0 0 0"/><worldbody>
  <body><joint name="elbow" axis="0 1 0"/><geom size="0.02" pos="0 0 -.1" mass="0.1"/>
    <body pos="0 0 -.2"><joint name="wrist" axis="0 1 0"/><geom size="0.02" pos="0 0 -.1" mass="0.05"/></body>
  </body></worldbody></mujoco>"""


@pytest.fixture
def scene(tmp_path) -> Scene:
    """Both joints of the test rig, keyed, over two seconds."""
    path = tmp_path / "arm.xml"
    path.write_text(MODEL)
    keys = [
        {"joint": "elbow", "times": [0, 0.7, 1.5, 2], "values": [0.0, 0.6, -0.4, 0.1], "curve": "natural"},
        {"joint": "wrist", "times": [0, 1, 2], "values": [0.2, -0.5, 0.2], "curve": "natural"},
    ]
    return Scene(duration=2, models=[{"file": str(path)}], keys=keys)


def orders(bus: VirtualBus) -> list[tuple[str, int, int]]:
    """(register, servo, count) of every write that reached a servo, in order."""
    log: list[tuple[str, int, int]] = []
    for s in bus.servos:
        original = s.write

        def spy(address, data, *args, _s=s, _write=original, **more):
            row = _s.table.at(address)
            if row is not None and row.size == len(data):
                log.append((row.name, _s.id, int.from_bytes(data, "little", signed=row.signed)))
            return _write(address, data, *args, **more)

        s.write = spy
    return log


def session_of(rig, bus, **more) -> Session:
    driver, _ = connect(rig, bus=bus)
    return Session(rig, driver, **more)


def test_the_contract_is_kept_in_order() -> None:
    rig, bus, _ = make_rig()
    log = orders(bus)
    session = session_of(rig, bus)
    at = session.mapping.servo(START)
    outcome = session.run(at, lambda t: at, 0.2)
    assert outcome.status == "done" and [p for p, _ in outcome.phases] == [
        "scan", "prepare", "torque on", "ramp", "stream", "stop"
    ]  # fmt: skip
    first = {(name, id): k for k, (name, id, _) in reversed(list(enumerate(log)))}
    torque = [k for k, (name, _, value) in enumerate(log) if name == "torque_enable" and value]
    assert [log[k][1] for k in torque] == [1, 2, 3]
    for s in bus.servos:
        for name in ("profile_velocity", "goal_position"):
            assert first[name, s.id] < torque[0], f"{name} comes before any torque"
        armed = [k for k, (name, id, v) in enumerate(log) if name == "bus_watchdog" and id == s.id and v > 0]
        assert armed and armed[0] < torque[0]
        assert s.get("profile_velocity") > 0  # 0 would mean no limit
    assert log[first["goal_position", 1]][2] == round(at[0] / (2 * np.pi / 4096)) + 2048


def test_goals_are_streamed_on_an_absolute_schedule() -> None:
    outcome, *_ = play()
    log = outcome.log
    stream = [i for i, p in enumerate(log.phase) if p == "stream"]
    due = np.array(log.due)[stream]
    assert np.allclose(np.diff(due), 0.02, atol=1e-9) and log.skipped == 0
    assert np.allclose(np.array(log.begun)[stream], due, atol=1e-4)


def test_late_cycles_are_skipped_not_made_up_for() -> None:
    """Stall the host for 75 ms: the goals that follow are those of their own time."""
    rig, bus, _ = make_rig()
    session = session_of(rig, bus)
    at = session.mapping.servo(START)
    asked: list[float] = []

    def target(t: float) -> np.ndarray:
        asked.append(t)
        if len(asked) == 10:
            bus.advance(0.075)
        return at

    outcome = session.run(at, target, 1.0)
    assert outcome.status == "done" and outcome.log.skipped == 3
    assert np.allclose(np.array(asked) / 0.02, np.rint(np.array(asked) / 0.02), atol=1e-9)
    assert len(asked) == 51 - 3


def test_a_wild_target_cannot_move_faster_than_the_limits() -> None:
    rig, bus, plants = make_rig()
    session = session_of(rig, bus)
    low, high = (session.mapping.servo(np.array([x, x])) for x in (-1.0, 1.0))
    outcome = session.run(session.mapping.servo(START), lambda t: low if int(t * 10) % 2 else high, 1.0)
    assert outcome.log.clamped > 10
    for plant, limit in zip(plants, session.bounds.velocity, strict=True):
        assert np.abs(np.diff(plant.path)).max() < 1.4 * limit * 1e-3


def test_targets_beyond_soft_limits_and_nonsense_are_kept_off_the_wire() -> None:
    rig, bus, plants = make_rig()
    session = session_of(rig, bus)
    at = session.mapping.servo(START)
    far = session.mapping.servo(START + np.array([50.0, 0.0]))
    outcome = session.run(at, lambda t: far, 3.0)
    assert outcome.status == "done" and outcome.log.clamped > 0
    assert (np.array(outcome.log.goal) <= session.bounds.high + 1e-12).all()
    assert session.bounds.high[0] == 1.5  # the joint's soft limit, not the servo's
    assert max(p.path[-1] for p in plants[:2]) < 1.52
    rig, bus, _ = make_rig()
    session = session_of(rig, bus)
    outcome = session.run(at, lambda t: np.full(3, np.nan), 1.0)
    assert outcome.status == "fault" and "not a number" in outcome.message


@pytest.mark.parametrize("where", ["ramp", "stream"])
@pytest.mark.parametrize("stop", ["hold", "park", "limp"])
def test_ctrl_c_stops_as_promised(where: str, stop: str) -> None:
    rig, bus, plants = make_rig()

    def on_phase(phase: str) -> None:
        if phase == where == "ramp":
            raise KeyboardInterrupt

    session = session_of(rig, bus, stop=stop, on_phase=on_phase)
    at = session.mapping.servo(START)

    def target(t: float) -> np.ndarray:
        if t > 0.3:
            raise KeyboardInterrupt
        return at + 0.3 * np.sin(t)

    outcome = session.run(at, target, 2.0)
    assert outcome.status == "interrupted" and outcome.phase == where
    bus.advance(1.0)
    assert [s.get("torque_enable") for s in bus.servos] == [int(stop == "hold")] * 3
    if stop == "park":
        pose = session.mapping.joint(np.array([p.path[-1] for p in plants]))
        assert np.allclose(pose, [-0.2, 0.1], atol=0.03)


def test_a_hold_stops_where_the_servos_are_not_where_they_were_going() -> None:
    rig, bus, plants = make_rig()
    session = session_of(rig, bus)
    at = session.mapping.servo(START)

    def target(t: float) -> np.ndarray:
        if t > 0.4:
            raise KeyboardInterrupt
        return at + session.mapping.matrix @ np.array([2.0, 0.0]) * t

    outcome = session.run(at, target, 1.0)
    behind = abs(outcome.log.goal[-1][0] - plants[0].path[-1])
    assert behind > 0.06  # what it had yet to go
    stopped = plants[0].path[-1]
    bus.advance(1.0)
    assert abs(plants[0].path[-1] - stopped) < 0.4 * behind


def test_an_exception_of_the_caller_stops_the_rig_and_goes_on() -> None:
    rig, bus, _ = make_rig()
    session = session_of(rig, bus, stop="limp")
    at = session.mapping.servo(START)

    def target(t: float) -> np.ndarray:
        if t > 0.1:
            raise ZeroDivisionError("somebody's bug")
        return at

    with pytest.raises(ZeroDivisionError):
        session.run(at, target, 1.0)
    assert not any(s.get("torque_enable") for s in bus.servos)


def test_every_mismatch_with_the_rig_is_told_at_once() -> None:
    rig = parse_rig(RIG)
    servos = [
        VirtualServo("xm430-w210", 1, baud=rig.baud),
        VirtualServo("xm430-w350", 2, baud=rig.baud, supply=9.0, ambient=78.0),
    ]
    servos[1].memory.put("torque_enable", 1)
    servos[1].memory.put("min_position_limit", 2048 - 652)
    outcome = session_of(rig, VirtualBus(servos)).run(np.zeros(3), lambda t: None, 1.0)
    assert outcome.status == "fault" and outcome.phase == "scan"
    for words in (
        "servo 1 'left' (joint elbow) is xm430-w210, the rig file says xm430-w350",
        "servo 2 'right' (joint elbow) has its torque on already",
        "servo 2 'right' (joint elbow) has 9.0 V",
        "servo 2 'right' (joint elbow) has 78 degC",
        "servo 2 'right' (joint elbow) has position limits of -1.000 to 3.140 rad",
        "servo 3 'tip' (joint wrist) does not answer",
    ):
        assert words in outcome.message


def test_servos_that_would_fight_are_refused() -> None:
    rig, bus, _ = make_rig()
    bus[2].drive.plant.position = bus[2].drive.plant.gear = 0.5
    bus.advance(0.01)
    outcome = session_of(rig, bus).run(np.zeros(3), lambda t: None, 1.0)
    assert outcome.status == "fault" and "would fight" in outcome.message
    assert not any(s.get("torque_enable") for s in bus.servos)


def test_taking_over_a_rig_that_holds_does_not_move_it() -> None:
    rig, bus, plants = make_rig()
    session = session_of(rig, bus)
    at = session.mapping.servo(START)
    assert session.run(at, lambda t: at, 0.1).status == "done"
    again = session_of(rig, bus)
    assert "torque on already" in again.run(at, lambda t: at, 0.1).message
    before = [len(p.path) for p in plants]
    over = session_of(rig, bus, take_over=True)
    assert over.run(lambda present: present, lambda t: over.goal, 0.1).status == "done"
    assert all(np.ptp(p.path[k:]) < 5e-3 for p, k in zip(plants, before, strict=True))


def test_a_rate_that_the_wire_cannot_carry_is_refused_with_one_that_it_can() -> None:
    text = RIG.replace('name = "test rig"', 'name = "slow"\nbaud = 57_600')
    rig = parse_rig(text)
    with pytest.raises(RigError, match=r"50 Hz does not fit the bus.* lower the rate to \d+ Hz"):
        session_of(rig, virtual_bus(rig)).run(np.zeros(3), lambda t: None, 1.0)


@pytest.mark.parametrize("seed", range(3))
def test_losses_are_counted_and_goals_stay_young(seed: int) -> None:
    """One packet in twenty lost: the motion goes on, nothing jumps, and each loss that shows is counted."""
    plan = FaultPlan(wire=(WireFault("lost", 0.05, start=0.3),), seed=seed)
    outcome, bus, plants, session, *_ = play(plan, firmware=44)
    assert outcome.status == "done"
    assert outcome.log.oldest_goal < 5
    seen = session.driver.statistics
    assert seen.timeouts + outcome.log.lost_goals >= 0.5 * bus.dice.count["lost"] > 0
    assert all(np.abs(np.diff(p.path)).max() < 3.9e-3 for p in plants)


def test_recording_of_the_rig_is_a_recording_like_any_other(scene: Scene, tmp_path) -> None:
    recording = run(scene)
    report = mirror_recording(recording, parse_rig(RIG))
    assert report.status == "done" and report.recording is not None
    mine = load(report.recording.save(tmp_path / "rig.npz"))
    assert np.array_equal(mine.q, report.recording.q) and mine.model.nq == 2
    assert mine.q.shape == (101, 2) and np.isclose(mine.t[-1], 2.0, atol=1e-3)
    for j, track in enumerate(report.tracking):
        assert track.rms_aligned < 0.012 < track.worst < 0.2
        assert 0.0 < track.delay < 0.12  # the lag of a P controller behind its goal
        late = np.interp(mine.t - track.delay, recording.t, recording.q[:, j])
        assert np.abs(mine.q[20:, j] - late[20:]).max() < 0.03
    assert np.abs(mine.v - np.gradient(mine.q, mine.t, axis=0)).max() < 0.5
    assert "delay" in str(report) and report.timing is not None and report.timing.cycles == 101
    timing = dataclasses.replace(report.timing, histogram=((50.0, 7), (75.0, 0), (np.inf, 2)))
    assert "cycles by rate: up to 50 Hz 7, above 75 Hz 2\n" in str(dataclasses.replace(report, timing=timing))


def test_delay_and_rms_of_a_known_lag() -> None:
    from pantograph.hardware.mirror.record import _track

    t = np.arange(0, 8, 0.02)
    track = _track("j", t, np.sin(2 * t), np.sin(2 * (t - 0.083)))
    assert abs(track.delay - 0.083) < 1e-3 and track.rms_aligned < 1e-3 < track.rms


def test_too_fast_motion_is_refused_or_slowed(scene: Scene) -> None:
    rig = parse_rig(RIG.replace("velocity = 3.0", "velocity = 0.5"))
    recording = run(scene)
    with pytest.raises(MotionRefused, match="speed of joint elbow") as e:
        mirror_recording(recording, rig)
    report = mirror_recording(recording, rig, slow=True)
    assert report.status == "done"
    assert np.isclose(report.slowed, e.value.verdict.slowdown)
    assert np.isclose(report.t[-1], 2.0 * report.slowed, atol=0.05)
    speed = np.abs(np.gradient(report.commanded[:, 0], report.t))
    assert 0.45 < speed.max() <= 0.5 * 1.02


def test_rig_that_does_not_fit_the_model_is_refused(scene: Scene) -> None:
    rig = parse_rig(RIG.replace('joint = "wrist"', 'joint = "rist"'))
    with pytest.raises(RigError, match="no joint 'rist'"):
        mirror_recording(run(scene), rig)


def test_live_run_gives_the_same_goals_as_the_recording(scene: Scene) -> None:
    recorded = mirror_recording(run(scene), parse_rig(RIG))
    live = mirror_live(scene, parse_rig(RIG))
    assert live.status == "done" and len(live.t) == len(recorded.t)
    assert np.allclose(live.commanded, recorded.commanded, atol=2e-3)
    assert live.recording is not None


def test_live_physics_is_the_run_itself(tmp_path) -> None:
    """A free pendulum, simulated in windows, ends where one run ends."""
    path = tmp_path / "arm.xml"
    path.write_text(MODEL.replace("0 0 0", "0 0 -9.81", 1))
    initial = {"position": {"elbow": 0.5, "wrist": -0.3}}
    scene = Scene(duration=1.0, models=[{"file": str(path)}], initial=initial)
    rig = parse_rig(RIG.replace("velocity = 3.0", "velocity = 4.5"))
    report = mirror_live(scene, rig)
    whole = run(scene)
    assert report.status == "done"
    end = np.array([np.interp(report.t[-1], whole.t, whole.q[:, j]) for j in range(2)])
    assert np.allclose(report.commanded[-1], end, atol=0.01)


def test_live_simulation_that_fails_stops_the_rig(tmp_path) -> None:
    path = tmp_path / "arm.xml"
    path.write_text(MODEL.replace('name="elbow"', 'name="elbow" stiffness="-1e7"'))
    scene = Scene(duration=1.0, models=[{"file": str(path)}], initial={"position": {"elbow": 0.1}})
    rig = parse_rig(RIG)
    bus = virtual_bus(rig)
    with pytest.raises(Exception, match="simulation"):
        mirror_live(scene, rig, bus=bus, stop="limp")
    assert not any(s.get("torque_enable") for s in bus.servos)


def test_virtual_rig_that_carries_its_robot_sags_as_its_gain_says() -> None:
    """At rest the torque of two servos, kt P e V / R each with error e, is that of gravity, m g l sin(q)."""
    mass, rod = 0.4, 0.2
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><joint name="elbow" axis="0 1 0" damping="0.02" armature="0.01"/>
        <inertial pos="0 0 {-rod}" mass="{mass}" diaginertia="1e-6 1e-6 1e-6"/>
        <body pos="0 0 {-rod}"><joint name="wrist" axis="0 1 0" armature="0.01" damping="0.02"/>
        <inertial pos="0 0 0" mass="1e-6" diaginertia="1e-9 1e-9 1e-9"/></body></body></worldbody></mujoco>"""
    )
    rig = parse_rig(RIG)
    bus = virtual_bus(rig, model=model, pose=np.array([0.1, 0.0]))
    session = session_of(rig, bus)
    goal = session.mapping.servo(np.array([1.2, 0.0]))
    outcome = session.run(goal, lambda t: goal, 1.0)
    assert outcome.status == "done"
    bus.advance(2.0)
    servo = bus[1]
    q = servo.drive.position
    drive = servo.drive
    p = drive.settings.position_gains[0]
    torque = drive.motor.kt * p * (goal[0] - q) * drive.voltage / drive.motor.resistance
    assert abs(drive.velocity) < 1e-3
    assert np.isclose(2 * torque, mass * 9.81 * rod * np.sin(q), rtol=0.03)
    assert 0.005 < goal[0] - q < 0.2


def leader_bus(rig, motion) -> VirtualBus:
    """A limp rig whose joints a person moves as `motion(t)`."""

    class Hand(Watched):
        def __init__(self, model: str, index: int) -> None:
            super().__init__(model, 0.0)
            self.index, self.time = index, 0.0

        def step(self, dt: float, torque: float) -> tuple[float, float]:
            self.time += dt
            s = make_mapping(rig).servo(motion(self.time))
            self.position = float(s[self.index])
            return self.position, 0.0

    servos = [
        VirtualServo(item.model, item.id, baud=rig.baud, plant=Hand(item.model, i))
        for i, item in enumerate(rig.servos)
    ]
    return VirtualBus(servos)


def test_leader_moves_follower() -> None:
    rig = parse_rig(RIG)

    def hand(t: float) -> np.ndarray:
        return np.array([0.4 * np.sin(t), 0.3 * np.cos(t)])

    follower = virtual_bus(rig)
    report = teleoperate(rig, rig, duration=2.0, leader_bus=leader_bus(rig, hand), follower_bus=follower)
    assert report.status == "done" and report.follower is not None
    assert len(report.t) == len(report.follower.t)
    assert np.abs(report.follower.measured - report.q)[20:].max() < 0.06
    assert np.abs(report.follower.commanded - report.q)[20:].max() < 5e-3


def test_leader_alone_and_leader_that_holds() -> None:
    rig = parse_rig(RIG)
    bus = leader_bus(rig, lambda t: np.array([0.2 * t, 0.1]))
    report = teleoperate(rig, duration=1.0, leader_bus=bus)
    assert report.follower is None and np.allclose(np.diff(report.q[:, 0]), 0.2 / rig.rate, atol=4e-3)
    bus.servos[0].memory.put("torque_enable", 1)
    with pytest.raises(RigFault, match="torque on already"):
        teleoperate(rig, duration=1.0, leader_bus=bus)


@needs_data
@pytest.mark.parametrize(
    ("name", "keys"),
    [
        ("dynamixel_2r", {"R1": [0.4, -0.3], "R2": [0.0, 0.8]}),
        ("wx250s", {"waist": [0.0, 0.6], "shoulder": [-0.9, -0.6], "left_finger": [0.02, 0.03]}),
    ],
)  # fmt: skip
def test_real_robots_mirror_to_virtual_rigs(name: str, keys: dict[str, list[float]]) -> None:
    items = [
        {"joint": j, "times": [0, 1, 2], "values": [a, b, a], "curve": "natural"}
        for j, (a, b) in keys.items()
    ]
    if name == "wx250s":
        items.append({"joint": "right_finger", "times": [0, 1, 2], "values": [-0.02, -0.03, -0.02]})
        rest = ("elbow", "forearm_roll", "wrist_angle", "wrist_rotate")
        items += [{"joint": j, "times": [0], "values": [0.0]} for j in rest]
    scene = Scene(duration=2, models=[{"file": name}], keys=items, physics={"contacts": "none"})
    report = mirror_recording(run(scene), load_rig(name), slow=True, stop="park")
    assert report.status == "done" and report.stop == "parked, then limp"
    assert all(t.rms_aligned < 0.02 for t in report.tracking)
    q = report.recording.q
    if name == "wx250s":
        assert np.allclose(q[:, -1], -q[:, -2])  # the other finger follows
    rig = load_rig(name)
    heavy = mirror_recording(run(scene), rig, slow=True, bus=virtual_bus(rig, model=rig.load_model()))
    assert heavy.status == "done"
    worst = max(t.rms_aligned for t in heavy.tracking)
    assert max(t.rms_aligned for t in report.tracking) < worst < 0.12  # it sags under its own weight


@pytest.mark.parametrize("follows", [False, True])
@pytest.mark.parametrize("fault", ["cable", "servo"])
def test_leader_that_falls_silent_ends_it_and_keeps_what_was_read(follows: bool, fault: str) -> None:
    rig = parse_rig(RIG)
    lead, follower = leader_bus(rig, lambda t: np.array([0.2 * t, 0.1])), virtual_bus(rig)

    def each(t: float, q: np.ndarray) -> None:
        if t > 0.5 and fault == "servo":
            lead[2].dead = True
        if t > 0.5 and fault == "cable":
            lead.dice.apply = lambda *_: []

    more = {"follower": rig, "follower_bus": follower, "stop": "park"} if follows else {}
    report = teleoperate(rig, duration=5.0, leader_bus=lead, each=each, **more)
    assert report.status == "fault" and "leader: " in report.message
    assert 0.5 < report.t[-1] < 1.0
    if follows:
        assert report.follower.stop == "parked, then limp"  # the follower is sound
        assert not any(s.get("torque_enable") for s in follower.servos)
