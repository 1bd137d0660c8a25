"""The smooth engine against MuJoCo, closed laws, and exact derivatives."""

import re
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from pantograph.sim.compile.jit import preferred_lanes
from pantograph.sim.curves import keyed
from pantograph.sim.dynamics import LinearFeedback, compile_model, joint_pd, unsupported
from pantograph.sim.dynamics.derivatives import JACOBIANS
from pantograph.sim.dynamics.functions import FORMULATIONS, FUNCTIONS
from pantograph.sim.dynamics.layout import Layout, keyed_joints
from pantograph.sim.dynamics.motion.prescribed import pieces_of
from pantograph.sim.dynamics.symbolic import Equations
from pantograph.sim.errors import EngineError
from pantograph.sim.integrate import ODE, TABLEAUS, Event, Status, solve
from strategies import random_states, seeds, trees

MJCF = Path(__file__).parent.parent / "models" / "mjcf"
OURS = sorted(MJCF.glob("*.xml"))
FEATURES = """
<mujoco><option timestep="0.001" {fluid}/><compiler angle="radian"/>
<worldbody>
 <body pos="0 0 1" gravcomp="0.4"><freejoint name="f"/><geom size=".1 .2 .3" type="box"/>
  <body pos=".2 .1 .3" quat="1 .2 .3 .4">
   <joint name="b" type="ball" stiffness="3" damping=".2" armature=".03"/>
   <geom type="capsule" size=".05" fromto="0 0 0 .1 .2 .3"/>
   <body pos=".1 .2 .3" euler=".3 .2 .1">
    <joint name="h1" axis="1 2 3" pos=".01 .02 .03" stiffness="2 .5 .7" springref=".3" damping=".1 .2 .3"
     armature=".02" actuatorfrcrange="-2 2"/>
    <joint name="s1" type="slide" axis="0 1 1" stiffness="2" damping=".3 .1 .05" ref=".1"/>
    <geom type="box" size=".05 .02 .1" pos="0 .1 0"/></body></body>
  <body pos="-.1 .1 0" gravcomp="1"><joint name="h2" axis="0 1 0" ref=".5"/>
   <geom type="box" size=".05 .02 .1" pos="0 .1 0"/>
   <body><geom type="box" size=".03 .02 .1" pos="0.3 .1 0.1" euler=".1 .2 .3"/></body>
  </body>
 </body>
 <body pos="1 0 0"><joint name="h3" axis="0 0 1"/><geom size=".1" pos=".1 0 0"/>
  <body pos=".5 0 0" euler="0.0000001 0 0"><joint name="h4" axis="0 0 1"/><geom size=".1" pos=".1 0 0"/>
   <body pos=".5 .1 0.2"><joint name="h5" axis="0 1 0"/><geom size=".05" pos=".1 0 0"/></body></body></body>
</worldbody>
<tendon><fixed name="t" stiffness="4 1 2" damping=".3 .1 .2" springlength=".1 .3">
 <joint joint="h1" coef=".5"/><joint joint="h2" coef="-1.5"/></fixed></tendon>
<actuator><motor joint="h1" gear="3" ctrllimited="true" ctrlrange="-.5 .6"/>
 <position joint="h2" kp="20" kv="2" forcerange="-3 3"/><velocity joint="s1" kv="4"/>
 <general tendon="t" gear="2" gaintype="affine" gainprm="1 .3 .2" biastype="affine" biasprm=".2 .3 .4"/>
 <general joint="h3" dyntype="filter" dynprm=".2" gainprm="2"/>
 <general joint="h4" dyntype="integrator" gainprm="2"/><motor joint="f" gear="1 2 3 4 5 6"/>
 <position joint="b" kp="3" kv=".1" gear=".5 .2 .3"/>
 <general joint="h5" dyntype="filterexact" dynprm=".2" gainprm="2"/></actuator>
</mujoco>"""
SWING = """<mujoco><option gravity="0 0 -9.81"/><worldbody>
 <body><joint name="a" axis="0 1 0"/><geom size=".1" pos=".5 0 0" mass="1"/>
  <body pos="1 0 0"><joint name="b" axis="0 1 0" damping=".1"/><geom size=".1" pos=".5 0 0" mass="2"/></body>
 </body>
 </worldbody><actuator><motor joint="a" gear="2"/><motor joint="b"/></actuator></mujoco>"""
TOP = """<mujoco><worldbody><body pos="0 0 1"><freejoint/><geom type="box" size=".1 .2 .3" mass="2"/>
 <body pos=".3 .1 0"><joint name="b" type="ball"/>
  <geom type="box" size=".05 .2 .1" pos=".1 0 .2" mass="1"/></body>
 </body></worldbody></mujoco>"""


def unconstrained(model):
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    return model


def of_text(xml):
    return unconstrained(mujoco.MjModel.from_xml_string(xml))


def dressed(model, seed):
    """The model with random springs, dampers and armature."""
    rng = np.random.default_rng(seed)
    scalar = np.isin(model.jnt_type, [2, 3])
    model.dof_damping[:] = rng.uniform(0, 0.5, model.nv)
    for joint in range(model.njnt):
        model.dof_armature[model.dof_jntid == joint] = rng.choice([0.0, 0.3])
    model.jnt_stiffness[scalar] = rng.uniform(0, 3, scalar.sum())
    model.qpos_spring[:] = model.qpos0 + 0.0
    return unconstrained(model)


def forwarded(model, q, v, act=(), u=()):
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = q, v, act, u
    mujoco.mj_forward(model, data)
    return data


def value(eq, name, kind="composite", **given):
    """Function `name` of the equations by NumPy, without a compiler; what is not given is zero."""
    tape = JACOBIANS[name](eq, 1) if name in JACOBIANS else FUNCTIONS[name](eq, kind)
    out = tape.evaluate(*(np.asarray(given.get(k, np.zeros(n))) for k, n in tape.inputs.items()))
    return dict(zip(tape.outputs, out, strict=True))


def equations(model, keyed=(), **options):
    return Equations(model, Layout(model, keyed_joints(model, keyed)), **options)


def close(got, expected, tolerance=1e-10):
    scale = max(np.abs(expected).max(initial=0.0), 1e-3)
    np.testing.assert_allclose(got, expected, rtol=0, atol=tolerance * scale)


def states_of(model, seed, n):
    rng = np.random.default_rng(seed)
    q, v, _ = random_states(model, seed, n)
    return q, v, rng.normal(size=(n, model.na)), rng.normal(size=(n, model.nu))


# ---- agreement with MuJoCo


@settings(max_examples=60)
@given(trees(), seeds)
def test_any_tree_moves_as_in_mujoco(model, seed):
    model = dressed(model, seed)
    if not model.nv:
        return
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    eq = equations(model)
    q, v, a = (x[0] for x in random_states(model, seed, 1))
    data = forwarded(model, q, v)
    for kind in FORMULATIONS:
        close(value(eq, "forward", kind, q=q, v=v)["a"], data.qacc)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    close(value(eq, "mass_matrix", q=q)["M"], M.ravel())
    close(value(eq, "bias", q=q, v=v)["bias"], data.qfrc_bias)
    poses = value(eq, "poses", q=q)
    close(poses["p"], data.xpos.ravel())
    close(poses["R"], data.xmat.ravel())
    close(value(eq, "sites", q=q)["p"], data.site_xpos.ravel())
    energy = value(eq, "energy", q=q, v=v)
    close(energy["kinetic"], data.energy[1:])
    close(energy["potential"], data.energy[:1])
    data.qacc[:] = a
    mujoco.mj_inverse(model, data)
    close(value(eq, "inverse", q=q, v=v, a=a)["tau"], data.qfrc_inverse)


