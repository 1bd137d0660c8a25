"""How fast a scene's springs, dampers and servos act, by which steps and widths of friction are chosen."""

from __future__ import annotations

import copy
from collections.abc import Iterable
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from .interface import Array

_NUDGE = 1e-6


class Look(NamedTuple):
    """A place to look at: q (nq,), v (nv,), ctrl (nu,)."""

    q: Array
    v: Array
    ctrl: Array


def mobility(model: mujoco.MjModel, q: Array, moving: NDArray[np.bool_]) -> Array:
    """Inverse inertia matrix of the `moving` freedoms at `q`, the others held; zero elsewhere."""
    data, M = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    out, free = np.zeros_like(M), np.ix_(moving, moving)
    out[free] = np.linalg.inv(M[free])
    return out


def friction_width(model: mujoco.MjModel, q: Array, moving: NDArray[np.bool_], step: float) -> float | None:
    """Speed [rad/s, m/s] below which dry friction is smoothed; None without friction.

    At least 0.01, and wide enough that the smoothed force is not stiff for the step: the largest rate
    eig(M^-1 diag(friction)) / width stays below 1/step.
    """
    off = int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    friction = np.where(moving, model.dof_frictionloss, 0.0)
    if model.opt.disableflags & off or not friction.any():
        return None
    root = np.sqrt(friction)
    fastest = np.linalg.eigvalsh(root[:, None] * mobility(model, q, moving) * root)[-1]
    return max(0.01, float(fastest) * step)


def fastest_rate(model: mujoco.MjModel, looks: Iterable[Look], moving: NDArray[np.bool_]) -> float:
    """Largest natural frequency [rad/s] or rate of decay [1/s] of the `moving` freedoms.

    The largest |eigenvalue| of d/dt (dq, dv, dact) where the model is looked at, of everything that MuJoCo
    counts as a passive or an actuator's force: springs and dampers of joints, tendons and actuators, servos,
    activations, drag. Found by differences, so that none is forgotten. Taut tendons stay taut and no force
    is cut off here, for what is slack or at its limit may not stay so.
    """
    if not moving.any():
        return 0.0
    forces = _Forces(model, moving)
    return max((forces.rate(look) for look in looks), default=0.0)


class _Forces:
    """Passive and actuators' forces of a model, linearised."""

    def __init__(self, model: mujoco.MjModel, moving: NDArray[np.bool_]) -> None:
        m, off = copy.copy(model), mujoco.mjtDisableBit
        for limited in (m.actuator_forcelimited, m.jnt_actfrclimited, m.tendon_actfrclimited):
            limited[:] = 0
        m.tendon_lengthspring[:, 1] = m.tendon_lengthspring[:, 0]
        m.opt.disableflags |= int(off.mjDSBL_CONSTRAINT) | int(off.mjDSBL_GRAVITY)
        m.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
        self.model, self.data, self.free = m, mujoco.MjData(m), np.flatnonzero(moving)

    def rate(self, look: Look) -> float:
        """Largest |eigenvalue| at a state."""
        m, n, na = self.model, len(self.free), self.model.na
        by_q, by_v, by_act = self._by(look, n, "q"), self._by(look, n, "v"), self._by(look, na, "act")
        if not (by_q.any() or by_v.any() or by_act.any()):
            return 0.0
        inverse = mobility(m, look.q, np.isin(np.arange(m.nv), self.free))[np.ix_(self.free, self.free)]
        A = np.zeros((2 * n + na, 2 * n + na))
        A[:n, n : 2 * n] = np.eye(n)
        A[n:] = np.hstack([by_q, by_v, by_act])
        A[n : 2 * n] = inverse @ A[n : 2 * n]
        return float(np.abs(np.linalg.eigvals(A)).max())

    def _by(self, look: Look, columns: int, what: str) -> Array:
        """Derivatives of the forces and of the activations' rates, (n + na, columns)."""
        out = np.zeros((len(self.free) + self.model.na, columns))
        for k in range(columns):
            ahead, behind = (self._at(look, k, what, side * _NUDGE) for side in (1.0, -1.0))
            out[:, k] = (ahead - behind) / (2.0 * _NUDGE)
        return out

    def _at(self, look: Look, k: int, what: str, nudge: float) -> Array:
        m, d = self.model, self.data
        d.qpos[:], d.qvel[:], d.ctrl[:], d.act[:] = look.q, look.v, look.ctrl, 0.0
        if what == "q":
            beside = np.zeros(m.nv)
            beside[self.free[k]] = 1.0
            mujoco.mj_integratePos(m, d.qpos, beside, nudge)
        elif what == "v":
            d.qvel[self.free[k]] += nudge
        else:
            d.act[k] += nudge
        if what == "q" or k == 0:
            mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        mujoco.mj_fwdActuation(m, d)
        return np.concatenate([(d.qfrc_passive + d.qfrc_actuator)[self.free], d.act_dot])
