"""Nonlinear model predictive control: real-time iterations of differential dynamic programming with limits.

Every sample shifts the last plan, improves it by Gauss-Newton steps on the exact step derivatives of the
compiled model, bounded inputs inside the backward pass, and applies its beginning (Y. Tassa, N. Mansard,
E. Todorov, Control-limited differential dynamic programming, ICRA 2014; M. Diehl et al., A real-time
iteration scheme, SIAM J. Control Optim. 43, 2005).
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip
from ...sim.compile.program import Bound
from ...sim.control import Target
from ...sim.errors import PantographError
from ..design.linear import held_matrices, linearise_path
from ..design.riccati import dlqr
from ..gains import Gain, force_limits, force_weights, per_joint, positive, whole
from ..nominal import Nominal
from ..preview import aimed

Array = NDArray[np.float64]


class PlanMemory(NamedTuple):
    """Time [s] of the last sample (NaN before the first), its plan of forces (n, m), and that plan's cost."""

    t: float
    u: Array
    cost: float


@dataclass(frozen=True, eq=False)
class Horizon:
    """References of a prediction: x (n + 1, 2 nv), u (n, m), and the lengths h (n,) [s] of its steps.

    Steps end on a grid that does not move with time, so that a plan goes on unchanged from sample to sample;
    the first step is what is left of the one in progress.
    """

    x: Array
    u: Array
    h: Array


