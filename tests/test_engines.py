"""Keyed motion is physics: closed forms, independent integration, and equality of loops."""

from __future__ import annotations

import dataclasses
import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles.sine import sine
from pantograph.models import captured_warnings
from pantograph.sim import Scene, make_plan, run
from pantograph.sim.clip import Clip
from pantograph.sim.control import Sampled
from pantograph.sim.curves import keyed
from pantograph.sim.engines.contact import ContactEngine
from pantograph.sim.engines.derive import derive
from pantograph.sim.engines.interface import Held, Role, State
from pantograph.sim.engines.prescribe import Prescriber
from scipy.integrate import solve_ivp

G = 9.81

PIVOT = """
<mujoco><option timestep="0.002" gravity="0 0 -9.81"/><worldbody>
  <body name="cart"><joint name="pivot" type="slide" axis="{axis}"/>
    <geom size="0.05" mass="1" contype="0" conaffinity="0"/>
    <body name="bob"><joint name="swing" axis="0 -1 0"/>
      <inertial pos="0 0 -1" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></body>
</worldbody></mujoco>"""


def pivot_problem(tmp_path, curve, *, axis, angle, duration, step, integrator="rk4", rate=0.0):
    """A pendulum, l = 1 m, whose pivot moves along ``axis`` as ``curve`` says."""
    file = tmp_path / "pivot.xml"
    file.write_text(PIVOT.format(axis=axis))
    scene = Scene(
        duration=duration,
        rate=1.0 / duration,
        models=[{"file": str(file)}],
        keys=[{"joint": "pivot", "times": [0.0], "values": [0.0]}],
        initial={"position": {"swing": angle}, "velocity": {"swing": rate}},
        solver={"integrator": integrator, "step": step},
    )
    problem = make_plan(scene).problem
    start = curve(np.array(0.0))
    q0, v0 = problem.state0.q.copy(), problem.state0.v.copy()
    q0[0], v0[0] = start.q[0], start.v[0]
    clip = Clip(problem.model, {"pivot": curve}, q0)
    return dataclasses.replace(problem, clip=clip, state0=State(q0, v0, problem.state0.act))


def end(problem):
    segment = ContactEngine().run(problem, (0.0, problem.duration), None)
    assert segment.status == "done"
    return segment.q[-1, 1], segment.v[-1, 1]


@pytest.mark.parametrize(
    ("integrator", "order", "steps"),
    [("rk4", 4, (0.02, 0.01, 0.005)), ("euler", 1, (2e-3, 1e-3, 5e-4)), ("discrete", 1, (2e-3, 1e-3, 5e-4))],
)
def test_pendulum_on_accelerating_pivot_converges_at_the_order_of_the_integrator(
    tmp_path, integrator, order, steps
):
    """theta'' = -(g sin theta + x'' cos theta)/l for a pivot at x(t), theta from down towards +x."""
    a, w = 0.3, 4.0

    def f(t, y):
        return [y[1], -(G * np.sin(y[0]) - a * w * w * np.sin(w * t) * np.cos(y[0]))]

    truth = solve_ivp(f, (0, 2), [0.5, 0.0], method="DOP853", rtol=1e-13, atol=1e-14).y[0, -1]
    errors = []
    for h in steps:
        p = pivot_problem(
            tmp_path, sine(a, w), axis="1 0 0", angle=0.5, duration=2.0, step=h, integrator=integrator
        )
        errors.append(abs(end(p)[0] - truth))
    slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
    assert order - 0.3 < slope < order + 0.5
    if order == 4:
        assert errors[-1] < 1e-6


@pytest.mark.parametrize(("rate", "stays"), [(97.0, True), (80.0, False)])
def test_upright_pendulum_on_shaken_pivot_is_stable_above_the_kapitza_threshold_only(tmp_path, rate, stays):
    """a = 0.05 m, l = 1 m: the Floquet threshold is 88.637 rad/s."""
    problem = pivot_problem(
        tmp_path, sine(0.05, rate), axis="0 0 1", angle=np.pi + 1e-3, duration=15.0, step=1e-3
    )
    problem = dataclasses.replace(problem, sample_every=20)
    segment = ContactEngine().run(problem, (0.0, problem.duration), None)
    largest = np.max(np.abs(segment.q[:, 1] - np.pi))
    assert (largest < 0.05) == stays
    if not stays:
        assert largest > 1.0


