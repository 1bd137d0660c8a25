"""The smooth engine: equal to MuJoCo's where their physics is the same, and its stops at limits."""

from __future__ import annotations

import dataclasses
import itertools
import re

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.sine import sine
from pantograph.sim import Scene, make_plan, run
from pantograph.sim.clip import Clip
from pantograph.sim.curves import keyed
from pantograph.sim.dynamics import compile_model
from pantograph.sim.engines.common import Broken
from pantograph.sim.engines.contact import ContactEngine
from pantograph.sim.engines.interface import Problem, Role, State
from pantograph.sim.engines.limits import complementary, rebound
from pantograph.sim.engines.smooth import SmoothEngine, differences
from pantograph.sim.errors import EngineError, SceneError
from scipy.integrate import solve_ivp

G = 9.81

SLIDE = """
<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody>
  <body name="b"><joint name="z" type="slide" axis="0 0 1" range="-0.5 2" limited="true"/>
    <geom size="0.1" mass="2" contype="0" conaffinity="0"/></body>
</worldbody><actuator><motor name="push" joint="z"/></actuator></mujoco>"""


def scene_of(tmp_path, xml, **words):
    file = tmp_path / "model.xml"
    file.write_text(xml)
    return Scene(models=[{"file": str(file)}], **words)


@st.composite
def problems(draw):
    """Random trees with keyed joints, and held joint forces."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spec = mujoco.MjSpec()
    bodies = [spec.worldbody]
    kinds = {
        "hinge": mujoco.mjtJoint.mjJNT_HINGE,
        "slide": mujoco.mjtJoint.mjJNT_SLIDE,
        "ball": mujoco.mjtJoint.mjJNT_BALL,
    }
    tracks = {}
    for i in range(draw(st.integers(1, 4))):
        parent = bodies[draw(st.integers(0, len(bodies) - 1))]
        body = parent.add_body(name=f"b{i}", pos=rng.normal(size=3) * 0.3)
        kind = draw(st.sampled_from(["hinge", "slide", "ball", "free"]))
        if kind == "free" and parent is spec.worldbody:
            body.add_freejoint(name=f"j{i}")
        else:
            body.add_joint(
                name=f"j{i}", type=kinds.get(kind, kinds["hinge"]), axis=rng.normal(size=3), damping=0.05
            )
            if kind in ("hinge", "slide") and draw(st.booleans()):
                tracks[f"j{i}"] = keyed([0.0, 0.07, 0.2], [[0.0], [rng.normal()], [0.0]], kind="clamped")
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=0.05 + 0.1 * rng.random(3),
            contype=0,
            conaffinity=0,
        )
        bodies.append(body)
    model = spec.compile()
    q = np.array(model.qpos0)
    mujoco.mj_integratePos(model, q, rng.normal(size=model.nv), 0.5)
    clip = Clip(model, tracks, q)
    roles = np.zeros(model.njnt, dtype=np.int8)
    for name in tracks:
        roles[model.joint(name).id] = Role.KEYED
    v = rng.normal(size=model.nv)
    start = clip.evaluate(0.0)
    q[clip.qpos_mask], v[clip.dofs] = start.q[clip.qpos_mask], start.v[clip.dofs]
    problem = Problem(
        model=model,
        state0=State(q, v, np.zeros(0)),
        duration=0.1,
        roles=roles,
        clip=clip,
        integrator="rk4",
        step=0.002,
        sample_every=10,
        drives=np.zeros(0, dtype=np.int8),
    )
    return problem, rng.normal(size=model.nv)


class Constant:
    """Held joint forces, renewed at each period."""

    def __init__(self, force, nu, period=0.01):
        from pantograph.sim.engines.interface import Held

        self.period, self.held = period, Held(np.zeros(nu), force)

    def sample(self, k, t, q, v):
        return self.held


@settings(max_examples=15)
@given(problems())
def test_engines_agree_where_their_physics_is_the_same(case):
    problem, force = case
    force = np.where(problem.dofs(Role.KEYED), 0.0, force)
    controls = Constant(force, 0)
    span = (0.0, problem.duration)
    ours = SmoothEngine().run(problem, span, controls)
    theirs = ContactEngine().run(problem, span, controls)
    np.testing.assert_array_equal(ours.t, theirs.t)
    scale = 1 + np.abs(theirs.v).max() ** 2
    # the contact engine's keyed accelerations are met to about 1e-7 of the forces on them
    tolerance = 1e-6 if problem.dofs(Role.KEYED).any() else 1e-9
    np.testing.assert_allclose(ours.q, theirs.q, atol=tolerance * scale)
    np.testing.assert_allclose(ours.v, theirs.v, atol=10 * tolerance * scale)


@pytest.mark.parametrize(
    ("method", "order", "steps"),
    [("euler", 1, (4e-3, 2e-3, 1e-3)), ("rk4", 4, (0.04, 0.02, 0.01)), ("dopri5", 5, (0.08, 0.04, 0.02))],
)
def test_keyed_motion_enters_every_method_at_its_full_order(tmp_path, method, order, steps):
    """A pendulum, l = 1 m, on a pivot that moves as a sin(w t)."""
    a, w = 0.3, 4.0
    xml = """
<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body><joint name="pivot" type="slide" axis="1 0 0"/>
    <geom size="0.05" mass="1" contype="0" conaffinity="0"/>
    <body><joint name="swing" axis="0 -1 0"/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></body>
