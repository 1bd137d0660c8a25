"""The table [fit] of a scene: what machine its keyed motion is for, and how it is made possible."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from .schema.item import Item
from .values import Finite, NotNegative, Positive, Span, Switch, at

Limit = Positive | dict[str, Positive] | None


class PhaseItem(Item):
    """A contact: sites that rest on level ground for a while."""

    sites: list[str] = Field(min_length=1, description="sites that touch")
    start: Finite = Field(description="seconds")
    stop: Finite = Field(description="seconds")
    friction: Positive = Field(0.8, description="sliding friction coefficient")
    ground: Finite = Field(0.0, description="height of the ground, metres")

    @model_validator(mode="after")
    def _order(self) -> PhaseItem:
        if self.stop <= self.start:
            raise at("stop", message=f"stop ({self.stop:g}) must come after start ({self.start:g})")
        return self


class FitItem(Item):
    """Limits in rad, m, s, N, A, one number or one a joint by name; the model's own stand where none is.

    Where a scene's angles are degrees, so are range, velocity, acceleration, jerk and top_speed of hinges;
    forces are always N m and N.
    """

    how: Literal["check", "retime", "nearest", "fit"] = Field(
        "check", description="check; retime: fastest timing; nearest timing; fit: nearest motion"
    )
    position: dict[str, Span] | None = Field(None, description="range of a joint; default: the model's")
    velocity: Limit = None
    acceleration: Limit = None
    jerk: Limit = None
    force: Limit = Field(None, description="at standstill; default: what the model's actuators give")
    top_speed: Limit = Field(None, description="where a motor gives nothing more")
    ampere: Limit = Field(None, description="current for each N m or N of a joint's force")
    current: Positive | None = Field(None, description="that the battery gives, amperes")
    passive: list[str] = Field(default_factory=list, description="joints without a drive, beside free ones")
    hard: list[Finite] = Field(default_factory=list, description="times of keys to pass through, seconds")
    phases: list[PhaseItem] = Field(default_factory=list)
    effort: NotNegative | None = Field(
        None,
        description="weight of drive forces against deviation from the keys; default: 0.001, and keys that "
        "are possible stay as they are",
    )
    deviation: NotNegative = Field(1.0, description="weight of deviation from the keys")
    step: Positive = Field(0.04, description="longest piece of the first grid, seconds")
    tolerance: Positive = Field(1e-3, description="of the certificate, relative")
    within: Positive = Field(
        0.05, description="how far a simulated motion may be from a fitted one, always rad, m"
    )
    at_rest: Switch | None = Field(
        None,
        description="begin and end at rest, or, false, at the keyed velocity, thrown things at any; default: "
        "at rest where the keys rest or are held, else as fast as keyed or slower",
    )