@pytest.mark.parametrize("fluid", ["", 'wind="0.3 -.2 .1" density="1.2" viscosity="0.3"'])
def test_every_feature_acts_as_in_mujoco(fluid):
    model = of_text(FEATURES.format(fluid=fluid))
    smooth = compile_model(model, cache=None)
    q, v, act, u = states_of(model, 3, 50)
    got, rates = smooth.forward(q, v, u, act=act), smooth.evaluate("rate", q=q, v=v, act=act, u=u)["dx"]
    for i in range(len(q)):
        data = forwarded(model, q[i], v[i], act[i], u[i])
        close(got[i], data.qacc)
        close(rates[i, model.nq + model.nv :], data.act_dot)


AT_ACTUATORS = """<mujoco><worldbody><body pos="0 0 1"><freejoint name="f"/><geom type="box" size=".1 .2 .3"/>
 <body pos=".2 .1 .3"><joint name="b" type="ball" damping=".1"/><geom type="box" size=".05 .1 .1"/>
  <body pos=".1 .2 .3"><joint name="h" axis="1 2 3" damping=".1" armature=".02"/>
   <geom type="box" size=".05 .02 .1" pos="0 .1 0"/></body></body></body></worldbody>
 <tendon><fixed name="t" damping=".2"><joint joint="h" coef="2"/></fixed></tendon>
 <actuator><motor joint="h" gear="-3" armature=".1" damping=".2 .3 .1"/>
  <position joint="h" gear="2" kp="3" armature=".05" damping=".4" group="3"/>
  <motor joint="b" gear="3 1 2" armature=".04" damping=".2"/>
  <motor joint="f" gear="1 2 3 0 0 0" {free}/>
  <velocity tendon="t" gear="1.5" kv=".1" damping=".3 .1"/></actuator></mujoco>"""


@pytest.mark.parametrize("free", ["", 'armature=".3" damping=".1"'])
@pytest.mark.parametrize("kind", FORMULATIONS)
def test_damping_and_armature_given_at_actuators_act_as_in_mujoco(kind, free):
    model = of_text(AT_ACTUATORS.format(free=free))
    assert not unsupported(model)
    eq = equations(model)
    q, v, _, u = states_of(model, 8, 5)
    for off in (0, int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)):
        model.opt.disableflags |= off
        eq = equations(model)
        for i in range(len(q)):
            data = forwarded(model, q[i], v[i], (), u[i])
            close(value(eq, "forward", kind, q=q[i], v=v[i], u=u[i])["a"], data.qacc)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    close(value(eq, "mass_matrix", q=q[-1])["M"], M.ravel())


def test_wrenches_on_bodies_act_as_in_mujoco():
    xml = TOP.replace("</worldbody>", '<body name="still" pos="1 0 0"><geom size=".1"/></body></worldbody>')
    model = of_text(xml)
    wrenches = [(1, False), (2, True), (2, False), (3, False)]
    smooth = compile_model(model, wrenches=wrenches, cache=None)
    assert smooth.layout.nw == 24
    q, v, _, _ = states_of(model, 2, 5)
    w = np.random.default_rng(1).normal(size=(5, 4, 6))
    got = smooth.forward(q, v, w=w.reshape(5, 24))
    for i in range(5):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = q[i], v[i]
        mujoco.mj_kinematics(model, data)
        for (body, own), wrench in zip(wrenches, w[i], strict=True):
            R = data.xmat[body].reshape(3, 3) if own else np.eye(3)
            data.xfrc_applied[body] += np.concatenate([R @ wrench[:3], R @ wrench[3:]])
        mujoco.mj_forward(model, data)
        close(got[i], data.qacc)


@pytest.mark.parametrize("path", OURS, ids=lambda p: p.stem)
def test_our_models_agree_over_the_whole_state_space(path):
    model = unconstrained(mujoco.MjModel.from_xml_path(str(path)))
    assert not unsupported(model)
    eq = equations(model)
    q, v, act, u = states_of(model, 1, 40)
    n = len(q)
    shared = {"tau": np.zeros((n, model.nv)), "w": np.zeros((n, 0)), "p": np.zeros((n, 0))}
    got = value(eq, "forward", "articulated", q=q, v=v, act=act, u=u, **shared)["a"]
    for i in range(n):
        close(got[i], forwarded(model, q[i], v[i], act[i], u[i]).qacc)


def test_nearly_parallel_axes_and_dust_beside_boulders_cost_no_accuracy():
    xml = """<mujoco><compiler angle="radian"/><worldbody><body>
      <joint axis="0 0 1"/><geom type="box" size="2 2 2" mass="1000"/>
      <body pos="1 .7 .5" euler="{tilt} 0 0"><joint axis="0 0 1"/><geom type="box" size=".3 .2 .1" mass="1"/>
      <body pos="1 0 0" euler="1.5708 0 0"><joint axis="0 0 1"/>
      <inertial pos=".001 .002 0" mass="1e-5" diaginertia="1e-12 2e-12 2.5e-12"/></body></body></body>
      </worldbody></mujoco>"""
    for tilt in (1e-15, 1e-12, 1e-9, 1e-6, 1e-3):
        model = of_text(xml.format(tilt=tilt))
        eq = equations(model)
        q, v, _, _ = states_of(model, 0, 5)
        for i in range(5):
            data = forwarded(model, q[i], v[i])
            for kind in FORMULATIONS:
                close(value(eq, "forward", kind, q=q[i], v=v[i])["a"], data.qacc, 1e-9)


# ---- roles


@settings(max_examples=30)
@given(trees(), seeds)
def test_keyed_joints_act_by_their_prescribed_motion(model, seed):
    model = dressed(model, seed)
    rng = np.random.default_rng(seed)
    keyed = [j for j in range(model.njnt) if rng.random() < 0.5]
    eq = equations(model, keyed)
    lay = eq.layout
    if not lay.nv:
        return
    q, v, a = (x[0] for x in random_states(model, seed, 1))
    data = forwarded(model, q, v)
    M = np.zeros((model.nv, model.nv))
    mujoco.mj_fullM(model, data, M)
    force = data.qfrc_passive + data.qfrc_actuator - data.qfrc_bias
    free, held = lay.v_free, lay.v_keyed
    expected = np.linalg.solve(M[np.ix_(free, free)], force[free] - M[np.ix_(free, held)] @ a[held])
    drive = M[np.ix_(held, free)] @ expected + M[np.ix_(held, held)] @ a[held] - force[held]
    given_ = {"q": q[lay.q_free], "v": v[free], "w": np.concatenate([q[lay.q_keyed], v[held], a[held]])}
    for kind in FORMULATIONS:
        close(value(eq, "forward", kind, **given_)["a"], expected, 1e-9)
    close(value(eq, "drive", **given_)["drive"], drive, 1e-9)


def test_a_keyed_pendulum_carries_the_other_one():
    model = of_text(SWING)
    smooth = compile_model(model, keyed=["a"], cache=None)

    def motion(t):
        return np.stack([0.3 * np.sin(5 * t), 1.5 * np.cos(5 * t), -7.5 * np.sin(5 * t)], axis=1)

    path = smooth.rollout([0.2], [0.0], step=1e-3, steps=500, w=motion)
    finer = smooth.rollout([0.2], [0.0], step=2.5e-4, steps=2000, every=4, w=motion)
    assert np.abs(path.q - finer.q).max() < 1e-10
    by_solve = solve(
        smooth.problem(w=motion), (0.0, 0.5), [0.2, 0.0], method="dop853", rtol=1e-12, atol=1e-12
    )
    close(path.x[-1], by_solve.y[-1], 1e-10)
    with pytest.raises(EngineError, match="prescribed motion"):
        smooth.forward([0.2], [0.0])


