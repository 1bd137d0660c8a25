"""PD along the keys with gravity compensation: tau = Kp (q_d - q) + Kd (v_d - v) + g(q).

B. Siciliano et al., Robotics: Modelling, Planning and Control (2009), eq. 8.51.
"""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.control import Target
from .gains import Gain, felt_inertia, per_joint, positive, switch

Array = NDArray[np.float64]


class PD:
    """PD with gravity compensation on the degrees of freedom ``tracked`` (nv,) of ``model``.

    Without explicit gains they follow from a bandwidth: kp = m w^2, kd = 2 zeta m w with w = 2 pi
    ``frequency`` [Hz] and m = 1 / (M^-1)_ii, the inertia that the joint feels at ``q0`` when the others are
    free. ``kp`` [N m/rad or N/m] and ``kd`` [N m s/rad or N s/m] are one number, or one a joint by name.
    Raises PantographError for a gain that is negative or names no joint of the model.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        *,
        frequency: float = 5.0,
        damping: float = 1.0,
        kp: Gain | None = None,
        kd: Gain | None = None,
        gravity: bool = True,
    ) -> None:
        positive("the PD law's frequency", frequency)
        positive("the PD law's damping", damping)
        self.model, self.tracked = model, tracked
        self.gravity = switch("the PD law's gravity", gravity)
        self.data = mujoco.MjData(model)
        inertia = felt_inertia(model, q0)
        w = 2.0 * np.pi * frequency
        self.kp = inertia * w**2 if kp is None else per_joint(model, "the PD law's kp", kp, tracked=tracked)
        self.kd = (
            2.0 * damping * np.sqrt(self.kp * inertia)
            if kd is None
            else per_joint(model, "the PD law's kd", kd, tracked=tracked)
        )

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        error = np.empty(self.model.nv)
        mujoco.mj_differentiatePos(self.model, error, 1.0, q, target.q)
        tau = self.kp * error + self.kd * (target.v - v)
        if self.gravity:
            tau = tau + self._weight(q)
        return np.where(self.tracked, tau, 0.0), None

    def _weight(self, q: Array) -> Array:
        """Joint forces g(q) (nv,) against gravity, less what the model compensates itself."""
        m, d = self.model, self.data
        d.qpos[:] = q
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_comVel(m, d)
        weight = np.empty(m.nv)
        mujoco.mj_rne(m, d, 0, weight)
        if m.ngravcomp:
            mujoco.mj_passive(m, d)
            weight -= d.qfrc_gravcomp
        return weight
