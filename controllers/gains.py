"""Gains of joint laws: by name, or from a bandwidth; and the forces that joints can give."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import joint_names
from ..sim.errors import PantographError, unknown
from ..sim.kinds import SCALAR

Array = NDArray[np.float64]
Gain = float | Mapping[str, float] | Array


def number(what: str, value: object) -> float:
    """``value`` as a finite number, else PantographError."""
    if isinstance(value, Real) and not isinstance(value, bool) and np.isfinite(float(value)):
        return float(value)
    raise PantographError(f"{what} must be a number, got {value!r}")


def positive(what: str, value: object, *, zero: bool = False) -> float:
    """``value`` if it is a positive number (or zero, if that may be), else PantographError."""
    exact = number(what, value)
    if exact > 0 or (zero and exact == 0):
        return exact
    raise PantographError(f"{what} must be a {'number >= 0' if zero else 'positive number'}, got {value!r}")


def whole(what: str, value: object, *, least: int = 1) -> int:
    """``value`` if it is a whole number of at least ``least``, else PantographError."""
    exact = number(what, value)
    if exact.is_integer() and exact >= least:
        return int(exact)
    raise PantographError(f"{what} must be a whole number >= {least}, got {value!r}")


def switch(what: str, value: object) -> bool:
    """``value`` if it is true or false, else PantographError."""
    if isinstance(value, bool | np.bool_):
        return bool(value)
    raise PantographError(f"{what} must be true or false, got {value!r}")


def choice(what: str, value: object, options: Sequence[str], where: str) -> str:
    """``value`` if it is one of ``options``, else PantographError listing these."""
    if isinstance(value, str) and value in options:
        return value
    raise PantographError(unknown(what, str(value), options, where=where))


def per_joint(
    model: mujoco.MjModel,
    what: str,
    gain: Gain,
    *,
    missing: float | Array = 0.0,
    zero: bool = True,
    tracked: NDArray[np.bool_] | None = None,
) -> Array:
    """One number >= 0 (> 0 without ``zero``) a degree of freedom (nv,), from one for all or one a joint by
    name, or as it is, (nv,). Joints that are not named have what "" is given, for all others, and without it
    ``missing``, one number or (nv,): the default of the law.

    Raises PantographError for what is no such number or no mapping of them, and a name that is no joint, or,
    with ``tracked`` (nv,), none of a tracked joint.
    """
    out = np.array(np.broadcast_to(missing, model.nv), dtype=float)
    names = {name: j for j, name in enumerate(joint_names(model))}
    able = (
        names if tracked is None else {n: j for n, j in names.items() if tracked[model.dof_jntid == j].any()}
    )
    for name, value in sorted(gain.items()) if isinstance(gain, Mapping) else [("", gain)]:
        if name and name not in names:
            raise PantographError(f"{what}: {unknown('joint', str(name), able)}")
        if name and name not in able:
            raise PantographError(
                f"{what} of {name!r} has no effect: that joint is not tracked; tracked: {', '.join(able)}"
            )
        of = f"{what} of {name!r}" if name else what
        rows = model.dof_jntid == names[name] if name else slice(None)
        each = [positive(of, one, zero=zero) for one in np.ravel(np.asarray(value, dtype=object))]
        out[rows] = each if isinstance(value, np.ndarray) else each[0]
    return out


def limit_per_joint(
    model: mujoco.MjModel, what: str, limit: Gain | None, *, tracked: NDArray[np.bool_] | None = None
) -> Array:
    """As :func:`per_joint` for limits: positive, infinite for joints that are not named, and without any."""
    return per_joint(model, what, {} if limit is None else limit, missing=np.inf, zero=False, tracked=tracked)


def force_weights(
    model: mujoco.MjModel, tracked: NDArray[np.bool_], force: Gain | None, weight: Array, what: str
) -> Array:
    """Cost (m,) of the squared force of each driven freedom ``tracked`` (nv,).

    Where ``force`` says nothing it is 1 / f^2 with f what the freedom's drive can give, or its ``weight``
    (nv,) [N m, N] (at least 1) where it can give anything. Raises PantographError, naming the law
    ``what``, for forces that cost nothing.
    """
    low, high = force_limits(model)
    able = np.minimum(-low, high)
    scale = np.where(np.isfinite(able), able, np.maximum(1.0, np.abs(weight)))
    own = 1.0 / np.maximum(scale, 1e-9) ** 2
    weights = per_joint(model, f"{what} force", {} if force is None else force, missing=own, tracked=tracked)
    if not (weights[tracked] > 0).all():
        raise PantographError(f"{what} force: every joint that it drives must cost something")
    return np.asarray(weights[tracked])


def felt_inertia(model: mujoco.MjModel, q: Array) -> Array:
    """1 / (M^-1)_ii (nv,): the inertia that each freedom feels at ``q`` when the others are free."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    inverse = np.eye(model.nv)
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    return np.asarray(1.0 / np.diag(inverse))


