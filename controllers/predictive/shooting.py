"""Better plans by shooting: Gauss-Newton steps of differential dynamic programming with bounded forces.

Y. Tassa, N. Mansard, E. Todorov, Control-limited differential dynamic programming, ICRA 2014.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim.compile.program import Bound
from ...sim.dynamics.smooth import Smooth
from ..drives import at_speed, by_speed
from .bounded import bounded_minimum
from .coordinates import Coordinates
from .following import Following

Array = NDArray[np.float64]
_RETRIES = 3  # more cautious tries, where a step does not help
_SHARES = np.array([1.0, 0.5, 0.2, 0.05])[:, None, None]  # of a step, tried side by side


@dataclass(frozen=True, eq=False)
class Horizon:
    """References of a prediction: x (n + 1, nq + nv), u (n, m), the lengths h (n,) [s] of its steps, and the
    prescribed motion w (n, 3, nw) at the beginning, in the middle and at the end of each.

    Steps end on a grid that does not move with time, so that a plan goes on unchanged from sample to sample;
    the first step is what is left of the one in progress.
    """

    x: Array
    u: Array
    h: Array
    w: Array


class Plan(NamedTuple):
    """States x (n + 1, nq + nv), forces u (n, m), gains K (n, m, 2 nv) that keep to them, and the cost."""

    x: Array
    u: Array
    K: Array
    cost: float


@dataclass(frozen=True, eq=False)
class Weights:
    """Cost of a step of full length: Q (2 nv,), R (m,), ``final`` (2 nv, 2 nv) at the end, ``soft`` (nv,) on
    what is beyond q_low, q_high (nv,); the bounds low, high (m,) of forces at rest, and the speeds ``top``
    (m,) at which motors give nothing more, infinite where there is none."""

    Q: Array
    R: Array
    final: Array
    soft: Array
    q_low: Array
    q_high: Array
    low: Array
    high: Array
    top: Array


class Shooting:
    """Predictions of ``smooth`` by RK4 in steps of ``step`` [s], forces on its freedoms ``inputs`` (m,).

    ``pushed`` is the same model with joint forces (nv,) as its last controls.
    """

    def __init__(
        self, smooth: Smooth, pushed: Smooth, inputs: NDArray[np.intp], step: float, weights: Weights
    ) -> None:
        self.pushed = pushed
        self.smooth, self.inputs, self.step, self.weights = smooth, inputs, step, weights
        self.coordinates, self.nq, self.nv = Coordinates(smooth.layout), smooth.layout.nq, smooth.layout.nv
        self.slow = bool(np.isfinite(weights.top).any())

    def able(self, x: Array) -> tuple[Array, Array]:
        """Least and greatest forces (..., m) at states x (..., nq + nv)."""
        c = self.weights
        return at_speed(c.low, c.high, c.top, x[..., self.nq + self.inputs]) if self.slow else (c.low, c.high)

    def away(self, x: Array, ref: Array) -> Array:
        """Deviations (..., 2 nv) of states x (..., nq + nv) from ``ref``."""
        if not self.coordinates.turning:
            return np.asarray(x - ref)
        nq = self.nq
        dq = self.coordinates.minus(x[..., :nq], ref[..., :nq])
        return np.concatenate([dq, x[..., nq:] - ref[..., nq:]], axis=-1)

    def begin(self, x: Array, u: Array, ref: Horizon) -> Plan:
        """The plan of forces u (n, m), as far as the drives give them, from x (nq + nv,) on, with nothing to
        keep to it."""
        K = np.zeros((*u.shape, 2 * self.nv))
        path, u = self.follow(x, Plan(ref.x, u, K, np.inf), ref)
        return Plan(path, u, K, float(self.cost(path, u, ref)))

    def follow(self, x: Array, plan: Plan, ref: Horizon, change: Array | float = 0.0) -> tuple[Array, Array]:
        """States (..., n + 1, nq + nv) and forces (..., n, m) from x (nq + nv,) on that keep to a plan with
        ``change`` (..., n, m) added to its forces, within their bounds."""
        c, (n, m), nq = self.weights, plan.u.shape, self.nq
        wanted = plan.u + change
        lead = wanted.shape[:-2]
        kept = np.concatenate([plan.x[:n], np.zeros((n, m)), plan.K.reshape(n, -1)], axis=1)
        rows = np.broadcast_to(kept, (*lead, *kept.shape)).copy()
        rows[..., len(x) : len(x) + m] = wanted
        motors, states = np.concatenate([c.low, c.high, 1.0 / c.top]), np.broadcast_to(x, (*lead, len(x)))
        inputs, X, U = tuple(self.inputs.tolist()), [states[..., None, :]], []
        # the first step is what is left of one in progress
        for steps, h in ((slice(0, 1), ref.h[0]), (slice(1, n), self.step)):
            if (count := steps.stop - steps.start) == 0:
                break
            law = Following(inputs, rows[..., steps, :], motors)
            w = ref.w[steps][:, (0, 1, 1, 2)].reshape(4 * count, -1) if ref.w.shape[2] else None
            path = self.pushed.rollout(states[..., :nq], states[..., nq:], law, step=h, steps=count, w=w)
            X.append(np.concatenate([path.q, path.v], axis=-1)[..., 1:, :])
            U.append(path.u[..., self.pushed.layout.nu - self.nv + self.inputs])
            states = X[-1][..., -1, :]
        return np.concatenate(X, axis=-2), np.concatenate(U, axis=-2)

    def cost(self, x: Array, u: Array, ref: Horizon) -> Array:
        """Costs (...,) of states (..., n + 1, nq + nv) and forces (..., n, m)."""
        c, du = self.weights, u - ref.u
        beyond, share = self._beyond(x), ref.h / self.step
        with np.errstate(over="ignore", invalid="ignore"):  # a plan that flies off costs infinitely much
            dx = self.away(x, ref.x)
            last = dx[..., -1, :]
            total = (dx[..., :-1, :] ** 2 @ c.Q + du**2 @ c.R) @ share + np.sum(beyond**2 @ c.soft, axis=-1)
            total += np.sum(last @ c.final * last, axis=-1)
            return np.where(np.isfinite(total), total, np.inf)

    def _beyond(self, x: Array) -> Array:
        """How far scalar joints are beyond their ranges, (..., nv), with its sign."""
        q, c = self.coordinates.positions(x[..., : self.nq]), self.weights
        return np.asarray(np.maximum(q - c.q_high, 0.0) - np.maximum(c.q_low - q, 0.0))

    def improve(self, plan: Plan, ref: Horizon, iterations: int) -> Plan:
        """A better plan. Stops early when nothing is left to gain."""
        damping, done, tries = 0.0, 0, 0
        while done + tries < iterations:
            A, B = self.derivatives(plan.x[:-1], plan.u, ref)
            change, K, gain = self._backward(plan, ref, A, B, damping)
            if gain <= 1e-9 * (1e-9 + plan.cost):
                return plan._replace(K=K)
            steered = plan._replace(K=K)
            x, u = self.follow(plan.x[0], steered, ref, _SHARES * change)
            costs = self.cost(x, u, ref)
            k = int(np.argmin(costs))
            cost = float(costs[k])
            if not cost < plan.cost:
                tries += 1
                if gain <= 1e-6 * plan.cost or tries > _RETRIES + iterations // 10 or damping > 1e6:
                    return plan
                damping = max(10.0 * damping, 1e-4 * float(np.trace(self.weights.final)))
                continue
            little = plan.cost - cost <= 1e-10 * plan.cost
            plan, done = Plan(x[k], u[k], K, cost), done + 1
            damping = 0.1 * damping if damping > 1e-9 else 0.0
            if little:
                break
        return plan

    def derivatives(self, x: Array, u: Array, ref: Horizon) -> tuple[Array, Array]:
        """A (n, 2 nv, 2 nv) and B (n, 2 nv, m) of the steps of ``ref`` from states (n, nq + nv): the motion's
        linearisation, integrated along it by RK4; for hinges and slides the chain rule of the step itself."""
        nq, nv, h, m, go = self.nq, self.nv, ref.h[:, None], len(self.inputs), self.coordinates
        tau = np.zeros((len(x), nv))
        tau[:, self.inputs] = u
        D0 = np.zeros((len(x), 2 * nv, 2 * nv + m))
        D0[:, range(2 * nv), range(2 * nv)] = 1.0
        total, speed, a, D = D0.copy(), np.zeros((len(x), nv)), np.zeros((len(x), nv)), np.zeros_like(D0)
        for c, b, place in ((0.0, 1 / 6, 0), (0.5, 1 / 3, 1), (0.5, 1 / 3, 1), (1.0, 1 / 6, 2)):
            q, v, Ds = go.plus(x[:, :nq], c * h * speed), x[:, nq:] + c * h * a, D0 + c * h[:, None] * D
            d = self.smooth.derivatives(q, v, tau=tau, w=ref.w[:, place] if ref.w.shape[2] else None)
            speed, a = v, d.a
            D = np.concatenate([Ds[:, nv:], d.dq @ Ds[:, :nv] + d.dv @ Ds[:, nv:]], axis=1)
            if go.turning:
                D[:, :nv] += go.turn(v, Ds[:, :nv])
            D[:, nv:, 2 * nv :] += d.dtau[:, :, self.inputs]
            total += b * h[:, None] * D
        return total[:, :, : 2 * nv], total[:, :, 2 * nv :]

    def _backward(
        self, plan: Plan, ref: Horizon, A: Array, B: Array, damping: float
    ) -> tuple[Array, Array, float]:
        """Changes (n, m) of the forces and gains (n, m, 2 nv), within the limits, and the gain to expect."""
        nv, c, u = self.nv, self.weights, plan.u
        over, dx = self._beyond(plan.x), self.away(plan.x, ref.x)
        part = np.append(ref.h, self.step)[:, None] / self.step
        grad, curve = dx * c.Q * part, c.Q * part
        grad[:, :nv] += over * c.soft
        curve[:, :nv] += (over != 0) * c.soft
        Vx, Vxx = c.final @ dx[-1], c.final.copy()
        Vx[:nv] += over[-1] * c.soft
        Vxx[range(nv), range(nv)] += (over[-1] != 0) * c.soft
        change, gains = np.empty_like(u), np.empty((len(u), u.shape[1], 2 * nv))
        m, expected = u.shape[1], 0.0
        heavy = part[:-1, :, None] * np.diag(c.R) + damping * np.eye(m)
        push = (u - ref.u) * c.R * part[:-1]
        low, high = (bound - u for bound in self.able(plan.x[:-1]))
        along = self._along(plan.x[:-1])
        F = np.concatenate([A, B], axis=2)
        diagonal = range(2 * nv)
        for k in range(len(u) - 1, -1, -1):
            f = F[k]
            W, w = f.T @ (Vxx @ f), f.T @ Vx
            Qu, Quu, Qux = push[k] + w[-m:], heavy[k] + W[-m:, -m:], W[-m:, :-m]
            d, K = bounded_minimum(Quu, Qu, Qux, low[k], high[k], along and (along[0][k], along[1][k]))
            Qxx = W[:-m, :-m]
            Qxx[diagonal, diagonal] += curve[k]
            full = Quu @ K + Qux
            Vx = grad[k] + w[:-m] + K.T @ (Quu @ d + Qu) + Qux.T @ d
            Vxx = Qxx + K.T @ full + Qux.T @ K
            change[k], gains[k] = d, K
            expected -= float(d @ (2.0 * Qu + Quu @ d))
        return change, gains, expected

    def _along(self, x: Array) -> tuple[Array, Array] | None:
        """Derivatives (n, m, 2 nv) of the least and greatest forces by states x (n, nq + nv)."""
        if not self.slow:
            return None
        c, (n, m) = self.weights, (len(x), len(self.inputs))
        out = np.zeros((2, n, m, 2 * self.nv))
        slopes = by_speed(c.low, c.high, c.top, x[:, self.nq + self.inputs])
        out[:, :, range(m), self.nv + self.inputs] = slopes
        return out[0], out[1]

    def advance(self, x: Array, u: Array, h: float, w: Array) -> Array:
        """One RK4 step of one state; prescribed motion w (3, nw) as it begins, in its middle, at its end."""
        f, nq, plus = self._rate, self.nq, self.coordinates.plus
        at_q, at_v, a = f.inputs["q"], f.inputs["v"], f.outputs["a"]
        f.inputs["tau"][self.inputs] = u
        q, v = x[:nq], x[nq:]
        speed, push = np.zeros(self.nv), np.zeros(self.nv)
        at_q[:], at_v[:] = q, v
        for c, b, place in ((0.5 * h, 1.0, 0), (0.5 * h, 2.0, 1), (h, 2.0, 1), (0.0, 1.0, 2)):
            if w.shape[1]:
                f.inputs["w"][:] = w[place]
            f()
            speed += b * at_v
            push += b * a
            if c:
                at_q[:] = plus(q, c * at_v)
                np.add(v, c * a, out=at_v)
        out = np.empty_like(x)
        out[:nq], out[nq:] = plus(q, h / 6.0 * speed), v + h / 6.0 * push
        return out

    @cached_property
    def _rate(self) -> Bound:
        return self.smooth.bind("forward")
