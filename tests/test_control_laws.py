"""Control laws: what each promises about forces, motion and memory."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.controllers.computed_torque import held_gains
from pantograph.controllers.gains import felt_inertia, force_limits
from pantograph.controllers.ilc import learn
from pantograph.controllers.nominal import Nominal, difference
from pantograph.controllers.observers import Kalman, VelocityFilter
from pantograph.controllers.operational_space import OperationalSpace
from pantograph.controllers.pid import PID
from pantograph.controllers.play import Play, Rotors
from pantograph.controllers.reality import Loop
from pantograph.controllers.task import Task
from pantograph.models import load_model
from pantograph.sim import PantographError, Scene, SceneError, make_plan, run
from pantograph.sim.compose import LAWS, make_engine, make_law
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from pantograph.sim.engines.contact import ContactEngine
from pantograph.sim.scene.schema.scene import ControllerItem
from scipy import linalg
from strategies import random_states, seeds, trees

ARM = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]
WORDS = {"operational-space": {"site": "tip"}, "impedance": {"site": "tip"}, "nmpc": {"horizon": 0.1}}


def arm_scene(law, seed=0, *, duration=1.0, period=0.002, tracked=ARM, **words):
    """The six-axis arm with ideal drives, without dry friction, along random smooth keys."""
    rng = np.random.default_rng(seed)
    keys = [
        {"joint": j, "times": [0, duration / 2, duration], "values": rng.uniform(-0.5, 0.5, 3).tolist()}
        for j in ARM
    ]
    return Scene(
        duration=duration,
        models=[{"file": "arm6"}],
        roles={"tracked": tracked},
        actuators={"*": "off"},
        keys=[k | {"curve": "clamped"} for k in keys],
        physics={"friction": False, "contacts": "none"},
        controller={"law": law, "period": period, **words},
    )


def worst_error(scene):
    plan = make_plan(scene)
    recording = run(plan)
    assert recording.status == "done"
    return np.abs(recording.q - plan.problem.clip.evaluate(recording.t).q).max()


def test_swing_up_says_that_it_does_not_do_arms():
    with pytest.raises(SceneError):
        make_law("swing-up", make_plan(arm_scene("pd")).problem, {}, 0.002)


@pytest.mark.parametrize("law", sorted(set(LAWS) - {"swing-up"}))
def test_a_law_has_no_hidden_memory(law):
    """Whatever is asked in between, the same input and memory give the same forces."""
    problem = make_plan(arm_scene("pd")).problem
    words = WORDS.get(law, {}) | {"encoder": 4096, "observer": "extended", "delay": 0.004, "backlash": 0.01}
    one, other = (make_law(law, problem, words, 0.002) for _ in range(2))
    rng = np.random.default_rng(1)
    memories, calls = [one.start()], []
    for k in range(6):
        q, v = rng.normal(size=6) * 0.3, rng.normal(size=6)
        target = Target(*problem.clip.evaluate(0.002 * k))
        tau, memory = one(0.002 * k, q, v, target, memories[-1])
        calls.append((0.002 * k, q, v, target, memories[-1], tau))
        memories.append(memory)
    for k in rng.permutation(6):
        *call, tau = calls[k]
        np.testing.assert_array_equal(other(*call)[0], tau)
        np.testing.assert_array_equal(one(*call)[0], tau)


@given(trees(max_bodies=4), seeds)
@settings(max_examples=20)
def test_the_nominal_model_is_mujocos(model, seed):
    if model.nv == 0:
        return
    (q,), (v,), (a,) = random_states(model, seed, 1)
    nominal, data = Nominal(model), mujoco.MjData(model)
    tau = nominal.inverse(q, v, a)
    data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qacc, a, atol=1e-8 * (1 + np.abs(a).max()))
    inertia, bias = nominal._mujoco(q, v)
    np.testing.assert_allclose(inertia @ a + bias, tau, atol=1e-9 * (1 + np.abs(tau).max()))
    np.testing.assert_allclose(nominal.mass_matrix(q), inertia, atol=1e-9 * (1 + np.abs(inertia).max()))


# ---- PID


def test_pid_forgets_a_constant_push_and_pd_does_not():
    model = load_model("pendulum")
    problem = _resting("pendulum", {"hinge": 0.4}, duration=4.0)
    heavy = dataclasses.replace(problem, model=_heavier(problem.model, 1.3))
    ends = {}
    for law in ("pd", "pid"):
        controls = _sampled(law, heavy, problem.model)
        segment = ContactEngine().run(heavy, (0.0, 4.0), controls)
        ends[law] = abs(segment.q[-1, 0] - 0.4)
    assert ends["pd"] > 1e-3
    assert ends["pid"] < 1e-6
    assert model.nv == 1


def test_integral_runs_back_to_where_the_drive_just_saturates():
    """With a constant error the integral settles where (sat - wanted) cancels Ki e: dI/dt = 0."""
    model = _with_motor(force=5.0)
    law = PID(model, np.array([True]), model.qpos0, kp=10.0, ki=20.0, kd=0.0, windup=0.1, feedforward="none")
    memory, target = law.start(), Target(np.array([2.0]), np.zeros(1), np.zeros(1))
    for k in range(4000):
        tau, memory = law(1e-3 * k, np.zeros(1), np.zeros(1), target, memory)
        assert abs(tau[0]) <= 5.0
    # 20 e = (I + 10 e - 5) / Tt
    assert memory.integral[0] == pytest.approx(20 * 2 * 0.1 + 5 - 10 * 2, rel=1e-2)
    target = Target(np.array([-0.1]), np.zeros(1), np.zeros(1))
    steps = 0
    while law(4 + 1e-3 * steps, np.zeros(1), np.zeros(1), target, memory)[0][0] > 0 and steps < 500:
        _, memory = law(4 + 1e-3 * steps, np.zeros(1), np.zeros(1), target, memory)
        steps += 1
    assert steps < 400  # a wound-up integral of 4 s of 2 rad would need seconds


def test_the_velocity_filter_of_pid_is_first_order_whatever_the_period():
    model = _with_motor()
    for period in (1e-3, 7e-3):
        law = PID(
            model, np.array([True]), model.qpos0, kp=0.0, ki=0.0, kd=1.0, filter=20.0, feedforward="none"
        )
        still, memory = Target(np.zeros(1), np.zeros(1), np.zeros(1)), law.start()
        _, memory = law(0.0, np.zeros(1), np.zeros(1), still, memory)
        for k in range(1, 11):
            tau, memory = law(k * period, np.zeros(1), np.ones(1), still, memory)
        assert -tau[0] == pytest.approx(1 - np.exp(-2 * np.pi * 20 * 10 * period), rel=1e-9)


# ---- computed torque


@given(st.floats(0.1, 500), st.floats(0.1, 3), st.floats(1e-4, 1e-1))
def test_held_gains_put_the_poles_where_continuous_ones_sample_to(w, zeta, period):
    kp, kd = held_gains(w, zeta, period)
    step = np.array([[1, period], [0, 1]]) - np.outer([period**2 / 2, period], [kp, kd])
    roots = np.roots([1, 2 * zeta * w, w * w]) * period
    wanted = np.exp(roots)
    np.testing.assert_allclose(
        [np.trace(step), np.linalg.det(step)], [wanted.sum().real, wanted.prod().real], atol=1e-9
    )


@pytest.mark.parametrize("seed", [0, 1])
def test_computed_torque_follows_a_clip_and_its_error_falls_with_the_square_of_the_period(seed):
    coarse, fine = (worst_error(arm_scene("computed-torque", seed, period=T)) for T in (0.008, 0.004))
    assert fine < 2e-5
    assert 3.2 < coarse / fine < 5.0


def test_computed_torque_gives_tracked_joints_their_acceleration_beside_passive_ones():
    """On a double pendulum with one driven joint, whichever it is."""
    model = load_model("double_pendulum")
    rng = np.random.default_rng(2)
    for driven in range(2):
        name = ["shoulder", "elbow"][driven]
        scene = Scene(
            duration=1.0,
            models=[{"file": "double_pendulum"}],
            roles={"tracked": [name]},
            actuators={"*": "off"},
            keys=[{"joint": name, "times": [0, 0.5, 1], "values": [0, 1, 0], "curve": "natural"}],
        )
        problem, period = make_plan(scene).problem, 1e-5
        law = make_law("computed-torque", problem, {"frequency": 1.0}, period)
        kp, kd = held_gains(2 * np.pi, 1.0, period)
        for t in (0.1, 0.7):
            q, v = rng.normal(size=2), rng.normal(size=2)
            target = Target(*problem.clip.evaluate(t))
            tau, _ = law(t, q, v, target, None)
            assert tau[1 - driven] == 0.0
            a = Nominal(model).smooth.forward(q, v, tau=tau)
            wanted = target.a + kp * (target.q - q) + kd * (target.v - v)
            assert a[driven] == pytest.approx(wanted[driven], rel=1e-3)


# ---- operational space and impedance


@pytest.mark.parametrize("keyed", [(), (0,), (1, 4)])
@pytest.mark.parametrize("axes", ["position", "pose"])
def test_operational_space_gives_the_site_its_acceleration_whatever_the_posture(axes, keyed):
    """Also beside joints that move as keyed, as far as those that are left can."""
    model, rng = load_model("arm6"), np.random.default_rng(3)
    if keyed and axes == "pose":
        return  # five joints do not turn and move a body as they like
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    held = np.isin(np.arange(6), keyed)
    nominal, task = Nominal(model), Task(model, "tip", axes)
    for posture in (0.5, 3.0):
        law = OperationalSpace(
            model, ~held, model.qpos0, held, site="tip", axes=axes, frequency=2.0, posture=posture
        )
        q, v = np.array([0.3, 0.35, 0.15, 0.2, 1.05, 0.1]), 0.3 * rng.normal(size=6)
        target = Target(q + 0.05 * rng.normal(size=6), rng.normal(size=6), rng.normal(size=6))
        target = Target(*(np.where(held, now, x) for now, x in zip((q, v, target.a), target, strict=True)))
        tau, _ = law(0.0, q, v, target, None)
        M, h = nominal.mass_matrix(q), nominal.inverse(q, v, np.where(held, target.a, 0.0))
        a = target.a.copy()
        a[~held] = np.linalg.solve(M[np.ix_(~held, ~held)], (tau - h)[~held])
        now, wanted = task.at(q, v), task.at(target.q, target.v)
        w = 2 * np.pi * 2.0
        expected = wanted.J @ target.a + wanted.drift + w**2 * task.error(now, wanted)
        expected += 2 * w * (wanted.velocity - now.velocity)
        np.testing.assert_allclose(now.J @ a + now.drift, expected, rtol=1e-6, atol=1e-6)


def test_the_drift_of_a_task_is_the_acceleration_at_constant_speed():
    model, rng = load_model("arm6"), np.random.default_rng(4)
    task, h = Task(model, "tip", "pose"), 1e-6
    q, v = rng.normal(size=6) * 0.5, rng.normal(size=6)
    rate = (task.at(q + h * v, v).velocity - task.at(q - h * v, v).velocity) / (2 * h)
    np.testing.assert_allclose(task.at(q, v).drift, rate, atol=1e-7)


@pytest.mark.parametrize("law", ["impedance", "operational-space"])
def test_a_site_at_rest_on_a_spring_yields_as_the_spring_says(law):
    """Push the tip with a constant force: the impedance law gives way by F / K in the force's direction."""
    problem = make_plan(_hold_arm(law)).problem
    stiffness, force = 800.0, np.array([4.0, -3.0, 5.0])
    words = {"stiffness": stiffness, "posture": 3.0} if law == "impedance" else {"posture": 3.0}
    controls = _sampled(law, problem, words={"site": "tip"} | words)
    pushed = _pushed(problem, "tool", force)
    segment = ContactEngine().run(pushed, (0.0, 3.0), controls)
    task, still = Task(problem.model, "tip", "position"), np.zeros(6)
    given_way = task.at(segment.q[-1], still).p - task.at(segment.q[0], still).p
    assert np.abs(segment.v[-1]).max() < 1e-3
    if law == "impedance":
        np.testing.assert_allclose(given_way, force / stiffness, rtol=0.02, atol=2e-5)


