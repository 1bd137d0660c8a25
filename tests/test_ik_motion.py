"""Inverse kinematics along time: limits, singularities, deviations, clearance, animators' constraints."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import ik_cases
from oracles.ik_motions import figure_eight, wrist_arm
from pantograph.models import ModelError, load_model
from pantograph.sim.ik import (
    Follower,
    JointValue,
    LookAt,
    Pole,
    Pose,
    Position,
    Posture,
    blend,
    follow,
    lock,
    soften,
    solve,
)
from pantograph.sim.ik.numeric.band import _Banded, _interior
from pantograph.sim.ik.numeric.qp import minimise
from pantograph.sim.kinematics import frame
from strategies import seeds


def test_a_figure_eight_through_a_wrist_singularity_streams_within_limits_and_tells_its_deviation():
    model = wrist_arm()
    q, goals = figure_eight(model)
    dt, v_max, a_max = 0.02, 2.0, 30.0
    follower = Follower(model, dt=dt, q0=q, velocity=v_max, acceleration=a_max)
    before, worst, told = np.zeros(model.nv), 0.0, 0.0
    f = frame(model, "site", "tip")
    for k in range(200):
        tick = follower.step(goals(k * dt))
        assert np.abs(tick.v).max() <= v_max * (1 + 1e-9)
        assert np.abs(tick.v - before).max() <= a_max * dt * (1 + 1e-6)
        assert ik_cases.illegal(model, tick.q) == []
        true = np.linalg.norm(f.pose(tick.q)[:3, 3] - goals(k * dt)[0].position)
        assert tick.residuals[0].position == pytest.approx(true, abs=1e-12)
        assert tick.followed == tick.residuals[0].met
        assert tick.followed or tick.held
        before, worst, told = tick.v, max(worst, true), max(told, tick.residuals[0].position)
    assert worst < 0.03


def test_a_whole_figure_eight_is_smooth_and_follows_better_than_streaming():
    model = wrist_arm()
    q, goals = figure_eight(model)
    times = np.arange(0, 4, 0.04)
    motion = follow(model, goals, times, q0=q, velocity=2.0, acceleration=30.0)
    assert motion.speed <= 1.0 and motion.effort <= 1.0
    steps = np.diff(motion.q, axis=0) / 0.04
    assert np.abs(steps).max() <= 2.0
    assert np.abs(np.diff(steps, axis=0)).max() / 0.04 <= 30.0
    f = frame(model, "site", "tip")
    true = [
        np.linalg.norm(f.pose(x)[:3, 3] - goals(t)[0].position) for t, x in zip(times, motion.q, strict=True)
    ]
    np.testing.assert_allclose(motion.position, true, atol=1e-12)
    follower = Follower(model, dt=0.04, q0=motion.q[0], velocity=2.0, acceleration=30.0)
    streamed = [follower.step(goals(t)).residuals[0].position for t in times]
    assert motion.position.max() <= max(streamed) + 1e-6
    clip = motion.clip()
    np.testing.assert_allclose(clip.evaluate(times).q, motion.q, atol=1e-9)


def test_an_easy_path_is_followed_exactly():
    model = load_model("arm6")
    q = np.array([0.3, 0.4, 0.5, 0.1, 0.6, 0.2])
    p, quat = ik_cases.pose_of(model, q, "tip")
    times = np.arange(0, 2, 0.05)
    motion = follow(
        model, lambda t: [Pose("tip", np.add(p, [0, 0.05 * np.sin(3 * t), 0]), quat)], times, q0=q
    )
    assert motion.followed and motion.missed == ()
    assert motion.position.max() < 1e-6 and motion.rotation.max() < 1e-6


def test_what_cannot_be_followed_is_told_with_its_reason():
    model = ik_cases.planar_chain((1.0, 0.8))
    times = np.arange(0, 2, 0.05)
    out = follow(
        model, lambda t: [Position("tip", [1.5 + 0.5 * np.sin(np.pi * t), 0.2, 0])], times, q0=[-0.3, 0.8]
    )
    assert len(out.missed) == 1
    assert out.missed[0].verdict.kind == "out of reach"
    assert out.missed[0].verdict.proved and out.missed[0].stopped == "goals"
    far = np.hypot(1.5 + 0.5 * np.sin(np.pi * times), 0.2)
    assert out.missed[0].position == pytest.approx((far - 1.8).max(), abs=2e-3)
    fast = follow(
        model, lambda t: [Position("tip", [1.4 * np.cos(4 * t), 1.4 * np.sin(4 * t), 0])], times, velocity=1.0
    )
    assert fast.missed and fast.missed[0].verdict is None and fast.missed[0].stopped == "velocity"
    assert fast.speed <= 1.0
    shaken = follow(
        model, lambda t: [Position("tip", [1.2 + 0.3 * np.sin(8 * t), 0.2, 0])], times, acceleration=10.0
    )
    assert shaken.missed and 0.9 < shaken.effort <= 1.0 and shaken.missed[0].stopped == "acceleration"
    assert np.abs(np.diff(shaken.q, 2, axis=0)).max() / 0.05**2 <= 10.0


def _finely(motion):
    """Largest velocity and acceleration (nv,) of a motion's curves, ten times as finely, from both sides."""
    t = np.linspace(motion.t[0], motion.t[-1], 10 * (len(motion.t) - 1) + 1)
    sides = [motion.clip().evaluate(t, left=left) for left in (False, True)]
    return (np.max([np.abs(getattr(m, name)).max(axis=0) for m in sides], axis=0) for name in ("v", "a"))