def keyed_by(curve):
    """Motion w(t) of one keyed hinge along a curve."""

    def w(t):
        s = curve(t)
        return np.concatenate([s.q, s.v, s.a], axis=1)

    return w


@pytest.mark.parametrize("method", ["dopri5", "dop853", "verner98"])
@pytest.mark.parametrize("told", [True, False], ids=["breaks told", "breaks found"])
def test_steps_that_follow_a_tolerance_see_keyed_motion_at_every_moment(method, told, arms):
    """Monotone cubics whose accelerations jump at the keys, against RK4 whose steps end there."""
    smooth = arms["a"]
    curve = keyed([0.0, 0.3, 0.7, 1.0], [0.0, 1.2, -0.6, 0.4])
    breaks = curve.breaks_between(0.0, 1.0) if told else ()
    times = np.linspace(0.0, 1.0, 41)
    exact = _between_breaks(smooth, curve, [0.2], [0.0], times)
    for tolerance, bound in ((1e-5, 3e-4), (1e-11, 1e-9)):
        path = smooth.integrate(
            [0.2], [0.0], times, method=TABLEAUS[method], rtol=tolerance, atol=tolerance,
            w=keyed_by(curve), breaks=breaks,
        )  # fmt: skip
        assert path.success
        assert np.abs(path.x - exact).max() < bound
    # a method of order p gains little by steps that straddle a break: they are few only when they end there
    assert path.rejected < 5 + path.evaluations / TABLEAUS[method].stages / 4
    batch = smooth.integrate(
        np.full((5, 1), 0.2), [0.0], times, method=TABLEAUS[method], rtol=1e-11, atol=1e-11,
        w=keyed_by(curve), breaks=breaks,
    )  # fmt: skip
    np.testing.assert_allclose(batch.x, np.tile(path.x, (5, 1, 1)), rtol=0, atol=1e-10)


def _between_breaks(smooth, curve, q, v, times):
    """States at `times` by small steps of RK4 that see the limits from inside at both ends of each."""
    x, out = np.concatenate([q, v]), [np.concatenate([q, v])]
    for t0, t1 in pairwise(times):
        edges = [t0, *curve.breaks_between(t0, t1), t1]
        for a, b in pairwise(edges):
            n = 60

            def w(t, a=a, b=b):
                left, right = curve(t, left=True), curve(t)
                at_end = (np.abs(t - b) < 1e-12)[:, None]
                return np.concatenate(
                    [np.where(at_end, *pair) for pair in zip(left, right, strict=True)], axis=1
                )

            x = smooth.rollout(x[:1], x[1:], step=(b - a) / n, steps=n, w=w, t0=a).x[-1]
        out.append(x)
    return np.array(out)


def test_a_keyed_velocity_that_jumps_pulls_the_others_along():
    """Linear keys of a slide that carries a pendulum: at rest, then at V: it turns at -V / l afterwards."""
    smooth = compile_model(of_text(CART), keyed=["cart"], cache=None)
    curve = keyed([0.0, 0.4, 1.4], [0.0, 0.0, 1.5], kind="linear")
    times = np.array([0.0, 0.2, 0.4, 0.4 + 1e-9, 0.9])
    for breaks, first in ((curve.breaks_between(0.0, 0.9), 2), ((), 3)):
        path = smooth.integrate([0.0], [0.0], times, w=keyed_by(curve), breaks=breaks, rtol=1e-11, atol=1e-11)
        np.testing.assert_allclose(path.x[:2], 0.0, atol=1e-12)
        # at the jump itself, where it is known to the last digit, the record is what follows it
        np.testing.assert_allclose(path.v[first:4, 0], -1.5, atol=1e-7)
        kept = 0.5 * path.v[first:, 0] ** 2 + 9.81 * (1 - np.cos(path.q[first:, 0]))
        np.testing.assert_allclose(kept, 0.5 * 1.5**2, atol=1e-8)


def test_compiled_laws_and_keyed_motion_run_together_to_a_tolerance(arms):
    """Breaks between the samples of a controller: neither moves the other."""
    smooth = arms["a"]
    curve = keyed([0.0, 0.137, 0.5], [0.0, 0.8, -0.2])
    K = np.array([[0.0, 0.0], [3.0, 0.4]])
    law = LinearFeedback(K, q_ref=np.linspace(0, 1, 10)[:, None])
    times = np.linspace(0.0, 0.5, 11)
    path = smooth.integrate(
        [0.2], [0.1], times, law, hold=0.05, w=keyed_by(curve), method=TABLEAUS["dop853"],
        rtol=1e-12, atol=1e-12,
    )  # fmt: skip
    x, u = np.array([0.2, 0.1]), []
    for k in range(10):
        u.append(K @ np.array([np.linspace(0, 1, 10)[k] - x[0], -x[1]]))
        part = smooth.integrate(
            x[:1], x[1:], times[k : k + 2], u[-1], w=keyed_by(curve), breaks=curve.breaks,
            method=TABLEAUS["dop853"], rtol=1e-12, atol=1e-12,
        )  # fmt: skip
        x = part.x[-1]
        np.testing.assert_allclose(path.x[k + 1], x, rtol=0, atol=1e-10)
    np.testing.assert_allclose(path.u, u, rtol=0, atol=1e-9)


def test_a_function_that_controls_is_called_once_a_period_and_held(arms):
    """The compiled law and the same in Python; the last period is cut, records lie on and between samples."""
    smooth, hold = arms["a"], 0.05
    curve = keyed([0.0, 0.2, 0.47], [0.0, 0.5, 0.1], kind="linear")  # one of its jumps is at a sample
    K = np.array([[0.0, 0.0], [3.0, 0.4]])
    times = np.unique([*np.linspace(0.0, 0.47, 33), 0.1, 0.15, 0.2 + 1e-12])
    given = {"w": keyed_by(curve), "breaks": curve.breaks, "hold": hold, "method": TABLEAUS["dop853"]}
    given |= {"rtol": 1e-12, "atol": 1e-12}
    asked = []

    def law(t, q, v):
        asked.append(t)
        return -(np.concatenate([q, v], axis=-1) @ K.T)

    q, v = np.array([[0.2], [-0.4], [0.7]]), np.array([[0.1], [0.0], [-0.3]])
    for q0, v0 in ((q[0], v[0]), (q, v)):
        asked.clear()
        compiled = smooth.integrate(q0, v0, times, LinearFeedback(K), **given)
        path = smooth.integrate(q0, v0, times, law, **given)
        assert path.success and path.x.shape == compiled.x.shape and path.u.shape == compiled.u.shape
        np.testing.assert_allclose(asked, hold * np.arange(10), atol=1e-15)
        np.testing.assert_allclose(path.x, compiled.x, rtol=0, atol=1e-10)
        np.testing.assert_allclose(path.u, compiled.u, rtol=0, atol=1e-9)
        assert np.all(path.evaluations < 1.5 * compiled.evaluations), "steps go on where they were"
    with pytest.raises(EngineError, match="Give its period, hold"):
        smooth.integrate(q[0], v[0], times, law, **(given | {"hold": None}))


def test_a_function_that_controls_spares_the_other_motions_of_a_batch():
    smooth = compile_model(of_text(SWING), cache=None)
    law = lambda t, q, v: np.where(np.arange(2)[:, None] == 1, np.nan, -q)  # noqa: E731
    times = np.linspace(0.0, 1.0, 11)
    path = smooth.integrate([[0.3, 0.1], [1.5, 0.1]], [0.0, 0.0], times, law, hold=0.1)
    alone = smooth.integrate([0.3, 0.1], [0.0, 0.0], times, lambda t, q, v: -q, hold=0.1)
    assert path.status[0] == 0 and path.status[1] != 0
    np.testing.assert_allclose(path.x[0], alone.x, atol=1e-12)
    assert np.isnan(path.x[1, 1:]).all()