# ---- observers and reality


@given(seeds, st.floats(0.5, 20))
def test_velocity_filter_of_a_ramp(seed, corner):
    model, rng = load_model("cart_pole"), np.random.default_rng(seed)
    speed, period = rng.normal(size=2), 0.003
    observer = VelocityFilter(model, model.qpos0, corner=corner)
    memory = observer.start()
    for k in range(200):
        memory = observer.update(memory, k * period, speed * k * period, np.zeros(2))
    expected = speed * (1 - np.exp(-2 * np.pi * corner * 199 * period))
    np.testing.assert_allclose(memory.v, expected, rtol=1e-9, atol=1e-12)


def test_kalman_covariance_settles_at_the_riccati_solution():
    """The dual equation, by SciPy, for the linear filter about rest."""
    model = load_model("cart_pole")
    T, noise, push = 0.01, 2e-3, 3.0
    kalman = Kalman(model, model.qpos0, noise=noise, push=push, extended=False)
    memory = kalman.start()
    for k in range(3000):
        memory = kalman.update(memory, k * T, model.qpos0, np.zeros(2))
    lin = kalman._rest
    A = linalg.expm(np.block([[lin[0], lin[1]], [np.zeros((2, 6))]]) * T)[:4, :4]
    G = np.vstack([T * T / 2 * np.eye(2), T * np.eye(2)])
    C, R = np.eye(2, 4), noise**2 * np.eye(2)
    P = linalg.solve_discrete_are(A.T, C.T, push**2 * G @ G.T, R)
    filtered = P - P @ C.T @ np.linalg.solve(C @ P @ C.T + R, C @ P)
    np.testing.assert_allclose(memory.P, filtered, atol=1e-6 * np.abs(P).max())