</worldbody></mujoco>"""
    truth = solve_ivp(
        lambda t, y: [y[1], -(G * np.sin(y[0]) - a * w * w * np.sin(w * t) * np.cos(y[0])) / (1 + 1e-9)],
        (0, 1.6),
        [0.5, 0.0],
        method="DOP853",
        rtol=1e-13,
        atol=1e-14,
    ).y[0, -1]
    errors = []
    for h in steps:
        scene = scene_of(
            tmp_path,
            xml,
            duration=1.6,
            rate=1,
            keys=[{"joint": "pivot", "times": [0.0], "values": [0.0]}],
            initial={"position": {"swing": 0.5}},
            solver={"integrator": method, "step": h, "engine": "smooth"},
        )
        problem = make_plan(scene).problem
        curve = sine(a, w)
        clip = Clip(problem.model, {"pivot": curve}, problem.state0.q)
        v0 = np.array([a * w, 0.0])
        problem = dataclasses.replace(
            problem, clip=clip, state0=State(problem.state0.q, v0, problem.state0.act)
        )
        segment = SmoothEngine().run(problem, (0.0, 1.6), None)
        errors.append(abs(segment.q[-1, 1] - truth))
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order - 0.35 < slope < order + 1.5, errors


@pytest.mark.parametrize("step", [0.002, 0.01, 0.05])
def test_a_falling_joint_stops_at_its_limit_at_the_closed_form_time(tmp_path, step):
    scene = scene_of(tmp_path, SLIDE, duration=1.0, solver={"step": step}, rate=100)
    plan = make_plan(scene)
    assert plan.engine.what == "smooth"
    r = run(plan)
    (hit,) = [e for e in r.events if e.kind == "limit"]
    assert abs(hit.t - np.sqrt(2 * 0.5 / G)) < 1e-9
    rest = r.t > hit.t
    assert np.all(r.q[rest, 0] == -0.5)
    assert np.all(r.v[rest] == 0.0)
    assert np.all(r.a[rest] == 0.0)
    assert r.q.min() >= -0.5


def test_a_resting_joint_leaves_its_limit_when_it_is_pulled_off(tmp_path):
    """2 kg on the lower limit, pushed up by a force that grows as 40 t: it leaves when 40 t = m g."""
    scene = scene_of(
        tmp_path,
        SLIDE,
        duration=1.2,
        initial={"position": {"z": -0.5}},
        keys=[{"actuator": "push", "times": [0.0, 2.0], "values": [0.0, 80.0], "curve": "linear"}],
        solver={"step": 0.001},
    )
    r = run(scene)
    (gone,) = [e for e in r.events if e.kind == "limit end"]
    t0 = 2 * G / 40
    assert t0 <= gone.t <= t0 + 0.0021
    # m z'' = 40 (t - t0): z = -0.5 + 40 (t - t0)^3 / (6 m)
    late = r.t > gone.t
    np.testing.assert_allclose(r.q[late, 0], -0.5 + 40 * (r.t[late] - t0) ** 3 / 12, atol=1e-5)


def test_an_impact_keeps_the_angular_momentum_of_a_floating_pair(tmp_path):
    """Two bodies, one hinge with a limit, no gravity: the impact is internal, energy can only be lost."""
    xml = """
<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="hull"><freejoint/>
  <geom type="box" size="0.2 0.1 0.1" mass="3" contype="0" conaffinity="0"/>
  <body pos="0.2 0 0"><joint name="flap" axis="0 1 0" range="-0.4 0.4" limited="true"/>
    <geom type="capsule" fromto="0 0 0 0.4 0 0" size="0.04" mass="1" contype="0" conaffinity="0"/>
  </body></body>
</worldbody></mujoco>"""
    scene = scene_of(tmp_path, xml, duration=1.0, initial={"velocity": {"flap": 3.0}}, solver={"step": 0.002})
    r = run(scene)
    assert [e.kind for e in r.events][:1] == ["limit"]
    d = mujoco.MjData(r.model)
    momenta = []
    for q, v in zip(r.q, r.v, strict=True):
        d.qpos[:], d.qvel[:] = q, v
        mujoco.mj_forward(r.model, d)
        mujoco.mj_subtreeVel(r.model, d)
        momenta.append(
            np.concatenate([d.subtree_angmom[0], r.model.body_subtreemass[0] * d.subtree_linvel[0]])
        )
    np.testing.assert_allclose(momenta, np.tile(momenta[0], (len(momenta), 1)), atol=1e-9)
    assert r.energy[-1] < 0.9 * r.energy[0]
    assert np.all(np.diff(r.energy) < 1e-9)
    assert np.all(np.abs(r.q[:, -1]) <= 0.4 + 1e-12)


def test_engines_agree_on_the_force_of_a_keyed_joint_with_an_actuator_of_its_own(tmp_path):
    """Inverse dynamics asks for it, whoever gives which part: m (a + g), of which the motor gives 3 N."""
    keys = [
        {"joint": "z", "times": [0, 0.5, 1], "values": [0, 0.4, 0]},
        {"actuator": "push", "times": [0], "values": [3]},
    ]
    for solver in ({"engine": "smooth"}, {"engine": "contact", "integrator": "rk4"}):
        xml = SLIDE.replace(
            "</worldbody>",
            '<body><joint name="y"/><geom size=".1" contype="0" conaffinity="0"/></body></worldbody>',
        )
        r = run(scene_of(tmp_path, xml, duration=1.0, keys=keys, solver=solver))
        np.testing.assert_allclose(r.tau[:, 0], 2 * (r.a[:, 0] + G), atol=1e-5)


@pytest.mark.parametrize("solver", [{}, {"tolerance": 1e-8}])
def test_a_joint_that_starts_beyond_its_limit_is_put_on_it_and_told(tmp_path, solver):
    start = {"position": {"z": -0.6}, "velocity": {"z": -1.0}}
    plan = make_plan(scene_of(tmp_path, SLIDE, duration=0.1, initial=start, solver=solver))
    assert any("'z' starts 0.1 m beyond its limit: it is put on it" in line for line in plan.left_out)
    r = run(plan)
    assert np.all(r.q[:, 0] == -0.5) and [(e.t, e.kind) for e in r.events] == [(0.0, "limit")]
    assert np.all(r.v[:, 0] == 0.0)
    assert r.t[0] == 0.0 and (np.diff(r.t) > 0).all()
    given = {"initial": start, "solver": solver, "physics": {"restitution": 0.5}}
    r = run(make_plan(scene_of(tmp_path, SLIDE, duration=0.1, **given)))
    assert (r.q[0, 0], r.v[0, 0]) == (-0.5, 0.5)
    inside = make_plan(scene_of(tmp_path, SLIDE, duration=0.1))
    assert not any("beyond its limit" in line for line in inside.left_out)


def test_dry_friction_stops_a_sliding_joint_where_coulomb_says(tmp_path):
    """m = 2 kg, friction 3 N, 1.5 m/s: it stops after v^2 m / (2 F) = 0.75 m, in v m / F = 1 s."""
    xml = SLIDE.replace('range="-0.5 2" limited="true"', 'frictionloss="3"').replace("0 0 -9.81", "0 0 0")
    scene = scene_of(tmp_path, xml, duration=2.0, initial={"velocity": {"z": 1.5}}, solver={"step": 0.001})
    plan = make_plan(scene)
    assert plan.engine.what == "smooth"
    assert any("smoothed below" in line for line in plan.left_out)
    r = run(plan)
    assert abs(r.q[-1, 0] - 0.75) < 0.02
    assert abs(r.v[-1, 0]) < 1e-3
    np.testing.assert_allclose(r.q[r.t < 0.9, 0], (1.5 * r.t - 0.75 * r.t**2)[r.t < 0.9], atol=2e-3)


HELD = """<mujoco><worldbody><body><joint name="a" axis="0 1 0" frictionloss="{friction}"/>
<geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5" contype="0" conaffinity="0"/>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize("share", [0.3, 0.8])
def test_what_dry_friction_holds_creeps_as_told_and_hardly_by_tolerance(tmp_path, share):
    model = mujoco.MjModel.from_xml_string(HELD.format(friction=0))
    data = mujoco.MjData(model)
    data.qpos[:] = 0.9
    mujoco.mj_forward(model, data)
    xml = HELD.format(friction=float(data.qfrc_bias[0]) / share)
    for solver, most in (({}, 0.5), ({"tolerance": 1e-5}, 5e-3), ({"tolerance": 1e-9}, 5e-3)):
        scene = scene_of(tmp_path, xml, duration=1.0, initial={"position": {"a": 0.9}}, solver=solver)
        plan = make_plan(scene)
        (line,) = (line for line in plan.left_out if "creeps" in line)
        width = float(re.search(r"below (\S+) rad/s", line)[1])
        slope = (run(plan).q[-1, 0] - 0.9) / 1.0
        assert -slope == pytest.approx(width * share / np.sqrt(1 - share**2), rel=0.2)
        assert -slope < most


