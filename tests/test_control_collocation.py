"""Fitted motion obeys the machine: known optima, limits, passive joints, hard keys, and simulation."""

import re
import signal
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from pantograph.controllers.fit import Phase, check, fit, machine, prove
from pantograph.controllers.fit.charts import Charts
from pantograph.controllers.fit.prove import given_by
from pantograph.controllers.fit.task import task_of
from pantograph.controllers.nominal import difference, moved
from pantograph.models import load_model
from pantograph.sim import PantographError, load
from pantograph.sim.clip import Clip, FreeTrack
from pantograph.sim.curves import keyed
from pantograph.sim.rotation_curves import keyed_rotation
from pantograph.sim.rotations import conjugate, exp, log, multiply, normalize
from pantograph.sim.scene.load import load_scene
from strategies import seeds
from typer.testing import CliRunner

ARM, ACROBOT = load_model("planar_2r"), load_model("acrobot")
SLIDER = mujoco.MjModel.from_xml_string(
    """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
    <geom size=".1" mass="2"/></body></worldbody></mujoco>"""
)
BALL = mujoco.MjModel.from_xml_string(
    """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="ball" type="ball"/>
    <geom size=".1" mass="2"/></body></worldbody></mujoco>"""
)
FLOAT = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><body><freejoint name="root"/><geom size=".1"/><body pos=".3 0 0">
    <joint name="ball" type="ball"/><geom size=".1"/><body pos=".3 0 0"><joint name="hinge"/>
    <geom size=".1"/></body></body></body></worldbody></mujoco>"""
)
SATELLITE = mujoco.MjModel.from_xml_string(
    """<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint name="root"/>
    <inertial pos="0 0 0" mass="3" diaginertia=".2 .25 .3"/>
    <body><joint name="wheel" axis="0 0 1"/><inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .02"/></body>
    </body></worldbody></mujoco>"""
)


def move(model, joint, times, values, **more):
    tracks = {joint: keyed(times, values, kind="clamped")}
    tracks |= {j: keyed(times, v, kind="clamped") for j, v in more.items()}
    return Clip(model, tracks, model.qpos0)


def test_least_effort_between_two_rests_is_the_cubic():
    """A mass moved with the least integral of force squared from rest to rest: x = 3 s^2 - 2 s^3."""
    clip = Clip(SLIDER, {"x": keyed([0, 1], [0.0, 1.0], ease="smooth")}, SLIDER.qpos0)
    found = fit(clip, machine(SLIDER), hard=[1.0], deviation=1e-9, effort=1.0, step=0.01)
    s = found.t
    np.testing.assert_allclose(found.clip.evaluate(s).q[:, 0], 3 * s**2 - 2 * s**3, atol=6e-3)
    peak = np.abs(found.tau[:, 0]).max()
    assert peak == pytest.approx(2 * 6, rel=0.1)


def test_a_force_that_just_suffices_gives_bang_bang():
    """Mass 2, way 1, time 1: the least force that does it is 4 m d / T^2 = 8, and then q(1/2) = 1/2."""
    clip = move(SLIDER, "x", [0, 1], [0.0, 1.0])
    with pytest.raises(PantographError, match="no motion was found"):
        fit(clip, machine(SLIDER, force=7.5), hard=[1.0])
    found = fit(clip, machine(SLIDER, force=8.4), hard=[1.0])
    assert found.certificate.limits <= 1 + 1e-3
    assert found.clip.evaluate(1.0).q[0] == pytest.approx(1.0, abs=1e-8)
    assert found.clip.evaluate(0.5).q[0] == pytest.approx(0.5, abs=1e-3)


@given(seeds)
@settings(max_examples=5)
def test_possible_keys_stay_as_they_are(seed):
    rng = np.random.default_rng(seed)
    a, b = 0.5 * rng.uniform(-1, 1, (2, 3))
    clip = move(ARM, "shoulder", [0, 1.0, 2.0], a, elbow=b)
    able = machine(ARM, velocity=20.0, force=1e4)
    found = fit(clip, able, effort=1e-7, step=0.05)
    assert check(clip, able).possible
    assert found.deviation < 2e-3


@given(seeds)
@settings(max_examples=5)
def test_a_pick_beyond_the_torque_limit_becomes_possible(seed):
    """Limits by MuJoCo's inverse dynamics on a fine grid, hard keys exactly, and a simulated run."""
    rng = np.random.default_rng(seed)
    clip = move(ARM, "shoulder", [0, 0.6, 1.2], [-1.2, rng.uniform(-0.2, 0.4), 0.8], elbow=[0.5, 1.8, 0.2])
    able = machine(ARM, velocity=6.0, force={"shoulder": 75.0, "elbow": 25.0}, top_speed=14.0)
    assume(not check(clip, able).possible)
    found = fit(clip, able, hard=[1.2])
    certificate = found.certificate
    assert certificate.solver < 1e-8
    assert certificate.limits <= 1 + 1e-3
    np.testing.assert_allclose(found.clip.evaluate(1.2).q, clip.evaluate(1.2).q, atol=1e-8)
    t = np.linspace(0, 1.2, 2001)
    q, v, a = found.clip.evaluate(t)
    assert np.abs(v).max() <= 6.0 * (1 + 1e-3)
    data, share = mujoco.MjData(ARM), 0.0
    for row in zip(q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(ARM, data)
        drawn = np.abs(data.qfrc_inverse) / [75.0, 25.0]
        share = max(share, (drawn + np.where(data.qfrc_inverse * row[1] > 0, np.abs(row[1]) / 14.0, 0)).max())
    assert share <= 1 + 5e-3
    proof = prove(found, able)
    assert proof.worst < 0.01


def test_jerk_and_acceleration_are_bounded():
    clip = move(ARM, "shoulder", [0, 0.5, 1.5], [0.0, 0.8, 0.8], elbow=[0, 0, 0])
    able = machine(ARM, acceleration=5.0, jerk=60.0, force=1e4)
    found = fit(clip, able, hard=[1.5])
    assert found.certificate.holds
    t = np.linspace(0, 1.5, 3001)
    a = found.clip.evaluate(t[:-1]).a  # held from the last key on
    assert np.abs(a).max() <= 5.0 * (1 + 1e-3)
    assert np.abs(np.diff(a, axis=0)).max() / (t[1] - t[0]) <= 60.0 * 1.002


def test_an_acrobot_swings_up_without_a_motor_in_its_shoulder():
    clip = move(ACROBOT, "shoulder", [0, 4.0], [0.0, np.pi], elbow=[0.0, 0.0])
    able = machine(ACROBOT, driven=np.array([False, True]), force={"elbow": 15.0})
    found = fit(clip, able, hard=[4.0], step=0.05, deviation=0.1)
    assert found.certificate.holds
    assert np.abs(found.tau[:, 0]).max() == 0.0
    assert np.abs(found.tau[:, 1]).max() <= 15.0
    proof = prove(found, able)
    assert proof.worst < 0.05
    assert abs(proof.q[-1, 0] - np.pi) < 0.05


THROWER = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><geom type="plane" size="3 3 .1"/>
    <body name="ball" pos="0 0 1"><freejoint name="root"/><geom size=".1" mass="1"/>
      <body><joint name="arm" axis="0 1 0"/><geom size=".05" mass=".1" pos="0 0 -.3"/></body></body>
    <body name="box" pos="1 0 .1"><freejoint name="box"/><geom type="box" size=".1 .1 .1"/></body>
    <body name="slider" pos="0 1 0"><joint name="x" type="slide" axis="1 0 0" frictionloss="4"/>
      <geom size=".1" mass="2" contype="0" conaffinity="0"/>
      <body><joint name="rope" axis="0 1 0" frictionloss=".02"/>
        <geom size=".05" mass=".2" pos="0 0 -.3" contype="0" conaffinity="0"/></body></body>
    </worldbody></mujoco>"""
)
LOOSE = np.isin(THROWER.dof_jntid, [THROWER.joint(n).id for n in ("root", "box", "rope")])


def test_a_throw_flies_at_the_speed_that_it_needs():
    """Keys of a body in free flight: its mass centre is on the parabola through both hard poses."""
    way = keyed([0, 1], [[0, 0, 1], [1, 0, 1]], kind="linear")
    clip = Clip(THROWER, {"root": FreeTrack(way), "arm": keyed([0, 1], [0, 0], kind="linear")})
    found = fit(clip, machine(THROWER, driven=~LOOSE), hard=[1.0], at_rest=False)
    assert found.certificate.holds
    s = np.linspace(0, 1, 101)
    q = found.clip.evaluate(s, left=True).q
    data, heights = mujoco.MjData(THROWER), []
    for row in q:
        data.qpos[:] = row
        mujoco.mj_kinematics(THROWER, data)
        mujoco.mj_comPos(THROWER, data)
        heights.append(data.subtree_com[THROWER.body("ball").id, 2])
    assert 2 * np.polyfit(s, heights, 2)[0] == pytest.approx(-9.81, rel=1e-3)
    assert q[-1, 2] == pytest.approx(1.0, abs=1e-7)


def test_loose_things_are_left_out_and_ropes_swing_out():
    """A box without keys stays; a rope obeys gravity and friction, and need not rest at the end."""
    clip = Clip(THROWER, {"x": keyed([0, 1], [0.0, 0.5], kind="clamped")})
    able = machine(THROWER, driven=~LOOSE, force={"x": 12.0})
    found = fit(clip, able, hard=[1.0])
    assert found.certificate.holds
    assert set(found.clip.tracks) == {"x", "rope", "arm", "root"}
    q, v, a = found.clip.evaluate(found.t[2:-1])
    assert abs(v[-1, THROWER.joint("rope").dofadr[0]]) > 0.1
    data = mujoco.MjData(able.model)
    dof, rope = THROWER.joint("x").dofadr[0], THROWER.joint("rope").dofadr[0]
    for row in zip(q, v, a, strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(able.model, data)
        dry = -0.02 * row[1][rope] / np.hypot(row[1][rope], 0.01)
        assert data.qfrc_inverse[rope] == pytest.approx(dry, abs=1e-6)
        assert abs(data.qfrc_inverse[dof] + 4.0 * np.sign(row[1][dof])) <= 12.0 * (1 + 1e-3)


def test_a_fit_starts_against_friction():
    """The least time from rest to rest, with (force - friction) / m and then (force + friction) / m, is 1 s
    for a force of 6.8 N: below it nothing fits, above it something does."""
    clip = move(THROWER, "x", [0, 1], [0.0, 0.5])
    mass = 2.2
    words = {"hard": [1.0], "refine": 2, "deviation": 1e-3}
    force = 0.5 * (2 * mass + np.sqrt((2 * mass) ** 2 + 4 * 16.0))  # 2 d (m / (f - 4) + m / (f + 4)) = 1
    stiff = THROWER.__copy__()
    stiff.dof_damping[THROWER.joint("rope").dofadr[0]] = 100.0  # one mass
    with pytest.raises(PantographError, match="no motion was found"):
        fit(clip, machine(stiff, driven=~LOOSE, force={"x": 0.96 * force}), **words)
    found = fit(clip, machine(stiff, driven=~LOOSE, force={"x": 1.06 * force}), **words)
    assert found.certificate.limits <= 1 + 1e-3


PENDULUMS = """<mujoco><worldbody><body pos="0 0 1"><joint name="driven" type="{kind}" axis="{axis}"/>
  <geom type="capsule" fromto="0 0 0 0 0 -{up}" size=".02" mass="{big}" contype="0" conaffinity="0"/>
  <body pos="0 0 -{up}"><joint name="loose" axis="0 1 0" frictionloss="{dry}"/>
    <geom type="capsule" fromto="0 0 0 0 0 -{low}" size=".02" mass="{small}" contype="0" conaffinity="0"/>
  </body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("seed", range(8))
def test_friction_that_nothing_drives_holds_where_it_turns(seed):
    """Between nodes, by MuJoCo's inverse dynamics: what hangs swings to and fro under its friction alone."""
    rng = np.random.default_rng(seed)
    low, small = rng.uniform(0.2, 0.6), rng.uniform(0.2, 1.0)
    words = {"kind": ("slide", "hinge")[seed % 2], "axis": ("1 0 0", "0 1 0")[seed % 2], "up": 0.3, "big": 2}
    dry = rng.choice([0.01, 0.1, 0.3]) * small * low * 2.0
    model = mujoco.MjModel.from_xml_string(PENDULUMS.format(low=low, small=small, dry=dry, **words))
    seconds = rng.uniform(0.8, 2.0)
    clip = move(model, "driven", np.linspace(0, seconds, 4), [0.0, *rng.uniform(-0.6, 0.6, 3)])
    able = machine(model, driven=np.array([True, False]))
    found = fit(clip, able, hard=[seconds])
    assert found.certificate.holds
    t = np.linspace(0, seconds, 20001)
    data, need = mujoco.MjData(able.model), []
    for row in zip(*found.clip.evaluate(t, left=True), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(able.model, data)
        dry_now = dry * row[1][1] / np.hypot(row[1][1], 0.01)
        need.append(data.qfrc_inverse + np.array([0.0, dry_now]))
    need = np.abs(need)
    assert need[:, 1].max() <= 1.01e-3 * need.max()


HOPPER = """<mujoco><worldbody><geom type="plane" size="3 3 .1"/><body name="trunk" pos="0 0 0">
  <joint name="x" type="slide" axis="1 0 0"/><joint name="z" type="slide" axis="0 0 1"/>
  <geom size=".1" mass="3" contype="0" conaffinity="0"/>
  <body name="thigh"><joint name="hip" axis="0 1 0" range="-90 90"/>
    <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".03" mass=".5" contype="0" conaffinity="0"/>
    <body name="shank" pos="0 0 -.3"><joint name="knee" axis="0 1 0" range="-150 -5"/>
      <geom type="capsule" fromto="0 0 0 0 0 -.3" size=".025" mass=".3" contype="0" conaffinity="0"/>
      <site name="foot" pos="0 0 -.3"/></body></body></body></worldbody></mujoco>"""


def test_a_jump_pushes_off_flies_and_lands():
    """Contacts as phases: in flight the mass centre falls freely, on the ground the foot rests."""
    model = mujoco.MjModel.from_xml_string(HOPPER)
    bent = np.deg2rad(45.0)
    height = 0.6 * np.cos(bent)
    times, up = [0, 0.5, 0.75, 1.0, 1.5], [height, height, height + 0.3, height, height]
    tracks = {"z": keyed(times, up, kind="clamped")}
    tracks |= {j: keyed([0], [x]) for j, x in (("hip", bent), ("knee", -2 * bent))}
    clip = Clip(model, tracks, [0.0, height, bent, -2 * bent])
    able = machine(model, driven=np.array([False, False, True, True]), force={"hip": 120.0, "knee": 120.0})
    phases = [Phase(0.0, 0.5, ("foot",)), Phase(1.0, 1.5, ("foot",))]
    found = fit(clip, able, phases=phases, hard=[0.75], effort=0.3)
    assert found.certificate.holds
    assert found.certificate.dynamics < 1e-3
    flight = (found.t > 0.5) & (found.t < 1.0)
    assert not found.contact[flight].any()
    ground = ~flight
    assert (found.contact[ground, 2] >= -1e-6).all()
    assert (np.abs(found.contact[ground, 0]) <= 0.8 * found.contact[ground, 2] + 1e-6).all()
    data, heights, feet = mujoco.MjData(model), [], []
    for q in found.clip.evaluate(found.t).q:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        heights.append(data.subtree_com[1, 2])
        feet.append(data.site("foot").xpos[2])
    fall = np.polyfit(found.t[flight], np.array(heights)[flight], 2)[0]
    assert 2 * fall == pytest.approx(-9.81, rel=0.02)
    np.testing.assert_allclose(np.array(feet)[ground], 0.0, atol=2e-4)
    assert found.clip.evaluate(0.75).q[1] == pytest.approx(height + 0.3, abs=1e-8)


@given(seeds)
@settings(max_examples=20)
def test_charts_are_those_of_the_manifold(seed):
    """By MuJoCo's integration and differences; rates and clips by differences in time."""
    rng, charts, eps = np.random.default_rng(seed), Charts(FLOAT), 1e-6
    nv = FLOAT.nv
    q = moved(FLOAT, FLOAT.qpos0, rng.normal(size=nv))
    d, v = rng.uniform(-1, 1, (2, nv))
    to = moved(FLOAT, q, d)
    np.testing.assert_allclose(np.asarray(charts.moved(q, d)).ravel(), to, atol=1e-14)
    np.testing.assert_allclose(np.asarray(charts.apart(q, to)).ravel(), d, atol=1e-12)
    ends = [difference(FLOAT, q, moved(FLOAT, to, s * eps * v)) for s in (1, -1)]
    np.testing.assert_allclose(
        np.asarray(charts.rate(d, v)).ravel(), (ends[0] - ends[1]) / (2 * eps), atol=1e-8
    )
    t = np.array([0.0, 0.4, 1.0])
    rows, vs = np.array([q, to, moved(FLOAT, to, 0.5 * v)]), rng.normal(size=(3, nv))
    a0, a1 = rng.normal(size=(2, 2, nv))
    clip = charts.clip(t, rows, vs, a0, a1, Clip(FLOAT, {}))
    now, end = clip.evaluate(t[:-1]), clip.evaluate(t[1:], left=True)
    for got, wanted in ((now.v, vs[:-1]), (now.a, a0), (end.v, vs[1:]), (end.a, a1), (end.q, rows[1:])):
        np.testing.assert_allclose(got, wanted, atol=1e-9)
    fine = np.linspace(0.01, 0.39, 5)
    later, sooner = clip.evaluate(fine + eps), clip.evaluate(fine - eps)
    speed = [difference(FLOAT, *pair) / (2 * eps) for pair in zip(sooner.q, later.q, strict=True)]
    np.testing.assert_allclose(clip.evaluate(fine).v, speed, atol=1e-6)


def test_a_turn_is_the_cubic_about_its_axis():
    """A sphere on a ball joint from rest to rest with the least effort: about one axis, as a cubic."""
    rng = np.random.default_rng(5)
    axis = rng.normal(size=3)
    axis *= 2.4 / np.linalg.norm(axis)
    start = normalize(rng.normal(size=4))
    track = keyed_rotation([0, 1], [start, multiply(start, exp(axis))], kind="linear")
    clip = Clip(BALL, {"ball": track}, start)
    found = fit(clip, machine(BALL), hard=[1.0], deviation=1e-9, effort=1.0, step=0.02, at_rest=True)
    s = np.linspace(0, 1, 301)
    q, v, _ = found.clip.evaluate(s)
    turned = log(multiply(conjugate(start), q))
    np.testing.assert_allclose(turned, np.outer(3 * s**2 - 2 * s**3, axis), atol=6e-3 * 2.4)
    np.testing.assert_allclose(
        v[1:-1], (log(multiply(conjugate(q[:-2]), q[2:])) / (s[2] - s[0])), atol=2e-3 * 2.4
    )


@given(seeds)
@settings(max_examples=3)
def test_a_floating_base_turns_against_its_wheel(seed):
    """Nothing drives the base: its turn follows from angular momentum, 0 = I w + J (w + wheel)."""
    rng = np.random.default_rng(seed)
    start = np.concatenate([rng.normal(size=3), normalize(rng.normal(size=4)), [0.0]])
    far = rng.uniform(1.0, 3.0)
    clip = Clip(SATELLITE, {"wheel": keyed([0, 1], [0.0, far], kind="clamped")}, start)
    able = machine(SATELLITE, driven=np.arange(7) == 6)
    found = fit(clip, able, hard=[1.0])
    assert found.certificate.holds
    end = found.clip.evaluate(1.0).q
    turn = log(multiply(conjugate(start[3:7]), end[3:7]))
    np.testing.assert_allclose(turn, [0, 0, -far * 0.02 / (0.3 + 0.02)], atol=1e-7)
    np.testing.assert_allclose(end[:3], start[:3], atol=1e-7)
    assert prove(found, able).holds  # though nothing steers the base


def test_a_hopper_with_a_free_base_hops():
    """A short hop along no axis of the world; balance of forces by MuJoCo, contacts by their Jacobian."""
    model = load_model("hopper")
    hip, knee, ankle = 0.7, 1.3, 0.6
    height = 0.3 * np.cos(hip) + 0.3 * np.cos(knee - hip) + 0.05
    times, yaw = [0, 0.35, 0.5, 0.9], 0.8
    way = np.array([np.cos(yaw), np.sin(yaw), 0.0])
    up = np.outer([0, 0, 0.05, 0.1], way) + np.outer([height, height, height + 0.05, height], [0, 0, 1])
    facing = keyed_rotation([0.0], [[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]])
    tracks = {"root": FreeTrack(keyed(times, up), facing)}
    tracks |= {j: keyed([0], [x]) for j, x in (("hip", hip), ("knee", knee), ("ankle", ankle))}
    clip = Clip(model, tracks)
    corners = ("toe_left", "toe_right", "heel_left", "heel_right")
    phases = [Phase(0.0, 0.4, corners), Phase(0.6, 0.9, corners)]
    able = machine(model, driven=np.arange(9) > 5)
    assert not check(clip, able, phases=phases).possible
    found = fit(clip, able, phases=phases, hard=[0.9], effort=0.1, tolerance=1e-2)
    assert found.certificate.holds
    q, v, a = found.clip.evaluate(found.t[:-1])  # held from the last on
    np.testing.assert_allclose(found.clip.evaluate(0.9).q, clip.evaluate(0.9).q, atol=2e-5)
    data, largest, missing = mujoco.MjData(able.model), 0.0, 0.0
    for row, f, tau in zip(zip(q, v, a, strict=True), found.contact[:-1], found.tau[:-1], strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(able.model, data)
        need = data.qfrc_inverse.copy()
        largest = max(largest, np.abs(need).max())
        J = np.zeros((3, 9))
        for k, site in enumerate(found.sites):
            mujoco.mj_jacSite(able.model, data, J, None, model.site(site).id)
            need -= J.T @ f[3 * k : 3 * k + 3]
        missing = max(missing, np.abs(need - tau).max())
    assert missing < 1e-6 * largest
    assert prove(found, able).worst < 0.1  # under servos, with MuJoCo's contacts


@pytest.mark.parametrize(
    ("values", "limits", "message"),
    [
        ([0, 3.5], {}, r"pose at 1 s is 0\.4 rad or m beyond the range of 'shoulder'"),
        ([0, 1.0], {"velocity": 0.5}, r"'shoulder' moves at 1 rad/s or m/s in the mean, its limit is 0\.5"),
    ],
)
def test_what_no_motion_does_is_told_before_it_is_sought(values, limits, message):
    seen = []
    with pytest.raises(PantographError, match=message):
        fit(move(ARM, "shoulder", [0, 1], values), machine(ARM, **limits), hard=[1.0], progress=seen.append)
    assert not seen


def test_a_pose_that_drives_cannot_hold_is_told_when_nothing_fits():
    with pytest.raises(
        PantographError, match=r"at rest at 0 s 'shoulder' needs 40\.76 N m or N .* limit is 5"
    ):
        fit(move(ARM, "shoulder", [0, 1], [0, 1.0]), machine(ARM, force=5.0), hard=[1.0])


def test_drives_give_less_at_speed_and_from_a_battery():
    able = machine(ARM, force=10.0, top_speed=5.0, ampere=0.5, current=6.0)
    np.testing.assert_allclose(given_by(able, np.array([20.0, -20.0]), np.zeros(2)), [6.0, -6.0])
    rich = machine(ARM, force=10.0, top_speed=5.0)
    np.testing.assert_allclose(given_by(rich, np.array([20.0, -20.0]), np.full(2, 2.5)), [5.0, -10.0])
    np.testing.assert_allclose(given_by(rich, np.array([20.0, 3.0]), np.full(2, -9.0)), [10.0, 3.0])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--velocity", "0"], "velocity must be a positive number, got 0.0"),
        (["--current", "0"], "current of the battery must be a positive number"),
        (["--current", "5"], "limits nothing without what it feeds"),
        (["--velocity", "elbow=-1"], "velocity of 'elbow' must be a positive number"),
        (["--jerk", "nan"], "jerk must be a"),
        (["--velocity", "a=b"], "--velocity is a number, or JOINT=number, not 'a=b'"),
        (["--top-speed", "1", "--top-speed", "2"], "--top-speed is given twice for all joints"),
    ],
)
def test_wrong_options_are_told(tmp_path, options, message):
    with pytest.raises(PantographError, match=message):
        app_of_fit(tmp_path, options)


def test_a_limit_for_all_and_one_for_a_joint(tmp_path):
    done = app_of_fit(tmp_path, ["--velocity", "4", "--velocity", "elbow=1.6"])
    assert re.search(r"shoulder +velocity +2\.25 +4 ", done.output)
    assert re.search(r"elbow +velocity +1\.5 +1\.6 ", done.output)


def fitting(tmp_path):
    """The command, and a scene of two keyed joints."""
    import typer
    from pantograph.controllers.fit_command import fit as command

    app = typer.Typer()
    app.command()(command)
    scene = tmp_path / "swing.toml"
    scene.write_text(
        'duration = 1.0\n[[models]]\nfile = "planar_2r"\n'
        '[[keys]]\njoint = "shoulder"\ntimes = [0, 1]\nvalues = [-1.0, 0.5]\n'
        '[[keys]]\njoint = "elbow"\ntimes = [0, 1]\nvalues = [0.5, 1.5]\n'
    )
    return app, scene


def app_of_fit(tmp_path, options):
    app, scene = fitting(tmp_path)
    return CliRunner().invoke(app, [str(scene), *options], catch_exceptions=False)


@pytest.mark.parametrize(
    ("clip", "words", "message"),
    [
        (move(ARM, "elbow", [0, 1], [0, 1]), {"hard": [2.0]}, "hard key at 2 s lies outside"),
        (Clip(load_model("quadruped"), {}), {}, "no joint has two keys"),
        (move(ARM, "elbow", [0, 1], [0, 1]), {"phases": [Phase(0, 1, ("tip",))]}, "'tip'.*mm above it"),
        (move(ARM, "elbow", [0, 1], [0, 1]), {"phases": [Phase(0, 1, ("toe",))]}, "no site 'toe'"),
    ],
)
def test_mistakes_are_told(clip, words, message):
    with pytest.raises(PantographError, match=message):
        fit(clip, machine(clip.model), **words)


def test_the_command_checks_retimes_and_fits(tmp_path):
    app, scene = fitting(tmp_path)
    run = CliRunner()
    base = [str(scene), "--velocity", "2", "--out", str(tmp_path)]
    done = run.invoke(app, [*base, "--how", "check"])
    assert done.exit_code == 1
    assert "as keyed: impossible" in done.output
    assert re.search(r"shoulder +velocity +2\.25 +2 +112\.5%", done.output)
    done = run.invoke(app, [*base, "--how", "nearest"])
    assert done.exit_code == 0, done.output
    recording = load(tmp_path / "swing.fit.npz")
    assert np.abs(recording.v).max() <= 2.0 * (1 + 1e-6)
    assert recording.q[-1, 0] == pytest.approx(0.5, abs=1e-6)
    done = run.invoke(app, [*base, "--how", "fit", "--force", "100", "--hard", "1"])
    assert done.exit_code == 0, done.output
    assert "LQR in the loop" in done.output
    done = run.invoke(app, [*base, "--how", "retime", "--jerk", "40"])
    assert done.exit_code == 0, done.output
    assert re.search(r"elbow +jerk +\S+ +40 +\d", done.output)


def test_a_scene_says_machine_and_contacts(tmp_path):
    """The table [fit] stands for the options; the film has the keys on the left."""
    import typer
    from pantograph.controllers.fit_command import fit as command

    app = typer.Typer()
    app.command()(command)
    scene = tmp_path / "sway.toml"
    scene.write_text(
        'duration = 0.4\n[[models]]\nfile = "planar_2r"\n[film]\nwidth = 64\nheight = 48\n'
        '[[keys]]\njoint = "shoulder"\ntimes = [0, 0.4]\nvalues = [-1.0, -0.7]\n'
        '[fit]\nhow = "fit"\nhard = [0.4]\nforce = 70\nvelocity = {shoulder = 1.4}\n'
    )
    run = CliRunner()
    done = run.invoke(app, [str(scene), "--out", str(tmp_path), "--film", "sway.gif"])
    assert done.exit_code == 0, done.output
    assert "certificate to 0.001 holds" in done.output
    assert (tmp_path / "sway.gif").exists()
    assert np.abs(load(tmp_path / "sway.fit.npz").v[:, 0]).max() <= 1.4 * (1 + 1e-3)
    done = run.invoke(app, [str(scene), "--out", str(tmp_path), "--how", "check", "--velocity", "2"])
    assert re.search(r"shoulder +velocity +1\.125 +2 +56\.[23]%", done.output)
    scene.write_text(scene.read_text() + '[[fit.phases]]\nsites = ["tipp"]\nstart = 0\nstop = 0.2\n')
    with pytest.raises(PantographError, match="no site 'tipp'"):
        run.invoke(app, [str(scene)], catch_exceptions=False)


def test_forces_missing_between_nodes_fall_with_the_third_power():
    clip = Clip(ACROBOT, {"elbow": keyed([0, 1.0], [0.0, 1.0], kind="clamped")}, ACROBOT.qpos0)
    able = machine(ACROBOT, driven=np.array([False, True]))
    words = {"at_rest": False, "refine": 0, "effort": 1e-4}
    left = [fit(clip, able, step=h, **words).certificate.dynamics for h in (0.05, 0.025)]
    assert np.log2(left[0] / left[1]) > 2.5


def test_ctrl_c_ends_a_fit():
    seen = []

    def press(text):
        seen.append(text)
        if text.endswith("iteration 3"):
            signal.raise_signal(signal.SIGINT)

    clip = move(ARM, "shoulder", [0, 1.0], [-1.0, 0.5], elbow=[0.5, 1.5])
    before = signal.getsignal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        fit(clip, machine(ARM, force=60.0), progress=press)
    assert len(seen) <= 4
    assert signal.getsignal(signal.SIGINT) is before


def test_keyed_joints_keep_the_limits_of_their_actuators():
    """The plan of a run leaves out actuators of joints that move as keyed; their machine has them."""
    scene = load_scene(Path(__file__).parents[1] / "models" / "scenes" / "waving_arm.toml")
    assert task_of(scene).machine.force_high[0] == 160.0


def test_the_jump_as_drawn_needs_what_nothing_gives():
    scene = load_scene(Path(__file__).parents[1] / "models" / "scenes" / "hopper_jump.toml")
    task = task_of(scene)
    crossed = {v.who for v in check(task.clip, task.machine, phases=task.phases).violations}
    assert {"root.x", "root.z", "root.ry"} <= crossed
    assert not crossed & {"root.y", "root.rx", "root.rz"}
