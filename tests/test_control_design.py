"""Linear design against closed forms, definitions and brute force."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import control_gains
from pantograph.controllers import cli
from pantograph.controllers.design import (
    LinearSystem,
    along,
    closed_loop,
    controllability,
    detectability,
    dlqr,
    figures,
    finite_horizon,
    held,
    linearise,
    linearise_contact,
    loop_response,
    lqr,
    margins,
    modes,
    observability,
    root_locus,
    stabilisability,
    step_info,
    step_response,
)
from pantograph.controllers.design.law import loop_of
from pantograph.controllers.design.linear import exponential
from pantograph.controllers.gains import force_limits
from pantograph.controllers.lqr import LQR
from pantograph.controllers.nominal import Nominal, moved
from pantograph.models import load_model
from pantograph.sim import Scene, make_plan, run
from pantograph.sim.compose import make_law
from pantograph.sim.control import Target
from pantograph.sim.errors import PantographError
from scipy import linalg
from strategies import random_states, seeds, trees

KNOWN = [
    control_gains.double_integrator,
    control_gains.inverted_pendulum,
    control_gains.ctms_cart_pendulum,
]


def system(A, B, period=None):
    n, m = np.shape(B)
    return LinearSystem(
        np.array(A, dtype=float),
        np.array(B, dtype=float),
        ("x",) * n,
        tuple(f"u{i}" for i in range(m)),
        period,
    )


def random_system(seed, n=4, m=2):
    rng = np.random.default_rng(seed)
    return rng.normal(size=(n, n)), rng.normal(size=(n, m))


@pytest.mark.parametrize("case", KNOWN)
def test_gains_known_to_many_digits(case):
    A, B, Q, R, K = case()
    r = lqr(A, B, Q, R)
    np.testing.assert_allclose(r.K, [K], rtol=1e-9, atol=1e-9)
    assert r.residual < 1e-12
    assert (r.poles.real < 0).all()


def test_the_built_in_cart_pole_is_the_one_of_the_tutorials():
    A, B, _, _, _ = control_gains.ctms_cart_pendulum()
    model = load_model("cart_pole")
    model.opt.gravity[2] = -9.8
    found = linearise(model, model.qpos0, inputs=np.array([True, False]))
    order = [0, 2, 1, 3]  # theirs: x, x', phi, phi'
    turn = np.diag([1.0, 1.0, -1.0, -1.0])
    A, B = (turn @ A @ turn)[np.ix_(order, order)], (turn @ B)[order]
    sign = (
        1.0
        if np.sign(found.A[3, 1]) == np.sign(A[3, 1]) and np.sign(found.B[3, 0]) == np.sign(B[3, 0])
        else -1.0
    )
    flip = np.diag([1.0, sign, 1.0, sign])
    np.testing.assert_allclose(found.A, flip @ A @ flip, atol=1e-12)
    np.testing.assert_allclose(found.B, flip @ B, atol=1e-12)


@given(seeds)
def test_no_gain_near_the_regulators_is_cheaper(seed):
    """x'P x is the cost of K, and K is its minimum: cost of any other gain by Lyapunov's equation."""
    rng = np.random.default_rng(seed)
    A, B = random_system(seed)
    W = rng.normal(size=(6, 6))
    W = W @ W.T
    Q, R, N = W[:4, :4], W[4:, 4:] + 0.1 * np.eye(2), W[:4, 4:]
    r = lqr(A, B, Q, R, N)

    def cost(K):
        F = A - B @ K
        return linalg.solve_continuous_lyapunov(F.T, -(Q + K.T @ R @ K - N @ K - (N @ K).T))

    scale = np.abs(r.P).max()
    np.testing.assert_allclose(cost(r.K), r.P, atol=1e-8 * scale)
    for _ in range(5):
        worse = cost(r.K + 1e-3 * rng.normal(size=r.K.shape) / (1 + np.linalg.norm(r.K))) - r.P
        assert np.linalg.eigvalsh(0.5 * (worse + worse.T)).min() > -1e-9 * scale


@given(seeds)
def test_discrete_gains_minimise_the_sum(seed):
    A, B = random_system(seed)
    r = dlqr(A, B, np.eye(4), np.eye(2))
    gains, values = finite_horizon(A, B, np.eye(4), np.eye(2), r.P, 7)
    np.testing.assert_allclose(gains, np.broadcast_to(r.K, gains.shape), atol=1e-8 * np.abs(r.K).max())
    np.testing.assert_allclose(values[0], r.P, atol=1e-8 * np.abs(r.P).max())
    assert (np.abs(r.poles) < 1).all()
    assert r.residual < 1e-10


def test_discrete_gains_become_continuous_ones_at_first_order_in_the_period():
    A, B, Q, R, K = control_gains.ctms_cart_pendulum()
    periods, errors = np.array([4e-3, 2e-3, 1e-3, 5e-4]), []
    for T in periods:
        step = held(system(A, B), T)
        errors.append(np.abs(dlqr(step.A, step.B, Q * T, R * T).K - K).max())
    slope = np.polyfit(np.log(periods), np.log(errors), 1)[0]
    assert 0.9 < slope < 1.1


@given(seeds)
def test_finite_horizon_is_the_minimum_over_all_inputs(seed):
    """Against the same problem as one least-squares problem over all inputs; time-varying too."""
    rng = np.random.default_rng(seed)
    s, n, m = 4, 3, 2
    A, B = rng.normal(size=(s, n, n)), rng.normal(size=(s, n, m))
    Q, R, F = np.diag(rng.uniform(0.1, 2, n)), np.diag(rng.uniform(0.1, 2, m)), 3 * np.eye(n)
    K, P = along(A, B, Q, R, F)
    x0 = rng.normal(size=n)
    free, forced, rows, rhs = x0, np.zeros((n, s * m)), [], []
    for k in range(s):
        rows += [np.sqrt(Q) @ forced]
        rhs += [-np.sqrt(Q) @ free]
        put = np.zeros((m, s * m))
        put[:, k * m : (k + 1) * m] = np.eye(m)
        rows += [np.sqrt(R) @ put]
        rhs += [np.zeros(m)]
        free, forced = A[k] @ free, A[k] @ forced + B[k] @ put
    rows += [np.sqrt(F) @ forced]
    rhs += [-np.sqrt(F) @ free]
    M, b = np.vstack(rows), np.concatenate(rhs)
    u = np.linalg.lstsq(M, b, rcond=None)[0]
    assert np.sum((M @ u - b) ** 2) == pytest.approx(x0 @ P[0] @ x0, rel=1e-9)
    np.testing.assert_allclose(-K[0] @ x0, u[:m], atol=1e-8 * (1 + np.abs(u).max()))


@given(seeds, st.floats(-6, 2))
def test_exponential(seed, size):
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(3, 5, 5)) * 10.0**size / 5
    for mine, one in zip(exponential(M), M, strict=True):
        theirs = linalg.expm(one)
        np.testing.assert_allclose(mine, theirs, atol=1e-12 * np.exp(np.linalg.norm(one, 2)))


@given(trees(max_bodies=3), seeds)
@settings(max_examples=25)
def test_linearisation_predicts_nearby_motion(model, seed):
    """Derivatives of the state's rate, both ends in the tangent space, against differences of two motions."""
    if model.nv == 0:
        return
    q, v, _ = random_states(model, seed, 1)
    q, v, rng = q[0], v[0], np.random.default_rng(seed)
    nominal = Nominal(model)
    tau = rng.normal(size=model.nv)
    lin = linearise(model, q, v, tau)
    d, n, dt = rng.normal(size=(2, model.nv)), model.nv, 1e-4

    def after(eps):
        """State dt later, to second order, in the tangent space of the unperturbed one."""
        q1, v1 = moved(model, q, eps * d[0]), v + eps * d[1]
        a1 = nominal.smooth.forward(q1, v1, tau=tau)
        return moved(model, q1, dt * v1), v1 + dt * a1

    eps = 1e-5
    (qp, vp), (qm, vm) = after(eps), after(-eps)
    dq = np.empty(n)
    mujoco.mj_differentiatePos(model, dq, 2 * eps, qm, qp)
    rate = (np.concatenate([dq, (vp - vm) / (2 * eps)]) - np.concatenate([d[0], d[1]])) / dt
    predicted = lin.A @ np.concatenate([d[0], d[1]])
    scale = 1 + np.abs(predicted).max()
    np.testing.assert_allclose(rate, predicted, atol=2e-3 * scale)


