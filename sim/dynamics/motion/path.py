"""The result of an integration of a smooth model."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

STATUS = ("success", "too many steps", "step too small", "not finite", "before a guard")


@dataclass(frozen=True, eq=False)
class Path:
    """Motion of one state or a batch.

    Attributes:
        t: times of the records [s], shape (records,).
        x: states (q, v, act), shape (records, nx), or (batch, records, nx).
        u: controls applied, shape ([batch,] periods, nu); one row if they did not change.
        status: how each motion ended, an index of STATUS; 0 is success. After a failure records are NaN.
        evaluations: of dx/dt, for each state.
        rejected: steps done again, for each state (fixed steps: none).
        steps: steps that were kept, for each state.
        reached: time to which each state came [s].
        seconds: wall time of the integration itself.
    """

    t: Array
    x: Array
    u: Array
    status: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    rejected: NDArray[np.int64]
    steps: NDArray[np.int64]
    reached: Array
    seconds: float
    nq: int
    nv: int

    @property
    def success(self) -> bool:
        """Whether every motion reached its end."""
        return not np.any(self.status)

    @property
    def q(self) -> Array:
        """Coordinates, shape (..., records, nq)."""
        return self.x[..., : self.nq]

    @property
    def v(self) -> Array:
        """Velocities, shape (..., records, nv)."""
        return self.x[..., self.nq : self.nq + self.nv]

    @property
    def act(self) -> Array:
        """Activations, shape (..., records, na)."""
        return self.x[..., self.nq + self.nv :]