def test_adaptive_error_follows_the_tolerance():
    """A pendulum from 120 degrees; its period is 4 sqrt(l/g) K(sin^2 60 deg)."""
    errors = []
    for tolerance in (1e-4, 1e-7, 1e-10):
        scene = Scene(
            duration=2.754089828887826,
            models=[{"file": "pendulum"}],
            angle="degree",
            initial={"position": {"hinge": 120.0}},
            physics={"friction": False, "limits": False},
            solver={"tolerance": tolerance},
        )
        r = run(scene, error=True)
        assert r.stats["integrator"] == "dopri5"
        true = abs(r.q[-1, 0] - r.q[0, 0])
        assert true <= 3 * r.error.angle[-1] + 1e-12
        errors.append(true)
    assert errors[0] > 30 * errors[1] > 900 * errors[2]


def test_accelerations_and_forces_are_those_of_the_engines_own_physics():
    scene = Scene(
        duration=0.6,
        models=[{"file": "arm6"}],
        physics={"contacts": "none"},
        roles={"tracked": ["shoulder", "elbow"]},
        keys=[{"joint": "waist", "times": [0, 0.6], "values": [0, 0.8]}],
    )
    plan = make_plan(scene)
    assert plan.engine.what == "smooth"
    r = run(plan)
    waist, others = 0, slice(1, 6)
    np.testing.assert_allclose(r.a[:, waist], plan.problem.clip.evaluate(r.t).a[:, waist], atol=1e-12)
    # v changes by the integral of a between samples, up to the held controls' jumps
    change = np.diff(r.v[:, others], axis=0)
    mean = 0.5 * (r.a[1:, others] + r.a[:-1, others]) * np.diff(r.t)[:, None]
    assert np.abs(change - mean)[5:].max() < 0.02
    # power of drives, friction, damping and gravity accounts for the energy
    m = r.model
    damping = np.array(m.dof_damping).reshape(m.nv, -1)[:, 0]
    width = r.stats["friction_width"]
    friction = m.dof_frictionloss * np.tanh(r.v / width)
    power = ((r.tau - damping * r.v - friction) * r.v).sum(axis=1)
    work = np.concatenate([[0.0], np.cumsum(0.5 * (power[1:] + power[:-1]) * np.diff(r.t))])
    assert np.abs(r.energy - r.energy[0] - work).max() < 0.02 * np.ptp(r.energy) + 0.02


def test_interrupted_run_keeps_what_it_has():
    scene = Scene(duration=5.0, models=[{"file": "double_pendulum"}], initial={"position": {"elbow": 1.0}})

    def stop(t):
        if t > 2.0:
            raise KeyboardInterrupt

    r = run(scene, progress=stop)
    assert r.status == "interrupted"
    assert 2.0 < r.t[-1] < 5.0
    whole = run(scene)
    np.testing.assert_array_equal(r.q, whole.q[: len(r.q)])


def test_divergence_keeps_finite_samples(tmp_path):
    xml = SLIDE.replace('range="-0.5 2" limited="true"', 'stiffness="1e6"')
    scene = scene_of(
        tmp_path,
        xml,
        duration=5.0,
        initial={"position": {"z": 0.1}},
        solver={"engine": "smooth", "step": 0.0005, "integrator": "rk4"},
    )
    problem = dataclasses.replace(make_plan(scene).problem, step=0.01)
    segment = SmoothEngine().run(problem, (0.0, 5.0), None)
    assert segment.status == "diverged"
    assert "'z'" in segment.message
    assert np.isfinite(segment.q).all()
    assert 0 < len(segment.t) < 500


WHIP = """
<mujoco><compiler angle="radian"/><worldbody><body>
  <joint name="a" axis="0 1 0" range="-1 1"/><geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5"/>
  <body pos="0 0 -.5"><joint name="b" axis="0 1 0" range="-2 2"/>
    <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5"/>
    <body pos="0 0 -.5"><joint name="c" axis="0 1 0" range="-2 2"/>
      <geom type="capsule" size=".02" fromto="0 0 0 0 0 -.5"/></body></body>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize(("restitution", "step", "fast"), [(0.0, 0.02, 3), (0.0, 0.1, 4), (0.9, 0.1, 5)])
def test_a_state_that_blows_up_on_its_way_to_a_limit_has_diverged(tmp_path, restitution, step, fast):
    physics = {"contacts": "none", "restitution": restitution}
    start = {"a": 30.0 * fast, "b": -400.0 * fast, "c": 1e3 * fast}
    solver = {"engine": "smooth", "step": step, "integrator": "rk4"}
    words = {"initial": {"position": {"a": 0.3}, "velocity": start}, "physics": physics, "solver": solver}
    r = run(scene_of(tmp_path, WHIP, duration=5.0, **words))
    assert r.status == "diverged"
    assert "too fast or too stiff" in r.message
    assert np.isfinite(r.q).all()


def test_a_joint_that_nothing_pushes_lies_on_its_limit_without_chatter(tmp_path):
    """On its bound, weightless, at rest: rounding alone must not make it meet and leave the limit."""
    xml = """
