"""Linear model predictive control: the least change of LQR that meets the limits ahead.

Along the keys, with LQR's gains K and values P, forces u = u_d - K x + c cost x'P x + sum c'(R + B'P B) c,
whatever the changes c (completion of squares; B. Kouvaritakis, M. Cannon, Model Predictive Control, 2016,
ch. 2 and 6): without a limit in the way the best c is none, and the law is LQR exactly, for any horizon.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip
from ...sim.control import Target
from ..drives import Drives
from ..gains import Gain, limit_per_joint, positive, whole
from ..lqr import LQR, POSITION, VELOCITY
from .quadratic import NOTHING, LeastChange, Rows

Array = NDArray[np.float64]
_REPEATS = 4  # moves of each length beyond the fine ones
_ANY = 1e300  # in place of infinite forces, whose difference is nothing


class Doubling(NamedTuple):
    """LQR's closed loop over 1, 2, 4, ... ticks from each: x+ = step x + push c, with c held and costing
    c'weight c. ``step`` (ticks, n, n), ``push`` (ticks, n, m), ``weight`` (ticks, m, m) for each power."""

    step: list[Array]
    push: list[Array]
    weight: list[Array]


class Ahead(NamedTuple):
    """What LQR alone would do at the beginnings of the moves (b,), and at their ends.

    ``at`` (b,): rows of LQR's solution; x (b + 1, n): deviations; u (b, m): forces.
    """

    at: NDArray[np.intp]
    x: Array
    u: Array


class MPCMemory(NamedTuple):
    """Last forces of the inputs (m,), None before the first; and the rows of limits that held then."""

    u: Array | None
    held: Rows


