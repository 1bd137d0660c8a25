"""Laws that move a site: what they reach beside joints that give way or move as keyed."""

import mujoco
import numpy as np
import pytest
from pantograph.controllers.impedance import Impedance
from pantograph.controllers.nominal import Nominal
from pantograph.controllers.operational_space import OperationalSpace
from pantograph.controllers.task import Task
from pantograph.models import load_model
from pantograph.sim.control import Target


@pytest.mark.parametrize("law", ["operational-space", "impedance"])
@pytest.mark.parametrize("roles", ["TTTTPT", "TTPTTT", "KTTTPT"])
def test_a_task_moves_as_wanted_beside_passive_and_keyed_joints(law, roles):
    """Passive joints give way, keyed ones move on: what is left makes the site accelerate as asked."""
    model, rng = load_model("arm6"), np.random.default_rng(3)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    tracked, told = (np.array([role == r for role in roles]) for r in "TK")
    nominal, task = Nominal(model), Task(model, "tip", "position")
    q, v = np.array([0.3, 0.35, 0.15, 0.2, 1.05, 0.1]), 0.3 * rng.normal(size=6)
    target = Target(q + 0.05 * rng.normal(size=6), rng.normal(size=6), rng.normal(size=6))
    now, wanted = task.at(q, v), task.at(target.q, target.v)
    expected = wanted.J @ target.a + wanted.drift
    if law == "impedance":  # nearly no spring, and nearly no damper with it
        made = Impedance(model, tracked, model.qpos0, told, site="tip", stiffness=1e-12)
    else:
        made = OperationalSpace(model, tracked, model.qpos0, told, site="tip", frequency=2.0)
        w = 2 * np.pi * 2.0
        expected += w**2 * task.error(now, wanted) + 2 * w * (wanted.velocity - now.velocity)
    tau, _ = made(0.0, q, v, target, None)
    assert (tau[~tracked] == 0.0).all()
    M, bias = nominal._mujoco(q, v)
    a, free = np.where(told, target.a, 0.0), ~told
    a[free] = np.linalg.solve(M[np.ix_(free, free)], (tau - bias - M @ a)[free])
    np.testing.assert_allclose(now.J @ a + now.drift, expected, rtol=1e-4, atol=1e-3)


def _still(law, v):
    """What a law of the arm's tip adds at joint speeds v, small, where it is wanted at rest here, to what
    makes up for the joints' own damping."""
    model, every = load_model("arm6"), np.ones(6, dtype=bool)
    q, nothing = np.array([0.3, 0.35, 0.15, 0.2, 1.05, 0.1]), np.zeros(6)
    made = law(model, every, model.qpos0)
    target = Target(q, nothing, nothing)
    added = made(0.0, q, v, target, None)[0] - made(0.0, q, nothing, target, None)[0]
    added -= Nominal(model).inverse(q, v, nothing) - Nominal(model).weight(q)
    return Nominal(model).mass_matrix(q), Task(model, "tip", "position").at(q, nothing).J, added


@pytest.mark.parametrize("damping", [0.4, 1.0])
def test_every_mode_of_an_impedance_has_its_damping(damping):
    """Poles of L e'' + D e' + K e = 0, with the damper D as the law's forces show it."""

    def law(model, every, q0):
        return Impedance(model, every, q0, site="tip", stiffness=300.0, damping=damping)

    rng, eps, D = np.random.default_rng(0), 1e-6, np.zeros((3, 3))
    rates, forces = np.zeros((2, 3, 3))
    for k in range(3):
        v = eps * rng.normal(size=6)
        M, J, tau = _still(law, v)
        inertia = np.linalg.inv(J @ np.linalg.solve(M, J.T))
        rates[:, k], forces[:, k] = J @ v, -inertia @ J @ np.linalg.solve(M, tau)
    D = forces @ np.linalg.inv(rates)
    inverse = np.linalg.inv(inertia)
    A = np.block([[np.zeros((3, 3)), np.eye(3)], [-300.0 * inverse, -inverse @ D]])
    poles = np.linalg.eigvals(A)
    np.testing.assert_allclose(-poles.real / np.abs(poles), damping, rtol=1e-2)


@pytest.mark.parametrize("kind", [Impedance, OperationalSpace])
def test_what_the_task_leaves_comes_to_rest_critically_damped(kind):
    """Speeds that the site does not feel: a = -2 w v at the posture's w."""

    def law(model, every, q0):
        return kind(model, every, q0, site="tip", posture=1.5)

    _, J, _ = _still(law, np.zeros(6))
    for v in 1e-6 * np.linalg.svd(J)[2][3:]:
        M, _, tau = _still(law, v)
        np.testing.assert_allclose(np.linalg.solve(M, tau), -4.0 * np.pi * 1.5 * v, rtol=1e-3, atol=1e-9)
