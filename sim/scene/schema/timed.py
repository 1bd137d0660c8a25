"""What a scene says over time: keys and forces."""

from __future__ import annotations

from itertools import pairwise
from typing import Literal

from pydantic import Field, model_validator

from ...curves import check_kind
from ...errors import KeyingError
from ..values import Finite, Row, Vector, at
from .item import Item

Curve = Literal["step", "linear", "auto", "natural", "clamped"]


class Timed(Item):
    """Rows at times, and the curve through them."""

    times: list[Finite] = Field(min_length=1, description="seconds, ascending")
    curve: Curve = "auto"
    ease: str | None = Field(None, description="easing between keys, instead of the curve's own timing")
    before: Literal["hold", "loop"] = "hold"
    after: Literal["hold", "loop"] = "hold"

    @model_validator(mode="after")
    def _a_curve(self) -> Timed:
        ascending(self.times)
        try:
            check_kind(self.curve, self.ease, self.before, self.after)
        except KeyingError as e:
            raise at("ease", message=str(e)) from None
        return self


def ascending(times: list[float]) -> None:
    """Raise when a time does not come after the one before it."""
    for t0, t1 in pairwise(times):
        if t1 <= t0:
            raise at("times", message=f"times must ascend: {t1:g} follows {t0:g}")


class KeysItem(Timed):
    """Keys of one channel: a joint, an actuator, or a property of a camera or light."""

    joint: str | None = None
    actuator: str | None = None
    camera: str | None = None
    light: str | None = None
    channel: Literal["value", "position", "rotation", "target", "fovy", "intensity", "color"] | None = Field(
        None, description="needed for free joints, cameras and lights"
    )
    values: list[Row] = Field(
        min_length=1, description="one row a time; rotations as w, x, y, z or euler x, y, z"
    )

    @model_validator(mode="after")
    def _one_target(self) -> KeysItem:
        given = [k for k in ("joint", "actuator", "camera", "light") if getattr(self, k) is not None]
        if len(given) != 1:
            got = " and ".join(given) or "none"
            raise at(message=f"keys name one of joint, actuator, camera, light; got {got}")
        allowed = {
            "joint": ("value", "position", "rotation"),
            "actuator": ("value",),
            "camera": ("position", "target", "fovy"),
            "light": ("position", "target", "intensity", "color"),
        }[given[0]]
        if self.channel is None and given[0] in ("camera", "light"):
            raise at(message=f"keys of a {given[0]} need a channel: {', '.join(allowed)}")
        if self.channel is not None and self.channel not in allowed:
            message = f"a {given[0]} has no channel {self.channel!r}; it has: {', '.join(allowed)}"
            raise at("channel", message=message)
        if len(self.times) != len(self.values):
            message = f"{len(self.times)} times but {len(self.values)} values; give one value a time"
            raise at("values", message=message)
        if len({len(r) if isinstance(r, list) else 0 for r in self.values}) > 1:
            raise at("values", message="every value needs the same number of components")
        return self


class ForceItem(Item):
    """A force and torque on a body at its centre of mass, constant or over time."""

    body: str
    force: Vector | list[Vector] | None = Field(None, description="newtons: one vector, or one a time")
    torque: Vector | list[Vector] | None = Field(None, description="newton metres")
    frame: Literal["world", "body"] = "world"
    times: list[Finite] | None = Field(None, min_length=1, description="seconds, for vectors over time")
    curve: Curve = "linear"
    start: Finite | None = Field(None, description="constant vectors: first moment, seconds")
    stop: Finite | None = Field(None, description="constant vectors: end, seconds")

    @model_validator(mode="after")
    def _shape(self) -> ForceItem:
        if self.force is None and self.torque is None:
            raise at(message="give a force, a torque or both")
        for name in ("force", "torque"):
            value = getattr(self, name)
            if value is None:
                continue
            over_time = isinstance(value, list)
            if over_time != (self.times is not None):
                raise at(name, message="give one vector without 'times', or a list with as many 'times'")
            if over_time and self.times is not None and len(value) != len(self.times):
                raise at(name, message=f"{len(value)} vectors for {len(self.times)} times")
        if self.times is not None:
            if self.start is not None or self.stop is not None:
                word = "start" if self.start is not None else "stop"
                raise at(word, message="'start' and 'stop' belong to constant vectors; use 'times' alone")
            ascending(self.times)
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise at("stop", message=f"stop ({self.stop:g}) must come after start ({self.start:g})")
        return self