def test_contact_differences_equal_exact_derivatives_where_nothing_touches():
    model = load_model("double_pendulum")
    q, v, tau = np.array([0.7, -1.1]), np.array([0.5, 2.0]), np.array([1.0, -0.3])
    exact, theirs = linearise(model, q, v, tau), linearise_contact(model, q, v, tau)
    np.testing.assert_allclose(theirs.A, exact.A, atol=1e-7)
    np.testing.assert_allclose(theirs.B, exact.B, atol=1e-7)


@pytest.mark.parametrize("which", [0, 1])
def test_contact_differences_with_keyed_joints_equal_exact_derivatives_too(which):
    model, keyed = load_model("double_pendulum"), np.arange(2) == which
    point = np.array([0.7, -1.1]), np.array([0.5, 2.0]), np.array([1.0, -0.3])
    words = {"keyed": keyed, "a_keyed": np.array([3.0, -2.0])}
    exact, theirs = linearise(model, *point, **words), linearise_contact(model, *point, **words)
    assert theirs.states == exact.states
    assert theirs.inputs == exact.inputs
    np.testing.assert_allclose(theirs.A, exact.A, atol=1e-5)
    np.testing.assert_allclose(theirs.B, exact.B, atol=1e-5)


def test_contact_differences_feel_the_floor():
    xml = """<mujoco><worldbody><geom type="plane" size="1 1 .1"/><body pos="0 0 .0999"><freejoint/>
      <geom type="sphere" size=".1" mass="1"/></body></worldbody></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    A = linearise_contact(model, model.qpos0).A
    assert A[8, 2] < -100.0  # the floor is a stiff spring against falling deeper
    assert A[6, 2] == pytest.approx(0.0, abs=1e-6)


def test_keyed_joints_are_not_states():
    model = load_model("double_pendulum")
    q, v, a = np.array([0.3, 0.8]), np.array([1.5, -0.4]), np.array([2.0, 0.0])
    keyed = np.array([True, False])
    part = linearise(model, q, v, np.zeros(2), keyed=keyed, a_keyed=a)
    assert part.A.shape == (2, 2)
    # elbow: l^2 (a1 + a2) + l^2 a1 cos(q2) + l^2 v1^2 sin(q2) + g l sin(q1 + q2) = 0, by q2
    by_q = a[0] * np.sin(q[1]) - v[0] ** 2 * np.cos(q[1]) - 9.81 * np.cos(q.sum())
    np.testing.assert_allclose(part.A, [[0, 1], [by_q, 0]], atol=1e-9)


def test_controllability_names_the_mode_that_nothing_moves():
    A = np.diag([1.0, -2.0, 3.0])
    s = system(A, [[1.0], [0.0], [1.0]])
    verdict = controllability(s)
    assert not verdict
    assert [m.pole for m in verdict.modes] == pytest.approx([-2.0])
    assert stabilisability(s)
    lost = stabilisability(system(A, [[0.0], [1.0], [1.0]]))
    assert not lost
    assert [m.pole for m in lost.modes] == pytest.approx([1.0])
    with pytest.raises(PantographError, match="no input can steer the mode 1"):
        lqr(A, [[0.0], [1.0], [1.0]], np.eye(3), np.eye(1))


@given(seeds)
def test_controllability_agrees_with_kalmans_rank_whatever_the_coordinates(seed):
    rng = np.random.default_rng(seed)
    A, B = random_system(seed, 4, 1)
    A[3] = 0.0
    A[3, 3] = -0.7
    B[3] = 0.0
    T = linalg.qr(rng.normal(size=(4, 4)))[0]
    hidden = system(T @ A @ T.T, T @ B)
    verdict = controllability(hidden)
    assert [m.pole.real for m in verdict.modes] == pytest.approx([-0.7], abs=1e-6)
    assert controllability(system(A[:3, :3], B[:3]))


def mechanism(M, K, D, driven):
    """M a + D v + K q = forces at the joints ``driven``, as a linear system."""
    n, names = len(M), tuple(f"j{i}" for i in range(len(M)))
    inverse = np.linalg.inv(M)
    A = np.block([[np.zeros((n, n)), np.eye(n)], [-inverse @ K, -inverse @ D]])
    B = np.vstack([np.zeros((n, len(driven))), inverse[:, driven]])
    inputs = tuple(names[i] for i in driven)
    return LinearSystem(A, B, (*names, *(f"{name} rate" for name in names)), inputs)


def positive_matrix(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.3 * np.eye(n)


@pytest.mark.parametrize("period", [None, 0.01, 1e-4])
@given(seeds, st.integers(2, 5), st.booleans(), st.booleans())
@settings(max_examples=30)
def test_a_base_in_free_fall_is_named_not_what_drives_it(period, seed, n, springs, damped):
    """No force inside moves the centre of mass: the joint that only the world could push is named, twice at
    zero, whatever the inertias are and also where other joints drift as freely."""
    rng = np.random.default_rng(seed)
    base = int(rng.integers(n))
    driven = [i for i in range(n) if i != base]
    inner = np.ix_(driven, driven)
    K, D = np.zeros((n, n)), np.zeros((n, n))
    K[inner] = positive_matrix(rng, n - 1) if springs else 0.0
    D[inner] = positive_matrix(rng, n - 1) if damped else 0.0
    s = mechanism(positive_matrix(rng, n), K, D, driven)
    s = s if period is None else held(s, period)
    verdict = controllability(s)
    assert [m.of for m in verdict.modes] == [f"j{base}"] * 2
    assert [m.frequency for m in verdict.modes] == pytest.approx([0.0, 0.0], abs=1e-3)
    assert not stabilisability(s)
    assert f"no input moves j{base} (" in stabilisability(s).says
    with pytest.raises(PantographError, match=f"no input can steer .*j{base}"):
        (lqr if period is None else dlqr)(s.A, s.B, np.eye(2 * n), np.eye(n - 1), states=s.states)


@given(seeds, st.integers(1, 3), st.integers(1, 3))
@settings(max_examples=30)
def test_all_joints_that_take_part_in_what_nothing_moves_are_named(seed, apart, together):
    """Loose joints that hang together beside a driven machine: each mode is one of all of them."""
    rng = np.random.default_rng(seed)
    n = apart + together
    order = rng.permutation(n)
    M = linalg.block_diag(positive_matrix(rng, apart), positive_matrix(rng, together))
    K = linalg.block_diag(positive_matrix(rng, apart), positive_matrix(rng, together))
    where = np.argsort(order)
    ours = [int(where[i]) for i in range(apart)]
    s = held(mechanism(*(x[np.ix_(order, order)] for x in (M, K, 0.1 * K)), ours), 0.005)
    verdict = controllability(s)
    loose = ", ".join(sorted(f"j{where[i]}" for i in range(apart, n)))
    assert len(verdict.modes) == 2 * together
    assert {m.of for m in verdict.modes} == {loose}
    C = np.eye(2 * n)[ours]
    assert {m.of for m in observability(s, C).modes} == {loose}


def test_equal_pendulums_on_a_driven_cart_swing_against_each_other():
    """Only their sum pushes the cart: their difference is out of its reach, and moves no cart."""
    M = np.array([[3.0, 0.5, 0.5], [0.5, 1.0, 0.0], [0.5, 0.0, 1.0]])
    s = mechanism(M, np.diag([0.0, 9.81, 9.81]), np.zeros((3, 3)), [0])
    verdict = controllability(s)
    assert verdict.says == "not controllable by j0: they cannot move j1, j2 (3.13 rad/s)"
    assert [m.frequency for m in verdict.modes] == pytest.approx([np.sqrt(9.81)] * 2)


def test_a_loose_body_is_named_as_one(tmp_path):
    (tmp_path / "two.xml").write_text(
        """<mujoco><worldbody><body><joint name="hinge" axis="0 1 0"/><geom size=".1" pos="0 0 -1"/></body>
        <body name="ball" pos="2 0 0"><freejoint name="ball"/><geom size=".1"/></body></worldbody></mujoco>"""
    )
    m = mujoco.MjModel.from_xml_path(str(tmp_path / "two.xml"))
    s = linearise(m, m.qpos0, inputs=np.arange(m.nv) == 0)
    assert controllability(s).says == "not controllable by hinge: they cannot move ball (0 rad/s)"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"R": -np.eye(1)}, "positive definite"),
        ({"Q": -np.eye(2)}, "negative"),
        ({"Q": np.array([[1.0, 1.0], [0.0, 1.0]])}, "symmetric"),
        ({"Q": np.eye(3)}, "shape"),
        ({"A": np.full((2, 2), np.nan)}, "finite"),
        ({"Q": np.diag([0.0, 1.0])}, "no weight sees the mode"),
    ],
)
def test_what_makes_no_sense_is_refused(change, words):
    A, B, Q, R, _ = control_gains.double_integrator()
    with pytest.raises(PantographError, match=words):
        lqr(**({"A": A, "B": B, "Q": Q, "R": R} | change))


@given(st.floats(0.2, 30), st.floats(0.1, 0.9))
def test_step_figures_of_a_second_order_loop(w, zeta):
    s = system([[0, 1], [-w * w, -2 * zeta * w]], [[0.0], [w * w]])
    t = np.linspace(0, 12 / (zeta * w), 4001)
    y = step_response(s, [1.0, 0.0], t)
    np.testing.assert_allclose(y, control_gains.second_order_step(w, zeta, t), atol=1e-9)
    info = step_info(t, y, final=1.0)
    assert info.overshoot == pytest.approx(np.exp(-np.pi * zeta / np.sqrt(1 - zeta**2)), rel=1e-2, abs=1e-4)
    inside = np.abs(control_gains.second_order_step(w, zeta, t[t > info.settling + t[1]]) - 1)
    assert inside.max() <= 0.02 + 1e-6
    before = np.abs(control_gains.second_order_step(w, zeta, max(info.settling - t[1], 0.0)) - 1)
    assert before > 0.019
    (first, second) = modes(s.A)
    assert first.frequency == pytest.approx(w)
    assert second.damping == pytest.approx(zeta)


@given(st.floats(0.1, 50), st.floats(0.1, 50))
def test_margins_of_a_pd_loop(k1, k2):
    A, B, *_ = control_gains.double_integrator()
    m = margins(system(A, B), [[k1, k2]])
    w, phase = control_gains.lead_of_pd_double_integrator(k1, k2)
    assert m.crossover == pytest.approx(w, rel=1e-6)
    assert m.phase == pytest.approx(phase, rel=1e-6)
    assert m.delay == pytest.approx(phase / w, rel=1e-6)
    assert m.gain[0] == pytest.approx(0.0, abs=1e-3)
    assert m.gain[1] == np.inf


@given(seeds)
@settings(max_examples=30)
def test_margins_are_where_stability_ends(seed):
    """Gain margins by the closed loop's poles themselves; the regulator's guarantees (Safonov 1977)."""
    A, B = random_system(seed, 3, 1)
    r = lqr(A, B, np.eye(3), np.eye(1))
    m = margins(system(A, B), r.K)
    assert m.disk > 1.0 - 1e-6
    assert m.gain[0] <= 0.5 + 1e-6
    assert m.gain[1] == np.inf
    assert m.phase >= np.pi / 3 - 1e-6
    if m.gain[0] > 1e-2:
        for factor, stable in ((1.001 * m.gain[0], True), (0.999 * m.gain[0], False)):
            assert (linalg.eigvals(A - factor * B @ r.K).real < 1e-9).all() == stable


def test_delay_margin_of_a_sampled_loop():
    A, B, Q, R, _ = control_gains.inverted_pendulum()
    step = held(system(A, B), 0.01)
    K = dlqr(step.A, step.B, Q, R).K
    margin = margins(step, K)
    late = [d for d in range(60) if _stable_with_delay(step, K, d)]
    assert late == list(range(len(late)))
    assert abs(len(late) - 1 - margin.delay / 0.01) <= 1.0


def _stable_with_delay(step, K, d):
    n = 2 + d
    M = np.zeros((n, n))
    M[:2, :2] = step.A - step.B @ K if d == 0 else step.A
    if d:
        M[:2, 2:3] = step.B
        M[2 : n - 1, 3:] = np.eye(d - 1)
        M[n - 1, :2] = -K
    return np.abs(linalg.eigvals(M)).max() < 1


def test_loop_gain_and_root_locus_by_definition():
    A, B, _, _, K = control_gains.inverted_pendulum()
    s, w = system(A, B), np.array([0.3, 2.0, 40.0])
    expected = (K[0] + 1j * w * K[1]) / (-(w**2) - control_gains.G)
    np.testing.assert_allclose(loop_response(s, [K], w), expected, rtol=1e-12)
    factors = np.linspace(0, 2, 41)
    locus = root_locus(s, [K], factors)
    for factor, poles in zip(factors, locus, strict=True):
        exact = np.roots([1.0, factor * K[1], factor * K[0] - control_gains.G])
        np.testing.assert_allclose(np.sort_complex(poles), np.sort_complex(exact), atol=1e-6)
    np.testing.assert_allclose(
        np.sort_complex(linalg.eigvals(closed_loop(s, [K]).A)), np.sort_complex(locus[20]), atol=1e-8
    )


def test_pictures_show_what_was_computed():
    A, B, _, _, K = control_gains.inverted_pendulum()
    s = system(A, B)
    for shown, gains in ((s, [K]), (system(*control_gains.ctms_cart_pendulum()[:2]), None)):
        gains = gains or [control_gains.ctms_cart_pendulum()[4]]
        w, phase = figures.bode(shown, gains).axes[1].lines[0].get_data()
        found = margins(shown, gains)
        at_crossover = np.interp(found.crossover, w, phase)
        assert at_crossover == pytest.approx(-180 + np.degrees(found.phase), abs=0.5)
    chart = figures.bode(s, [K])
    w, gain = chart.axes[0].lines[0].get_data()
    np.testing.assert_allclose(10 ** (gain / 20), np.abs(loop_response(s, [K], w)))
    assert f"{np.degrees(margins(s, [K]).phase):.1f} deg" in chart.get_suptitle()
    chart = figures.locus(s, [K])
    dots = chart.axes[0].lines[3].get_data()
    np.testing.assert_allclose(np.sort(dots[0]), np.sort(linalg.eigvals(closed_loop(s, [K]).A).real))
    chart = figures.step(s, [K], 0)
    assert chart.axes[0].lines[0].get_ydata()[-1] == pytest.approx(1 / (K[0] - control_gains.G), rel=1e-2)


def balancing(law, duration=1.0, **words):
    return Scene(
        duration=duration,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        keys=[{"joint": "slide", "times": [0], "values": [0]}],
        initial={"position": {"hinge": 1e-3}},
        controller={"law": law, "period": 0.01, **words},
    )


def test_the_loop_of_a_law_is_the_one_it_was_designed_for():
    words = {"goal": {"hinge": 0.0}}
    plan = make_plan(balancing("lqr", **words))
    found, K, *_ = loop_of(plan, "lqr", words)
    p = plan.problem
    tracked = np.array([True, False])
    law = LQR(p.model, tracked, p.state0.q, p.clip, 0.01, 1.0, ~(tracked | True), **words)
    np.testing.assert_allclose(K, law.solution.K[0], rtol=1e-6, atol=1e-6)
    np.testing.assert_allclose(found.A, law.solution.A[0], atol=1e-12)
    np.testing.assert_allclose(found.B, law.solution.B[0], atol=1e-12)
    assert found.inputs == ("slide",)


def test_gains_of_a_law_are_its_own_whatever_the_scene_keys():
    """PD on two of an arm's joints, the others keyed: kd as it is, kp less what the weight gives."""
    keys = [
        {"joint": j, "times": [0, 1], "values": [0.2, 0.9], "curve": "clamped"} for j in ("waist", "elbow")
    ]
    scene = Scene(
        duration=1.0,
        models=[{"file": "arm6"}],
        roles={"tracked": ["elbow", "shoulder"]},
        actuators={"*": "off"},
        keys=[*keys, {"joint": "shoulder", "times": [0], "values": [0.3]}],
        physics={"friction": False, "contacts": "none"},
        controller={"law": "pd", "period": 0.002},
    )
    words = {"kp": {"shoulder": 300.0, "elbow": 200.0}, "kd": {"shoulder": 30.0, "elbow": 20.0}}
    plan = make_plan(scene)
    found, K, *_ = loop_of(plan, "pd", words, t=0.4)
    assert found.states[:2] == ("shoulder", "elbow")
    n = len(found.states) // 2
    np.testing.assert_allclose(K[:2, n : n + 2], np.diag([30.0, 20.0]), atol=1e-5)
    (q, v, a), nominal = plan.problem.clip.evaluate(0.4), Nominal(plan.problem.model)
    tracked, keyed = np.isin(np.arange(6), [1, 2]), np.arange(6) == 0
    here = linearise(
        plan.problem.model, q, v, nominal.inverse(q, v, a), keyed=keyed, a_keyed=a, inputs=tracked
    )
    np.testing.assert_allclose(found.A, held(here, 0.002).A, atol=1e-12)
    for i, dof in enumerate((1, 2)):
        unit = 1e-5 * np.eye(6)[dof]
        slope = (nominal.weight(q + unit) - nominal.weight(q - unit))[[1, 2]] / 2e-5
        expected = np.diag([300.0, 200.0])[:, i] - slope
        np.testing.assert_allclose(K[:, i], expected, rtol=1e-5, atol=1e-4)


