"""Keyed joints inside MuJoCo: prescribed acceleration with the right inertial forces on everything else.

A keyed degree of freedom gets a large armature A and the force A a_key + drive. It then accelerates with
a_key up to (forces on it - drive) / A, and the rest of the mechanism, contacts included, feels a body that
nothing can push. ``drive`` is what inverse dynamics asked for at the evaluation before, so that the
remainder is a change of forces over one evaluation, divided by A:
M a + bias = passive + actuation + constraint + drive.
"""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from .interface import Array

# Armature relative to the joint's own inertia: large enough that forces move a keyed joint by 1e-7 of what
# they would otherwise, small enough that MuJoCo's constraint solver keeps its digits (gradient noise about
# A * 1e-16 of the inertia).
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
        self.drive = np.zeros(len(self.keyed))
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
        self._inertial = np.zeros(m.nv)

    def forward(self, data: mujoco.MjData, a_key: Array) -> None:
        """``mj_forward`` with keyed accelerations ``a_key`` (k,) and the joint forces in ``qfrc_applied``."""
        if not len(self.keyed):
            mujoco.mj_forward(self.model, data)
            return
        self.push(data, a_key)
        mujoco.mj_forward(self.model, data)
        self.observe(data)

    def push(self, data: mujoco.MjData, a_key: Array) -> None:
        """Write the forces that make the keyed joints accelerate with ``a_key`` (k,)."""
        data.qfrc_applied[self.keyed] = self.armature * a_key + self.drive

    def observe(self, data: mujoco.MjData) -> None:
        """Take ``drive`` from the accelerations and forces of an evaluation."""
        k, a = self.keyed, data.qacc
        mujoco.mj_mulM(self.model, data, self._inertial, a)
        others = data.qfrc_bias - data.qfrc_passive
        others -= data.qfrc_actuator
        others -= data.qfrc_constraint
        self.drive = self._inertial[k] - self.armature * a[k]
        self.drive += others[k]

    def settle(self, data: mujoco.MjData, qfrc: Array, a_key: Array) -> None:
        """As :meth:`forward` under joint forces ``qfrc`` (nv,), until the keyed accelerations are met: then
        ``drive`` (k,) is the force [N, N m] that the keyed motion needs."""
        data.qfrc_applied[:] = qfrc
        if not len(self.keyed):
            self.forward(data, a_key)
            return
        allowed = 1e-12 * (1.0 + np.abs(a_key))
        for _ in range(4):
            self.forward(data, a_key)
            if (np.abs(data.qacc[self.keyed] - a_key) <= allowed).all():
                break
