"""The contact engine: MuJoCo's physics, with keyed motion prescribed at every evaluation."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import captured_warnings
from ..errors import EngineError
from ..kinds import BALL, FREE
from .common import HUGE, Broken, Ticks, fastest_joint, joint_of_largest, place_of, recorded, steps_per_tick
from .derive import apply_wrenches
from .interface import Array, Controls, Held, Problem, Role, Segment, State
from .prescribe import Prescriber
from .tick import SampledTick, sampled_quickly
from .timed import Timed, TimedInputs
from .touch import Touch

INTEGRATORS = {
    "euler": mujoco.mjtIntegrator.mjINT_EULER,
    "rk4": mujoco.mjtIntegrator.mjINT_RK4,
    "implicit": mujoco.mjtIntegrator.mjINT_IMPLICIT,
    "implicitfast": mujoco.mjtIntegrator.mjINT_IMPLICITFAST,
    "discrete": mujoco.mjtIntegrator.mjINT_DISCRETE,
}
ORDER = {"euler": 1, "rk4": 4, "implicit": 1, "implicitfast": 1, "discrete": 1}

_CHUNK = 1024  # steps whose prescribed inputs are evaluated at once
_BLOWN_UP = (mujoco.mjtWarning.mjWARN_BADQACC, mujoco.mjtWarning.mjWARN_BADQPOS)
_STATE = int(mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL | mujoco.mjtState.mjSTATE_ACT)


class ContactEngine:
    """MuJoCo behind the common interface."""

    name = "contact"

    def order(self, integrator: str) -> int:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        return ORDER[integrator]

    def run(
        self,
        problem: Problem,
        t_span: tuple[float, float],
        controls: Controls | None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Segment:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        if problem.integrator not in INTEGRATORS:
            raise EngineError(
                f"the contact engine has no integrator {problem.integrator!r}; "
                f"it has: {', '.join(sorted(INTEGRATORS))}"
            )
        # a run that blows up is reported by its segment; MuJoCo would write to stderr and a log file
        with captured_warnings():
            return _Run(problem, t_span, controls).segment(progress)


class _Run:
    """State of one run."""

    def __init__(self, problem: Problem, t_span: tuple[float, float], controls: Controls | None) -> None:
        self.problem, self.t0 = problem, t_span[0]
        self.controls = sampled_quickly(controls, t_span[1] - t_span[0])
        self.h = problem.step
        self.steps = round((t_span[1] - t_span[0]) / self.h)
        self.per_tick = steps_per_tick(controls, self.h)
        self.prescriber = Prescriber(problem.model, problem.dofs(Role.KEYED))
        self.model = self.prescriber.model
        self.model.opt.timestep = self.h
        self.model.opt.integrator = int(INTEGRATORS[problem.integrator])
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.data = mujoco.MjData(self.model)
        self.warnings = [self.data.warning[int(w)] for w in _BLOWN_UP]
        self.timed = Timed(problem)
        self.chunk_first = -1
        self.jumps = self.timed.jumps(self.t0, self.h, self.steps)
        self.held = Held(np.zeros(self.model.nu), np.zeros(self.model.nv))
        self.joints = _places(self.model)
        self.nq, self.nqv = self.model.nq, self.model.nq + self.model.nv  # where parts of a state end
        self.width = self.nqv + self.model.na
        self.touch = Touch(self.model)
        self.k = 0  # the step to come
        self.torn: tuple[int, Array] | None = None  # a step that has begun, and the state before it
        self.samples: list[tuple[float, State]] = []
        self.ticks = Ticks(self.model)

    def segment(self, progress: Callable[[float], None] | None) -> Segment:
        started, status, message, failure = time.perf_counter(), "done", "", None
        try:
            self._start()
            while True:
                x = self._state()
                if message := self._nonsense(self.k, x):
                    status = "diverged"
                    break
                self._stop_at(self.k, x)
                if self.k >= self.steps:
                    break
                self._advance(self._until_next(self.k))
                if progress:
                    progress(self.t0 + self.k * self.h)
        except KeyboardInterrupt:
            status, message = "interrupted", f"interrupted at t = {self._keep_last():.4g} s"
        except Exception as error:
            status, message, failure = (
                "failed",
                f"failed at t = {self._keep_last():.4g} s: {place_of(error)}",
                error,
            )
        segment = self._result(status, message, self.k, time.perf_counter() - started)
        if failure is not None:
            raise Broken(segment) from failure
        return segment

    def _keep_last(self) -> float:
        """Record the state after the last whole step of a run that was stopped; its time [s]."""
        d = self.data
        self.k, x = self.torn or (round((d.time - self.t0) / self.h), self._state())
        last, t = self._parts(x), self.t0 + self.k * self.h
        if (
            not (self.samples and self.samples[-1][0] >= t)
            and fastest_joint(self.model, last.q, last.v) is None
        ):
            self.samples.append((t, last))
        return t

    def _start(self) -> None:
        d, s = self.data, self.problem.state0
        d.qpos[:], d.qvel[:], d.time = s.q, s.v, self.t0
        if self.model.na:
            d.act[:] = s.act
        inputs = self.timed.at(np.array([self.t0]))
        d.ctrl[:] = self.held.ctrl
        self._prescribe_state(inputs, 0)
        self._apply(inputs, 0)
        self.prescriber.settle(d, self.held.qfrc, inputs.a[0])

    def _until_next(self, k: int) -> int:
        stops = [self.steps - k, self.problem.sample_every - k % self.problem.sample_every]
        if self.per_tick:
            stops.append(self.per_tick - k % self.per_tick)
        return min(stops)

    def _stop_at(self, k: int, x: Array) -> None:
        """Record and sample the controller at state ``x``, where step ``k`` begins, if it is time for it."""
        t = self.t0 + k * self.h
        if k % self.problem.sample_every == 0 or k == self.steps:
            self.samples.append((t, self._parts(x)))
        if self.controls and self.per_tick and k % self.per_tick == 0 and k < self.steps:
            q, v, _ = self._parts(x.copy())
            self.held = self.controls.sample(k // self.per_tick, t, q, v)
            self.ticks.add(t, self.held)

    def _advance(self, n: int) -> None:
        step = self._plain
        if not self.timed.empty:
            step = self._runge_kutta if self.problem.integrator == "rk4" else self._native
        d, t0, h, look = self.data, self.t0, self.h, self.touch.look
        d.ctrl[:], d.qfrc_applied[:] = self.held.ctrl, self.held.qfrc
        for k in range(self.k, self.k + n):
            if k in self.jumps:
                self._jump(k)
            step(k)
            self.k = k + 1
            look(d, t0 + k * h)

    def _plain(self, k: int) -> None:
        """A step without prescribed inputs; the integrator is MuJoCo's own."""
        self.data.time = self.t0 + k * self.h
        mujoco.mj_step(self.model, self.data)

    def _jump(self, k: int) -> None:
        """Velocities that keyed joints take up at once pull the others along: M_pp dv_p = -M_pk dv_k."""
        d, p = self.data, self.prescriber
        mujoco.mj_fwdPosition(self.model, d)
        impulse, dv = np.zeros((1, self.model.nv)), np.zeros((1, self.model.nv))
        impulse[0, p.keyed] = p.armature * self.jumps[k]
        mujoco.mj_solveM(self.model, d, dv, impulse)
        dv[0, p.keyed] = 0.0
        d.qvel[:] += dv[0]

    def _inputs(self, k: int) -> tuple[tuple[TimedInputs, TimedInputs, TimedInputs], int]:
        """Prescribed inputs at the start, the middle (where RK4 asks) and the end of a chunk of steps, and
        the row of step ``k`` in them. The end is the limit from the left: keys may bend there."""
        first = k - k % _CHUNK
        if first != self.chunk_first:
            n, h = min(_CHUNK, self.steps - first), self.h
            begin = self.t0 + np.arange(first, first + n) * h
            end = self.t0 + np.arange(first + 1, first + n + 1) * h
            at = self.timed.at(begin)
            middle = self.timed.at(begin + h / 2) if self.problem.integrator == "rk4" else at
            self.chunk = at, middle, self.timed.at(end, left=True)
            self.chunk_first = first
        return self.chunk, k - first

    def _runge_kutta(self, k: int) -> None:
        """Classical RK4 whose stages see the prescribed inputs at their own times.

        Orientation is integrated as the quaternion ODE qdot = q * (0, w) / 2 and normalised after the
        step, which keeps order 4.
        """
        h, d = self.h, self.data
        (begin, middle, end), row = self._inputs(k)
        x0 = self._state()
        self.torn = k, x0
        rate, change = np.empty(self.width), np.zeros(self.width)
        for inputs, c, weight in ((begin, 0.0, 6), (middle, 0.5, 3), (middle, 0.5, 3), (end, 1.0, 6)):
            if c:
                mujoco.mj_setState(self.model, d, x0 + c * h * rate, _STATE)
                self._prescribe_state(inputs, row)
            d.time = self.t0 + (k + c) * h
            self._apply(inputs, row)
            self.prescriber.forward(d, inputs.a[row])
            self._rate(rate)
            change += h / weight * rate
        mujoco.mj_setState(self.model, d, x0 + change, _STATE)
        mujoco.mj_normalizeQuat(self.model, d.qpos)
        self._land(k + 1)

    def _native(self, k: int) -> None:
        """MuJoCo's one-stage integrators; keyed joints get the mean acceleration over the step."""
        d, p = self.data, self.prescriber
        (begin, _, end), row = self._inputs(k)
        self.torn = k, self._state()
        self._apply(begin, row)
        if len(p.keyed):
            p.push(d, (end.v[row] - begin.v[row]) / self.h)
        mujoco.mj_step(self.model, d)
        if len(p.keyed):
            p.observe(d)
        self._land(k + 1)

    def _land(self, k: int) -> None:
        """Put keyed joints where their keys say at the start of step ``k``, free of rounding drift."""
        self.data.time = self.t0 + k * self.h
        if k < self.steps:
            (begin, _, _), row = self._inputs(k)
            self._prescribe_state(begin, row)
        else:
            self._prescribe_state(self.timed.at(np.array([self.data.time])), 0)
        self.torn = None

    def _prescribe_state(self, inputs: TimedInputs, row: int) -> None:
        self.data.qpos[self.timed.qpos] = inputs.q[row]
        self.data.qvel[self.timed.keyed] = inputs.v[row]

    def _apply(self, inputs: TimedInputs, row: int) -> None:
        """Commands of servos and wrenches of one evaluation."""
        if len(self.timed.servos):
            self.data.ctrl[self.timed.servos] = inputs.ctrl[row]
        if len(self.timed.bodies):
            apply_wrenches(self.model, self.data, self.timed, inputs.wrench[row])

    def _rate(self, out: Array) -> None:
        """Write the time derivative of the state (nq + nv + na,), after an evaluation there."""
        d, j = self.data, self.joints
        out[j.scalar_q] = d.qvel[j.scalar_v]
        if len(j.quat_q):
            out[j.quat_q] = _quaternion_rates(d.qpos[j.quat_q].tolist(), d.qvel[j.quat_v].tolist())
        out[self.nq : self.nqv] = d.qacc
        out[self.nqv :] = d.act_dot

    def _state(self) -> Array:
        """The state (nq + nv + na,): q, v, act."""
        x = np.empty(self.width)
        mujoco.mj_getState(self.model, self.data, x, _STATE)
        return x

    def _parts(self, x: Array) -> State:
        return State(x[: self.nq], x[self.nq : self.nqv], x[self.nqv :])

    def _nonsense(self, k: int, x: Array) -> str:
        """Why the state ``x`` at step ``k`` makes no sense, or an empty string."""
        bad_acceleration, bad_position = self.warnings
        blown_up = bad_acceleration.number or bad_position.number
        if math.hypot(*x.tolist()) < HUGE and not blown_up:  # nearly always, and quickly told
            return ""
        joint = fastest_joint(self.model, *self._parts(x)[:2])
        if blown_up:
            joint = joint_of_largest(self.model, np.abs(self.data.qacc))
        if joint is None:
            return ""
        return (
            f"diverged at t = {self.t0 + k * self.h:.4g} s at joint {joint!r}: "
            f"with {self.problem.integrator} and a step of {self.h:g} s {self._cause()}"
        )

    def _cause(self) -> str:
        m, h = self.model, self.h
        kp = float(np.max(np.abs(m.actuator_gainprm[:, 0]), initial=0.0))
        stiff = float(np.max(np.abs(m.jnt_stiffness), initial=0.0))
        if max(kp, stiff) * h * h > 1e-3 * float(m.stat.meaninertia):
            return (
                f"the springs or servo gains (up to {max(kp, stiff):g}) are probably too stiff; "
                "try integrator = 'discrete' or a smaller step"
            )
        sooner = "a smaller one" + (", or a smaller period of the controller" if self.controls else "")
        return f"the motion is too fast for the step; try {sooner}, or check forces and initial state"

    def _result(self, status: str, message: str, k: int, wall: float) -> Segment:
        stats: dict[str, Any] = {
            "engine": "contact",
            "integrator": self.problem.integrator,
            "step": self.h,
            "steps": k,
            "evaluations": k * (4 if self.problem.integrator == "rk4" else 1),
            "wall_s": wall,
        }
        if isinstance(self.controls, SampledTick):
            stats |= self.controls.stats
        return Segment(
            **recorded(self.model, self.samples, self.ticks),
            status=status,
            message=message,
            stats=stats,
            events=tuple(self.touch.events),
        )


