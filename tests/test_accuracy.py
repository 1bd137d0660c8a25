"""The estimated error of a run against its true one, by an independent integration of the same model."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles.mujoco_motion import motion
from pantograph.sim import Scene, accuracy, make_plan, run
from pantograph.sim.accuracy import difference
from pantograph.sim.engines.contact import ContactEngine
from scenes import numbers
from scipy.spatial.transform import Rotation

SMOOTH = {"contacts": "none", "limits": False}
MODELS = {
    "double_pendulum": {"file": "double_pendulum"},
    "cart_pole": {"file": "cart_pole"},
    "planar_2r": {"file": "planar_2r"},
    "ball chain": {"chain": {"links": 2, "length": 1.0}},
    "loose chain": {"chain": {"links": 2, "length": 1.0, "fixed": False}},
}


def start_anywhere(scene, seed):
    """The plan of ``scene`` started from a random state."""
    plan = make_plan(scene)
    m, rng = plan.problem.model, np.random.default_rng(seed)
    q = m.qpos0.copy()
    mujoco.mj_integratePos(m, q, rng.normal(size=m.nv), 1.0)
    state = plan.problem.state0._replace(q=q, v=rng.normal(size=m.nv))
    return dataclasses.replace(plan, problem=dataclasses.replace(plan.problem, state0=state))


@given(
    st.sampled_from(sorted(MODELS)),
    st.integers(0, 10**6),
    st.sampled_from(["rk4", "euler", "implicit"]),
    st.sampled_from(["auto", "contact"]),
)
@settings(max_examples=30)
def test_the_estimate_is_near_the_true_error_of_smooth_motion(name, seed, integrator, engine):
    step = 0.01 if integrator == "rk4" else 0.001
    scene = Scene(
        duration=1.0,
        rate=20,
        models=[MODELS[name]],
        physics=SMOOTH,
        solver={"step": step, "integrator": integrator, "engine": engine},
    )
    plan = start_anywhere(scene, seed)
    r = run(plan, error=True)
    assert r.status == "done"
    assert r.error.order == (4 if integrator == "rk4" else 1)
    assert r.error.trusted_until == np.inf
    assert r.error.evaluations == 2 * r.stats["evaluations"]
    assert_near_the_truth(plan, r)


def assert_near_the_truth(plan, r):
    """Estimates within a fifth of the true errors, down to what the reference itself can tell."""
    s = plan.problem.state0
    truth = motion(plan.problem.model, s.q, s.v, r.t)
    for estimate, error in zip((r.error.angle, r.error.length), difference(r.model, r.q, truth), strict=True):
        assert estimate.shape == r.t.shape
        assert np.max(estimate) <= 1.2 * np.max(error) + 1e-9
        assert np.max(error) <= 1.2 * np.max(estimate) + 1e-9


@given(st.sampled_from(["double_pendulum", "cart_pole"]), st.integers(0, 10**6), st.floats(3.0, 6.0))
@settings(max_examples=15)
def test_the_estimate_of_adaptive_steps_is_near_the_true_error(name, seed, digits):
    scene = Scene(
        duration=1.0, rate=20, models=[MODELS[name]], physics=SMOOTH, solver={"tolerance": 10**-digits}
    )
    plan = start_anywhere(scene, seed)
    assert_near_the_truth(plan, run(plan, error=True))


@given(st.sampled_from([0.02, 0.01]), st.integers(0, 10**6))
@settings(max_examples=5)
def test_the_estimate_falls_at_the_order_of_the_integrator(step, seed):
    for integrator, fall in (("rk4", 16), ("euler", 2)):
        errors = []
        for h in (step / 4, step / 8):
            scene = Scene(
                duration=0.5,
                models=[MODELS["double_pendulum"]],
                physics=SMOOTH,
                solver={"step": h, "integrator": integrator},
            )
            errors.append(run(start_anywhere(scene, seed), error=True).error.angle.max())
        assume(errors[1] > 1e-10)
        assert errors[0] / errors[1] == pytest.approx(fall, rel=0.2)


def controlled(step, engine="auto", frequency=3.0, lean=0.2, duration=1.5):
    """A shoulder that feedback alone holds upright, and an elbow that follows its keys."""
    return Scene(
        duration=duration,
        rate=25,
        models=[MODELS["double_pendulum"]],
        physics=SMOOTH,
        roles={"tracked": ["shoulder", "elbow"]},
        initial={"position": {"shoulder": np.pi - lean}},
        keys=[
            {"joint": "shoulder", "times": [0], "values": [np.pi]},
            {"joint": "elbow", "times": [0, duration], "values": [0.5, -0.5], "ease": "smooth"},
        ],
        controller={"period": 0.02, "frequency": frequency},
        solver={"step": step, "engine": engine, "integrator": "rk4"},
    )


def test_keyed_and_controlled_motion_has_an_estimate_of_the_integrators_order():
    scene = {
        "duration": 1.0,
        "models": [MODELS["double_pendulum"]],
        "physics": SMOOTH,
        "roles": {"tracked": ["elbow"]},
        "keys": [
            {"joint": "shoulder", "times": [0, 1], "values": [0, 1], "ease": "smooth"},
            {"joint": "elbow", "times": [0, 1], "values": [0.5, -0.5], "ease": "smooth"},
        ],
        "controller": {"period": 0.02},
    }
    coarse, fine = (run(Scene(**scene, solver={"step": h}), error=True).error for h in (0.01, 0.005))
    assert 0 < coarse.angle.max() < 1e-5
    assert coarse.angle.max() / fine.angle.max() == pytest.approx(16, rel=0.5)


@given(st.sampled_from(["smooth", "contact"]), st.floats(2.0, 5.0), st.floats(-0.3, 0.3))
@settings(max_examples=8)
def test_the_estimate_has_feedback_in_its_loop(engine, frequency, lean):
    """Upright only by feedback: its samples played back would let any error fall over."""
    r = run(controlled(0.02, engine, frequency, lean, duration=4.0), error=True)
    truth = run(controlled(0.02 / 16, "contact", frequency, lean, duration=4.0))
    error = difference(r.model, r.q, truth.q)[0].max()
    assert r.error.angle.max() <= 1.2 * error + 1e-9
    assert error <= 1.2 * r.error.angle.max() + 1e-9


ball = {"name": "ball", "shape": "sphere", "size": [0.1]}
floor = {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True}


@given(st.floats(0.15, 1.5))
@settings(max_examples=10)
def test_the_estimate_is_trusted_until_the_first_contact(height):
    scene = Scene(duration=0.8, props=[{**ball, "position": [0, 0, height]}, floor])
    r = run(scene, error=True)
    touch = np.sqrt(2 * (height - 0.1) / 9.81)
    assert touch - r.stats["step"] - 1e-9 <= r.error.trusted_until <= touch + 1e-9
    before = r.t < touch
    assert r.error.length[before].max() < 1e-12
    assert r.error.length[~before].max() > 1e-7


def test_the_estimate_is_trusted_until_the_first_limit():
    scene = Scene(
        duration=0.5,
        models=[{"file": "cart_pole"}],
        initial={"velocity": {"slide": 4.0}},
        solver={"engine": "contact"},
    )
    r = run(scene, error=True)
    after = np.argmax(r.q[:, 0] > 1.0)
    assert r.t[after - 1] - r.stats["step"] <= r.error.trusted_until <= r.t[after]


def test_a_second_run_that_diverges_leaves_the_error_infinite_from_there():
    class Diverging(ContactEngine):
        runs = 0

        def run(self, problem, t_span, controls, *, progress=None):
            self.runs += 1
            end = t_span[1] if self.runs == 1 else 0.5 * t_span[1]
            segment = super().run(problem, (t_span[0], end), controls, progress=progress)
            return dataclasses.replace(segment, status="done" if self.runs == 1 else "diverged")

    plan = make_plan(Scene(duration=1.0, models=[MODELS["double_pendulum"]], solver={"engine": "contact"}))
    engine = Diverging()
    segment = engine.run(plan.problem, (0.0, 1.0), None)
    estimate = accuracy.estimate_error(engine, plan.problem, segment, None)
    assert np.isfinite(estimate.angle[segment.t <= 0.5]).all()
    assert np.isinf(estimate.angle[segment.t > 0.51]).all()
    assert estimate.angle.shape == segment.t.shape


@given(st.lists(numbers, min_size=12, max_size=12))
def test_differences_are_angles_and_lengths(x):
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><body><freejoint/><geom size="1"/></body><body><joint type="ball"/>'
        '<geom size="1"/><body><joint type="slide"/><geom size="1"/><body><joint/><geom size="1"/></body>'
        "</body></body></worldbody></mujoco>"
    )
    p, r1, r2, s, h = np.array(x[:3]), x[3:6], x[6:9], x[9], x[10]
    q1 = model.qpos0.copy()
    turn = [Rotation.from_rotvec(r).as_quat(scalar_first=True) for r in (r1, r2)]
    q2 = np.concatenate([q1[:3] + p, turn[0], turn[1], [s, h]])
    angle, length = difference(model, q1[None], q2[None])
    norms = [Rotation.from_rotvec(r).magnitude() for r in (r1, r2)]
    assert angle[0] == pytest.approx(max(*norms, abs(h)), abs=1e-9)
    assert length[0] == pytest.approx(max(np.linalg.norm(p), abs(s)), abs=1e-12)