@settings(max_examples=5, deadline=None)
@given(seeds)
def test_limits_of_a_followed_motion_hold_between_its_instants(seed):
    rng = np.random.default_rng(seed)
    model = ik_cases._random_chain(rng, 4)
    v_max, a_max = rng.uniform(0.3, 2.0, model.nv), rng.uniform(2.0, 20.0, model.nv)
    p, w, phase = rng.normal(size=(3, 3)), rng.uniform(3, 9, 3), rng.uniform(0, 6, 3)
    motion = follow(
        model,
        lambda t: [Position("tip", 0.4 * np.sin(w * t + phase) @ p)],
        np.arange(0, 1.2, 0.04),
        q0=ik_cases._within(model, rng),
        velocity=v_max,
        acceleration=a_max,
    )
    v, a = _finely(motion)
    assert (v <= v_max * (1 + 1e-9)).all() and (a <= a_max * (1 + 1e-9)).all()
    assert motion.speed == pytest.approx((v / v_max).max(), rel=1e-6)
    assert motion.effort == pytest.approx((a / a_max).max(), rel=1e-6)
    assert max(motion.speed, motion.effort) > 0.9
    np.testing.assert_allclose(motion.clip().evaluate(motion.t).q, motion.q, atol=1e-9)
    between = motion.clip().evaluate(np.linspace(0, 1.16, 200)).q
    assert all(ik_cases.illegal(model, q) == [] for q in between)


def test_limits_hold_for_balls_and_floating_bodies_too():
    a, b = 0.4, 0.3
    links = [([0, 0, 0], ik_cases.BALL, (0, 0, 1), None), ([a, 0, 0], ik_cases.HINGE, (0, 0, 1), (0, 2.8))]
    ball, puppet = ik_cases.chain([*links, ([b, 0, 0], None, None, None)]), load_model("puppet")
    hand = ik_cases.pose_of(puppet, puppet.qpos0, "left_hand")[0]
    cases = [
        (ball, "tip", np.zeros(3), [0.4, 0.4, 0.3], [7, 5, 6], None),
        (
            puppet,
            "left_hand",
            hand,
            [0.2, 0.1, 0.2],
            [6, 9, 8],
            ["root", "left_elbow", "left_shoulder_pitch"],
        ),
    ]
    for model, at, p, size, w, joints in cases:
        motion = follow(
            model,
            lambda t, at=at, p=p, size=size, w=w: [Position(at, p + size * np.sin(np.multiply(w, t) + 1))],
            np.arange(0, 1.2, 0.04),
            velocity=1.0,
            acceleration=8.0,
            joints=joints,
        )
        v, a = _finely(motion)
        assert 0.8 < v.max() <= 1 + 1e-6 and 4 < a.max() <= 8 * (1 + 1e-6)


