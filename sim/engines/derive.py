"""What follows from recorded states: accelerations, drive forces, energies, normal forces."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from ...models import captured_warnings
from .interface import Array, Problem, Role, Segment
from .prescribe import Prescriber
from .timed import Timed


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
    d, plain = mujoco.MjData(p.model), mujoco.MjData(m)
    timed, friction = Timed(problem), dry_friction(m)[p.keyed]
    inputs = timed.at(segment.t)
    a, tau, ctrl = np.zeros((n, m.nv)), np.zeros((n, m.nv)), np.zeros((n, m.nu))
    kinetic, potential, normal = np.zeros(n), np.zeros(n), np.zeros(n)
    tick = np.searchsorted(segment.tick_t, segment.t + 1e-9, side="right") - 1
    for i in range(n):
        d.qpos[:], d.qvel[:], d.act[:], d.time = segment.q[i], segment.v[i], segment.act[i], segment.t[i]
        held = tick[i] >= 0
        d.ctrl[:] = segment.tick_ctrl[tick[i]] if held else 0.0
        d.ctrl[timed.servos] = inputs.ctrl[i]
        qfrc = segment.tick_qfrc[tick[i]] if held else np.zeros(m.nv)
        ctrl[i] = d.ctrl
        if segment.a is not None and segment.drive is not None:
            mujoco.mj_fwdPosition(m, d)
            mujoco.mj_fwdVelocity(m, d)
            mujoco.mj_fwdActuation(m, d)
            a[i], tau[i] = segment.a[i], d.qfrc_actuator + qfrc + segment.drive[i]
        else:
            apply_wrenches(p.model, d, timed, inputs.wrench[i])
            p.settle(d, qfrc, inputs.a[i])
            a[i], tau[i] = d.qacc, d.qfrc_actuator + qfrc
            tau[i, p.keyed] = d.qfrc_actuator[p.keyed] + p.drive + friction * np.sign(segment.v[i, p.keyed])
            normal[i] = _normal(p.model, d)
        kinetic[i], potential[i] = _energy(m, plain, segment.q[i], segment.v[i])
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
    data.xfrc_applied[:] = 0.0
    for body, local, w in zip(timed.bodies, timed.body_frame, wrench, strict=True):
        R_WB = data.xmat[body].reshape(3, 3) if local else np.eye(3)
        data.xfrc_applied[body, :3] += R_WB @ w[:3]
        data.xfrc_applied[body, 3:] += R_WB @ w[3:]


def _energy(model: mujoco.MjModel, data: mujoco.MjData, q: Array, v: Array) -> tuple[float, float]:
    data.qpos[:], data.qvel[:] = q, v
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return float(data.energy[1]), float(data.energy[0])


def _normal(model: mujoco.MjModel, data: mujoco.MjData) -> float:
    """Sum of the normal forces [N] of all contacts."""
    total, force = 0.0, np.zeros(6)
    for c in range(data.ncon):
        if data.contact[c].efc_address >= 0:
            mujoco.mj_contactForce(model, data, c, force)
            total += float(force[0])
    return total
