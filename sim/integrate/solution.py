"""What an integration returns."""

from collections.abc import Callable
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from .tableau import Array


class Status(StrEnum):
    """How an integration ended; only the first two are a success."""

    FINISHED = "finished"
    """The end of the time span was reached."""
    EVENT = "stopped by a terminal event"
    DIVERGED = "the state is no longer finite"
    STEP_TOO_SMALL = "the tolerance asks for steps below the resolution of time"
    TOO_MANY_STEPS = "the limit of steps was reached"
    ACCUMULATED = "events accumulate at one time"
    SOLVER = "the foreign solver gave up"


@dataclass(frozen=True)
class Stats:
    """What an integration cost.

    Attributes:
        evaluations: calls of f.
        steps: accepted steps; None when a foreign solver does not tell.
        rejected: steps computed and thrown away; None when a foreign solver does not tell.
        wall_s: time on the clock [s].
    """

    evaluations: int
    steps: int | None
    rejected: int | None
    wall_s: float


@dataclass(frozen=True, eq=False)
class Occurrence:
    """One event that happened.

    Attributes:
        event: index of the event in the sequence given to `solve`.
        name: its name.
        t: time [s].
        y: state just before any jump, shape (ndim,).
        y_after: state just after the event's jump; y itself when it has none.
    """

    event: int
    name: str
    t: float
    y: Array
    y_after: Array


@dataclass(frozen=True, eq=False)
class Solution:
    """Solution of an initial value problem, as far as it was computed; arrays are read-only.

    Attributes:
        t: times [s] in the order of integration, shape (n,): those of `t_eval`, or the ends of all steps. A
            terminal event or a failure ends them early.
        y: states, shape (n, ndim).
        status: how it ended.
        stats: what it cost.
        events: the events in the order they happened.
        message: the end in words, with time and component in case of a failure.
        error: estimate of y minus the exact solution, shape (n, ndim); NaN where the comparison run has no
            value; None when it was not asked for.
        error_stats: what that estimate cost, apart.
        interpolant: continuous solution, (m,) times -> (m, ndim) states; None when it was not asked for.
    """

    t: Array
    y: Array
    status: Status
    stats: Stats
    events: tuple[Occurrence, ...]
    message: str
    error: Array | None = None
    error_stats: Stats | None = None
    interpolant: Callable[[Array], Array] | None = None

    def __post_init__(self) -> None:
        for array in (self.t, self.y, self.error):
            if array is not None:
                array.setflags(write=False)

    @property
    def success(self) -> bool:
        """The end of the span, or a terminal event, was reached."""
        return self.status in (Status.FINISHED, Status.EVENT)

    @property
    def max_error(self) -> float:
        """Largest estimated error of any component at any time.

        Raises:
            ValueError: no estimate was asked for.
        """
        if self.error is None:
            raise ValueError(
                "this solution carries no error estimate; ask for it with solve(..., error=True)"
            )
        return float(np.nanmax(np.abs(self.error)))