def test_a_look_that_slides_along_the_limits_of_ball_joints_is_as_near_as_any_pose():
    """A fly circles the puppet's head; neck and waist are balls with limits that keep it from behind."""
    model, times, joints = load_model("puppet"), np.arange(0, 4, 0.1), ["neck", "waist"]

    def goals(t):
        return [LookAt("gaze", [1.5 * np.cos(1.5 * t), 1.5 * np.sin(1.5 * t), 1.2], axis=(1, 0, 0))]

    motion = follow(model, goals, times, joints=joints)
    assert all(ik_cases.illegal(model, q) == [] for q in motion.q)
    nearest = [solve(model, goals(t), joints=joints, restarts=20).residuals[0].rotation for t in times[::5]]
    assert min(nearest) < 1e-9 and max(nearest) > 0.5
    assert (motion.rotation[::5] < np.array(nearest) + 0.01).all()
    assert np.abs(np.diff(motion.q, axis=0)).max() < 0.5


def test_what_goals_leave_open_does_not_drift():
    """A gaze goes round and round; how far the head is turned about it is nobody's goal."""
    model, times = load_model("puppet"), np.arange(0, 8, 0.05)

    def goals(t):
        w = 0.5 * np.pi * t
        point = [1.0, 0.5 * np.sin(w), 1.0 + 0.4 * np.cos(w)]
        return [LookAt("gaze", point, axis=(1, 0, 0))]

    motion = follow(model, goals, times, joints=["neck"])
    assert motion.followed
    neck = motion.q[:, model.joint("neck").qposadr[0] :][:, :4]
    roll = 2 * np.arctan2(neck[:, 1], neck[:, 0])
    assert np.abs(roll).max() < 0.2
    np.testing.assert_allclose(neck[100], neck[20], atol=0.01)  # the same after a turn


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_halving_the_tick_halves_the_steps_also_past_singularities(seed):
    """Law of a path without jumps: no step is longer than its duration allows. The goals pass places where
    the arm is stretched out or the wrist is singular, on ways that no solution follows at finite speed."""
    rng = np.random.default_rng(seed)
    model = wrist_arm()
    q = np.array([0.2, 0.7, 1.1, 0.3, 0.0, 0.0]) + 0.2 * rng.normal(size=6) * [1, 1, 1, 1, 0, 1]
    p, quat = ik_cases.pose_of(model, q, "tip")
    way, v_max = 0.25 * ik_cases.unit(rng), 3.0
    for dt in (0.02, 0.01):
        follower, last = Follower(model, dt=dt, q0=q, velocity=v_max), q
        for k in range(round(1.0 / dt)):
            goal = Pose("tip", p + way * np.sin(2 * np.pi * k * dt), quat)
            tick = follower.step([goal])
            assert np.abs(tick.q - last).max() <= v_max * dt * (1 + 1e-9)
            assert ik_cases.illegal(model, tick.q) == []
            last = tick.q
    times = np.arange(0, 1.0, 0.05)
    goals = [[Pose("tip", p + way * np.sin(2 * np.pi * t), quat)] for t in times]
    motion = follow(model, goals, times, q0=q, velocity=v_max)
    fine = motion.clip().evaluate(np.linspace(0, times[-1], 2000))
    assert np.abs(np.diff(fine.q, axis=0)).max() <= v_max * times[-1] / 1999 * (1 + 1e-6)


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_streaming_never_breaks_a_limit_whatever_is_asked(seed):
    rng = np.random.default_rng(seed)
    model = ik_cases._random_chain(rng, 5)
    dt, v_max, a_max = 0.02, rng.uniform(0.2, 4), rng.uniform(1, 60)
    follower = Follower(model, dt=dt, q0=ik_cases._within(model, rng), velocity=v_max, acceleration=a_max)
    before = np.zeros(model.nv)
    for k in range(25):
        if k % 8 == 0:
            goal = Pose("tip", 3 * rng.normal(size=3), rng.normal(size=4))
        tick = follower.step([goal])
        assert ik_cases.illegal(model, tick.q) == []
        assert np.abs(tick.v).max() <= v_max * (1 + 1e-9)
        assert np.abs(tick.v - before).max() <= a_max * dt * (1 + 1e-6)
        before = tick.v