<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody><body>
  <joint name="x" type="slide" axis="1 0 0" range="-2 2" limited="true"/>
  <geom size="0.1" mass="1" contype="0" conaffinity="0"/>
  <body><joint name="swing" axis="0 1 0"/>
    <geom size="0.05" pos="0 0 -.5" mass="1e-3" contype="0" conaffinity="0"/>
  </body></body></worldbody></mujoco>"""
    for angle in (0.0, 0.3, -0.3):
        scene = scene_of(
            tmp_path,
            xml,
            duration=0.5,
            initial={"position": {"x": 2.0, "swing": angle}},
            solver={"step": 0.002},
        )
        for r in (run(scene), adaptively(make_plan(scene), 1e-8)):
            assert r.status == "done"
            assert r.q[:, 0].max() <= 2.0 + 1e-12
            assert len(r.events) <= 4
    keys = [
        {"joint": "slide", "times": [0, 0.03, 0.3], "values": [2.0, 0.0, 0.0], "curve": "step"},
        {"joint": "hinge", "times": [0, 0.03, 0.3], "values": [0.0, -1.0, 0.0], "curve": "linear"},
    ]
    scene = Scene(
        duration=0.02,
        angle="degree",
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide", "hinge"]},
        keys=keys,
        controller={"law": "pd", "frequency": 2},
    )
    plan = make_plan(scene)
    assert plan.engine.what == "smooth"
    for r in (run(plan), adaptively(plan, 1e-8)):
        assert r.status == "done"
        assert len(r.events) <= 4


# ---- steps that follow a tolerance


def adaptively(plan, tolerance, integrator="dopri5"):
    """The scene's motion in steps that follow a tolerance."""
    problem = dataclasses.replace(plan.problem, tolerance=tolerance, integrator=integrator)
    return run(dataclasses.replace(plan, problem=problem))


@pytest.mark.parametrize("integrator", ["dopri5", "dop853"])
def test_adaptive_steps_stop_a_joint_at_its_limit_at_the_closed_form_time(tmp_path, integrator):
    """It falls on the limit, lies there, is pushed off by 50 N/s and comes to rest on it again."""
    keys = [
        {
            "actuator": "push",
            "times": [0.0, 1.0, 1.5, 1.6, 2.4],
            "values": [0, 0, 25, 0, 0],
            "curve": "linear",
        }
    ]
    scene = scene_of(tmp_path, SLIDE, duration=2.4, keys=keys, solver={"step": 0.001}, rate=100)
    plan = make_plan(scene)
    r = adaptively(plan, 1e-9, integrator)
    kinds = [(e.kind, round(e.t, 9)) for e in r.events]
    fall = np.sqrt(2 * 0.5 / G)
    leave = 1.0 + 2 * G / 50
    assert kinds[:2] == [("limit", round(fall, 9)), ("limit end", round(leave, 9))]
    assert kinds[2][0] == "limit" and len(kinds) == 3
    np.testing.assert_array_equal(r.t, plan.problem.step * np.arange(0, 2401, 10))
    rest = ((r.t > fall) & (r.t < leave)) | (r.t > kinds[2][1])
    assert np.all(r.q[rest, 0] == -0.5) and np.all(r.v[rest] == 0.0)
    free = r.t < fall
    np.testing.assert_allclose(r.q[free, 0], -G * r.t[free] ** 2 / 2, atol=1e-10)
    up = (r.t > leave) & (r.t < 1.5)
    np.testing.assert_allclose(r.q[up, 0], -0.5 + 50 * (r.t[up] - leave) ** 3 / 12, atol=1e-9)
    assert r.stats["steps"] < 120


def test_a_limit_that_is_passed_and_left_within_one_step_is_not_overlooked(tmp_path):
    """A ball thrown up against a ceiling just below its apex: one step would carry it over and back."""
    apex = 1.0 / (2 * G)
    for depth, hits in ((1e-5, 1), (-1e-5, 0)):
        xml = SLIDE.replace('range="-0.5 2"', f'range="-5 {apex - depth}"')
        scene = scene_of(
            tmp_path, xml, duration=0.25, initial={"velocity": {"z": 1.0}}, solver={"step": 0.25}, rate=4
        )
        plan = make_plan(scene)
        for r in (run(plan), adaptively(plan, 1e-2), adaptively(plan, 1e-10)):
            met = [e for e in r.events if e.kind == "limit"]
            assert len(met) == hits
            if hits:
                assert abs(met[0].t - (1 / G - np.sqrt(2 * depth / G))) < 1e-8
            else:
                np.testing.assert_allclose(r.q[-1, 0], 0.25 - G * 0.25**2 / 2, atol=1e-9)


@settings(max_examples=8)
@given(problems())
def test_adaptive_and_fixed_steps_agree_on_keyed_and_controlled_trees(case):
    problem, force = case
    force = np.where(problem.dofs(Role.KEYED), 0.0, force)
    span = (0.0, problem.duration)
    # keys at 0.07 s lie on the grid of steps, so that both methods keep their order
    fixed = dataclasses.replace(problem, integrator="dop853", step=0.0005, sample_every=40)
    adaptive = dataclasses.replace(problem, integrator="dop853", tolerance=1e-11)
    ours = SmoothEngine().run(adaptive, span, Constant(force, 0))
    theirs = SmoothEngine().run(fixed, span, Constant(force, 0))
    assert ours.status == "done"
    np.testing.assert_allclose(ours.t, theirs.t, atol=1e-15)
    np.testing.assert_allclose(ours.tick_t, theirs.tick_t, atol=1e-15)
    scale = 1 + np.abs(theirs.v).max() ** 2
    np.testing.assert_allclose(ours.q, theirs.q, atol=1e-9 * scale)
    np.testing.assert_allclose(ours.v, theirs.v, atol=1e-8 * scale)
    np.testing.assert_allclose(ours.a, theirs.a, atol=1e-6 * scale)


class Pulling:
    """A sampled law of the state: a spring to zero, with a memory of its calls."""

    def __init__(self, period):
        self.period, self.seen = period, []

    def sample(self, k, t, q, v):
        from pantograph.sim.engines.interface import Held

        self.seen.append((k, t))
        return Held(np.zeros(0), np.array([-3.0 * q[0] - 0.2 * v[0]]))


def test_a_controller_is_sampled_at_its_period_whatever_the_steps_are(tmp_path):
    """m = 2 kg pushed by f held over each period: x and v follow by the closed form."""
    xml = SLIDE.replace('range="-0.5 2" limited="true"', "").replace("0 0 -9.81", "0 0 0")
    xml = xml.replace('<actuator><motor name="push" joint="z"/></actuator>', "")
    scene = scene_of(tmp_path, xml, duration=1.03, initial={"position": {"z": 1.0}}, solver={"step": 0.01})
    problem = dataclasses.replace(
        make_plan(scene).problem, tolerance=1e-8, integrator="dopri5", sample_every=1
    )
    law = Pulling(0.05)
    segment = SmoothEngine().run(problem, (0.0, 1.03), law)
    assert law.seen == [(k, pytest.approx(0.05 * k)) for k in range(21)]
    x, v = 1.0, 0.0
    for t, q, speed in zip(segment.t, segment.q[:, 0], segment.v[:, 0], strict=True):
        k = int((t + 1e-9) / 0.05)
        x, v = 1.0, 0.0
        for _ in range(k):
            f = -3.0 * x - 0.2 * v
            x, v = x + 0.05 * v + f * 0.05**2 / 4, v + f * 0.05 / 2
        dt, f = t - 0.05 * k, -3.0 * x - 0.2 * v
        assert q == pytest.approx(x + dt * v + f * dt * dt / 4, abs=1e-9)
        assert speed == pytest.approx(v + f * dt / 2, abs=1e-9)