@pytest.mark.parametrize("engine", ["contact", "smooth"])
@pytest.mark.parametrize("time", [0.5, 0.5007])
def test_a_pivot_that_starts_at_once_kicks_the_pendulum(tmp_path, engine, time):
    """Linear keys jump in velocity: the hanging bob stays where it is, so theta' = -V / l afterwards."""
    file = tmp_path / "pivot.xml"
    file.write_text(PIVOT.format(axis="1 0 0"))
    scene = Scene(
        duration=1.0,
        rate=500,
        models=[{"file": str(file)}],
        keys=[
            {"joint": "pivot", "times": [0.0, time, 1.5], "values": [0.0, 0.0, 1.5 - time], "curve": "linear"}
        ],
        solver={"engine": engine, "step": 0.002, "integrator": "rk4"},
    )
    r = run(scene)
    np.testing.assert_allclose(r.q[r.t < time, 1], 0.0, atol=1e-12)
    # seen from the moving pivot: theta' = -1 at theta = 0, kept energy afterwards
    after = r.t > time + 0.004
    kept = 0.5 * r.v[after, 1] ** 2 + G * (1 - np.cos(r.q[after, 1]))
    np.testing.assert_allclose(kept, 0.5, atol=1e-6)
    assert r.v[after, 1][0] < -0.99


def test_recorded_drive_force_is_what_inverse_dynamics_asks_for(tmp_path):
    problem = pivot_problem(tmp_path, sine(0.3, 4.0), axis="1 0 0", angle=0.5, duration=1.0, step=0.002)
    problem = dataclasses.replace(problem, sample_every=10)
    segment = ContactEngine().run(problem, (0.0, 1.0), None)
    derived = derive(problem, segment)
    theta, omega = segment.q[:, 1], segment.v[:, 1]
    x2 = -0.3 * 16 * np.sin(4.0 * segment.t)
    theta2 = -(G * np.sin(theta) + x2 * np.cos(theta))
    # m = 1 kg cart and bob: force on the cart = (m1 + m2) x'' + m2 l (theta'' cos - theta'^2 sin)
    force = 2 * x2 + theta2 * np.cos(theta) - omega**2 * np.sin(theta)
    np.testing.assert_allclose(derived.tau[:, 0], force, atol=1e-8)
    np.testing.assert_allclose(derived.tau[:, 1], 0.0, atol=1e-12)
    np.testing.assert_allclose(derived.a[:, 1], theta2, atol=1e-7)


joint_kinds = st.sampled_from(["hinge", "slide", "ball"])


@st.composite
def trees(draw):
    """Random trees of 2 to 6 bodies with a free or fixed base, and a mask of keyed joints."""
    n = draw(st.integers(2, 6))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    spec = mujoco.MjSpec()
    bodies = [spec.worldbody]
    for i in range(n):
        parent = bodies[draw(st.integers(0, len(bodies) - 1))]
        body = parent.add_body(name=f"b{i}", pos=rng.normal(size=3) * 0.3)
        if parent is spec.worldbody and draw(st.booleans()):
            body.add_freejoint(name=f"j{i}")
        else:
            kind = draw(joint_kinds)
            axis = rng.normal(size=3)
            kinds = {"hinge": mujoco.mjtJoint.mjJNT_HINGE, "slide": mujoco.mjtJoint.mjJNT_SLIDE}
            body.add_joint(
                name=f"j{i}", type=kinds.get(kind, mujoco.mjtJoint.mjJNT_BALL), axis=axis, damping=0.1
            )
        body.add_geom(
            size=[0.05 + 0.1 * rng.random(), 0.1, 0.1],
            type=mujoco.mjtGeom.mjGEOM_BOX,
            contype=0,
            conaffinity=0,
        )
        bodies.append(body)
    model = spec.compile()
    joints = [draw(st.booleans()) for _ in range(model.njnt)]
    keyed_dofs = np.array([joints[j] for j in model.dof_jntid])
    q = rng.normal(size=model.nq)
    mujoco.mj_normalizeQuat(model, q)
    return (
        model,
        keyed_dofs,
        q,
        rng.normal(size=model.nv),
        rng.normal(size=model.nv),
        rng.normal(size=model.nv),
    )


