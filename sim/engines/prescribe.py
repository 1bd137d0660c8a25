"""Keyed joints inside MuJoCo: prescribed acceleration with the right inertial forces on everything else.

A keyed degree of freedom gets a large armature A and the force A a_key + lag. It then accelerates
with a_key up to (forces on it) / A, and the rest of the mechanism, contacts included, feels a body that
nothing can push. ``lag`` collects A (a_key - a) after each evaluation, which removes that remainder; at
its fixed point lag is the torque that a drive would need for the keyed motion:
M a + bias = passive + constraint + lag on the keyed rows.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from .interface import Array

# Armature relative to the joint's own inertia: large enough that one correction leaves about 1e-14 of
# the acceleration, small enough that MuJoCo's constraint solver keeps its digits (gradient noise
# about A * 1e-16 of the inertia).
STIFFNESS = 1e7


def prescribed_bodies(model: mujoco.MjModel, keyed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Mask (nbody,) of bodies all of whose motion is keyed; the world is one of them."""
    out = np.ones(model.nbody, dtype=bool)
    for body in range(1, model.nbody):
        dofs = slice(model.body_dofadr[body], model.body_dofadr[body] + model.body_dofnum[body])
        own = True if model.body_dofnum[body] == 0 else bool(keyed[dofs].all())
        out[body] = own and out[model.body_parentid[body]]
    return out


class Prescriber:
    """A copy of the model in which the keyed degrees of freedom move as told."""

    def __init__(self, model: mujoco.MjModel, keyed: NDArray[np.bool_]) -> None:
        self.keyed = np.flatnonzero(keyed)
        self.model = copy.copy(model)
        self.lag = np.zeros(len(self.keyed))
        if not len(self.keyed):
            return
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        inertia = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, inertia)
        self.armature = STIFFNESS * np.diag(inertia)[self.keyed]
        m, mean_inertia = self.model, model.stat.meaninertia
        m.dof_armature[self.keyed] += self.armature
        m.dof_frictionloss[self.keyed] = 0.0
        for joint in np.unique(m.dof_jntid[self.keyed]):
            m.jnt_limited[joint] = 0
        mujoco.mj_setConst(m, mujoco.MjData(m))
        # the solver scales its tolerance by this; the added armature is no inertia of the scene
        m.stat.meaninertia = mean_inertia

    def forward(self, data: mujoco.MjData, qfrc: Array, a_key: Array) -> None:
        """``mj_forward`` with joint forces ``qfrc`` (nv,) and keyed accelerations ``a_key`` (k,)."""
        data.qfrc_applied[:] = qfrc
        if not len(self.keyed):
            mujoco.mj_forward(self.model, data)
            return
        k = self.keyed
        data.qfrc_applied[k] = self.armature * a_key + self.lag
        mujoco.mj_forward(self.model, data)
        self.lag = self.lag + self.armature * (a_key - data.qacc[k])

    def settle(self, data: mujoco.MjData, qfrc: Array, a_key: Array) -> None:
        """As :meth:`forward`, repeated until the keyed accelerations are met: afterwards ``lag`` is the
        required drive force (k,) [N or N m]."""
        if not len(self.keyed):
            self.forward(data, qfrc, a_key)
            return
        for _ in range(4):
            self.forward(data, qfrc, a_key)
            error = np.abs(data.qacc[self.keyed] - a_key)
            if np.all(error <= 1e-12 * (1.0 + np.abs(a_key))):
                break
