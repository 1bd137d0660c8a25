import os
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from pantograph.sim import rotations as rot
from pantograph.sim.clip import Clip, FreeTrack
from pantograph.sim.curves import keyed
from pantograph.sim.errors import KeyingError
from pantograph.sim.rotation_curves import keyed_rotation
from strategies import random_states, seeds, trees

laws = settings(deadline=None, max_examples=60)
DATA = Path(os.environ.get("PANTOGRAPH_DATA", Path(__file__).parents[2] / "shared" / "data"))
TIMES = [0.0, 0.7, 1.5, 3.0]


def smooth_tracks(model, rng):
    """Keys on about half of the joints; free joints get a position, a rotation, or both."""
    tracks = {}
    for j in range(model.njnt):
        kind, numbers = model.jnt_type[j], rng.normal(size=4)
        rotation = keyed_rotation(TIMES, rng.normal(size=(4, 4)), kind="clamped")
        if rng.random() < 0.4:
            continue
        if kind == mujoco.mjtJoint.mjJNT_FREE:
            position = keyed(TIMES, rng.normal(size=(4, 3)), kind="clamped")
            which = rng.integers(1, 4)
            track = FreeTrack(position if which & 1 else None, rotation if which & 2 else None)
        elif kind == mujoco.mjtJoint.mjJNT_BALL:
            track = rotation
        else:
            track = keyed(TIMES, numbers, kind="natural")
        tracks[model.joint(j).name] = track
    return tracks


@laws
@given(trees(), seeds)
def test_v_and_a_are_mujocos_differences_of_neighbouring_samples(model, seed):
    rng = np.random.default_rng(seed)
    q0 = random_states(model, seed, 1)[0][0]
    clip = Clip(model, smooth_tracks(model, rng), q0)
    t, h = 0.1 + 0.5 * rng.random() + rng.choice(TIMES[:-1]), 1e-3
    if np.abs(np.array(TIMES) - t).min() < 0.05:
        t += 0.1
    q, v, a = clip.evaluate(t + h * np.arange(-3, 4))
    step = np.zeros((7, model.nv))
    for k in range(7):
        mujoco.mj_differentiatePos(model, step[k], 1.0, q[3], q[k])
    weights = np.array([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60]) / h
    size = 1 + np.abs(v).max(initial=0) ** 2 + np.abs(a).max(initial=0)
    np.testing.assert_allclose(weights @ step, v[3], rtol=0, atol=1e-10 * size)
    np.testing.assert_allclose(weights @ v, a[3], rtol=0, atol=1e-9 * size)


@laws
@given(trees(), seeds)
def test_what_has_no_keys_stays_where_it_was(model, seed):
    q0 = random_states(model, seed, 1)[0][0]
    clip = Clip(model, smooth_tracks(model, np.random.default_rng(seed)), q0)
    q, v, a = clip.evaluate(np.linspace(-1, 4, 11))
    assert (q.shape, v.shape, a.shape) == ((11, model.nq), (11, model.nv), (11, model.nv))
    assert np.all(q[:, ~clip.qpos_mask] == q0[~clip.qpos_mask])
    assert not v[:, ~clip.dofs].any()
    assert not a[:, ~clip.dofs].any()
    middle = clip.evaluate(np.array([0.4, 1.1]))
    assert np.all(np.abs(middle.v[:, clip.dofs]).max(axis=0) > 0)  # and all that has keys moves
    keyed_joints = [model.joint(name).id for name in clip.tracks]
    assert not clip.dofs[~np.isin(model.dof_jntid, keyed_joints)].any()
    one = clip.evaluate(0.4)
    assert one.q.shape == (model.nq,)
    np.testing.assert_array_equal(one.a, middle.a[0])