@settings(max_examples=60)
@given(trees())
def test_prescribed_accelerations_equal_the_reduced_equations(tree):
    """M_pp a_p = f_p - M_pk a_k: an independent solve of the whole system with a_k given."""
    model, keyed_dofs, q, v, a_key, force = tree
    d = mujoco.MjData(model)
    d.qpos[:], d.qvel[:] = q, v
    mujoco.mj_forward(model, d)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, d, M)
    rest = d.qfrc_passive + force - d.qfrc_bias
    k, p = np.flatnonzero(keyed_dofs), np.flatnonzero(~keyed_dofs)
    a = np.zeros(model.nv)
    a[k] = a_key[k]
    if len(p):
        a[p] = np.linalg.solve(M[np.ix_(p, p)], rest[p] - M[np.ix_(p, k)] @ a[k])
    drive = (M @ a - rest)[k] + force[k]

    prescriber = Prescriber(model, keyed_dofs)
    data = mujoco.MjData(prescriber.model)
    data.qpos[:], data.qvel[:] = q, v
    prescriber.settle(data, np.where(keyed_dofs, 0.0, force), a_key[k])
    scale = 1.0 + np.abs(a).max()
    np.testing.assert_allclose(data.qacc, a, atol=1e-9 * scale)
    if len(k):
        np.testing.assert_allclose(prescriber.drive, drive, atol=1e-7 * (1.0 + np.abs(drive).max()))


def test_satellite_with_a_keyed_arm_keeps_its_angular_momentum(tmp_path):
    """A floating body turns against its keyed arm; momentum stays zero, at the order of RK4."""
    file = tmp_path / "satellite.xml"
    file.write_text("""
<mujoco><option gravity="0 0 0"/><worldbody><body name="hull"><freejoint name="root"/>
  <geom type="box" size="0.3 0.2 0.2" mass="5" contype="0" conaffinity="0"/>
  <body name="arm" pos="0.3 0 0"><joint name="shoulder" type="ball"/>
    <geom type="capsule" fromto="0 0 0 0.5 0 0" size="0.05" mass="2" contype="0" conaffinity="0"/>
  </body></body>
</worldbody></mujoco>""")
    drifts, steps = [], (0.02, 0.01, 0.005)
    for h in steps:
        scene = Scene(
            duration=2.0,
            rate=20,
            models=[{"file": str(file)}],
            keys=[
                {
                    "joint": "shoulder",
                    "times": [0.0, 1.0, 2.0],
                    "values": [[0, 0, 0], [0.4, 0.9, -0.5], [0.1, -0.6, 0.8]],
                    "curve": "clamped",
                }
            ],
            solver={"step": h, "integrator": "rk4"},
        )
        r = run(scene)
        d = mujoco.MjData(r.model)
        momenta = []
        for q, v in zip(r.q, r.v, strict=True):
            d.qpos[:], d.qvel[:] = q, v
            mujoco.mj_forward(r.model, d)
            mujoco.mj_subtreeVel(r.model, d)
            momenta.append(np.concatenate([d.subtree_angmom[0], d.subtree_linvel[0]]))
        assert np.ptp(r.q[:, 3]) > 0.01  # the hull does turn
        drifts.append(np.max(np.abs(momenta)))
    assert drifts[-1] < 1e-7
    slope = np.polyfit(np.log(steps), np.log(drifts), 1)[0]
    assert slope > 3.5


@settings(max_examples=15)
@given(trees())
def test_own_runge_kutta_equals_mujocos_where_nothing_is_prescribed(tree):
    model, _, q, v, _, _ = tree
    h, n = 1e-3, 20
    model.opt.timestep, model.opt.integrator = h, int(mujoco.mjtIntegrator.mjINT_RK4)
    theirs = mujoco.MjData(model)
    theirs.qpos[:], theirs.qvel[:] = q, v
    mujoco.mj_step(model, theirs, n)
    ours = own_rk4(model, q, v, h, n)
    scale = 1 + np.abs(theirs.qpos).max() + np.abs(theirs.qvel).max()
    # two methods of order 4 differ on quaternions only by their error of a step
    np.testing.assert_allclose(ours.q[-1], theirs.qpos, atol=1e-8 * scale**3)


