"""Nonlinear MPC against IPOPT on the same problem, against LQR where both agree, and in closed loop."""

import numpy as np
import pytest
from hypothesis import given, settings
from oracles.control_ipopt import formulate
from pantograph.controllers.basin import advance
from pantograph.controllers.predictive.nonlinear import NMPC, _boxed
from pantograph.models import load_model
from pantograph.sim import Scene, SceneError, make_plan, run
from pantograph.sim.clip import Clip
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from strategies import seeds

STILL = Target(np.zeros(2), np.zeros(2), np.zeros(2))


def cart(limit=40.0, **words):
    model = load_model("cart_pole")
    model.actuator_ctrlrange[0] = [-limit, limit]
    clip = Clip(model, {"slide": keyed([0], [0.0])}, np.zeros(2))
    return NMPC(model, np.array([True, False]), np.zeros(2), clip, 0.02, np.zeros(2, dtype=bool), **words)


def arm(**words):
    model = load_model("planar_2r")
    clip = Clip(model, {n: keyed([0, 1], [0.0, 0.6]) for n in ("shoulder", "elbow")}, model.qpos0)
    return NMPC(model, np.ones(2, dtype=bool), model.qpos0, clip, 0.02, np.zeros(2, dtype=bool), **words)


CART, ARM = cart(8.0, horizon=0.6, step=0.03), arm(horizon=0.4)
PEERS = {law: formulate(law) for law in (CART, ARM)}


@pytest.mark.parametrize("law", [CART, ARM])
@given(seed=seeds)
@settings(max_examples=8)
def test_the_plan_is_the_optimum_that_ipopt_finds(law, seed):
    rng, nv = np.random.default_rng(seed), 2
    ref = law.horizon(0.107)
    x0 = ref.x[0] + rng.uniform(-0.4, 0.4, 2 * nv)
    u = np.clip(ref.u, law.low, law.high)
    x, u, cost = law.improve(law.rollout(x0, u, ref), u, ref, 200)
    theirs_u, theirs = PEERS[law](x0, ref, x, u)
    assert cost <= theirs * (1 + 1e-6) + 1e-9
    np.testing.assert_allclose(u, theirs_u, atol=2e-3 * (law.high - law.low).max())
    assert (u >= law.low).all()
    assert (u <= law.high).all()


@given(seeds)
@settings(max_examples=10)
def test_near_the_goal_it_is_lqr(seed):
    law, rng = cart(), np.random.default_rng(seed)
    x = 1e-3 * rng.normal(size=4)
    tau, _ = law(0.0, x[:2], x[2:], STILL, law.start())
    A, B = (m[0] for m in law.derivatives(np.zeros((1, 4)), np.zeros((1, 1)), np.array([law.step])))
    P = law.final
    K = np.linalg.solve(np.diag(law.R) + B.T @ P @ B, B.T @ P @ A)
    assert tau[0] == pytest.approx(float(-K[0] @ x), rel=1e-3, abs=1e-9)
    assert tau[1] == 0.0


@given(seeds)
@settings(max_examples=10)
def test_derivatives_of_a_step_are_its_differences(seed):
    rng, law, eps = np.random.default_rng(seed), ARM, 1e-6
    x, u = rng.normal(size=4), 10 * rng.normal(size=2)
    A, B = law.derivatives(x[None], u[None], np.array([0.02]))
    for matrix, base, f in (
        (A[0], x, lambda z: law._advance(z, u, 0.02)),
        (B[0], u, lambda z: law._advance(x, z, 0.02)),
    ):
        for j in range(len(base)):
            step = eps * np.eye(len(base))[j]
            np.testing.assert_allclose(matrix[:, j], (f(base + step) - f(base - step)) / (2 * eps), atol=1e-6)


@given(seeds)
def test_bounded_minimum_meets_the_conditions_of_optimality(seed):
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(4, 4))
    H, g, G = M @ M.T + 0.1 * np.eye(4), 3 * rng.normal(size=4), rng.normal(size=(4, 3))
    low, high = -rng.uniform(0, 1, 4), rng.uniform(0, 1, 4)
    d, K = _boxed(H, g, G, low, high)
    slope = g + H @ d
    assert (slope[d >= high - 1e-12] <= 1e-9).all()
    assert (slope[d <= low + 1e-12] >= -1e-9).all()
    inside = (d > low + 1e-9) & (d < high - 1e-9)
    np.testing.assert_allclose(slope[inside], 0, atol=1e-8)
    np.testing.assert_allclose(K[~inside], 0, atol=0)


def test_one_iteration_a_sample_swings_a_cart_pole_up():
    law = cart(horizon=1.0, step=0.04, goal={"hinge": 0.0})
    q, v, memory = np.array([0.3, np.pi - 0.1]), np.zeros(2), law.start()
    for k in range(200):
        tau, memory = law(0.02 * k, q, v, STILL, memory)
        assert abs(tau[0]) <= 40.0
        q, v = (x[0] for x in advance(law.nominal, q[None], v[None], tau[None], 0.005, 4))
        assert abs(q[0]) < 1.1
    assert np.abs(q).max() < 0.02


def test_it_follows_keys_in_a_scene():
    scene = Scene(
        duration=1.0,
        models=[{"file": "planar_2r"}],
        roles={"tracked": ["shoulder", "elbow"]},
        actuators={"*": "off"},
        keys=[{"joint": "shoulder", "times": [0, 1], "values": [0, 0.8], "curve": "clamped"}],
        controller={"law": "nmpc", "period": 0.01, "horizon": 0.3},
    )
    plan = make_plan(scene)
    r = run(plan)
    assert np.abs(r.q - plan.problem.clip.evaluate(r.t).q).max() < 2e-3


def test_mistakes_are_told():
    with pytest.raises(SceneError, match="hinges and slides"):
        make_plan(
            Scene(
                duration=0.1,
                models=[{"file": "quadruped"}],
                roles={"tracked": ["*"]},
                controller={"law": "nmpc"},
            )
        )
