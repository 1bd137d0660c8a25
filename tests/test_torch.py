"""The smooth engine in torch: gradients against differences, rollouts by torchdiffeq against exact steps."""

import sys

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim.dynamics import compile_model, differentiable
from pantograph.sim.errors import EngineError
from pantograph.sim.integrate import TABLEAUS
from strategies import random_states, seeds, trees

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'pantograph-sim[torch]'")
torchdiffeq = pytest.importorskip(
    "torchdiffeq", reason="torchdiffeq is not installed: pip install 'pantograph-sim[torch]'"
)


def tensor(array, grad: bool = True):
    return torch.tensor(np.asarray(array), dtype=torch.float64, requires_grad=grad)


def machine(seed: int, kind: str, *, hinges: int = 2) -> mujoco.MjModel:
    """A `kind` joint with hinges behind it; a servo with activation, a motor, gravity, damping."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.option.disableflags = int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    body = spec.worldbody
    joints = [kind] + ["hinge"] * hinges
    for i, name in enumerate(joints):
        body = body.add_body(name=f"b{i}", pos=rng.normal(size=3))
        body.add_joint(name=f"j{i}", type=getattr(mujoco.mjtJoint, f"mjJNT_{name.upper()}"),
                       axis=rng.normal(size=3), damping=np.full(3, 0.1))  # fmt: skip
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=rng.uniform(0.2, 0.6, 3), pos=rng.normal(size=3))
    for joint, dynamics in ((1, mujoco.mjtDyn.mjDYN_FILTER), (hinges, mujoco.mjtDyn.mjDYN_NONE)):
        motor = spec.add_actuator(name=f"a{dynamics}", target=f"j{joint}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.gear[0], motor.dyntype, motor.dynprm[0] = rng.uniform(50, 100), dynamics, 0.3
    return spec.compile()


def inputs(smooth, seed: int, n: int):
    """A batch of states x (n, nx) with unit quaternions, controls (n, nu) and parameters (np,)."""
    rng = np.random.default_rng(seed)
    q, v, _ = random_states(smooth.model, seed, n)
    u, act = rng.normal(size=(n, smooth.layout.nu)), rng.normal(size=(n, smooth.layout.na))
    return np.concatenate([q, v, act], axis=1), u, smooth.parameter_values * rng.uniform(0.8, 1.2)


@settings(max_examples=6, deadline=None)
@given(seeds, st.sampled_from(["free", "ball", "slide"]), st.sampled_from([(), (2,), (2, 2)]))
def test_gradients_of_the_rate(seed, kind, lead):
    """By state, controls and a mass, quaternions as plain numbers; what is given once gathers from all."""
    smooth = compile_model(machine(seed, kind), parameters=[("body_mass", "b1")])
    x, u, p = inputs(smooth, seed, max(1, int(np.prod(lead))))
    f = differentiable(smooth).rate
    args = (tensor(x.reshape(*lead, -1)), tensor(u[0]), tensor(p))
    dx = f(*args)
    q, v, act = np.split(x, [smooth.layout.nq, smooth.layout.nq + smooth.layout.nv], axis=1)
    true = smooth.evaluate("rate", q=q, v=v, act=act, u=u[0], p=p)["dx"]
    assert dx.shape == args[0].shape
    assert np.array_equal(dx.detach().numpy(), true.reshape(dx.shape))
    scale = max(1.0, float(dx.detach().abs().max()))
    assert torch.autograd.gradcheck(lambda *a: f(*a) / scale, args, eps=1e-6, atol=1e-6, rtol=1e-5)


@settings(max_examples=6, deadline=None)
@given(trees(max_bodies=3), seeds)
def test_gradients_of_accelerations(model, seed):
    """Of any tree, by all inputs; a quaternion's length does not count, nor does its gradient along it."""
    smooth = compile_model(model, parameters=[("body_mass", "b0")])
    if not smooth.layout.nv:
        return
    q, v, tau = random_states(model, seed, 2)
    for at in smooth.layout.quaternions:
        q[:, at : at + 4] *= 1.3
    f = differentiable(smooth).forward
    scale = 1.0 + np.abs(smooth.forward(q, v, tau=tau)).max()
    args = (tensor(q), tensor(v), tensor(tau), tensor(smooth.parameter_values))
    assert torch.autograd.gradcheck(
        lambda q, v, tau, p: f(q, v, tau=tau, p=p) / scale, args, eps=1e-6, atol=1e-6, rtol=1e-5
    )