def test_prescribed_motion_becomes_polynomials_that_agree_to_rounding():
    smooth_ = lambda t: np.stack([np.sin(7 * t), np.exp(-t) * t**3], axis=1)  # noqa: E731
    t = np.linspace(0.0, 3.0, 501)
    pieces = pieces_of(smooth_, 2, 0.0, 3.0)
    assert not len(pieces.breaks)
    np.testing.assert_allclose(pieces(t), smooth_(t), rtol=0, atol=1e-12)
    # a cubic needs four coefficients and no more
    cubic = pieces_of(lambda t: (t**3 - 2 * t)[:, None], 1, -1.0, 2.0)
    assert cubic.coefficients.shape == (1, 1, 4)

    def jumping(t):
        return np.where(t < 1.2345, np.cos(t), 3.0 - t)[:, None]

    pieces = pieces_of(jumping, 1, 0.0, 3.0)
    np.testing.assert_allclose(pieces.knots[pieces.breaks], [1.2345], atol=1e-11)
    np.testing.assert_allclose(pieces(t), jumping(t), rtol=0, atol=1e-12)
    np.testing.assert_allclose(pieces([1.5], left=True), pieces([1.5]))
    # a jump on a boundary between halves
    rng = np.random.default_rng(3)
    spline = keyed(np.sort(rng.uniform(0, 4, 9)), rng.normal(size=(9, 2)), kind="natural", after="hold")
    known = spline.knots_between(0.0, 4.0)
    told = pieces_of(lambda t: spline(t).q, 2, 0.0, 4.0, spline.breaks_between(0.0, 4.0), known)
    np.testing.assert_array_equal(told.knots, [0.0, *known, 4.0])
    t = rng.uniform(0, 4, 99)
    np.testing.assert_allclose(told(t), spline(t).q, atol=1e-12)
    sign = pieces_of(lambda t: np.sign(t - 1.5)[:, None], 1, 0.0, 3.0)
    assert sign.knots[sign.breaks].tolist() == [1.5]
    # a kink is a break as well, also on such a boundary
    for kink in (1.0, 1.5):
        bent = pieces_of(lambda t, kink=kink: np.abs(t - kink)[:, None], 1, 0.0, 3.0)
        np.testing.assert_allclose(bent.knots[bent.breaks], [kink], atol=1e-10)
    with pytest.raises(EngineError, match="not finite at t = "):
        pieces_of(lambda t: np.where(t < 1, t, np.nan)[:, None], 1, 0.0, 3.0)
    with pytest.raises(EngineError, match=r"shape \(16,\)"):
        pieces_of(lambda t: t, 1, 0.0, 3.0)
    with pytest.raises(EngineError, match="too wild"):
        pieces_of(lambda t: np.random.default_rng(0).normal(size=(len(t), 1)), 1, 0.0, 3.0)


CART = """<mujoco><worldbody><body><joint name="cart" type="slide" axis="1 0 0"/>
 <geom size=".05" mass="1"/><body><joint name="swing" axis="0 -1 0"/>
 <inertial pos="0 0 -1" mass="1" diaginertia="1e-9 1e-9 1e-9"/></body></body></worldbody></mujoco>"""


@pytest.fixture(scope="module")
def arms():
    """The swinging arm with one joint keyed."""
    return {joint: compile_model(of_text(SWING), keyed=[joint], cache=None) for joint in "ab"}


@pytest.mark.parametrize("joints", [["a"], [0], np.array([True, False])])
def test_keyed_joints_have_names_numbers_or_a_mask(joints):
    assert keyed_joints(of_text(SWING), joints) == (0,)


def test_keyed_joints_that_do_not_exist_or_are_cut_in_two_are_refused():
    model = of_text(TOP)
    with pytest.raises(EngineError, match="no joint 'elbow'"):
        keyed_joints(model, ["elbow"])
    with pytest.raises(EngineError, match="keyed in part"):
        keyed_joints(model, np.arange(model.nv) == 7)
    with pytest.raises(EngineError, match=r"shape \(3,\)"):
        keyed_joints(model, np.array([True, False, True]))


# ---- derivatives


@settings(max_examples=20)
@given(trees(max_bodies=3), seeds)
def test_derivatives_equal_the_complex_step(model, seed):
    model = dressed(model, seed)
    if not model.nv:
        return
    eq = equations(model)
    q, v, bar = (x[0] for x in random_states(model, seed, 1))
    forward = FUNCTIONS["forward"](eq, "articulated")
    base = {"q": q, "v": v, "tau": np.linspace(-1, 1, model.nv)}
    h = 1e-40

    def step(name, direction):
        changed = {k: np.asarray(base.get(k, np.zeros(n)), complex) for k, n in forward.inputs.items()}
        changed[name] = changed[name] + 1j * h * direction
        return forward.evaluate(*changed.values())[0].imag / h

    exact = {}
    directions = [_tangent(model, q, k) for k in range(model.nv)]
    exact["q"] = np.stack([step("q", d) for d in directions], axis=1)
    for name in ("v", "tau"):
        exact[name] = np.stack([step(name, d) for d in np.eye(model.nv)], axis=1)
    got = value(eq, "derivatives", **base)
    for name, J in exact.items():
        close(got["d" + name], J.ravel(), 1e-9)
    wide = np.concatenate([bar, np.zeros(len(eq.inputs["bar"]) - model.nv)])
    back = value(eq, "vjp", bar=wide, **base)
    for name, J in exact.items():
        close(back[name], bar @ J, 1e-9)


def _tangent(model, q, k):
    """d qpos along freedom k; a body's angular velocity w turns its quaternion by q (0, w) / 2."""
    joint = model.dof_jntid[k]
    at, dof, kind = model.jnt_qposadr[joint], model.jnt_dofadr[joint], model.jnt_type[joint]
    out = np.zeros(model.nq)
    place = k - dof
    if (kind == 0 and place < 3) or kind in (2, 3):
        out[at + place] = 1.0
        return out
    at, place = (at + 3, place - 3) if kind == 0 else (at, place)
    mujoco.mju_mulQuat(out[at : at + 4], q[at : at + 4], np.concatenate([[0.0], 0.5 * np.eye(3)[place]]))
    return out


def test_parameters_are_inputs_with_derivatives():
    model = of_text(FEATURES.format(fluid=""))
    names = [("body_mass", 2), ("body_pos", 3, 1), ("actuator_gainprm", 1), ("dof_damping", "h3")]
    names += [("body_ipos", 3, 2), ("jnt_stiffness", "b"), ("dof_armature", "h1"), ("body_inertia", 6, 0)]
    names += [("body_pos", 7, 0), ("actuator_gear", 3), ("tendon_damping", "t"), ("qpos_spring", "h1")]
    eq = equations(model, parameters=names)
    smooth = compile_model(model, parameters=names, cache=None)
    q, v, act, u = (x[0] for x in states_of(model, 5, 1))
    given_ = {"q": q, "v": v, "act": act, "u": u}
    p = smooth.parameter_values * 1.1 + 0.01
    changed = of_text(FEATURES.format(fluid=""))
    changed.body_mass[2], changed.body_pos[3, 1], changed.actuator_gainprm[1, 0] = p[:3]
    changed.dof_damping[changed.joint("h3").dofadr] = p[3]
    changed.body_ipos[3, 2] = p[4]
    changed.jnt_stiffness[changed.joint("b").id] = p[5]
    changed.dof_armature[changed.joint("h1").dofadr] = p[6]
    changed.body_inertia[6, 0], changed.body_pos[7, 0], changed.actuator_gear[3, 0] = p[7:10]
    changed.tendon_damping[0] = p[10]
    changed.qpos_spring[changed.joint("h1").qposadr] = p[11]
    close(value(eq, "forward", p=p, **given_)["a"], forwarded(changed, q, v, act, u).qacc)
    got = value(eq, "control_derivatives", p=p, **given_)
    h = 1e-5
    for name, size in (("p", len(names)), ("u", model.nu), ("act", model.na)):
        J = got["d" + name].reshape(model.nv, size)
        for k in range(size):
            ends = []
            for sign in (1, -1):
                moved = given_ | {"p": p}
                moved[name] = moved[name] + sign * h * (np.arange(size) == k)
                ends.append(value(eq, "forward", **moved)["a"])
            close(J[:, k], (ends[0] - ends[1]) / (2 * h), 1e-6)


