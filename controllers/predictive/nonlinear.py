"""Nonlinear model predictive control: real-time iterations of differential dynamic programming with limits.

Every sample carries the last plan on from the measured state with the gains that came with it, improves it on
the exact derivatives of the compiled model, and applies its beginning (M. Diehl et al., A real-time iteration
scheme, SIAM J. Control Optim. 43, 2005; Y. Tassa, T. Erez, E. Todorov, IROS 2012).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ...sim.clip import Clip
from ...sim.control import Target
from ...sim.dynamics.smooth import compile_model
from ...sim.errors import PantographError
from ...sim.kinds import FREE, SCALAR
from ..design.linear import held_matrices, linearise_path
from ..design.riccati import Regulator
from ..drives import Drives
from ..gains import Gain, force_weights, per_joint, positive, whole
from ..lqr import POSITION, VELOCITY, regulator
from ..nominal import Nominal
from ..preview import aimed
from .shooting import Horizon, Plan, Shooting, Weights

Array = NDArray[np.float64]
_FIRST = 300  # improvements of the first plan, from nothing


class PlanMemory(NamedTuple):
    """Time [s] of the last sample, and its plan; None before the first."""

    t: float
    plan: Plan | None


class NMPC:
    """Nonlinear MPC with the joint forces ``tracked`` (nv,) as inputs, within what the drives give.

    Looks ``horizon`` [s] ahead in steps of ``step`` [s]; the cost per second is that of LQR: ``position``,
    ``velocity`` and ``force`` weights on deviations from the keys (``goal`` [rad, m] for joints
    without: joint -> value), with the LQR's value as the cost to go. Ranges of joints are soft: leaving one
    costs ``soft`` times the position weight. Joints ``keyed`` (nv,) are foreseen as they will move. The first
    sample plans until nothing is left to gain, each later one makes up to ``iterations`` improvements. What
    drives lose towards their ``top_speed`` [rad/s, m/s] is foreseen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        clip: Clip,
        period: float,
        keyed: NDArray[np.bool_],
        top_speed: Gain | None = None,
        *,
        horizon: float = 1.0,
        step: float = 0.02,
        position: Gain = POSITION,
        velocity: Gain = VELOCITY,
        force: Gain | None = None,
        goal: Mapping[str, float] | None = None,
        soft: float = 100.0,
        iterations: int = 4,
    ) -> None:
        _predictable(model, tracked | keyed)
        self.clip, _ = aimed(clip, {} if goal is None else goal, "the NMPC's goal")
        self.model, self.tracked, self.keyed, self.period = model, tracked, keyed, period
        self.step = positive("the NMPC's step", step)
        self.iterations = whole("the NMPC's iterations", iterations)
        self.n = max(1, round(positive("the NMPC's horizon", horizon) / self.step))
        self.nominal, self.inputs, free = Nominal(model), np.flatnonzero(tracked), ~keyed
        weights = [
            per_joint(model, f"the NMPC's {word}", gain, missing=missing)[free]
            for word, gain, missing in (("position", position, POSITION), ("velocity", velocity, VELOCITY))
        ]
        self.drives = Drives(model, tracked, top_speed=top_speed)
        self.Q = np.concatenate(weights) * self.step
        weight = self.nominal.weight(q0)
        self.R = force_weights(model, tracked, force, weight, "the NMPC's") * self.step
        self.soft = positive("the NMPC's soft", soft, zero=True) * np.maximum(self.Q[: free.sum()], 1e-12)

    @cached_property
    def shooting(self) -> Shooting:
        """The predictions; what takes long is done when they are first asked for."""
        m, free = self.model, ~self.keyed
        limited = m.jnt_limited[m.dof_jntid].astype(bool) & np.isin(m.jnt_type[m.dof_jntid], SCALAR)
        ranges = m.jnt_range[m.dof_jntid]
        q_low, q_high = np.where(limited, ranges[:, 0], -np.inf), np.where(limited, ranges[:, 1], np.inf)
        low, high, top = (x[self.inputs] for x in (self.drives.low, self.drives.high, self.drives.top))
        weights = Weights(
            self.Q, self.R, self.regulator.P, self.soft, q_low[free], q_high[free], low, high, top
        )  # fmt: skip
        inputs = np.flatnonzero(self.tracked[free])
        pushed = compile_model(self.nominal.model, keyed=self.keyed, forces=True)
        return Shooting(self.nominal.smooth_with(self.keyed), pushed, inputs, self.step, weights)

    @cached_property
    def regulator(self) -> Regulator:
        """LQR about rest at the clip's end, whose value is the cost to go at the horizon's end."""
        q, still = self.clip.evaluate(self.clip.end).q, np.zeros((1, self.model.nv))
        path = (q[None], still, still, self.nominal.weight(q)[None])
        made = linearise_path(self.nominal, *path, inputs=self.tracked, keyed=self.keyed)
        A, B = held_matrices(*made, self.step)
        Q = np.diag(np.maximum(self.Q, 1e-12))
        return regulator(self.model, ~self.keyed, A[0], B[0], Q, np.diag(self.R))

    def horizon(self, t: float) -> Horizon:
        """References from time ``t`` [s] on."""
        gone, lay = self._step_of(t), self.shooting.smooth.layout
        ends = np.concatenate([[t], (gone + 1 + np.arange(self.n)) * self.step])
        at, middle = self.clip.evaluate(ends), self.clip.evaluate(0.5 * (ends[1:] + ends[:-1]))
        tau = self.nominal.smooth.inverse(*middle)
        w = np.zeros((self.n, 3, 0))
        if lay.v_keyed:
            rows = [
                np.hstack([part.q[:, lay.q_keyed], part.v[:, lay.v_keyed], part.a[:, lay.v_keyed]])
                for part in (at, middle, self.clip.evaluate(ends[1:], left=True))
            ]
            w = np.stack([rows[0][:-1], rows[1], rows[2]], axis=1)
        x = np.hstack([at.q[:, lay.q_free], at.v[:, lay.v_free]])
        return Horizon(x, tau[:, self.inputs], np.diff(ends), w)

    def _step_of(self, t: float) -> int:
        """Index of the step of the grid in which ``t`` lies."""
        return int(np.floor(t / self.step + 1e-6))

    # ---- the law

    def start(self) -> PlanMemory:
        """No plan yet."""
        return PlanMemory(np.nan, None)

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: PlanMemory
    ) -> tuple[Array, PlanMemory]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        ref, lay = self.horizon(t), self.shooting.smooth.layout
        x = np.concatenate([q[lay.q_free], v[lay.v_free]])
        plan = self.shooting.improve(
            self.carried(x, ref, t, memory), ref, _FIRST if memory.plan is None else self.iterations
        )
        tau = np.zeros(self.model.nv)
        tau[self.inputs] = plan.u[0]
        return tau, PlanMemory(t, plan)

    def carried(self, x: Array, ref: Horizon, t: float, memory: PlanMemory) -> Plan:
        """The last plan as it goes on from the state x (nq + nv,) at ``t`` [s]: its gains keep to it, and
        where it has ended LQR keeps to the references. Without one, the forces that the references need."""
        shooting, old = self.shooting, memory.plan
        if old is None:
            return shooting.begin(x, ref.u, ref)
        passed = self._step_of(t) - self._step_of(memory.t)
        kept = max(0, self.n - passed)
        X, u, K = ref.x.copy(), ref.u.copy(), np.tile(-self.regulator.K, (self.n, 1, 1))
        X[:kept], u[:kept], K[:kept] = old.x[passed : self.n], old.u[passed:], old.K[passed:]
        since = t - max(memory.t, self._step_of(t) * self.step)
        if kept and since > 0.0:  # where the plan meant to be by now
            X[0] = shooting.advance(X[0], u[0], since, np.tile(ref.w[0, 0], (3, 1)))
        path, u = shooting.follow(x, Plan(X, u, K, np.inf), ref)
        cost = float(shooting.cost(path, u, ref))
        return Plan(path, u, K, cost) if np.isfinite(cost) else shooting.begin(x, ref.u, ref)


def _predictable(model: mujoco.MjModel, held: NDArray[np.bool_]) -> None:
    """Raise PantographError for joints that nothing holds and that would only fall: predictions know of no
    contacts."""
    for joint in np.flatnonzero(model.jnt_type == FREE):
        if not held[model.jnt_dofadr[joint]]:
            raise PantographError(
                f"nonlinear MPC predicts without contacts, where nothing holds the free joint "
                f"{name_of(model, 'joint', int(joint))!r}: key it, or take another law"
            )
