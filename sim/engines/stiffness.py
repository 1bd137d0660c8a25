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
_HEAVY = 1e10  # inertia that is held, beside the model's largest
_LARGE = 80  # states beyond which only the largest eigenvalue is sought


class Look(NamedTuple):
    """A place to look at: q (nq,), v (nv,), ctrl (nu,)."""

    q: Array
    v: Array
    ctrl: Array


def mobility(model: mujoco.MjModel, q: Array, on: NDArray[np.intp], held: NDArray[np.bool_]) -> Array:
    """Inverse inertia matrix at `q` of the freedoms `on`, those that are `held` taken out."""
    still = _holding(model, held)
    data, inverse, unit = mujoco.MjData(still), np.zeros((len(on), model.nv)), np.zeros((len(on), model.nv))
    data.qpos[:] = q
    mujoco.mj_fwdPosition(still, data)
    unit[np.arange(len(on)), on] = 1.0
    mujoco.mj_solveM(still, data, inverse, unit)
    return inverse[:, on]


def _holding(model: mujoco.MjModel, held: NDArray[np.bool_]) -> mujoco.MjModel:
    """A copy of the model in which no force moves the freedoms that are held."""
    m = copy.copy(model)
    m.dof_armature[held] = _HEAVY * max(1.0, float(np.max(m.dof_M0, initial=0.0)))
    return m


def friction_width(
    model: mujoco.MjModel, q: Array, moving: NDArray[np.bool_], step: float, least: float = 0.01
) -> float | None:
    """Speed [rad/s, m/s] below which dry friction is smoothed; None without friction.

    At least `least`, and wide enough that the smoothed force is not stiff for the step: the largest rate
    eig(M^-1 diag(friction)) / width stays below 1/step.
    """
    off = int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    dry = np.flatnonzero(np.where(moving, model.dof_frictionloss, 0.0))
    if model.opt.disableflags & off or not len(dry):
        return None
    root = np.sqrt(model.dof_frictionloss[dry])
    fastest = np.linalg.eigvalsh(root[:, None] * mobility(model, q, dry, ~moving) * root)[-1]
    return max(least, float(fastest) * step)


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
        m, off = _holding(model, ~moving), mujoco.mjtDisableBit
        for limited in (m.actuator_forcelimited, m.jnt_actfrclimited, m.tendon_actfrclimited):
            limited[:] = 0
        m.tendon_lengthspring[:, 1] = m.tendon_lengthspring[:, 0]
        m.opt.disableflags |= int(off.mjDSBL_CONSTRAINT) | int(off.mjDSBL_GRAVITY)
        m.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
        self.model, self.free = m, np.flatnonzero(moving)
        self.data, self.inertia = mujoco.MjData(m), mujoco.MjData(m)

    def rate(self, look: Look) -> float:
        """Largest |eigenvalue| at a state."""
        self.inertia.qpos[:] = look.q
        mujoco.mj_fwdPosition(self.model, self.inertia)
        n, size = len(self.free), 2 * len(self.free) + self.model.na
        random = np.random.default_rng(0).normal(size=(3, size))
        if not any(self._along(look, x)[n:].any() for x in random):
            return 0.0
        if size > _LARGE:
            return self._largest(look, random[0])
        dense = np.stack([self._along(look, x) for x in np.eye(size)], axis=1)
        return float(np.abs(np.linalg.eigvals(dense)).max())

    def _largest(self, look: Look, x: Array) -> float:
        """The largest |eigenvalue| alone, to 0.1 %; where it does not stand out, by how vectors grow."""
        from scipy.sparse.linalg import ArpackNoConvergence, LinearOperator, eigs

        A = LinearOperator((len(x), len(x)), matvec=lambda x: self._along(look, x), dtype=float)
        try:
            return float(np.abs(eigs(A, 1, v0=x, tol=1e-3, maxiter=20, return_eigenvectors=False))[0])
        except ArpackNoConvergence:
            growth = []
            for _ in range(100):
                x = self._along(look, x / np.linalg.norm(x))
                growth.append(np.log(np.linalg.norm(x)))
            return float(np.exp(np.mean(growth[50:])))

    def _along(self, look: Look, x: Array) -> Array:
        """d/dt (dq, dv, dact) for x = (dq, dv, dact) of the free freedoms."""
        n, m = len(self.free), self.model
        dq, dv, dact = np.split(np.asarray(x, dtype=float).ravel(), (n, 2 * n))
        ahead, behind = (self._at(look, side * dq, side * dv, side * dact) for side in (_NUDGE, -_NUDGE))
        change = (ahead - behind) / (2.0 * _NUDGE)
        force, a = np.zeros((1, m.nv)), np.zeros((1, m.nv))
        force[0, self.free] = change[:n]
        mujoco.mj_solveM(m, self.inertia, a, force)
        return np.concatenate([dv, a[0, self.free], change[n:]])

    def _at(self, look: Look, dq: Array, dv: Array, dact: Array) -> Array:
        """Forces on the free freedoms, and rates of the activations, beside a state."""
        m, d = self.model, self.data
        d.qpos[:], d.qvel[:], d.ctrl[:], d.act[:] = look.q, look.v, look.ctrl, dact
        beside = np.zeros(m.nv)
        beside[self.free] = dq
        mujoco.mj_integratePos(m, d.qpos, beside, 1.0)
        d.qvel[self.free] += dv
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        mujoco.mj_fwdActuation(m, d)
        return np.concatenate([(d.qfrc_passive + d.qfrc_actuator)[self.free], d.act_dot])