def test_an_extended_filter_finds_the_speed_of_a_double_pendulum_far_from_rest():
    model, T = load_model("double_pendulum"), 0.005
    rng, smooth = np.random.default_rng(5), Nominal(model).smooth
    path = smooth.rollout([2.0, -1.0], [0.0, 0.0], step=T, steps=800)
    errors = {}
    for name, observer in {
        "extended": Kalman(model, path.q[0], noise=1e-3, push=0.05),
        "fixed": Kalman(model, np.zeros(2), noise=1e-3, push=0.05, extended=False),
        "filter": VelocityFilter(model, path.q[0], corner=20.0),
    }.items():
        memory, rates = observer.start(), []
        for k in range(801):
            memory = observer.update(memory, k * T, path.q[k] + 1e-3 * rng.normal(size=2), np.zeros(2))
            rates.append(memory.v)
        errors[name] = np.sqrt(np.mean((np.array(rates) - path.v)[200:] ** 2))
    assert errors["extended"] < 0.01
    assert errors["extended"] < 0.2 * errors["filter"]
    assert errors["extended"] < 0.1 * errors["fixed"]


ALL = np.ones(2, dtype=bool)


class _Echo:
    """A law that returns what it sees: positions first, then a count."""

    def start(self):
        return 0

    def __call__(self, t, q, v, target, memory):
        return np.array(q, dtype=float), memory + 1


