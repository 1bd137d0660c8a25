"""Operational space control: a site follows its path as a double integrator; the posture uses what is left.

tau = J^T L (x''_d + kp e + kd e' - J' v) + N^T tau_0 + h,  L = (J M^-1 J^T)^-1,  N = I - Jbar J,
Jbar = M^-1 J^T L, the dynamically consistent inverse (O. Khatib, IEEE J. Robotics and Automation 3, 1987).
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.control import Target
from .gains import positive
from .task import Axes
from .task_space import TaskSpace

Array = NDArray[np.float64]


class OperationalSpace:
    """The site ``site`` follows the path that the keys give it, at ``frequency`` [Hz] and ``damping``.

    ``axes``: its position alone, or its whole pose. What joints are left follow the keys at
    ``posture`` [Hz], without disturbing the site. It moves by the joints ``tracked`` (nv,) alone; passive
    ones move as these make them, joints ``keyed`` (nv,) as their keys say.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        keyed: NDArray[np.bool_] | None = None,
        *,
        site: str = "",
        axes: Axes = "position",
        frequency: float = 5.0,
        damping: float = 1.0,
        posture: float = 1.0,
    ) -> None:
        name = "the operational-space law's"
        self.w = 2.0 * np.pi * positive(f"{name} frequency", frequency)
        self.damping = positive(f"{name} damping", damping)
        self.space = TaskSpace(model, tracked, keyed, site, axes, posture, name)

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        at = self.space.at(q, v, target)
        push = at.feed + self.w**2 * at.error + 2.0 * self.damping * self.w * at.rate
        return self.space.forces(at, at.inertia @ push), None
