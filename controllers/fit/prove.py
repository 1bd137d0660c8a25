"""A fitted motion tried: simulated by MuJoCo under a law, its forces cut at what the drives can give."""

from __future__ import annotations

import copy
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.control import Target
from ..lqr import LQR
from ..nominal import difference
from .contact import places, touching
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


def prove(
    fitted: Fitted, machine: Machine, *, period: float | None = None, steps: int | None = None
) -> Proof:
    """Simulate the clip from its start, the law sampled every ``period`` [s] (default: 2 ms, with contacts
    0.5 ms), ``steps`` steps each; contacts and limits are the model's own.

    The law is LQR along the clip. With contacts, of which LQR's mechanism does not know, it is the fitted
    forces and a servo at each driven joint.
    """
    clip = fitted.clip
    period = period or (0.0005 if fitted.phases else 0.002)
    steps = steps or (1 if fitted.phases else 4)
    m = copy.copy(clip.model)
    m.actuator_gainprm[:] = 0.0
    m.actuator_biasprm[:] = 0.0
    m.opt.timestep = period / steps
    m.opt.integrator = int(mujoco.mjtIntegrator.mjINT_RK4)
    if fitted.phases:
        m.opt.integrator = int(mujoco.mjtIntegrator.mjINT_IMPLICITFAST)
    d = mujoco.MjData(m)
    start, end = clip.start, clip.end
    ticks = round((end - start) / period)
    law = _Servo(fitted, machine, period) if fitted.phases else _lqr(fitted, machine, period)
    d.qpos[:], d.qvel[:], _ = clip.evaluate(start)
    rows, errors, cut = [], [], 0
    for k in range(ticks):
        t = start + k * period
        target = Target(*clip.evaluate(t))
        rows.append(d.qpos.copy())
        errors.append(difference(m, d.qpos, target.q))
        tau, _ = law(t, d.qpos.copy(), d.qvel.copy(), target, None)
        given = given_by(machine, tau, d.qvel)
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


def given_by(machine: Machine, tau: Array, v: Array) -> Array:
    """What drives give of forces tau (nv,) at velocities v (nv,): less the faster they turn, and together no
    more than the battery does."""
    low, high = machine.force_low.copy(), machine.force_high.copy()
    for force, way in ((low, -1.0), (high, 1.0)):
        limited = np.isfinite(force)
        force[limited] *= np.maximum(1.0 - np.maximum(way * v, 0.0) / machine.top_speed, 0.0)[limited]
    given = np.clip(tau, low, high)
    draw = float(np.abs(given) @ machine.ampere)
    return given * min(1.0, machine.current / draw) if draw > 0.0 else given


def _lqr(fitted: Fitted, machine: Machine, period: float) -> LQR:
    clip, keyed = fitted.clip, np.zeros(machine.model.nv, dtype=bool)
    return LQR(machine.model, machine.driven, clip.q0, clip, period, clip.end, keyed)


class _Servo:
    """The fitted forces, and a servo of ``frequency`` [Hz] on what each driven joint feels at the time."""

    def __init__(self, fitted: Fitted, machine: Machine, period: float, *, frequency: float = 5.0) -> None:
        self.fitted, self.driven, self.w = fitted, machine.driven, 2.0 * np.pi * frequency
        model, t = machine.model, fitted.t
        q = fitted.clip.evaluate(t).q
        _, J = places(model, fitted.sites, q)
        on = np.stack([touching(fitted.phases, s, t) for s in fitted.sites], axis=1)
        self.felt, self.most = np.empty((len(t), model.nv)), np.empty((len(t), model.nv))
        for i in range(len(t)):
            # accelerations by forces where resting sites hold: M^-1 - M^-1 J' (J M^-1 J')^-1 J M^-1
            inverse = np.linalg.inv(machine.nominal.mass_matrix(q[i]))
            rows = J[i][np.repeat(on[i], 3)]
            ways = inverse @ rows.T
            free = inverse - ways @ np.linalg.pinv(rows @ ways, rcond=1e-8) @ ways.T
            self.felt[i] = 1.0 / np.maximum(np.diag(free), 1e-3 * np.diag(inverse))
            # a foot may come off: damping of what then moves must not swing up from sample to sample
            self.most[i] = 0.5 / np.diag(inverse) / period

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,)."""
        k = max(int(np.searchsorted(self.fitted.t, t, side="right")) - 1, 0)
        kp = self.felt[k] * self.w**2
        kd = np.minimum(2.0 * kp / self.w, self.most[k])
        error = difference(self.fitted.clip.model, q, target.q)
        tau = self.fitted.drives(t) + kp * error + kd * (target.v - v)
        return np.where(self.driven, tau, 0.0), None