@given(st.integers(0, 7), st.integers(1, 4096), seeds)
def test_a_loop_delays_and_quantises(late, counts, seed):
    model, rng = load_model("double_pendulum"), np.random.default_rng(seed)
    loop = Loop(_Echo(), model, ALL, model.qpos0, 0.01, delay=0.01 * late, encoder=counts)
    memory, seen = loop.start(), rng.normal(size=(12, 2))
    target = Target(np.zeros(2), np.zeros(2), np.zeros(2))
    for k in range(12):
        tau, memory = loop(0.01 * k, seen[k], np.zeros(2), target, memory)
        unit = 2 * np.pi / counts
        expected = np.zeros(2) if k < late else np.round(seen[k - late] / unit) * unit
        np.testing.assert_allclose(tau, expected, atol=1e-12)


@given(st.floats(1e-3, 0.5), seeds)
def test_play_hides_at_most_half_its_width_and_no_motion_smaller_than_it(width, seed):
    model, rng = load_model("double_pendulum"), np.random.default_rng(seed)
    loop = Loop(_Echo(), model, ALL, model.qpos0, 0.01, backlash=width)
    memory, q = loop.start(), np.zeros(2)
    target, shown = Target(np.zeros(2), np.zeros(2), np.zeros(2)), None
    for k in range(40):
        step = 0.7 * width * rng.uniform(-1, 1, 2)
        q = q + step
        last, (shown, memory) = shown, loop(0.01 * k, q, np.zeros(2), target, memory)
        assert (np.abs(shown - q) <= 0.5 * width + 1e-12).all()
        if last is not None:
            moved = shown != last
            assert (np.sign(shown - last)[moved] == np.sign(step)[moved]).all()