def test_the_delay_that_a_loop_stands_is_the_one_that_a_scene_stands():
    words = {"goal": {"hinge": 0.0}, "position": 10.0}
    found, K, *_ = loop_of(make_plan(balancing("lqr", **words)), "lqr", words)
    ticks = int(margins(found, K).delay / 0.01)
    assert 1 <= ticks <= 20
    stood, lost = (run(balancing("lqr", duration=8.0, delay=0.01 * d, **words)) for d in (ticks, ticks + 2))
    assert np.abs(stood.q[-1]).max() < 1e-3
    assert np.abs(lost.q).max() > 0.1


def test_both_engines_make_the_same_loop_where_nothing_touches():
    words = {"goal": {"hinge": 0.0}}
    scene = balancing("lqr", **words)
    exact, K, says, _ = loop_of(make_plan(scene), "lqr", words)
    assert "about the keys at t = 0 s, by exact derivatives; joint limits left out" in says
    still = {"initial": scene.initial.model_copy(update={"position": {"hinge": 0.0}})}
    other = scene.model_copy(update={"solver": scene.solver.model_copy(update={"engine": "contact"})} | still)
    theirs, same, says, _ = loop_of(make_plan(other), "lqr", words)
    assert "differences of the contact engine; nothing touches" in says
    np.testing.assert_allclose(theirs.A, exact.A, atol=1e-7)
    np.testing.assert_allclose(theirs.B, exact.B, atol=1e-7)
    np.testing.assert_allclose(same, K, rtol=1e-5, atol=1e-5)


