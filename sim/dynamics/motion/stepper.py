"""Integration of one state, called again and again: between a controller's samples, up to an event."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...compile.program import address
from ...integrate.tableau import Tableau
from ..laws import CompiledLaw
from .fixed import fixed_loop

if TYPE_CHECKING:
    from ..smooth import Smooth

Array = NDArray[np.float64]


class Stepper:
    """Compiled steps of `method` on buffers of its own, without the checks of `Smooth.rollout`.

    One call costs microseconds beside the steps themselves. One thread at a time may use it.

    Attributes:
        stages: evaluations a step.
        rows: rows of prescribed motion a step, one a stage of the method.
    """

    def __init__(self, smooth: Smooth, method: Tableau, most: int):
        lay = smooth.layout
        loop = fixed_loop(smooth, 1, None, method)
        self._run = loop.run
        self._x, self._u = np.zeros(lay.nx), np.zeros(lay.nu)
        self._path, self._none = np.empty((most + 1, lay.nx)), np.zeros(max(1, lay.nw))
        self._parameters = np.ascontiguousarray(smooth.parameter_values)
        self._at = [address(a) for a in (self._x, self._u, self._path, self._none, self._parameters)]
        self._nw = lay.nw
        self.stages, self.rows = loop.stages, len(method.c)

    def __call__(self, x: Array, u: Array, steps: int, step: float, w: Array | None = None) -> Array:
        """States (steps + 1, nx) from `x` (nx,) under held controls `u` (nu,), `step` seconds apart.

        `w` are contiguous prescribed rows (steps * rows, nw). The result is overwritten by the next call.
        """
        self._x[:], self._u[:] = x, u
        at_x, at_u, at_path, at_none, at_p = self._at
        table = at_none if w is None else address(w)
        self._run(
            1, 1, steps, 1, step, at_x, at_u, 0, 0, at_none, 0, at_none, 0, 0, table, 0, self._nw, at_p, 0,
            at_path,
        )  # fmt: skip
        return self._path[: steps + 1]


class ControlledStepper:
    """Compiled steps of `method` under a compiled law with `gains` (ng,), sampled within them."""

    def __init__(self, smooth: Smooth, method: Tableau, law: CompiledLaw, gains: Array):
        self._loop, self._lay = fixed_loop(smooth, 1, law, method), smooth.layout
        self._gains = np.ascontiguousarray(gains)
        self._parameters = np.ascontiguousarray(smooth.parameter_values)

    def __call__(
        self, x: Array, rows: Array, memory: Array, hold: int, step: float, w: Array
    ) -> tuple[Array, Array, Array]:
        """States (periods * hold + 1, nx) from `x` (nx,), controls (periods, nu), and what the law remembers,
        (periods + 1, nm), from `memory` (nm,) on; the law sees a row of `rows` (periods, nr) every `hold`
        steps of `step` seconds.

        `w` are contiguous prescribed rows (steps * rows, nw).
        """
        periods, nm = len(rows), len(memory)
        start, rows, w = (np.ascontiguousarray(a, dtype=np.float64) for a in (x, rows, w))
        path = np.empty((periods * hold + 1, self._lay.nx))
        u, kept = np.empty((periods, self._lay.nu)), np.empty((periods + 1, nm))
        kept[0] = memory
        self._loop.run(
            1, periods, hold, 1, step, address(start), address(rows), 0, rows.shape[1], address(self._gains),
            0, address(u), address(kept), 0, address(w), 0, self._lay.nw, address(self._parameters), 0,
            address(path),
        )  # fmt: skip
        return path, u, kept
