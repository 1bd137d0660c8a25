"""The contact engine: MuJoCo's physics, with keyed motion prescribed at every evaluation."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any

import mujoco
import numpy as np

from ...models import captured_warnings
from ..errors import EngineError
from ..kinds import BALL, FREE
from .common import Broken, Ticks, fastest_joint, joint_of_largest, place_of, recorded, steps_per_tick
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
        self.timed = Timed(problem)
        self.chunk_first = -1
        self.jumps = self.timed.jumps(self.t0, self.h, self.steps)
        self.held = Held(np.zeros(self.model.nu), np.zeros(self.model.nv))
        self.quat = _quaternion_joints(self.model)
        self.evaluations = 0
        self.touch = Touch(self.model)
        self.k = 0  # the step to come
        self.torn: tuple[int, State] | None = None  # a step that has begun, and the state before it
        self.samples: list[tuple[float, State]] = []
        self.ticks = Ticks(self.model)

    def segment(self, progress: Callable[[float], None] | None) -> Segment:
        started, status, message, failure = time.perf_counter(), "done", "", None
        try:
            self._start()
            while True:
                if message := self._nonsense(self.k):
                    status = "diverged"
                    break
                self._stop_at(self.k)
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
        now = State(d.qpos.copy(), d.qvel.copy(), d.act.copy())
        self.k, last = self.torn or (round((d.time - self.t0) / self.h), now)
        t = self.t0 + self.k * self.h
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
        self._prescribe_state(inputs, 0)
        self._apply(inputs, 0)
        self.prescriber.settle(d, self.held.qfrc, inputs.a[0])

    def _until_next(self, k: int) -> int:
        stops = [self.steps - k, self.problem.sample_every - k % self.problem.sample_every]
        if self.per_tick:
            stops.append(self.per_tick - k % self.per_tick)
        return min(stops)

    def _stop_at(self, k: int) -> None:
        """Record and sample the controller where step ``k`` begins, if it is time for it."""
        t, d = self.t0 + k * self.h, self.data
        if k % self.problem.sample_every == 0 or k == self.steps:
            self.samples.append((t, State(d.qpos.copy(), d.qvel.copy(), d.act.copy())))
        if self.controls and self.per_tick and k % self.per_tick == 0 and k < self.steps:
            self.held = self.controls.sample(k // self.per_tick, t, d.qpos.copy(), d.qvel.copy())
            self.ticks.add(t, self.held)

    def _advance(self, n: int) -> None:
        step = self._plain
        if not self.timed.empty:
            step = self._runge_kutta if self.problem.integrator == "rk4" else self._native
        self.data.ctrl[:] = self.held.ctrl
        for k in range(self.k, self.k + n):
            if k in self.jumps:
                self._jump(k)
            step(k)
            self.k = k + 1
            self.touch.look(self.data, self.t0 + k * self.h)

    def _plain(self, k: int) -> None:
        """A step without prescribed inputs; the integrator is MuJoCo's own."""
        d = self.data
        d.qfrc_applied[:] = self.held.qfrc
        d.time = self.t0 + k * self.h
        mujoco.mj_step(self.model, d)
        self.evaluations += 4 if self.problem.integrator == "rk4" else 1

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
        """Prescribed inputs at the start, the middle and the end of a chunk of steps, and the row of step
        ``k`` in them. The end is the limit from the left: keys may bend there."""
        first = k - k % _CHUNK
        if first != self.chunk_first:
            n, h = min(_CHUNK, self.steps - first), self.h
            begin = self.t0 + np.arange(first, first + n) * h
            end = self.t0 + np.arange(first + 1, first + n + 1) * h
            self.chunk = (self.timed.at(begin), self.timed.at(begin + h / 2), self.timed.at(end, left=True))
            self.chunk_first = first
        return self.chunk, k - first

    def _runge_kutta(self, k: int) -> None:
        """Classical RK4 whose stages see the prescribed inputs at their own times.

        Orientation is integrated as the quaternion ODE qdot = q * (0, w) / 2 and normalised after the
        step, which keeps order 4.
        """
        h, d = self.h, self.data
        (begin, middle, end), row = self._inputs(k)
        q0, v0, act0 = d.qpos.copy(), d.qvel.copy(), d.act.copy()
        self.torn = k, State(q0, v0, act0)
        rates: list[tuple[Array, Array, Array]] = []
        for inputs, c in zip((begin, middle, middle, end), (0.0, 0.5, 0.5, 1.0), strict=True):
            if rates:
                dq, dv, dact = rates[-1]
                d.qpos[:], d.qvel[:], d.act[:] = q0 + c * h * dq, v0 + c * h * dv, act0 + c * h * dact
            d.time = self.t0 + (k + c) * h
            self._prescribe_state(inputs, row)
            self._apply(inputs, row)
            self.prescriber.forward(d, self.held.qfrc, inputs.a[row])
            rates.append((self._qdot(), d.qacc.copy(), d.act_dot.copy()))
        weights = (h / 6, h / 3, h / 3, h / 6)
        d.qpos[:] = q0 + sum(w * r[0] for w, r in zip(weights, rates, strict=True))
        d.qvel[:] = v0 + sum(w * r[1] for w, r in zip(weights, rates, strict=True))
        d.act[:] = act0 + sum(w * r[2] for w, r in zip(weights, rates, strict=True))
        mujoco.mj_normalizeQuat(self.model, d.qpos)
        self.evaluations += 4
        self._land(k + 1)

    def _native(self, k: int) -> None:
        """MuJoCo's one-stage integrators; keyed joints get the mean acceleration over the step."""
        h, d, p = self.h, self.data, self.prescriber
        (begin, _, end), row = self._inputs(k)
        self.torn = k, State(d.qpos.copy(), d.qvel.copy(), d.act.copy())
        self._prescribe_state(begin, row)
        self._apply(begin, row)
        d.qfrc_applied[:] = self.held.qfrc
        a_key = (end.v[row] - begin.v[row]) / h
        if len(p.keyed):
            p.push(d, a_key)
        mujoco.mj_step(self.model, d)
        if len(p.keyed):
            p.observe(d)
        self.evaluations += 1
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
        """Controls and wrenches of one evaluation."""
        d = self.data
        d.ctrl[:] = self.held.ctrl
        d.ctrl[self.timed.servos] = inputs.ctrl[row]
        apply_wrenches(self.model, d, self.timed, inputs.wrench[row])

    def _qdot(self) -> Array:
        """Time derivative of qpos (nq,): velocities, and quaternion rates of ball and free joints."""
        d, m = self.data, self.model
        out = np.empty(m.nq)
        scalar_q, scalar_v, quat_q, quat_v = self.quat
        out[scalar_q] = d.qvel[scalar_v]
        for iq, iv in zip(quat_q, quat_v, strict=True):
            w, x, y, z = d.qpos[iq : iq + 4]
            p, r, s = 0.5 * d.qvel[iv : iv + 3]
            out[iq] = -x * p - y * r - z * s
            out[iq + 1] = w * p + y * s - z * r
            out[iq + 2] = w * r + z * p - x * s
            out[iq + 3] = w * s + x * r - y * p
        return out

    def _nonsense(self, k: int) -> str:
        """Why the state at step ``k`` makes no sense, or an empty string."""
        d, m = self.data, self.model
        joint = fastest_joint(m, d.qpos, d.qvel)
        if any(d.warning[int(w)].number for w in _BLOWN_UP):
            joint = joint_of_largest(m, np.abs(d.qacc))
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
        return "the motion is too fast for the step; try a smaller one, or check forces and initial state"

    def _result(self, status: str, message: str, k: int, wall: float) -> Segment:
        stats: dict[str, Any] = {
            "engine": "contact",
            "integrator": self.problem.integrator,
            "step": self.h,
            "steps": k,
            "evaluations": self.evaluations,
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


def _quaternion_joints(model: mujoco.MjModel) -> tuple[Array, Array, list[int], list[int]]:
    """Indices (qpos, dof) of coordinates that are their own rates, and starts of quaternion parts."""
    scalar_q: list[int] = []
    scalar_v: list[int] = []
    quat_q: list[int] = []
    quat_v: list[int] = []
    for joint in range(model.njnt):
        iq, iv, kind = model.jnt_qposadr[joint], model.jnt_dofadr[joint], int(model.jnt_type[joint])
        if kind == FREE:
            scalar_q += [iq, iq + 1, iq + 2]
            scalar_v += [iv, iv + 1, iv + 2]
            iq, iv = iq + 3, iv + 3
        if kind in (FREE, BALL):
            quat_q.append(int(iq))
            quat_v.append(int(iv))
        else:
            scalar_q.append(int(iq))
            scalar_v.append(int(iv))
    return np.array(scalar_q, dtype=int), np.array(scalar_v, dtype=int), quat_q, quat_v
