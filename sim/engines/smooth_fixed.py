"""The smooth engine in steps of one length: chunks of them compiled, up to what happens."""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..errors import EngineError
from .common import HUGE, steps_per_tick
from .compiled import CHUNK
from .interface import Array, Controls, Problem
from .smooth_run import MOST, Run

if TYPE_CHECKING:
    from ..dynamics.motion.stepper import ControlledStepper
    from ..integrate import Tableau


_FEW = 16


class FixedRun(Run):
    """A run on a grid of steps; the state is at the start of step ``k``."""

    def __init__(
        self, problem: Problem, t_span: tuple[float, float], controls: Controls | None, method: Tableau
    ) -> None:
        super().__init__(problem, t_span, controls, method)
        self.per_tick = steps_per_tick(controls, self.h)
        self.jumps = self.timed.jumps(self.t0, self.h, self.steps)
        self.most = CHUNK  # steps at once: few after an event, which another may follow
        self.by_hand = 0  # step before which Python samples the controller

    def advance(self, progress: Callable[[float], None] | None) -> str:
        """See `Run`."""
        k = 0
        while True:
            self.offset, self.done = k * self.h, k
            self.mark()
            if message := self.nonsense():
                return message
            if k == self.steps:
                self.keep(self.offset, self.q, self.v, self.act)
                return ""
            k = self._ticks(k, self._periods(k)) or self._held(k)
            if progress:
                progress(self.t0 + k * self.h)

    def _held(self, k: int) -> int:
        """From step ``k`` on under what is held from there; the step reached."""
        if self.per_tick and k % self.per_tick == 0:
            self.sample(k // self.per_tick)
        if k in self.jumps:
            self._jump(k)
        self.release()
        return self._go(k, *self._roll(k, self._until_next(k)))

    def _until_next(self, k: int) -> int:
        ahead = self._ahead(k)
        return min(ahead, self.per_tick - k % self.per_tick) if self.per_tick else ahead

    def _ahead(self, k: int) -> int:
        """Steps from ``k`` on that may be taken at once, a controller's ticks aside."""
        return min(self.steps - k, self.most, *(at - k for at in self.jumps if at > k))

    def _periods(self, k: int) -> int:
        """Control periods from step ``k`` on that machine code can take at once, ticks included."""
        if self.tick is None or k % self.per_tick or k < self.by_hand or self.resting or k in self.jumps:
            return 0
        return self._ahead(k) // self.per_tick

    def _ticks(self, k: int, periods: int) -> int:
        """Go on for ``periods`` from step ``k``, or less far up to an event; the step reached, 0 for none."""
        if not periods or self.tick is None:
            return 0
        c, rows, n = self.model(), self.model().stepper.rows, periods * self.per_tick
        w = c.on_grid(k, n)
        seen = self.tick.rows(k // self.per_tick, c.motion(w[:: rows * self.per_tick]))
        x = c.gather(self.q, self.v, self.act)
        path, u, memory = self.controlled(x, seen, self.tick.memory, self.per_tick, self.h, w)
        if not (np.isfinite(seen).all() and np.abs(path).max() < HUGE):  # not even for NaN
            self.by_hand = k + n  # where it is told what is wrong, and when
            return 0
        self.evaluations += n * c.stepper.stages
        q, v, act = self._spread(k, path, w)
        last = self._first_doubtful(k, q, v, act)
        taken = min(periods, last // self.per_tick + 1)
        times: Array = self.t0 + self.h * (k + self.per_tick * np.arange(float(taken)))
        self.ticked(c, times, u[:taken], memory[taken])
        return self._go(k, q, v, act, last)

    @cached_property
    def controlled(self) -> ControlledStepper:
        """Steps with the controller's ticks in them, of joints none of which rests."""
        assert self.tick is not None
        with self.preparing():
            return self.model(()).controlled(self.tick, self.tick.formula.gains)

    def _jump(self, k: int) -> None:
        """Velocities that keyed joints take up at once pull the others along: M_pp dv_p = -M_pk dv_k."""
        m, c = self.problem.model, self.model()
        data, M = mujoco.MjData(m), np.zeros((m.nv, m.nv))
        data.qpos[:] = self.q
        mujoco.mj_forward(m, data)
        mujoco.mj_fullM(m, data, M)
        pulled = M[np.ix_(c.v_free, self.timed.keyed)] @ self.jumps[k]
        self.v[c.v_free] -= np.linalg.solve(M[np.ix_(c.v_free, c.v_free)], pulled)

    def _go(self, k: int, q: Array, v: Array, act: Array, last: int | None = None) -> int:
        """Take over states (n + 1, ...) from step ``k`` on, up to the ``last`` before an event at a limit, if
        there is one, and that event's step; the step reached."""
        n = len(q) - 1
        last = self._first_doubtful(k, q, v, act) if last is None else last
        for i in range(last):
            if (k + i) % self.problem.sample_every == 0:
                self.keep((k + i) * self.h, q[i], v[i], act[i])
        self.q, self.v, self.act = q[last].copy(), v[last].copy(), act[last].copy()
        if last == n:
            self.most = min(CHUNK, 2 * self.most)
            return k + n
        self.most = _FEW
        self.offset = (k + last) * self.h
        if (k + last) % self.problem.sample_every == 0:
            self.keep(self.offset, self.q, self.v, self.act)
        self._step_with_events(k + last)
        return k + last + 1

    def _first_doubtful(self, k: int, q: Array, v: Array, act: Array) -> int:
        """Index of the last state before a limit is passed, or may be, or has to pull a joint at rest."""
        doubtful = self.limits.doubtful(q, v, self.h, self.resting)
        if doubtful is None and not self.resting:
            return len(q) - 1
        doubtful = np.zeros(len(q) - 1, dtype=bool) if doubtful is None else doubtful
        if self.resting:
            offsets: Array = self.h * np.arange(k + 1.0, k + len(q))
            doubtful |= (self.forces_at(offsets, q[1:], v[1:], act[1:]) < 0).any(axis=1)
        found = np.flatnonzero(doubtful)
        return int(found[0]) if len(found) else len(q) - 1

    def _roll(self, k: int, n: int) -> tuple[Array, Array, Array]:
        """States (n + 1, ...) of steps ``k`` to ``k + n``."""
        c = self.model()
        w = c.on_grid(k, n)
        path = c.stepper(c.gather(self.q, self.v, self.act), c.held(self.held), n, self.h, w)
        self.evaluations += n * c.stepper.stages
        return self._spread(k, path.copy(), w)

    def _spread(self, k: int, path: Array, w: Array) -> tuple[Array, Array, Array]:
        """The whole model's states (n + 1, ...) of the compiled model's from step ``k`` on."""
        c, m, n = self.model(), self.problem.model, len(path) - 1
        act = path[:, c.nq + c.nv :]
        if c.whole:
            return path[:, : c.nq], path[:, c.nq : c.nq + c.nv], act
        q, v = np.empty((n + 1, m.nq)), np.empty((n + 1, m.nv))
        q[:, c.q_free], v[:, c.v_free] = path[:, : c.nq], path[:, c.nq : c.nq + c.nv]
        if c.q_keyed.size:
            q[:-1, c.q_keyed], v[:-1, c.v_keyed] = c.motion(w[:: c.stepper.rows])
            q[-1:, c.q_keyed], v[-1:, c.v_keyed] = c.motion(c.end(k + n))
        return q, v, act

    def _step_with_events(self, k: int) -> None:
        """One step in which joints may meet or leave limits: to each event, the event, and on to the end."""
        for _ in range(MOST):
            left = (k + 1) * self.h - self.offset
            moment = self.first_event(left)
            if moment is None:
                self.move(1.0, left)
                return
            self.move(moment.share, left)
            self.happen(moment)
            self.mark()
            if self.samples[-1][0] == self.now:
                self.keep(self.offset, self.q, self.v, self.act)
        raise EngineError(
            f"joints met their limits more than {MOST} times within one step at "
            f"t = {self.t0 + k * self.h:.4g} s; use a smaller step or engine = 'contact'"
        )