def test_parameters_that_cannot_be_are_refused_by_name():
    model = of_text(SWING)
    with pytest.raises(EngineError, match="no parameter field 'body_quat'"):
        compile_model(model, parameters=[("body_quat", 1)])
    with pytest.raises(EngineError, match=r"no joint 'c'.*has: a, b"):
        compile_model(model, parameters=[("dof_damping", "c")])
    with pytest.raises(EngineError, match="outside body_pos"):
        compile_model(model, parameters=[("body_pos", 1, 3)])


@pytest.mark.parametrize("xml", [SWING, TOP])
def test_derivatives_of_a_step_equal_the_step_s_differences(xml):
    model = of_text(xml)
    smooth = compile_model(model, parameters=[("body_mass", 2)], cache=None)
    q, v, _, u = (x[0] for x in states_of(model, 2, 1))
    got = smooth.step_derivatives(q, v, u, step=0.01)
    after = smooth.rollout(q, v, u, step=0.01, steps=1)
    close(got.x, after.x[-1], 1e-14)
    nv, h = model.nv, 1e-5

    def moved(dq=None, dv=0.0, du=0.0, dp=0.0):
        start = q.copy()
        mujoco.mj_integratePos(model, start, np.zeros(nv) if dq is None else dq, 1.0)
        p = smooth.parameter_values + dp
        end = smooth.rollout(start, v + dv, u + du, step=0.01, steps=1, p=p).x[-1]
        out = np.zeros(2 * nv)
        mujoco.mj_differentiatePos(
            model, out[:nv], 1.0, got.x[: model.nq], np.ascontiguousarray(end[: model.nq])
        )
        out[nv:] = end[model.nq :] - got.x[model.nq :]
        return out

    def column(**direction):
        minus = {k: -x for k, x in direction.items()}
        return (moved(**direction) - moved(**minus)) / (2 * h)

    A = np.stack([column(dq=h * e) for e in np.eye(nv)] + [column(dv=h * e) for e in np.eye(nv)], axis=1)
    close(got.A, A, 1e-7)
    for k in range(model.nu):
        close(got.B[:, k], column(du=h * (np.arange(model.nu) == k)), 1e-7)
    close(got.P[:, 0], column(dp=np.array([h])), 1e-7)


def test_derivatives_of_a_step_with_keyed_motion_equal_its_differences(arms):
    smooth = arms["a"]
    curve = keyed([0.0, 1.0], [0.0, 1.2], kind="clamped")
    w, t0, h = keyed_by(curve), 0.3, 1e-5
    got = smooth.step_derivatives([0.2], [0.5], [0.1, 0.3], step=0.05, w=w, t0=t0)

    def end(q=0.2, v=0.5, u=0.3):
        return smooth.rollout([q], [v], [0.1, u], step=0.05, steps=1, w=w, t0=t0).x[-1]

    close(got.x, end(), 1e-14)
    for k, name in enumerate(("q", "v")):
        by = (end(**{name: (0.2, 0.5)[k] + h}) - end(**{name: (0.2, 0.5)[k] - h})) / (2 * h)
        close(got.A[:, k], by, 1e-7)
    close(got.B[:, 1], (end(u=0.3 + h) - end(u=0.3 - h)) / (2 * h), 1e-7)
    still = smooth.step_derivatives([0.2], [0.5], step=0.05, w=[0.0, 0.0, 0.0])
    assert np.abs(still.x - got.x).max() > 1e-3
    with pytest.raises(EngineError, match="prescribed motion"):
        smooth.step_derivatives([0.2], [0.5], step=0.05)


def test_the_adjoint_of_the_rate_is_the_transpose_of_its_jacobian():
    model = of_text(TOP)
    smooth = compile_model(model, parameters=[("body_mass", 2), ("body_pos", 2, 0)], cache=None)
    q, v, _, _ = states_of(model, 4, 3)
    bar = np.random.default_rng(0).normal(size=(3, smooth.layout.nx))
    J = smooth.evaluate("rate_jacobian", q=q, v=v)
    back = smooth.evaluate("rate_vjp", q=q, v=v, bar=bar)
    n = smooth.layout.nx
    close(back["x"], np.einsum("bi,bij->bj", bar, J["dx"].reshape(3, n, n)))
    close(back["p"], np.einsum("bi,bij->bj", bar, J["dp"].reshape(3, n, 2)))


# ---- conservation and order


def test_a_floating_top_keeps_energy_and_momentum():
    model = of_text(TOP)
    model.opt.gravity[:] = 0
    smooth = compile_model(model, cache=None)
    q, v, _, _ = states_of(model, 1, 3)
    path = smooth.rollout(q, v, step=1e-3, steps=2000, every=100, method=TABLEAUS["dop853"])
    for b in range(3):
        kinetic, _ = smooth.energy(path.q[b], path.v[b])
        linear, angular = smooth.momentum(path.q[b], path.v[b])
        assert np.ptp(kinetic) < 1e-11 * kinetic[0]
        assert np.ptp(linear, axis=0).max() < 1e-11
        assert np.ptp(angular, axis=0).max() < 1e-11


def test_a_swinging_chain_keeps_its_energy():
    model = of_text(SWING.replace('damping=".1"', 'stiffness="3" armature=".1"'))
    smooth = compile_model(model, cache=None)
    path = smooth.integrate(
        [2.0, 0.5], [0.0, 1.0], np.linspace(0, 5, 51), method=TABLEAUS["verner98"], rtol=1e-12, atol=1e-12
    )
    assert path.success
    assert np.ptp(sum(smooth.energy(path.q, path.v))) < 1e-9


@pytest.mark.parametrize("method", [*TABLEAUS])
@pytest.mark.parametrize("xml", [SWING, TOP], ids=["hinges", "quaternions"])
def test_compiled_steps_have_the_method_s_order(method, xml, engines):
    smooth, q, v, span, exact = engines[xml]
    tableau = TABLEAUS[method]
    counts = {5: (32, 64), 8: (8, 16), 9: (8, 16)}.get(tableau.order, (128, 256))
    errors = []
    for n in counts:
        path = smooth.rollout(q, v, step=span / n, steps=n, every=n, method=tableau)
        errors.append(np.abs(path.x[-1] - exact).max())
    order = np.log(errors[0] / errors[1]) / np.log(counts[1] / counts[0])
    assert order > tableau.order - 0.3, f"errors {errors}"
    assert errors[0] > 1e-13


@pytest.fixture(scope="module")
def engines():
    out = {}
    for xml in (SWING, TOP):
        model = of_text(xml)
        smooth = compile_model(model, cache=None)
        q, v = (x[0] for x in states_of(model, 7, 1)[:2])
        q, v = (np.array([0.5, 0.3]), np.array([1.0, -0.5])) if xml == SWING else (q, 2 * v)
        span = 0.2 if xml == SWING else 0.6
        path = smooth.rollout(q, v, step=span / 400, steps=400, every=400, method=TABLEAUS["verner98"])
        out[xml] = smooth, q, v, span, path.x[-1]
    return out


# ---- rollouts