def geared(width=0.1, armature=0.02, period=0.01):
    model = load_model("double_pendulum")
    model.dof_armature[:] = armature
    return Play(model, np.array([width, 0.0]), period), model


@given(st.floats(0.01, 0.3), st.floats(0.005, 0.1), st.floats(0.2, 5.0))
def test_a_rotor_crosses_its_gap_as_a_free_body(width, inertia, torque):
    """From one flank to the other in sqrt(2 width J / tau): until then nothing arrives, then all that was
    put into the rotor, then the torque."""
    play, _ = geared(width, inertia, period=1e-3)
    still, rotors, given_ = np.zeros(2), Rotors(np.array([-width / 2, 0.0]), np.zeros(2)), []
    crossing = np.sqrt(2 * width * inertia / torque)
    for _ in range(int(crossing / 1e-3) + 5):
        tau, rotors = play.pass_on(np.array([torque, torque]), still, still, rotors)
        given_.append(tau[0])
        assert tau[1] == torque
    k = int(crossing / 1e-3 - 1e-6)  # rounding may tell a crossing at a sample as before it
    np.testing.assert_allclose(given_[:k], 0, atol=1e-12)
    np.testing.assert_allclose(np.sum(given_) * 1e-3, torque * 1e-3 * len(given_), rtol=1e-9)
    np.testing.assert_allclose(given_[k + 2 :], torque)


@given(seeds, st.floats(-2.0, 2.0))
def test_play_loses_no_impulse(seed, speed):
    """Whatever the torques, beside a joint that moves evenly: what arrived and what is in the rotor."""
    rng, (play, model) = np.random.default_rng(seed), geared()
    q, v = np.array([0.3, 0.0]), np.array([speed, 0.0])
    rotors, put, got = play.start(q, v), 0.0, 0.0
    for k in range(200):
        tau = rng.normal(size=2) * (k < 150 or rng.uniform() < 0.5)
        at = q + 0.01 * k * v
        given_, rotors = play.pass_on(tau, at, v, rotors)
        put, got = put + 0.01 * tau[0], got + 0.01 * given_[0]
        gap = rotors.q[0] - (at[0] + 0.01 * speed)
        assert abs(gap) <= 0.05 + 1e-9
        assert put == pytest.approx(got + model.dof_armature[0] * (rotors.v[0] - speed), abs=1e-9)


def test_a_flank_pushes_and_does_not_pull():
    """A rotor that runs into its flank against its motor gives its momentum, turns round, and gives nothing
    more."""
    play, still = geared(0.1, 0.02, 0.01)[0], np.zeros(2)
    rotors = Rotors(np.array([0.05 - 1e-3, 0.0]), np.array([1.0, 0.0]))
    tau = np.array([-0.5, 0.0])
    hit = 2e-3 / (1.0 + np.sqrt(1.0 - 2 * 25.0 * 1e-3))  # 1e-3 = t - 25 t^2 / 2
    given_, after = play.pass_on(tau, still, still, rotors)
    assert given_[0] == pytest.approx(0.02 * (1.0 - 25.0 * hit) / 0.01, rel=1e-9)
    assert after.q[0] == pytest.approx(0.05 - 12.5 * (0.01 - hit) ** 2, rel=1e-9)
    assert play.pass_on(tau, still, still, after)[0][0] == 0.0


def test_dry_friction_stops_and_does_not_shake():
    """Friction that would turn a light body round within a period stops it instead."""
    model = _with_motor(force=50.0)
    loop = Loop(_Still(), model, ALL[:1], model.qpos0, 0.02, friction=5.0)
    v, inertia, memory = np.array([0.3]), felt_inertia(model, model.qpos0)[0], loop.start()
    for _ in range(50):
        before = v[0]
        tau, memory = loop(0.0, np.zeros(1), v, None, memory)
        v = v + 0.02 * (tau + loop.lost(v)) / inertia
        assert 0.0 <= v[0] <= before
    assert v[0] < 1e-3


