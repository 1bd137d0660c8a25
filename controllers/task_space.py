"""What laws of a task share: the machine as its tracked joints feel it, and what the task leaves them.

Passive joints p move as the tracked ones t make them, a_p = -M_pp^-1 (M_pt a_t + h_p) (M. W. Spong, Partial
feedback linearization, IROS 1994): what the tracked joints feel is the inertia M_tt - M_tp M_pp^-1 M_pt, and
so on for forces and Jacobian. The task's inertia and null space are then those of O. Khatib (IEEE J. Robotics
and Automation 3, 1987).
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.control import Target
from .gains import positive
from .nominal import Nominal, difference
from .task import Axes, Task

Array = NDArray[np.float64]
_SINGULAR = 1e-6  # bounds the task's inertia near singular poses, relative


class TaskView(NamedTuple):
    """A task at a sample: ``error`` (k,) and its ``rate`` (k,) to where it should be; the acceleration
    ``feed`` (k,) that its path needs beside what the machine does by itself; its inertia (k, k); J (k, nt);
    and ``rest`` (nt,): forces of the tracked joints that hold them against all that moves them, and hold the
    posture where the task does not feel it."""

    error: Array
    rate: Array
    feed: Array
    inertia: Array
    J: Array
    rest: Array


class TaskSpace:
    """The site ``site`` moved by the joints ``tracked`` (nv,), with ``keyed`` (nv,) moving as they are told.

    ``posture`` [Hz]: how the joints that are left follow the keys, for the law ``name``.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        keyed: NDArray[np.bool_] | None,
        site: str,
        axes: Axes,
        posture: float,
        name: str,
    ) -> None:
        self.model, self.tracked = model, tracked
        self.keyed = np.zeros_like(tracked) if keyed is None else keyed
        self.passive = ~tracked & ~self.keyed
        self.posture = 2.0 * np.pi * positive(f"{name} posture", posture)
        self.task, self.nominal = Task(model, site, axes), Nominal(model)

    def at(self, q: Array, v: Array, target: Target) -> TaskView:
        """The task at state q (nq,), v (nv,), wanted at ``target``."""
        wanted, now = self.task.at(target.q, target.v), self.task.at(q, v)
        told = np.where(self.keyed, target.a, 0.0)
        M, h = self.nominal.mass_matrix(q), self.nominal.inverse(q, v, told)
        t, p, drift = self.tracked, self.passive, now.drift + now.J @ told
        inertia, bias, J = M[np.ix_(t, t)], h[t], now.J[:, t]
        if p.any():
            follow = np.linalg.solve(M[np.ix_(p, p)], np.column_stack([M[np.ix_(p, t)], h[p]]))
            inertia = inertia - M[np.ix_(t, p)] @ follow[:, :-1]
            bias = bias - M[np.ix_(t, p)] @ follow[:, -1]
            J, drift = J - now.J[:, p] @ follow[:, :-1], drift - now.J[:, p] @ follow[:, -1]
        moved = np.linalg.solve(inertia, J.T)
        gram = J @ moved
        size = np.trace(gram) / len(gram)
        weight = np.linalg.inv(gram + _SINGULAR**2 * size * np.eye(len(gram)))
        hold = self.posture**2 * difference(self.model, q, target.q)
        hold += 2.0 * self.posture * (target.v - v) + target.a
        held = inertia @ hold[t]
        held -= J.T @ (weight @ (moved.T @ held))
        feed = wanted.J @ target.a + wanted.drift - drift
        rate = wanted.velocity - now.velocity
        return TaskView(self.task.error(now, wanted), rate, feed, weight, J, bias + held)

    def forces(self, view: TaskView, force: Array) -> Array:
        """Joint forces (nv,) that put ``force`` (k,) on the task."""
        tau = np.zeros(self.model.nv)
        tau[self.tracked] = view.J.T @ force + view.rest
        return tau