def test_linear_keys_kick_in_adaptive_steps_too(tmp_path):
    xml = """
<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody>
  <body name="cart"><joint name="pivot" type="slide" axis="1 0 0"/>
    <geom size="0.05" mass="1" contype="0" conaffinity="0"/>
    <body name="bob"><joint name="swing" axis="0 -1 0"/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></body>
</worldbody></mujoco>"""
    keys = [{"joint": "pivot", "times": [0, 0.5007, 1.5], "values": [0, 0, 0.9993], "curve": "linear"}]
    scene = scene_of(tmp_path, xml, duration=1.0, rate=500, keys=keys, solver={"engine": "smooth"})
    r = adaptively(make_plan(scene), 1e-10)
    np.testing.assert_allclose(r.q[r.t < 0.5007, 1], 0.0, atol=1e-12)
    after = r.t > 0.5007
    kept = 0.5 * r.v[after, 1] ** 2 + G * (1 - np.cos(r.q[after, 1]))
    np.testing.assert_allclose(kept, 0.5, atol=1e-8)


def test_a_scene_that_no_step_is_small_enough_for_says_so(tmp_path):
    xml = SLIDE.replace('range="-0.5 2" limited="true"', 'stiffness="-1e6"')
    scene = scene_of(
        tmp_path,
        xml,
        duration=5.0,
        initial={"position": {"z": 0.1}},
        solver={"engine": "smooth", "step": 0.0005},
    )
    problem = dataclasses.replace(make_plan(scene).problem, tolerance=1e-6, integrator="dopri5")
    segment = SmoothEngine().run(problem, (0.0, 5.0), None)
    assert segment.status == "diverged"
    assert np.isfinite(segment.q).all()
    assert 0 < len(segment.t) < 10000
    assert "t = " in segment.message


def test_forces_on_bodies_act_as_in_the_contact_engine(tmp_path):
    """A push in the body's frame, one in the world's over time, and one that begins and ends in between."""
    xml = """
<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody>
  <body name="upper" pos="0 0 1"><joint name="a" type="ball"/>
    <geom type="capsule" fromto="0 0 0 .4 0 0" size=".04" mass="1" contype="0" conaffinity="0"/>
    <body name="lower" pos=".4 0 0"><joint name="b" axis="0 1 0"/>
      <geom type="capsule" fromto="0 0 0 .3 .1 0" size=".03" mass=".5" contype="0" conaffinity="0"/>
    </body></body>
</worldbody></mujoco>"""
    forces = [
        {"body": "lower", "force": [0.0, 3.0, 1.0], "frame": "body", "start": 0.101, "stop": 0.303},
        {
            "body": "upper",
            "torque": [[0, 0, 0], [0.5, 0, 1], [0, 0, 0]],
            "times": [0, 0.2, 0.4],
            "curve": "linear",
        },
    ]
    scene = scene_of(
        tmp_path, xml, duration=0.5, forces=forces, solver={"step": 0.0005, "integrator": "rk4"}, rate=100
    )
    plan = make_plan(scene)
    assert plan.engine.what == "smooth"
    ours, theirs = (
        run(plan),
        run(dataclasses.replace(plan, engine=dataclasses.replace(plan.engine, what="contact"))),
    )
    assert theirs.stats["engine"] == "contact"
    assert np.abs(ours.q - ours.q[0]).max() > 0.1
    np.testing.assert_allclose(ours.q, theirs.q, atol=1e-8)
    np.testing.assert_allclose(ours.a, theirs.a, atol=1e-5)
    r = adaptively(plan, 1e-10)
    np.testing.assert_allclose(r.q, ours.q, atol=1e-8)


def test_scenes_ask_for_a_tolerance_with_keys_controllers_and_limits(tmp_path):
    scene = Scene(
        duration=0.5,
        models=[{"file": "arm6"}],
        physics={"contacts": "none"},
        roles={"tracked": ["shoulder", "elbow"]},
        keys=[{"joint": "waist", "times": [0, 0.5], "values": [0, 0.8]}],
        controller={"law": "computed-torque", "period": 0.002},
        solver={"tolerance": 1e-8, "integrator": "dop853"},
    )
    plan = make_plan(scene)
    assert plan.engine.what == "smooth"
    r = run(plan, error=True)
    assert r.status == "done" and len(r.tick_t) == 250
    finer = adaptively(plan, 1e-12, "verner98")
    true = np.abs(r.q - finer.q).max()
    assert 0 < true < 1e-5
    assert 0.02 * true < r.error.angle.max() < 50 * true


@pytest.mark.parametrize("shift", [0.0, 0.15, 0.4, 0.7])
def test_a_push_that_swells_and_ebbs_within_one_step_lifts_a_resting_joint(tmp_path, shift):
    """Nothing moves, so that steps are as long as the pieces of the push; its middle alone beats m g."""
    times, values = [0.0, 1.0 + shift, 1.5 + shift, 3.0], [0.0, 19.4, 19.4, 0.0]
    keys = [{"actuator": "push", "times": times, "values": values, "curve": "natural"}]
    scene = scene_of(
        tmp_path, SLIDE, duration=3.0, keys=keys, initial={"position": {"z": -0.5}}, solver={"step": 0.001}
    )
    plan = make_plan(scene)
    push = keyed(times, values, kind="natural")
    t = np.linspace(0, 3, 30001)
    strong = t[push(t).q[:, 0] > 2 * G]
    assert 1.0 < strong[0] < strong[-1] < strong[0] + 0.6
    for r in (adaptively(plan, 1e-6), run(plan)):
        kinds = [e.kind for e in r.events]
        assert kinds == ["limit", "limit end", "limit"]
        assert abs(r.events[1].t - strong[0]) < 2e-4
        assert (np.diff(r.t) > 0).all()


