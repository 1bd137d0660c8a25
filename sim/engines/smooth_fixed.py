"""The smooth engine in steps of one length: chunks of them compiled, up to what happens."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import mujoco
import numpy as np

from ..errors import EngineError
from .common import steps_per_tick
from .compiled import CHUNK
from .interface import Array, Controls, Problem
from .smooth_run import MOST, Run

if TYPE_CHECKING:
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
            if self.per_tick and k % self.per_tick == 0:
                self.sample(k // self.per_tick)
            if k in self.jumps:
                self._jump(k)
            self.release()
            k = self._chunk(k, self._until_next(k))
            if progress:
                progress(self.t0 + k * self.h)

    def _until_next(self, k: int) -> int:
        stops = [self.steps - k, self.most]
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

    def _chunk(self, k: int, n: int) -> int:
        """Integrate ``n`` steps from step ``k``, or fewer up to an event at a limit; the step reached."""
        q, v, act = self._roll(k, n)
        last = self._first_doubtful(k, q, v, act)
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
        if self.resting:
            offsets: Array = self.h * np.arange(k + 1.0, k + len(q))
            doubtful |= (self.forces_at(offsets, q[1:], v[1:], act[1:]) < 0).any(axis=1)
        found = np.flatnonzero(doubtful)
        return int(found[0]) if len(found) else len(q) - 1

    def _roll(self, k: int, n: int) -> tuple[Array, Array, Array]:
        """States (n + 1, ...) of steps ``k`` to ``k + n``."""
        c, m = self.model(), self.problem.model
        w = c.on_grid(k, n)
        path = c.stepper(c.gather(self.q, self.v, self.act), c.held(self.held), n, self.h, w)
        self.evaluations += n * c.stepper.stages
        if c.whole:
            path = path.copy()
            return path[:, : c.nq], path[:, c.nq : c.nq + c.nv], path[:, c.nq + c.nv :]
        q, v = np.empty((n + 1, m.nq)), np.empty((n + 1, m.nv))
        q[:, c.q_free], v[:, c.v_free] = path[:, : c.nq], path[:, c.nq : c.nq + c.nv]
        if c.q_keyed.size:
            q[:-1, c.q_keyed], v[:-1, c.v_keyed] = c.motion(w[:: c.stepper.rows])
            q[-1:, c.q_keyed], v[-1:, c.v_keyed] = c.motion(c.end(k + n))
        return q, v, path[:, c.nq + c.nv :].copy()

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