def test_both_engines_make_the_same_loop_of_an_arm_that_holds_its_weight():
    """Its forces count: inertia changes with the pose, and with it what they do."""
    keys = [{"joint": j, "times": [0], "values": [x]} for j, x in (("shoulder", 0.3), ("elbow", 1.1))]

    def loop(engine):
        scene = Scene(
            duration=0.1,
            models=[{"file": "planar_2r"}],
            roles={"tracked": ["shoulder", "elbow"]},
            actuators={"*": "off"},
            keys=keys,
            physics={"limits": False},
            controller={"law": "computed-torque", "period": 0.01},
            solver={"engine": engine},
        )
        return loop_of(make_plan(scene), "computed-torque", {})

    exact, theirs = loop("smooth"), loop("contact")
    assert "exact" in exact.says
    assert "differences" in theirs.says
    np.testing.assert_allclose(theirs.system.A, exact.system.A, atol=1e-6)
    np.testing.assert_allclose(theirs.system.B, exact.system.B, atol=1e-6)
    np.testing.assert_allclose(theirs.K, exact.K, rtol=1e-4, atol=1e-3)


PRESS = """<mujoco><option timestep="1e-4"/><worldbody><geom type="plane" size="1 1 .1"/>
  <body name="foot" pos="0 0 .1"><joint name="z" type="slide" axis="0 0 1" damping="30"/>
  <geom type="sphere" size=".1" mass="1" solref="0.05 1"/></body></worldbody></mujoco>"""


