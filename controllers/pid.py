"""PID along the keys: the derivative of the measurement is filtered, the integral knows when drives saturate.

tau = ff + Kp e + I + Kd (v_d - v_f),  dI/dt = Ki e + (sat(tau) - tau) / Tt,  dv_f/dt = (v - v_f) / Tf
K. J. Astrom, T. Hagglund: Advanced PID Control (2006), ch. 3.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.control import Target
from .drives import Drives
from .gains import Gain, choice, felt_inertia, per_joint, positive, unit_free_gains
from .nominal import Nominal, difference

Array = NDArray[np.float64]
_FEEDFORWARD = ("none", "gravity", "full")


class PIDMemory(NamedTuple):
    """Time [s] of the last sample (NaN before the first), integral part I (nv,), filtered velocity (nv,)."""

    t: float
    integral: Array
    velocity: Array


class PID:
    """PID on the degrees of freedom ``tracked`` (nv,) of ``model``.

    Gains follow from ``frequency`` [Hz] and ``damping`` as for PD, Ki = Kp w / 10; or ``kp`` [N m/rad,
    N/m], ``ki`` [N m/(rad s), N/(m s)], ``kd`` [N m s/rad, N s/m] are given (one number, or one a joint by
    name). ``filter`` [Hz] is the corner of the velocity filter
    (default: ten times ``frequency``). ``feedforward``: nothing, the weight at the target, or all forces that
    the target's motion needs. Beyond what its drives can give, less towards ``top_speed`` [rad/s, m/s], the
    integral runs back within ``windup`` [s] (default: the geometric mean of Ki/Kp and Kd/Kp times).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        top_speed: Gain | None = None,
        *,
        frequency: float = 5.0,
        damping: float = 1.0,
        kp: Gain | None = None,
        ki: Gain | None = None,
        kd: Gain | None = None,
        filter: float | None = None,
        feedforward: Literal["none", "gravity", "full"] = "gravity",
        windup: float | None = None,
    ) -> None:
        w = 2.0 * np.pi * positive("the PID law's frequency", frequency)
        positive("the PID law's damping", damping)
        choice("feedforward", feedforward, _FEEDFORWARD, "the PID law")
        self.model, self.tracked, self.feedforward = model, tracked, feedforward
        self.kp, self.kd = unit_free_gains(felt_inertia(model, q0), frequency, damping)
        if kp is not None:
            self.kp = per_joint(model, "the PID law's kp", kp, tracked=tracked)
        if kd is not None:
            self.kd = per_joint(model, "the PID law's kd", kd, tracked=tracked)
        self.ki = (
            self.kp * w / 10.0 if ki is None else per_joint(model, "the PID law's ki", ki, tracked=tracked)
        )
        corner = 10.0 * frequency if filter is None else positive("the PID law's filter", filter)
        self.lag = 1.0 / (2.0 * np.pi * corner)
        if windup is None:
            self.windup = np.sqrt(_ratio(self.kp, self.ki, 1.0) * _ratio(self.kd, self.kp, 0.1))
        else:
            self.windup = np.full(model.nv, positive("the PID law's windup", windup))
        self.drives = Drives(model, tracked, top_speed=top_speed)
        self.nominal = Nominal(model)

    def start(self) -> PIDMemory:
        """No integral yet; the velocity filter starts at the first measurement."""
        return PIDMemory(np.nan, np.zeros(self.model.nv), np.zeros(self.model.nv))

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: PIDMemory
    ) -> tuple[Array, PIDMemory]:
        """Joint forces (nv,) within the limits; see :class:`~pantograph.sim.control.Law`."""
        first = np.isnan(memory.t)
        dt = 0.0 if first else t - memory.t
        velocity = v if first else v + (memory.velocity - v) * np.exp(-dt / self.lag)
        error = difference(self.model, q, target.q)
        wanted = self._forward(target) + self.kp * error + memory.integral + self.kd * (target.v - velocity)
        tau = np.clip(wanted, *self.drives.at(v))
        # exact over a sample with error and excess held: the way back never overshoots
        back = 1.0 - np.exp(-dt / self.windup)
        integral = memory.integral + self.ki * error * dt + (tau - wanted) * back
        return np.where(self.tracked, tau, 0.0), PIDMemory(t, integral, velocity)

    def _forward(self, target: Target) -> Array:
        if self.feedforward == "full":
            return self.nominal.inverse(target.q, target.v, target.a)
        return self.nominal.weight(target.q) if self.feedforward == "gravity" else np.zeros(self.model.nv)


def _ratio(a: Array, b: Array, default: float) -> Array:
    """a / b where both are positive, else ``default`` seconds."""
    return np.divide(a, b, out=np.full_like(a, default), where=(a > 0) & (b > 0))
