"""Proofs of inverse kinematics: bounds hold at every configuration, and planar ones are attained."""

from itertools import combinations

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from oracles import ik_cases, ik_planar
from pantograph.models import ModelError, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import (
    CenterOfMass,
    Distance,
    LookAt,
    Mirror,
    PointOnLine,
    PointOnPlane,
    Position,
    solve,
)
from pantograph.sim.ik.chains.closed_form import closed_form
from pantograph.sim.ik.pose import Kinematics
from pantograph.sim.ik.problem import Problem
from pantograph.sim.ik.proofs.gaps import goal_gap, pair_gap, subdivision
from pantograph.sim.ik.proofs.reach import path, reach
from pantograph.sim.ik.space import Space
from strategies import random_states, seeds, trees


def _limited(model, rng):
    for j in range(model.njnt):
        if (
            model.jnt_type[j] in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
            and rng.random() < 0.6
        ):
            model.jnt_limited[j] = 1
            model.jnt_range[j] = np.sort(rng.normal(size=2) * 1.5)
    return model


@settings(max_examples=150, deadline=None)
@given(trees(), seeds)
def test_reach_bounds_every_distance_between_frames(model, seed):
    rng = np.random.default_rng(seed)
    model = _limited(model, rng)
    space, kinematics = Space(model), Kinematics(model)
    moved = rng.random(model.nv) < 0.8
    for ball in space.balls:
        moved[ball.v : ball.v + 3] = moved[ball.v]
    for _, v in space.shifts:
        moved[v : v + 6] = moved[v]
    start = space.clip(random_states(model, seed, 1)[0])[0]
    q = space.random(rng, 40, start, moved)
    a, b = (f"s{k}" for k in rng.integers(0, model.nsite, 2))
    hops = path(kinematics.frame(a), kinematics.frame(b), space, moved, start)
    if hops is None:
        return
    bounds = reach(hops)
    far = np.linalg.norm(
        kinematics.frame(a).pose(q)[:, :3, 3] - kinematics.frame(b).pose(q)[:, :3, 3], axis=1
    )
    assert (far >= bounds.low - 1e-9).all()
    assert (far <= bounds.high + 1e-9).all()


@settings(max_examples=150, deadline=None)
@given(trees(), seeds)
def test_no_proof_excludes_what_some_configuration_has(model, seed):
    rng = np.random.default_rng(seed)
    model = _limited(model, rng)
    space = Space(model)
    start = space.clip(model.qpos0[None])[0]
    q = space.random(rng, 1, start, np.ones(model.nv, dtype=bool))[0]
    sites = [f"s{k}" for k in rng.integers(0, model.nsite, 2)]
    goals = []
    for site in sites:
        p, quat = ik_cases.pose_of(model, q, site)
        goals.append(ik_cases.Pose(site, p, quat) if rng.random() < 0.5 else Position(site, p))
    p, x = ik_cases.pose_of(model, q, sites[0])[0], rng.normal(size=3)
    across = np.cross(rng.normal(size=3), x)
    others = [PointOnPlane(sites[0], p + across, x), PointOnLine(sites[0], p + x, x)]
    others.append(Distance(sites[0], p + x, float(np.linalg.norm(x))))
    others.append(PointOnLine(sites[1], ik_cases.pose_of(model, q, sites[1])[0] - x, x))
    others.append(PointOnPlane(sites[1], ik_cases.pose_of(model, q, sites[1])[0] + across, x))
    for goal in others:
        assert goal_gap(Problem(model, [goal], space), goal, start).position < 1e-7
    for a, b in combinations(others + goals, 2):
        gap = pair_gap(Problem(model, [a, b], space), a, b, start)
        assert max(gap.position, gap.rotation) < 1e-7
    problem = Problem(model, goals, space)
    for goal in goals:
        gap = goal_gap(problem, goal, start)
        assert max(gap.position, gap.rotation) < 1e-7
        assert not subdivision(problem.only([goal]), start, boxes=3000)
    gap = pair_gap(problem, *goals, start)
    assert max(gap.position, gap.rotation) < 1e-7


