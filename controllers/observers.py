"""Observers: velocities, and better positions, when only servo positions are measured.

R. E. Kalman, J. Basic Engineering 82 (1960); B. D. O. Anderson, J. B. Moore, Optimal Filtering (1979).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.integrate.tableaus import RK4
from .design.linear import held_matrices, linearise_path
from .gains import positive
from .nominal import Nominal, difference, moved

Array = NDArray[np.float64]


class Estimate(NamedTuple):
    """Time [s] (NaN before the first measurement), q (nq,), v (nv,); P (2 nv, 2 nv): covariance, if kept."""

    t: float
    q: Array
    v: Array
    P: Array | None = None


class Observer(Protocol):
    """Estimates the state from measured positions and the forces applied since the last measurement."""

    def start(self) -> Any:
        """Memory before the first measurement."""
        ...

    def update(self, memory: Any, t: float, y: Array, tau: Array) -> Any:
        """The memory, which has q and v, after positions ``y`` (nq,) measured at ``t`` [s], with joint forces
        ``tau`` (nv,) held since the last measurement."""
        ...


class VelocityFilter:
    """Velocity as the filtered difference of positions, first order with ``corner`` [Hz]; no model needed."""

    def __init__(self, model: mujoco.MjModel, q0: Array, *, corner: float = 30.0) -> None:
        self.model, self.q0 = model, q0
        self.lag = 1.0 / (2.0 * np.pi * positive("the velocity filter's corner", corner))

    def start(self) -> Estimate:
        """At rest, wherever the first measurement is."""
        return Estimate(np.nan, self.q0, np.zeros(self.model.nv))

    def update(self, memory: Estimate, t: float, y: Array, tau: Array) -> Estimate:
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
    accelerations that the model does not know, held over a sample. With ``extended`` false the model is
    linearised once, at rest at ``q0``. Tracked and passive joints alike are estimated.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        q0: Array,
        *,
        noise: float = 1e-3,
        push: float = 5.0,
        extended: bool = True,
    ) -> None:
        self.model, self.q0, self.extended = model, q0, extended
        self.noise = positive("the Kalman filter's noise", noise)
        self.push = positive("the Kalman filter's push", push)
        self.nominal = Nominal(model)

    @cached_property
    def _rest(self) -> tuple[Array, Array, Array]:
        """A, B of the model at rest at q0, and the forces that hold it there."""
        still = np.zeros((1, self.model.nv))
        tau = self.nominal.weight(self.q0)
        A, B = linearise_path(self.nominal, self.q0[None], still, still, tau[None])
        return A[0], B[0], tau

    def start(self) -> Estimate:
        """Wherever the first measurement is, velocities unknown to 1 rad/s or m/s."""
        n = self.model.nv
        P = np.diag(np.concatenate([np.full(n, self.noise**2), np.ones(n)]))
        return Estimate(np.nan, self.q0, np.zeros(n), P)

    def update(self, memory: Estimate, t: float, y: Array, tau: Array) -> Estimate:
        """See :class:`Observer`."""
        if np.isnan(memory.t):
            return Estimate(t, y, memory.v, memory.P)
        n, dt = self.model.nv, t - memory.t
        if dt <= 0.0:
            return memory
        q, v, A = self._predict(memory, tau, dt)
        unit = np.concatenate([np.full(n, 0.5 * dt * dt), np.full(n, dt)])
        kick = np.vstack([np.diag(unit[:n]), np.diag(unit[n:])])
        assert memory.P is not None
        P = A @ memory.P @ A.T + self.push**2 * kick @ kick.T
        # update in Joseph's form; positions are measured, so C = (I 0)
        S = P[:n, :n] + self.noise**2 * np.eye(n)
        L = np.linalg.solve(S, P[:n]).T
        dx = L @ difference(self.model, q, y)
        keep = np.eye(2 * n)
        keep[:, :n] -= L
        P = keep @ P @ keep.T + self.noise**2 * L @ L.T
        return Estimate(t, moved(self.model, q, dx[:n]), v + dx[n:], P)

    def _predict(self, memory: Estimate, tau: Array, dt: float) -> tuple[Array, Array, Array]:
        """State after ``dt`` [s] and the derivative of it by the state before, in the tangent space."""
        n = self.model.nv
        if not self.extended:
            A, B, held = self._rest
            A, B = held_matrices(A, B, dt)
            x = np.concatenate([difference(self.model, self.q0, memory.q), memory.v])
            x = A @ x + B @ (tau - held)
            return moved(self.model, self.q0, x[:n]), x[n:], A
        q, v = _advance(self.nominal, memory.q, memory.v, tau, dt)
        middle = moved(self.model, memory.q, 0.5 * difference(self.model, memory.q, q))
        rows = (middle[None], 0.5 * (memory.v + v)[None], np.zeros((1, n)), tau[None])
        A, B = linearise_path(self.nominal, *rows)
        return q, v, held_matrices(A[0], B[0], dt)[0]


def _advance(nominal: Nominal, q: Array, v: Array, tau: Array, dt: float) -> tuple[Array, Array]:
    """State after ``dt`` [s] under held joint forces, by RK4 on the manifold."""
    smooth, m = nominal.smooth, nominal.model
    rates: list[tuple[Array, Array]] = []
    for row in RK4.A:
        dq = sum((c * r[0] for c, r in zip(row, rates, strict=False)), np.zeros(m.nv))
        dv = sum((c * r[1] for c, r in zip(row, rates, strict=False)), np.zeros(m.nv))
        vi = v + dt * dv
        rates.append((vi, smooth.forward(moved(m, q, dt * dq), vi, tau=tau)))
    dq = sum((b * r[0] for b, r in zip(RK4.b, rates, strict=True)), np.zeros(m.nv))
    dv = sum((b * r[1] for b, r in zip(RK4.b, rates, strict=True)), np.zeros(m.nv))
    return moved(m, q, dt * dq), v + dt * dv
