"""The mechanism as a law believes it to be: inertia and inverse dynamics without its actuators."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.compile.cache import key_of
from ..sim.compile.graph import Node, Scalar
from ..sim.compile.program import Bound
from ..sim.dynamics.fingerprint import code_fingerprint, model_fingerprint
from ..sim.dynamics.layout import Layout, keyed_joints
from ..sim.dynamics.smooth import Smooth, compile_model
from ..sim.dynamics.support import unsupported

Array = NDArray[np.float64]


class Nominal:
    """Rigid-body dynamics M(q) a + h(q, v) = tau of ``model``, contacts and limits left out.

    h holds gravity, Coriolis and passive forces (springs, damping); tau are joint forces [N, N m]. Machine
    code of the smooth engine where it knows the model, MuJoCo where it does not (closed loops and the like);
    both agree to rounding. One instance serves one thread.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = copy.copy(model)
        self.model.actuator_gainprm[:] = 0.0
        self.model.actuator_biasprm[:] = 0.0
        self.model.jnt_actfrclimited[:] = 0
        disable = mujoco.mjtDisableBit
        self.model.opt.disableflags |= int(disable.mjDSBL_CONTACT | disable.mjDSBL_CONSTRAINT)
        self.compiled = not unsupported(self.model)
        self._data = mujoco.MjData(self.model)
        self._keyed: dict[bytes, Smooth] = {}

    @cached_property
    def smooth(self) -> Smooth:
        """The compiled model. Raises EngineError naming what the smooth engine cannot do."""
        return compile_model(self.model)

    @cached_property
    def pushed(self) -> Smooth:
        """The compiled model whose controls end with joint forces (nv,), for whole rollouts."""
        return compile_model(self.model, forces=True)

    def smooth_with(self, keyed: NDArray[np.bool_] | None) -> Smooth:
        """The compiled model in which the freedoms ``keyed`` (nv,) move as prescribed."""
        if keyed is None or not keyed.any():
            return self.smooth
        key = keyed.tobytes()
        if key not in self._keyed:
            self._keyed[key] = compile_model(self.model, keyed=keyed)
        return self._keyed[key]

    def inverse(self, q: Array, v: Array, a: Array) -> Array:
        """Joint forces (nv,) for acceleration ``a`` (nv,) at q (nq,), v (nv,)."""
        if not self.compiled:
            inertia, bias = self._mujoco(q, v)
            return np.asarray(inertia @ a + bias)
        call = self._inverse
        call.inputs["q"][:], call.inputs["v"][:], call.inputs["a"][:] = q, v, a
        call()
        return call.outputs["tau"].copy()

    def mass_matrix(self, q: Array) -> Array:
        """Inertia matrix M(q), (nv, nv)."""
        nv = self.model.nv
        if not self.compiled:
            return self._mujoco(q, np.zeros(nv))[0]
        call = self._inertia
        call.inputs["q"][:] = q
        call()
        return call.outputs["M"].reshape(nv, nv).copy()

    def weight(self, q: Array) -> Array:
        """Joint forces (nv,) that hold the mechanism still at q."""
        still = np.zeros(self.model.nv)
        return self.inverse(q, still, still)

    @cached_property
    def key(self) -> str:
        """Tells expressions of different models apart."""
        return key_of(model_fingerprint(self.model), code_fingerprint())

    def express(
        self,
        q: Sequence[Scalar],
        v: Sequence[Scalar],
        a: Sequence[Scalar],
        passive: NDArray[np.bool_] | None = None,
    ) -> list[Scalar]:
        """`inverse` as an expression of a graph; freedoms ``passive`` (nv,) get no force: they accelerate by
        themselves, not by ``a``."""
        from ..sim.dynamics.symbolic import Equations

        free = np.ones(self.model.nv, dtype=bool) if passive is None else passive
        layout = Layout(self.model, keyed_joints(self.model, ~free))
        prescribed = [q[i] for i in layout.q_keyed]
        prescribed += [x[i] for x in (v, a) for i in layout.v_keyed]
        given = {"q": [q[i] for i in layout.q_free], "v": [v[i] for i in layout.v_free], "w": prescribed}
        graph = next(x.graph for x in q if isinstance(x, Node))
        equations = Equations(self.model, layout, graph=graph, given=given)
        if passive is None:
            return equations.inverse(a)
        tau = equations.inverse(equations.acceleration("composite"))
        return [0.0 if free else x for x, free in zip(tau, passive, strict=True)]

    @cached_property
    def _inverse(self) -> Bound:
        return self.smooth.bind("inverse")

    @cached_property
    def _inertia(self) -> Bound:
        return self.smooth.bind("mass_matrix")

    def _mujoco(self, q: Array, v: Array) -> tuple[Array, Array]:
        """M and h by MuJoCo."""
        m, d = self.model, self._data
        d.qpos[:], d.qvel[:] = q, v
        mujoco.mj_fwdPosition(m, d)
        mujoco.mj_fwdVelocity(m, d)
        inertia = np.zeros((m.nv, m.nv))
        mujoco.mj_fullM(m, d, inertia)
        return inertia, np.asarray(d.qfrc_bias - d.qfrc_passive)


def difference(model: mujoco.MjModel, q: Array, to: Array) -> Array:
    """Tangent (nv,) from configuration ``q`` (nq,) to ``to`` (nq,)."""
    if model.nq == model.nv:  # no ball or free joint
        return np.asarray(to - q)
    out = np.empty(model.nv)
    mujoco.mj_differentiatePos(model, out, 1.0, q, to)
    return out


def differences(model: mujoco.MjModel, q: Array, to: Array) -> Array:
    """Tangents (n, nv) from configurations ``q`` (n, nq) to ``to`` (n, nq)."""
    if model.nq == model.nv:
        return np.asarray(to - q)
    return np.array([difference(model, a, b) for a, b in zip(q, to, strict=True)])


def moved(model: mujoco.MjModel, q: Array, by: Array) -> Array:
    """Configuration (nq,) that lies the tangent ``by`` (nv,) away from ``q``."""
    if model.nq == model.nv:
        return np.asarray(q + by)
    out = np.array(q, dtype=float)
    mujoco.mj_integratePos(model, out, by, 1.0)
    return out
