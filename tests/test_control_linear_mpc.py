"""Linear MPC is LQR where nothing limits it, and else the optimum of an independent solver."""

from functools import cache

import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st
from oracles import control_qp
from pantograph.controllers.basin import advance
from pantograph.controllers.design import dlqr
from pantograph.controllers.drives import Drives
from pantograph.controllers.lqr import LQR
from pantograph.controllers.predictive.linear import MPC, _moves
from pantograph.controllers.predictive.quadratic import LeastChange
from pantograph.models import load_model
from pantograph.sim import PantographError, Scene, make_plan, run
from pantograph.sim.clip import Clip
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from scipy import optimize
from strategies import seeds


def cart(kind=MPC, period=0.02, limit=8.0, reach=1.0, **words):
    model = load_model("cart_pole")
    model.actuator_ctrlrange[0] = [-limit, limit]
    model.jnt_range[0] = [-reach, reach]
    clip = Clip(model, {"slide": keyed([0], [0.0])}, np.zeros(2))
    none = np.zeros(2, dtype=bool)
    return kind(model, np.array([True, False]), np.zeros(2), clip, period, 2.0, none, **words)


def arm(kind=MPC, period=0.02, limit=np.inf, **words):
    """The arm along moving keys, with ideal drives or motors of so much."""
    model = load_model("planar_2r")
    model.jnt_limited[:] = False
    model.actuator_gainprm[:] = 0.0
    if np.isfinite(limit):
        model.actuator_biasprm[:], model.actuator_biastype[:], model.actuator_gainprm[:, 0] = 0.0, 0, 1.0
        model.actuator_ctrllimited[:], model.actuator_ctrlrange[:] = True, [-limit, limit]
        model.actuator_forcelimited[:], model.actuator_gear[:, 0] = False, 1.0
    tracks = {"shoulder": keyed([0, 1], [0.0, 1.2]), "elbow": keyed([0, 1], [0.3, -0.4])}
    clip = Clip(model, tracks, model.qpos0)
    return kind(model, np.ones(2, dtype=bool), model.qpos0, clip, period, 1.0, np.zeros(2, bool), **words)


def target(law, t):
    return Target(*law.preview.clip.evaluate(t))


@pytest.mark.parametrize(("horizon", "fine"), [(0.02, 1), (0.3, 4), (2.0, 8)])
@pytest.mark.parametrize("make", [cart, arm])
def test_without_limits_in_the_way_it_is_lqr(make, horizon, fine):
    rng, free = np.random.default_rng(0), {"limit": 1e6, "reach": 1e6} if make is cart else {}
    mpc, lqr = make(horizon=horizon, fine=fine, **free), make(LQR, **free)
    memory = mpc.start()
    for t in (0.0, 0.4, 1.3, 0.98):
        q, v = rng.normal(size=2), 3 * rng.normal(size=2)
        tau, memory = mpc(t, q, v, target(lqr, t), memory)
        expected, _ = lqr(t, q, v, target(lqr, t), None)
        np.testing.assert_allclose(tau, expected, rtol=1e-9, atol=1e-9)


def test_its_gains_on_keys_that_rest_are_those_of_the_algebraic_equation():
    law = cart(limit=1e6, reach=1e6)
    A, B, K, _, _ = law.lqr.solution
    for i, unit in enumerate(1e-3 * np.eye(4)):
        tau, _ = law(0.0, unit[:2], unit[2:], Target(*np.zeros((3, 2))), law.start())
        expected = dlqr(A[0], B[0], law.lqr.Q, law.lqr.R).K[0, i]
        assert -tau[0] / 1e-3 == pytest.approx(expected, rel=1e-9)
    assert K.shape == (1, 1, 4)


CASES = [
    (cart, {}),
    (cart, {"limit": 20.0, "slew": 150.0, "reach": 0.3}),
    (cart, {"speed": {"slide": 0.5}, "reach": 0.2, "limit": 1e4}),
    (arm, {"limit": 12.0}),
    (arm, {"limit": 15.0, "slew": 400.0, "speed": 1.0}),
]


@cache
def tight(case):
    make, words = CASES[case]
    return make(horizon=0.3, fine=15, soft=300.0, **words)


