"""Impedance: to whatever pushes it, the site feels like a mass on a spring and a damper.

L(q) e'' + D e' + K e = F, the joints' own inertia L kept: tau = J^T (L (x''_d - J' v) + K e + D e') + h
+ N^T tau_0 (N. Hogan, J. Dynamic Systems, Measurement and Control 107, 1985; damping after A. Albu-Schaffer
et al., ICRA 2003).
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


class Impedance:
    """The site ``site`` on a spring of ``stiffness`` [N/m] and ``turning`` [N m/rad] around its keyed path.

    The damper gives every direction the damping ratio ``damping`` for the inertia felt there. Joints that are
    left follow the keys at ``posture`` [Hz] without disturbing the site. It moves by the joints ``tracked``
    (nv,) alone; passive ones move as these make them, joints ``keyed`` (nv,) as their keys say.
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
        stiffness: float = 500.0,
        turning: float = 20.0,
        damping: float = 1.0,
        posture: float = 1.0,
    ) -> None:
        name = "the impedance law's"
        self.damping = positive(f"{name} damping", damping)
        self.space = TaskSpace(model, tracked, keyed, site, axes, posture, name)
        springs = [positive(f"{name} stiffness", stiffness)] * 3 + [positive(f"{name} turning", turning)] * 3
        self.K = np.diag(springs[: self.space.task.k])

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        at = self.space.at(q, v, target)
        damper = 2.0 * self.damping * double_diagonal(at.inertia, self.K)
        force = at.inertia @ at.feed + self.K @ at.error + damper @ at.rate
        return self.space.forces(at, force), None


def double_diagonal(inertia: Array, stiffness: Array) -> Array:
    """D that damps every mode of L e'' + 2 D e' + K e = 0 critically: L^1/2 (L^-1/2 K L^-1/2)^1/2 L^1/2."""
    values, vectors = np.linalg.eigh(inertia)
    root = (vectors * np.sqrt(values)) @ vectors.T
    inverse = (vectors / np.sqrt(values)) @ vectors.T
    values, vectors = np.linalg.eigh(inverse @ stiffness @ inverse)
    return np.asarray(root @ ((vectors * np.sqrt(np.maximum(values, 0.0))) @ vectors.T) @ root)