def test_a_loop_with_contact_is_the_motion_that_the_contact_engine_makes(tmp_path):
    """A foot pressed on the floor: one period of a small deviation, simulated finely, and as predicted."""
    (tmp_path / "press.xml").write_text(PRESS)
    words, period = {"kp": 200.0, "kd": 5.0}, 0.01
    scene = Scene(
        duration=3.0,
        models=[{"file": str(tmp_path / "press.xml")}],
        roles={"tracked": ["z"]},
        keys=[{"joint": "z", "times": [0], "values": [-0.05]}],
        controller={"law": "pd", "period": period, **words},
    )
    plan = make_plan(scene)
    found, K, says, _ = loop_of(plan, "pd", words | {"friction": 0.01}, t=3.0)
    assert "touching: foot and world; left out of the loop: friction" in says
    predicted = closed_loop(found, K).A
    model, data = plan.problem.model, mujoco.MjData(plan.problem.model)
    model.opt.timestep, model.opt.integrator = 1e-4, mujoco.mjtIntegrator.mjINT_RK4
    at = run(scene)
    law = make_law("pd", plan.problem, words, period)

    def after(dq, dv):
        q, v = at.q[-1] + dq, at.v[-1] + dv
        tau, _ = law(0.0, q, v, Target(np.array([-0.05]), np.zeros(1), np.zeros(1)), None)
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], data.qfrc_applied[:] = q, v, tau
        mujoco.mj_step(model, data, 100)
        return np.concatenate([data.qpos, data.qvel])

    eps = 1e-5
    for column, unit in enumerate(eps * np.eye(2)):
        rate = (after(*unit) - after(*-unit)) / (2 * eps)
        np.testing.assert_allclose(predicted[:, column], rate, rtol=0.02, atol=1e-3)
    free = linearise(model, at.q[-1]).A
    assert abs(predicted[1, 0]) > 3 * abs(closed_loop(held(_like(found, free), period), K).A[1, 0])