def own_rk4(model, q, v, h, n):
    from pantograph.sim.engines.interface import Problem, Wrench

    problem = Problem(
        model=model,
        state0=State(q, v, np.zeros(0)),
        duration=n * h,
        roles=np.zeros(model.njnt, dtype=np.int8),
        clip=Clip(model, {}, q),
        integrator="rk4",
        step=h,
        sample_every=n,
        drives=np.zeros(0, dtype=np.int8),
        wrenches=(Wrench(1, keyed([0.0], [[0.0, 0.0, 0.0]]), None),),
    )
    return ContactEngine().run(problem, (0.0, n * h), None)


def test_box_on_an_accelerating_keyed_platform_feels_g_plus_a(tmp_path):
    """Contact with a keyed body: the normal force is m (g + a), and the keyed platform does not yield."""
    file = tmp_path / "lift.xml"
    file.write_text("""
<mujoco><option timestep="0.001"/><worldbody>
  <body name="platform"><joint name="lift" type="slide" axis="0 0 1"/>
    <geom type="box" size="0.5 0.5 0.05" mass="1"/></body>
  <body name="box" pos="0 0 0.15"><freejoint/><geom type="box" size="0.1 0.1 0.1" mass="3"/></body>
</worldbody></mujoco>""")
    scene = Scene(
        duration=1.5,
        models=[{"file": str(file)}],
        keys=[{"joint": "lift", "times": [0.0, 1.5], "values": [0.0, 0.3], "curve": "clamped"}],
    )
    r = run(scene)
    np.testing.assert_array_equal(r.q[:, 0], make_plan(scene).problem.clip.evaluate(r.t).q[:, 0])
    late = r.t > 0.5
    np.testing.assert_allclose(r.normal[late], 3 * (G + r.a[late, 0]), rtol=2e-2)
    # the drive carries both
    np.testing.assert_allclose(r.tau[late, 0], 4 * (G + r.a[late, 0]), rtol=2e-2)
    assert {e.what for e in r.events if e.kind == "contact"} == {"box - platform"}


def test_wrench_over_time_moves_a_free_body_by_newtons_law(tmp_path):
    """m x'' = F(t) world; a body-frame force turns with the body. Order 4 in the stages of RK4."""
    scene = Scene(
        duration=2.0,
        rate=1,
        props=[{"name": "puck", "shape": "sphere", "size": [0.1], "mass": 2.0}],
        physics={"gravity": False},
        forces=[
            {"body": "puck", "force": [[0, 0, 0], [4, 0, 0], [0, 2, 0]], "times": [0.0, 1.0, 2.0]},
        ],
        solver={"step": 0.01, "integrator": "rk4"},
    )
    r = run(scene)
    # piecewise linear forces: x'' = F/m integrates to cubics
    x = 4 / 2 * (1 / 6 + 1 / 2 + 1 / 3)
    y = 2 / 2 * (1 / 6)
    np.testing.assert_allclose(r.q[-1, :3], [x, y, 0], atol=1e-12)


def test_constant_force_acts_between_start_and_stop():
    scene = Scene(
        duration=2.0,
        rate=1,
        props=[{"name": "puck", "shape": "sphere", "size": [0.1], "mass": 2.0}],
        physics={"gravity": False},
        forces=[{"body": "puck", "force": [4, 0, 0], "start": 0.5, "stop": 1.0}],
        solver={"step": 0.01, "integrator": "euler"},
    )
    np.testing.assert_allclose(run(scene).v[-1, 0], 4 / 2 * 0.5, rtol=1e-9)


class Counting:
    """Controls that note when they are asked, and push the first joint by the tick's number."""

    def __init__(self, period, nu, nv):
        self.period, self.nu, self.nv, self.calls = period, nu, nv, []

    def sample(self, k, t, q, v):
        self.calls.append((k, t))
        return Held(np.zeros(self.nu), np.full(self.nv, float(k % 3)))