@settings(max_examples=150, deadline=None)
@given(trees(), seeds)
def test_no_proof_excludes_a_centre_of_mass_a_mirror_image_or_a_sight_that_some_configuration_has(
    model, seed
):
    rng = np.random.default_rng(seed)
    model = _limited(model, rng)
    space, kinematics = Space(model), Kinematics(model)
    start = space.clip(model.qpos0[None])[0]
    q = space.random(rng, 1, start, np.ones(model.nv, dtype=bool))[0]
    a, b, base = (f"s{k}" for k in rng.integers(0, model.nsite, 3))
    (p, quat), other = ik_cases.pose_of(model, q, a), ik_cases.pose_of(model, q, b)[0]
    axis, far = rng.normal(size=3), rng.uniform(0.1, 5)
    R = rotations.to_matrix(quat)
    goals = [LookAt(a, p + far * R @ axis, axis)]
    if np.linalg.norm(p - other) > 1e-6:  # the mirror plane halfway between two points
        goals.append(Mirror(a, b, p - other, 0.5 * (p + other)))
        seen = Mirror(a, b, axis, other, relative_to=base).rows(kinematics.at(q[None])).r[0]
        at = np.linalg.inv(kinematics.frame(base).pose(q)) @ np.append(p, 1.0)
        of = np.linalg.inv(kinematics.frame(base).pose(q)) @ np.append(other, 1.0)
        assert np.isfinite(seen).all()
        goals.append(Mirror(a, b, (at - of)[:3], 0.5 * (at + of)[:3], relative_to=base))
    try:
        center = kinematics.at(q[None]).center_of_mass()[0][0]
        free = np.add(center, [0, 0, rng.normal()])
        goals += [CenterOfMass(center), CenterOfMass(free, tolerance=(1e-6, 1e-6, np.inf))]
    except ModelError:  # nothing that moves has mass
        pass
    for goal in goals:
        problem = Problem(model, [goal], space)
        gap = goal_gap(problem, goal, start)
        assert max(gap.position, gap.rotation) < 1e-7, goal
        assert not subdivision(problem, start, boxes=1500)


def _balls(lengths):
    """A chain of ball joints of uniform rods, its root above the origin: its centre of mass fills a ball."""
    offsets = [[0, 0, 1], *([length, 0, 0] for length in lengths)]
    links = [(offset, ik_cases.BALL, (0, 0, 1), None) for offset in offsets[:-1]]
    return ik_cases.chain([*links, (offsets[-1], None, None, None)])


def test_a_centre_of_mass_out_of_reach_is_proved_by_what_a_stretched_chain_reaches():
    model = _balls((0.5, 0.4, 0.3))
    q = model.qpos0.copy()
    stretched = Kinematics(model).at(q[None]).center_of_mass()[0][0]  # along x from (0, 0, 1)
    longest = np.linalg.norm(stretched - [0, 0, 1])
    rng = np.random.default_rng(0)
    for beyond in (1e-4, 0.05, 1.0):
        way = ik_cases.unit(rng)
        verdict = solve(model, CenterOfMass([0, 0, 1] + (longest + beyond) * way)).verdict
        assert (verdict.kind, verdict.proved) == ("out of reach", True)
        assert verdict.bound == pytest.approx(beyond, abs=1e-9)
        assert verdict.position == pytest.approx(beyond, abs=1e-6)
        assert solve(model, CenterOfMass([0, 0, 1] + (longest - beyond / 10) * way)).solved
    free = (1e-6, 1e-6, np.inf)  # over a line: the height is free
    verdict = solve(model, CenterOfMass([longest + 0.1, 0, 7], tolerance=free)).verdict
    assert (verdict.kind, verdict.proved) == ("out of reach", True)
    assert verdict.bound == pytest.approx(0.1, abs=1e-9)


