"""How a control law meets a scene: sampled at its own period, held in between, through the actuators."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import name_of
from .clip import Clip
from .engines.interface import Array, Drive, Held, Problem, Role
from .errors import EngineError
from .formula import Formula
from .kinds import SCALAR

_CHUNK = 1024  # ticks whose targets are evaluated at once

ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
_AFFINE_GAIN = (int(mujoco.mjtGain.mjGAIN_FIXED), int(mujoco.mjtGain.mjGAIN_AFFINE))
_AFFINE_BIAS = (int(mujoco.mjtBias.mjBIAS_NONE), int(mujoco.mjtBias.mjBIAS_AFFINE))


class Target(NamedTuple):
    """Where keys and live goals want the scene: q (nq,), v (nv,), a (nv,)."""

    q: Array
    v: Array
    a: Array


class Law(Protocol):
    """A control law: the same input and memory give the same output, in any order of calls.

    One that also has ``lost(v)`` tells forces (nv,) that act at speeds v (nv,) beside what drives give. One
    that has ``formula(period)`` gives itself as a :class:`~pantograph.sim.formula.Formula`, or None. One that
    has ``remarks(q, memory)`` tells in sentences how a run went that ended at q (nq,) with this memory.
    """

    def start(self) -> Any:
        """Memory before the first sample; None for a law without memory."""
        ...

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: Any) -> tuple[Array, Any]:
        """Joint forces tau (nv,) [N, N m] at time t [s] and state q (nq,), v (nv,); and the new memory."""
        ...


class Sampled:
    """A law sampled every ``period`` seconds, its forces delivered through the model's actuators.

    A tracked joint with an actuator in the drive ``controller`` gets its force from it, within the limits
    of the actuator; one without gets it as an ideal joint force, unless a servo moves it along its keys.
    """

    def __init__(self, law: Law, problem: Problem, period: float) -> None:
        self.law, self.period = law, period
        self.clip: Clip = problem.clip
        by_servo = np.isin(problem.model.dof_jntid, list(keyed_by_servo(problem.model, problem.drives)))
        self.tracked = problem.dofs(Role.TRACKED) & ~by_servo
        self.actuators = controlled_actuators(problem.model, problem.drives)
        self.memory = law.start()
        self.lost = getattr(law, "lost", None)
        self.all_tracked = bool(self.tracked.all())
        self.idle = np.zeros(problem.model.nu)
        self.idle.setflags(write=False)
        self._first, self._targets = -1, self.clip.evaluate(np.zeros(1))
        self.live = problem.live(period) if problem.live is not None else None

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        """See :class:`~pantograph.sim.engines.interface.Controls`.

        Raises EngineError for forces that are not finite; MuJoCo would take them for zero.
        """
        target = self._target(k)
        if self.live is not None:
            target = Target(*self.live.at(t, q, v, target))
        tau, self.memory = self.law(t, q, v, target, self.memory)
        qfrc = tau.copy() if self.all_tracked else np.where(self.tracked, tau, 0.0)
        if not np.isfinite(qfrc).all():
            joint = name_of(self.clip.model, "joint", int(self.clip.model.dof_jntid[~np.isfinite(qfrc)][0]))
            raise EngineError(f"the controller gives no finite force for joint {joint!r}")
        ctrl = self.idle
        if len(self.actuators.index):
            ctrl = self.idle.copy()
            ctrl[self.actuators.index] = self.actuators.ctrl_for(qfrc, q, v)
            qfrc[self.actuators.dof] = 0.0
        if self.lost is not None:
            qfrc += self.lost(v)
        return Held(ctrl, qfrc)

    @cached_property
    def formula(self) -> Formula | None:
        """The law as an expression, where it is one and its targets are known beforehand."""
        make = getattr(self.law, "formula", None)
        if make is None or self.live is not None or self.lost is not None or not self.actuators.plain:
            return None
        found: Formula | None = make(self.period)
        return found

    def rows(self, first: int, count: int) -> Array:
        """What the law's formula needs at ``count`` ticks from ``first`` on, (count, width)."""
        assert self.formula is not None
        ticks = np.arange(first, first + count)
        return self.formula.rows(first, Target(*self.clip.evaluate(ticks * self.period)))

    def remarks(self, q: Array) -> tuple[str, ...]:
        """What the law has to say of a run that ended at q (nq,)."""
        tell = getattr(self.law, "remarks", None)
        return () if tell is None else tuple(tell(q, self.memory))

    def _target(self, k: int) -> Target:
        """Where the keys are at tick ``k``; evaluated some ticks at a time."""
        first = k - k % _CHUNK
        if first != self._first:
            self._targets = self.clip.evaluate(np.arange(first, first + _CHUNK) * self.period)
            self._first = first
        targets, i = self._targets, k - first
        return Target(targets.q[i], targets.v[i], targets.a[i])


