"""The smooth engine behind the common interface: compiled equations of motion, limits as located impacts."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ...models import name_of
from ..errors import EngineError
from .common import HUGE, fastest_joint, recorded, rows, steps_per_tick
from .compiled import CHUNK, Compiled
from .interface import Array, Controls, Event, Held, Problem, Segment, State
from .limits import Limit, limits_of
from .timed import Timed

if TYPE_CHECKING:
    from ..integrate import Tableau

RESTITUTION = 0.0  # a joint that meets its limit stops there; servo arms do not bounce


def methods() -> dict[str, int]:
    """Names of the methods, and their orders."""
    from ..integrate import TABLEAUS

    return {name: tableau.order for name, tableau in TABLEAUS.items()}


def adaptive_methods() -> tuple[str, ...]:
    """Names of the methods that can follow a tolerance."""
    from ..integrate import TABLEAUS

    return tuple(name for name, tableau in TABLEAUS.items() if tableau.adaptive)


def differences(problem: Problem) -> list[str]:
    """Physics that this engine models otherwise than MuJoCo, as sentences; no matter of step or order."""
    from ..dynamics.support import differences as of_model

    width = friction_width(problem.model, mobility(problem), problem.step)
    found = [f"otherwise than MuJoCo: {line}" for line in of_model(problem.model, friction_width=width)]
    if limits_of(problem).each:
        found.append(f"a joint that meets its limit stops there (restitution {RESTITUTION:g})")
    return found


def friction_width(model: mujoco.MjModel, mobility: Array, step: float) -> float | None:
    """Speed [rad/s, m/s] below which dry friction is smoothed; None without friction.

    At least 0.01, and wide enough that the smoothed force is not stiff for the step: the rate
    friction / (inertia width) stays below 1/step.
    """
    off = int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    if model.opt.disableflags & off or not model.dof_frictionloss.any():
        return None
    return max(0.01, float(np.max(model.dof_frictionloss * mobility)) * step)


class SmoothEngine:
    """Runge-Kutta integration of a scene's own machine code."""

    name = "smooth"

    def order(self, integrator: str) -> int:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        return methods()[integrator]

    def run(
        self,
        problem: Problem,
        t_span: tuple[float, float],
        controls: Controls | None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Segment:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        from ..integrate import TABLEAUS

        if problem.integrator not in TABLEAUS:
            listing = ", ".join(sorted(TABLEAUS))
            raise EngineError(
                f"the smooth engine has no integrator {problem.integrator!r}; it has: {listing}"
            )
        if problem.wrenches:
            raise EngineError("the smooth engine takes no forces on bodies; use engine = 'contact'")
        run = _Run(problem, t_span, controls, TABLEAUS[problem.integrator])
        return run.segment(progress) if problem.tolerance is None else run.adaptive(problem.tolerance)


class _Run:
    """State of one run: the whole model's q, v, act at the start of a step."""

    def __init__(
        self, problem: Problem, t_span: tuple[float, float], controls: Controls | None, method: Tableau
    ) -> None:
        self.problem, self.controls, self.method, self.t0 = problem, controls, method, t_span[0]
        self.h = problem.step
        self.steps = round((t_span[1] - t_span[0]) / self.h)
        self.per_tick = steps_per_tick(controls, self.h)
        self.timed = Timed(problem)
        self.limits = limits_of(problem)
        self.jumps = self.timed.jumps(self.t0, self.h, self.steps)
        self.resting: tuple[Limit, ...] = ()
        self.compiled: dict[tuple[Limit, ...], Compiled] = {}
        self.q, self.v, self.act = (np.array(x, dtype=float) for x in problem.state0)
        self.held = Held(np.zeros(problem.model.nu), np.zeros(problem.model.nv))
        self.samples: list[tuple[float, State]] = []
        self.rests: list[tuple[Limit, ...]] = []
        self.ticks: list[tuple[float, Held]] = []
        self.events: list[Event] = []
        self.evaluations = 0
        self.build_s = 0.0

    @cached_property
    def width(self) -> float | None:
        """Speed below which dry friction is smoothed."""
        return friction_width(self.problem.model, mobility(self.problem), self.h)

    def model(self) -> Compiled:
        """The compiled model, with the joints that rest at a limit taken out of the unknowns."""
        if self.resting not in self.compiled:
            begun = time.perf_counter()
            self.compiled[self.resting] = Compiled(
                self.problem, self.timed, self.t0, self.method, width=self.width, resting=self.resting
            )
            self.build_s += time.perf_counter() - begun
        return self.compiled[self.resting]

    def segment(self, progress: Callable[[float], None] | None) -> Segment:
        started, status, message, k = time.perf_counter(), "done", "", 0
        try:
            while True:
                if message := self._nonsense(k):
                    status = "diverged"
                    break
                self._stop_at(k)
                if k >= self.steps:
                    break
                k = self._advance(k, self._until_next(k))
                if progress:
                    progress(self.t0 + k * self.h)
        except KeyboardInterrupt:
            status, message = "interrupted", f"interrupted at t = {self.t0 + k * self.h:.4g} s"
        return self._result(status, message, k, time.perf_counter() - started)

    def adaptive(self, tolerance: float) -> Segment:
        """The whole run with adaptive steps, to a relative tolerance (absolute: the same in SI units)."""
        started = time.perf_counter()
        at = np.unique(np.append(np.arange(0, self.steps, self.problem.sample_every), self.steps))
        t = self.t0 + at * self.h
        c = self.model()
        path = c.smooth.integrate(
            self.q,
            self.v,
            t,
            c.held(self.held),
            method=self.method,
            rtol=tolerance,
            atol=tolerance,
            act0=self.act,
        )
        finite = np.isfinite(path.x).all(axis=1)
        last = int(np.argmin(finite)) if not finite.all() else len(t)
        self.samples = [(float(t[i]), State(path.q[i], path.v[i], path.act[i])) for i in range(last)]
        self.rests = [()] * last
        self.evaluations = int(path.evaluations)
        status = "done" if last == len(t) else "diverged"
        message = "" if status == "done" else f"no step is small enough after t = {t[last - 1]:.4g} s"
        segment = self._result(status, message, self.steps, time.perf_counter() - started)
        segment.stats.update(step=None, tolerance=tolerance, steps=int(path.evaluations) // c.stepper.stages)
        return segment

    def _until_next(self, k: int) -> int:
        stops = [self.steps - k, CHUNK]
        if self.per_tick:
            stops.append(self.per_tick - k % self.per_tick)
        stops += [at - k for at in self.jumps if at > k]
        return min(stops)

    def _jump(self, k: int) -> None:
        """Velocities that keyed joints take up at once pull the others along: M_pp dv_p = -M_pk dv_k."""
        m, c = self.problem.model, self.model()
        data, M = mujoco.MjData(m), np.zeros((m.nv, m.nv))
        data.qpos[:] = self.q
        mujoco.mj_forward(m, data)
        mujoco.mj_fullM(m, data, M)
        pulled = M[np.ix_(c.v_free, self.timed.keyed)] @ self.jumps[k]
        self.v[c.v_free] -= np.linalg.solve(M[np.ix_(c.v_free, c.v_free)], pulled)

    def _stop_at(self, k: int) -> None:
        if k == self.steps:
            self._keep(k, self.q, self.v, self.act)
        if self.controls and k % self.per_tick == 0 and k < self.steps:
            t = self.t0 + k * self.h
            self.held = self.controls.sample(k // self.per_tick, t, self.q.copy(), self.v.copy())
            self.ticks.append((t, self.held))

    def _keep(self, k: int, q: Array, v: Array, act: Array) -> None:
        self.samples.append((self.t0 + k * self.h, State(q.copy(), v.copy(), act.copy())))
        self.rests.append(self.resting)

    def _advance(self, k: int, n: int) -> int:
        """Integrate ``n`` steps from step ``k``, or fewer when a joint meets or leaves a limit."""
        if k in self.jumps:
            self._jump(k)
        self._release(k)
        q, v, act = self._roll(k * self.h, self.h, n)
        last = self._first_event(k, q, v, act)
        for i in range(last):
            if (k + i) % self.problem.sample_every == 0:
                self._keep(k + i, q[i], v[i], act[i])
        self.q, self.v, self.act = q[last].copy(), v[last].copy(), act[last].copy()
        if last == n or self._pulled(k + last, q[last], v[last], act[last]):
            return k + last
        if (k + last) % self.problem.sample_every == 0:
            self._keep(k + last, self.q, self.v, self.act)
        self._step_with_impacts(k + last)
        return k + last + 1

    def _first_event(self, k: int, q: Array, v: Array, act: Array) -> int:
        """Index of the last state before a limit is passed, or at which a resting joint is pulled off its."""
        passed = self.limits.first_passed(q[1:], self.resting)
        last = len(q) - 1 if passed is None else passed
        for i in range(1, last if self.resting else 0):
            if self._pulled(k + i, q[i], v[i], act[i]):
                return i
        return last

    def _roll(self, offset: float, step: float, n: int) -> tuple[Array, Array, Array]:
        """States (n + 1, ...) of ``n`` steps from the current state, ``offset`` seconds after the start."""
        c, m = self.model(), self.problem.model
        x = np.concatenate([self.q[c.q_free], self.v[c.v_free], self.act])
        k = round(offset / self.h)
        on_grid = step == self.h and abs(k * self.h - offset) < 1e-9 * self.h
        w = c.on_grid(k, n) if on_grid else c.prescribed(offset + step * np.arange(n), step)
        path = c.stepper(x, c.held(self.held), n, step, w)
        self.evaluations += n * c.stepper.stages
        q, v = np.empty((n + 1, m.nq)), np.empty((n + 1, m.nv))
        q[:, c.q_free], v[:, c.v_free] = path[:, : c.nq], path[:, c.nq : c.nq + c.nv]
        if c.q_keyed.size:
            q[:-1, c.q_keyed], v[:-1, c.v_keyed] = c.motion(w[:: c.stepper.rows])
            q[-1:, c.q_keyed], v[-1:, c.v_keyed] = c.motion(c.end(offset + step * n, on_grid, k + n))
        return q, v, path[:, c.nq + c.nv :].copy()

    def _limit_forces(self, k: int, q: Array, v: Array, act: Array) -> Array:
        """Forces (resting,) that the limits give, positive away from them."""
        c = self.model()
        w = c.end(k * self.h, True, k)[0]
        drive = c.smooth.drive(q[c.q_free], v[c.v_free], c.held(self.held), act=act, w=w)
        at = [int(np.flatnonzero(c.v_keyed == limit.dof)[0]) for limit in self.resting]
        sides = np.array([limit.side for limit in self.resting])
        pushed = np.array([self.held.qfrc[limit.dof] for limit in self.resting])
        return np.asarray(-sides * (drive[at] - pushed))

    def _pulled(self, k: int, q: Array, v: Array, act: Array) -> bool:
        return bool(self.resting) and bool((self._limit_forces(k, q, v, act) < 0).any())

    def _release(self, k: int) -> None:
        """Let joints go that their limits would have to pull; the one pulled most first."""
        while self.resting:
            forces = self._limit_forces(k, self.q, self.v, self.act)
            worst = int(np.argmin(forces))
            if forces[worst] >= 0:
                return
            gone = self.resting[worst]
            self.resting = tuple(limit for limit in self.resting if limit is not gone)
            self._note(k * self.h, "limit end", gone)

    def _step_with_impacts(self, k: int) -> None:
        """One step in which joints meet limits: to each impact, the impact, and on to the step's end."""
        done = 0.0
        for _ in range(2 * len(self.limits.each) + 2):
            q, v, act = self._roll(k * self.h + done, self.h - done, 1)
            hit = self._hit(k * self.h + done, self.h - done, q)
            if hit is None:
                self.q, self.v, self.act = q[-1], v[-1], act[-1]
                return
            limit, share = hit
            if share > 0.0:
                part = share * (self.h - done)
                q, v, act = self._roll(k * self.h + done, part, 1)
                self.q, self.v, self.act = q[-1], v[-1], act[-1]
                done += part
            self._impact(limit)
            self._note(k * self.h + done, "limit", limit)
        raise EngineError(
            f"joints met their limits more than {2 * len(self.limits.each) + 2} times within one step at "
            f"t = {self.t0 + k * self.h:.4g} s; use a smaller step or engine = 'contact'"
        )

    def _hit(self, offset: float, step: float, q: Array) -> tuple[Limit, float] | None:
        """The first limit passed within a step from the current state, and the share of the step before."""
        found: tuple[Limit, float] | None = None
        for limit in self.limits.passed(q[-1], self.resting):
            share = self._share(offset, step, limit)
            if found is None or share < found[1]:
                found = (limit, share)
        return found

    def _share(self, offset: float, step: float, limit: Limit) -> float:
        """Share of the step at which the gap closes, to rounding, by bracketed root finding."""
        from scipy.optimize import brentq

        def gap(share: float) -> float:
            if share == 0.0:
                return limit.gap(self.q)
            return limit.gap(self._roll(offset, share * step, 1)[0][-1])

        return 0.0 if gap(0.0) <= 0.0 else float(brentq(gap, 0.0, 1.0, xtol=1e-13))

    def _impact(self, limit: Limit) -> None:
        """Impulse on the joint: its velocity becomes -RESTITUTION times what it was; with none it rests.

        v+ = v - (1 + e) M^-1 J' (J M^-1 J')^-1 J v (R. Featherstone, Rigid Body Dynamics Algorithms, 11.7),
        over the freedoms that are neither keyed nor at rest.
        """
        c = self.model()
        w = np.zeros(c.nw)
        w[: len(c.q_keyed)] = self.q[c.q_keyed]
        M = c.smooth.mass_matrix(self.q[c.q_free], w=w)
        j = (c.v_free == limit.dof).astype(float)
        response = np.linalg.solve(M, j)
        self.v[c.v_free] -= (1.0 + RESTITUTION) * self.v[limit.dof] / (j @ response) * response
        self.q[limit.qpos] = limit.bound
        if RESTITUTION == 0.0:
            self.v[limit.dof] = 0.0
            self.resting = (*self.resting, limit)

    def _note(self, offset: float, kind: str, limit: Limit) -> None:
        name = name_of(self.problem.model, "joint", limit.joint)
        self.events.append(Event(self.t0 + offset, kind, name))

    def _nonsense(self, k: int) -> str:
        joint = fastest_joint(self.problem.model, self.q, self.v)
        if joint is None:
            return ""
        return (
            f"diverged before t = {self.t0 + k * self.h:.4g} s at joint {joint!r}: with "
            f"{self.problem.integrator} and a step of {self.h:g} s the motion is too fast or too stiff; "
            "try a smaller step, or check forces and initial state"
        )

    def _accelerations(self, kept: list[tuple[float, State]]) -> tuple[Array, Array]:
        """Accelerations and forces of the drives (n, nv) at the samples, those at rest apart."""
        n, m = len(kept), self.problem.model
        a, drive = np.zeros((n, m.nv)), np.zeros((n, m.nv))
        t = np.array([t for t, _ in kept])
        tick = np.searchsorted([tick for tick, _ in self.ticks], t + 1e-9, side="right") - 1
        nothing = Held(np.zeros(m.nu), np.zeros(m.nv))
        for resting in dict.fromkeys(self.rests[:n]):
            at = np.array([i for i in range(n) if self.rests[i] == resting])
            c = self.compiled[resting]
            q, v = (rows([getattr(kept[i][1], x) for i in at], w) for x, w in (("q", m.nq), ("v", m.nv)))
            act = rows([kept[i][1].act for i in at], m.na)
            u = np.array([c.held(self.ticks[tick[i]][1] if tick[i] >= 0 else nothing) for i in at])
            w = c.at(t[at] - self.t0)
            state = {"q": q[:, c.q_free], "v": v[:, c.v_free], "act": act, "u": u, "w": w}
            a[np.ix_(at, c.v_free)] = c.smooth.evaluate("forward", **state)["a"]
            if len(c.v_keyed):
                a[np.ix_(at, c.v_keyed)] = c.accelerations(w)
                drive[np.ix_(at, c.v_keyed)] = c.smooth.evaluate("drive", **state)["drive"]
                drive[np.ix_(at, np.array([limit.dof for limit in resting], dtype=int))] = 0.0
        return a, drive

    def _result(self, status: str, message: str, k: int, wall: float) -> Segment:
        m = self.problem.model
        kept = [
            (t, s) for t, s in self.samples if np.isfinite(s.q).all() and np.abs(s.v).max(initial=0) < HUGE
        ]
        a, drive = self._accelerations(kept)
        builds = [c.smooth.stats for c in self.compiled.values()]
        return Segment(
            **recorded(m, kept, self.ticks),
            status=status,
            message=message,
            stats={
                "engine": "smooth",
                "integrator": self.problem.integrator,
                "step": self.h,
                "steps": k,
                "evaluations": self.evaluations,
                "wall_s": wall - self.build_s,
                "build_s": self.build_s,
                "build_cached": all(b.cached for b in builds),
                "friction_width": self.width,
                "restitution": RESTITUTION if self.limits.each else None,
            },
            events=tuple(self.events),
            a=a,
            drive=drive,
        )


def mobility(problem: Problem) -> Array:
    """Diagonal (nv,) of the inverse inertia matrix at the initial state [1/kg, 1/(kg m^2)]."""
    m = problem.model
    data = mujoco.MjData(m)
    data.qpos[:] = problem.state0.q
    mujoco.mj_forward(m, data)
    inverse = np.eye(m.nv)
    mujoco.mj_solveM(m, data, inverse, np.eye(m.nv))
    return np.diag(inverse).copy()