class NMPC:
    """Nonlinear MPC with the joint forces ``tracked`` (nv,) as inputs, within what the drives give.

    Looks ``horizon`` [s] ahead in steps of ``step`` [s]; the cost per second is that of LQR: ``position``,
    ``velocity`` and ``force`` weights on deviations from the keys (``goal`` for joints without: joint ->
    value), with the LQR's value as the cost to go. Ranges of joints are soft: leaving one costs ``soft``
    times the position weight. The first sample plans until nothing is left to gain, each later one makes
    ``iterations`` improvements. Hinges and slides,
    no keyed joints.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        clip: Clip,
        period: float,
        keyed: NDArray[np.bool_],
        *,
        horizon: float = 1.0,
        step: float = 0.02,
        position: Gain = 400.0,
        velocity: Gain = 1.0,
        force: Gain | None = None,
        goal: Mapping[str, float] | None = None,
        soft: float = 100.0,
        iterations: int = 1,
    ) -> None:
        if model.nq != model.nv or keyed.any():
            raise PantographError("nonlinear MPC takes models of hinges and slides without keyed joints")
        self.clip, _ = aimed(clip, {} if goal is None else goal, "the NMPC's goal")
        self.model, self.tracked, self.period = model, tracked, period
        self.step = positive("the NMPC's step", step)
        self.iterations = whole("the NMPC's iterations", iterations)
        self.n = max(1, round(positive("the NMPC's horizon", horizon) / step))
        self.nominal, self.inputs = Nominal(model), np.flatnonzero(tracked)
        low, high = force_limits(model)
        self.low, self.high = low[self.inputs], high[self.inputs]
        weights = [
            per_joint(model, f"the NMPC's {w}", g)
            for w, g in (("position", position), ("velocity", velocity))
        ]
        self.Q = np.concatenate(weights) * step
        weight = self.nominal.weight(q0)
        self.R = force_weights(model, tracked, force, weight, "the NMPC's") * step
        limited = np.array([bool(model.jnt_limited[j]) for j in model.dof_jntid])
        ranges = model.jnt_range[model.dof_jntid]
        self.q_low = np.where(limited, ranges[:, 0], -np.inf)
        self.q_high = np.where(limited, ranges[:, 1], np.inf)
        self.soft = positive("the NMPC's soft", soft, zero=True) * np.maximum(self.Q[: model.nv], 1e-12)

    @cached_property
    def final(self) -> Array:
        """Cost to go (2 nv, 2 nv) at the horizon's end: the LQR's at the clip's end."""
        at = self.horizon(self.clip.end).x[-1]
        nv = self.model.nv
        q, still = at[:nv], np.zeros((1, nv))
        path = (q[None], still, still, self.nominal.weight(q)[None])
        A, B = held_matrices(*linearise_path(self.nominal, *path, inputs=self.tracked), self.step)
        return dlqr(A[0], B[0], np.diag(np.maximum(self.Q, 1e-12)), np.diag(self.R)).P

    def horizon(self, t: float) -> Horizon:
        """References from time ``t`` [s] on."""
        gone = self._step_of(t)
        ends = np.concatenate([[t], (gone + 1 + np.arange(self.n)) * self.step])
        middle = self.clip.evaluate(0.5 * (ends[1:] + ends[:-1]))
        q, v, _ = self.clip.evaluate(ends)
        tau = self.nominal.smooth.inverse(middle.q, middle.v, middle.a)
        return Horizon(np.hstack([q, v]), tau[:, self.inputs], np.diff(ends))

    def _step_of(self, t: float) -> int:
        """Index of the step of the grid in which ``t`` lies."""
        return int(np.floor(t / self.step + 1e-6))

    # ---- one plan

    def rollout(self, x: Array, u: Array, ref: Horizon) -> Array:
        """States (n + 1, 2 nv) from x (2 nv,) under forces (n, m) over the steps of ``ref``."""
        out = np.empty((len(u) + 1, len(x)))
        out[0] = x
        for k in range(len(u)):
            out[k + 1] = self._advance(out[k], u[k], ref.h[k])
        return out

    def cost(self, x: Array, u: Array, ref: Horizon) -> float:
        """Cost of states (n + 1, 2 nv) and forces (n, m)."""
        nv = self.model.nv
        dx, du = x - ref.x, u - ref.u
        beyond = np.maximum(x[:, :nv] - self.q_high, 0.0) + np.maximum(self.q_low - x[:, :nv], 0.0)
        share = ref.h / self.step
        with np.errstate(over="ignore"):  # a plan that flies off costs infinitely much
            total = float(share @ (dx[:-1] ** 2 @ self.Q + du**2 @ self.R) + dx[-1] @ self.final @ dx[-1])
        return total + float(np.sum(beyond**2 @ self.soft))

    def improve(self, x: Array, u: Array, ref: Horizon, iterations: int) -> tuple[Array, Array, float]:
        """A better plan: states, forces, cost. Stops early when nothing is left to gain."""
        cost, damping = self.cost(x, u, ref), 0.0
        for _ in range(iterations):
            A, B = self.derivatives(x[:-1], u, ref.h)
            change, K, gain = self._backward(x, u, ref, A, B, damping)
            if gain <= 1e-9 * (1e-9 + cost):
                break
            for share in (1.0, 0.5, 0.2, 0.05):
                new_x, new_u = self._forward(x, u, ref, change, K, share)
                new = self.cost(new_x, new_u, ref)
                if new < cost or gain <= 1e-6 * cost:
                    break  # better, or so near the optimum that rounding decides
            if not new < cost:
                if gain <= 1e-6 * cost:
                    break
                if damping > 1e6:
                    break
                damping = max(10.0 * damping, 1e-4 * float(np.trace(self.final)))
                continue
            done = cost - new <= 1e-10 * cost
            x, u, cost, damping = new_x, new_u, new, 0.1 * damping if damping > 1e-9 else 0.0
            if done:
                break
        return x, u, cost

    def derivatives(self, x: Array, u: Array, lengths: Array) -> tuple[Array, Array]:
        """A (n, 2 nv, 2 nv) and B (n, 2 nv, m) of steps (n,) from states (n, 2 nv): RK4 by the chain rule."""
        nv, h, m = self.model.nv, lengths[:, None], len(self.inputs)
        tau = np.zeros((len(x), nv))
        tau[:, self.inputs] = u
        D0 = np.zeros((len(x), 2 * nv, 2 * nv + m))
        D0[:, range(2 * nv), range(2 * nv)] = 1.0
        total, k, D = D0.copy(), np.zeros_like(x), np.zeros_like(D0)
        for c, b in ((0.0, 1 / 6), (0.5, 1 / 3), (0.5, 1 / 3), (1.0, 1 / 6)):
            xs, Ds = x + c * h * k, D0 + c * h[:, None] * D
            d = self.nominal.smooth.derivatives(xs[:, :nv], xs[:, nv:], tau=tau)
            k = np.hstack([xs[:, nv:], d.a])
            D = np.concatenate([Ds[:, nv:], d.dq @ Ds[:, :nv] + d.dv @ Ds[:, nv:]], axis=1)
            D[:, nv:, 2 * nv :] += d.dtau[:, :, self.inputs]
            total += b * h[:, None] * D
        return total[:, :, : 2 * nv], total[:, :, 2 * nv :]

    def _backward(
        self, x: Array, u: Array, ref: Horizon, A: Array, B: Array, damping: float
    ) -> tuple[Array, Array, float]:
        """Changes (n, m) of the forces and gains (n, m, 2 nv), within the limits, and the gain to expect."""
        nv = self.model.nv
        over = np.maximum(x[:, :nv] - self.q_high, 0.0) - np.maximum(self.q_low - x[:, :nv], 0.0)
        part = np.append(ref.h, self.step)[:, None] / self.step
        grad, curve = (x - ref.x) * self.Q * part, self.Q * part
        grad[:, :nv] += over * self.soft
        curve[:, :nv] += (over != 0) * self.soft
        Vx, Vxx = self.final @ (x[-1] - ref.x[-1]), self.final.copy()
        Vx[:nv] += over[-1] * self.soft
        Vxx[range(nv), range(nv)] += (over[-1] != 0) * self.soft
        change, gains = np.empty_like(u), np.empty((len(u), u.shape[1], 2 * nv))
        m, expected = u.shape[1], 0.0
        heavy = part[:-1, :, None] * np.diag(self.R) + damping * np.eye(m)
        push = (u - ref.u) * self.R * part[:-1]
        low, high = self.low - u, self.high - u
        F = np.concatenate([A, B], axis=2)
        diagonal = range(2 * nv)
        for k in range(len(u) - 1, -1, -1):
            f = F[k]
            W, w = f.T @ (Vxx @ f), f.T @ Vx
            Qu, Quu, Qux = push[k] + w[-m:], heavy[k] + W[-m:, -m:], W[-m:, :-m]
            d, K = _boxed(Quu, Qu, Qux, low[k], high[k])
            Qxx = W[:-m, :-m]
            Qxx[diagonal, diagonal] += curve[k]
            full = Quu @ K + Qux
            Vx = grad[k] + w[:-m] + K.T @ (Quu @ d + Qu) + Qux.T @ d
            Vxx = Qxx + K.T @ full + Qux.T @ K
            change[k], gains[k] = d, K
            expected -= float(d @ (2.0 * Qu + Quu @ d))
        return change, gains, expected

    def _forward(
        self, x: Array, u: Array, ref: Horizon, change: Array, K: Array, share: float
    ) -> tuple[Array, Array]:
        new_x, new_u = np.empty_like(x), np.empty_like(u)
        new_x[0] = x[0]
        for k in range(len(u)):
            raw = u[k] + share * change[k] + K[k] @ (new_x[k] - x[k])
            new_u[k] = np.minimum(np.maximum(raw, self.low), self.high)
            new_x[k + 1] = self._advance(new_x[k], new_u[k], ref.h[k])
        return new_x, new_u

    def _advance(self, x: Array, u: Array, h: float) -> Array:
        """One RK4 step of one state."""
        f, nv = self._rate, self.model.nv
        at_q, at_v, a = f.inputs["q"], f.inputs["v"], f.outputs["a"]
        f.inputs["tau"][self.inputs] = u
        q, v = x[:nv], x[nv:]
        speed, push = np.zeros(nv), np.zeros(nv)
        at_q[:], at_v[:] = q, v
        for c, b in ((0.5 * h, 1.0), (0.5 * h, 2.0), (h, 2.0), (0.0, 1.0)):
            f()
            speed += b * at_v
            push += b * a
            if c:
                np.add(q, c * at_v, out=at_q)
                np.add(v, c * a, out=at_v)
        out = np.empty_like(x)
        out[:nv], out[nv:] = q + h / 6.0 * speed, v + h / 6.0 * push
        return out

    @cached_property
    def _rate(self) -> Bound:
        return self.nominal.smooth.bind("forward")

    # ---- the law

    def start(self) -> PlanMemory:
        """No plan yet."""
        return PlanMemory(np.nan, np.zeros((self.n, len(self.inputs))), np.inf)

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: PlanMemory
    ) -> tuple[Array, PlanMemory]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        ref = self.horizon(t)
        first = np.isnan(memory.t)
        u = np.clip(ref.u if first else self._shifted(memory, t), self.low, self.high)
        x = self.rollout(np.concatenate([q, v]), u, ref)
        x, u, cost = self.improve(x, u, ref, 300 if first else self.iterations)
        tau = np.zeros(self.model.nv)
        tau[self.inputs] = u[0]
        return tau, PlanMemory(t, u, cost)

    def _shifted(self, memory: PlanMemory, t: float) -> Array:
        """The last plan as it goes on from ``t`` [s], its last force held."""
        passed = self._step_of(t) - self._step_of(memory.t)
        return memory.u[np.minimum(np.arange(self.n) + passed, self.n - 1)]