def floating_arm():
    return mujoco.MjModel.from_xml_string("""
        <mujoco><worldbody>
          <body name="base"><freejoint name="base"/><geom size=".1"/>
            <body><joint name="shoulder" type="ball"/><geom size=".1"/>
              <body><joint name="elbow" type="hinge"/><geom size=".1"/></body></body></body>
        </worldbody></mujoco>""")


def test_a_free_joint_moves_linearly_in_the_world_and_turns_in_its_own_frame():
    model = floating_arm()
    quarter = rot.exp([0, 0, np.pi / 2])
    turned = rot.multiply(quarter, rot.exp([1.0, 0, 0]))  # about its own x, which is the world's y
    track = FreeTrack(
        keyed([0, 2], [[0, 0, 0], [2, 4, 6]], kind="linear"),
        keyed_rotation([0, 2], [quarter, turned], kind="linear"),
    )
    q, v, a = Clip(model, {"base": track}).evaluate(1.0)
    np.testing.assert_allclose(q[:3], [1, 2, 3], rtol=0, atol=1e-15)
    np.testing.assert_allclose(v[:6], [1, 2, 3, 0.5, 0, 0], rtol=0, atol=1e-15)
    assert not a.any()
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_forward(model, data)
    velocity = np.zeros(6)
    mujoco.mj_objectVelocity(model, data, mujoco.mjtObj.mjOBJ_XBODY, 1, velocity, 0)
    np.testing.assert_allclose(velocity, [0, 0.5, 0, 1, 2, 3], rtol=0, atol=1e-15)


def test_times_and_breaks_of_all_channels_are_gathered():
    model = floating_arm()
    tracks = {
        "base": FreeTrack(position=keyed([1, 2], np.eye(3)[:2], kind="linear")),
        "elbow": keyed([0, 0.5, 1], [0, 1, 0], kind="linear", after="loop"),
    }
    clip = Clip(model, tracks)
    assert (clip.start, clip.end) == (0, 2)
    np.testing.assert_array_equal(clip.breaks, [0, 0.5, 1, 2])
    np.testing.assert_allclose(clip.breaks_between(0.9, 2.6), [1, 1.5, 2, 2.5])
    assert clip.evaluate(0.5).v[-1] == -2
    assert clip.evaluate(0.5, left=True).v[-1] == 2
    empty = Clip(model, {})
    assert (empty.start, empty.end, len(empty.breaks), empty.dofs.any()) == (0, 0, 0, False)
    np.testing.assert_array_equal(empty.evaluate([0, 1]).q, [model.qpos0] * 2)


def test_all_tracks_that_do_not_fit_are_reported_at_once():
    number, rotation = keyed([0, 1], [0, 1]), keyed_rotation([0], [[1, 0, 0, 0]])
    tracks = {"elbo": number, "elbow": rotation, "shoulder": number, "base": rotation}
    with pytest.raises(KeyingError) as caught:
        Clip(floating_arm(), tracks)
    assert str(caught.value).splitlines() == [
        "no joint 'elbo' (did you mean 'elbow'?); this model has: base, elbow, shoulder",
        "hinge joint 'elbow' needs a curve of one number, not RotationCurve of 4",
        "ball joint 'shoulder' needs a RotationCurve (keyed_rotation), not PolynomialCurve of 1",
        "free joint 'base' needs a FreeTrack of a position and a rotation curve, not RotationCurve of 4",
    ]
    plane = keyed([0], [[0, 0]])
    for track in (
        FreeTrack(position=number),
        FreeTrack(position=plane),
        FreeTrack(rotation=keyed([0], [[1, 0, 0, 0]])),
    ):
        with pytest.raises(KeyingError, match="free joint 'base' needs a position of three numbers"):
            Clip(floating_arm(), {"base": track})
    with pytest.raises(KeyingError, match="hinge joint 'elbow' needs a curve of one number, not FreeTrack"):
        Clip(floating_arm(), {"elbow": FreeTrack()})
    with pytest.raises(KeyingError, match=r"q0 must have shape \(12,\), not \(3,\)"):
        Clip(floating_arm(), {}, np.zeros(3))