def test_a_goal_that_jumps_is_reached_in_nearly_the_least_time_and_without_overshoot():
    """Least time of one joint over a way s: a triangle of velocity, or a trapezoid when v_max is reached."""
    model, dt, v_max, a_max = load_model("arm6"), 0.01, 2.0, 15.0
    longer = []
    for seed in (139, *range(40)):  # the first so far away that full steps towards it do not help
        rng = np.random.default_rng(seed)
        q0 = np.array([0.3, 0.4, 0.8, 0.2, 0.7, 0.1]) + 0.1 * rng.normal(size=6)
        there = np.clip(q0 + 0.3 * rng.normal(size=6), *(0.95 * model.jnt_range.T))
        goal = Pose("tip", *ik_cases.pose_of(model, there, "tip"))
        follower = Follower(model, dt=dt, q0=q0, velocity=v_max, acceleration=a_max)
        ticks = [follower.step([goal]) for _ in range(150)]
        assert ticks[-1].followed and np.abs(ticks[-1].v).max() < 1e-9
        way = np.abs(ticks[-1].q - q0)
        ramp = v_max**2 / a_max
        least = np.where(way < ramp, 2 * np.sqrt(way / a_max), way / v_max + v_max / a_max).max()
        late = max((k + 1 for k, tick in enumerate(ticks) if not tick.followed), default=0)
        longer.append((late - 2) * dt / least)  # a tick to see the goal, one cut off by the grid
        beyond = np.sign(ticks[-1].q - q0) * (np.array([tick.q for tick in ticks]) - ticks[-1].q)
        assert beyond.max() < 0.02 * way.max() + 1e-6
    assert np.median(longer) < 1.1
    assert max(longer) < 1.5  # ways that bend: the joint with the longest way is not the one that waits


def test_streaming_keeps_named_geoms_apart():
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    for i in range(3):
        body = body.add_body(name=f"b{i}", pos=[0 if i == 0 else 0.5, 0, 0])
        body.add_joint(name=f"j{i}", type=ik_cases.HINGE, axis=[0, 0, 1])
        body.add_geom(
            name=f"g{i}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=[0, 0, 0, 0.5, 0, 0], size=[0.04, 0, 0]
        )
    body.add_site(name="tip", pos=[0.5, 0, 0])
    spec.worldbody.add_geom(
        name="post", type=mujoco.mjtGeom.mjGEOM_CYLINDER, size=[0.1, 0.5, 0], pos=[0.9, 0.35, 0]
    )
    model, clearance = spec.compile(), 0.02
    start, pairs = np.array([-0.3, 0.2, 0.2]), [(f"g{i}", "post") for i in range(3)]
    data = mujoco.MjData(model)

    def nearest(apart):
        follower = Follower(model, dt=0.02, q0=start, velocity=2.0, apart=apart, clearance=clearance)
        least, held = np.inf, set()
        for k in range(120):
            angle = -0.1 + 0.9 * min(1.0, k / 80)
            tick = follower.step([Position("tip", [1.2 * np.cos(angle), 1.2 * np.sin(angle), 0])])
            data.qpos[:] = tick.q
            mujoco.mj_forward(model, data)
            ends = np.zeros(6)
            least = min(least, *(mujoco.mj_geomDistance(model, data, i + 1, 0, 1.0, ends) for i in range(3)))
            held |= set(tick.held)
        return least, held

    assert nearest(())[0] < 0
    least, held = nearest(pairs)
    assert least >= clearance - 1e-4
    assert any("near post" in what for what in held)


def _straight(n, d=0):
    """A planar arm of n links whose first ones point along x, with a turn of 180 degrees after d links."""
    q = np.zeros(n)
    if d:
        q[d] = np.pi
    return ik_cases.planar_chain([0.5] * n), q


LIMITS = pytest.mark.parametrize("limits", [{}, {"velocity": 2.0}, {"velocity": 2.0, "acceleration": 20.0}])


