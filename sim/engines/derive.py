"""What follows from recorded states: accelerations, drive forces, energies, normal forces."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from ...models import captured_warnings
from .interface import Array, Problem, Role, Segment
from .prescribe import Prescriber
from .timed import Timed

_GIVEN = int(
    mujoco.mjtState.mjSTATE_TIME
    | mujoco.mjtState.mjSTATE_QPOS
    | mujoco.mjtState.mjSTATE_QVEL
    | mujoco.mjtState.mjSTATE_ACT
    | mujoco.mjtState.mjSTATE_CTRL
)


@dataclass(frozen=True)
class Derived:
    """Quantities that belong to the recorded states, not to the step before (n samples).

    a (n, nv); tau (n, nv): force of actuators, controllers and, on keyed joints, of whatever drives them as
    keyed, their actuators included [N, N m]; ctrl (n, nu); kinetic, potential (n,) [J]; normal (n,): sum of
    contact normal forces [N].
    """

    a: Array
    tau: Array
    ctrl: Array
    kinetic: Array
    potential: Array
    normal: Array


def derive(problem: Problem, segment: Segment) -> Derived:
    """Evaluate the model at every sample of ``segment``."""
    with captured_warnings():
        return _derive(problem, segment)


def _derive(problem: Problem, segment: Segment) -> Derived:
    m, n = problem.model, len(segment.t)
    p = Prescriber(m, problem.dofs(Role.KEYED))
    p.model.opt.timestep = problem.step
    d, timed, friction = mujoco.MjData(p.model), Timed(problem), dry_friction(m)[p.keyed]
    inputs = timed.at(segment.t)
    tick = np.searchsorted(segment.tick_t, segment.t + 1e-9, side="right")  # 0: before the first
    ctrl, qfrc = (np.vstack([np.zeros(x.shape[1]), x])[tick] for x in (segment.tick_ctrl, segment.tick_qfrc))
    ctrl[:, timed.servos] = inputs.ctrl
    states = np.column_stack([segment.t, segment.q, segment.v, segment.act, ctrl])
    a, force, drive = np.zeros((n, m.nv)), np.zeros((n, m.nv)), np.zeros((n, len(p.keyed)))
    energy, normal = np.zeros((2, n)), np.zeros(n)
    for i in range(n):
        mujoco.mj_setState(m, d, states[i], _GIVEN)
        if segment.a is not None:
            mujoco.mj_fwdPosition(m, d)
            mujoco.mj_fwdVelocity(m, d)
            mujoco.mj_fwdActuation(m, d)
        else:
            apply_wrenches(p.model, d, timed, inputs.wrench[i])
            p.settle(d, qfrc[i], inputs.a[i])
            a[i], drive[i], normal[i] = d.qacc, p.drive, _normal(p.model, d)
            if len(p.keyed):
                mujoco.mj_makeM(m, d)  # without what makes them move as told
        force[i] = d.qfrc_actuator
        mujoco.mj_energyPos(m, d)
        mujoco.mj_energyVel(m, d)
        energy[:, i] = d.energy
    tau = force + qfrc
    if segment.a is not None:
        assert segment.drive is not None
        a, tau = segment.a, tau + segment.drive
    else:
        tau[:, p.keyed] = force[:, p.keyed] + drive + friction * np.sign(segment.v[:, p.keyed])
    potential, kinetic = energy
    return Derived(a, tau, ctrl, kinetic, potential, normal)


def dry_friction(model: mujoco.MjModel) -> Array:
    """Dry friction (nv,) [N, N m] that is part of the scene's physics; a drive has to overcome it."""
    off = int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    loss = np.array(model.dof_frictionloss, dtype=float)
    return np.zeros_like(loss) if model.opt.disableflags & off else loss


def apply_wrenches(model: mujoco.MjModel, data: mujoco.MjData, timed: Timed, wrench: Array) -> None:
    """Write the wrenches (w, 6) of one time into ``xfrc_applied``, body frames turned into the world."""
    if not len(timed.bodies):
        return
    if timed.body_frame.any():
        mujoco.mj_kinematics(model, data)
    applied = data.xfrc_applied
    applied[:] = 0.0
    for body, local, w in zip(timed.bodies, timed.body_frame, wrench, strict=True):
        if local:
            R_WB = data.xmat[body].reshape(3, 3)
            applied[body, :3] += R_WB @ w[:3]
            applied[body, 3:] += R_WB @ w[3:]
        else:
            applied[body] += w


def _normal(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Sum of the normal forces [N] of all contacts.

    That of a pyramid is the sum of its rows, that of a cone its first row (MuJoCo, Computation, Constraint
    model); the rows of contacts come last.
    """
    if not data.ncon:
        return 0.0
    if model.opt.cone == mujoco.mjtCone.mjCONE_PYRAMIDAL:
        return float(data.efc_force[data.ne + data.nf + data.nl :].sum())
    rows = data.contact.efc_address
    return float(data.efc_force[rows[rows >= 0]].sum())