@pytest.mark.parametrize("case", range(len(CASES)))
@given(seed=seeds, first=st.booleans())
@settings(max_examples=8, phases=(Phase.generate,))
def test_with_limits_it_is_the_optimum_of_a_solver_of_its_own(case, seed, first):
    """One force a tick over the whole horizon, so that both mean the same problem."""
    law, rng, t = tight(case), np.random.default_rng(seed), 0.2
    q, v = 0.3 * rng.normal(size=2), 1.5 * rng.normal(size=2)
    aim = target(law.lqr, t)
    q = q + aim.q
    low, high = (side[0] for side in (law.low, law.high))
    before = None if first else rng.uniform(max(low, -5.0), min(high, 5.0), len(law.inputs))
    tau, memory = law(t, q, v, aim, law.start()._replace(u=before))
    A, B, _, P, u_d = law.lqr.solution
    i = np.minimum(10 + np.arange(16), len(A) - 1)
    ends = 10 + 1 + np.arange(15)
    wanted = [np.concatenate(law.lqr.preview.clip.evaluate(k * 0.02)[:2]) for k in ends]
    states = np.array([law.x_low - wanted, law.x_high - wanted])
    u, _ = control_qp.solve(
        A[i[:15]], B[i[:15]], law.lqr.Q, law.lqr.R, P[i[15]], np.concatenate([q - aim.q, v - aim.v]),
        needed=u_d[i[:15]], force=np.array([law.low, law.high]), slew=law.slew, before=before, states=states,
        soft=law.soft,
    )  # fmt: skip
    scale = min(high, np.abs(u).max())
    np.testing.assert_allclose(tau[law.inputs], u[0], atol=1e-5 * scale)
    assert (np.abs(memory.u) <= law.high * (1 + 1e-9)).all()


def by_nonnegative_least_squares(M, low, high, give):
    """The same z from its dual (C. Lawson, R. Hanson, Solving Least Squares Problems, 1974, ch. 23)."""
    y = np.hstack([M, np.diag(np.sqrt(give))])
    G, h = np.vstack([y, -y]), np.concatenate([low, -high])
    u, _ = optimize.nnls(np.vstack([G.T, h]), np.append(np.zeros(y.shape[1]), 1.0), maxiter=1000)
    rest = np.append(G.T @ u, h @ u - 1.0)
    return -rest[: M.shape[1]] / rest[-1]