class Careless(Counting):
    """Controls that write into the state that they are shown."""

    def sample(self, k, t, q, v):
        held = super().sample(k, t, q, v)
        q[:], v[:] = np.nan, np.nan
        return held


def test_controls_may_write_into_what_they_are_shown():
    scene = Scene(duration=0.1, rate=100, models=[{"file": "pendulum"}], solver={"step": 0.01})
    problem = make_plan(scene).problem
    one, two = (
        ContactEngine().run(problem, (0.0, 0.1), kind(0.01, problem.model.nu, problem.model.nv))
        for kind in (Counting, Careless)
    )
    np.testing.assert_array_equal(one.q, two.q)
    np.testing.assert_array_equal(one.v, two.v)


@pytest.mark.parametrize("far", [9.9e4, 1e7, 9e9])
@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_far_away_is_no_divergence(far, integrator):
    """Bodies whose coordinates are all below 1e10 run on, also where they are more than that together."""
    pucks = [
        {"name": f"puck{i}", "shape": "sphere", "size": [0.1], "position": [far, -far, far + 0.1 * i]}
        for i in range(2)
    ]
    scene = Scene(
        duration=0.05,
        props=pucks,
        physics={"gravity": False, "contacts": "none"},
        solver={"engine": "contact", "integrator": integrator},
    )
    r = run(scene)
    assert r.status == "done"
    np.testing.assert_array_equal(r.q, np.broadcast_to(r.q[0], r.q.shape))


@pytest.mark.parametrize("mode", ["plain", "pushed"])
@pytest.mark.parametrize("far", [9.9e9, 2e10])
def test_beyond_1e10_is_divergence(mode, far):
    puck = {"name": "puck", "shape": "sphere", "size": [0.1], "position": [0, 0, 0]}
    scene = Scene(
        duration=1.0,
        models=[{"file": "pendulum"}],
        props=[puck],
        physics={"gravity": False, "contacts": "none"},
        forces=[{"body": "puck", "force": [0, 0, 0]}] if mode == "pushed" else [],
        initial={"velocity": {"puck": [far, 0, 0, 0, 0, 0]}},
        solver={"engine": "contact", "step": 0.01},
    )
    r = run(scene)
    assert r.status == ("diverged" if far > 1e10 else "done")


@pytest.mark.parametrize("step", [0.01, 0.005, 0.0025])
@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_controls_are_sampled_at_their_period_and_held_whatever_the_step(step, integrator):
    scene = Scene(
        duration=0.1, rate=100, models=[{"file": "pendulum"}], solver={"step": step, "integrator": integrator}
    )
    problem = make_plan(scene).problem
    controls = Counting(0.01, problem.model.nu, problem.model.nv)
    segment = ContactEngine().run(problem, (0.0, 0.1), controls)
    assert [k for k, _ in controls.calls] == list(range(10))
    np.testing.assert_allclose([t for _, t in controls.calls], np.arange(10) * 0.01, atol=1e-12)
    np.testing.assert_allclose(segment.tick_t, np.arange(10) * 0.01, atol=1e-12)


def test_held_controls_converge_at_order_four_between_ticks():
    ends = []
    for step in (0.01, 0.005, 0.0025):
        scene = Scene(
            duration=0.5,
            models=[{"file": "double_pendulum"}],
            initial={"position": {"shoulder": 1.0}},
            solver={"step": step, "integrator": "rk4"},
        )
        problem = make_plan(scene).problem
        segment = ContactEngine().run(problem, (0.0, 0.5), Counting(0.01, problem.model.nu, problem.model.nv))
        ends.append(segment.q[-1])
    ratio = np.linalg.norm(ends[1] - ends[0]) / np.linalg.norm(ends[2] - ends[1])
    assert 12 < ratio < 20