def test_mirror_images_and_sights_out_of_reach_are_proved():
    spec = mujoco.MjSpec()
    for side in (1, -1):
        body = spec.worldbody
        for i in range(2):
            body = body.add_body(name=f"b{side}{i}", pos=[0, 0.5 * side, 0] if i == 0 else [0.4, 0, 0])
            body.add_joint(name=f"j{side}{i}", axis=[0, 0, 1])
            body.add_geom(size=[0.02, 0, 0])
        body.add_site(name=f"hand{side}", pos=[0.3, 0, 0])
    model = spec.compile()
    assert solve(model, Mirror("hand1", "hand-1")).solved
    verdict = solve(model, Mirror("hand1", "hand-1", point=[0, 1.2, 0])).verdict
    assert (verdict.kind, verdict.proved) == ("out of reach", True)
    assert verdict.bound == pytest.approx(2.4 - 1.4, abs=1e-9)  # shoulder to mirrored shoulder, two arms long
    assert verdict.position == pytest.approx(2.4 - 1.4, abs=1e-6)
    seen = [5.0, 0.5, 1.0]  # the arm turns in a plane; what it looks at is above
    verdict = solve(model, LookAt("hand1", seen, axis=[1, 0, 0])).verdict
    assert (verdict.kind, verdict.proved) == ("out of reach", True)
    away = 5.0 + 0.4 - 0.3  # the upper arm leads away, the forearm points back at what it sees
    assert verdict.rotation == pytest.approx(np.arctan2(1.0, away), abs=1e-6)


def test_a_sight_held_by_limits_is_proved_by_subdivision():
    links = [
        ([0, 0, 1], ik_cases.HINGE, (0, 0, 1), (-0.5, 0.5)),
        ([0, 0, 0.1], ik_cases.HINGE, (0, 1, 0), (-0.4, 0.4)),
    ]
    model = ik_cases.chain([*links, ([0.1, 0, 0.05], None, None, None)])
    for angle, solved in ((0.4, True), (0.7, False)):
        seen = [4 * np.cos(angle), 4 * np.sin(angle), 1.15]
        solution = solve(model, LookAt("tip", seen, axis=[1, 0, 0]))
        assert solution.solved == solved
        if not solved:
            verdict = solution.verdict
            assert (verdict.kind, verdict.proved) == ("held by limits", True)
            assert verdict.rotation == pytest.approx(angle - 0.5, abs=0.01)


@pytest.mark.parametrize("seed", range(20))
def test_bounds_of_planar_arms_are_attained(seed):
    rng = np.random.default_rng(seed)
    lengths = rng.uniform(0.1, 1.0, rng.integers(2, 6))
    heights, n = rng.normal(size=len(lengths)), len(lengths)
    axes = [(0, 0, rng.choice([-1, 1])) for _ in lengths]
    offsets = [np.zeros(3), *([length, 0, h] for length, h in zip(lengths, heights, strict=True))]
    links = [(offset, ik_cases.HINGE, axis, None) for offset, axis in zip(offsets[:n], axes, strict=True)]
    model = ik_cases.chain([*links, (offsets[n], None, None, None)])
    space, kinematics = Space(model), Kinematics(model)
    moved = np.ones(model.nv, dtype=bool)
    hops = path(kinematics.frame("body:link_0"), kinematics.frame("tip"), space, moved, model.qpos0)
    bounds, height = reach(hops), heights.sum()
    assert bounds.high == pytest.approx(np.hypot(sum(lengths), height))
    assert bounds.low == pytest.approx(np.hypot(max(0.0, 2 * max(lengths) - sum(lengths)), height), abs=1e-12)


@pytest.mark.parametrize("seed", range(30))
def test_closed_forms_list_the_configuration_that_made_the_pose(seed):
    rng = np.random.default_rng(seed)
    unit = ik_cases.unit
    first = [([*rng.normal(size=3) * 0.2], ik_cases.HINGE, unit(rng), None) for _ in range(3)]
    wrist = [([*rng.normal(size=3) * 0.2 * (i == 0)], ik_cases.HINGE, unit(rng), None) for i in range(3)]
    model = ik_cases.chain([*first, *wrist, ([0.1, 0.05, 0.02], None, None, None)])
    q = rng.uniform(-np.pi, np.pi, 6)
    p, quat = ik_cases.pose_of(model, q, "tip")
    problem = Problem(model, [ik_cases.Pose("tip", p, quat)], Space(model))
    form = closed_form(problem, model.qpos0)
    assert form.structure == "spherical wrist"
    assert np.abs(ik_planar.wrap(form.q - q)).max(axis=1).min() < 1e-6
    away = [np.linalg.norm(ik_cases.pose_of(model, x, "tip")[0] - p) for x in form.q]
    assert np.median(away) < 1e-9


