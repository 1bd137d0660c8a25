"""Rig files, the mapping of joints to servos, and the verdict on a whole motion."""

from __future__ import annotations

import re
import tomllib

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pantograph.hardware.limits import MotionRefused, check_motion, fit
from pantograph.hardware.mapping import (
    Bounds,
    JointBounds,
    Mapping,
    SliderCrank,
    Table,
    joint_bounds,
    make_bounds,
    make_mapping,
    park_pose,
    within_joints,
)
from pantograph.hardware.motion import Loads, Motion, loads_of, motion_of
from pantograph.hardware.rig import Rig, RigError, check_model, load_rig, parse_rig
from pantograph.hardware.rig_checks import contradictions
from pantograph.models.library import data_robots
from pantograph.sim.run import run
from pantograph.sim.scene.schema import Scene
from pydantic import ValidationError

needs_data = pytest.mark.skipif(
    "wx250s" not in data_robots(), reason="the data folder with wx250s and dynamixel_2r is not there"
)

EVERYTHING = """
name = "all kinds"
angle = "degree"
servos = [
    { name = "a", id = 1, model = "xm430-w350", velocity = 90.0 },
    { name = "a2", id = 2, model = "xm430-w350" },
    { name = "left", id = 3, model = "xl430-w250" },
    { name = "right", id = 4, model = "xl430-w250" },
    { name = "claw", id = 5, model = "xl330-m288", range = [-100, 100] },
    { name = "odd", id = 6, model = "mx-28" },
]
[[joints]]
joint = "lift"
servos = [{ servo = "a", ratio = 2.0, zero = 10 }, { servo = "a2", direction = -1, ratio = 2.0, zero = -5 }]
park = 30.0
[[joints]]
joint = "pitch"
range = [-60, 60]
[[joints]]
joint = "roll"
[[joints]]
joint = "finger"
servo = "claw"
direction = -1
crank = { radius = 0.014, rod = 0.024 }
range = [0.015, 0.037]
[[joints]]
joint = "hatch"
servo = "odd"
points = [[0.0, -30.0], [0.4, 10.0], [1.0, 25.0], [1.2, 80.0]]
[[differentials]]
joints = ["pitch", "roll"]
servos = ["left", "right"]
matrix = [[1.0, 1.0], [1.0, -1.0]]
zero = [3.0, -3.0]
"""

BROKEN = """baud = 1_000_001
colour = "red"
[[servos]]
name = "a"
id = 1
model = "xm430"
[[servos]]
name = "a"
id = 300
model = "xl430-w250"
current = 1.0
[[joints]]
joint = "waist"
servo = "b"
range = [2, 1]
speed = 3
[[joints]]
joint = "waist"
servos = [{ servo = "a" }, { servo = "a" }]
points = [[0, 0], [1, 1], [2, 0.5]]
[[differentials]]
joints = ["p", "r"]
servos = ["a", "a"]
matrix = [[1, 1], [1, 1]]
"""


def test_every_mistake_is_told_with_its_line() -> None:
    with pytest.raises(RigError) as e:
        parse_rig(BROKEN, file="broken.toml")
    text = str(e.value)
    for line, words in {
        1: "no bit rate 1_000_001",
        2: "no such word",
        6: "did you mean 'xm430-w350'",
        8: "used by an earlier servo",
        9: "less than or equal to 252",
        11: "does not control current",
        14: "no servo 'b'",
        15: "range must rise",
        16: "direction, zero",  # lists what a joint may say
        18: "stands here twice",
        17: "rise or fall all the way",
        21: "cannot be inverted",
    }.items():
        assert re.search(rf"line {line}, [^\n]*{re.escape(words)}", text), f"line {line} {words!r} in\n{text}"


@pytest.mark.parametrize("text", ["", "servos = 3", "servos = [1]\njoints = [2]", "[[servos]]", "x = ["])
def test_nonsense_is_told_in_words(text: str) -> None:
    with pytest.raises(RigError):
        parse_rig(text)


@needs_data
@pytest.mark.parametrize("name", ["wx250s", "dynamixel_2r"])
def test_rigs_that_come_along_fit_their_robots(name: str) -> None:
    rig = load_rig(name)
    check_model(rig, rig.load_model())
    assert np.linalg.matrix_rank(make_mapping(rig).matrix) == len(rig.joints)