def _boxed(H: Array, g: Array, G: Array, low: Array, high: Array) -> tuple[Array, Array]:
    """d (m,) that minimises d'H d/2 + g'd within [low, high], and the gains -H^-1 G (m, n) of its free part.

    Projected Newton steps with their active set (D. Bertsekas, SIAM J. Control Optim. 20, 1982).
    """
    if len(g) == 1:
        one = min(max(-g[0] / H[0, 0], low[0]), high[0])
        free_one = low[0] < one < high[0]
        return np.array([one]), np.asarray(-G / H[0, 0] if free_one else np.zeros_like(G))
    both = np.asarray(np.linalg.solve(H, np.column_stack([g, G])), dtype=np.float64)
    d = -both[:, 0]
    if ((d >= low) & (d <= high)).all():
        return d, -both[:, 1:]
    d = np.clip(d, low, high)
    value = d @ (g + 0.5 * H @ d)
    for _ in range(50):
        free = _free(d, g + H @ d, low, high)
        if not len(free):
            break
        move = -np.linalg.solve(H[np.ix_(free, free)], (g + H @ d)[free])
        share, new, less = 1.0, d, value
        while share > 1e-6:
            new = d.copy()
            new[free] = np.clip(d[free] + share * move, low[free], high[free])
            less = new @ (g + 0.5 * H @ new)
            if less <= value:
                break
            share *= 0.5
        still = np.abs(new - d).max() <= 1e-12 * (1.0 + np.abs(d).max())
        d, value = new, less
        if still:
            break
    K = np.zeros_like(G)
    free = _free(d, g + H @ d, low, high)
    if len(free):
        K[free] = -np.linalg.solve(H[np.ix_(free, free)], G[free])
    return d, K


def _free(d: Array, slope: Array, low: Array, high: Array) -> NDArray[np.intp]:
    """Entries that no bound holds."""
    return np.flatnonzero(~(((d <= low) & (slope > 0)) | ((d >= high) & (slope < 0))))