def test_two_runs_are_equal_to_the_last_bit_and_samples_are_at_whole_steps():
    scene = Scene(duration=0.5, models=[{"file": "puppet"}], roles={"tracked": ["*_elbow"]})
    one, two = run(scene), run(scene)
    for name in ("t", "q", "v", "a", "tau", "ctrl", "tick_qfrc"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    ratio = one.t / one.stats["step"]
    np.testing.assert_allclose(ratio, np.round(ratio), atol=1e-6)


def test_kinematic_engine_returns_the_keys_without_dynamics():
    joints = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]
    keys = [{"joint": j, "times": [0, 1], "values": [0.0, 0.1 * i]} for i, j in enumerate(joints, 1)]
    scene = Scene(duration=1.0, models=[{"file": "arm6"}], keys=keys)
    plan = make_plan(scene)
    assert plan.engine.what == "kinematic"
    r = run(scene)
    assert r.stats["evaluations"] == 0
    motion = plan.problem.clip.evaluate(r.t)
    np.testing.assert_array_equal(r.q, motion.q)
    np.testing.assert_array_equal(r.v, motion.v)
    np.testing.assert_allclose(r.a, motion.a, atol=1e-9)
    # its drive forces are MuJoCo's inverse dynamics of the model as filed, and dry friction
    m = plan.setup.as_filed
    m.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_ACTUATION)
    d = mujoco.MjData(m)
    for i in range(0, len(r.t), 25):
        d.qpos[:], d.qvel[:], d.qacc[:] = r.q[i], r.v[i], motion.a[i]
        mujoco.mj_inverse(m, d)
        friction = m.dof_frictionloss * np.sign(r.v[i])
        np.testing.assert_allclose(r.tau[i], d.qfrc_inverse + friction, atol=1e-7)


def test_divergence_is_reported_with_time_joint_and_cause_and_keeps_finite_samples(tmp_path):
    file = tmp_path / "stiff.xml"
    file.write_text("""
<mujoco><worldbody><body name="b"><joint name="spring" type="slide" stiffness="1e7"/>
  <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody></mujoco>""")
    scene = Scene(
        duration=5.0,
        models=[{"file": str(file)}],
        initial={"position": {"spring": 0.1}},
        solver={"integrator": "rk4", "step": 0.01},
    )
    r = run(scene)
    assert r.status == "diverged"
    for part in ("'spring'", "t = ", "stiff", "0.01 s"):
        assert part in r.message
    assert 0 < len(r.t) < 601
    assert np.isfinite(r.q).all() and np.isfinite(r.v).all()


def test_warnings_of_mujoco_do_not_reach_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with captured_warnings() as heard:
        pass
    assert heard == []
    test_divergence_is_reported_with_time_joint_and_cause_and_keeps_finite_samples(tmp_path)
    assert not (tmp_path / "MUJOCO_LOG.TXT").exists()


def test_an_acceleration_beyond_1e10_is_divergence_before_the_state_is(tmp_path):
    file = tmp_path / "fall.xml"
    file.write_text("""
<mujoco><option gravity="0 0 -2e10"/><worldbody>
  <body><joint name="calm" type="slide" axis="1 0 0"/><geom size="0.1" contype="0" conaffinity="0"/></body>
  <body><joint name="fall" type="slide" axis="0 0 1"/><geom size="0.1" contype="0" conaffinity="0"/></body>
</worldbody></mujoco>""")
    solver = {"engine": "contact", "integrator": "euler", "step": 1e-3}
    r = run(Scene(duration=0.01, models=[{"file": str(file)}], solver=solver))
    assert r.status == "diverged"
    assert "'fall'" in r.message


@pytest.mark.parametrize("integrator", ["rk4", "euler"])
def test_activation_under_a_keyed_command_follows_its_filter(tmp_path, integrator):
    """act' = (ctrl - act) / T from rest with ctrl = 1: the force is 1 - exp(-t / T) (MuJoCo: Actuation)."""
    file = tmp_path / "filter.xml"
    file.write_text("""
<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="push" type="slide"/>
  <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody>
  <actuator><general name="lag" joint="push" dyntype="filter" dynprm="0.2"/></actuator></mujoco>""")
    scene = Scene(
        duration=1.0,
        models=[{"file": str(file)}],
        keys=[{"actuator": "lag", "times": [0], "values": [1]}],
        solver={"engine": "contact", "integrator": integrator, "step": 1e-3},
    )
    r = run(scene)
    tolerance = 1e-10 if integrator == "rk4" else 2e-3  # h / (2 e T)
    np.testing.assert_allclose(r.tau[:, 0], 1 - np.exp(-r.t / 0.2), atol=tolerance)


