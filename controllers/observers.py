"""Observers: velocities, and better positions, when only servo positions are measured.

R. E. Kalman, J. Basic Engineering 82 (1960); B. D. O. Anderson, J. B. Moore, Optimal Filtering (1979).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.control import Target
from ..sim.integrate.tableaus import RK4
from .design.linear import held_matrices, linearise_path
from .gains import Gain, per_joint, positive
from .nominal import Nominal, difference, moved

Array = NDArray[np.float64]
Way = tuple[Target, Target, Target]  # where keyed joints are at the beginning, middle and end of a sample


class Estimate(NamedTuple):
    """Time [s] (NaN before the first measurement), q (nq,), v (nv,); P (2 n, 2 n): covariance of the
    n freedoms that are not keyed, if kept; and where keyed joints were told to be."""

    t: float
    q: Array
    v: Array
    P: Array | None = None
    told: Target | None = None


class Observer(Protocol):
    """Estimates the state from measured positions and the forces applied since the last measurement."""

    def start(self) -> Any:
        """Memory before the first measurement."""
        ...

    def update(self, memory: Any, t: float, y: Array, tau: Array, told: Target | None = None) -> Any:
        """The memory, which has q and v, after positions ``y`` (nq,) measured at ``t`` [s], with joint forces
        ``tau`` (nv,) commanded since the last measurement; ``told``: where keyed joints are now."""
        ...


class VelocityFilter:
    """Velocity as the filtered difference of positions, first order with ``corner`` [Hz]; no model needed."""

    def __init__(self, model: mujoco.MjModel, q0: Array, *, corner: float = 30.0) -> None:
        self.model, self.q0 = model, q0
        self.lag = 1.0 / (2.0 * np.pi * positive("the velocity filter's corner", corner))

    def start(self) -> Estimate:
        """At rest, wherever the first measurement is."""
        return Estimate(np.nan, self.q0, np.zeros(self.model.nv))

    def update(
        self, memory: Estimate, t: float, y: Array, tau: Array, told: Target | None = None
    ) -> Estimate:
        """See :class:`Observer`."""
        if np.isnan(memory.t):
            return Estimate(t, y, memory.v)
        dt = t - memory.t
        if dt <= 0.0:
            return memory
        measured = difference(self.model, memory.q, y) / dt
        return Estimate(t, y, measured + (memory.v - measured) * np.exp(-dt / self.lag))


class Kalman:
    """Kalman filter about the model's motion; extended: predicted and linearised at the estimate itself.

    ``noise`` [rad, m]: standard deviation of measured positions; ``push`` [rad/s^2, m/s^2]: of the
    accelerations that the model does not know, held over a sample; one number, one a joint by name, or (nv,).
    With ``extended`` false the model is linearised once, at rest at ``q0``. Tracked and passive joints alike
    are estimated; ``keyed`` ones (nv,) are where they are told to be, and move the others as they do.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        q0: Array,
        keyed: NDArray[np.bool_] | None = None,
        *,
        noise: Gain = 1e-3,
        push: Gain = 5.0,
        extended: bool = True,
    ) -> None:
        self.model, self.q0, self.extended = model, q0, extended
        self.keyed = np.zeros(model.nv, dtype=bool) if keyed is None else keyed
        self.free = ~self.keyed
        self.noise, self.push = (
            per_joint(model, what, x, missing=missing, zero=False)[self.free]
            for what, x, missing in (
                ("the Kalman filter's noise", noise, 1e-3),
                ("the Kalman filter's push", push, 5.0),
            )
        )
        self.nominal = Nominal(model)

    @cached_property
    def _rest(self) -> tuple[Array, Array, Array]:
        """A, B of the model at rest at q0, and the forces (nv,) that hold it there."""
        still = np.zeros((1, self.model.nv))
        tau = self.nominal.weight(self.q0)
        A, B = linearise_path(self.nominal, self.q0[None], still, still, tau[None], keyed=self.keyed)
        return A[0], B[0], tau

    def start(self) -> Estimate:
        """Wherever the first measurement is, velocities unknown to 1 rad/s or m/s."""
        P = np.diag(np.concatenate([self.noise**2, np.ones(len(self.noise))]))
        return Estimate(np.nan, self.q0, np.zeros(self.model.nv), P)

    def update(
        self, memory: Estimate, t: float, y: Array, tau: Array, told: Target | None = None
    ) -> Estimate:
        """See :class:`Observer`."""
        if np.isnan(memory.t):
            return Estimate(t, *self._placed(y, memory.v, told), memory.P, told)
        n, dt = len(self.noise), t - memory.t
        if dt <= 0.0:
            return memory
        q, v, A = self._predict(memory, tau, dt, told)
        kick = np.vstack([np.diag(0.5 * dt * dt * self.push), np.diag(dt * self.push)])
        assert memory.P is not None
        P = A @ memory.P @ A.T + kick @ kick.T
        # update in Joseph's form; positions are measured, so C = (I 0)
        R = np.diag(self.noise**2)
        L = np.linalg.solve(P[:n, :n] + R, P[:n]).T
        dx = L @ difference(self.model, q, y)[self.free]
        keep = np.eye(2 * n)
        keep[:, :n] -= L
        P = keep @ P @ keep.T + L @ R @ L.T
        step = np.zeros((2, self.model.nv))
        step[:, self.free] = dx.reshape(2, n)
        return Estimate(t, moved(self.model, q, step[0]), v + step[1], P, told)

    def _predict(
        self, memory: Estimate, tau: Array, dt: float, told: Target | None
    ) -> tuple[Array, Array, Array]:
        """State after ``dt`` [s] and the derivative of it by the state before, in the tangent space."""
        way = _told(self.model, memory.told or told, told, dt)
        if not self.extended:
            return self._about_rest(memory, tau, dt, way)
        q, v = self._advance(memory.q, memory.v, tau, dt, way)
        middle = moved(self.model, memory.q, 0.5 * difference(self.model, memory.q, q))
        a = np.zeros(self.model.nv) if way is None else np.where(self.keyed, way[1].a, 0.0)
        rows = (middle[None], 0.5 * (memory.v + v)[None], a[None], tau[None])
        A, B = linearise_path(self.nominal, *rows, keyed=self.keyed)
        return q, v, held_matrices(A[0], B[0], dt)[0]

    def _about_rest(
        self, memory: Estimate, tau: Array, dt: float, way: Way | None
    ) -> tuple[Array, Array, Array]:
        """By the model at rest, with the accelerations that keyed joints give it there as one more input."""
        A, B, held = self._rest
        n, u = len(self.noise), (tau - held)[self.free]
        A, B = held_matrices(A, np.hstack([B, np.vstack([np.zeros((n, n)), np.eye(n)])]), dt)
        pulled = self._rate(self.q0, np.zeros(self.model.nv), held, way and way[1])
        x = np.concatenate([difference(self.model, self.q0, memory.q)[self.free], memory.v[self.free]])
        x = A @ x + B @ np.concatenate([u, pulled[self.free]])
        dq, v = np.zeros(self.model.nv), np.zeros(self.model.nv)
        dq[self.free], v[self.free] = x[:n], x[n:]
        return *self._placed(moved(self.model, self.q0, dq), v, way and way[2]), A

    def _advance(self, q: Array, v: Array, tau: Array, dt: float, way: Way | None) -> tuple[Array, Array]:
        """State after ``dt`` [s] under held joint forces, by RK4 on the manifold."""
        m = self.model
        rates: list[tuple[Array, Array]] = []
        for row, at in zip((*RK4.A, RK4.b), (0, 1, 1, 2, 2), strict=True):
            dq = sum((c * r[0] for c, r in zip(row, rates, strict=False)), np.zeros(m.nv))
            dv = sum((c * r[1] for c, r in zip(row, rates, strict=False)), np.zeros(m.nv))
            qi, vi = self._placed(moved(m, q, dt * dq), v + dt * dv, way and way[at])
            if len(rates) < 4:
                rates.append((vi, self._rate(qi, vi, tau, way and way[at])))
        return qi, vi

    def _placed(self, q: Array, v: Array, told: Target | None) -> tuple[Array, Array]:
        """A state with keyed joints where they are told to be."""
        if told is None:
            return q, v
        lay, q = self.nominal.smooth_with(self.keyed).layout, q.copy()
        q[lay.q_keyed] = told.q[lay.q_keyed]
        return q, np.where(self.keyed, told.v, v)

    def _rate(self, q: Array, v: Array, tau: Array, told: Target | None) -> Array:
        """Accelerations (nv,)."""
        smooth = self.nominal.smooth_with(self.keyed)
        if told is None:
            return smooth.forward(q, v, tau=tau)
        lay, out = smooth.layout, np.where(self.keyed, told.a, 0.0)
        w = np.concatenate([told.q[lay.q_keyed], told.v[lay.v_keyed], told.a[lay.v_keyed]])
        out[self.free] = smooth.forward(q[lay.q_free], v[self.free], tau=tau[self.free], w=w)
        return out


def _told(model: mujoco.MjModel, before: Target | None, now: Target | None, dt: float) -> Way | None:
    """Where keyed joints are at the beginning, the middle and the end of a sample: between two targets
    accelerations change evenly."""
    if before is None or now is None:
        return None
    by = 0.5 * dt * before.v + dt * dt / 48.0 * (5.0 * before.a + now.a)
    middle = Target(
        moved(model, before.q, by),
        before.v + dt / 8.0 * (3.0 * before.a + now.a),
        0.5 * (before.a + now.a),
    )
    return before, middle, now
