"""Dead time compensated: where the machine will be when a force that is asked for now arrives.

The model is integrated from the state seen under the forces on their way, and the law is asked for that
moment (Z. Artstein, IEEE Trans. Automatic Control 27, 1982): as far as the model is right, the delay is
outside the loop.
"""

from __future__ import annotations

from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.clip import Clip
from ..sim.control import Target
from ..sim.dynamics.smooth import Smooth, compile_model
from .drives import Drives
from .nominal import Nominal
from .preview import Preview

Array = NDArray[np.float64]
_STEPS = 2  # of the integration, in a period


class Predictor:
    """States and targets ``late`` periods ahead, of ``model`` with forces within what ``drives`` give.

    Freedoms ``keyed`` (nv,) move as ``clip`` says. Contacts and limits of joints are not foreseen.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        keyed: NDArray[np.bool_],
        clip: Clip,
        period: float,
        late: int,
        drives: Drives,
    ) -> None:
        self.model, self.keyed, self.clip, self.drives = Nominal(model).model, keyed, clip, drives
        self.period, self.late = period, late
        self.preview = Preview(clip, period, clip.end, offset=late)

    @cached_property
    def _pushed(self) -> Smooth:
        return compile_model(self.model, keyed=self.keyed, forces=True)

    def target(self, t: float, now: Target) -> Target:
        """The target when a force of time ``t`` [s] arrives; freedoms without keys go on with theirs."""
        return self.preview.at(t, now)

    def state(self, t: float, q: Array, v: Array, queue: tuple[Array, ...]) -> tuple[Array, Array]:
        """q (nq,), v (nv,) then, from those at ``t`` [s] under the forces ``queue`` (late of (nv,))."""
        lay, free = self._pushed.layout, ~self.keyed
        q_out, v_out = q.copy(), v.copy()
        x, rate = q[lay.q_free], v[free]
        for k, tau in enumerate(queue):
            v_out[free] = rate
            u = np.zeros(lay.nu)
            u[lay.nu - lay.nv :] = np.clip(tau, *self.drives.at(v_out))[free]
            path = self._pushed.rollout(
                x, rate, u[None], step=self.period / _STEPS, steps=_STEPS, hold=_STEPS, every=_STEPS,
                w=self._prescribed if lay.nw else None, t0=t + k * self.period,
            )  # fmt: skip
            x, rate = path.q[-1], path.v[-1]
        q_out[lay.q_free], v_out[free] = x, rate
        if self.keyed.any():
            then = self.clip.evaluate(t + len(queue) * self.period)
            q_out[lay.q_keyed], v_out[self.keyed] = then.q[lay.q_keyed], then.v[self.keyed]
        return q_out, v_out

    def _prescribed(self, times: Array) -> Array:
        lay, at = self._pushed.layout, self.clip.evaluate(times)
        return np.hstack([at.q[:, lay.q_keyed], at.v[:, lay.v_keyed], at.a[:, lay.v_keyed]])