def test_subdivision_proves_what_limits_exclude_and_nothing_else():
    rng = np.random.default_rng(5)
    for _ in range(10):
        case = ik_cases.limited_two_links(rng)
        assert subdivision(Problem(case.model, case.goals, Space(case.model)), case.model.qpos0)
    for _ in range(10):
        lengths, ranges = rng.uniform(0.3, 1, 2), [(-1.0, 1.0)] * 2
        model = ik_cases.planar_chain(lengths, ranges)
        tip = ik_planar.forward(lengths, rng.uniform(-1, 1, 2))[-1]
        assert not subdivision(Problem(model, [Position("tip", [*tip, 0])], Space(model)), model.qpos0)


def test_values_beyond_a_turn_are_proved_only_when_nothing_has_them():
    """A joint without limits at 4.2 rad: a box of one turn around zero does not hold it."""
    model = ik_cases.planar_chain((1.0, 0.8))
    q = np.array([0.5, 4.2])
    goals = [Position("tip", [*ik_planar.forward((1.0, 0.8), q)[-1], 0]), ik_cases.JointValue("j1", 4.2)]
    assert not subdivision(Problem(model, goals, Space(model)), model.qpos0)
    assert solve(model, goals).solved
    goals[1] = ik_cases.JointValue("j1", 4.0)
    assert subdivision(Problem(model, goals, Space(model)), model.qpos0)


def test_limits_of_a_wrist_arm_are_proved_by_its_closed_form():
    """All eight solutions known: a range around none of them."""
    model = load_model("arm6")
    q = np.array([0.4, 0.3, -0.7, 0.5, 0.8, -0.3])
    p, quat = ik_cases.pose_of(model, q, "tip")
    goal = ik_cases.Pose("tip", p, quat)
    waists = solve(model, goal, all=True).solutions[:, 0]
    model.jnt_range[0] = waists.max() + 0.1, waists.max() + 0.3
    verdict = solve(model, goal).verdict
    assert (verdict.kind, verdict.proved) == ("held by limits", True)
    assert "waist" in verdict.joints


def test_points_lines_and_planes_that_do_not_meet_are_proved():
    """Of one point: parallel planes, a line along a plane, parallel and skew lines; of two, a link apart."""
    arm = [([0, 0, 1], ik_cases.BALL, (0, 0, 1), None), ([0.5, 0, 0], ik_cases.HINGE, (0, 1, 0), None)]
    model = ik_cases.chain([*arm, ([0.4, 0, 0], None, None, None)])
    x, y, z = np.eye(3)
    floor, line = PointOnPlane("tip", z, z), PointOnLine("tip", [0, 0.2, 1.0], x)
    for goals, far in (
        ([floor, PointOnPlane("tip", 1.25 * z, -z)], 0.25),
        ([PointOnPlane("tip", 1.3 * z + y, z), line], 0.3),
        ([line, PointOnLine("tip", [0.1, 0.2, 1.1], -x)], 0.1),
        ([line, PointOnLine("tip", [0.1, 0.0, 1.1], y)], 0.1),
        ([line, Position("tip", [0.5, 0.2, 1.1])], 0.1),
        ([floor, Position("tip", [0.3, 0.2, 1.2])], 0.2),
        ([PointOnPlane("at1", 0.8 * z, z), PointOnPlane("tip", 1.3 * z, z)], 0.1),  # a link of 0.4 between
    ):
        assert all(solve(model, goal).solved for goal in goals)
        for order in (goals, goals[::-1]):
            verdict = solve(model, order).verdict
            assert (verdict.kind, verdict.proved, len(verdict.goals)) == ("conflict", True, 2)
            assert verdict.bound == pytest.approx(far, abs=1e-12)
    for goals in ([floor, line], [line, PointOnPlane("tip", [0.3, 0, 0], x)]):
        assert solve(model, goals).solved
