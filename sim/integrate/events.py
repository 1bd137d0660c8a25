"""Events: zero crossings of functions of time and state, located inside a step."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import scipy

from .steps import Step
from .tableau import EPS, Array


@dataclass(frozen=True)
class Event:
    """A change of sign of g(t, y).

    A crossing is found when g changes sign over a step, or when it dips through zero and back with a single
    extremum inside the step. A graze that touches zero without crossing is no event. Where g starts at zero
    it has to leave zero first.

    Attributes:
        g: continuous function (t, y) -> float.
        direction: +1 only from negative to positive in the direction of integration, -1 only the reverse,
            0 both.
        terminal: stop there.
        jump: state just after the event, (t, y) -> y; None for no jump. It should leave g at exactly zero or
            clearly beside it, with a motion that leads away from zero.
        name: for messages and results.
    """

    g: Callable[[float, Array], float]
    direction: Literal[-1, 0, 1] = 0
    terminal: bool = False
    jump: Callable[[float, Array], Array] | None = None
    name: str = ""

    @property
    def interrupts(self) -> bool:
        """The step ends at this event."""
        return self.terminal or self.jump is not None


@dataclass(frozen=True)
class Crossing:
    """A located event: index in the sequence of events, place in the step (0 to 1)."""

    event: int
    theta: float


class Watch:
    """Follows on which side of zero each event function is, from step to step."""

    def __init__(self, events: Sequence[Event]) -> None:
        self.events = events
        self.side = [0.0] * len(events)

    def restart(self) -> None:
        """Forget the sides, after a jump: they are found out just behind the start of the next step."""
        self.side = [0.0] * len(self.events)

    def crossings(self, step: Step) -> list[Crossing]:
        """All events of a step in the order they happen, up to the first one that interrupts it."""
        found = []
        for i, event in enumerate(self.events):
            thetas, self.side[i] = _crossings(event, self.side[i], step)
            found += [Crossing(i, theta) for theta in thetas]
        found.sort(key=lambda c: c.theta)
        for n, crossing in enumerate(found):
            if self.events[crossing.event].interrupts:
                return found[: n + 1]
        return found


def _crossings(event: Event, side: float, step: Step) -> tuple[list[float], float]:
    """Places in the step where g crosses zero in the event's direction, and its side of zero at the end."""

    def g(theta: float) -> float:
        return float(event.g(step.t + theta * step.h, step.at(theta)))

    # Two times closer than this are the same double.
    resolution = min(4 * EPS * max(abs(step.t), abs(step.t_end)) / abs(step.h), 0.5)
    end = g(1.0)
    start = 0.0
    if side == 0:
        side, start = _departure(event, step, resolution)
    knots = [start]
    if side * end > 0 and _dips(event, side, step):
        bottom = scipy.optimize.minimize_scalar(
            lambda theta: side * g(theta), bounds=(0.0, 1.0), method="bounded"
        ).x
        if side * g(float(bottom)) < 0:
            knots.append(float(bottom))
    knots.append(1.0)
    roots = []
    for a, b in pairwise(knots):
        if side * g(b) >= 0:
            continue
        if event.direction in (0, -side):
            crossed = side * g(a) <= 0  # by the rounding of a root at the end of the step before
            roots.append(
                a if crossed else float(scipy.optimize.brentq(g, a, b, xtol=resolution, rtol=4 * EPS))
            )
        side = -side
    return roots, side


def _departure(event: Event, step: Step, resolution: float) -> tuple[float, float]:
    """The side of zero at the start of a step, and the place from which on it holds.

    Where the start itself is a zero, the motion along f there tells, just far enough to see it.
    """

    def along(theta: float) -> float:
        dt = theta * step.h
        return float(event.g(step.t + dt, step.y + dt * step.f_start))

    first = along(0.0)
    if abs(first) > 1e-12 * abs(along(1.0) - first):
        return float(np.sign(first)), 0.0
    theta = resolution
    while theta < 1 and along(theta) == 0:
        theta *= 4
    return float(np.sign(along(theta))), min(theta, 1.0)


def _dips(event: Event, side: float, step: Step) -> bool:
    """g approaches zero at the start of the step and leaves it at the end, judged by its slopes there."""
    dt = 1e-4 * step.h
    y0, y1 = step.y, step.y_end
    at_start = event.g(step.t + dt, y0 + dt * step.f_start) - event.g(step.t, y0)
    at_end = event.g(step.t_end, y1) - event.g(step.t_end - dt, y1 - dt * step.f_end)
    return bool(side * at_start < 0 < side * at_end)