def test_a_force_acts_from_its_start_to_its_stop(tmp_path):
    """m = 2 kg from rest under F between moments off the grid: v = F (stop - start) / m."""
    xml = SLIDE.replace('range="-0.5 2" limited="true"', "").replace("0 0 -9.81", "0 0 0")
    forces = [{"body": "b", "force": [0, 0, 3.0], "start": 0.1234, "stop": 0.3456}]
    scene = scene_of(tmp_path, xml, duration=0.5, forces=forces, solver={"step": 0.001})
    plan = make_plan(scene)
    r = adaptively(plan, 1e-8)
    np.testing.assert_allclose(r.v[-1, 0], 1.5 * (0.3456 - 0.1234), atol=1e-10)
    np.testing.assert_allclose(r.q[-1, 0], 0.75 * 0.2222**2 + 1.5 * 0.2222 * (0.5 - 0.3456), atol=1e-10)
    assert abs(run(plan).v[-1, 0] - r.v[-1, 0]) < 3e-3
    # on the grid fixed steps are exact as well: the end of a step sees the limit from inside
    forces[0] |= {"start": 0.1, "stop": 0.3}
    v = run(scene_of(tmp_path, xml, duration=0.5, forces=forces, solver={"step": 0.001})).v[-1, 0]
    np.testing.assert_allclose(v, 0.3, atol=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(1, 6))
def test_impulses_push_and_velocities_part_or_the_limit_is_not_touched(seed, n):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    W, b = A @ A.T + 0.1 * np.eye(n), rng.normal(size=n)
    x = complementary(W, b)
    y = W @ x + b
    assert x.min() >= 0.0
    assert y.min() > -1e-9 * (1 + np.abs(b).max())
    assert abs(x @ y) < 1e-8 * (1 + np.abs(x).max())


def chain_with_limits(n, limit):
    body = ""
    for i in reversed(range(n)):
        body = (
            f'<body pos="0 0 {-0.2 if i else 0}"><joint name="j{i}" axis="0 1 0" range="-{limit} {limit}" '
            'limited="true" damping=".01"/><geom type="capsule" fromto="0 0 0 0 0 -.2" size=".02" mass=".3" '
            f'contype="0" conaffinity="0"/>{body}</body>'
        )
    return f'<mujoco><compiler angle="radian"/><worldbody>{body}</worldbody></mujoco>'


@pytest.mark.parametrize(("n", "limit", "speed", "duration"), [(4, 0.1, 20.0, 0.15), (5, 0.3, 15.0, 0.87)])
def test_impacts_on_joints_that_rest_on_limits_of_their_own(tmp_path, n, limit, speed, duration):
    """A chain is whirled into its limits: an impact on one throws others off theirs, or onto them."""
    start = {f"j{i}": speed * (1 if i % 2 else -1) for i in range(n)}
    scene = scene_of(tmp_path, chain_with_limits(n, limit), duration=duration, initial={"velocity": start})
    plan = make_plan(scene)
    fixed, adaptive = run(plan), adaptively(plan, 1e-9)
    assert len(adaptive.events) > 8
    assert [(e.kind, e.what) for e in fixed.events] == [(e.kind, e.what) for e in adaptive.events]
    times = np.array([[a.t, b.t] for a, b in zip(fixed.events, adaptive.events, strict=True)])
    assert np.abs(times[:, 0] - times[:, 1]).max() < 1e-4
    assert len(set(times[:, 1])) < len(times), "some of them at one time"
    for r in (fixed, adaptive):
        assert np.abs(r.q).max() <= limit + 1e-12
        assert np.diff(r.energy).max() < 1e-9
        assert r.energy[-1] < r.energy[0] - 1.0


def test_a_plan_by_tolerance_promises_no_step():
    plan = make_plan(Scene(duration=0.5, models=[{"file": "pendulum"}], solver={"tolerance": 1e-8}))
    assert plan.step.what == "of any length" and "0.002 s" in plan.step.why
    with pytest.raises(
        SceneError, match="steps at a fixed rate, and not the smooth one, since bodies can touch"
    ):
        make_plan(Scene(duration=0.5, models=[{"file": "quadruped"}], solver={"tolerance": 1e-8}))


def bounces(tmp_path, restitution, solver, *, height=0.5, duration=2.5, xml=SLIDE):
    physics = {"restitution": restitution}
    start = {"position": {"z": height - 0.5}}
    return run(
        scene_of(tmp_path, xml, duration=duration, physics=physics, solver=solver, initial=start, rate=500)
    )


@pytest.mark.parametrize(
    "solver", [{}, {"step": 0.02}, {"tolerance": 1e-9}, {"tolerance": 1e-6, "integrator": "bosh3"}]
)
@pytest.mark.parametrize(("restitution", "height"), [(0.5, 0.5), (0.8, 0.2), (1.0, 0.3), (0.1, 1.0)])
def test_a_joint_rebounds_with_the_stated_part_of_its_speed(tmp_path, restitution, height, solver):
    """Times and heights of every bounce in closed form; the last are slower than 1 mm/s and end at rest."""
    r = bounces(tmp_path, restitution, solver, height=height)
    assert r.status == "done"
    times = np.array([e.t for e in r.events if e.kind == "limit"])
    first = np.sqrt(2 * height / G)
    flights = 2 * first * restitution ** np.arange(1, 1000)
    exact = np.concatenate([[first], first + np.cumsum(flights)])
    speeds = restitution ** np.arange(1, 1001) * G * first
    still = int(np.argmax(speeds <= 1e-3)) if restitution < 1 else len(speeds)
    exact = exact[: still + 1][exact[: still + 1] <= 2.5]
    assert len(times) == len(exact)
    np.testing.assert_allclose(times, exact, atol=1e-9)
    assert len([e for e in r.events if e.kind == "limit end"]) == len(exact) - (restitution < 1)
    for k, (begin, end) in enumerate(itertools.pairwise(exact[:4])):
        inside = (r.t > begin) & (r.t < end)
        s, v = r.t[inside] - begin, restitution ** (k + 1) * G * first
        np.testing.assert_allclose(r.q[inside, 0], -0.5 + v * s - G * s**2 / 2, atol=1e-8)
        mechanical = r.energy[inside] - 2 * G * -0.5
        np.testing.assert_allclose(mechanical, 2 * G * height * restitution ** (2 * k + 2), rtol=1e-6)
    if restitution < 1:
        rest = r.t > times[-1]
        assert rest.any() and np.all(r.q[rest, 0] == -0.5) and np.all(r.v[rest] == 0.0)
    assert r.stats["restitution"] == restitution


