"""What an answer is worth: the verdict, its proofs, and the results that carry it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Kind = Literal["solved", "out of reach", "held by limits", "conflict", "not found"]


class Residual(NamedTuple):
    """What is left of one goal or loop: metres, radians, and whether it is within its tolerance."""

    goal: str
    position: float
    rotation: float
    met: bool


@dataclass(frozen=True)
class Verdict:
    """Whether goals can be met, and if not, why.

    Attributes:
        kind: what was found.
        proved: a bound, a closed form or a subdivision says that the goals cannot be met; otherwise only
            that searches from `restarts` random starts found nothing else. It says nothing of how far, which
            is that of the nearest pose found: `reason` puts "at most" where no bound from below agrees. An
            answer that meets its goals is its own proof.
        reason: in words.
        position, rotation: how far out of reach [m], [rad]; each with the other held where a pose's two parts
            can be met only apart. Limits of joints count unless limits alone are the reason (then 0).
        bound: proved least distance [m] (out of reach or conflict), 0 without one.
        joints: joints whose limits hold the goals back, with how far beyond them [rad or m] a solution lies.
        goals: goals that cannot be met (together).
        restarts: random starts that were made, besides the start and mid-range.
    """

    kind: Kind
    proved: bool
    reason: str
    position: float = 0.0
    rotation: float = 0.0
    bound: float = 0.0
    joints: dict[str, float] | None = None
    goals: tuple[str, ...] = ()
    restarts: int = 0

    def __str__(self) -> str:
        if self.kind == "solved":
            return f"solved: {self.reason}"
        certainty = "proved" if self.proved else f"not proved: none found in {self.restarts} restarts"
        return f"{self.kind}: {self.reason} ({certainty})"


@dataclass(frozen=True)
class Solution:
    """Answer to an inverse-kinematics question.

    Attributes:
        q (nq,): within limits always; the nearest pose found when the goals cannot be met.
        residuals: of every goal and touched loop of the model.
        verdict: see `Verdict`.
        solutions (k, nq): distinct solutions, best first: the answer alone, or with `all` every one that was
            found. Those that differ by whole turns of hinges, or by less than 1e-3 in every freedom, count as
            one, told with the turns nearest to q0.
        complete: whether `solutions` are certainly all, by a closed form or by a proof that there is none.
            Only with `all`; otherwise, and for a continuum of solutions, False.
        q_free (nq,): a solution that leaves the limits, when limits are the reason; otherwise None.
        iterations: of damped least squares over all starts; restarts: random starts used; seconds: wall time.
    """

    q: Array
    residuals: tuple[Residual, ...]
    verdict: Verdict
    solutions: Array
    complete: bool
    q_free: Array | None
    iterations: int
    restarts: int
    seconds: float

    @property
    def solved(self) -> bool:
        """Whether all that is judged is met."""
        return self.verdict.kind == "solved"