def test_fixed_steps_equal_mujoco_s():
    from mujoco.rollout import rollout

    # MuJoCo integrates "filterexact" by its exact solution, Runge-Kutta methods by their own
    model = of_text(FEATURES.format(fluid="").replace("filterexact", "filter"))
    model.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    smooth = compile_model(model, cache=None)
    _, v, act, u = states_of(model, 9, 5)
    q = np.tile(model.qpos0, (5, 1))
    for row, direction in zip(q, v, strict=True):
        mujoco.mj_integratePos(model, row, direction, 0.1)
    state = np.concatenate([np.zeros((5, 1)), q, v, act], axis=1)
    reference, _ = rollout(model, mujoco.MjData(model), state, np.repeat(u[:, None], 40, axis=1))
    path = smooth.rollout(q, v, u[:, None], act0=act, step=model.opt.timestep, steps=40, hold=40)
    np.testing.assert_allclose(path.x[:, 1:], reference[:, :, 1:], rtol=0, atol=1e-9)


@pytest.mark.parametrize("n", [2, 7, 19])
def test_one_state_any_lanes_and_any_threads_give_one_motion(n):
    model = of_text(TOP)
    q, v, _, _ = states_of(model, 3, n)
    single = compile_model(model, cache=None)
    alone = np.stack([single.rollout(q[i], v[i], step=1e-3, steps=30).x for i in range(n)])
    for lanes in {1, 2, 4, 8, preferred_lanes()}:
        batch = compile_model(model, lanes=lanes, cache=None).rollout(q, v, step=1e-3, steps=30)
        np.testing.assert_allclose(batch.x, alone, rtol=0, atol=2e-14)


def test_controls_are_held_over_their_period_however_they_are_given():
    model = of_text(SWING)
    smooth = compile_model(model, cache=None)
    K = joint_pd(model, 5.0, 0.5)
    np.testing.assert_allclose(K, [[2.5, 0, 0.25, 0], [0, 5, 0, 0.5]])
    q_ref = np.linspace([0.0, 0.0], [1.0, -1.0], 10)
    law = LinearFeedback(K, q_ref=q_ref, u_ref=[0.1, 0.2])
    q, v = np.array([0.3, -0.2]), np.array([0.5, 0.1])
    compiled = smooth.rollout(q, v, law, step=1e-3, steps=100, hold=10)
    period = iter(q_ref)

    def python(t, q, v):
        return np.array([0.1, 0.2]) + K @ np.concatenate([next(period) - q, -v])

    called = smooth.rollout(q, v, python, step=1e-3, steps=100, hold=10)
    np.testing.assert_allclose(compiled.x, called.x, rtol=0, atol=1e-13)
    np.testing.assert_allclose(compiled.u, called.u, rtol=0, atol=1e-12)
    replayed = smooth.rollout(q, v, compiled.u, step=1e-3, steps=100, hold=10)
    np.testing.assert_allclose(replayed.x, compiled.x, rtol=0, atol=1e-13)
    adaptive = smooth.integrate(
        q, v, compiled.t[::10], law, hold=0.01, method=TABLEAUS["dop853"], rtol=1e-12, atol=1e-12
    )
    np.testing.assert_allclose(adaptive.x, compiled.x[::10], rtol=0, atol=1e-9)


def test_feedback_takes_differences_of_rotations_on_the_manifold():
    xml = TOP.replace("</worldbody>", "</worldbody><actuator><motor joint='b' gear='1 0 0'/></actuator>")
    model = of_text(xml)
    smooth = compile_model(model, cache=None)
    (q, goal), (v, _), _, _ = states_of(model, 6, 2)
    K = np.random.default_rng(0).normal(size=(1, 2 * model.nv))
    path = smooth.rollout(q, v, LinearFeedback(K, q_ref=goal), step=1e-3, steps=1)
    error = np.zeros(model.nv)
    mujoco.mj_differentiatePos(model, error, 1.0, q, goal)
    close(path.u[0], K @ np.concatenate([error, -v]))


def test_gains_change_without_another_compilation():
    model = of_text(SWING)
    smooth = compile_model(model, cache=None)
    for kp in (1.0, 50.0):
        smooth.rollout([0.3, 0.1], [0.0, 0.0], LinearFeedback(joint_pd(model, kp, 1.0)), step=1e-3, steps=10)
    assert len([b for b in smooth.stats.builds if b.name.startswith("fixed")]) == 1


@pytest.mark.parametrize("method", [name for name, t in TABLEAUS.items() if t.adaptive])
def test_tighter_tolerances_give_smaller_errors_at_every_requested_time(method, engines):
    smooth, q, v, _, _ = engines[TOP]
    times = np.linspace(0.0, 0.4, 24)
    exact = smooth.rollout(q, v, step=0.4 / 23 / 20, steps=460, every=20, method=TABLEAUS["verner98"]).x
    batch = smooth.integrate(
        np.tile(q, (3, 1)), np.tile(v, (3, 1)), times, method=TABLEAUS[method], rtol=1e-7, atol=1e-7
    )
    for tolerance, bound in ((1e-4, 2e-2), (1e-7, 2e-5)):
        path = smooth.integrate(q, v, times, method=TABLEAUS[method], rtol=tolerance, atol=tolerance)
        assert path.success
        assert np.abs(path.x - exact).max() < bound
    np.testing.assert_allclose(batch.x[1], path.x, rtol=0, atol=1e-8)
    assert batch.evaluations[0] == pytest.approx(path.evaluations, rel=0.05)


def test_a_motion_that_cannot_go_on_says_so():
    model = of_text(SWING)
    smooth = compile_model(model, cache=None)
    path = smooth.rollout([[0.3, 0.1], [0.2, np.inf]], [0.0, 0.0], step=1e-3, steps=5)
    assert path.status.tolist() == [0, 3]
    assert not path.success
    few = smooth.integrate([0.3, 0.1], [0.0, 0.0], [0.0, 5.0], rtol=1e-10, atol=1e-10, max_steps=10)
    assert few.status == 1
    for bad in (np.nan, np.inf):
        path = smooth.integrate([[0.3, bad], [0.3, 0.1]], [0.0, 0.0], [0.0, 0.1, 0.2])
        assert path.status.tolist() == [3, 0]
        assert np.isfinite(path.x[1]).all()
        alone = smooth.integrate([0.3, 0.1], [0.0, bad], [0.0, 0.1])
        assert alone.status == 3 and not alone.success
    assert np.isnan(few.x[-1]).all()


def test_shapes_that_do_not_fit_are_named():
    smooth = compile_model(of_text(SWING), cache=None)
    with pytest.raises(EngineError, match=r"q has shape \(3,\); expected \(2,\)"):
        smooth.forward(np.zeros(3), np.zeros(2))
    with pytest.raises(EngineError, match="different lengths"):
        smooth.forward(np.zeros((3, 2)), np.zeros((2, 2)))
    with pytest.raises(EngineError, match="must divide"):
        smooth.rollout(np.zeros(2), np.zeros(2), step=1e-3, steps=10, every=3)
    with pytest.raises(EngineError, match="controls has shape"):
        smooth.rollout(np.zeros(2), np.zeros(2), np.zeros((4, 2)), step=1e-3, steps=10)
    with pytest.raises(EngineError, match="does not estimate its error"):
        smooth.integrate(np.zeros(2), np.zeros(2), [0.0, 1.0], method=TABLEAUS["rk4"])