@pytest.mark.parametrize("solver", [{}, {"tolerance": 1e-8}])
def test_bounces_that_are_far_shorter_than_a_step_end_at_rest(tmp_path, solver):
    """A motor of 4 kN presses the joint on its limit: a flight at 1 mm/s takes a microsecond."""
    xml = SLIDE.replace('name="push" joint="z"', 'name="push" joint="z" gear="-4000"')
    keys = [{"actuator": "push", "times": [0.0], "values": [1.0]}]
    file = tmp_path / "pressed.xml"
    file.write_text(xml)
    scene = Scene(
        models=[{"file": str(file)}], duration=0.2, keys=keys, solver=solver, physics={"restitution": 0.7}
    )
    r = run(scene)
    a = 4000 / 2 + G
    first = np.sqrt(2 * 0.5 / a)
    count = int(np.ceil(np.log(1e-3 / (a * first)) / np.log(0.7)))
    times = [e.t for e in r.events if e.kind == "limit"]
    assert len(times) == count
    exact = first * (1 + 2 * np.sum(0.7 ** np.arange(1, count)))
    np.testing.assert_allclose(times[-1], exact, atol=1e-9)
    assert r.q[-1, 0] == -0.5 and r.v[-1, 0] == 0.0


@given(st.integers(0, 2**32 - 1), st.integers(1, 6), st.floats(0.0, 1.0))
def test_rebounds_never_make_energy_and_leave_nothing_on_its_way_into_a_limit(seed, n, restitution):
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(n, n))
    W, u = A @ A.T + 0.1 * np.eye(n), rng.normal(size=n)
    p, after = rebound(W, u, restitution)
    np.testing.assert_allclose(after, u + W @ p, atol=1e-8 * (1 + np.abs(u).max()))
    assert p.min() >= 0.0
    assert after.min() >= -1e-9 * (1 + np.abs(u).max())
    # what the impulses change in kinetic energy, u W^-1 u / 2 in these coordinates
    assert p @ (u + after) / 2 <= 1e-9 * (1 + p @ p)
    if n == 1 and u[0] < 0:
        np.testing.assert_allclose(after, -restitution * u if restitution * -u > 1e-3 else 0.0, atol=1e-12)


@pytest.mark.parametrize("tolerance", [None, 1e-9])
def test_rebounds_of_a_whirled_chain_keep_its_energy_when_they_are_elastic(tmp_path, tolerance):
    n, limit = 4, 0.3
    start = {f"j{i}": 10.0 * (1 if i % 2 else -1) for i in range(n)}
    xml = chain_with_limits(n, limit).replace('damping=".01"', "")
    solver = {"step": 1e-4} if tolerance is None else {"tolerance": tolerance}
    scene = scene_of(
        tmp_path, xml, duration=0.2, initial={"velocity": start}, physics={"restitution": 1.0}, solver=solver
    )
    r = run(scene)
    assert r.status == "done"
    assert len([e for e in r.events if e.kind == "limit"]) > 10
    assert np.abs(r.q).max() <= limit + 1e-9
    np.testing.assert_allclose(r.energy, r.energy[0], atol=1e-6 * abs(r.energy[0]) + 1e-6)


LIMITED = """
<mujoco><worldbody>
  <body><joint name="a" type="{kind}" {joint}/><geom size=".1" pos=".1 0 0" contype="0" conaffinity="0"/>
  </body>
</worldbody><tendon>{tendon}</tendon></mujoco>"""
TENDON = '<fixed name="t" limited="true" range="-1 1"><joint joint="a" coef="1"/></fixed>'


@pytest.mark.parametrize(
    ("kind", "joint", "tendon", "named"),
    [
        ("ball", 'range="0 0.3" limited="true"', "", "joint 'a': a limit of a ball joint"),
        ("hinge", "", TENDON, "tendon 't': a limit of a tendon"),
    ],
)
def test_limits_that_no_run_can_locate_are_refused_by_name(tmp_path, kind, joint, tendon, named):
    xml = LIMITED.format(kind=kind, joint=joint, tendon=tendon)
    plan = make_plan(scene_of(tmp_path, xml, duration=0.1))
    assert plan.engine.what == "contact" and named in plan.engine.why
    with pytest.raises(EngineError, match=named):
        SmoothEngine().run(plan.problem, (0.0, 0.1), None)
    without = make_plan(scene_of(tmp_path, xml, duration=0.1, physics={"limits": False}))
    assert without.engine.what == "smooth"
    assert SmoothEngine().run(without.problem, (0.0, 0.1), None).status == "done"


def test_restitution_is_asked_only_of_an_engine_that_has_it(tmp_path):
    physics = {"restitution": 0.5}
    said = make_plan(scene_of(tmp_path, SLIDE, duration=1.0, physics=physics)).left_out
    assert any("rebounds with restitution 0.5" in line and "0.001" in line for line in said)
    with pytest.raises(SceneError, match=r"physics\.restitution: rebounds belong to the smooth engine"):
        make_plan(Scene(duration=1.0, models=[{"file": "quadruped"}], physics=physics))
    with pytest.raises(SceneError, match=r"physics\.restitution: the contact engine.*soft"):
        make_plan(scene_of(tmp_path, SLIDE, duration=1.0, physics=physics, solver={"engine": "contact"}))
    with pytest.raises(SceneError, match=r"physics\.restitution.*at most 1"):
        Scene(duration=1.0, models=[{"file": "arm6"}], physics={"restitution": 1.5})
    problem = make_plan(scene_of(tmp_path, SLIDE, duration=1.0)).problem
    with pytest.raises(EngineError, match=r"restitution must lie in \[0, 1\], not -0\.5"):
        SmoothEngine().run(dataclasses.replace(problem, restitution=-0.5), (0.0, 1.0), None)


def test_differences_count_the_limits_that_are_met(tmp_path):
    """Three joints have limits: one is keyed, one is a ball, which leaves one to be met."""
    part = '<body><joint name="{n}" type="{k}" {r}/><geom size=".1" contype="0" conaffinity="0"/></body>'
    joints = [("a", "hinge", "0 1"), ("b", "hinge", "-1 1"), ("c", "ball", "0 1"), ("d", "slide", None)]
    bodies = "".join(
        part.format(n=n, k=k, r=f'range="{r}" limited="true" frictionloss=".1"' if r else "")
        for n, k, r in joints
    )
    xml = f"<mujoco><worldbody>{bodies}</worldbody></mujoco>"
    keys = [{"joint": "a", "times": [0, 1], "values": [0, 1]}]
    plan = make_plan(scene_of(tmp_path, xml, duration=1.0, keys=keys))
    lines = differences(plan.problem)
    assert len(lines) == 2, lines
    assert lines[0].startswith("limits of one joint are hard stops")
    assert lines[1].startswith("dry friction on 4 freedoms")
    bare = compile_model(plan.problem.model, keyed=["a"]).differences
    assert bare[0].startswith("limits of one joint are left out")
    assert bare[1] == "joint 'c': a limit of a ball joint, which is left out"
    assert bare[2].startswith("dry friction on 4 freedoms is left out")
    off = make_plan(
        scene_of(tmp_path, xml, duration=1.0, keys=keys, physics={"limits": False, "friction": False})
    )
    assert differences(off.problem) == []


