"""Goals of frames that see each other: mirror images with their rotation, sight relative to a frame."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from oracles import ik_cases
from oracles.derivatives import assert_derivative
from pantograph.models import ModelError, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import LookAt, Mirror, PointOnLine, PointOnPlane, solve
from pantograph.sim.ik.pose import Kinematics
from pantograph.sim.ik.space import Space
from strategies import random_states, seeds, trees


def _reflected(x, normal, point):
    """Mirror image of points x (..., 3): the foot of the perpendicular lies halfway."""
    n = np.asarray(normal) / np.linalg.norm(normal)
    return x - 2 * ((x - point) @ n)[..., None] * n


def _two(rng):
    """A body on a chain of three hinges and one that floats, with skew frames."""
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for i in range(3):
        body = body.add_body(name=f"link{i}", pos=0.3 * rng.normal(size=3), quat=_quat(rng))
        body.add_joint(name=f"hinge{i}", axis=rng.normal(size=3))
        body.add_geom(size=[0.05, 0, 0])
    body.add_site(name="of", pos=rng.normal(size=3), quat=_quat(rng))
    free = spec.worldbody.add_body(name="floating", quat=_quat(rng))
    free.add_freejoint(name="float")
    free.add_geom(size=[0.05, 0, 0])
    free.add_site(name="at", pos=rng.normal(size=3), quat=_quat(rng))
    trunk = spec.worldbody.add_body(name="trunk", pos=rng.normal(size=3), quat=_quat(rng))
    trunk.add_geom(size=[0.05, 0, 0])
    return spec.compile()


def _quat(rng):
    return rotations.normalize(rng.normal(size=4))


def _frame_in(model, q, name, base):
    p, quat = ik_cases.pose_of(model, q, name)
    R = rotations.to_matrix(quat)
    if base is None:
        return np.asarray(p), R
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_kinematics(model, data)
    Rb, pb = data.body(base).xmat.reshape(3, 3), data.body(base).xpos
    return Rb.T @ (p - pb), Rb.T @ R


@settings(max_examples=25, deadline=None)
@given(seeds)
@pytest.mark.parametrize("relative", [False, True])
def test_points_of_a_mirrored_frame_are_mirror_images_of_the_points_of_the_other(relative, seed):
    """Law: what is fixed in one frame at x meets, mirrored, what is fixed in the other at x flipped."""
    rng = np.random.default_rng(seed)
    model, base = _two(rng), "trunk" if relative else None
    normal, point, flip = rng.normal(size=3), rng.normal(size=3), rng.normal(size=3)
    q0 = model.qpos0.copy()
    q0[:3] = rng.uniform(-2, 2, 3)
    goal = Mirror("at", "of", normal, point, base and "body:trunk", "pose", flip)
    solution = solve(model, goal, q0=q0, joints=["float"])
    assert solution.solved
    p_of, R_of = _frame_in(model, solution.q, "of", base)
    p_at, R_at = _frame_in(model, solution.q, "at", base)
    x = rng.normal(size=(4, 3))
    flipped = _reflected(x, flip, np.zeros(3))
    np.testing.assert_allclose(
        p_at + flipped @ R_at.T, _reflected(p_of + x @ R_of.T, normal, point), atol=1e-5
    )


def test_mirrored_arms_of_the_puppet_have_mirrored_joints():
    """The puppet is symmetric: its left arm mirrors the right one when all joints do."""
    model, rng = load_model("puppet"), np.random.default_rng(1)
    q = model.qpos0.copy()
    sides = [(model.joint(j).name, model.joint(j).name.replace("right", "left")) for j in range(model.njnt)]
    pairs = [(a, b) for a, b in sides if a.startswith("right") and a != b and "hip" not in a]
    goal = Mirror("left_hand", "right_hand", what="pose")
    kinematics = Kinematics(model)
    for _ in range(5):
        for right, left in pairs:
            i, j = model.joint(right), model.joint(left)
            value = rng.uniform(*model.jnt_range[i.id])
            # hinges along the normal turn alike on both sides, those in the plane the other way
            same = np.sign(i.axis[1] * j.axis[1] - i.axis[0] * j.axis[0] - i.axis[2] * j.axis[2])
            q[i.qposadr[0]], q[j.qposadr[0]] = value, same * value
        np.testing.assert_allclose(goal.rows(kinematics.at(q[None])).r, 0, atol=1e-12)


@settings(max_examples=15, deadline=None)
@given(trees(), seeds)
def test_jacobians_are_derivatives(model, seed):
    rng = np.random.default_rng(seed)
    q = random_states(model, seed, 2)[0]
    a, b, c = (f"s{k}" for k in rng.integers(0, model.nsite, 3))
    x, y, z = rng.normal(size=(3, 3))
    goals = [
        Mirror(a, b, x, y, c, "pose", z),
        Mirror(a, b, x, y, None, "orientation"),
        LookAt(a, 5 * x, y, relative_to=b),
    ]
    space, kinematics = Space(model, limits=False), Kinematics(model)
    for goal in goals:
        if np.abs(goal.rows(kinematics.at(q)).r[:, -3:]).max() > 2.8:  # a turn by almost pi jumps
            continue
        assert_derivative(lambda x, goal=goal: goal.rows(kinematics.at(x)), space, q)


@settings(max_examples=15, deadline=None)
@given(trees(), seeds)
def test_sight_of_a_frames_point_is_that_of_the_point_in_the_world(model, seed):
    rng = np.random.default_rng(seed)
    q = random_states(model, seed, 1)[0]
    a, b = (f"s{k}" for k in rng.integers(0, model.nsite, 2))
    p, quat = ik_cases.pose_of(model, q[0], b)
    x, axis = rng.normal(size=(2, 3))
    there = p + rotations.to_matrix(quat) @ x
    kinematics = Kinematics(model)
    one, two = LookAt(a, x, axis, relative_to=b), LookAt(a, there, axis)
    np.testing.assert_allclose(
        one.rows(kinematics.at(q)).r, two.rows(kinematics.at(q)).r, atol=1e-7 * (1 + np.abs(there).max())
    )


@settings(max_examples=15, deadline=None)
@given(trees(), seeds)
def test_lines_and_planes_of_a_frame_are_those_of_the_world_turned_and_moved_with_it(model, seed):
    rng = np.random.default_rng(seed)
    q = random_states(model, seed, 1)[0]
    a, b = (f"s{k}" for k in rng.integers(0, model.nsite, 2))
    (p, quat), (x, y) = ik_cases.pose_of(model, q[0], b), rng.normal(size=(2, 3))
    R, kinematics = rotations.to_matrix(quat), Kinematics(model)
    for kind in (PointOnLine, PointOnPlane):
        one, two = kind(a, x, y, relative_to=b), kind(a, p + R @ x, R @ y)
        far = [np.linalg.norm(goal.rows(kinematics.at(q)).r) for goal in (one, two)]
        assert far[0] == pytest.approx(far[1], abs=1e-7 * (1 + far[1]))


def test_a_mirror_of_nothing_is_a_mistake():
    with pytest.raises(ModelError, match="orientation or the pose"):
        Mirror("at", "of", what="colour")