def tied(ties, refs=(0.3, -0.2, 0.5)):
    joints = "".join(
        f'<body><joint name="j{i}" type="slide" ref="{ref}"/>'
        '<geom size=".1" contype="0" conaffinity="0"/></body>'
        for i, ref in enumerate(refs)
    )
    return mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{joints}</worldbody><equality>{ties}</equality></mujoco>"
    )


def test_followers_of_followers_move_as_mujocos_equalities_want_them():
    model = tied(
        '<joint joint1="j1" joint2="j0" polycoef="0.1 -2 0.7 0.4 -0.3"/>'
        '<joint joint1="j1" joint2="j2" polycoef="0.6 0.5 0 0 0"/>'  # read backwards
    )
    clip = Clip(model, {"j0": keyed(TIMES, [0, 1, -1, 2], kind="clamped")}).with_coupled()
    assert set(clip.tracks) == {"j0", "j1", "j2"}
    data, t, h = mujoco.MjData(model), np.array([0.3, 0.9, 2.2]), 1e-3
    q, v, a = clip.evaluate(t)
    for k in range(3):
        data.qpos[:] = q[k]
        mujoco.mj_forward(model, data)
        assert len(data.efc_pos) == 2
        np.testing.assert_allclose(data.efc_pos, 0, rtol=0, atol=1e-13)
    steps = clip.evaluate(t[:, None] + h * np.arange(-3, 4))
    weights = np.array([-1 / 60, 3 / 20, -3 / 4, 0, 3 / 4, -3 / 20, 1 / 60]) / h
    np.testing.assert_allclose(weights @ steps.q, v, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(weights @ steps.v, a, rtol=1e-9, atol=1e-9)
    held = clip.evaluate(99.0)
    np.testing.assert_allclose(held.q, clip.evaluate(3.0, left=True).q, rtol=0, atol=1e-13)
    assert not held.v.any()


def test_ties_that_cannot_be_followed_are_refused_or_left():
    curve = keyed([0, 1], [0, 1])
    curved = tied('<joint joint1="j1" joint2="j0" polycoef="0 1 1 0 0"/>')
    with pytest.raises(KeyingError, match=r"'j1' is tied to 'j0' by a curved polynomial.*key 'j0' instead"):
        Clip(curved, {"j1": curve}).with_coupled()
    both = Clip(curved, {"j0": curve, "j1": curve}).with_coupled()
    assert both.tracks["j1"] is curve
    for ties in (
        '<joint joint1="j1" joint2="j0" active="false"/>',
        '<joint joint1="j1" polycoef="0.1 0 0 0 0"/>',
        '<joint joint1="j0" joint2="j2" polycoef="0.1 0 0 0 0"/>',  # j0 does not move j2
    ):
        assert set(Clip(tied(ties), {"j0": curve}).with_coupled().tracks) == {"j0"}


def test_the_gripper_of_the_wx250s_closes_with_both_fingers():
    path = DATA / "robots" / "trossen_wx250s" / "wx250s.xml"
    if not path.is_file():
        pytest.skip(f"no {path}: set PANTOGRAPH_DATA to the data folder")
    model = mujoco.MjModel.from_xml_path(str(path))
    clip = Clip(model, {"left_finger": keyed([0, 1], [0.037, 0.015])}).with_coupled()
    q, v, _ = clip.evaluate([0.0, 0.5, 1.0])
    left, right = (model.joint(f"{side}_finger").qposadr[0] for side in ("left", "right"))
    data = mujoco.MjData(model)
    for row in q:
        data.qpos[:] = row
        mujoco.mj_forward(model, data)
        assert abs(data.efc_pos[0]) < 1e-15
    assert v[1, left] == pytest.approx(-0.033)
    assert abs(v[1, right]) == pytest.approx(0.033)
