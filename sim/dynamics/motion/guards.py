"""What steps of any length must not pass unseen, as compiled functions that they must not pass zero of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

from ...compile.graph import Scalar
from ...compile.tape import Tape
from ..functions import drive_forces

if TYPE_CHECKING:
    from ..smooth import Smooth


class Bound(NamedTuple):
    """A value that a coordinate may not pass in the direction `side` (1 or -1): its places in q and v."""

    q: int
    v: int
    bound: float
    side: int


class Rest(NamedTuple):
    """A keyed freedom, by its place among them, that rests on a limit in the direction `side` (1 or -1)."""

    keyed: int
    side: int


@dataclass(frozen=True)
class Guards:
    """Gaps left to the bounds, and forces of the limits that joints rest on, positive away from them.

    Attributes:
        bounds: of joints that move.
        rests: of joints that do not; these guards have no rates.
    """

    bounds: tuple[Bound, ...]
    rests: tuple[Rest, ...]

    @property
    def count(self) -> int:
        """How many functions."""
        return len(self.bounds) + len(self.rests)

    @property
    def key(self) -> str:
        """What the functions are, for the compiled code's key."""
        return repr((self.bounds, self.rests))

    def tape(self, smooth: Smooth) -> Tape:
        """The program (q, v, act, u, w, p, offsets) -> values, offsets added to them, and rates."""
        eq = smooth.equations
        q, v, offsets = eq.inputs["q"], eq.inputs["v"], eq.graph.inputs("offsets", self.count)
        forces: Sequence[Scalar] = drive_forces(eq, smooth.formulation) if self.rests else ()
        values = [at.side * (at.bound - q[at.q]) for at in self.bounds]
        values += [-at.side * forces[at.keyed] for at in self.rests]
        rates = [-at.side * v[at.v] for at in self.bounds] + [0.0] * len(self.rests)
        given = {name: len(eq.inputs[name]) for name in ("q", "v", "act", "u", "w", "p")}
        values = [x + more for x, more in zip(values, offsets, strict=True)]
        return Tape.build(given | {"offsets": self.count}, {"values": values, "rates": rates})
