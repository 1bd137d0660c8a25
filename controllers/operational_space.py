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
from .nominal import Nominal, difference
from .task import Axes, Task, TaskState

Array = NDArray[np.float64]


class Projection:
    """Inertia of a task and what the joints may do without disturbing it; ``used`` (nv,) are the joints it
    may move. Near singular poses the task's inertia is bounded by ``damping`` [relative]."""

    def __init__(self, nominal: Nominal, used: NDArray[np.bool_], damping: float = 1e-6) -> None:
        self.nominal, self.used, self.damping = nominal, used, damping

    def at(self, q: Array, J: Array) -> tuple[Array, Array, Array]:
        """L (k, k), N (nv, nv) and M (nv, nv)."""
        inertia = self.nominal.mass_matrix(q)
        u = self.used
        mobility = np.zeros_like(inertia)
        mobility[np.ix_(u, u)] = np.linalg.inv(inertia[np.ix_(u, u)])
        gram = J @ mobility @ J.T
        size = np.trace(gram) / len(gram)
        task = np.linalg.inv(gram + self.damping**2 * size * np.eye(len(gram)))
        return task, np.eye(len(u)) - mobility @ J.T @ task @ J, inertia


class OperationalSpace:
    """The site ``site`` follows the path that the keys give it, at ``frequency`` [Hz] and ``damping``.

    ``axes``: its position alone, or its whole pose. What joints are left follow the keys at
    ``posture`` [Hz], without disturbing the site.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        *,
        site: str = "",
        axes: Axes = "position",
        frequency: float = 5.0,
        damping: float = 1.0,
        posture: float = 1.0,
    ) -> None:
        name = "the operational-space law's"
        self.w = 2.0 * np.pi * positive(f"{name} frequency", frequency)
        self.posture = 2.0 * np.pi * positive(f"{name} posture", posture)
        self.damping = positive(f"{name} damping", damping)
        self.model, self.tracked = model, tracked
        self.task, self.nominal = Task(model, site, axes), Nominal(model)
        self.projection = Projection(self.nominal, tracked)

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        wanted, now = self.task.at(target.q, target.v), self.task.at(q, v)
        J = np.where(self.tracked, now.J, 0.0)
        weight, null, inertia = self.projection.at(q, J)
        push = self._acceleration(now, wanted, target)
        rest = self.posture**2 * difference(self.model, q, target.q)
        rest += 2.0 * self.posture * (target.v - v) + target.a
        tau = J.T @ weight @ push + null.T @ (inertia @ np.where(self.tracked, rest, 0.0))
        tau += self.nominal.inverse(q, v, np.zeros_like(v))
        return np.where(self.tracked, tau, 0.0), None

    def _acceleration(self, now: TaskState, wanted: TaskState, target: Target) -> Array:
        """Wanted acceleration of the task less what it has without joint accelerations, (k,)."""
        feed = wanted.J @ target.a + wanted.drift
        pull = self.w**2 * self.task.error(now, wanted)
        pull += 2.0 * self.damping * self.w * (wanted.velocity - now.velocity)
        given = now.J @ np.where(self.tracked, 0.0, target.a)  # by joints that move as keyed
        return feed + pull - now.drift - given