@dataclass(frozen=True)
class JointActuators:
    """The n actuators, each on one joint, that a controller drives, by MuJoCo's affine law:
    force = (g0 + g1 l + g2 l') ctrl + b0 + b1 l + b2 l', l = gear q, joint force = gear * force
    (MuJoCo documentation, Computation, Actuation model).

    index, dof, qpos (n,) in the model; gear, low, high (n,); gain, bias (n, 3); up, down (n,): parts of their
    joint's force that they give when it is positive, and when it is negative.
    """

    index: NDArray[np.intp]
    dof: NDArray[np.intp]
    qpos: NDArray[np.intp]
    gear: Array
    gain: Array
    bias: Array
    low: Array
    high: Array
    up: Array
    down: Array

    def ctrl_for(self, tau: Array, q: Array, v: Array) -> Array:
        """The ctrl (n,) that give joint forces ``tau`` (nv,) [N, N m] now, within the control ranges."""
        asked = tau[self.dof]
        force, gain = asked * np.where(asked < 0.0, self.down, self.up) / self.gear, self.gain[:, 0]
        if not self._motors:
            length, rate = self.gear * q[self.qpos], self.gear * v[self.dof]
            gain = gain + self.gain[:, 1] * length + self.gain[:, 2] * rate
            force = force - self.bias[:, 0] - self.bias[:, 1] * length - self.bias[:, 2] * rate
        ctrl = np.divide(force, gain, out=np.zeros_like(force), where=gain != 0.0)
        return np.asarray(np.minimum(np.maximum(ctrl, self.low), self.high))

    @property
    def plain(self) -> bool:
        """Whether gains are constant."""
        return not self.gain[:, 1:].any()

    @cached_property
    def _motors(self) -> bool:
        """Whether forces are ctrl times a constant."""
        return not (self.bias.any() or self.gain[:, 1:].any())


def controlled_actuators(model: mujoco.MjModel, drives: NDArray[np.int8]) -> JointActuators:
    """The actuators that the controller drives."""
    index = np.flatnonzero(drives == Drive.CONTROLLER)
    joints = model.actuator_trnid[index, 0]
    limited = model.actuator_ctrllimited[index].astype(bool)
    low, high = (
        np.where(limited, model.actuator_ctrlrange[index, k], s * np.inf) for k, s in ((0, -1), (1, 1))
    )
    up, down = _shares(model, index, model.jnt_dofadr[joints], low, high)
    return JointActuators(
        index=index,
        dof=model.jnt_dofadr[joints].astype(np.intp),
        qpos=model.jnt_qposadr[joints].astype(np.intp),
        gear=model.actuator_gear[index, 0].copy(),
        gain=model.actuator_gainprm[index, :3].copy(),
        bias=model.actuator_biasprm[index, :3].copy(),
        low=low,
        high=high,
        up=up,
        down=down,
    )


def _shares(
    model: mujoco.MjModel, index: NDArray[np.intp], dof: NDArray[np.intp], low: Array, high: Array
) -> tuple[Array, Array]:
    """Parts (n,) of positive and of negative joint forces that actuators of one joint give, as they can."""
    with np.errstate(invalid="ignore"):
        ends = np.sort(model.actuator_gainprm[index, :1] * np.column_stack([low, high]), axis=1)
    ends[np.isnan(ends)] = 0.0  # no gain
    forced = model.actuator_forcelimited[index].astype(bool)
    ends[forced] = np.clip(ends[forced], *model.actuator_forcerange[index][forced].T[..., None])
    ends = np.sort(model.actuator_gear[index, :1] * ends, axis=1)
    parts = []
    for able in (np.maximum(ends[:, 1], 0.0), np.maximum(-ends[:, 0], 0.0)):
        part = np.ones(len(index))
        for joint in np.unique(dof):
            mine = dof == joint
            each = np.isinf(able[mine]) if np.isinf(able[mine]).any() else able[mine]
            part[mine] = each / each.sum() if each.any() else 1.0 / mine.sum()
        parts.append(part)
    return parts[0], parts[1]


def keyed_by_servo(model: mujoco.MjModel, drives: NDArray[np.int8]) -> set[int]:
    """Joints that an actuator of their own moves by keys, and none by the controller."""
    on_joint = np.isin(model.actuator_trntype, ON_JOINT)
    keyed, controlled = (
        set(model.actuator_trnid[on_joint & (drives == drive), 0].tolist())
        for drive in (Drive.KEYS, Drive.CONTROLLER)
    )
    return keyed - controlled


def why_not_controllable(model: mujoco.MjModel, i: int) -> str:
    """Why a controller cannot drive actuator ``i``; empty when it can."""
    if int(model.actuator_trntype[i]) not in ON_JOINT:
        return "it does not act on one joint"
    joint = int(model.actuator_trnid[i, 0])
    if int(model.jnt_type[joint]) not in SCALAR:
        return "it acts on a ball or free joint"
    if model.actuator_dyntype[i] != mujoco.mjtDyn.mjDYN_NONE:
        return "it has activation dynamics"
    gain, bias = int(model.actuator_gaintype[i]), int(model.actuator_biastype[i])
    if gain not in _AFFINE_GAIN or bias not in _AFFINE_BIAS:
        return "its force is no affine function of its control"
    return ""


def is_position_servo(model: mujoco.MjModel, i: int) -> bool:
    """Whether actuator ``i`` pulls its length towards its control: force = kp (ctrl - l) - ..."""
    gain, bias = model.actuator_gainprm[i], model.actuator_biasprm[i]
    return bool(
        model.actuator_biastype[i] == mujoco.mjtBias.mjBIAS_AFFINE and gain[0] > 0 and bias[1] == -gain[0]
    )
