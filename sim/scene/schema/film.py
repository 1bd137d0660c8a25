"""How a scene is filmed: cameras, lights, format."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..values import Finite, NotNegative, Positive, Switch, Vector, at
from .item import Item


class CameraItem(Item):
    """A camera: fixed, following a body, circling, or one of the model file."""

    name: str
    kind: Literal["fixed", "tracking", "orbit", "model"] = "fixed"
    position: Vector | None = Field(None, description="metres; tracking: offset from the body")
    target: Vector | None = Field(None, description="looked-at point, metres")
    body: str | None = Field(None, description="body to follow or circle")
    radius: Positive | None = Field(None, description="orbit: metres")
    elevation: Finite = Field(0.3, description="orbit: scene angles above the horizon")
    azimuth: Finite = Field(0.0, description="orbit: scene angles at t = 0")
    period: Positive | None = Field(None, description="orbit: seconds a turn")
    fovy: Positive = Field(45.0, lt=180, description="vertical field of view, degrees")

    @model_validator(mode="after")
    def _kind_needs(self) -> CameraItem:
        if self.kind == "tracking" and self.body is None:
            raise at(message="a tracking camera needs the 'body' to follow")
        return self


class LightItem(Item):
    """A light of the film."""

    name: str
    kind: Literal["directional", "point", "spot"] = "directional"
    position: Vector = (1.0, -1.0, 3.0)
    target: Vector = (0.0, 0.0, 0.0)
    color: Vector = (1.0, 1.0, 1.0)
    intensity: NotNegative = 1.0
    shadow: Switch = True


class FilmItem(Item):
    """The film's format."""

    width: Annotated[int, Field(ge=16, le=7680)] = 640
    height: Annotated[int, Field(ge=16, le=4320)] = 480
    fps: Positive = Field(30.0, le=1000)
    camera: str | None = Field(None, description="name of a camera; default frames the whole motion")
    shadows: Switch = True