class _Still:
    """No force."""

    def start(self):
        return None

    def __call__(self, t, q, v, target, memory):
        return np.zeros(len(v)), None


def test_a_loop_cuts_forces_as_the_motor_does():
    model = _with_motor(force=8.0)
    loop = Loop(_Echo(), model, ALL[:1], model.qpos0, 0.01, saturation=0.5, top_speed=10.0, friction=0.0)
    still = Target(np.zeros(1), np.zeros(1), np.zeros(1))
    for speed, asked, given_ in ((0, 9, 4), (5, 9, 2), (5, -9, -4), (-5, -9, -2), (12, 9, 0), (0, 1, 1)):
        tau, _ = loop(0.0, np.array([float(asked)]), np.array([float(speed)]), still, loop.start())
        assert tau[0] == pytest.approx(given_)
    # what friction takes is no matter of the drive's limit
    loop = Loop(_Echo(), model, ALL[:1], model.qpos0, 0.01, friction=1.0)
    tau, memory = loop(0.0, np.array([99.0]), np.array([50.0]), still, loop.start())
    assert (tau[0], loop.lost(np.array([50.0]))[0]) == (8.0, -1.0)
    assert memory.cut[0]
    low, high = force_limits(model)
    assert (low[0], high[0]) == (-8.0, 8.0)


# ---- LQR along keys, learning


def test_lqr_holds_an_unstable_state_and_follows_keys():
    scene = Scene(
        duration=6.0,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        keys=[{"joint": "slide", "times": [0], "values": [0]}],
        initial={"position": {"hinge": 0.2, "slide": 0.1}},
        controller={"law": "lqr", "period": 0.01, "goal": {"hinge": 0.0}},
    )
    assert np.abs(run(scene).q[-1]).max() < 1e-3
    assert worst_error(arm_scene("lqr", 5)) < 1e-4


@pytest.mark.parametrize("keys", [[0.0], [0.0, 0.4]])
@pytest.mark.parametrize("final", [0.0, 3.0])
def test_regulation_that_ends_is_the_minimum_over_all_forces(keys, final):
    """Forces of the law along its own linearised motion against least squares over the whole horizon, on keys
    that rest and that move."""
    scene = Scene(
        duration=0.4,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        keys=[{"joint": "slide", "times": np.linspace(0, 0.4, len(keys)).tolist(), "values": keys}],
        controller={"law": "lqr", "period": 0.02, "final": final, "force": 0.3},
    )
    law = make_law("lqr", make_plan(scene).problem, {"final": final, "force": 0.3}, 0.02)
    A, B, K, P, _ = law.solution
    assert len(K) == 20
    x0, Q, R = np.array([0.1, -0.05, 0.2, 0.1]), law.Q, law.R
    # x = M x0 + N u, minimised by its normal equations
    M, N = [np.eye(4)], [np.zeros((4, 20))]
    for k in range(20):
        push = np.zeros((4, 20))
        push[:, k] = B[k][:, 0]
        M.append(A[k] @ M[-1])
        N.append(A[k] @ N[-1] + push)
    weights = [Q] * 20 + [np.diag([400.0, 400.0, 1.0, 1.0]) * final]
    H = R[0, 0] * np.eye(20) + sum(n.T @ W @ n for n, W in zip(N, weights, strict=True))
    g = sum(n.T @ W @ m for n, m, W in zip(N, M, weights, strict=True)) @ x0
    u = -np.linalg.solve(H, g)
    x = x0
    for k in range(20):
        np.testing.assert_allclose(-K[k] @ x, u[k : k + 1], rtol=1e-6, atol=1e-9 * np.abs(u).max())
        x = A[k] @ x + B[k] @ (-K[k] @ x)
    assert x0 @ P[0] @ x0 == pytest.approx(
        sum((m @ x0 + n @ u) @ W @ (m @ x0 + n @ u) for m, n, W in zip(M, N, weights, strict=True))
        + R[0, 0] * u @ u,
        rel=1e-9,
    )