def coupling(model: mujoco.MjModel, q: Array, tracked: NDArray[np.bool_]) -> float:
    """How many times its felt inertia a motion of the freedoms ``tracked`` (nv,) together has, at most; 1
    where no joint drags another along."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_forward(model, data)
    inverse = np.eye(model.nv)
    mujoco.mj_solveM(model, data, inverse, np.eye(model.nv))
    among = inverse[np.ix_(tracked, tracked)]
    scale = np.sqrt(np.diag(among))
    return float(1.0 / np.linalg.eigvalsh(among / np.outer(scale, scale)).min(initial=1.0))


def falling_stiffness(model: mujoco.MjModel, q: Array, tracked: NDArray[np.bool_]) -> Array:
    """Stiffness (nv,) [N m/rad, N/m] that keeps the freedoms ``tracked`` (nv,) from falling away from ``q``
    under weights that are balanced there: D with D + dg/dq >= 0, by diagonal dominance; 0 where all return.
    """
    data, columns, step = mujoco.MjData(model), [], 1e-5
    for unit in step * np.eye(model.nv)[tracked]:
        ends = []
        for way in (unit, -unit):
            data.qpos[:] = q
            mujoco.mj_integratePos(model, data.qpos, way, 1.0)
            mujoco.mj_fwdPosition(model, data)
            mujoco.mj_fwdVelocity(model, data)
            ends.append((data.qfrc_bias - data.qfrc_passive)[tracked])
        columns.append((ends[0] - ends[1]) / (2.0 * step))
    out = np.zeros(model.nv)
    if columns:
        gradient = np.column_stack(columns)
        sizes, ways = np.linalg.eigh(0.5 * (gradient + gradient.T))
        out[tracked] = np.abs((ways * np.maximum(-sizes, 0.0)) @ ways.T).sum(axis=1)
    return out


def force_limits(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Least and greatest force (nv,) that the actuators on each freedom can give [N, N m].

    Infinite for a freedom without a working actuator of its own (its joint force is ideal): on a ball or free
    joint those count whose gear names one axis of the joint's frame. Actuators whose gain depends on position
    or speed are limited by their force range alone.
    """
    low, high, driven = np.zeros(model.nv), np.zeros(model.nv), np.zeros(model.nv, dtype=bool)
    for i in range(model.nu):
        joint_like = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
        gain = float(model.actuator_gainprm[i, 0])
        if int(model.actuator_trntype[i]) not in joint_like or not np.any(model.actuator_gainprm[i, :3]):
            continue
        found = _freedom(model, i)
        if found is None:
            continue
        dof, gear = found
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
        low[dof], high[dof], driven[dof] = low[dof] + ends[0], high[dof] + ends[1], True
    limited, bounds = (x[model.dof_jntid] for x in (model.jnt_actfrclimited, model.jnt_actfrcrange))
    own = driven & limited.astype(bool)  # of hinges and slides
    low[own], high[own] = np.maximum(low, bounds[:, 0])[own], np.minimum(high, bounds[:, 1])[own]
    return np.where(driven, low, -np.inf), np.where(driven, high, np.inf)


def _freedom(model: mujoco.MjModel, i: int) -> tuple[int, float] | None:
    """The one freedom that actuator ``i`` of a joint acts on, and its gear; None when it is not one."""
    joint = int(model.actuator_trnid[i, 0])
    scalar = int(model.jnt_type[joint]) in SCALAR
    if not scalar and model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINTINPARENT:
        return None  # axes of the parent's frame are none of the freedoms
    gears = model.actuator_gear[i, : int((model.dof_jntid == joint).sum())]
    axes = np.flatnonzero(gears)
    return (int(model.jnt_dofadr[joint] + axes[0]), float(gears[axes[0]])) if len(axes) == 1 else None


def unit_free_gains(inertia: Array, frequency: float, damping: float) -> tuple[Array, Array]:
    """kp = m w^2 and kd = 2 zeta m w (nv,) for w = 2 pi ``frequency`` [Hz]."""
    w = 2.0 * np.pi * frequency
    return inertia * w**2, 2.0 * damping * inertia * w