def _like(system, A):
    return LinearSystem(A, np.array([[0.0], [1.0]]), system.states, system.inputs)


def test_what_positions_show_is_observed():
    """A pole on a cart: its angle shows all but the cart's place, which no force of the pole tells."""
    A = linearise(load_model("cart_pole"), np.zeros(2))
    both, angle = np.eye(4)[:2], np.eye(4)[1:2]
    assert observability(A, both)
    assert detectability(A, both)
    assert not observability(A, angle)
    verdict = detectability(A, angle)
    assert not verdict
    assert "not detectable: nothing measured shows slide (0 rad/s)" in verdict.says
    damped = LinearSystem(np.diag([-1.0, -2.0]), np.eye(2), ("a", "b"), ("a", "b"))
    assert not observability(damped, np.eye(2)[:1])
    assert "what nothing shows dies out" in detectability(damped, np.eye(2)[:1]).says


def test_the_command_says_what_can_be_steered_and_seen(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "press.xml").write_text(PRESS)
    Path("press.toml").write_text(
        """duration = 1.0
[[models]]
file = "press.xml"
[roles]
tracked = ["z"]
[[keys]]
joint = "z"
times = [0]
values = [-0.05]
[controller]
law = "pd"
period = 0.01
observer = "filter"
"""
    )
    cli.gains(Path("press.toml"), at=0.5)
    said = capsys.readouterr().out
    for words in (
        "about the run at t = 0.5 s",
        "touching: foot and world",
        "controllable by z",
        "stabilisable",
    ):
        assert words in said
    assert "observable" in said
    assert "detectable" in said
    assert {p.name for p in Path("out").iterdir()} == {f"press.{x}.png" for x in ("bode", "locus", "step")}
    with pytest.raises(PantographError, match="outside the scene, which lasts 1 s"):
        cli.gains(Path("press.toml"), at=7.0)


