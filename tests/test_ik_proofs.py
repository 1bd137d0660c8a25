"""Proofs of inverse kinematics: bounds hold at every configuration, and planar ones are attained."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from oracles import ik_cases, ik_planar
from pantograph.sim.ik import Distance, PointOnLine, PointOnPlane, Position, solve
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
    for goal in others:
        assert goal_gap(Problem(model, [goal], space), goal, start).position < 1e-7
    problem = Problem(model, goals, space)
    for goal in goals:
        gap = goal_gap(problem, goal, start)
        assert max(gap.position, gap.rotation) < 1e-7
        assert not subdivision(problem.only([goal]), start, boxes=3000)
    gap = pair_gap(problem, *goals, start)
    assert max(gap.position, gap.rotation) < 1e-7


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
    from pantograph.models import load_model

    model = load_model("arm6")
    q = np.array([0.4, 0.3, -0.7, 0.5, 0.8, -0.3])
    p, quat = ik_cases.pose_of(model, q, "tip")
    goal = ik_cases.Pose("tip", p, quat)
    waists = solve(model, goal, all=True).solutions[:, 0]
    model.jnt_range[0] = waists.max() + 0.1, waists.max() + 0.3
    verdict = solve(model, goal).verdict
    assert (verdict.kind, verdict.proved) == ("held by limits", True)
    assert "waist" in verdict.joints
