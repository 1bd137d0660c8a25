"""Closed loops: a four-bar against its closed form, a Stewart platform, coupled joints, welds."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import ik_cases, ik_loops, ik_planar
from pantograph.models import data_robots, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import JointValue, Loops, Pose, Position, solve
from pantograph.sim.kinematics import frame
from strategies import seeds

FOUR_BAR = ik_loops.four_bar()
STEWART, ANCHORS = ik_loops.stewart()


@settings(max_examples=40, deadline=None)
@given(st.floats(-np.pi, np.pi))
def test_a_four_bar_closes_on_its_closed_form(angle):
    both = ik_loops.four_bar_angles(angle)
    guess = both[0] + [0.1, -0.1]
    found = Loops(FOUR_BAR).project([angle, *guess], held=[True, False, False])
    assert found.closed and found.open < 1e-12
    assert found.q[0] == angle
    np.testing.assert_allclose(ik_planar.wrap(found.q[1:] - both[0]), 0, atol=1e-11)


@settings(max_examples=15, deadline=None)
@given(seeds)
def test_a_stewart_platform_closes_with_the_lengths_of_its_legs(seed):
    rng = np.random.default_rng(seed)
    q, quat = STEWART.qpos0.copy(), rotations.exp(0.15 * rng.normal(size=3))
    q[:3] += 0.08 * rng.normal(size=3)
    q[3:7] = quat
    held = np.zeros(STEWART.nv, dtype=bool)
    held[:6] = True
    found = Loops(STEWART).project(q, held=held)
    assert found.open < 1e-12
    np.testing.assert_array_equal(found.q[:3], q[:3])
    rest = ik_loops.leg_lengths(ANCHORS, np.eye(3), [0, 0, 1])
    truth = ik_loops.leg_lengths(ANCHORS, rotations.to_matrix(quat), q[:3]) - rest
    slides = [found.q[STEWART.joint(f"s{i}").qposadr[0]] for i in range(6)]
    np.testing.assert_allclose(slides, truth, atol=1e-12)
    data = mujoco.MjData(STEWART)
    data.qpos[:] = found.q
    mujoco.mj_forward(STEWART, data)
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-12


def test_goals_on_closed_loops_are_solved_closed():
    p, quat = np.array([0.05, -0.04, 1.1]), rotations.exp([0.1, -0.05, 0.2])
    solution = solve(STEWART, Pose("plate", p, quat))
    assert solution.solved
    assert max(r.position for r in solution.residuals) < 1e-12
    assert ik_cases.illegal(STEWART, solution.q) == []
    turned = solve(FOUR_BAR, JointValue("rocker", 2.0), q0=[1.0, 0.2, 1.5])
    assert turned.solved
    assert np.abs(ik_planar.wrap(ik_loops.four_bar_angles(turned.q[0])[:, 1] - 2.0)).min() < 1e-9


def test_a_rocker_beyond_its_dead_centre_is_out_of_reach():
    """The rocker of a crank-rocker swings between the stretched and the folded crank and coupler."""
    ground, crank, coupler, rocker = ik_loops.GROUND, ik_loops.CRANK, ik_loops.COUPLER, ik_loops.ROCKER
    far = crank + coupler
    dead = np.pi - np.arccos((ground**2 + rocker**2 - far**2) / (2 * ground * rocker))
    assert solve(FOUR_BAR, JointValue("rocker", dead + 1e-3), q0=[0.5, 0.3, 1.3]).solved
    solution = solve(FOUR_BAR, JointValue("rocker", dead - 0.05), q0=[0.5, 0.3, 1.3])
    assert solution.verdict.kind == "out of reach"


def test_the_projection_is_nearest_in_the_metric_of_the_mass_matrix():
    q = np.array([0.7, *ik_loops.four_bar_angles(0.7)[0]])
    v = np.array([1.0, -0.3, 0.4])
    loops = Loops(FOUR_BAR)
    rng = np.random.default_rng(0)
    L = rng.normal(size=(3, 3))
    M = L @ L.T + 0.1 * np.eye(3)
    along = loops.tangent(q, v, metric=M)
    J = loops.rows(q[None]).J[0]
    np.testing.assert_allclose(J @ along, 0, atol=1e-12)
    closed = loops.project(np.add(q, [0, 1e-6, 0]), metric=M, held=[True, False, False])
    assert closed.q[0] == q[0] and closed.open < 1e-12
    free = np.linalg.svd(J)[2][-1]  # a four-bar has one freedom
    assert free @ M @ (along - v) == pytest.approx(0, abs=1e-12)


def test_coupled_joints_follow_their_polynomial():
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    for i in range(3):
        body = body.add_body(name=f"b{i}", pos=[0.3 * (i > 0), 0, 0])
        body.add_joint(name=f"j{i}", type=ik_cases.HINGE, axis=[0, 0, 1], ref=0.1 * i)
        body.add_geom(size=[0.01, 0, 0], mass=1, contype=0, conaffinity=0)
    body.add_site(name="tip", pos=[0.2, 0, 0])
    tie = spec.add_equality(name="tie", type=mujoco.mjtEq.mjEQ_JOINT, name1="j2", name2="j1")
    tie.data[:5] = [0.05, 0.7, 0.1, 0, 0]
    model = spec.compile()
    q = np.array([0.4, 0.9, 0.0])
    q[2] = 0.2 + np.polyval([0.1, 0.7, 0.05], q[1] - 0.1)
    solution = solve(model, Position("tip", frame(model, "site", "tip").pose(q)[:3, 3]), q0=[0.3, 0.7, 0])
    np.testing.assert_allclose(solution.q, q, atol=1e-9)


def test_what_cannot_close_says_how_far_it_stays_open():
    model = ik_loops.four_bar((3.0, 0.3, 0.9, 0.7))
    found = Loops(model).project([0.1, 0.2, 0.3])
    assert not found.closed
    assert found.open > 0.5
    assert np.isfinite(found.q).all()


def test_welds_hold_pose_and_bodies():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body name="a"><joint type="free"/><geom size=".1" mass="1"/></body>
      <body name="b" pos="1 0 0"><joint name="h" axis="0 0 1"/><geom size=".1" mass="1"/></body>
    </worldbody><equality>
      <weld body1="a" body2="b" anchor="0.1 0.2 0.3" relpose="0.3 0 0 0.8 0.6 0 0"/></equality>
    </mujoco>""")
    q = model.qpos0.copy()
    q[7] = 0.8
    q[:3] += 0.1
    found = Loops(model).project(q)
    data = mujoco.MjData(model)
    data.qpos[:] = found.q
    mujoco.mj_forward(model, data)
    assert found.open < 1e-12
    assert np.abs(data.efc_pos[: data.ne]).max() < 1e-11


@pytest.mark.skipif("wx250s" not in data_robots(), reason="the data folder with wx250s is absent")
def test_the_fingers_of_a_real_gripper_move_together():
    model = load_model("wx250s")
    solution = solve(model, JointValue("left_finger", 0.03))
    assert solution.solved
    right = solution.q[model.joint("right_finger").qposadr[0]]
    assert right == pytest.approx(-0.03, abs=1e-9)
