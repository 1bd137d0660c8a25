"""Computed torque: the model's own inverse dynamics turn each joint into a double integrator.

tau = M(q) (a_d + Kp e + Kd e') + h(q, v)    (Siciliano et al. 2009, eq. 8.57)

With passive joints p beside the tracked ones t, their accelerations follow from those of the tracked:
a_p = -M_pp^-1 (M_pt a_t + h_p)    (M. W. Spong, Partial feedback linearization, IROS 1994)
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.clip import Clip
from ..sim.compile.cache import key_of, source
from ..sim.control import Target
from ..sim.dynamics.layout import Layout
from ..sim.dynamics.rigid import spatial
from ..sim.dynamics.tangent import difference as difference_of
from ..sim.dynamics.tangent import moved as moved_of
from ..sim.formula import Expressed, Formula, Symbols
from .gains import positive
from .nominal import Nominal, difference, differences, moved
from .preview import Preview

Array = NDArray[np.float64]


class ComputedTorque:
    """Inverse dynamics on the freedoms ``tracked`` (nv,); ``keyed`` ones (nv,) move as their keys say.

    The closed loop has ``frequency`` [Hz] and ``damping``, its poles placed in discrete time for a force held
    over ``period`` [s], so that any frequency is stable. The force is that of the middle of the period, where
    the target of ``clip`` will be: a held force then errs by the square of the period, not by the period.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        clip: Clip,
        period: float,
        duration: float,
        keyed: NDArray[np.bool_],
        *,
        frequency: float = 8.0,
        damping: float = 1.0,
    ) -> None:
        positive("the computed-torque law's frequency", frequency)
        positive("the computed-torque law's damping", damping)
        self.model, self.tracked, self.period = model, tracked, period
        self.preview = Preview(clip, period, duration)
        self.passive = ~tracked & ~keyed
        self.keyed = keyed
        self._all, self._any_passive = bool(tracked.all()), bool(self.passive.any())
        self.kp, self.kd = held_gains(2.0 * np.pi * frequency, damping, period)
        self.nominal = Nominal(model)

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        m = self.model
        middle = self.preview.at(t, target)
        error, rate = difference(m, q, target.q), target.v - v
        a = middle.a + self.kp * error + self.kd * rate
        if not self._all:
            a = np.where(self.tracked, a, np.where(self.keyed, middle.a, 0.0))
        q_mid = moved(m, q, difference(m, target.q, middle.q))
        v_mid = v + middle.v - target.v
        if self._any_passive:
            q_mid = np.asarray(self._with_passive(q_mid, q, v))
            bias, inertia = self.nominal.inverse(q_mid, v_mid, a), self.nominal.mass_matrix(q_mid)
            p = self.passive
            a[p] = np.linalg.solve(inertia[np.ix_(p, p)], -bias[p])
        tau = self.nominal.inverse(q_mid, v_mid, a)
        return tau if self._all else np.where(self.tracked, tau, 0.0), None

    def formula(self, period: float) -> Formula | None:
        """See :class:`~pantograph.sim.formula.Formula`; None for a model that expressions do not know."""
        m, nq, nv = self.model, self.model.nq, self.model.nv
        blocks = Layout(m).blocks
        if not self.nominal.compiled:
            return None

        def rows(first: int, now: Target) -> Array:
            middle = self.preview.ahead(first, len(now.q))
            return np.hstack([now.q, now.v, differences(m, now.q, middle.q), middle.v, middle.a])

        def express(q: Symbols, v: Symbols, row: Symbols, gains: Symbols, _: Symbols) -> Expressed:
            q_d, (v_d, way, v_m, a_m) = row[:nq], (row[nq + k * nv : nq + (k + 1) * nv] for k in range(4))
            error, rate = difference_of(blocks, q, q_d), spatial.sub(v_d, v)
            kp, kd, half = gains
            a = [
                x + kp * e + kd * r if on else x
                for x, e, r, on in zip(a_m, error, rate, self.tracked, strict=True)
            ]
            way = [half * x if free else w for x, w, free in zip(v, way, self.passive, strict=True)]
            v_mid = [x + (b - c) for x, b, c in zip(v, v_m, v_d, strict=True)]
            passive = self.passive if self._any_passive else None
            return self.nominal.express(moved_of(blocks, q, way), v_mid, a, passive), ()

        return Formula(
            key=key_of(source(__file__), self.nominal.key, np.array([self.tracked, self.passive]).tobytes()),
            gains=np.array([self.kp, self.kd, 0.5 * self.period]),
            width=nq + 4 * nv,
            rows=rows,
            express=express,
        )

    def _with_passive(self, q_mid: Array, q: Array, v: Array) -> Array:
        """``q_mid`` with passive joints carried on by their own velocity."""
        step = np.where(self.passive, 0.5 * self.period * v, difference(self.model, q, q_mid))
        return moved(self.model, q, step)


def held_gains(w: float, damping: float, period: float) -> tuple[float, float]:
    """kp [1/s^2] and kd [1/s] of a double integrator whose input is held over ``period`` [s], with the poles
    exp(s T) of s^2 + 2 zeta w s + w^2 = 0.

    From e+ = e + T e' + T^2/2 u, e'+ = e' + T u, u = -kp e - kd e': the sum of the poles is
    2 - kp T^2/2 - kd T, their product 1 + kp T^2/2 - kd T.
    """
    root = np.sqrt(complex(damping**2 - 1.0))
    p1, p2 = np.exp((-damping + root) * w * period), np.exp((-damping - root) * w * period)
    total, product = float((p1 + p2).real), float((p1 * p2).real)
    return (1.0 - total + product) / period**2, (3.0 - total - product) / (2.0 * period)
