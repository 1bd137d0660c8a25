"""Gains of joint laws: by name, or from a bandwidth; and the forces that joints can give."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import joint_names
from ..sim.errors import PantographError, unknown

Array = NDArray[np.float64]
Gain = float | Mapping[str, float]


def positive(what: str, value: float, *, zero: bool = False) -> float:
    """``value`` if it is a positive number (or zero, if that may be), else PantographError."""
    good = isinstance(value, int | float) and np.isfinite(value) and (value > 0 or (zero and value == 0))
    if not good:
        raise PantographError(
            f"{what} must be a {'number >= 0' if zero else 'positive number'}, got {value!r}"
        )
    return float(value)


def per_joint(model: mujoco.MjModel, what: str, gain: Gain) -> Array:
    """One number >= 0 a degree of freedom (nv,), from one for all or one a joint by name (others zero).

    Raises PantographError for a number that is negative or a name that is no joint.
    """
    out = np.zeros(model.nv)
    names = {name: j for j, name in enumerate(joint_names(model))}
    for name, value in (gain if isinstance(gain, Mapping) else {"": gain}).items():
        positive(what, value, zero=True)
        if name and name not in names:
            raise PantographError(f"{what}: {unknown('joint', name, names)}")
        out[model.dof_jntid == names[name] if name else slice(None)] = value
    return out


def felt_inertia(model: mujoco.MjModel, q: Array) -> Array:
    """1 / (M^-1)_ii (nv,): the inertia that each freedom feels at ``q`` when the others are free."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    inverse = np.eye(model.nv)
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return np.asarray(1.0 / np.diag(inverse))


def force_limits(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Least and greatest force (nv,) that the actuators on each hinge or slide can give [N, N m].

    Infinite for a freedom without a working actuator (its joint force is ideal). Actuators whose gain depends
    on position or speed are limited by their force range alone.
    """
    low, high = np.full(model.nv, -np.inf), np.full(model.nv, np.inf)
    for i in range(model.nu):
        joint_like = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        gain = float(model.actuator_gainprm[i, 0])
        if int(model.actuator_trntype[i]) not in joint_like or not np.any(model.actuator_gainprm[i, :3]):
            continue
        joint = int(model.actuator_trnid[i, 0])
        dof, gear = int(model.jnt_dofadr[joint]), float(model.actuator_gear[i, 0])
        ends = np.array([-np.inf, np.inf])
        motor = (
            model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_NONE
            and not model.actuator_gainprm[i, 1:3].any()
        )
        if motor and model.actuator_ctrllimited[i]:
            ends = np.sort(gain * model.actuator_ctrlrange[i])
        if model.actuator_forcelimited[i]:
            force = model.actuator_forcerange[i]
            ends = np.array([max(ends[0], force[0]), min(ends[1], force[1])])
        ends = np.sort(gear * ends)
        if np.isneginf(low[dof]) and np.isposinf(high[dof]):
            low[dof], high[dof] = ends
        else:
            low[dof], high[dof] = low[dof] + ends[0], high[dof] + ends[1]
        if model.jnt_actfrclimited[joint]:
            low[dof] = max(low[dof], float(model.jnt_actfrcrange[joint, 0]))
            high[dof] = min(high[dof], float(model.jnt_actfrcrange[joint, 1]))
    return low, high


def unit_free_gains(inertia: Array, frequency: float, damping: float) -> tuple[Array, Array]:
    """kp = m w^2 and kd = 2 zeta m w (nv,) for w = 2 pi ``frequency`` [Hz]."""
    w = 2.0 * np.pi * frequency
    return inertia * w**2, 2.0 * damping * inertia * w