@LIMITS
@pytest.mark.parametrize(("links", "folded"), [(2, 0), (3, 0), (4, 0), (4, 1)])
def test_a_straight_arm_follows_a_goal_inwards_along_it(links, folded, limits):
    """J'r = 0 there though r is not: no first-order step moves it."""
    model, q = _straight(links, folded)
    goal = Position("tip", 0.5 * ik_cases.pose_of(model, q, "tip")[0])
    follower = Follower(model, dt=0.01, q0=q, **limits)
    before = np.zeros(model.nv)
    for _ in range(400):
        tick = follower.step([goal])
        assert np.abs(tick.v).max() <= limits.get("velocity", np.inf) * (1 + 1e-9)
        assert np.abs(tick.v - before).max() <= 0.01 * limits.get("acceleration", np.inf) * (1 + 1e-6)
        before = tick.v
    assert tick.followed and tick.residuals[0].position < 1e-9


@LIMITS
@pytest.mark.parametrize("dt", [0.005, 0.02])
def test_an_arm_comes_back_from_a_goal_beyond_its_reach_where_it_waits_still(limits, dt):
    model = wrist_arm()
    q = np.array([0.0, 0.8, 1.0, 0.0, 0.5, 0.0])
    p, root = ik_cases.pose_of(model, q, "tip")[0], np.array([0, 0, 0.3])
    follower = Follower(model, dt=dt, q0=q, **limits)
    far = root + 1.4 * (p - root) / np.linalg.norm(p - root)
    away = [follower.step([Position("tip", far)]) for _ in range(round(3 / dt))][-round(1 / dt) :]
    assert not away[-1].followed
    assert max(np.abs(tick.q - away[0].q).max() for tick in away) < 1e-6
    for k in range(round(6 / dt)):
        share = max(0.0, 1.0 - k * dt)  # back within a second, along the stretched arm
        tick = follower.step([Position("tip", p + share * (far - p))])
    assert tick.followed and tick.residuals[0].position < 1e-6


def test_an_elbow_at_its_limit_bends_the_way_it_can():
    links = [([0, 0, 0], ik_cases.HINGE, (0, 0, 1), (-3, 3)), ([0.5, 0, 0], ik_cases.HINGE, (0, 0, 1), None)]
    for low, high in ((0.0, 2.8), (-2.8, 0.0)):
        links[1] = (*links[1][:3], (low, high))
        model = ik_cases.chain([*links, ([0.5, 0, 0], None, None, None)])
        for words in ({}, {"velocity": 2.0, "acceleration": 30.0}):
            follower = Follower(model, dt=0.01, q0=[0, 0], **words)
            for _ in range(300):
                tick = follower.step([Position("tip", [0.6, 0, 0])])
            assert tick.followed and ik_cases.illegal(model, tick.q) == []


@pytest.mark.parametrize("limits", [{}, {"velocity": 4.0, "acceleration": 60.0}])
def test_a_whole_motion_that_begins_straight_goes_inwards(limits):
    for model, q in (_straight(2), _straight(3)):
        x = ik_cases.pose_of(model, q, "tip")[0]
        motion = follow(
            model, lambda s, x=x: [Position("tip", x * (1 - 0.5 * s))], np.linspace(0, 1, 31), q0=q, **limits
        )
        assert motion.position[-10:].max() < 1e-4
        assert motion.position.max() < 0.01  # the first instant asks for infinite speed


def test_a_whole_motion_beyond_reach_stays_stretched():
    model, q = _straight(2)
    motion = follow(model, lambda s: [Position("tip", [1.2, 0, 0])], np.linspace(0, 1, 31), q0=q)
    np.testing.assert_allclose(motion.position, 0.2, atol=1e-9)
    np.testing.assert_allclose(motion.q, 0, atol=1e-6)


