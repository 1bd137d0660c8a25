"""The smooth engine in steps that follow a tolerance: compiled from sample to sample, up to what happens."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np

from ..errors import EngineError
from .interface import Array, Controls, Problem
from .smooth_run import MOST, Run

if TYPE_CHECKING:
    from ..dynamics.motion.follower import Follower, Reached
    from ..dynamics.motion.prescribed import Pieces
    from ..integrate import Tableau
    from .compiled import Compiled
    from .tick import Tick

_TOGETHER = 256  # ticks in one call at most


class AdaptiveRun(Run):
    """A run to the problem's tolerance: relative, and absolute in SI units."""

    def __init__(
        self, problem: Problem, t_span: tuple[float, float], controls: Controls | None, method: Tableau
    ) -> None:
        super().__init__(problem, t_span, controls, method)
        at = np.unique(np.append(np.arange(0, self.steps, problem.sample_every), self.steps))
        self.records = at * self.h
        self.end = self.steps * self.h
        self.next_step = 1e-3 * min(self.end, controls.period if controls else self.end)
        self.followers: dict[tuple[int, Tick | None], Follower] = {}
        self.motions: dict[int, Pieces] = {}
        self.jumped = False  # at the current moment

    def advance(self, progress: Callable[[float], None] | None) -> str:
        """See `Run`."""
        period = self.controls.period if self.controls else self.end
        ticks, k = max(1, int(np.ceil(self.end / period - 1e-9))), 0
        while k < ticks:
            self.mark()
            taken = self._ticks(k, min(_TOGETHER, ticks - k), period)
            if not taken and self.controls:
                self.sample(k)
            k += max(1, taken)
            if message := self._until(min(self.end, k * period)):
                return message
            if progress:
                progress(self.now)
        self.keep(self.offset, self.q, self.v, self.act)
        return self.nonsense()

    def _ticks(self, k: int, count: int, period: float) -> int:
        """Go on from tick ``k`` for ``count`` periods, or less far: up to an event, where it fails; how many
        ticks machine code has taken."""
        if self.tick is None or self.resting:
            return 0
        c, begun = self.model(), self.offset
        offsets: Array = period * np.arange(float(k), float(k + count))
        seen = self.tick.rows(k, c.motion(c.at(offsets)))
        if not np.isfinite(seen).all():
            return 0  # where it is told what is wrong
        stop = min(self.end, (k + count) * period)
        reached, u, memory = self._follower(self.tick).sampled(
            c.gather(self.q, self.v, self.act), seen, self.tick.formula.gains, self.tick.memory, period,
            begun, stop, self.next_step, jump=not self.jumped,
        )  # fmt: skip
        taken = int(np.searchsorted(offsets - 1e-9 * period, reached.t, "right"))
        self.ticked(c, self.t0 + offsets[:taken], u[:taken], memory[taken])
        self._take_over(reached, stop)
        return taken

    def _until(self, stop: float) -> str:
        """Go on to the offset ``stop``, from event to event."""
        self.release()
        at_once = 0
        while self.offset < stop:
            self.mark()
            c, begun = self.model(), self.offset
            reached = self._follower()(
                c.gather(self.q, self.v, self.act), c.held(self.held), begun, stop, self.next_step,
                offsets=c.guard_offsets(self.held, self.limits), jump=not self.jumped,
            )  # fmt: skip
            self._take_over(reached, stop)
            if reached.failed:
                return f"{reached.failed} at t = {self.now:.4g} s: {self.nonsense() or self._advice()}"
            if reached.guarded:
                self._step(min(reached.h, stop - self.offset))
            at_once = at_once + 1 if self.offset == begun else 0
            if at_once > MOST:
                raise EngineError(f"joints meet and leave their limits without end at t = {self.now:.6g} s")
        return ""

    def _take_over(self, reached: Reached, stop: float) -> None:
        """Where compiled steps towards the offset ``stop`` have come to."""
        c, begun = self.model(), self.offset
        self.evaluations += reached.evaluations
        self.done += reached.steps
        times = self.records[reached.first : reached.first + len(reached.records)]
        w = c.at(np.append(times, reached.t))
        for t, x, row in zip(times, reached.records, w, strict=False):
            self.keep(float(t), *c.spread(x, row))
        self.offset, self.next_step = reached.t, reached.h
        self.jumped = reached.t == begun or reached.t < stop
        self.q, self.v, self.act = c.spread(reached.x, w[-1])

    def _step(self, length: float) -> None:
        """One step of ``length`` seconds, or as much of it as comes before an event, and the event."""
        moment = self.first_event(length)
        share = 1.0 if moment is None else moment.share
        end = self.offset + share * length
        for t in self.records[(self.records > self.offset) & (self.records < end)]:
            self.keep(float(t), *self.roll(float(t) - self.offset))
        self.move(share, length)
        self.jumped = self.jumped and share == 0.0
        if moment is not None:
            self.happen(moment)

    def _follower(self, tick: Tick | None = None) -> Follower:
        """The compiled integration with the joints at rest taken out, ``tick`` in it if there is one."""
        from ..dynamics.motion.follower import Follower

        c = self.model()
        if (id(c), tick) not in self.followers:
            tolerance = self.problem.tolerance
            assert tolerance is not None
            with self.preparing():
                self.followers[id(c), tick] = Follower(
                    c.smooth, self.method, self._motion(c), self.records, tolerance, c.guards(self.limits),
                    law=tick,
                )  # fmt: skip
        return self.followers[id(c), tick]

    def _motion(self, c: Compiled) -> Pieces:
        """What the compiled model is prescribed; taken over as polynomials only once."""
        if id(c) not in self.motions:
            self.motions[id(c)] = c.polynomials(self.end)
        return self.motions[id(c)]

    @property
    def pace(self) -> str:
        """See `Run`."""
        return f"a tolerance of {self.problem.tolerance:g}"

    def _advice(self) -> str:
        return "the motion is too stiff or too wild for this tolerance; try a larger one, or fixed steps"

    def facts(self) -> dict[str, Any]:
        """See `Run`."""
        return {"step": None, "tolerance": self.problem.tolerance}
