"""Nonlinear MPC against IPOPT on the same problem, against LQR where both agree, and in closed loop."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from oracles.control_ipopt import formulate
from pantograph.controllers.basin import advance
from pantograph.controllers.predictive.bounded import bounded_minimum
from pantograph.controllers.predictive.coordinates import Coordinates
from pantograph.controllers.predictive.nonlinear import NMPC
from pantograph.controllers.predictive.shooting import Horizon
from pantograph.models import load_model
from pantograph.sim import Scene, SceneError, make_plan, run
from pantograph.sim.clip import Clip
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from pantograph.sim.dynamics.smooth import compile_model
from strategies import seeds

STILL = Target(np.zeros(2), np.zeros(2), np.zeros(2))


def cart(limit=40.0, top=None, **words):
    model = load_model("cart_pole")
    model.actuator_ctrlrange[0] = [-limit, limit]
    clip = Clip(model, {"slide": keyed([0], [0.0])}, np.zeros(2))
    return NMPC(
        model, np.array([True, False]), np.zeros(2), clip, 0.02, np.zeros(2, dtype=bool), top, **words
    )


def arm(top=None, **words):
    model = load_model("planar_2r")
    clip = Clip(model, {n: keyed([0, 1], [0.0, 0.6]) for n in ("shoulder", "elbow")}, model.qpos0)
    return NMPC(model, np.ones(2, dtype=bool), model.qpos0, clip, 0.02, np.zeros(2, dtype=bool), top, **words)


CART, ARM = cart(8.0, horizon=0.6, step=0.03), arm(horizon=0.4)
SLOW = (cart(8.0, 0.6, horizon=0.6, step=0.03), arm({"shoulder": 1.5, "elbow": 0.7}, horizon=0.4))
PEERS = {law: formulate(law) for law in (CART, ARM, *SLOW)}


@pytest.mark.parametrize("law", PEERS)
@given(seed=seeds)
@settings(max_examples=6)
def test_the_plan_is_the_optimum_that_ipopt_finds(law, seed):
    rng, nv = np.random.default_rng(seed), 2
    ref = law.horizon(0.107)
    x0 = ref.x[0] + rng.uniform(-0.4, 0.4, 2 * nv)
    shooting = law.shooting
    x, u, _, cost = shooting.improve(shooting.begin(x0, ref.u, ref), ref, 200)
    theirs_u, theirs = PEERS[law](x0, ref, x, u)
    # limits bend at rest and at top speed, where steps stall; without their slopes one is off by 300 %
    assert cost <= theirs * (1 + (0.1 if shooting.slow else 1e-6)) + 1e-9
    v, c = x[:-1, nv + law.inputs], shooting.weights
    left = np.clip(1.0 - np.abs(v) / c.top, 0.0, 1.0)
    low, high = np.where(v < 0, left, 1.0) * c.low, np.where(v > 0, left, 1.0) * c.high
    if not shooting.slow:
        np.testing.assert_allclose(u, theirs_u, atol=2e-3 * (c.high - c.low).max())
    assert (u >= low - 1e-9).all()
    assert (u <= high + 1e-9).all()


@given(seeds)
@settings(max_examples=10)
def test_near_the_goal_it_is_lqr(seed):
    law, rng = cart(), np.random.default_rng(seed)
    x = 1e-3 * rng.normal(size=4)
    tau, _ = law(0.0, x[:2], x[2:], STILL, law.start())
    step = Horizon(np.zeros((2, 4)), np.zeros((1, 1)), np.array([law.step]), np.zeros((1, 3, 0)))
    A, B = (m[0] for m in law.shooting.derivatives(np.zeros((1, 4)), np.zeros((1, 1)), step))
    P = law.regulator.P
    K = np.linalg.solve(np.diag(law.R) + B.T @ P @ B, B.T @ P @ A)
    assert tau[0] == pytest.approx(float(-K[0] @ x), rel=1e-3, abs=1e-9)
    assert tau[1] == 0.0


@given(seeds)
@settings(max_examples=10)
def test_derivatives_of_a_step_are_its_differences(seed):
    rng, law, eps = np.random.default_rng(seed), ARM.shooting, 1e-6
    x, u, w = rng.normal(size=4), 10 * rng.normal(size=2), np.zeros((3, 0))
    A, B = law.derivatives(x[None], u[None], Horizon(x[None], u[None], np.array([0.02]), w[None]))
    for matrix, base, f in (
        (A[0], x, lambda z: law.advance(z, u, 0.02, w)),
        (B[0], u, lambda z: law.advance(x, z, 0.02, w)),
    ):
        for j in range(len(base)):
            step = eps * np.eye(len(base))[j]
            np.testing.assert_allclose(matrix[:, j], (f(base + step) - f(base - step)) / (2 * eps), atol=1e-6)


@given(seeds)
def test_the_bounded_minimum_moves_with_its_slope_and_its_bounds(seed):
    """Differences of d by what moves g and the bounds."""
    rng, eps = np.random.default_rng(seed), 1e-6
    m = int(rng.integers(1, 5))
    M = rng.normal(size=(m, m))
    H, g, G = M @ M.T + 0.5 * np.eye(m), 3 * rng.normal(size=m), rng.normal(size=(m, 3))
    low, high = -rng.uniform(0.1, 1, m), rng.uniform(0.1, 1, m)
    along = rng.normal(size=(m, 3)), rng.normal(size=(m, 3))
    d, K = bounded_minimum(H, g, G, low, high, along)
    slope = np.abs(g + H @ d)
    edge = np.minimum(d - low, high - d)
    if ((edge < 1e-4) & (slope < 1e-3) | (edge > 1e-12) & (edge < 1e-3)).any():
        return  # about to leave or to meet a bound
    for j in range(3):
        plus, minus = (
            bounded_minimum(H, g + s * G[:, j], G, low + s * along[0][:, j], high + s * along[1][:, j])[0]
            for s in (eps, -eps)
        )
        np.testing.assert_allclose(K[:, j], (plus - minus) / (2 * eps), atol=1e-5)


@given(seeds)
def test_bounded_minimum_meets_the_conditions_of_optimality(seed):
    rng = np.random.default_rng(seed)
    M = rng.normal(size=(4, 4))
    H, g, G = M @ M.T + 0.1 * np.eye(4), 3 * rng.normal(size=4), rng.normal(size=(4, 3))
    low, high = -rng.uniform(0, 1, 4), rng.uniform(0, 1, 4)
    d, K = bounded_minimum(H, g, G, low, high)
    slope = g + H @ d
    assert (slope[d >= high - 1e-12] <= 1e-9).all()
    assert (slope[d <= low + 1e-12] >= -1e-9).all()
    inside = (d > low + 1e-9) & (d < high - 1e-9)
    np.testing.assert_allclose(slope[inside], 0, atol=1e-8)
    np.testing.assert_allclose(K[~inside], 0, atol=0)


def test_one_iteration_a_sample_swings_a_cart_pole_up():
    law = cart(horizon=1.0, step=0.04, goal={"hinge": 0.0}, iterations=1)
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


def ball_and_free():
    """A keyed turntable with a slide, a ball joint and hinges on it, beside a free body."""
    joints = """<body name="table"><joint name="table" axis="0 0 1"/><geom size=".1" mass="1"/>
      <body pos=".2 0 0"><joint name="slide" type="slide" axis="1 0 .3"/><geom size=".05" mass=".5"/>
      <body pos="0 0 .2"><joint name="ball" type="ball"/><geom size=".05" pos=".1 0 .1" mass=".7"/>
      <body pos="0 .1 .2"><joint name="tip" axis="0 1 0"/><geom size=".04" pos="0 .1 0" mass=".3"/>
      </body></body></body></body>"""
    free = '<body pos="1 0 0"><freejoint name="free"/><geom size=".1 .2 .05" type="box" mass="1"/></body>'
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{joints}{free}</worldbody></mujoco>")


@given(seeds)
@settings(max_examples=20)
def test_steps_of_any_joints_beside_keyed_ones_are_the_engines_and_their_derivatives(seed):
    """Against the compiled rollout, and against differences on the manifold."""
    model, rng, h, eps = ball_and_free(), np.random.default_rng(seed), 1e-3, 1e-6
    held = model.dof_jntid == 0
    clip = Clip(model, {"table": keyed([0, 0.3, 1], [0, 1.0, -0.5], kind="natural")}, model.qpos0)
    law = NMPC(model, ~held, model.qpos0, clip, 0.01, held, step=h, horizon=3 * h)
    shooting, ref, full = law.shooting, law.horizon(0.4), model.qpos0.copy()
    mujoco.mj_integratePos(model, full, rng.normal(size=model.nv), 1.0)
    lay = shooting.smooth.layout
    x = np.concatenate([full[lay.q_free], rng.normal(size=lay.nv)])
    u = rng.normal(size=lay.nv)
    go, n, nq = Coordinates(lay), lay.nv, lay.nq

    def moved(x, d):
        return np.concatenate([go.plus(x[:nq], d[:n]), x[nq:] + d[n:]])

    def prescribed(t):
        at = clip.evaluate(t)
        return np.hstack([at.q[:, lay.q_keyed], at.v[:, lay.v_keyed], at.a[:, lay.v_keyed]])

    pushed = compile_model(law.nominal.model, keyed=held, forces=True)
    path = pushed.rollout(x[:nq], x[nq:], u[None], step=h, steps=1, w=prescribed, t0=0.4)
    mine = shooting.advance(x, u, h, ref.w[0])
    np.testing.assert_allclose(mine, np.concatenate([path.q[-1], path.v[-1]]), atol=1e-7)
    plan = shooting.begin(x, np.tile(u, (law.n, 1)), ref)
    for k in range(law.n):
        after = shooting.advance(plan.x[k], u, h, ref.w[k])
        np.testing.assert_allclose(plan.x[k + 1], after, atol=1e-7)
    A, B = shooting.derivatives(x[None], u[None], Horizon(ref.x[:2], ref.u[:1], ref.h[:1], ref.w[:1]))
    for j, unit in enumerate(eps * np.eye(2 * n)):
        plus, minus = (shooting.advance(moved(x, s * unit), u, h, ref.w[0]) for s in (1, -1))
        np.testing.assert_allclose(A[0][:, j], shooting.away(plus, minus) / (2 * eps), atol=2e-6)
    for j, unit in enumerate(eps * np.eye(n)):
        plus, minus = (shooting.advance(x, u + s * unit, h, ref.w[0]) for s in (1, -1))
        np.testing.assert_allclose(B[0][:, j], shooting.away(plus, minus) / (2 * eps), atol=1e-7)
    d = 0.3 * rng.normal(size=n)
    np.testing.assert_allclose(go.minus(go.plus(x[:nq], d), x[:nq]), d, atol=1e-12)
    np.testing.assert_allclose(full[lay.q_free], go.plus(x[:nq], np.zeros(n)), atol=1e-12)


BALL = """<mujoco><worldbody><body><joint name="arm" axis="0 1 0"/><geom size=".05" mass="1"/>
  <body pos=".4 0 0"><joint name="ball" type="ball" armature=".01"/>
  <geom size=".05" pos=".1 0 .05" mass=".5"/></body></body></worldbody></mujoco>"""


def test_a_ball_joint_on_a_keyed_arm_is_brought_home(tmp_path):
    """A ball on a link that is keyed to swing; ideal torques, off its place by 0.8 rad."""
    (tmp_path / "ball.xml").write_text(BALL)
    scene = Scene(
        duration=1.0,
        models=[{"file": str(tmp_path / "ball.xml")}],
        roles={"tracked": ["ball"]},
        keys=[
            {"joint": "arm", "times": [0, 0.5, 1], "values": [0, 0.8, 0], "curve": "natural"},
            {"joint": "ball", "times": [0], "values": [[1, 0, 0, 0]]},
        ],
        initial={"position": {"ball": [0.92, 0.28, 0.28, 0.0]}},
        controller={"law": "nmpc", "period": 0.02, "horizon": 0.3},
    )
    r = run(scene)
    assert r.status == "done"
    assert np.abs(r.q[-1, 1:] * np.sign(r.q[-1, 1]) - [1, 0, 0, 0]).max() < 5e-3


@given(seeds)
@settings(max_examples=10)
def test_a_plan_is_followed_as_its_steps_do_one_by_one(seed):
    """Machine code against single steps: the first one short, motors slow at speed, several at once."""
    rng, law = np.random.default_rng(seed), SLOW[seed % 2]
    shooting, ref = law.shooting, law.horizon(0.107)
    n, m = law.n, len(law.inputs)
    plan = shooting.begin(ref.x[0] + 0.3 * rng.normal(size=4), ref.u, ref)
    plan = plan._replace(K=5.0 * rng.normal(size=plan.K.shape))
    start, change = plan.x[0] + 0.1 * rng.normal(size=4), 4.0 * rng.normal(size=(3, n, m))
    states, forces = shooting.follow(start, plan, ref, change)
    costs = shooting.cost(states, forces, ref)
    for X, U, c, cost in zip(states, forces, change, costs, strict=True):
        assert cost == pytest.approx(float(shooting.cost(X, U, ref)))
        np.testing.assert_array_equal(X[0], start)
        for k in range(n):
            low, high = shooting.able(X[k])
            wanted = plan.u[k] + c[k] + plan.K[k] @ (X[k] - plan.x[k])
            np.testing.assert_allclose(U[k], np.clip(wanted, low, high), atol=1e-9)
            np.testing.assert_allclose(X[k + 1], shooting.advance(X[k], U[k], ref.h[k], ref.w[k]), atol=1e-9)


@given(seeds)
@settings(max_examples=6)
def test_a_plan_that_comes_true_goes_on_as_it_was(seed):
    """Within a step of its grid and across one."""
    law, rng = CART, np.random.default_rng(seed)
    x = 0.3 * rng.normal(size=4)
    _, memory = law(0.0, x[:2], x[2:], STILL, law.start())
    plan, shooting = memory.plan, law.shooting
    for t, passed in ((0.02, 0), (0.04, 1)):
        at = plan.x[passed]
        reached = shooting.advance(at, plan.u[passed], t - passed * law.step, np.zeros((3, 0)))
        goes_on = law.carried(reached, law.horizon(t), t, memory)
        kept = law.n - passed
        # the rest of a step after a part of it is another RK4 than the whole step
        np.testing.assert_allclose(goes_on.u[:kept], plan.u[passed:], atol=5e-3)


def test_steps_that_end_at_a_key_end_with_the_motion_before_it():
    model = ball_and_free()
    held = model.dof_jntid == 0
    clip = Clip(model, {"table": keyed([0, 0.3, 1], [0, 1.2, -0.2], kind="linear")}, model.qpos0)
    law = NMPC(model, ~held, model.qpos0, clip, 0.1, held, step=0.1, horizon=0.3)
    w = law.horizon(0.2).w  # (steps, places, position, speed and acceleration)
    np.testing.assert_allclose(w[0, :, 1], 4.0)
    np.testing.assert_allclose(w[1, :, 1], -2.0)
    np.testing.assert_allclose(w[0, 2, 0], 1.2)


def test_noise_does_not_drive_the_plan_off():
    """An unstable machine seen through a coarse encoder, one improvement a sample: its plan is carried on
    with its gains. Without these, the open-loop motion from each noisy state flies off."""
    law, rng = cart(horizon=1.0, goal={"hinge": 0.0}, iterations=1), np.random.default_rng(1)
    q, v, memory, costs = np.array([0.1, 0.1]), np.zeros(2), law.start(), []
    for k in range(150):
        seen = 3e-3 * rng.normal(size=2), 0.1 * rng.normal(size=2)
        x = np.concatenate([q + seen[0], v + seen[1]])
        carried = law.carried(x, law.horizon(0.02 * k), 0.02 * k, memory).cost
        tau, memory = law(0.02 * k, q + seen[0], v + seen[1], STILL, memory)
        costs.append(carried / memory.plan.cost)
        assert tau[0] == pytest.approx(np.clip(-law.regulator.K[0] @ x, -40.0, 40.0), abs=2.0)
        q, v = (z[0] for z in advance(law.nominal, q[None], v[None], tau[None], 0.005, 4))
    assert max(costs[1:]) < 5.0
    assert np.abs(q).max() < 0.1


def test_mistakes_are_told():
    with pytest.raises(SceneError, match="nothing holds the free joint 'root': key it"):
        make_plan(
            Scene(
                duration=0.1,
                models=[{"file": "quadruped"}],
                roles={"tracked": ["*"], "passive": ["root"]},
                controller={"law": "nmpc"},
            )
        )
