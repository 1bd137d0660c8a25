"""Linear-quadratic regulation along the keys: the cheapest linear feedback, gains from a Riccati equation.

u = u_d + K (x_d - x), x = (q, v). On keys that rest K solves the algebraic equation, on moving ones the
difference equation backwards along them (B. D. O. Anderson, J. B. Moore, Optimal Control, 1990, ch. 2).
"""

from __future__ import annotations

from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.clip import Clip
from ..sim.control import Target
from ..sim.errors import PantographError
from .design.linear import held_matrices, linearise_path
from .design.riccati import along, dlqr
from .gains import Gain, force_limits, per_joint
from .nominal import Nominal, difference
from .preview import Preview

Array = NDArray[np.float64]


class LQR:
    """LQR with the joint forces ``tracked`` (nv,) as inputs and all joints but ``keyed`` (nv,) as states.

    Cost per second: ``position`` |q - q_d|^2 + ``velocity`` |v - v_d|^2 + ``force`` |u - u_d|^2, weights one
    number or one a joint by name. ``force`` defaults to 1 / f^2 with f what the joint's drive can give, or
    its weight at ``q0`` where it can give anything. The gains are those of forces held over ``period`` [s],
    and are computed when first used.
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
        position: Gain = 400.0,
        velocity: Gain = 1.0,
        force: Gain | None = None,
    ) -> None:
        self.model, self.tracked, self.keyed = model, tracked, keyed
        self.period, self.preview = period, Preview(clip, period, duration)
        self.nominal = Nominal(model)
        moving = ~keyed
        state = [
            per_joint(model, "the LQR's position", position),
            per_joint(model, "the LQR's velocity", velocity),
        ]
        self.Q = np.diag(np.concatenate([weight[moving] for weight in state])) * period
        if force is None:
            low, high = force_limits(model)
            able = np.minimum(-low, high)
            scale = np.where(np.isfinite(able), able, np.maximum(1.0, np.abs(self.nominal.weight(q0))))
            weights = 1.0 / np.maximum(scale, 1e-9) ** 2
        else:
            weights = per_joint(model, "the LQR's force", force)
        if not (weights[tracked] > 0).all():
            raise PantographError("the LQR's force: every joint that it drives must cost something")
        self.R = np.diag(weights[tracked]) * period

    @cached_property
    def gains(self) -> Array:
        """K (ticks, nv, 2 nv), or (1, nv, 2 nv) for keys that rest; zero where nothing is driven or seen."""
        path = self.preview.targets
        rest = not path.v.any() and np.ptp(path.q, axis=0).max(initial=0.0) == 0.0
        q, v, a = (x[-1:] if rest else x for x in path)
        tau = np.array([self.nominal.inverse(*row) for row in zip(q, v, a, strict=True)])
        continuous = linearise_path(self.nominal, q, v, a, tau, inputs=self.tracked, keyed=self.keyed)
        A, B = held_matrices(*continuous, self.period)
        last = dlqr(A[-1], B[-1], self.Q, self.R)
        K = last.K[None] if rest else along(A, B, self.Q, self.R, last.P)[0]
        out = np.zeros((len(K), self.model.nv, 2 * self.model.nv))
        seen = np.concatenate([~self.keyed, ~self.keyed])
        out[np.ix_(np.arange(len(K)), self.tracked, seen)] = K
        return out

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        tick = min(max(round(t / self.period), 0), len(self.gains) - 1)
        wanted = self.preview.at(t, target)
        error = np.concatenate([difference(self.model, q, target.q), target.v - v])
        tau = self.nominal.inverse(*wanted) + self.gains[tick] @ error
        return np.where(self.tracked, tau, 0.0), None
