"""PID along the keys: the derivative of the measurement is filtered, the integral knows when drives saturate.

tau = ff + Kp e + I + Kd (v_d - v_f),  dI/dt = Ki e + (sat(tau) - tau) / Tt,  dv_f/dt = (v - v_f) / Tf
K. J. Astrom, T. Hagglund: Advanced PID Control (2006), ch. 3.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.compile.cache import key_of, source
from ..sim.compile.graph import Scalar
from ..sim.control import Target
from ..sim.dynamics.layout import Layout
from ..sim.dynamics.tangent import difference as difference_of
from ..sim.formula import Expressed, Formula, Symbols
from .drives import Drives
from .gains import (
    Gain,
    choice,
    coupling,
    falling_stiffness,
    felt_inertia,
    per_joint,
    positive,
    unit_free_gains,
)
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

    Gains follow from ``frequency`` [Hz] and ``damping`` as for PD: Kp = m w^2 and as much more as the weight
    pulls away from ``q0``, for it is compensated at the target only; Ki = m w^3 / 10, less where joints
    drag each other along so much that it would not be stable. Or ``kp`` [N m/rad, N/m], ``ki`` [N m/(rad s),
    N/(m s)], ``kd`` [N m s/rad, N s/m] are given: one number, or one a joint by name, where joints that are
    not named have what "" is given, or these. ``filter`` [Hz] is the corner of the velocity filter (default:
    ten times ``frequency``). ``feedforward``: nothing, the weight at the target, or all forces that the
    target's motion needs. Beyond what its drives can give, less towards ``top_speed`` [rad/s, m/s], the
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
        kp, ki, kd = ({} if gain is None else gain for gain in (kp, ki, kd))
        inertia, falls = felt_inertia(model, q0), falling_stiffness(model, q0, tracked)
        own, own_kd = unit_free_gains(inertia, frequency, damping)
        self.kp = per_joint(model, "the PID law's kp", kp, missing=own + falls, tracked=tracked)
        # half of what Routh allows a motion of all joints together: m s^3 + kd s^2 + kp s + ki
        rate = w * min(0.1, damping / coupling(model, q0, tracked))
        own = rate * np.maximum(self.kp - falls, 0.0)
        self.ki = per_joint(model, "the PID law's ki", ki, missing=own, tracked=tracked)
        self.kd = per_joint(model, "the PID law's kd", kd, missing=own_kd, tracked=tracked)
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

    def formula(self, period: float) -> Formula:
        """See :class:`~pantograph.sim.formula.Formula`."""
        m, nq, nv, drives = self.model, self.model.nq, self.model.nv, self.drives
        blocks = Layout(m).blocks
        fade, back = np.exp(-period / self.lag), 1.0 - np.exp(-period / self.windup)
        gains = [self.kp, self.kd, self.ki * period, back, np.full(nv, fade)]

        def rows(first: int, now: Target) -> Array:
            return np.hstack([now.q, now.v, self._forwards(now)])

        def express(q: Symbols, v: Symbols, row: Symbols, gains: Symbols, memory: Symbols) -> Expressed:
            error, v_d, forward = difference_of(blocks, q, row[:nq]), row[nq : nq + nv], row[nq + nv :]
            kp, kd, ki, back, fade = (gains[k * nv : (k + 1) * nv] for k in range(5))
            later, integral, velocity = memory[0], list(memory[1 : 1 + nv]), list(memory[1 + nv :])
            tau: list[Scalar] = []
            for i in range(nv):
                velocity[i] = v[i] + later * fade[i] * (velocity[i] - v[i])
                wanted = forward[i] + kp[i] * error[i] + integral[i] + kd[i] * (v_d[i] - velocity[i])
                tau.append(drives.express(i, wanted, v[i]))
                change = ki[i] * error[i] + (tau[i] - wanted) * back[i]
                integral[i] = integral[i] + later * change
            return tau, [1.0, *integral, *velocity]

        def unpack(t: float, memory: Array) -> PIDMemory:
            return PIDMemory(t if memory[0] else np.nan, memory[1 : 1 + nv], memory[1 + nv :])

        return Formula(
            key=key_of(source(__file__), repr(blocks), drives.key),
            gains=np.concatenate(gains),
            width=nq + 2 * nv,
            rows=rows,
            express=express,
            pack=lambda last: np.concatenate([[not np.isnan(last.t)], last.integral, last.velocity]),
            unpack=unpack,
        )

    def _forwards(self, now: Target) -> Array:
        """Feedforward (n, nv) at n targets."""
        if self.feedforward != "none" and self.nominal.compiled:
            full = self.feedforward == "full"
            v, a = (now.v, now.a) if full else (np.zeros_like(now.v), np.zeros_like(now.a))
            return self.nominal.smooth.inverse(now.q, v, a)
        return np.array([self._forward(Target(*row)) for row in zip(*now, strict=True)])

    def _forward(self, target: Target) -> Array:
        if self.feedforward == "full":
            return self.nominal.inverse(target.q, target.v, target.a)
        return self.nominal.weight(target.q) if self.feedforward == "gravity" else np.zeros(self.model.nv)


def _ratio(a: Array, b: Array, default: float) -> Array:
    """a / b where both are positive, else ``default`` seconds."""
    return np.divide(a, b, out=np.full_like(a, default), where=(a > 0) & (b > 0))