def _over_a_floor():
    """Three links in a vertical plane, a floor, and a thin wall within reach."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    world, plane, box = spec.worldbody, mujoco.mjtGeom.mjGEOM_PLANE, mujoco.mjtGeom.mjGEOM_BOX
    world.add_geom(name="floor", type=plane, size=[2, 2, 0.1])
    world.add_geom(name="wall", type=box, size=[0.02, 1, 3], pos=[0.6, 0, 0])
    body = world
    for i, (away, length) in enumerate(((0.6, 0.5), (0.5, 0.4), (0.4, 0.1))):
        body = body.add_body(pos=[0, 0, away] if i == 0 else [away, 0, 0])
        body.add_joint(name=f"j{i}", type=ik_cases.HINGE, axis=[0, 1, 0], limited=True, range=[-3, 3])
        body.add_geom(
            name=f"g{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, length, 0, 0],
            size=[0.03, 0, 0],
        )
    body.add_site(name="tip", pos=[0.1, 0, 0])
    return spec.compile()


@pytest.mark.parametrize("limits", [{}, {"velocity": 2.0}, {"velocity": 2.0, "acceleration": 20.0}])
@pytest.mark.parametrize("start", [(0.3, -0.2, 0.0), (-0.9, 0.4, 0.3), (0.5, 0.1, 0.2)])
@pytest.mark.parametrize("geoms", [(2,), (0, 1, 2)])
def test_a_hand_goes_down_to_the_floor_from_anywhere_and_no_further(start, geoms, limits):
    """The goal is 0.1 m below the floor: the nearest is the clearance above it, whatever way is left."""
    model, clearance = _over_a_floor(), 0.02
    pairs = [(f"g{i}", "floor") for i in geoms]
    follower = Follower(model, dt=0.01, q0=start, apart=pairs, clearance=clearance, **limits)
    data, nearest = mujoco.MjData(model), np.inf
    for _ in range(300):
        tick = follower.step([Position("tip", [0.5, 0, -0.1])])
        data.qpos[:] = tick.q
        mujoco.mj_kinematics(model, data)
        for i in geoms:
            ends = np.zeros(6)
            found = mujoco.mj_geomDistance(model, data, model.geom(f"g{i}").id, 0, 1.0, ends)
            nearest = min(nearest, found)
    assert nearest >= (0.25 if "acceleration" in limits else 1.0) * clearance - 1e-4
    assert data.site("tip").xpos[2] == pytest.approx(0.03 + clearance, abs=1e-3)
    assert any("near floor" in what for what in tick.held)


@pytest.mark.parametrize("start", [(1.5, 0.5, 0.0), (-1.8, -0.5, 0.2), (1.3, 1.2, 0.5)])
def test_without_limits_of_velocity_a_hand_jumps_over_no_wall(start):
    model, clearance = _over_a_floor(), 0.02
    pairs = [(f"g{i}", "wall") for i in range(3)]
    follower = Follower(model, dt=0.01, q0=start, apart=pairs, clearance=clearance)
    f = frame(model, "site", "tip")
    for _ in range(200):
        tick = follower.step([Position("tip", [0.95, 0, 0.6])])
        assert f.pose(tick.q)[0, 3] < 0.58
    assert not tick.followed and any("near wall" in what for what in tick.held)


def test_without_limits_no_limit_is_told_to_be_the_reason():
    """A path from one branch to another, and one that asks for infinite acceleration at its first instant."""
    model, q = _straight(2)
    corner = follow(model, lambda s: [Position("tip", [1 - 0.5 * s, 0, 0])], np.linspace(0, 1, 31), q0=q)
    assert corner.position.max() > 1e-6
    assert {missed.stopped for missed in corner.missed} <= {"smoothness", "jump"}
    bounded = ik_cases.chain(
        [([0, 0, 0], ik_cases.HINGE, (0, 0, 1), (-2.5, 2.5)), ([1, 0, 0], None, None, None)]
    )
    turning = lambda t: [Position("tip", [np.cos(t), np.sin(t), 0], tolerance=1e-3)]  # noqa: E731
    around = follow(bounded, turning, np.linspace(0, 2 * np.pi, 61), q0=[0])
    assert [(missed.stopped, missed.verdict) for missed in around.missed] == [("jump", None)]


def test_a_tick_that_is_off_says_why():
    model, q = _straight(2)
    still = Follower(model, dt=0.01, q0=q, velocity=2.0, acceleration=20.0)
    for _ in range(50):
        out = still.step([Position("tip", [1.3, 0, 0])])
    assert out.held == ("no step nearer",)
    torn = Follower(model, dt=0.01, q0=[0.3, 0.5])
    for _ in range(50):
        between = torn.step([JointValue("j0", 0.1), JointValue("j0", 0.5)])
    assert between.held == ("no step nearer",) and between.q[0] == pytest.approx(0.3)
    fast = Follower(model, dt=0.01, q0=[0.3, 0.5], velocity=[0.1, np.inf])
    assert fast.step([JointValue("j0", 1.0)]).held == ("j0",)
    hard = Follower(model, dt=0.01, q0=[0.3, 0.5], acceleration=[np.inf, 0.1])
    assert hard.step([JointValue("j0", 1.0), JointValue("j1", 1.0)]).held == ("j1",)
    limited = ik_cases.chain(
        [([0, 0, 0], ik_cases.HINGE, (0, 0, 1), (-0.5, 0.5)), ([1, 0, 0], None, None, None)]
    )
    ranged = Follower(limited, dt=0.01)
    for _ in range(20):
        tick = ranged.step([Position("tip", [0, 1, 0])])
    assert tick.held == ("j0",)


def test_joints_without_names_are_followed_and_locked_too():
    joint = '<joint axis="0 0 1"/><geom size=".01"/>'
    legs = f'<body>{joint}<body pos=".5 0 0">{joint}<site name="tip" pos=".5 0 0"/></body></body>'
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{legs}</worldbody></mujoco>")
    motion = follow(model, lambda s: [Position("tip", [0.3, 0.3 + 0.1 * s, 0])], np.linspace(0, 1, 11))
    assert motion.followed
    curves = motion.clip()
    assert set(curves.tracks) == {"joint0", "joint1"}
    np.testing.assert_allclose(curves.evaluate(motion.t).q, motion.q, atol=1e-9)
    locked = lock(
        model, np.linspace(0, 1, 21), np.linspace([0.1, 0.2], [0.3, 0.5], 21), {"tip": [(0.3, 0.6)]}
    )
    assert locked.met.all()


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(1, 8), st.integers(0, 14))
def test_small_quadratic_programmes_meet_their_optimality_conditions(seed, n, k):
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(n, n))
    H, g = M @ M.T + 0.1 * np.eye(n), rng.normal(size=n)
    A, inside = rng.normal(size=(k, n)), rng.normal(size=n)
    b = A @ inside + rng.uniform(0, 1, k) * (rng.random(k) < 0.7)
    found = minimise(H, g, A, b)
    assert found.feasible
    assert (A @ found.x <= b + 1e-8).all()
    active = A[list(found.active)]
    multipliers = np.linalg.lstsq(active.T, -(H @ found.x + g), rcond=None)[0] if len(active) else np.zeros(0)
    np.testing.assert_allclose(H @ found.x + g + active.T @ multipliers, 0, atol=1e-6)
    assert (multipliers >= -1e-6).all()


def test_a_quadratic_programme_that_cannot_be_met_says_so():
    found = minimise(np.eye(1), np.zeros(1), np.array([[1.0], [-1.0]]), np.array([-1.0, -1.0]))
    assert not found.feasible


@pytest.mark.parametrize("seed", range(5))
def test_banded_programmes_agree_with_an_independent_solver(seed):
    from scipy.optimize import minimize

    rng = np.random.default_rng(seed)
    k, n = 12, 2
    H = _Banded(k, n)
    for i in range(k):
        B = rng.normal(size=(3, n))
        H.add_block(i, 10 * B.T @ B + 0.1 * np.eye(n))
    H.add_differences((1.0, -2.0, 1.0), np.ones((k - 2, n)))
    dense = np.diag(H.bands[0])
    for d in range(1, 2 * n + 1):
        dense += np.diag(H.bands[d, :-d], d) + np.diag(H.bands[d, :-d], -d)
    g = 20 * rng.normal(size=(k, n))
    bounds = np.full((k - 2, n), -0.05), np.full((k - 2, n), 0.05)
    sets = [((1.0,), np.full((k, n), -0.5), np.full((k, n), 0.5), np.full(n, 0.5)),
            ((-1.0, 1.0), np.full((k - 1, n), -0.1), np.full((k - 1, n), 0.1), np.full(n, 0.1)),
            ((1.0, -2.0, 1.0), *bounds, np.full(n, 0.05))]  # fmt: skip
    x = _interior(H, g, sets)

    def walls(y):
        y = y.reshape(k, n)
        return np.concatenate([(0.5 - np.abs(y)).ravel(), (0.1 - np.abs(np.diff(y, axis=0))).ravel(),
                               (0.05 - np.abs(np.diff(y, 2, axis=0))).ravel()])  # fmt: skip

    def cost(y):
        return 0.5 * y @ dense @ y + g.ravel() @ y

    assert walls(x.ravel()).min() > -1e-8
    found = minimize(cost, np.zeros(k * n), constraints={"type": "ineq", "fun": walls}, method="SLSQP",
                     options={"maxiter": 1000, "ftol": 1e-12})  # fmt: skip
    assert cost(x.ravel()) <= found.fun + 1e-3 * abs(found.fun)


def test_the_pole_says_where_the_elbow_points():
    a, b = 0.4, 0.3
    links = [([0, 0, 0], ik_cases.BALL, (0, 0, 1), None), ([a, 0, 0], ik_cases.HINGE, (0, 0, 1), (0, 2.8))]
    model = ik_cases.chain([*links, ([b, 0, 0], None, None, None)])
    rng = np.random.default_rng(0)
    for _ in range(5):
        hand, pole = 0.5 * ik_cases.unit(rng), 2 * rng.normal(size=3)
        solution = solve(model, [Position("tip", hand), Pole("body:link_0", "at1", "tip", pole, weight=1.0)])
        assert solution.solved
        elbow = ik_cases.pose_of(model, solution.q, "at1")[0]
        along = hand / np.linalg.norm(hand)
        side, wanted = elbow - (elbow @ along) * along, pole - (pole @ along) * along
        assert side @ wanted / np.linalg.norm(side) / np.linalg.norm(wanted) > 1 - 1e-6


@given(st.floats(0, 5), st.floats(0.05, 0.9))
def test_soft_reach_never_reaches_and_never_turns_back(far, softness):
    near = np.linalg.norm(soften([0, 0, 0], [far, 0, 0], 1.0, softness))
    further = np.linalg.norm(soften([0, 0, 0], [far + 1e-3, 0, 0], 1.0, softness))
    assert near <= 1.0 and near <= far + 1e-12
    assert near <= further <= near + 1e-3 + 1e-12
    if far <= 1 - softness:
        assert near == pytest.approx(far)


def test_blending_goes_from_keys_to_goals_along_the_shortest_way():
    model = load_model("puppet")
    rng = np.random.default_rng(0)
    from pantograph.sim.ik.space import Space

    space = Space(model)
    fk, ik = (space.random(rng, 4, model.qpos0, np.ones(model.nv, dtype=bool)) for _ in range(2))
    np.testing.assert_allclose(blend(model, fk, ik, 0.0), fk, atol=1e-12)
    ends = blend(model, fk, ik, 1.0)
    np.testing.assert_allclose(space.difference(ends, ik), 0, atol=1e-9)
    half = blend(model, fk, ik, 0.5)
    np.testing.assert_allclose(space.difference(ik, half), space.difference(half, fk), atol=1e-9)
    assert all(ik_cases.illegal(model, x) == [] for x in half)
    arm = blend(model, fk, ik, 1.0, joints=["left_elbow"])
    moved = np.flatnonzero(np.abs(arm - fk).max(axis=0) > 1e-12)
    assert moved.tolist() == [model.joint("left_elbow").qposadr[0]]


def test_mistakes_are_told():
    model = load_model("arm6")
    with pytest.raises(ModelError, match="evenly spaced"):
        follow(model, lambda t: [JointValue("elbow", 0)], [0, 1, 3])
    with pytest.raises(ModelError, match="1 lists of goals for 3 instants"):
        follow(model, [[JointValue("elbow", 0)]], [0, 1, 2])
    with pytest.raises(ModelError, match="velocity must be positive"):
        Follower(model, dt=0.01, velocity=-1)
    with pytest.raises(ModelError, match="positive time"):
        Follower(model, dt=0.0)
    with pytest.raises(ModelError, match="value of joint 'elbow' must be"):
        JointValue("elbow", np.nan)
    with pytest.raises(ModelError, match="finite"):
        Posture([np.nan] * 6)
    with pytest.raises(ModelError, match=r"6 numbers \(nq\), not 2"):
        solve(model, Posture([0, 0]))
    with pytest.raises(ModelError, match="share for each row"):
        blend(model, np.zeros((3, 6)), np.zeros((3, 6)), [0, 1])
    with pytest.raises(ModelError, match="below the reach"):
        soften([0, 0, 0], [1, 0, 0], 1.0, 2.0)