@given(seeds, st.integers(1, 12), st.integers(1, 30))
def test_the_least_change_is_that_of_lawson_and_hanson(seed, n, r):
    """Twins of rows, soft rows and warm starts with wrong guesses included."""
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(r, n))
    M[r // 2 :] = M[: r - r // 2]
    inside = M @ rng.normal(size=n)
    low, high = inside - rng.uniform(0.01, 0.5, r), inside + rng.uniform(0.01, 0.5, r)
    low, high = np.where(rng.uniform(size=(2, r)) < 0.2, [[-np.inf], [np.inf]], [low, high])
    give = np.where(rng.uniform(size=r) < 0.3, rng.uniform(0.1, 1, r), 0.0)
    least_change = LeastChange()
    z, held, _ = least_change(M, low, high, give)
    expected = by_nonnegative_least_squares(M, np.maximum(low, -1e3), np.minimum(high, 1e3), give)
    np.testing.assert_allclose(z, expected, atol=1e-6 * (1 + np.abs(z).max()))
    guess = rng.permutation(r)[: rng.integers(0, r + 1)]
    warm, _, _ = least_change(M, low, high, give, guess)
    np.testing.assert_allclose(warm, z, atol=1e-7 * (1 + np.abs(z).max()))
    again, same, programs = least_change(M, low, high, give, held)
    assert programs == (1 if len(held) else 0)
    assert set(same) <= set(held)
    np.testing.assert_allclose(again, z, atol=1e-9 * (1 + np.abs(z).max()))


def test_hard_limits_that_contradict_each_other_are_told_and_soft_ones_give():
    M, low, high = np.array([[1.0], [1.0]]), np.array([1.0, -2.0]), np.array([2.0, -1.0])
    with pytest.raises(PantographError, match="contradict"):
        LeastChange()(M, low, high, np.zeros(2))
    z, held, _ = LeastChange()(M, low, high, np.array([0.01, 0.02]))
    # z^2 + (1 - z)^2 / 0.01 + (1 + z)^2 / 0.02 is least where z + 100 (z - 1) + 50 (z + 1) = 0
    assert z[0] == pytest.approx(50 / 151, rel=1e-9)
    assert set(held) == {0, 1}


@given(st.floats(1e-3, 3.0), st.sampled_from([1e-3, 0.01, 0.02]), st.integers(1, 30))
def test_moves_fill_the_horizon(horizon, period, fine):
    powers = _moves(horizon, period, fine)
    lengths = [2**p for p in powers]
    ticks = max(1, round(horizon / period))
    assert sum(lengths) >= ticks > sum(lengths[:-1])
    assert powers == sorted(powers)
    assert powers[:fine] == [0] * min(fine, ticks)


def test_moves_of_many_ticks_are_those_ticks():
    """Held changes of 4 ticks: where they lead and what they cost, tick by tick; past the end of the keys."""
    law = arm(horizon=2.0)
    A, B, K, P, _ = law.lqr.solution
    for i in (0, 7, len(K) - 3):
        x, c, cost = np.array([0.1, -0.2, 0.3, 0.4]), np.array([1.5, -0.7]), 0.0
        y = x
        for j in np.minimum(i + np.arange(4), len(K) - 1):
            y = A[j] @ y + B[j] @ (c - K[j] @ y)
            cost += c @ (law.lqr.R + B[j].T @ P[j + 1] @ B[j]) @ c
        np.testing.assert_allclose(law.ahead.step[2][i] @ x + law.ahead.push[2][i] @ c, y, atol=1e-12)
        assert c @ law.ahead.weight[2][i] @ c == pytest.approx(cost, rel=1e-9)


def closed_loop(law, q, v, seconds, noise=0.0):
    """States (n, 4) and forces (n,) of the cart-pole under a law, by the smooth engine, forces cut."""
    rng, memory, xs, us = np.random.default_rng(0), law.start(), [], []
    model = law.model
    low, high = model.actuator_ctrlrange[0]
    for k in range(round(seconds / 0.02)):
        tau, memory = law(0.02 * k, q, v, Target(*np.zeros((3, 2))), memory)
        us.append(tau[0])
        pushed = np.clip(tau, [low, 0], [high, 0]) + noise * rng.normal(size=2)
        q, v = (x[0] for x in advance(law.nominal, q[None], v[None], pushed[None], 0.005, 4))
        xs.append(np.concatenate([q, v]))
    return np.array(xs), np.array(us)


def test_it_keeps_limits_where_lqr_does_not():
    """A cart that must turn before the rail's end, with a pole to balance."""
    q, v = np.array([0.35, 0.0]), np.array([0.55, 0.0])
    words = {"limit": 20.0, "reach": 0.5}
    mpc, lqr = cart(horizon=1.0, **words), cart(LQR, **words)
    mpc.nominal = lqr.nominal = mpc.lqr.nominal
    ends = {}
    for name, law in (("mpc", mpc), ("lqr", lqr)):
        xs, us = closed_loop(law, q, v, 6.0)
        ends[name] = xs[:, 0].max()
        assert np.abs(xs[-1]).max() < 1e-2
        if name == "mpc":
            assert np.abs(us).max() <= 20.0 * (1 + 1e-9)
    assert ends["lqr"] > 0.51
    assert ends["mpc"] < 0.505


def test_forces_change_no_quicker_than_they_may():
    law = cart(horizon=1.0, limit=15.0, slew=120.0, fine=5)
    law.nominal = law.lqr.nominal
    xs, us = closed_loop(law, np.array([0.2, 0.1]), np.zeros(2), 4.0, noise=0.05)
    assert np.abs(xs[-1]).max() < 0.3
    assert np.abs(np.diff(us)).max() <= 120.0 * 0.02 * (1 + 1e-9)
    assert np.abs(np.diff(us)).max() > 120.0 * 0.02 * (1 - 1e-9)
    assert np.abs(us).max() <= 15.0 * (1 + 1e-9)


@given(seeds, st.sampled_from([cart, arm]))
@settings(max_examples=12)
def test_a_force_leaves_its_slew_only_along_the_limit_of_its_motor(seed, make):
    """Motors that lose their force at low speeds, faster than it may change; kicks every few ticks."""
    rng = np.random.default_rng(seed)
    limit, top, fine = np.exp(rng.uniform(1, 4)), np.exp(rng.uniform(-1.5, 1.5)), int(rng.integers(1, 12))
    slew = limit * np.exp(rng.uniform(-1, 3))
    words = {"reach": 0.6, "goal": {"hinge": 0.0}} if make is cart else {}
    law = make(limit=limit, slew=slew, horizon=rng.choice([0.1, 0.5]), fine=fine, top_speed=top, **words)
    drives, moved, memory = Drives(law.model, law.lqr.tracked, None, top), law.inputs, law.start()
    q, v, before = target(law.lqr, 0.0).q + 0.2 * rng.normal(size=2), rng.normal(size=2), None
    for k in range(40):
        v = v + rng.normal(size=2) * (rng.uniform() < 0.2)
        tau, memory = law(0.02 * k, q, v, target(law.lqr, 0.02 * k), memory)
        (low, high), u, eps = (x[moved] for x in drives.at(v)), tau[moved], 1e-9 * limit
        assert ((u >= low - eps) & (u <= high + eps)).all()
        if before is not None:
            change, most = u - before, slew * 0.02 + eps
            assert ((change >= -most) | (np.abs(u - high) < eps)).all()
            assert ((change <= most) | (np.abs(u - low) < eps)).all()
        before = u
        q, v = (x[0] for x in advance(law.lqr.nominal, q[None], v[None], tau[None], 0.005, 4))
        if np.abs(v).max() > 50.0:  # a machine that its motor cannot hold
            break


def balancing(**goal):
    return Scene(
        duration=4.0,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        keys=[{"joint": "slide", "times": [0], "values": [0]}],
        initial={"position": {"hinge": 0.45, "slide": 0.3}},
        controller={"law": "mpc", "period": 0.01, "horizon": 1.0, "goal": goal},
    )


def test_in_a_scene():
    recording = run(balancing(hinge=0.0))
    assert np.abs(recording.q[-1]).max() < 1e-2
    with pytest.raises(PantographError, match="no joint without keys 'slide'"):
        make_plan(balancing(slide=1.0))