def test_joints_that_a_model_lacks_are_told_at_once() -> None:
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="lift" type="hinge"/><geom size=".1"/>
        <body><joint name="pitch" type="ball"/><geom size=".1"/>
        <body><joint name="finger" type="slide" range="0.02 0.03" limited="true"/><geom size=".1"/>
        <body><joint name="hatch" type="hinge"/><geom size=".1"/></body></body>
        </body></body></worldbody></mujoco>"""
    )
    with pytest.raises(RigError) as e:
        check_model(parse_rig(EVERYTHING), model)
    text = str(e.value)
    assert "4 mistakes" in text
    for words in (
        "'pitch' is a ball",
        "no joint 'roll'",
        "wider than the model's [0.02, 0.03]",
        "'hatch' turns; 'crank' and 'points' are for joints that slide",
    ):
        assert words in text


def joints_inside(rng: np.random.Generator, n: int) -> np.ndarray:
    low = np.array([-0.7, -1.0, -1.0, 0.0155, 0.02])
    high = np.array([0.7, 1.0, 1.0, 0.0365, 1.18])
    return rng.uniform(low, high, (n, 5))


@given(st.integers(0, 2**32 - 1))
def test_mapping_there_and_back(seed: int) -> None:
    mapping = make_mapping(parse_rig(EVERYTHING))
    q = joints_inside(np.random.default_rng(seed), 7)
    assert np.allclose(mapping.joint(mapping.servo(q)), q, atol=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_rates_are_derivatives_and_power_is_kept(seed: int) -> None:
    rng = np.random.default_rng(seed)
    mapping = make_mapping(parse_rig(EVERYTHING))
    q = joints_inside(rng, 1)[0]
    for x in (0.0, 0.4, 1.0, 1.2):  # the table's curvature jumps at its points
        if abs(q[4] - x) < 1e-3:
            q[4] = x + 2e-3
    v, a = rng.normal(size=5) * [1, 1, 1, 0.01, 1], rng.normal(size=5) * [1, 1, 1, 0.01, 1]
    h = 1e-5
    path = [mapping.servo(q + v * t + a * t * t / 2) for t in (-h, 0.0, h)]
    servo_v, servo_a = mapping.rates(q, v, a)
    assert np.allclose(servo_v, (path[2] - path[0]) / (2 * h), rtol=1e-5, atol=1e-5)
    assert np.allclose(servo_a, (path[2] - 2 * path[1] + path[0]) / h**2, rtol=2e-3, atol=2e-3)
    assert np.allclose(mapping.joint_rates(q, servo_v), v, atol=1e-9)
    tau = rng.normal(size=5)
    torque = mapping.torque(q, tau)
    assert np.isclose(torque @ servo_v, tau @ v)  # virtual work
    assert np.allclose(mapping.joint_force(q, torque), tau)


def test_two_servos_share_a_joint_and_fights_are_seen() -> None:
    mapping = make_mapping(parse_rig(EVERYTHING))
    torque = mapping.torque(np.array([0, 0, 0, 0.02, 0.5]), np.array([4.0, 0, 0, 0, 0]))
    assert np.allclose(torque[:2], [1.0, -1.0])  # each half of 4 N m, over a gear of 2
    s = mapping.servo(np.array([0.2, 0, 0, 0.02, 0.5]))
    assert np.allclose(mapping.disagreement(s), 0, atol=1e-12)
    s[1] += 0.2
    assert np.isclose(np.abs(mapping.disagreement(s)[:2]).max(), 0.1)


@given(st.floats(0.005, 0.03), st.floats(0.005, 0.04), st.floats(-1.4, 1.4))
def test_slider_crank_closes_its_triangle(radius: float, more: float, u: float) -> None:
    crank = SliderCrank(radius, radius + more)
    x = crank.joint(np.array([u]))
    pin = radius * np.array([np.cos(u), np.sin(u)])  # the slider runs along y
    assert np.isclose(np.hypot(pin[0], x[0] - pin[1]), radius + more)
    assert np.allclose(crank.angle(x)[0], u, atol=1e-7)


def test_table_is_monotone_and_straight_beyond_its_ends() -> None:
    table = Table([(0.0, 1.0), (1.0, 0.5), (2.0, 0.49), (3.0, -2.0)])
    q = np.linspace(-1, 4, 2001)
    u, d1, _ = table.angle(q)
    assert np.all(np.diff(u) < 0)
    assert np.allclose(np.gradient(u, q)[5:-5], d1[5:-5], atol=0.02)
    assert np.allclose(table.joint(u), q, atol=1e-6)


def test_limits_come_from_the_file_or_from_the_model_of_servo() -> None:
    rig = parse_rig(EVERYTHING)
    bounds, joints = make_bounds(rig), joint_bounds(rig)
    assert np.isclose(bounds.velocity[0], np.pi / 2) and np.isclose(bounds.velocity[1], 200 * 0.0239691227)
    assert np.isclose(bounds.high[4], np.radians(100)) and np.isclose(bounds.low[0], -np.pi)
    assert np.isclose(joints.low[1], -np.pi / 3) and joints.low[3] == 0.015 and np.isinf(joints.low[0])
    assert (
        np.isclose(park_pose(rig, np.full(5, 0.1))[0], np.radians(30))
        and park_pose(rig, np.full(5, 0.1))[1] == 0.1
    )


@given(st.integers(0, 2**32 - 1))
def test_goals_within_the_servos_tightened_limits_hold_every_pose_of_the_joints(seed: int) -> None:
    rig = parse_rig(EVERYTHING)
    mapping, joints = make_mapping(rig), joint_bounds(rig)
    free = make_bounds(rig)
    tight = within_joints(free, mapping, joints)
    rng = np.random.default_rng(seed)
    q = rng.uniform(np.fmax(joints.low, -1), np.fmin(joints.high, 1), (50, 5))
    s = np.clip(mapping.servo(q), free.low, free.high)
    assert (s > tight.low - 1e-9).all() and (s < tight.high + 1e-9).all()
    ends = mapping.servo(np.array([[0.0, 0.0, 0.0, x, 0.5] for x in (0.015, 0.037)]))[:, 4]
    assert np.allclose(sorted(ends), [tight.low[4], tight.high[4]])
    assert (tight.velocity <= free.velocity).all()


def test_joints_of_a_named_model_in_a_scene() -> None:
    body = '<body name="b{0}"><joint name="{0}/elbow"/><geom size=".1"/></body>'
    one, two = (
        mujoco.MjModel.from_xml_string(
            f"<mujoco><worldbody>{''.join(map(body.format, names))}</worldbody></mujoco>"
        )
        for names in (["left"], ["left", "right"])
    )
    text = 'servos = [{ name = "s", id = 1, model = "mx-28" }]\n[[joints]]\njoint = "elbow"\nservo = "s"'
    rig = parse_rig(text)
    assert rig.joint_in(one, "elbow") == "left/elbow"
    with pytest.raises(RigError, match="several joints 'elbow': left/elbow, right/elbow"):
        check_model(rig, two)
    assert parse_rig('prefix = "right"\n' + text).joint_in(two, "elbow") == "right/elbow"


# The verdict.

ONE = Mapping(("j",), ("s",), (1,), np.array([[2.0]]), np.zeros(1), {}, ("rad",))
FREE = JointBounds(*(np.array([x]) for x in (-np.inf, np.inf, np.inf, np.inf, np.inf)))


def bounds(
    velocity=np.inf, acceleration=np.inf, torque=np.inf, stall=np.inf, free=np.inf, high=100.0
) -> Bounds:
    return Bounds(*(np.array([float(x)]) for x in (-high, high, velocity, acceleration, torque, stall, free)))


def swing(rate: float = 3.0, size: float = 0.5) -> Motion:
    t = np.linspace(0, 2 * np.pi / rate, 401)
    q = size * np.sin(rate * t)
    return Motion(t, q[:, None], (size * rate * np.cos(rate * t))[:, None], (-(rate**2) * q)[:, None])


def no_load(motion: Motion) -> Loads:
    return Loads(*(np.zeros_like(motion.q) for _ in range(3)))


def test_speed_and_acceleration_limits_give_their_own_slowdown() -> None:
    motion = swing()  # servo: peak speed 2 * 0.5 * 3, acceleration 2 * 0.5 * 9
    verdict = check_motion(motion, ONE, bounds(velocity=1.5), FREE, no_load(motion))
    assert not verdict.ok and np.isclose(verdict.slowdown, 2.0, rtol=1e-4)
    verdict = check_motion(motion, ONE, bounds(acceleration=1.0), FREE, no_load(motion))
    assert np.isclose(verdict.slowdown, 3.0, rtol=1e-4)


@given(st.integers(0, 2**32 - 1))
def test_slowed_motion_fits_and_a_little_faster_does_not(seed: int) -> None:
    """The factor is exact: the motion fits with it, and breaks a limit with 1 % less."""
    rng = np.random.default_rng(seed)
    motion = swing(rng.uniform(2, 8), rng.uniform(0.1, 1.0))
    n = len(motion.t)
    gravity, damping, inertia = rng.uniform(-1.5, 1.5), rng.uniform(0, 0.3), rng.uniform(0, 0.4)
    limit = bounds(
        rng.uniform(0.5, 5), rng.uniform(1, 30), rng.uniform(1, 3), rng.uniform(1, 3), rng.uniform(3, 9)
    )
    loads = Loads(np.full((n, 1), gravity), damping * motion.v, inertia * motion.a)
    factor = check_motion(motion, ONE, limit, FREE, loads).slowdown
    assert np.isfinite(factor)  # gravity alone, 0.75 N m at the servo, fits always

    def broken(k: float) -> bool:
        slow = motion.slow(k)
        parts = Loads(loads.static, loads.viscous / k, loads.dynamic / k**2)
        force = np.abs(ONE.torque(slow.q, parts.static + parts.viscous + parts.dynamic))
        speed, acceleration = np.abs(2 * slow.v), np.abs(2 * slow.a)
        line = limit.stall * (1 - speed / limit.free_speed)
        return bool(
            (speed > limit.velocity * (1 + 1e-6)).any()
            or (acceleration > limit.acceleration * (1 + 1e-6)).any()
            or (force > np.minimum(limit.torque, line) * (1 + 1e-6)).any()
        )

    assert not broken(factor)
    assert all(not broken(factor * k) for k in (1.1, 2.0, 10.0)), "every slower motion fits as well"
    if factor > 1.02:
        assert broken(factor / 1.01)


def test_gravity_and_positions_are_not_helped_by_slowing() -> None:
    motion = swing()
    heavy = Loads(np.full_like(motion.q, 5.0), np.zeros_like(motion.q), np.zeros_like(motion.q))
    verdict = check_motion(motion, ONE, bounds(torque=2.0, stall=9.0), FREE, heavy)
    assert verdict.slowdown == np.inf and "no slowing helps" in str(verdict)
    with pytest.raises(MotionRefused, match="does not help"):
        fit(motion, verdict, slow=True)
    far = check_motion(motion, ONE, bounds(high=0.9), FREE, no_load(motion))
    assert far.slowdown == np.inf and "position of servo s" in str(far)


def test_a_jump_between_samples_is_seen_though_its_recorded_speed_is_zero() -> None:
    t = np.linspace(0, 1, 101)
    q = np.where(t < 0.5, 0.0, 1.0)[:, None]
    motion = Motion(t, q, np.zeros_like(q), np.zeros_like(q))
    verdict = check_motion(motion, ONE, bounds(velocity=5.0), FREE, no_load(motion))
    # 1 rad in 10 ms from rest, as a parabola, ends with 2 / 0.01 rad/s, twice that at the servo.
    assert np.isclose(verdict.slowdown, 2 * 2.0 / 0.01 / 5.0, rtol=1e-6)


def test_motion_does_not_overshoot_where_keys_bend() -> None:
    t = np.linspace(0, 1, 11)
    q = np.minimum(t, 0.5)[:, None]
    motion = Motion(t, q, np.where(t < 0.5 - 1e-9, 1.0, 0.0)[:, None], np.zeros_like(q))
    dense = motion.dense()
    got, speed = motion.at(dense)
    assert np.allclose(got[:, 0], np.minimum(dense, 0.5), atol=1e-12)
    assert speed.max() < 1 + 1e-9


def test_refusal_names_the_way_out_and_slow_takes_it() -> None:
    motion = swing()
    verdict = check_motion(motion, ONE, bounds(velocity=1.0), FREE, no_load(motion))
    with pytest.raises(MotionRefused, match="--slow"):
        fit(motion, verdict, slow=False)
    slow = fit(motion, verdict, slow=True)
    assert np.isclose(slow.duration, 3 * motion.duration, rtol=1e-4)
    half = 0.5 * slow.duration
    assert np.allclose(slow.at(half)[0], motion.at(half / slow.slowed)[0])


@given(st.lists(st.floats(0, 1), min_size=1, max_size=20))
def test_motion_between_samples_is_the_cubic(times: list[float]) -> None:
    c = np.array([0.3, -1.0, 2.0, 0.7])
    t = np.array([0.0, 0.2, 0.5, 1.0])
    value = np.polynomial.Polynomial(c)
    q, v = value(t)[:, None], value.deriv()(t)[:, None]
    got_q, got_v = Motion(t, q, v, np.zeros_like(q)).at(np.array(times))
    assert np.allclose(got_q[:, 0], value(np.array(times)))
    assert np.allclose(got_v[:, 0], value.deriv()(np.array(times)))


def test_loads_split_as_a_pendulum_does() -> None:
    """A point mass m on a rod l: static m g l sin q + friction, viscous d v, dynamic (m l^2 + armature) a."""
    m, rod, d, friction, armature = 0.7, 0.4, 0.11, 0.05, 0.02
    model = f"""<mujoco><option gravity="0 0 -9.81"/><worldbody><body>
        <joint name="j" axis="0 1 0" damping="{d}" frictionloss="{friction}" armature="{armature}"/>
        <inertial pos="0 0 {-rod}" mass="{m}" diaginertia="1e-9 1e-9 1e-9"/></body></worldbody></mujoco>"""
    mapping = Mapping(("j",), ("s",), (1,), np.eye(1), np.zeros(1), {}, ("rad",))
    recording = _pendulum_recording(model)
    rig = parse_rig('servos = [{name="s", id=1, model="mx-28"}]\n[[joints]]\njoint = "j"\nservo = "s"')
    motion, loads = motion_of(recording, rig, mapping), loads_of(recording, rig, mapping)
    q, v, a = motion.q, motion.v, motion.a
    assert np.allclose(loads.static, m * 9.81 * rod * np.sin(q) + friction * np.sign(v), atol=1e-6)
    assert np.allclose(loads.viscous, d * v)
    assert np.allclose(loads.dynamic, (m * rod * rod + armature + 1e-9) * a, atol=1e-6)


def _pendulum_recording(xml: str):
    import tempfile
    from pathlib import Path

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "pendulum.xml"
        path.write_text(xml)
        keys = [{"joint": "j", "times": [0, 0.5, 1, 2], "values": [0.2, 1, -0.5, 0.1]}]
        return run(Scene(duration=2, models=[{"file": str(path)}], keys=keys))


def broken_values() -> st.SearchStrategy[object]:
    words = st.sampled_from(["a", "left", ""])
    plain = st.one_of(st.none(), st.booleans(), st.integers(-5, 300), st.floats(), words)
    tables = st.dictionaries(st.sampled_from("abcd"), plain, max_size=3)
    return st.one_of(plain, tables, st.lists(st.one_of(plain, tables), max_size=3))


@given(st.data())
def test_any_value_in_any_place_is_told_or_accepted_but_never_a_crash(data: st.DataObject) -> None:
    whole = tomllib.loads(EVERYTHING)
    for _ in range(data.draw(st.integers(1, 3))):
        item: object = whole
        while True:
            keys = list(item) if isinstance(item, dict) else range(len(item))
            key = data.draw(st.sampled_from(list(keys)))
            deeper = item[key]
            if not isinstance(deeper, dict | list) or not deeper or data.draw(st.booleans()):
                break
            item = deeper
        item[key] = data.draw(broken_values())
    mistakes = contradictions(whole)
    try:
        rig = Rig(**whole)
    except ValidationError:
        return
    if not mistakes:
        make_mapping(rig)  # what has no mistake can be used


def test_a_joint_where_its_crank_does_not_reach_is_named_alone() -> None:
    """A gripper left at 0 m, where no crank angle puts it, says nothing about the other joints."""
    rig = parse_rig(EVERYTHING)
    mapping = make_mapping(rig)
    j = next(i for i, item in enumerate(rig.joints) if item.crank)
    q = np.tile(joints_inside(np.random.default_rng(0), 1), (3, 1))
    q[:, j] = 0.0
    motion = Motion(np.linspace(0, 1, 3), q, np.zeros_like(q), np.zeros_like(q))
    verdict = check_motion(motion, mapping, make_bounds(rig), joint_bounds(rig))
    assert [v.joint for v in verdict.joints if not v.ok] == [mapping.joints[j]]
    assert f"position of joint {mapping.joints[j]}: 0 m" in str(verdict)
    assert "nan" not in str(verdict)
    assert np.isinf(verdict.slowdown)