@pytest.mark.parametrize("mode", ["controller", "keys", "off"])
def test_actuators_do_what_their_drive_says(mode):
    """arm6: its own position servos off, along the keys, or as the controller wants."""
    scene = Scene(
        duration=1.0,
        models=[{"file": "arm6"}],
        roles={"tracked": ["*"]},
        keys=[{"joint": "elbow", "times": [0, 1], "values": [0.4, 0.8]}],
        initial={"position": {"elbow": 0.4, "shoulder": 0.3}},
        actuators={"*": mode},
        controller={"law": "pd", "frequency": 8.0},
    )
    plan = make_plan(scene)
    r = run(plan)
    m = plan.problem.model
    elbow = m.joint("elbow").dofadr[0]
    force = np.abs(m.actuator_forcerange[:, 1])
    if mode == "off":
        assert not r.ctrl.any()
        assert r.tau.any()  # ideal joint forces of the controller
    else:
        assert np.all(np.abs(r.tau) <= force[None, :] * np.abs(m.actuator_gear[:, 0]) + 1e-9)
        assert r.ctrl.any()
    if mode == "keys":
        np.testing.assert_allclose(r.ctrl[:, 2], plan.problem.clip.evaluate(r.t).q[:, elbow], atol=1e-12)
    assert abs(r.q[-1, elbow] - 0.8) < 0.05


@pytest.mark.parametrize("curve", ["auto", "linear"])
def test_a_servo_along_keys_is_commanded_where_the_clip_has_its_joint(curve):
    """Also one whose joint has no keys: it is held where the joint is at first."""
    scene = Scene(
        duration=1.0,
        models=[{"file": "arm6"}],
        roles={"tracked": ["*"]},
        keys=[
            {"joint": "elbow", "times": [0, 0.3, 1], "values": [0.4, 0.1, 0.8], "curve": curve},
            {"joint": "waist", "times": [0, 1], "values": [0.2, -0.8], "curve": curve},
        ],
        initial={"position": {"shoulder": 0.3}},
        actuators={"*": "keys"},
    )
    problem = make_plan(scene).problem
    m, t = problem.model, np.linspace(-0.1, 1.2, 27)
    q = problem.clip.evaluate(t).q
    assert sorted(problem.servo) == list(range(m.nu))
    for i, command in problem.servo.items():
        column = m.jnt_qposadr[m.actuator_trnid[i, 0]]
        np.testing.assert_array_equal(command(t), m.actuator_gear[i, 0] * q[:, column])


def test_roles_split_every_dof_exactly_once():
    plan = make_plan(Scene(duration=0.1, models=[{"file": "puppet"}], roles={"tracked": ["*_elbow", "neck"]}))
    masks = [plan.problem.dofs(r) for r in Role]
    assert np.array_equal(np.sum(masks, axis=0), np.ones(plan.problem.model.nv))
    assert len(list(itertools.chain(*(plan.joints(r) for r in Role)))) == plan.problem.model.njnt


def test_a_long_scene_begins_at_once():
    """The targets of a controller are those of the keys at every tick, and not all worked out at once."""
    scene = Scene(
        duration=1e7,
        models=[{"file": "pendulum"}],
        roles={"tracked": ["hinge"]},
        keys=[{"joint": "hinge", "times": [0, 1, 2.5], "values": [0, 1, 0], "after": "loop"}],
        controller={"law": "pd", "period": 0.002},
    )
    plan = make_plan(scene)
    seen = []

    class Law:
        def start(self):
            return None

        def __call__(self, t, q, v, target, memory):
            seen.append(target)
            return np.zeros(1), None

    sampled = Sampled(Law(), plan.problem, 0.002)
    ticks = [0, 1, 1023, 1024, 1025, 5000, 3, 4_999_999_999]
    for k in ticks:
        sampled.sample(k, 0.002 * k, np.zeros(1), np.zeros(1))
    expected = plan.problem.clip.evaluate(0.002 * np.array(ticks))
    for i, name in enumerate(("q", "v", "a")):
        np.testing.assert_array_equal([target[i] for target in seen], getattr(expected, name))
