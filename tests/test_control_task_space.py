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