class _Places(NamedTuple):
    """Where in qpos and qvel are coordinates whose rates are velocities (n,) and quaternions (m, 4 and 3)."""

    scalar_q: NDArray[np.intp]
    scalar_v: NDArray[np.intp]
    quat_q: NDArray[np.intp]
    quat_v: NDArray[np.intp]


def _places(model: mujoco.MjModel) -> _Places:
    scalar_q: list[int] = []
    scalar_v: list[int] = []
    quat_q: list[int] = []
    quat_v: list[int] = []
    for joint in range(model.njnt):
        iq, iv, kind = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint]), int(model.jnt_type[joint])
        if kind == FREE:
            scalar_q += [iq, iq + 1, iq + 2]
            scalar_v += [iv, iv + 1, iv + 2]
            iq, iv = iq + 3, iv + 3
        if kind in (FREE, BALL):
            quat_q.append(iq)
            quat_v.append(iv)
        else:
            scalar_q.append(iq)
            scalar_v.append(iv)
    starts_q, starts_v = np.array(quat_q, dtype=np.intp), np.array(quat_v, dtype=np.intp)
    return _Places(
        np.array(scalar_q, dtype=np.intp),
        np.array(scalar_v, dtype=np.intp),
        starts_q[:, None] + np.arange(4),
        starts_v[:, None] + np.arange(3),
    )


def _quaternion_rates(
    quaternions: list[list[float]], spins: list[list[float]]
) -> list[tuple[float, float, float, float]]:
    """q * (0, w) / 2 of quaternions (n, 4) and angular velocities (n, 3); few: quicker than NumPy."""
    out = []
    for (w, x, y, z), (wx, wy, wz) in zip(quaternions, spins, strict=True):
        p, r, s = 0.5 * wx, 0.5 * wy, 0.5 * wz
        out.append(
            (-x * p - y * r - z * s, w * p + y * s - z * r, w * r + z * p - x * s, w * s + x * r - y * p)
        )
    return out
