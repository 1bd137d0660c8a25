"""What counts in a trial: which joints, how far they are from where they belong, when they have arrived."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import dof_names, joint_names
from ..sim.control import JointActuators
from ..sim.engines.interface import Problem, Role
from ..sim.kinds import SCALAR
from .nominal import differences

Array = NDArray[np.float64]
_BAND = 0.02  # of its motion: a joint that stays this near to where it belongs has settled
_STILL = 1e-9  # rad, m: no motion


@dataclass(frozen=True, eq=False)
class Judged:
    """Freedoms that count, ``dofs`` (nv,): those of tracked joints, and of joints with a goal, whichever law
    runs and whether it knows of goals. ``goal`` (nq,) is NaN for joints without one."""

    model: mujoco.MjModel
    dofs: NDArray[np.bool_]
    goal: Array

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the freedoms that count."""
        names = dof_names(self.model)
        return tuple(names[i] for i in np.flatnonzero(self.dofs))

    def targets(self, q: Array, v: Array) -> tuple[Array, Array]:
        """Where keys, q (n, nq) and v (n, nv), and goals want the joints."""
        at_rest = self._goal_dofs()
        return np.where(np.isnan(self.goal), q, self.goal), np.where(at_rest, 0.0, v)

    def errors(self, q: Array, targets: Array) -> Array:
        """From q (n, nq) to ``targets``, of the freedoms that count, (n, count) [rad, m]; hinges with a goal
        and without a range by the shorter way around."""
        error = differences(self.model, q, targets)
        error = np.where(self._around(), (error + np.pi) % (2.0 * np.pi) - np.pi, error)
        return np.asarray(error[:, self.dofs])

    def arrival(self, t: Array, error: Array, q: Array, v: Array) -> tuple[float, float]:
        """Settling time [s] and overshoot of the worst joint, from errors (n, count) at times t (n,) with
        targets q (n, nq), v (n, nv); see :class:`~pantograph.controllers.trial.Figures`."""
        way = differences(self.model, q, np.broadcast_to(q[-1], q.shape))[:, self.dofs]
        moving = np.flatnonzero((np.abs(way) > _STILL).any(axis=1) | v[:, self.dofs].any(axis=1))
        rest = int(moving[-1]) + 1 if len(moving) else 0
        start, left = way[0] + error[0], error[rest:]
        scale = self._scale(np.maximum(np.abs(way).max(axis=0), np.abs(start)))
        if not len(left) or not (scale > _STILL).any():
            return np.nan, 0.0
        outside = np.flatnonzero((np.abs(left) > _BAND * scale).any(axis=1))
        settling = 0.0 if not len(outside) else np.inf
        if len(outside) and outside[-1] + 1 < len(left):
            settling = float(t[rest + outside[-1] + 1] - t[rest])
        whole = np.where(self._around()[self.dofs], np.unwrap(error, axis=0), error)[rest:]
        return settling, max(0.0, float(np.max(-whole * np.sign(start) / scale)))

    def _scale(self, motion: Array) -> Array:
        """What 2 % is of, (count,): a joint's own motion; where it has none, the largest of its kind, then
        that of the other kind at an arm as long as the model (MuJoCo's extent)."""
        m = self.model
        first = np.arange(m.nv) - m.jnt_dofadr[m.dof_jntid]
        kind = m.jnt_type[m.dof_jntid]
        free = (kind == mujoco.mjtJoint.mjJNT_FREE) & (first < 3)
        length = ((kind == mujoco.mjtJoint.mjJNT_SLIDE) | free)[self.dofs]
        extent, own = float(m.stat.extent), np.where(motion > _STILL, motion, 0.0)
        angles, lengths = (own[kind].max(initial=0.0) for kind in (~length, length))
        missing = np.where(length, lengths or angles * extent, angles or lengths / extent)
        return np.where(own > 0.0, own, missing)

    def _around(self) -> NDArray[np.bool_]:
        """Hinges (nv,) with a goal and without a range."""
        m = self.model
        hinges = (m.jnt_type == mujoco.mjtJoint.mjJNT_HINGE) & ~m.jnt_limited.astype(bool)
        return np.asarray(self._goal_dofs() & hinges[m.dof_jntid])

    def _goal_dofs(self) -> NDArray[np.bool_]:
        """Freedoms (nv,) with a goal."""
        m, out = self.model, np.zeros(self.model.nv, dtype=bool)
        scalar = np.flatnonzero(np.isin(m.jnt_type, SCALAR))
        out[m.jnt_dofadr[scalar]] = ~np.isnan(self.goal[m.jnt_qposadr[scalar]])
        return out


def judged(problem: Problem, goal: Any = None) -> Judged:
    """What counts under ``goal`` [rad, m] (joint -> value), the word of controllers; names and values that
    make no sense are left to the laws to refuse."""
    m, aims = problem.model, np.full(problem.model.nq, np.nan)
    dofs, names = problem.dofs(Role.TRACKED).copy(), joint_names(problem.model)
    for name, value in (goal if isinstance(goal, Mapping) else {}).items():
        if name in names and m.jnt_type[names.index(name)] in SCALAR:
            joint = names.index(name)
            aims[m.jnt_qposadr[joint]], dofs[m.jnt_dofadr[joint]] = float(value), True
    return Judged(m, dofs, aims)


def delivered(
    m: mujoco.MjModel, actuators: JointActuators, tau: Array, ctrl: Array, q: Array, v: Array
) -> Array:
    """Joint forces (n, nv) that drives give for ``ctrl`` (n, nu) at q (n, nq), v (n, nv); freedoms without a
    drive get ``tau`` (n, nv) (MuJoCo documentation, Computation, Actuation model)."""
    a, out = actuators, np.array(tau)
    length, rate = a.gear * q[:, a.qpos], a.gear * v[:, a.dof]
    gain, bias = (x[:, 0] + x[:, 1] * length + x[:, 2] * rate for x in (a.gain, a.bias))
    limited = m.actuator_forcelimited[a.index, None].astype(bool)
    low, high = np.where(limited, m.actuator_forcerange[a.index], (-np.inf, np.inf)).T
    out[:, a.dof] = a.gear * np.clip(gain * ctrl[:, a.index] + bias, low, high)
    limited = m.jnt_actfrclimited[m.dof_jntid[a.dof], None].astype(bool)
    low, high = np.where(limited, m.jnt_actfrcrange[m.dof_jntid[a.dof]], (-np.inf, np.inf)).T
    out[:, a.dof] = np.clip(out[:, a.dof], low, high)
    return out