def test_learning_removes_what_the_model_does_not_know():
    problem = make_plan(arm_scene("pd", 6, duration=1.5)).problem
    true = dataclasses.replace(problem, model=_heavier(problem.model, 1.1))
    found = learn(
        lambda: make_law("pd", true, {}, 0.002, model=problem.model), true, ContactEngine(), 0.002, repeats=8
    )
    assert found.errors[-1] < 0.05 * found.errors[0]
    assert found.forces.shape == (750, 6)


def test_a_repeat_that_diverges_is_the_last_one():
    problem = make_plan(arm_scene("pd", 6, duration=0.2)).problem
    wild = {"kp": 1e9, "kd": 1e6}
    found = learn(lambda: make_law("pd", problem, wild, 0.002), problem, ContactEngine(), 0.002, repeats=8)
    assert found.errors == (np.inf,)
    assert not found.forces.any()
    for words in ({"share": 1.5}, {"repeats": 0}, {"bandwidth": -1.0}):
        with pytest.raises(PantographError):
            learn(lambda: make_law("pd", problem, {}, 0.002), problem, ContactEngine(), 0.002, **words)


def test_what_was_learned_can_be_given_to_a_scene(tmp_path):
    """The file that learning wrote makes a run of the same law as good as its best repeat."""
    scene = arm_scene("pd", 6, duration=0.6).model_copy(update={"rate": 500.0})
    plan = make_plan(scene)
    engine = make_engine(plan.engine.what)
    found = learn(lambda: make_law("pd", plan.problem, {}, 0.002), plan.problem, engine, 0.002, repeats=4)
    path = found.save(tmp_path / "a" / "arm.npz")
    item = ControllerItem(law="pd", period=0.002, learned=str(path))
    recording = run(scene.model_copy(update={"controller": item}))
    np.testing.assert_allclose(recording.tick_t, recording.t[:-1], atol=1e-9)
    aims = plan.problem.clip.evaluate(recording.tick_t).q
    assert np.sqrt(np.mean((recording.q[:-1] - aims) ** 2)) == pytest.approx(min(found.errors), rel=1e-6)
    assert min(found.errors) < 0.1 * found.errors[0]
    for words, message in (
        ({"period": 0.004}, "learned with a period of 0.002 s"),
        ({"learned": str(tmp_path / "none.npz")}, "cannot read forces"),
    ):
        item = ControllerItem(**{"law": "pd", "period": 0.002, "learned": str(path)} | words)
        with pytest.raises(SceneError, match=message):
            make_plan(scene.model_copy(update={"controller": item}))


@pytest.mark.parametrize(
    ("law", "words", "message"),
    [
        ("pid", {"feedforward": "magic"}, "no feedforward 'magic'"),
        ("pid", {"ki": {"knee": 1.0}}, "no joint 'knee'"),
        ("computed-torque", {"frequency": -1}, "frequency must be a positive"),
        ("operational-space", {}, "site = one of tip"),
        ("impedance", {"site": "top"}, "no site 'top'"),
        ("lqr", {"force": 0.0}, "must cost something"),
        ("lqr", {"goal": {"waist": 0.0}}, "no joint without keys 'waist'"),
        ("lqr", {"final": -1.0}, "final must be a number >= 0"),
        ("mpc", {"horizon": 0.0}, "horizon must be a positive"),
        ("pd", {"observer": "eyes"}, "no observer 'eyes'"),
        ("pd", {"gravity": "no"}, "gravity must be true or false"),
        ("pd", {"kp": "hard"}, "kp must be a number, got 'hard'"),
        ("pd", {"kd": {"elbow": float("nan")}}, "kd of 'elbow' must be a number, got nan"),
        ("pid", {"filter": True}, "filter must be a number, got True"),
        ("pid", {"windup": 0}, "windup must be a positive"),
        ("impedance", {"site": 3}, "site = one of tip"),
        ("lqr", {"goal": 0.3}, "a value for each joint"),
        ("lqr", {"position": {"waist": -1.0}}, "position of 'waist' must be a number >= 0"),
        ("mpc", {"fine": 0.5}, "fine must be a whole number >= 1, got 0.5"),
        ("mpc", {"slew": 0.0}, "slew must be a positive"),
        ("mpc", {"speed": {"elbow": 0.0}}, "speed of 'elbow' must be a positive"),
        ("nmpc", {"iterations": 0.5}, "iterations must be a whole number >= 1"),
        ("nmpc", {"step": float("inf")}, "step must be a number, got inf"),
        ("nmpc", {"goal": {"waist": 0.0}}, "no joint without keys 'waist'"),
        ("pd", {"top_speed": 3.0}, "top_speed needs to know what the drive of 'waist' can give"),
        ("pd", {"saturation": 0.5}, "saturation needs to know what the drive"),
        ("pd", {"delay": "1ms"}, "delay must be a number"),
        ("pd", {"corner": -1.0}, "corner must be a positive"),
        ("pd", {"detay": 1}, "did you mean 'delay'"),
    ],
)
def test_mistakes_in_a_law_are_told_in_words(law, words, message):
    with pytest.raises(SceneError, match=message):
        make_plan(arm_scene(law, **words))


