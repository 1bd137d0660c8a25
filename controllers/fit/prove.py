"""A fitted motion tried: simulated by MuJoCo under LQR, its forces cut at the machine's limits."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.control import Target
from ..lqr import LQR
from ..nominal import difference
from .fitted import Fitted
from .machine import Machine

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Proof:
    """A simulated run of a fitted motion: t (n,) [s], q (n, nq), ``error`` (n, nv), its largest ``worst``
    [rad, m], and the part of samples ``saturated``, where a drive gave all it could."""

    t: Array
    q: Array
    error: Array
    worst: float
    saturated: float


def prove(fitted: Fitted, machine: Machine, *, period: float = 0.002, steps: int = 4) -> Proof:
    """Simulate the clip from its start under LQR along it; contacts and limits are the model's own."""
    clip, driven = fitted.clip, machine.driven
    m = copy.copy(clip.model)
    m.actuator_gainprm[:] = 0.0
    m.actuator_biasprm[:] = 0.0
    m.opt.timestep, m.opt.integrator = period / steps, int(mujoco.mjtIntegrator.mjINT_RK4)
    d = mujoco.MjData(m)
    start, end = clip.start, clip.end
    keyed = np.zeros(m.nv, dtype=bool)
    ticks = round((end - start) / period)
    law = LQR(machine.model, driven, clip.q0, clip, period, end, keyed)
    d.qpos[:], d.qvel[:], _ = clip.evaluate(start)
    rows, errors, cut = [], [], 0
    for k in range(ticks):
        t = start + k * period
        target = Target(*clip.evaluate(t))
        rows.append(d.qpos.copy())
        errors.append(difference(m, d.qpos, target.q))
        tau, _ = law(t, d.qpos.copy(), d.qvel.copy(), target, None)
        given = np.clip(tau, machine.force_low, machine.force_high)
        cut += bool(np.any(given != tau))
        d.qfrc_applied[:] = given
        mujoco.mj_step(m, d, steps)
    error = np.array(errors)
    worst = float(np.abs(error).max()) if np.isfinite(error).all() else np.inf
    return Proof(
        np.asarray(start + period * np.arange(ticks), dtype=np.float64),
        np.array(rows),
        error,
        worst,
        cut / max(ticks, 1),
    )
