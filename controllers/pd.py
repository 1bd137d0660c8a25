"""PD along the keys with gravity compensation: tau = Kp (q_d - q) + Kd (v_d - v) + g(q).

B. Siciliano et al., Robotics: Modelling, Planning and Control (2009), eq. 8.51.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.compile.cache import key_of, source
from ..sim.control import Target
from ..sim.dynamics.layout import Layout
from ..sim.dynamics.rigid import spatial
from ..sim.dynamics.tangent import difference
from ..sim.formula import Expressed, Formula, Symbols
from .gains import Gain, felt_inertia, per_joint, positive, switch
from .nominal import Nominal

Array = NDArray[np.float64]


class PD:
    """PD with gravity compensation on the degrees of freedom ``tracked`` (nv,) of ``model``.

    Without explicit gains they follow from a bandwidth: kp = m w^2, kd = 2 zeta m w with w = 2 pi
    ``frequency`` [Hz] and m = 1 / (M^-1)_ii, the inertia that the joint feels at ``q0`` when the others are
    free. ``kp`` [N m/rad or N/m] and ``kd`` [N m s/rad or N s/m] are one number, or one a joint by name;
    joints that are not named have what "" is given, or these.
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
        own, kp, kd = inertia * w**2, {} if kp is None else kp, {} if kd is None else kd
        self.kp = per_joint(model, "the PD law's kp", kp, missing=own, tracked=tracked)
        own = 2.0 * damping * np.sqrt(self.kp * inertia)
        self.kd = per_joint(model, "the PD law's kd", kd, missing=own, tracked=tracked)

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

    def formula(self, period: float) -> Formula | None:
        """See :class:`~pantograph.sim.formula.Formula`; None for a model that expressions do not know."""
        m, nq, nv = self.model, self.model.nq, self.model.nv
        blocks, still = Layout(m).blocks, _still(m)
        if not still.compiled:
            return None

        def express(q: Symbols, v: Symbols, row: Symbols, gains: Symbols, _: Symbols) -> Expressed:
            error, kp, kd = difference(blocks, q, row[:nq]), gains[:nv], gains[nv:]
            tau = [kp[i] * error[i] + kd[i] * (row[nq + i] - v[i]) for i in range(nv)]
            if self.gravity:
                tau = spatial.add(tau, still.express(q, [0.0] * nv, [0.0] * nv))
            return tau, ()

        return Formula(
            key=key_of(source(__file__), still.key, repr(self.gravity)),
            gains=np.concatenate([self.kp, self.kd]),
            width=nq + nv,
            rows=lambda first, targets: np.hstack([targets.q, targets.v]),
            express=express,
        )

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


def _still(model: mujoco.MjModel) -> Nominal:
    """``model`` with nothing passive but gravity and what compensates it."""
    bare = copy.copy(model)
    bare.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SPRING)
    bare.opt.density = bare.opt.viscosity = 0.0
    return Nominal(bare)