def _resting(file, position, duration):
    """A model whose joints are told to stay where they are."""
    scene = Scene(
        duration=duration,
        models=[{"file": file}],
        roles={"tracked": list(position)},
        actuators={"*": "off"} if load_model(file).nu else {},
        keys=[{"joint": j, "times": [0], "values": [x]} for j, x in position.items()],
    )
    return make_plan(scene).problem


def _hold_arm(law):
    pose = dict(zip(ARM, [0.3, 0.35, 0.15, 0.2, 1.05, 0.1], strict=True))
    return Scene(
        duration=3.0,
        models=[{"file": "arm6"}],
        roles={"tracked": ARM},
        actuators={"*": "off"},
        keys=[{"joint": j, "times": [0], "values": [x]} for j, x in pose.items()],
        physics={"friction": False, "contacts": "none"},
        controller={"law": law, "site": "tip"},
    )


def _pushed(problem, body, force):
    from pantograph.sim.engines.interface import Wrench

    index = mujoco.mj_name2id(problem.model, mujoco.mjtObj.mjOBJ_BODY, body)
    data = mujoco.MjData(problem.model)
    data.qpos[:] = problem.state0.q
    mujoco.mj_kinematics(problem.model, data)
    torque = np.cross(data.site("tip").xpos - data.xipos[index], force)
    curves = (keyed([0.0], [list(x)]) for x in (force, torque))
    return dataclasses.replace(problem, wrenches=(Wrench(index, *curves),))


def _heavier(model, factor):
    import copy

    out = copy.copy(model)
    out.body_mass[:] *= factor
    out.body_inertia[:] *= factor
    mujoco.mj_setConst(out, mujoco.MjData(out))
    return out


def _sampled(law, problem, believed=None, words=None, period=0.002):
    from pantograph.sim.control import Sampled

    return Sampled(make_law(law, problem, words or {}, period, model=believed), problem, period)


def _with_motor(force=np.inf):
    limit = f'forcerange="{-force} {force}"' if np.isfinite(force) else ""
    xml = f"""<mujoco>
      <worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1" mass="1"/></body></worldbody>
      <actuator><motor joint="j" {limit}/></actuator></mujoco>"""
    return mujoco.MjModel.from_xml_string(xml)


def test_felt_inertia_of_one_body_is_its_inertia():
    model = _with_motor()
    assert felt_inertia(model, model.qpos0)[0] == pytest.approx(0.4 * 0.01)
    assert difference(model, np.array([0.5]), np.array([0.2]))[0] == pytest.approx(-0.3)


@pytest.mark.parametrize("law", ["operational-space", "impedance"])
def test_task_space_laws_leave_to_keyed_joints_what_these_do(law):
    """The waist turns the task as keyed; the arm is not asked to produce that acceleration."""
    joints = ("shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll")
    scene = Scene(
        duration=0.5,
        models=[{"file": "arm6"}],
        roles={"tracked": list(joints)},
        keys=[
            {"joint": "waist", "times": [0, 0.25, 0.5], "values": [0, 0.6, 0]},
            *({"joint": j, "times": [0], "values": [0.3]} for j in ("shoulder", "elbow", "wrist_pitch")),
        ],
        controller={"law": law, "site": "tip"},
        physics={"contacts": "none"},
    )
    recording = run(scene)
    assert recording.status == "done"
    assert np.abs(recording.q[:, 1:5] - [0.3, 0.3, 0.0, 0.3]).max() < 0.15
