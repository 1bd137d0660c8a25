"""Steps of one state that follow a tolerance, called again and again: up to samples, up to events."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...compile.program import address
from ...compile.step_control import GUARDED, OK, STATISTICS
from ...integrate.tableau import Tableau
from ..laws import CompiledLaw
from .adaptive import Spans, adaptive_loop
from .guards import Guards
from .path import STATUS
from .prescribed import Pieces

if TYPE_CHECKING:
    from ..smooth import Smooth

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Reached:
    """Where a call of `Follower` has come to: x (nx,) at t [s], the next step `h`, records from `first` on,
    and what it took.

    `guarded`: it stands before a step of length `h` in which a guard may be passed.
    `failed` says why it went no further, "" if it did not fail.
    """

    x: Array
    t: float
    h: float
    records: Array
    first: int
    evaluations: int
    steps: int
    guarded: bool
    failed: str


class Follower:
    """Compiled steps of one state that follow a tolerance; one thread at a time.

    Records are the states at `t_eval`; a call from t0 to t1 makes those in t0 <= t < t1.
    """

    def __init__(
        self, smooth: Smooth, method: Tableau, motion: Pieces, t_eval: Array, tolerance: float,
        guards: Guards | None = None, *, law: CompiledLaw | None = None, max_steps: int = 10_000_000,
    ) -> None:  # fmt: skip
        nx = smooth.layout.nx
        self.spans, self._loop = Spans(smooth.layout, motion), adaptive_loop(smooth, 1, law, method, guards)
        self._rtol, self._max_steps, self._times = tolerance, float(max_steps), t_eval
        self._nu = smooth.layout.nu
        self._x, self._u, self._h = np.zeros(nx), np.zeros(max(1, self._nu)), np.zeros(1)
        self._path, self._x1 = np.zeros((len(t_eval), nx)), np.zeros(nx)
        self._stats, self._tolerance = np.zeros(len(STATISTICS)), np.full(nx, tolerance)
        self._offsets = np.zeros(guards.count if guards else 0)
        self._parameters = smooth.own_parameters

    def __call__(
        self,
        x: Array,
        u: Array,
        t0: float,
        t1: float,
        h: float,
        *,
        offsets: ArrayLike = (),
        jump: bool = True,
    ) -> Reached:
        """From `x` (nx,) at t0 to t1 or before a guard, under held controls `u` (nu,), first step `h`.

        `offsets` are added to the guards; `jump` tells whether a jump of prescribed velocities at t0 is due.
        """
        self._u[: len(u)], self._offsets[:] = u, offsets
        edges, of_span = self.spans.between(t0, t1, jump=jump)
        held = address(self._u), 0, 0, 0, 0, 0, 0, 0
        return self._run(x, h, 1, edges, of_span, held, t0, t1)

    def sampled(
        self,
        x: Array,
        rows: Array,
        gains: Array,
        memory: Array,
        hold: float,
        t0: float,
        t1: float,
        h: float,
        *,
        jump: bool = True,
    ) -> tuple[Reached, Array, Array]:
        """As a call, but under the law with `gains`, which sees a row of `rows` (periods, nr) every `hold`
        seconds; also its controls (periods, nu), and what it remembers (periods + 1, nm), from `memory` on.
        """
        periods = len(rows)
        rows, gains = (np.ascontiguousarray(a, dtype=np.float64) for a in (rows, gains))
        u, kept = np.empty((periods, self._nu)), np.empty((periods + 1, len(memory)))
        kept[0], self._offsets[:] = memory, 0.0
        edges, of_span = self.spans.between(t0, t1, hold, periods, jump=jump)
        controls = address(rows), 0, rows.shape[1], address(gains), 0, address(u), address(kept), 0
        return self._run(x, h, periods, edges, of_span, controls, t0, t1), u, kept

    def _run(
        self, x: Array, h: float, periods: int, edges: Array, of_span: NDArray[np.int64],
        controls: tuple[int, ...], t0: float, t1: float,
    ) -> Reached:  # fmt: skip
        self._x[:], self._h[0] = x, h
        first, last = np.searchsorted(self._times, (t0, t1)).tolist()
        motion, at = self.spans.motion, address
        self._loop.run(
            1, periods, len(edges), at(edges), at(of_span), t0, self._rtol, at(self._tolerance),
            self._max_steps, at(self._x), at(self._h), *controls, at(self._parameters.array), 0,
            at(motion.knots), at(motion.coefficients), motion.terms, at(self.spans.jumps), at(self._offsets),
            at(self._times), last, first, at(self._path), at(self._x1), at(self._stats),
        )  # fmt: skip
        steps, _, evaluations, status, following, t = self._stats.tolist()
        end = int(np.searchsorted(self._times[:last], t, "right" if t < t1 else "left"))
        failed = "" if status in (OK, GUARDED) else STATUS[int(status)]
        return Reached(
            self._x1.copy(), t, following, self._path[first:end].copy(), first, int(evaluations), int(steps),
            status == GUARDED, failed,
        )  # fmt: skip
