"""Inverse kinematics: verdicts against truths known by construction, laws of answers, hard cases."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import ik_cases, ik_planar
from oracles.derivatives import assert_derivative
from pantograph.models import ModelError, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import (
    CenterOfMass,
    Distance,
    JointValue,
    LookAt,
    Mirror,
    Orientation,
    PointOnLine,
    PointOnPlane,
    Pose,
    Position,
    Posture,
    solve,
)
from pantograph.sim.ik.animate import Pole, Spread
from pantograph.sim.ik.pose import Kinematics
from pantograph.sim.ik.space import Space
from strategies import random_states, seeds, trees

FAMILIES = [*ik_cases.REACHABLE, *ik_cases.BEYOND, *ik_cases.LIMITED, *ik_cases.CONFLICT]


@pytest.mark.parametrize("family", FAMILIES, ids=lambda f: f.__name__)
@pytest.mark.parametrize("index", range(2))
def test_verdicts_are_true(family, index):
    case = family(np.random.default_rng([index, 77]))
    solution = solve(case.model, case.goals)
    assert ik_cases.mistakes(case, solution) == []
    if case.kind == "solved":
        assert all(r.met for r in solution.residuals)


@settings(max_examples=15, deadline=None)
@given(trees(), seeds)
def test_answers_are_finite_and_within_limits_whatever_is_asked(model, seed):
    rng = np.random.default_rng(seed)
    for j in range(model.njnt):
        if model.jnt_type[j] != mujoco.mjtJoint.mjJNT_FREE and rng.random() < 0.6:
            model.jnt_limited[j] = 1
            half = rng.uniform(0.1, 2.5)
            model.jnt_range[j] = (
                (0, half) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL else (-half, half)
            )
    site = f"s{rng.integers(model.nsite)}"
    far = 10.0 ** rng.integers(-3, 4)
    goals = [Pose(site, far * rng.normal(size=3), rng.normal(size=4)), Position("s0", rng.normal(size=3))]
    solution = solve(model, goals[: rng.integers(1, 3)], restarts=12, seed=int(rng.integers(100)))
    assert ik_cases.illegal(model, solution.q) == []
    assert solution.solved == all(r.met for r in solution.residuals)
    for j in np.flatnonzero((model.jnt_type == int(mujoco.mjtJoint.mjJNT_HINGE)) & (model.jnt_limited == 0)):
        at = model.jnt_qposadr[j]
        assert abs(solution.q[at] - model.qpos0[at]) <= np.pi + 1e-9


@settings(max_examples=25, deadline=None)
@given(trees(joints=("ball", "slide", "hinge")), seeds)
def test_a_pose_that_some_configuration_has_is_found(model, seed):
    q = random_states(model, seed, 1)[0][0]
    goals = [Position(f"s{k}", ik_cases.pose_of(model, q, f"s{k}")[0]) for k in range(min(2, model.nsite))]
    assert solve(model, goals).solved


@settings(max_examples=10, deadline=None)
@given(trees(), seeds)
def test_jacobians_of_goals_are_their_derivatives(model, seed):
    rng = np.random.default_rng(seed)
    q = random_states(model, seed, 2)[0]
    a, b = (f"s{k}" for k in rng.integers(0, model.nsite, 2))
    x, y, quat = rng.normal(size=3), rng.normal(size=3), rng.normal(size=4)
    goals = [
        Position(a, x), Position(a, x, relative_to=b), Orientation(a, quat),
        Pose(a, x, quat, relative_to="s0"),
        LookAt(a, 5 * x, axis=y), PointOnLine(a, x, y), PointOnPlane(a, x, y), Distance(a, 3 * x, 1.0),
        PointOnLine(a, x, y, b), PointOnPlane(a, x, y, b),
        Posture(model.qpos0), Mirror(a, "s0", y, x, relative_to=b), Pole(a, "s0", b, x),
    ]  # fmt: skip
    if model.nv:
        goals.append(CenterOfMass(x))
    space, kinematics = Space(model, limits=False), Kinematics(model)
    for goal in goals:
        try:
            J = goal.rows(kinematics.at(q)).J
        except ModelError:  # nothing that moves has mass
            continue
        assert_derivative(lambda x, goal=goal: goal.rows(kinematics.at(x)), space, q)
        np.testing.assert_allclose(goal.rows(kinematics.at(q[:1])).J, J[:1], atol=1e-9)


def test_the_planar_arm_of_the_notes():
    model = ik_cases.planar_chain([1.0, 0.8])
    solution = solve(model, Position("tip", [1.2, 0.7, 0]), all=True)
    truth = ik_planar.two_links((1.0, 0.8), (1.2, 0.7))
    assert len(solution.solutions) == 2
    found = solution.solutions[np.argsort(solution.solutions[:, 1])[::-1]]
    np.testing.assert_allclose(found, truth, atol=1e-12)
    np.testing.assert_allclose(truth[0], [-0.0739531788805312790, 1.38853897167576753], atol=1e-15)
    for target, gap in (((2, 0, 0), 0.2), ((0.1, 0, 0), 0.1)):
        verdict = solve(model, Position("tip", target)).verdict
        assert (verdict.kind, verdict.proved) == ("out of reach", True)
        assert verdict.position == pytest.approx(gap, abs=1e-9)
        assert verdict.bound == pytest.approx(gap, abs=1e-9)
    assert solve(model, Position("tip", (1.8, 0, 0))).solved


@pytest.mark.parametrize("beyond", [1e-12, 1e-7, 1e-5, 1e-3])
def test_no_near_miss_passes_for_solved(beyond):
    model = ik_cases.planar_chain([1.0, 0.8])
    solution = solve(model, Position("tip", (1.8 + beyond, 0, 0)))
    assert solution.solved == (beyond < 1e-6)
    if not solution.solved:
        assert solution.verdict.position == pytest.approx(beyond, rel=1e-3)


def test_pose_met_only_apart_tells_both_distances():
    """A 2R arm at a point has two headings; keeping another heading, its wrist circle misses the point."""
    lengths, q = (1.0, 0.8), np.array([0.3, 1.1])
    tip = ik_planar.forward(lengths, q)[-1]
    heading = q.sum() + 0.2
    verdict = solve(ik_cases.planar_chain(lengths), Pose("tip", [*tip, 0], ik_cases.quat_z(heading))).verdict
    assert verdict.kind == "out of reach"
    others = ik_planar.two_links(lengths, tip).sum(axis=1)
    assert verdict.rotation == pytest.approx(np.abs(ik_planar.wrap(others - heading)).min(), abs=1e-6)
    wrist = tip - lengths[1] * np.array([np.cos(heading), np.sin(heading)])
    assert verdict.position == pytest.approx(abs(np.hypot(*wrist) - lengths[0]), abs=1e-6)


def test_wishes_give_way_to_hard_goals_and_are_met_as_well_as_possible():
    lengths = (1.0, 0.8, 0.5)
    model = ik_cases.planar_chain(lengths)
    target = (1.1, 0.6)
    solution = solve(model, [Position("tip", [*target, 0]), JointValue("j0", 0.9, weight=1.0)])
    assert solution.solved
    assert solution.residuals[0].position < 1e-9
    # j0 can be 0.9 exactly: the rest of the arm still reaches the point from there
    assert np.hypot(*(target - ik_planar.forward(lengths[:1], [0.9])[-1])) < 1.3
    assert solution.q[0] == pytest.approx(0.9, abs=1e-6)
    # farther than it can be: as near as the hard goal allows, which is where the other two stand stretched
    solution = solve(model, [Position("tip", [2.2, 0, 0]), JointValue("j0", 1.5, weight=1.0)])
    a, b, d = 1.0, 1.3, 2.2
    assert solution.q[0] == pytest.approx(np.arccos((a * a + d * d - b * b) / (2 * a * d)), abs=1e-4)


def test_near_means_nearest_to_the_start():
    lengths = (1.0, 0.8)
    model = ik_cases.planar_chain(lengths)
    for truth in ik_planar.two_links(lengths, (0.9, 0.7)):
        solution = solve(model, Position("tip", [0.9, 0.7, 0]), q0=np.add(truth, [0.2, -0.1]))
        np.testing.assert_allclose(solution.q, truth, atol=1e-9)


def test_middle_prefers_the_middle_of_the_ranges():
    model = ik_cases.planar_chain((1.0, 0.8, 0.6), [(-2, 2)] * 3)
    goal = Position("tip", [1.2, 0.9, 0])
    near, middle = (solve(model, goal, q0=[1.6, -1.5, 1.9], prefer=p) for p in ("near", "middle"))
    assert near.solved and middle.solved
    assert np.sum(middle.q**2) < np.sum(near.q**2) - 0.1
    best = np.inf  # along the whole self-motion, by the first joint and the closed form of the rest
    for first in np.linspace(-2, 2, 4001):
        rest = np.array([1.2, 0.9]) - [np.cos(first), np.sin(first)]
        turned = [[np.cos(first), np.sin(first)], [-np.sin(first), np.cos(first)]] @ rest
        if 0.2 < np.hypot(*rest) < 1.4:
            for pair in ik_planar.two_links((0.8, 0.6), turned):
                if np.abs(pair).max() <= 2:
                    best = min(best, first**2 + np.sum(pair**2))
    assert np.sum(middle.q**2) == pytest.approx(best, abs=1e-4)


def test_tolerances_leave_room_per_axis():
    model = ik_cases.planar_chain((1.0, 0.8))
    high = Position("tip", [1.2, 0.3, 0.5], tolerance=(1e-6, 1e-6, np.inf))
    assert solve(model, high).solved
    spun = Pose("tip", [*ik_planar.forward((1.0, 0.8), [0.3, 0.5])[-1], 0], ik_cases.quat_z(2.0),
                tolerance=(1e-6, 1e-6, 1e-6, 1e-6, 1e-6, np.inf))  # fmt: skip
    assert solve(model, spun).solved
    band = Position("tip", [1.85, 0, 0], tolerance=(0.1, 1e-6, 1e-6))
    assert solve(model, band).solved
    assert not solve(model, Position("tip", [1.85, 0, 0], tolerance=(0.04, 1e-6, 1e-6))).solved


def test_pinned_feet_and_the_centre_of_mass_of_a_free_puppet():
    model = load_model("puppet")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    feet = [Position(f"{side}_foot", data.site(f"{side}_foot").xpos.copy()) for side in ("left", "right")]
    hand = np.add(data.site("left_hand").xpos, [0.12, 0.02, 0.1])
    middle = 0.5 * (feet[0].target + feet[1].target)
    com = CenterOfMass([middle[0], middle[1], 0.0], tolerance=(1e-6, 1e-6, np.inf))
    solution = solve(model, [*feet, Position("left_hand", hand), com])
    assert solution.solved
    data.qpos[:] = solution.q
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("left_hand").xpos, hand, atol=1e-6)
    np.testing.assert_allclose(data.subtree_com[0][:2], middle[:2], atol=1e-6)


def test_mirror_line_plane_and_sight():
    model = load_model("puppet")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    hand, seen = np.add(data.site("right_hand").xpos, [0.15, -0.05, 0.2]), np.array([1.0, -0.3, 0.8])
    goals = [Position("right_hand", hand), Mirror("left_hand", "right_hand"),
             LookAt("gaze", seen, axis=(1, 0, 0), tolerance=1e-5)]  # fmt: skip
    joints = [model.joint(j).name for j in range(model.njnt) if model.joint(j).name != "root"]
    solution = solve(model, goals, joints=joints)
    assert solution.solved
    data.qpos[:] = solution.q
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.site("left_hand").xpos, hand * [1, -1, 1], atol=1e-6)
    sight = seen - data.site("gaze").xpos
    np.testing.assert_allclose(
        data.site("gaze").xmat.reshape(3, 3)[:, 0], sight / np.linalg.norm(sight), atol=2e-5
    )
    np.testing.assert_array_equal(solution.q[:7], model.qpos0[:7])


def test_all_lists_every_solution_of_a_wrist_arm():
    model = load_model("arm6")
    q = np.array([0.4, 0.3, -0.7, 0.5, 0.8, -0.3])
    p, quat = ik_cases.pose_of(model, q, "tip")
    found = solve(model, Pose("tip", p, quat), all=True).solutions
    assert any(np.allclose(x, q, atol=1e-6) for x in found)
    flipped = np.add(
        q, [0, 0, 0, np.pi * (-1 if q[3] > 0 else 1), -2 * q[4], np.pi]
    )  # the wrist's other solution
    assert any(np.allclose(ik_planar.wrap(x - flipped), 0, atol=1e-6) for x in found)
    for x in found:
        np.testing.assert_allclose(ik_cases.pose_of(model, x, "tip")[0], p, atol=1e-9)


def test_spread_shares_a_bow_among_vertebrae():
    links = [([0, 0, 0.2 * (i > 0)], ik_cases.HINGE, (0, 1, 0), (-1, 1)) for i in range(4)]
    model = ik_cases.chain([*links, ([0, 0, 0.2], None, None, None)])
    solution = solve(model, [Orientation("tip", [np.cos(0.4), 0, np.sin(0.4), 0]),
                             Spread(("j0", "j1", "j2", "j3"), (1, 2, 3, 2), weight=1.0)])  # fmt: skip
    np.testing.assert_allclose(solution.q, 0.8 * np.array([1, 2, 3, 2]) / 8, atol=1e-5)


def test_mistakes_are_told_in_words():
    model = load_model("arm6")
    with pytest.raises(ModelError, match="tip"):
        solve(model, Position("tipp", [0, 0, 0]))
    with pytest.raises(ModelError, match="3 finite numbers"):
        Position("tip", [0, 0])
    with pytest.raises(ModelError, match="at least one goal"):
        solve(model, [])
    with pytest.raises(ModelError, match="elbow"):
        solve(model, Position("tip", [0, 0, 0]), joints=["elbo"])
    with pytest.raises(ModelError, match="zero"):
        Orientation("tip", [0, 0, 0, 0])
    with pytest.raises(ModelError, match="6 finite numbers"):
        solve(model, Position("tip", [0, 0, 0]), q0=[0, 1])
    with pytest.raises(ModelError, match="manipulability"):
        solve(model, Position("tip", [0, 0, 0]), prefer="manipulable")


@settings(max_examples=40, deadline=None)
@given(seeds, st.integers(1, 6))
def test_steps_and_differences_are_inverse(seed, _):
    model = load_model("puppet")
    q, v, _ = random_states(model, seed, 3)
    space = Space(model, limits=False)
    d = np.clip(v, -1, 1)
    np.testing.assert_allclose(space.difference(space.step(q, d), space.clip(q)), d, atol=1e-9)
    truth = q.copy()
    for row, step in zip(truth, d, strict=True):
        mujoco.mj_integratePos(model, row, step, 1.0)
    np.testing.assert_allclose(space.step(q, d), truth, atol=1e-9)
    assert rotations.normalize(q[:, 3:7]).shape == (3, 4)


def _three_links_beside_a_post():
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    for i, length in enumerate((0.6, 0.5, 0.4)):
        body = body.add_body(name=f"b{i}", pos=[(0, 0.6, 0.5)[i], 0, 0])
        body.add_joint(name=f"j{i}", type=ik_cases.HINGE, axis=[0, 0, 1], range=[-2.5, 2.5], limited=True)
        ends = [0, 0, 0, length, 0, 0]
        body.add_geom(name=f"g{i}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[0.03, 0, 0])
    body.add_site(name="tip", pos=[0.4, 0, 0])
    spec.worldbody.add_geom(
        name="post", type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.05, 0, 0], pos=[0.62, 0.05, 0]
    )
    return spec.compile()


def test_clear_keeps_away_from_obstacles():
    model = _three_links_beside_a_post()
    data, goal, q0 = mujoco.MjData(model), Position("tip", [0.8, 0.7, 0]), [0.3, 0.5, 0.4]
    pairs = [(f"g{i}", "post") for i in range(3)]

    def distance(q):
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        return min(mujoco.mj_geomDistance(model, data, i, model.geom("post").id, 1.0, np.zeros(6)) for i in
                   (model.geom(f"g{k}").id for k in range(3)))  # fmt: skip

    near, clear = solve(model, goal, q0=q0), solve(model, goal, q0=q0, prefer="clear", obstacles=pairs)
    assert near.solved and clear.solved
    assert distance(near.q) < 0.05
    assert distance(clear.q) > 0.09


def test_manipulability_is_the_greatest_of_the_self_motion():
    lengths = (1.0, 0.8, 0.6)
    model = ik_cases.planar_chain(lengths, [(-2.8, 2.8)] * 3)
    solution = solve(model, Position("tip", [1.2, 0.9, 0]), q0=[0.1, 0.9, 0.2], prefer="manipulability")

    def manipulability(q):
        points = ik_planar.forward(lengths, q)
        J = np.array([[-(points[-1] - p)[1], (points[-1] - p)[0]] for p in points[:-1]]).T
        return np.sqrt(np.linalg.det(J @ J.T))

    best = 0.0
    for first in np.linspace(-2.8, 2.8, 2001):
        rest = np.array([1.2, 0.9]) - [np.cos(first), np.sin(first)]
        turned = [[np.cos(first), np.sin(first)], [-np.sin(first), np.cos(first)]] @ rest
        if 0.2 < np.hypot(*rest) < 1.4:
            pairs = [p for p in ik_planar.two_links(lengths[1:], turned) if np.abs(p).max() <= 2.8]
            best = max([best, *(manipulability([first, *p]) for p in pairs)])
    assert manipulability(solution.q) == pytest.approx(best, rel=2e-3)