def test_how_far_each_motion_came_is_told():
    smooth = compile_model(of_text(SWING), cache=None)
    q = [[0.3, 0.1], [0.2, np.inf]]
    fixed = smooth.rollout(q, [0.0, 0.0], step=1e-3, steps=20, every=5)
    assert fixed.steps.tolist() == [20, 20] and fixed.reached.tolist() == [fixed.t[-1], 0.0]
    given = {"rtol": 1e-9, "first_step": 1e-3}
    single = smooth.integrate(q[0], [0.0, 0.0], [0.0, 0.1, 5.0], max_steps=50, **given)
    assert (single.status, single.steps) == (1, 50) and 0.1 < single.reached < 5.0
    there = smooth.integrate(q[0], [0.0, 0.0], [0.0, single.reached], **given)
    assert there.success and there.reached == single.reached and 49 <= there.steps <= 51
    batch = smooth.integrate(
        [q[0], [0.0, 0.0]], [[0.0, 0.0], [30.0, -60.0]], [0.0, 0.5], rtol=1e-7, max_steps=70
    )
    assert batch.status.tolist() == [0, 1] and (batch.steps + batch.rejected)[1] == 70
    assert batch.reached[0] == 0.5 > batch.reached[1] > 0.0
    law = smooth.integrate([q[0], q[0]], [0.0, 0.0], [0.0, 0.5], lambda t, q, v: -q, hold=0.1, rtol=1e-7)
    assert law.success and law.reached.tolist() == [0.5, 0.5]
    tried = law.steps + law.rejected
    assert (law.evaluations >= 6 * tried).all() and (law.evaluations <= 8 * tried).all()
    pushed = smooth.integrate(
        [q[0], q[0]],
        [0.0, 0.0],
        [0.0, 0.5],
        lambda t, q, v: [[0.0, 0.0], [0.0, 0.0 if t < 0.15 else 1e300]],
        hold=0.1,
        rtol=1e-7,
    )
    assert pushed.status[0] == 0 != pushed.status[1]
    assert pushed.reached.tolist() == pytest.approx([0.5, 0.2], abs=1e-9)


def test_arguments_that_make_no_sense_are_named():
    smooth, q, v = compile_model(of_text(SWING), cache=None), np.array([0.3, 0.1]), np.zeros(2)
    times = [0.0, 0.1]
    for bad in (-1.0, 0.0, np.nan, np.inf):
        with pytest.raises(EngineError, match="atol must be positive"):
            smooth.integrate(q, v, times, rtol=bad)
        with pytest.raises(EngineError, match="atol must be positive"):
            smooth.integrate(q, v, times, rtol=1e-6, atol=bad)
        with pytest.raises(EngineError, match=r"step=.*positive"):
            smooth.rollout(q, v, step=bad, steps=10)
        with pytest.raises(EngineError, match=r"step=.*positive"):
            smooth.step_derivatives(q, v, step=bad)
        with pytest.raises(EngineError, match=r"first_step=.*positive"):
            smooth.integrate(q, v, times, first_step=bad)
        with pytest.raises(EngineError, match=r"hold=.*positive"):
            smooth.integrate(q, v, times, hold=bad)
    with pytest.raises(EngineError, match="doubles"):
        smooth.integrate(q, v, times, rtol=1e-17)
    for bad in (0, -5):
        with pytest.raises(EngineError, match="positive number of steps"):
            smooth.rollout(q, v, step=1e-3, steps=bad)
    for bad in ([0.0, np.nan], [0.0, np.inf], [0.1, 0.0]):
        with pytest.raises(EngineError, match="ascending, finite"):
            smooth.integrate(q, v, bad)


def test_one_tolerance_stands_for_both():
    smooth, times = compile_model(of_text(SWING), cache=None), [0.0, 0.5]
    both = smooth.integrate([0.3, 0.1], [0.0, 0.0], times, rtol=1e-9, atol=1e-9).x
    for one in ({"rtol": 1e-9}, {"atol": 1e-9}):
        np.testing.assert_array_equal(smooth.integrate([0.3, 0.1], [0.0, 0.0], times, **one).x, both)


def test_methods_have_names():
    smooth, q, v = compile_model(of_text(SWING), cache=None), np.array([0.3, 0.1]), np.zeros(2)
    for run in (
        lambda method: smooth.rollout(q, v, step=1e-2, steps=10, method=method).x,
        lambda method: smooth.integrate(q, v, [0.0, 0.1], method=method).x,
        lambda method: smooth.step_derivatives(q, v, step=1e-2, method=method).x,
    ):
        np.testing.assert_array_equal(run("bosh3"), run(TABLEAUS["bosh3"]))
        with pytest.raises(EngineError, match=r"did you mean 'dopri5'.*verner98"):
            run("dopri")


# ---- the front door


def step_by_step(problem):
    """The same equations without compiled loops."""
    return ODE(problem.f, problem.ndim, problem.project)


@pytest.fixture(scope="module")
def posed():
    """A problem and a start of either kind of joints."""
    top, swing = (compile_model(of_text(xml), cache=None) for xml in (TOP, SWING))
    q, v = (x[0] for x in states_of(of_text(TOP), 7, 1)[:2])
    return {
        "quaternions": (top.problem(), np.concatenate([3.0 * q, 2 * v])),  # put on the sphere first
        "hinges": (swing.problem([0.3, -0.2]), np.array([0.5, 0.3, 1.0, -0.5])),
    }


@pytest.mark.parametrize("kind", ["quaternions", "hinges"])
@pytest.mark.parametrize("method", [*TABLEAUS])
def test_the_front_door_hands_fixed_steps_to_compiled_loops_that_agree(posed, kind, method):
    problem, y0 = posed[kind]
    # step by step, a method that is FSAL begins with its last slope, of quaternions before they are put back
    rounding = 1e-9 if TABLEAUS[method].fsal and kind == "quaternions" else 1e-13
    t0 = 0.7
    grid = t0 + 0.01 * np.arange(21)
    for span, times in (
        ((t0, t0 + 0.2), None),
        ((t0, t0 + 0.203), None),  # the last step is cut
        ((t0, t0 + 0.004), None),
        ((t0, t0 + 0.203), grid[[0, 3, 3, 20]]),
        ((t0, t0 + 0.203), [t0 + 0.001, t0 + 0.004, t0 + 0.05, t0 + 0.2015, t0 + 0.203]),
        ((t0, t0 + 0.2), np.linspace(t0, t0 + 0.2, 41)),
    ):
        given = {"method": method, "step": 0.01, "t_eval": times, "error": True}
        ours, slow = solve(problem, span, y0, **given), solve(step_by_step(problem), span, y0, **given)
        np.testing.assert_array_equal(ours.t, slow.t)
        np.testing.assert_allclose(ours.y, slow.y, rtol=0, atol=rounding)
        np.testing.assert_allclose(ours.error, slow.error, rtol=0, atol=rounding)
        assert (ours.status, ours.message, ours.stats.steps) == (slow.status, slow.message, slow.stats.steps)
        most = 1.5 if times is None else 3.0  # a step around a time is done again
        assert 0 < ours.stats.evaluations <= most * slow.stats.evaluations + 10


@pytest.mark.parametrize("kind", ["quaternions", "hinges"])
def test_the_front_door_hands_tolerances_to_compiled_loops(posed, kind):
    problem, y0 = posed[kind]
    times, span = [0.0, 0.1, 0.1, 0.25, 0.37], (0.0, 0.5)
    exact = solve(step_by_step(problem), span, y0, method="dop853", rtol=1e-13, t_eval=times).y
    called, f = [], problem.f
    problem.f = lambda t, y: called.append(t) or f(t, y)
    for tolerance in (1e-5, 1e-8):
        given = {"method": "dopri5", "rtol": tolerance, "t_eval": times}
        ours, slow = (
            solve(problem, span, y0, **given),
            solve(ODE(f, len(y0), problem.project), span, y0, **given),
        )
        np.testing.assert_array_equal(ours.t, times)
        assert np.abs(ours.y - exact).max() < 5 * np.abs(slow.y - exact).max()
        assert ours.stats.evaluations == pytest.approx(slow.stats.evaluations, rel=0.1)
        assert ours.stats.steps == pytest.approx(slow.stats.steps, rel=0.1)
        assert (ours.status, ours.message) == (slow.status, slow.message)
    del problem.f
    assert len(called) == 4  # to choose the first steps


