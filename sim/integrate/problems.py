"""What is integrated: first-order initial value problems, and how a MuJoCo model becomes one."""

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np

from ..errors import EngineError
from .tableau import Array

Derivative = Callable[[float, Array], Array]
Control = Callable[[float, Array], Array]


class Problem(Protocol):
    """dy/dt = f(t, y) on a manifold that is embedded in R^ndim."""

    @property
    def ndim(self) -> int:
        """Number of components of the state y."""

    def f(self, t: float, y: Array, /) -> Array:
        """Derivative dy/dt at time t [s], shape (ndim,), a new array; smooth beside the manifold too."""

    def project(self, y: Array, /) -> Array:
        """Nearest state on the manifold; the integrators apply it after each step."""


def _unchanged(y: Array) -> Array:
    return y


@dataclass(frozen=True)
class ODE:
    """A problem given by a function.

    Attributes:
        f: dy/dt = f(t, y).
        ndim: number of components of y.
        project: returns the nearest state on the manifold, identity where y is unconstrained.
    """

    f: Derivative
    ndim: int
    project: Callable[[Array], Array] = _unchanged


def quaternion_addresses(model: mujoco.MjModel) -> tuple[Array, Array]:
    """Addresses in qpos and qvel of all quaternions (wxyz) and their angular velocities.

    Returns:
        Integer arrays of shapes (n, 4) and (n, 3), a row for each ball or free joint.
    """
    offset = {int(mujoco.mjtJoint.mjJNT_FREE): 3, int(mujoco.mjtJoint.mjJNT_BALL): 0}
    joints = [(j, offset[int(kind)]) for j, kind in enumerate(model.jnt_type) if int(kind) in offset]
    q = [np.arange(4) + model.jnt_qposadr[j] + shift for j, shift in joints]
    v = [np.arange(3) + model.jnt_dofadr[j] + shift for j, shift in joints]
    return np.reshape(q, (-1, 4)).astype(int), np.reshape(v, (-1, 3)).astype(int)


def quaternion_rate(quat_wxyz: Array, omega: Array) -> Array:
    """Rates q' = 1/2 q (0, omega), omega in the body's frame; shapes (n, 4), (n, 3) -> (n, 4).

    Linear in q, so that it is smooth beside the unit sphere; |q| is an invariant of the exact flow.
    """
    w, x, y, z = quat_wxyz.T
    a, b, c = omega.T
    rate = (-x * a - y * b - z * c, w * a + y * c - z * b, w * b + z * a - x * c, w * c + x * b - y * a)
    return np.stack(rate, axis=1) / 2


class MujocoProblem:
    """The smooth dynamics of a MuJoCo model, y = (qpos, qvel, act), evaluated by `mj_forward`.

    Quaternions are integrated as an ODE in R^4 and normalised after each step, which keeps the order of every
    Runge-Kutta method: the exact flow stays on the sphere, so a step leaves it by its local error only.

    It owns one MjData, so that one thread at a time may evaluate it.
    """

    def __init__(self, model: mujoco.MjModel, control: Array | Control | None) -> None:
        self.model, self.data, self.control = model, mujoco.MjData(model), control
        self.ndim = model.nq + model.nv + model.na
        self._quat, self._omega = quaternion_addresses(model)
        # qpos address and qvel address of each coordinate that is not part of a quaternion
        in_quat = np.isin(np.arange(model.nq), self._quat)
        in_omega = np.isin(np.arange(model.nv), self._omega)
        self._plain_q, self._plain_v = np.flatnonzero(~in_quat), np.flatnonzero(~in_omega)

    def f(self, t: float, y: Array, /) -> Array:
        """Derivative (dq/dt, qacc, act_dot) at state y, shape (nq + nv + na,)."""
        nq, nv = self.model.nq, self.model.nv
        data = self.data
        data.time = t
        data.qpos[:], data.qvel[:], data.act[:] = y[:nq], y[nq : nq + nv], y[nq + nv :]
        if self.control is not None:
            data.ctrl[:] = self.control(t, y) if callable(self.control) else self.control
        data.qacc_warmstart[:] = 0
        mujoco.mj_forwardSkip(self.model, data, mujoco.mjtStage.mjSTAGE_NONE, 1)
        dy = np.empty(self.ndim)
        v = y[nq : nq + nv]
        dy[self._plain_q] = v[self._plain_v]
        if len(self._quat):
            dy[self._quat] = quaternion_rate(y[self._quat], v[self._omega])
        dy[nq : nq + nv] = data.qacc
        dy[nq + nv :] = data.act_dot
        return dy

    def project(self, y: Array, /) -> Array:
        """The state with all quaternions normalised."""
        if not len(self._quat):
            return y
        y = y.copy()
        quat = y[self._quat]
        y[self._quat] = quat / np.linalg.norm(quat, axis=1, keepdims=True)
        return y


def constraints_of(model: mujoco.MjModel) -> list[str]:
    """What in the model MuJoCo treats as a constraint, in words; empty when its dynamics is smooth."""
    from ..engines.touch import can_touch  # with the engines' interface: the dynamics alone need none

    off = model.opt.disableflags
    flag = mujoco.mjtDisableBit

    def on(*bits: int) -> bool:
        return not any(off & int(bit) for bit in (flag.mjDSBL_CONSTRAINT, *bits))

    limits = int(model.jnt_limited.sum() + model.tendon_limited.sum())
    friction = int((model.dof_frictionloss > 0).sum() + (model.tendon_frictionloss > 0).sum())
    found = {
        f"{model.neq} equality constraint(s)": model.neq > 0 and on(flag.mjDSBL_EQUALITY),
        f"{limits} joint or tendon limit(s)": limits > 0 and on(flag.mjDSBL_LIMIT),
        f"dry friction in {friction} joint(s) or tendon(s)": friction > 0 and on(flag.mjDSBL_FRICTIONLOSS),
        "geoms that may touch": on(flag.mjDSBL_CONTACT) and can_touch(model),
    }
    return [words for words, present in found.items() if present]


def mujoco_problem(
    model: mujoco.MjModel,
    *,
    control: Array | Control | None = None,
    drop_constraints: bool = False,
) -> MujocoProblem:
    """The smooth dynamics of a MuJoCo model as an initial value problem.

    Args:
        model: compiled model; its state is y = (qpos, qvel, act).
        control: constant controls, shape (nu,), or a function (t, y) -> controls; zero when None.
        drop_constraints: leave out contacts, limits, equalities and dry friction that the model has.

    Raises:
        EngineError: the model has constraints and `drop_constraints` is not set, or limits on activations.
    """
    found = constraints_of(model)
    if found and not drop_constraints:
        raise EngineError(
            f"the model is not smooth: it has {', '.join(found)}; integrate it with the contact engine, or "
            "leave them out with mujoco_problem(model, drop_constraints=True)"
        )
    if model.na and model.actuator_actlimited.any():
        raise EngineError("the model limits activations (actlimited), which a smooth ODE cannot express")
    if found:
        model = deepcopy(model)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    return MujocoProblem(model, control)