@pytest.mark.parametrize("kind", ["ball", "free"])
def test_force_limits_of_motors_on_one_joint_are_of_their_axes(kind, recwarn):
    motors = "".join(
        f'<motor joint="j" gear="{gear}" {limit}/>'
        for gear, limit in (
            ("2 0 0 0 0 0", 'ctrllimited="true" ctrlrange="-.1 .1"'),
            ("0 -1 0 0 0 0", 'ctrllimited="true" ctrlrange="-.2 .4"'),
            ("0 1 0 0 0 0", 'forcelimited="true" forcerange="-1 1"'),
            ("0 0 1 0 0 0", ""),
        )
    )
    m = mujoco.MjModel.from_xml_string(
        f"""<mujoco><worldbody><body><joint name="j" type="{kind}"/><geom size=".1"/></body></worldbody>
        <actuator>{motors}<motor jointinparent="j" gear="1 0 0 0 0 0" forcerange="-9 9"/>
        <motor joint="j" gear="1 1 0 0 0 0" forcerange="-9 9"/></actuator></mujoco>"""
    )
    low, high = force_limits(m)
    free = [np.inf] * (m.nv - 2)
    np.testing.assert_allclose(high, [0.2, 1.2, *free])
    np.testing.assert_allclose(low, [-0.2, -1.4, *np.negative(free)])
    assert not len(recwarn)
