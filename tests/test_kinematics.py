import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from pantograph.sim.errors import ModelError
from pantograph.sim.kinematics import frame
from strategies import random_states, seeds, trees

laws = settings(deadline=None, max_examples=60)
DATA = Path(os.environ.get("PANTOGRAPH_DATA", Path(__file__).parents[2] / "shared" / "data"))
OBJECT = {
    "body": mujoco.mjtObj.mjOBJ_XBODY,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "camera": mujoco.mjtObj.mjOBJ_CAMERA,
}
POSE = {
    "body": ("xpos", "xmat"),
    "site": ("site_xpos", "site_xmat"),
    "geom": ("geom_xpos", "geom_xmat"),
    "camera": ("cam_xpos", "cam_xmat"),
}
JACOBIAN = {"body": mujoco.mj_jacBody, "site": mujoco.mj_jacSite, "geom": mujoco.mj_jacGeom}


def frames_of(model):
    for kind, count in (("body", model.nbody), ("site", model.nsite), ("geom", model.ngeom)):
        for i in range(count):
            name = getattr(model, kind)(i).name
            if name:
                yield kind, i, name


def mujoco_pose(model, data, kind, i):
    position, matrix = (getattr(data, field)[i] for field in POSE[kind])
    X = np.eye(4)
    X[:3, :3], X[:3, 3] = matrix.reshape(3, 3), position
    return X


def compare_with_mujoco(model, seed, n=3):
    """Pose, Jacobian, velocity and acceleration of all named frames, at rounding level for their size."""
    q, v, a = random_states(model, seed, n)
    model.opt.gravity[:] = 0  # else MuJoCo's accelerations are those of a frame that falls
    data = mujoco.MjData(model)
    frames = [(kind, i, frame(model, kind, name)) for kind, i, name in frames_of(model)]
    ours = [(f.pose(q), f.jacobian(q), f.velocity(q, v), f.acceleration(q, v, a)) for _, _, f in frames]
    for k in range(n):
        data.qpos[:], data.qvel[:] = q[k], v[k]
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        data.qacc[:] = a[k]
        mujoco.mj_rnePostConstraint(model, data)
        size = 1 + np.abs(data.xpos).max() + np.abs(data.geom_xpos).max()
        for (kind, i, f), (X, J, rate, second) in zip(frames, ours, strict=True):
            np.testing.assert_allclose(X[k], mujoco_pose(model, data, kind, i), rtol=0, atol=1e-13 * size)
            J_mujoco = np.zeros((6, model.nv))
            JACOBIAN[kind](model, data, J_mujoco[3:], J_mujoco[:3], i)
            np.testing.assert_allclose(J[k], J_mujoco, rtol=0, atol=1e-13 * size)
            moving = np.flatnonzero(np.abs(J_mujoco).max(axis=0) > 0)
            assert set(moving) <= set(f.dofs)
            expected = np.zeros(6)
            mujoco.mj_objectVelocity(model, data, OBJECT[kind], i, expected, 0)
            speed = 1 + np.abs(v[k]).sum()
            np.testing.assert_allclose(rate[k], expected, rtol=0, atol=1e-13 * size * speed)
            mujoco.mj_objectAcceleration(model, data, OBJECT[kind], i, expected, 0)
            np.testing.assert_allclose(second[k], expected, rtol=0, atol=1e-12 * size * speed**2)


@laws
@given(trees(), seeds)
def test_every_frame_of_a_random_tree_agrees_with_mujoco(model, seed):
    compare_with_mujoco(model, seed)


@pytest.mark.parametrize("robot", ["humanoid/humanoid.xml", "trossen_wx250s/wx250s.xml"])
def test_every_frame_of_a_real_robot_agrees_with_mujoco(robot):
    path = DATA / "robots" / robot
    if not path.is_file():
        pytest.skip(f"no {path}: set PANTOGRAPH_DATA to the data folder")
    compare_with_mujoco(mujoco.MjModel.from_xml_path(str(path)), seed=1, n=20)


