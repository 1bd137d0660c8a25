"""What stands in a scene: models, chains and props with their placement."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from ..values import Colour, NotNegative, Positive, Quaternion, Switch, Vector, at
from .item import Item


class Placement(Item):
    """Where something stands in the world: X_W of its root."""

    position: Vector = Field((0.0, 0.0, 0.0), description="metres")
    rotation: Quaternion | None = Field(None, description="quaternion w, x, y, z")
    euler: Vector | None = Field(None, description="rotations about the fixed x, y, z axes, in scene angles")

    @model_validator(mode="after")
    def _one_rotation(self) -> Placement:
        if self.rotation is not None and self.euler is not None:
            raise at("euler", message="give 'rotation' (quaternion) or 'euler', not both")
        if self.rotation is not None and sum(c * c for c in self.rotation) < 1e-12:
            raise at("rotation", message="the zero quaternion is no rotation; [1, 0, 0, 0] turns nothing")
        return self


class ChainItem(Item):
    """A chain of equal links hanging from its upper end, or loose; see ``pantograph.models.chain``."""

    links: Annotated[int, Field(ge=1, le=1000)]
    length: Positive = Field(1.0, description="of the whole chain, metres")
    mass: Positive = Field(1.0, description="of the whole chain, kg")
    joint: Literal["ball", "hinge"] = "ball"
    radius: Positive | None = Field(None, description="of the links, metres")
    damping: NotNegative = Field(0.0, description="N m s/rad")
    fixed: Switch = Field(True, description="hangs from the world; otherwise it is loose")
    point_masses: Switch = False
    contacts: Switch = Field(False, description="links touch other things")


class ModelItem(Placement):
    """A robot or figure from a file, or a chain."""

    file: str | None = Field(
        None, description="built-in model name, or a path to MJCF or URDF, relative to the scene"
    )
    chain: ChainItem | None = None
    name: str | None = Field(None, pattern=r"^[\w.-]+$", description="prefix 'name/' of everything in it")

    @model_validator(mode="after")
    def _one_source(self) -> ModelItem:
        if (self.file is None) == (self.chain is None):
            raise at(message="give 'file' or 'chain', one of them")
        return self


class PropItem(Placement):
    """A loose thing: one body of one shape, free unless fixed."""

    name: str = Field(pattern=r"^[\w.-]+$")
    shape: Literal["plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh"]
    size: list[Positive] = Field(
        default_factory=list, description="half-sizes or radii as in MJCF, metres; plane: half-lengths x, y"
    )
    file: str | None = Field(None, description="mesh file (shape 'mesh'), relative to the scene")
    mass: Positive | None = Field(None, description="kg; default from the density of water")
    color: Colour = (0.7, 0.7, 0.75)
    friction: Positive | None = Field(None, description="sliding friction coefficient")
    fixed: Switch = False

    @model_validator(mode="after")
    def _sizes(self) -> PropItem:
        need = {"plane": 2, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "mesh": 0}
        if len(self.size) != need[self.shape]:
            count = f"{need[self.shape]} size{'s' * (need[self.shape] != 1)}"
            raise at("size", message=f"a {self.shape} needs {count}, got {len(self.size)}")
        if (self.shape == "mesh") != (self.file is not None):
            raise at("file", message="shape 'mesh' needs a 'file', and no other shape has one")
        if self.shape == "plane" and not self.fixed:
            raise at("fixed", message="a plane must be fixed: fixed = true")
        return self