class MPC:
    """Linear MPC with the joint forces ``tracked`` (nv,) as inputs and all joints but ``keyed`` as states.

    Looks ``horizon`` [s] ahead by the model's exact linearisation along the keys. Weights ``position``,
    ``velocity``, ``force`` and the ``goal`` [rad, m] are LQR's. What drives can give is a hard limit, and so
    is ``slew`` [N m/s, N/s], how quickly their forces may change. Ranges of joints and ``speed``
    [rad/s, m/s] are soft: the square of what is beyond costs ``soft`` times the position's weight. The first
    ``fine`` moves take one period each, later ones 2, 4, 8, ...; limits are looked at where moves meet. What
    drives lose towards their ``top_speed`` [rad/s, m/s] is foreseen at the speeds that LQR alone would have;
    where that is more than ``slew`` allows, forces follow the drives.
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
        top_speed: Gain | None = None,
        *,
        horizon: float = 0.5,
        fine: int = 8,
        position: Gain = POSITION,
        velocity: Gain = VELOCITY,
        force: Gain | None = None,
        goal: Mapping[str, float] | None = None,
        slew: Gain | None = None,
        speed: Gain | None = None,
        soft: float = 1e4,
    ) -> None:
        self.lqr = LQR(
            model, tracked, q0, clip, period, duration, keyed,
            position=position, velocity=velocity, force=force, goal=goal,
        )  # fmt: skip
        self.model, self.inputs, self.moving = model, np.flatnonzero(tracked), np.flatnonzero(~keyed)
        self.powers = _moves(positive("the MPC's horizon", horizon), period, whole("the MPC's fine", fine))
        self.drives = Drives(model, tracked, top_speed=top_speed)
        self.low, self.high = self.drives.low[self.inputs], self.drives.high[self.inputs]
        self.slew = limit_per_joint(model, "the MPC's slew", slew, tracked=tracked)[self.inputs] * period
        ranges, limited = model.jnt_range[model.dof_jntid], model.jnt_limited[model.dof_jntid].astype(bool)
        top = limit_per_joint(model, "the MPC's speed", speed)
        self.x_low = np.concatenate(
            [np.where(limited, ranges[:, 0], -np.inf)[self.moving], -top[self.moving]]
        )
        self.x_high = np.concatenate([np.where(limited, ranges[:, 1], np.inf)[self.moving], top[self.moving]])
        self.limited = np.flatnonzero(np.isfinite(self.x_high - self.x_low))
        self.soft = positive("the MPC's soft", soft) * float(self.lqr.Q.max())
        self.least_change = LeastChange()
        self._known: dict[bool, tuple[Array, Array, Array]] = {}

    @cached_property
    def ahead(self) -> Doubling:
        """LQR's closed loop over powers of two of ticks."""
        A, B, K, P, _ = self.lqr.solution
        last, now = len(K) - 1, np.arange(len(K))
        out = Doubling([A - B @ K], [B], [self.lqr.R + B.mT @ P[1:] @ B])
        for p in range(max(self.powers)):
            then = np.minimum(now + 2**p, last)
            step, push, weight = (parts[p] for parts in out)
            out.step.append(step[then] @ step)
            out.push.append(step[then] @ push + push[then])
            out.weight.append(weight + weight[then])
        return out

    @cached_property
    def wanted(self) -> Array:
        """Where the keys want limited states, (ticks + 1, k): positions of hinges and slides, and speeds."""
        m, preview = self.model, self.lqr.preview
        q, v, _ = preview.clip.evaluate(np.arange(len(preview.times) + 1) * preview.period)
        scalar = np.zeros((len(q), m.nv))
        for joint in np.flatnonzero(m.jnt_limited):
            scalar[:, m.jnt_dofadr[joint]] = q[:, m.jnt_qposadr[joint]]
        return np.concatenate([scalar[:, self.moving], v[:, self.moving]], axis=1)[:, self.limited]

    def start(self) -> MPCMemory:
        """No force yet."""
        return MPCMemory(None, NOTHING)

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: MPCMemory
    ) -> tuple[Array, MPCMemory]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        error, needed = self.lqr.aim(t, q, v, target)
        kept = np.concatenate([self.moving, self.model.nv + self.moving])
        ahead = self.foresee(t, -error[kept], needed[self.inputs])
        able = self.able(t, ahead)
        low, high = self.limits(t, memory.u, able)
        at = self._rows(ahead.x, ahead.u, memory.u)
        u, held = ahead.u[0], NOTHING
        if (at < low - 1e-12 * (1.0 + abs(low))).any() or (at > high + 1e-12 * (1.0 + abs(high))).any():
            M, give, scale = self.program(ahead, first=memory.u is None)
            z, held, _ = self.least_change(M, low - at, high - at, give, memory.held)
            u = np.clip(u + scale @ z[: len(u)], *self._now(memory.u, able))
        tau = np.zeros(self.model.nv)
        tau[self.inputs] = u
        return tau, MPCMemory(u, held)

    # ---- the prediction

    def foresee(self, t: float, x: Array, needed: Array) -> Ahead:
        """The motion from deviation x (n,) at time ``t`` [s] under LQR; ``needed`` (m,): u_d now."""
        K, u_d, first = self.lqr.solution.K, self.lqr.solution.u, self.lqr.tick(t)
        starts = first + np.concatenate([[0], np.cumsum(2 ** np.array(self.powers))])
        at = np.minimum(starts, len(K) - 1)
        xs = np.empty((len(at), len(x)))
        xs[0] = x
        for b, p in enumerate(self.powers):
            xs[b + 1] = self.ahead.step[p][at[b]] @ xs[b]
        at = at[:-1]
        us = u_d[at] - np.einsum("bij,bj->bi", K[at], xs[:-1])
        us[0] += needed - u_d[at[0]]
        return Ahead(at, xs, us)

    def able(self, t: float, ahead: Ahead) -> tuple[Array, Array]:
        """Least and greatest force (b, m) of the drives at the beginnings of the moves."""
        b = len(self.powers)
        if not self.drives.slow:
            return np.tile(self.low, (b, 1)), np.tile(self.high, (b, 1))
        first = max(round(t / self.lqr.period), 0)
        at = first + np.concatenate([[0], np.cumsum(2 ** np.array(self.powers[:-1]))]).astype(int)
        v = self.speeds[np.minimum(at, len(self.speeds) - 1)].copy()
        v[:, self.moving] += ahead.x[:-1, len(self.moving) :]
        low, high = self.drives.at(v)
        return low[:, self.inputs], high[:, self.inputs]

    @cached_property
    def speeds(self) -> Array:
        """Velocities that the keys want, (ticks + 1, nv)."""
        preview = self.lqr.preview
        return np.asarray(preview.clip.evaluate(np.arange(len(preview.times) + 1) * preview.period).v)

    def limits(self, t: float, before: Array | None, able: tuple[Array, Array]) -> tuple[Array, Array]:
        """Least and greatest value of every row: forces, their changes (moves of one period), states."""
        slower, quicker = self._changes(before, able)
        first = max(round(t / self.lqr.period), 0)
        ends = np.minimum(first + np.cumsum(2 ** np.array(self.powers)), len(self.wanted) - 1)
        wanted = self.wanted[ends]
        return (
            np.concatenate([able[0].ravel(), slower.ravel(), (self.x_low[self.limited] - wanted).ravel()]),
            np.concatenate([able[1].ravel(), quicker.ravel(), (self.x_high[self.limited] - wanted).ravel()]),
        )

    def _changes(self, before: Array | None, able: tuple[Array, Array]) -> tuple[Array, Array]:
        """Least and greatest change (moves of one period, m) of the forces: ``slew``, or as much more as what
        drives can give shrinks at speed, so that the force ``before`` (m,), and any other that they could
        give, has a way on."""
        low, high = (np.clip(side[: self.powers.count(0)], -_ANY, _ANY) for side in able)
        if before is not None:
            low, high = np.vstack([before, low]), np.vstack([before, high])
        return np.minimum(-self.slew, np.diff(high, axis=0)), np.maximum(self.slew, np.diff(low, axis=0))

    def _now(self, before: Array | None, able: tuple[Array, Array]) -> tuple[Array, Array]:
        """Hard limits (m,) of the forces now, for what rounding leaves of them."""
        low, high = able[0][0], able[1][0]
        if before is None:
            return low, high
        slower, quicker = self._changes(before, able)
        return np.maximum(low, before + slower[0]), np.minimum(high, before + quicker[0])

    def _rows(self, x: Array, u: Array, before: Array | None) -> Array:
        """Values of the rows that have limits, for states x (b + 1, ...) and forces u (b, ...)."""
        known = u[: self.powers.count(0)]
        change = np.diff(known if before is None else np.concatenate([before[None], known]), axis=0)
        parts = (u, change, x[1:, self.limited])
        return np.concatenate([part.reshape(-1, *u.shape[2:]) for part in parts])

    def program(self, ahead: Ahead, *, first: bool) -> tuple[Array, Array, Array]:
        """M (r, z) of the rows by scaled changes of the moves, their softness (r,), and the change of the
        first move by its part of z, (m, m). On keys that rest it is always the same."""
        if len(self.lqr.solution.K) > 1:
            return self._program(ahead, first)
        if first not in self._known:
            self._known[first] = self._program(ahead, first)
        return self._known[first]

    def _program(self, ahead: Ahead, first: bool) -> tuple[Array, Array, Array]:
        b, m, n = len(self.powers), len(self.inputs), ahead.x.shape[1]
        K, X, U = self.lqr.solution.K, np.zeros((b + 1, n, b * m)), np.zeros((b, m, b * m))
        for k, (p, i) in enumerate(zip(self.powers, ahead.at, strict=True)):
            done, own = slice(0, k * m), slice(k * m, (k + 1) * m)
            # c'weight c = |z|^2 for weight = L L' and c = L'^-1 z
            scale = np.linalg.inv(np.linalg.cholesky(self.ahead.weight[p][i])).T
            U[k, :, done], U[k, :, own] = -K[i] @ X[k, :, done], scale
            X[k + 1, :, done] = self.ahead.step[p][i] @ X[k, :, done]
            X[k + 1, :, own] = self.ahead.push[p][i] @ scale
        M = self._rows(X, U, None if first else np.zeros((m, b * m)))
        soft = np.repeat(self.soft * 2.0 ** np.array(self.powers), len(self.limited))
        give = np.concatenate([np.zeros(len(M) - len(soft)), 1.0 / soft])
        return M, give, U[0, :, :m]


def _moves(horizon: float, period: float, fine: int) -> list[int]:
    """Powers of two of the moves' lengths [ticks] that fill a horizon: ``fine`` ones, then longer ones."""
    ticks, powers = max(1, round(horizon / period)), [0] * fine
    p = 1
    while sum(2**k for k in powers) < ticks:
        powers += [p] * _REPEATS
        p += 1
    while sum(2**k for k in powers[:-1]) >= ticks:
        powers.pop()
    return powers