@pytest.mark.parametrize("seed", range(3))
def test_a_rollout_by_torchdiffeq_has_the_derivatives_of_our_steps(seed):
    """Its rk4 is the 3/8 rule; ten exact steps, chained, by state, controls and mass."""
    smooth = compile_model(machine(seed, "hinge", hinges=2), parameters=[("body_mass", "b1")])
    x, u, p = inputs(smooth, seed, 1)
    step, steps, lay = 0.01, 10, smooth.layout
    x0, controls, mass = tensor(x[0]), tensor(u[0]), tensor(p)
    dynamics = differentiable(smooth)
    t = torch.linspace(0, step * steps, steps + 1, dtype=torch.float64)
    path = torchdiffeq.odeint(lambda t, y: dynamics.rate(y, controls, mass), x0, t, method="rk4")
    state, A, B, P = x[0], np.eye(lay.nx), np.zeros((lay.nx, lay.nu)), np.zeros((lay.nx, 1))
    for _ in range(steps):
        q, v, act = np.split(state, [lay.nq, lay.nq + lay.nv])
        d = smooth.step_derivatives(q, v, u[0], step=step, method=TABLEAUS["rk38"], act=act, p=p)
        state, A, B, P = d.x, d.A @ A, d.A @ B + d.B, d.A @ P + d.P
    assert np.abs(path[-1].detach().numpy() - state).max() < 1e-12 * (1 + np.abs(state).max())
    for i in range(lay.nx):
        found = torch.autograd.grad(path[-1, i], (x0, controls, mass), retain_graph=True)
        for ours, exact in zip(found, (A[i], B[i], P[i]), strict=True):
            assert np.abs(ours.numpy() - exact).max() < 1e-10 * (1 + np.abs(exact).max())


@pytest.mark.parametrize(("kind", "solver"), [("free", "odeint"), ("ball", "odeint_adjoint")])
def test_an_adaptive_rollout_of_rotations_has_the_derivatives_of_the_motion(kind, solver):
    """By where it starts, in the tangent space, against differences of our own solver's ends at 1e-12."""
    smooth = compile_model(machine(7, kind))
    x, u, _ = inputs(smooth, 7, 1)
    lay, nv = smooth.layout, smooth.layout.nv
    x0, controls = tensor(x[0]), tensor(u[0])
    dynamics = differentiable(smooth)
    weights = np.random.default_rng(1).normal(size=nv)
    t = torch.tensor([0.0, 0.3], dtype=torch.float64)
    words = {"adjoint_params": (controls,)} if solver == "odeint_adjoint" else {}
    path = getattr(torchdiffeq, solver)(
        lambda t, y: dynamics.rate(y, controls), x0, t, rtol=1e-10, atol=1e-10, **words
    )
    (path[-1, lay.nq : lay.nq + nv] @ torch.from_numpy(weights)).backward()
    q, v, act = np.split(x[0], [lay.nq, lay.nq + nv])
    for k in range(nv):
        ends, moved = [], []
        for sign in (1, -1):
            start = q.copy()
            mujoco.mj_integratePos(smooth.model, start, sign * np.eye(nv)[k], 1e-5)
            end = smooth.integrate(
                start, v, (0, 0.3), u[0], act0=act, rtol=1e-12, atol=1e-12, method=TABLEAUS["dop853"]
            )
            ends.append(end.v[-1])
            moved.append(start)
        true = weights @ (ends[0] - ends[1]) / 2e-5
        ours = x0.grad[: lay.nq].numpy() @ (moved[0] - moved[1]) / 2e-5
        assert ours == pytest.approx(true, rel=1e-5, abs=1e-5 * np.abs(x0.grad.numpy()).max())


def test_keyed_motion_is_a_constant_to_gradients():
    smooth = compile_model(machine(3, "slide"), keyed=["j0"])
    lay = smooth.layout
    dynamics = differentiable(smooth)
    x, w = tensor(np.linspace(0.1, 0.9, lay.nx)), tensor(np.array([0.2, -0.4, 3.0]), grad=False)
    assert torch.autograd.gradcheck(lambda y: 1e-2 * dynamics.rate(y, w=w), (x,), atol=1e-6)
    still = dynamics.rate(x, w=torch.zeros(3, dtype=torch.float64))
    assert (dynamics.rate(x, w=w) - still).abs().max() > 1e-2, "prescribed motion pulls the others"
    with pytest.raises(EngineError, match="keyed joints need their prescribed motion"):
        dynamics.rate(x)
    with pytest.raises(EngineError, match=r"no gradients by prescribed motion w: pass w\.detach"):
        dynamics.rate(x, w=w.clone().requires_grad_())


def test_mistakes_are_named():
    smooth = compile_model(machine(0, "ball"))
    nx, nu = smooth.layout.nx, smooth.layout.nu
    rate = differentiable(smooth).rate
    x = torch.zeros(nx, dtype=torch.float64)
    with pytest.raises(EngineError, match=r"x has type torch\.float32; it must be torch\.float64: x\.double"):
        rate(x.float())
    with pytest.raises(EngineError, match=rf"u has shape \({nu + 1},\); expected \(\.\.\., {nu}\)"):
        rate(x, torch.zeros(nu + 1, dtype=torch.float64))
    with pytest.raises(EngineError, match="x is a ndarray; it must be a torch tensor"):
        rate(x.numpy())
    with pytest.raises(EngineError, match=r"do not broadcast: x \(3, "):
        rate(x.expand(3, nx), torch.zeros(2, nu, dtype=torch.float64))
    with pytest.raises(EngineError, match=r"x is on meta; compiled dynamics run on the CPU"):
        rate(x.to("meta"))
    y = x.clone().requires_grad_()
    with pytest.raises(EngineError, match="first derivatives only: leave out create_graph=True"):
        torch.autograd.grad(rate(y).sum(), y, create_graph=True)


def test_missing_torch_is_said_with_the_remedy(monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(EngineError, match=r"pip install 'pantograph-sim\[torch\]'"):
        differentiable(compile_model(machine(0, "ball")))