def test_what_compiled_loops_cannot_do_goes_step_by_step(posed):
    problem, y0 = posed["hinges"]
    given = {"method": "dopri5", "rtol": 1e-8}
    turned = Event(lambda t, y: y[0] - 0.6, name="turned")
    for special in ({"events": [turned]}, {"dense": True}, {"t_eval": None}):
        ours = solve(problem, (0.0, 0.5), y0, **given | special)
        slow = solve(step_by_step(problem), (0.0, 0.5), y0, **given | special)
        np.testing.assert_array_equal(ours.y, slow.y)
        assert [o.t for o in ours.events] == [o.t for o in slow.events]
    back = solve(problem, (0.5, 0.0), ours.y[-1], t_eval=[0.0], rtol=1e-10)
    np.testing.assert_allclose(back.y[0], y0, rtol=0, atol=1e-6)
    pushed = problem_of_a_push()
    ours = solve(pushed, (0.0, 0.5), y0, step=0.01)
    np.testing.assert_array_equal(ours.y, solve(step_by_step(pushed), (0.0, 0.5), y0, step=0.01).y)


def problem_of_a_push():
    return compile_model(of_text(SWING), cache=None).problem(lambda t, q, v: [np.sin(20 * t), -v[0]])


def test_failures_of_compiled_loops_are_told_at_the_front_door(posed):
    problem, y0 = posed["hinges"]
    times = np.linspace(0.0, 2.0, 21)
    for how in ({"step": 0.01}, {"rtol": 1e-9}):
        ours = solve(problem, (0.0, 2.0), y0, t_eval=times, max_steps=30, **how)
        slow = solve(step_by_step(problem), (0.0, 2.0), y0, t_eval=times, max_steps=30, **how)
        assert ours.status == slow.status == Status.TOO_MANY_STEPS
        assert ours.stats.steps == slow.stats.steps == 30
        assert 0 < len(ours.t) < 21 and np.isfinite(ours.y).all()
        assert "30 steps" in ours.message and "reached only t = 0." in ours.message
    np.testing.assert_array_equal(
        solve(problem, (0.0, 2.0), y0, t_eval=times, max_steps=30, step=0.01).t, times[:4]
    )
    wild = np.array([0.5, 0.3, 1e200, -1e200])
    for how in ({"step": 0.01}, {"rtol": 1e-6}):
        ours = solve(problem, (0.0, 2.0), wild, t_eval=times, **how)
        assert ours.status == solve(step_by_step(problem), (0.0, 2.0), wild, t_eval=times, **how).status
        assert ours.status == Status.DIVERGED and "not finite" in ours.message
        np.testing.assert_array_equal(ours.t, [0.0])


# ---- what it cannot do, what it does otherwise, what it keeps


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (("</worldbody>", "</worldbody><equality><joint joint1='a' joint2='b'/></equality>"), "closed loops"),
        (('<motor joint="b"/>', "<muscle joint='b' lengthrange='0 1'/>"), "muscle"),
        (
            (
                '<actuator><motor joint="a"',
                "<tendon><fixed name='t'><joint joint='a' coef='1'/></fixed></tendon>"
                '<actuator><motor tendon="t" armature=".1"/><motor joint="a"',
            ),
            "given at its actuator",
        ),
        (('<motor joint="b"/>', "<motor site='s'/>"), "transmission site"),
        (('<motor joint="b"/>', "<position joint='b' kp='1' delay='0.1' nsample='10'/>"), "delay"),
        (('<motor joint="b"/>', "<intvelocity joint='b' kp='1' actrange='-1 1'/>"), "actlimited"),
        (
            (
                "</worldbody>",
                "<site name='w'/></worldbody><tendon><spatial><site site='w'/><site site='s'/></spatial>"
                "</tendon>",
            ),
            "through sites",
        ),
    ],
)
def test_what_it_cannot_do_is_named(change, named):
    xml = SWING.replace(
        '<geom size=".1" pos=".5 0 0" mass="2"/>', "<geom size='.1' mass='2'/><site name='s'/>"
    )
    model = mujoco.MjModel.from_xml_string(xml.replace(*change))
    problems = unsupported(model)
    assert any(named in line for line in problems), problems
    with pytest.raises(EngineError, match=named):
        compile_model(model)


def test_dry_friction_is_smoothed_over_the_stated_width():
    xml = SWING.replace('name="a"', 'name="a" frictionloss="3" range="-1 1" limited="true"')
    model = mujoco.MjModel.from_xml_string(xml)
    smooth = compile_model(model, friction_width=0.1, cache=None)
    q, v = np.array([0.4, 0.2]), np.array([0.05, -0.3])
    force = 3 * v[0] / np.hypot(v[0], 0.1)
    expected = compile_model(model, cache=None).forward(q, v, tau=[-force, 0.0])
    close(smooth.forward(q, v), expected, 1e-13)
    assert [line for line in smooth.differences if "limits of one joint are left out" in line]
    assert [line for line in smooth.differences if "0.1 rad/s" in line]
    with pytest.raises(EngineError, match="positive"):
        compile_model(model, friction_width=0.0)


def test_who_runs_compiled_code_writes_none_of_it():
    """Its programs are kept on disk under a hash of the folders that write them: no other may."""
    sim = MJCF.parent.parent / "sim"
    files = [*(sim / "engines").glob("*.py"), *sim.glob("*.py")]
    assert len(files) > 20
    writes = re.compile(r"from \.\.+compile[. ]|import .*\bTape\b")
    assert [f.name for f in files if writes.search(f.read_text())] == []


def test_a_second_use_finds_the_code_and_another_model_does_not(tmp_path):
    model = of_text(SWING)
    q, v = np.array([0.4, 0.2]), np.array([0.5, -0.3])
    first = compile_model(model, cache=tmp_path)
    expected = first.forward(q, v)
    assert not first.stats.cached
    second = compile_model(model, cache=tmp_path)
    np.testing.assert_array_equal(second.forward(q, v), expected)
    assert second.stats.cached
    assert "equations" not in vars(second)
    model.body_mass[2] *= 2
    third = compile_model(model, cache=tmp_path)
    assert np.abs(third.forward(q, v) - expected).max() > 1e-3
    assert not third.stats.cached
    fourth = compile_model(model, cache=tmp_path, friction_width=0.1)
    fourth.forward(q, v)
    assert not fourth.stats.cached


def test_a_bound_function_runs_on_its_own_arrays():
    smooth = compile_model(of_text(SWING), cache=None)
    bound = smooth.bind("forward")
    bound.inputs["q"][:], bound.inputs["v"][:] = (0.4, 0.2), (0.5, -0.3)
    bound()
    np.testing.assert_array_equal(bound.outputs["a"], smooth.forward([0.4, 0.2], [0.5, -0.3]))


def test_models_alike_but_for_their_names_share_no_code(tmp_path):
    def forward(first, second):
        body = '<body name="{}" pos="{} 0 0"><joint axis="0 1 0"/>'
        body += '<geom size="0.1" mass="{}" pos="0.3 0 0"/></body>'
        xml = f"<mujoco><worldbody>{body.format(first, 0, 1)}{body.format(second, 1, 3)}</worldbody></mujoco>"
        model = mujoco.MjModel.from_xml_string(xml)
        smooth = compile_model(model, parameters=[("body_mass", "a")], cache=tmp_path)
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        close(smooth.forward(data.qpos, data.qvel), data.qacc)

    forward("a", "b")
    forward("b", "a")
