"""Integration of one state, called again and again: between a controller's samples, up to an event."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...compile.program import address
from ...integrate.tableau import Tableau
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
            1, 1, steps, 1, step, at_x, at_u, 0, 0, at_none, 0, at_none, table, 0, self._nw, at_p, 0, at_path
        )
        return self._path[: steps + 1]
