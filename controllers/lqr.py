"""Linear-quadratic regulation along the keys: the cheapest linear feedback, gains from a Riccati equation.

u = u_d + K (x_d - x), x = (q, v). On keys that rest K solves the algebraic equation, on moving ones the
difference equation backwards along them (B. D. O. Anderson, J. B. Moore, Optimal Control, 1990, ch. 2).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import dof_names
from ..sim.clip import Clip
from ..sim.compile.cache import key_of, source
from ..sim.control import Target
from ..sim.dynamics.layout import Layout
from ..sim.dynamics.rigid import spatial
from ..sim.dynamics.tangent import difference as difference_of
from ..sim.errors import PantographError
from ..sim.formula import Expressed, Formula, Symbols
from .design.linear import held_matrices, linearise_path
from .design.riccati import Regulator, along, dlqr
from .gains import Gain, force_weights, per_joint, positive
from .nominal import Nominal, difference
from .preview import Preview, aimed

Array = NDArray[np.float64]
POSITION, VELOCITY = 400.0, 1.0
"""Weights of deviations, also of joints that are not named."""


class Solution(NamedTuple):
    """Regulation of every tick, of one for keys that rest, by freedoms that are not keyed, n, and inputs, m.

    A (ticks, 2 n, 2 n) and B (ticks, 2 n, m) over a period; K (ticks, m, 2 n); P (ticks + 1, 2 n, 2 n): the
    cost to come; u (ticks, m): the forces that the keys need.
    """

    A: Array
    B: Array
    K: Array
    P: Array
    u: Array


def regulator(
    model: mujoco.MjModel, free: NDArray[np.bool_], A: Array, B: Array, Q: Array, R: Array
) -> Regulator:
    """:func:`~pantograph.controllers.design.riccati.dlqr` for the freedoms ``free`` (nv,), whose mistakes
    name joints."""
    names = dof_names(model)
    try:
        return dlqr(A, B, Q, R, states=tuple(names[i] for i in np.flatnonzero(free)) * 2)
    except PantographError as e:
        raise PantographError(f"{e}; track, key or damp what is left to itself") from None


class LQR:
    """LQR with the joint forces ``tracked`` (nv,) as inputs and all joints but ``keyed`` (nv,) as states.

    Cost per second: ``position`` |q - q_d|^2 + ``velocity`` |v - v_d|^2 + ``force`` |u - u_d|^2, weights one
    number or one a joint by name. ``force`` defaults to 1 / f^2 with f what the joint's drive can give, or
    its weight at ``q0`` where it can give anything. Joints without keys are kept at ``goal`` [rad, m]
    (joint -> value), or where they start. With ``final`` [s] regulation ends with the scene, where deviations
    cost as much as so many seconds of them: gains of a finite horizon, also on keys that rest; without, it
    goes on for ever. The gains are those of forces held over ``period`` [s], computed when first used.
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
        position: Gain = POSITION,
        velocity: Gain = VELOCITY,
        force: Gain | None = None,
        goal: Mapping[str, float] | None = None,
        final: float | None = None,
    ) -> None:
        self.final = None if final is None else positive("the LQR's final", final, zero=True)
        self.model, self.tracked, self.keyed = model, tracked, keyed
        clip, self.unkeyed = aimed(clip, {} if goal is None else goal, "the LQR's goal")
        self._all = bool(tracked.all())
        self.period, self.preview = period, Preview(clip, period, duration)
        self.nominal = Nominal(model)
        moving = ~keyed
        state = [
            per_joint(model, "the LQR's position", position, missing=POSITION),
            per_joint(model, "the LQR's velocity", velocity, missing=VELOCITY),
        ]
        self.Q = np.diag(np.concatenate([weight[moving] for weight in state])) * period
        weight = self.nominal.weight(q0)
        self.R = np.diag(force_weights(model, tracked, force, weight, "the LQR's")) * period

    @cached_property
    def solution(self) -> Solution:
        """The regulation along the keys."""
        path = self.preview.targets
        rest = not path.v.any() and np.ptp(path.q, axis=0).max(initial=0.0) == 0.0
        q, v, a = (x[-1:] if rest else x for x in path)
        tau = np.array([self.nominal.inverse(*row) for row in zip(q, v, a, strict=True)])
        continuous = linearise_path(self.nominal, q, v, a, tau, inputs=self.tracked, keyed=self.keyed)
        A, B = held_matrices(*continuous, self.period)
        if self.final is None:
            last = regulator(self.model, ~self.keyed, A[-1], B[-1], self.Q, self.R)
            if rest:
                return Solution(A, B, last.K[None], np.array([last.P, last.P]), tau[:, self.tracked])
            end = last.P
        else:
            end = self.Q * (self.final / self.period)
            ticks = len(path.q)
            A, B, tau = (np.broadcast_to(x, (ticks, *x.shape[1:])) for x in (A, B, tau))
        return Solution(A, B, *along(A, B, self.Q, self.R, end), tau[:, self.tracked])

    @cached_property
    def gains(self) -> Array:
        """K (ticks, nv, 2 nv), or (1, nv, 2 nv) for keys that rest; zero where nothing is driven or seen."""
        K = self.solution.K
        out = np.zeros((len(K), self.model.nv, 2 * self.model.nv))
        seen = np.concatenate([~self.keyed, ~self.keyed])
        out[np.ix_(np.arange(len(K)), self.tracked, seen)] = K
        return out

    def tick(self, t: float) -> int:
        """Row of the solution at time ``t`` [s]."""
        return min(max(round(t / self.period), 0), len(self.solution.K) - 1)

    def aim(self, t: float, q: Array, v: Array, target: Target) -> tuple[Array, Array]:
        """The way (2 nv,) from state q, v to where it belongs, and the joint forces (nv,) that keys need."""
        if self.unkeyed.any():
            target = target._replace(q=np.where(self.unkeyed, self.preview.clip.q0, target.q))
        error = np.concatenate([difference(self.model, q, target.q), target.v - v])
        return error, self._needed(t, target)

    def _needed(self, t: float, target: Target) -> Array:
        """Joint forces (nv,) that the keys need at time ``t`` [s]; live goals are not known before."""
        tick = t / self.period
        on_grid = abs(tick - round(tick)) < 1e-6 and 0 <= round(tick) < len(self.preview.times)
        if on_grid and self.preview.known(target):
            return np.asarray(self._forces[min(round(tick), len(self._forces) - 1)])
        return self.nominal.inverse(*self.preview.at(t, target))

    @cached_property
    def _forces(self) -> Array:
        """What the keys need (ticks, nv), on keys that rest (1, nv)."""
        out = np.zeros((len(self.solution.u), self.model.nv))
        out[:, self.tracked] = self.solution.u
        return out

    def formula(self, period: float) -> Formula:
        """See :class:`~pantograph.sim.formula.Formula`."""
        m, nq, nv, still = self.model, self.model.nq, self.model.nv, len(self.gains) == 1
        blocks, entries = Layout(m).blocks, np.nonzero(self.gains.any(axis=0))
        K = self.gains[:, entries[0], entries[1]]

        def rows(first: int, now: Target) -> Array:
            ticks = np.arange(first, first + len(now.q))
            q = np.where(self.unkeyed, self.preview.clip.q0, now.q)
            needed = self._forces[np.minimum(ticks, len(self._forces) - 1)]
            known = [q, now.v, needed]
            return np.hstack(known if still else [*known, K[np.minimum(ticks, len(K) - 1)]])

        def express(q: Symbols, v: Symbols, row: Symbols, gains: Symbols, _: Symbols) -> Expressed:
            error = difference_of(blocks, q, row[:nq]) + spatial.sub(row[nq : nq + nv], v)
            tau = list(row[nq + nv : nq + 2 * nv])
            for i, j, k in zip(*entries, gains if still else row[nq + 2 * nv :], strict=True):
                tau[i] = tau[i] + k * error[j]
            return tau, ()

        return Formula(
            key=key_of(source(__file__), repr((blocks, nv, still)), np.array(entries).tobytes()),
            gains=K[0] if still else np.zeros(0),
            width=nq + 2 * nv + (0 if still else K.shape[1]),
            rows=rows,
            express=express,
        )

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        error, needed = self.aim(t, q, v, target)
        tau = self.gains[self.tick(t)] @ error + needed
        return tau if self._all else np.where(self.tracked, tau, 0.0), None