@laws
@given(trees(), seeds)
def test_rates_are_the_derivatives_of_mujocos_poses(model, seed):
    """Along q(t) = q ⊕ (v t + a t²/2), which has velocity v and acceleration a at t = 0."""
    q, v, a = (x[0] for x in random_states(model, seed, 1))
    h = 1e-3
    offsets, data = np.arange(-3, 4), mujoco.MjData(model)
    names = list(frames_of(model))
    X = np.empty((7, len(names), 4, 4))
    for k, t in enumerate(offsets * h):
        data.qpos[:] = q
        mujoco.mj_integratePos(model, data.qpos, v * t + 0.5 * a * t**2, 1.0)
        mujoco.mj_kinematics(model, data)
        X[k] = [mujoco_pose(model, data, kind, i) for kind, i, _ in names]
    # Sixth-order central differences.
    dX = np.tensordot([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60], X, 1) / h
    ddX = np.tensordot([1 / 90, -3 / 20, 3 / 2, -49 / 18, 3 / 2, -3 / 20, 1 / 90], X, 1) / h**2
    for k, (kind, _, name) in enumerate(names):
        R, dR, ddR = X[3, k, :3, :3], dX[k, :3, :3], ddX[k, :3, :3]
        W, dW = dR @ R.T, ddR @ R.T + dR @ dR.T
        f = frame(model, kind, name)
        rate = np.array([W[2, 1], W[0, 2], W[1, 0], *dX[k, :3, 3]])
        second = np.array([dW[2, 1], dW[0, 2], dW[1, 0], *ddX[k, :3, 3]])
        size = (1 + np.abs(X[3, k, :3, 3]).max()) * (1 + np.abs(v).sum()) ** 2
        # rounding of the differences: eps/h and eps/h^2; truncation: h^6 times eight powers of the speed
        np.testing.assert_allclose(f.velocity(q, v), rate, rtol=0, atol=1e-10 * size)
        np.testing.assert_allclose(f.acceleration(q, v, a), second, rtol=0, atol=1e-7 * size)
        np.testing.assert_allclose(f.jacobian(q) @ v, f.velocity(q, v), rtol=0, atol=1e-13 * size)


def cameras(mode):
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="link", pos=[0, 0, 1])
    body.add_joint(name="hinge", axis=[0, 1, 0])
    body.add_geom(size=[0.1, 0.1, 0.1])
    body.add_camera(name="eye", pos=[0.1, 0.2, 0.3], quat=[0.8, 0.6, 0, 0], mode=mode)
    spec.worldbody.add_body(name="target", mocap=True)
    return spec.compile()


def test_a_fixed_camera_moves_with_its_body():
    model = cameras(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
    data = mujoco.MjData(model)
    data.qpos[0] = 0.7
    mujoco.mj_forward(model, data)
    X = frame(model, "camera", "eye").pose(data.qpos)
    np.testing.assert_allclose(X, mujoco_pose(model, data, "camera", 0), rtol=0, atol=1e-15)


def test_frames_that_joints_do_not_determine_are_refused():
    model = cameras(mujoco.mjtCamLight.mjCAMLIGHT_TRACK)
    with pytest.raises(ModelError, match="camera 'eye' tracks"):
        frame(model, "camera", "eye")
    with pytest.raises(ModelError, match="mocap"):
        frame(model, "body", "target")


def test_unknown_names_list_what_exists():
    model = cameras(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
    with pytest.raises(ModelError, match=r"no body 'lnk' \(did you mean 'link'\?\).*link, target, world"):
        frame(model, "body", "lnk")
    with pytest.raises(ModelError, match="no frames of kind 'bone'; there are: body, camera, geom, site"):
        frame(model, "bone", "link")


def test_arrays_of_the_wrong_width_are_refused():
    model = cameras(mujoco.mjtCamLight.mjCAMLIGHT_FIXED)
    with pytest.raises(ModelError, match=r"q of shape \(2,\) does not fit: the model needs \(\.\.\., 1\)"):
        frame(model, "body", "link").pose([0.0, 0.0])
    with pytest.raises(ModelError, match="v of shape"):
        frame(model, "body", "link").velocity([0.0], 0.0)


@laws
@given(trees(max_bodies=3), seeds)
def test_batches_of_any_shape_and_length_are_rows_of_the_same_thing(model, seed):
    n = 4100  # more than one chunk
    q, v, a = random_states(model, seed, 6)
    f = frame(model, "site", f"s{model.nsite - 1}")
    pose, second = f.pose(q), f.acceleration(q, v, a)
    many = np.arange(n) % 6
    np.testing.assert_array_equal(f.pose(q[many]), pose[many])
    np.testing.assert_allclose(f.pose(q.reshape(2, 3, -1)), pose.reshape(2, 3, 4, 4), rtol=0, atol=1e-14)
    np.testing.assert_allclose(f.pose(q[2]), pose[2], rtol=0, atol=1e-13)
    one = f.acceleration(q[0], v[:2], a[0])  # leading shapes broadcast
    np.testing.assert_allclose(one[0], second[0], rtol=0, atol=1e-10)
    assert one.shape == (2, 6)
    assert f.pose(q[:0]).shape == (0, 4, 4)


def test_quaternions_of_any_length_mean_their_direction():
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body(name="top")
    body.add_freejoint()
    body.add_geom(size=[0.1, 0.1, 0.1])
    f = frame(spec.compile(), "body", "top")
    q = np.array([1.0, 2, 3, 0.5, 0.5, 0.5, 0.5])
    np.testing.assert_allclose(f.pose(q * [1, 1, 1, 7, 7, 7, 7]), f.pose(q), rtol=0, atol=1e-15)