@pytest.mark.parametrize("tolerance", [None, 1e-9])
def test_a_run_that_a_controller_breaks_ends_with_its_last_step(tmp_path, tolerance):
    plan = make_plan(scene_of(tmp_path, SLIDE, duration=1.0, solver={"step": 0.002}, rate=10))

    class Failing(Constant):
        def sample(self, k, t, q, v):
            if k == 13:
                raise ValueError("no more")
            return self.held

    problem = dataclasses.replace(
        plan.problem, tolerance=tolerance, integrator="dopri5" if tolerance else "rk4"
    )
    with pytest.raises(Broken) as caught:
        SmoothEngine().run(problem, (0.0, 1.0), Failing(np.zeros(1), 1))
    segment = caught.value.segment
    assert segment.t[-1] == pytest.approx(0.13)
    np.testing.assert_allclose(segment.q[-1, 0], -G * 0.13**2 / 2, atol=1e-9)
    assert "t = 0.13 s" in segment.message and len(segment.a) == len(segment.t)


@pytest.mark.parametrize("shift", [0.0, 1e-13, -1e-13])
def test_a_limit_met_at_the_very_end_does_not_lose_the_run(tmp_path, shift):
    end = np.sqrt(2 * 0.5 / G)
    scene = scene_of(tmp_path, SLIDE, duration=end * (1 + shift), solver={"tolerance": 1e-9})
    r = run(scene, error=True)
    assert r.status == "done"
    assert r.t[-1] == pytest.approx(end, abs=1e-12)
    np.testing.assert_allclose(r.q[-1, 0], -0.5, atol=1e-9)
    assert len(set(r.t)) == len(r.t)
    assert [e.kind for e in r.events] in ([], ["limit"])
    assert np.isfinite(r.error.length).all()


def test_tolerances_below_what_rounding_allows(tmp_path):
    """A run follows 1e-13, of which nothing can be said by one that is tighter; the recording says so."""
    scene = scene_of(tmp_path, SLIDE, duration=0.2, solver={"tolerance": 1e-13, "integrator": "dop853"})
    r = run(scene, error=True)
    assert r.status == "done" and r.error is None
    assert any("below a tolerance of 1e-12" in note for note in r.notes)
    np.testing.assert_allclose(r.q[-1, 0], -G * 0.2**2 / 2, atol=1e-13)


def whirled_tree(seed):
    """A random tree of hinges and slides between narrow limits, whirled and pushed; a joint may be keyed."""
    rng, spec = np.random.default_rng(seed), mujoco.MjSpec()
    bodies, tracks = [spec.worldbody], {}
    for i in range(rng.integers(2, 5)):
        body = bodies[rng.integers(0, len(bodies))].add_body(pos=rng.normal(size=3) * 0.3)
        slide = rng.random() < 0.5
        span = rng.choice([0.003, 0.1]) * (1 + rng.random())
        body.add_joint(
            name=f"j{i}",
            type=mujoco.mjtJoint.mjJNT_SLIDE if slide else mujoco.mjtJoint.mjJNT_HINGE,
            axis=rng.normal(size=3),
            damping=rng.choice([0.0, 0.05], size=1).repeat(3) * [1, 0, 0],
            range=np.array([-span, span]) * (1.0 if slide else 180.0 / np.pi),
            limited=True,
            frictionloss=rng.choice([0.0, 0.3]),
        )
        if i == 0 and rng.random() < 0.3:
            tracks["j0"] = keyed([0.0, 0.07, 0.3], [[0.0], [0.3 * rng.normal()], [0.0]], kind="clamped")
        size = 0.05 + 0.1 * rng.random(3)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, contype=0, conaffinity=0)
        bodies.append(body)
    model = spec.compile()
    clip = Clip(model, tracks, model.qpos0)
    roles = np.full(model.njnt, Role.PASSIVE, dtype=np.int8)
    roles[: len(tracks)] = Role.KEYED
    start, v = clip.evaluate(0.0), 3 * rng.normal(size=model.nv)
    v[clip.dofs] = start.v[clip.dofs]
    problem = Problem(
        model=model,
        state0=State(start.q, v, np.zeros(0)),
        duration=0.2,
        roles=roles,
        clip=clip,
        integrator="rk4",
        step=0.001,
        sample_every=10,
        drives=np.zeros(0, dtype=np.int8),
        restitution=float(rng.choice([0.0, 0.3, 0.7])),
        friction_width=0.05,
    )
    return problem, Constant(3 * rng.normal(size=model.nv) * (roles[model.dof_jntid] != Role.KEYED), 0)


@pytest.mark.parametrize("seed", range(2, 6))
def test_no_whirl_of_impacts_breaks_a_run(seed):
    problem, controls = whirled_tree(seed)
    fine = dataclasses.replace(problem, tolerance=1e-10, integrator="dopri5")
    fixed, adaptive = (SmoothEngine().run(p, (0.0, problem.duration), controls) for p in (problem, fine))
    free = problem.roles != Role.KEYED
    for segment in (fixed, adaptive):
        assert segment.status == "done", segment.message
        q = segment.q[:, free]
        low, high = problem.model.jnt_range[free].T
        assert (q >= low - 1e-9).all() and (q <= high + 1e-9).all()
        assert any(e.kind == "limit" for e in segment.events)
    np.testing.assert_allclose(fixed.q, adaptive.q, atol=1e-5)


@pytest.mark.parametrize("curve", ["linear", "natural"])
def test_turns_at_a_constant_rate_are_prescribed_by_tolerance_too(curve):
    """Components of their acceleration that should be zero are noise, which no polynomial resolves."""
    turned = [[1, 0, 0, 0], [0.7, 0.3, 0, 0.2]]
    keys = [{"joint": "root", "channel": "rotation", "times": [0, 0.8], "values": turned, "curve": curve}]
    scene = Scene(
        duration=0.8,
        models=[{"file": "quadruped"}],
        keys=keys,
        roles={"keyed": ["root"]},
        physics={"contacts": "none", "limits": False, "friction": False},
        solver={"integrator": "dop853", "tolerance": 1e-8},
    )
    fixed = Scene(
        **{**scene.model_dump(exclude_defaults=True), "solver": {"integrator": "dop853", "step": 1e-3}}
    )
    ours, theirs = run(scene), run(fixed)
    assert ours.status == "done" and ours.stats["steps"] < 300
    np.testing.assert_allclose(ours.q[-1], theirs.q[-1], atol=1e-6)
