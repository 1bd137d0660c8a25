"""A whole scene: who moves what, by which physics, and how it is computed."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from ..fitting import FitItem
from ..mistakes import report
from ..values import NotNegative, Pair, Positive, Row, Switch, Vector, at
from ..words import mistakes_of
from .film import CameraItem, FilmItem, LightItem
from .goal import GoalItem
from .item import Item
from .things import ModelItem, PropItem
from .timed import ForceItem, KeysItem


class Initial(Item):
    """State at t = 0; keyed joints take theirs from the keys."""

    keyframe: str | None = Field(None, description="a keyframe of the model file to start from")
    position: dict[str, Row] = Field(default_factory=dict, description="joint -> value")
    velocity: dict[str, Row] = Field(default_factory=dict, description="joint -> value")


class Roles(Item):
    """Who moves which joint; names or patterns with *; joints with keys are keyed, others passive."""

    keyed: list[str] = Field(default_factory=list)
    tracked: list[str] = Field(default_factory=list)
    passive: list[str] = Field(default_factory=list)


class ControllerItem(BaseModel):
    """The law that pushes tracked joints; words beside these are the law's own parameters, see
    'pantograph control --laws'.

    Where a scene's angles are degrees, so are positions, speeds and accelerations of hinges in these, but not
    gains and weights, which are of radians.
    """

    model_config = ConfigDict(extra="allow", frozen=True)

    law: str = "pd"
    period: Positive = Field(0.002, description="seconds between samples; held in between")

    @property
    def parameters(self) -> dict[str, Any]:
        """The law's own parameters."""
        return dict(self.model_extra or {})


class Physics(Item):
    """What of the model's physics takes part; the default is what the model file says."""

    contacts: Literal["model", "none"] | list[Pair] = Field(
        "model", description="as the model file has them, none, or pairs of bodies or geoms"
    )
    limits: Switch = True
    restitution: NotNegative = Field(
        0.0, le=1, description="part of its speed with which a joint rebounds from its limit; smooth engine"
    )
    friction: Switch = Field(True, description="dry friction of joints and tendons")
    gravity: Switch | Vector = True


class Solver(Item):
    """How it is computed; auto is explained by 'pantograph plan'."""

    engine: Literal["auto", "kinematic", "smooth", "contact"] = "auto"
    integrator: str = "auto"
    step: Positive | Literal["auto"] = Field("auto", description="seconds")
    tolerance: Positive | None = Field(None, description="relative tolerance, adaptive integrators only")


class Scene(Item):
    """A whole scene. ``Scene(**toml)`` and ``load_scene(path)`` give equal objects."""

    format: Literal[1] = Field(1, description="version of this format")
    title: str = ""
    duration: Positive = Field(description="seconds")
    angle: Literal["radian", "degree"] = Field(
        "radian",
        description="unit of angles in this scene: of hinges, also of their speeds and accelerations, and of "
        "euler angles; gains and weights are of radians, cameras have degrees",
    )
    rate: Positive = Field(120.0, description="recorded samples a second, rounded to whole steps")
    models: list[ModelItem] = Field(default_factory=list)
    props: list[PropItem] = Field(default_factory=list)
    initial: Initial = Initial()
    roles: Roles = Roles()
    actuators: dict[str, Literal["off", "keys", "controller"]] = Field(
        default_factory=dict, description="actuator name or pattern -> what drives it; the last match rules"
    )
    keys: list[KeysItem] = Field(default_factory=list)
    goals: list[GoalItem] = Field(default_factory=list)
    forces: list[ForceItem] = Field(default_factory=list)
    controller: ControllerItem | None = None
    fit: FitItem | None = None
    physics: Physics = Physics()
    solver: Solver = Solver()
    cameras: list[CameraItem] = Field(default_factory=list)
    lights: list[LightItem] = Field(default_factory=list)
    film: FilmItem = FilmItem()

    _base: Path | None = PrivateAttr(None)
    _lines: dict[tuple[str | int, ...], int] = PrivateAttr(default_factory=dict)
    _file: str = PrivateAttr("scene")

    @field_validator("format", mode="before")
    @classmethod
    def _known_format(cls, value: Any) -> Any:
        if type(value) is int and value != 1:
            raise at(message=f"this Pantograph reads format 1, not {value}; a newer one may read it")
        return value

    @field_validator("models", "props", "cameras", "lights")
    @classmethod
    def _names_once(cls, items: list[Any]) -> list[Any]:
        names = [i.name for i in items]
        for i, name in enumerate(names):
            if name in names[:i] and name is not None:
                raise at(i, "name", message=f"the name {name!r} is used twice")
            if name is None and len(names) > 1:
                raise at(i, message="with several models each needs a 'name'")
        return items

    @model_validator(mode="after")
    def _not_empty(self) -> Scene:
        if not self.models and not self.props:
            raise at(message='a scene needs at least one model or prop: [[models]] file = "pendulum"')
        return self

    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, data: Any, handler: ModelWrapValidatorHandler[Scene]) -> Scene:
        """Raises SceneError, with all mistakes in a person's words, in place of pydantic's error."""
        try:
            return handler(data)
        except ValidationError as e:
            raise report(mistakes_of(e, data, cls), "scene", {}) from None

    def __eq__(self, other: object) -> bool:
        """Whether both say the same, wherever they come from."""
        return isinstance(other, Scene) and self.model_dump() == other.model_dump()

    @property
    def base(self) -> Path:
        """Folder that relative paths of the scene start from."""
        return self._base or Path.cwd()
