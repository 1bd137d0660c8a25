"""What a fit returns: the clip, its forces, and the certificate of how possible it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip
from .contact import Phase

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Certificate:
    """How possible a fitted motion is, on a grid ten times finer than the one it was computed on.

    ``limits``: largest share of any limit in use; ``dynamics``: largest force missing where nothing drives,
    relative to the ``largest`` joint force at all [N m, N]; ``contact``: how far sites that rest stray [m];
    ``holds``: whether all are within ``tolerance`` (contact: of the model's size); ``solver``: what IPOPT
    left of its constraints; ``status``: its words; ``iterations``, ``seconds`` and ``pieces`` of the last
    grid.
    ``by_piece`` (pieces,): the larger of what limits and dynamics miss on each piece, in tolerances.
    """

    limits: float
    dynamics: float
    largest: float
    contact: float
    tolerance: float
    holds: bool
    solver: float
    status: str
    iterations: int
    seconds: float
    pieces: int
    by_piece: Array

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        slips = f"contacts within {1e3 * self.contact:.2g} mm, " if self.contact else ""
        return (
            f"certificate to {self.tolerance:g} {verdict}: limits in use {self.limits:.2%}, "
            f"missing force {self.dynamics:.1e} of the largest, {slips}constraints to {self.solver:.1e} "
            f"({self.status}, {self.pieces} pieces, {self.iterations} iterations, {self.seconds:.2f} s)"
        )


@dataclass(frozen=True, eq=False)
class Fitted:
    """A possible clip; at its nodes t (n,) forces ``tau`` (n, nv), straight between them, and contact forces
    (n, 3 sites) [N], parabolas through those of the ``middle`` (n - 1, 3 sites); the largest ``deviation``
    from the keys at the nodes [rad, m]; its certificate."""

    clip: Clip
    t: Array
    tau: Array
    contact: Array
    middle: Array
    sites: tuple[str, ...]
    phases: tuple[Phase, ...]
    deviation: float
    certificate: Certificate

    def drives(self, t: float) -> Array:
        """Joint forces (nv,) at a time [s]."""
        return np.array([np.interp(t, self.t, column) for column in self.tau.T])
