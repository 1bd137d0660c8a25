"""What a scene can say: the same objects whether written as TOML or in Python (format 1)."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

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

from ..curves import check_kind
from ..errors import KeyingError
from .fitting import FitItem
from .mistakes import report
from .values import Colour, Finite, NotNegative, Pair, Positive, Quaternion, Row, Switch, Vector, at, plain
from .words import mistakes_of

Curve = Literal["step", "linear", "auto", "natural", "clamped"]


class Item(BaseModel):
    """Base of every table of a scene: unknown words are mistakes, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    @field_validator("*", mode="before")
    @classmethod
    def _plain(cls, value: Any) -> Any:
        return plain(value)


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


class KeysItem(Item):
    """Keys of one channel: a joint, an actuator, or a property of a camera or light."""

    joint: str | None = None
    actuator: str | None = None
    camera: str | None = None
    light: str | None = None
    channel: Literal["value", "position", "rotation", "target", "fovy", "intensity", "color"] | None = Field(
        None, description="needed for free joints, cameras and lights"
    )
    times: list[Finite] = Field(min_length=1, description="seconds, ascending")
    values: list[Row] = Field(
        min_length=1, description="one row a time; rotations as w, x, y, z or euler x, y, z"
    )
    curve: Curve = "auto"
    ease: str | None = Field(None, description="easing between keys, instead of the curve's own timing")
    before: Literal["hold", "loop"] = "hold"
    after: Literal["hold", "loop"] = "hold"

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
        _ascending(self.times)
        if len({len(r) if isinstance(r, list) else 0 for r in self.values}) > 1:
            raise at("values", message="every value needs the same number of components")
        try:
            check_kind(self.curve, self.ease, self.before, self.after)
        except KeyingError as e:
            raise at("ease", message=str(e)) from None
        return self


class GoalItem(Item):
    """What a site or body does over time; joints without keys are solved for it (inverse kinematics)."""

    at: str = Field(description="site, or body:NAME")
    times: list[Finite] = Field(min_length=1, description="seconds, ascending")
    position: list[Vector] | None = Field(None, description="of its origin, metres, one row a time")
    rotation: list[Row] | None = Field(None, description="w, x, y, z or euler x, y, z, one row a time")
    look_at: list[Vector] | None = Field(None, description="point that its axis points to, one row a time")
    axis: Vector = Field((0.0, 0.0, 1.0), description="local axis that looks")
    relative_to: str | None = Field(
        None, description="site or body:NAME that carries the goal; default world"
    )
    solve: Literal["auto", "baked", "live"] = Field(
        "auto",
        description="before the run, smooth over all of it; or live, tick by tick from the state of the run",
    )
    velocity: Positive | None = Field(
        None,
        description="limit of its joints, scene angles or metres a second; live default: half a turn, 1 m",
    )
    acceleration: Positive | None = Field(
        None, description="likewise, per second squared; live default: 3 turns, 10 m"
    )
    weight: Positive | None = Field(None, description="a wish of this weight; without it, a hard goal")
    joints: list[str] = Field(default_factory=list, description="names or patterns; default all that move it")
    curve: Curve = "auto"
    ease: str | None = Field(None, description="easing between keys, instead of the curve's own timing")
    before: Literal["hold", "loop"] = "hold"
    after: Literal["hold", "loop"] = "hold"

    @model_validator(mode="after")
    def _something(self) -> GoalItem:
        given = [w for w in ("position", "rotation", "look_at") if getattr(self, w) is not None]
        if not given:
            raise at(message="a goal says where to: give 'position', 'rotation', 'look_at', or several")
        for word in given:
            rows = getattr(self, word)
            if len(rows) != len(self.times):
                raise at(word, message=f"{len(self.times)} times but {len(rows)} rows; give one row a time")
        _ascending(self.times)
        try:
            check_kind(self.curve, self.ease, self.before, self.after)
        except KeyingError as e:
            raise at("ease", message=str(e)) from None
        return self


def _ascending(times: list[float]) -> None:
    for t0, t1 in pairwise(times):
        if t1 <= t0:
            raise at("times", message=f"times must ascend: {t1:g} follows {t0:g}")


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
            _ascending(self.times)
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise at("stop", message=f"stop ({self.stop:g}) must come after start ({self.start:g})")
        return self


class ControllerItem(BaseModel):
    """The law that pushes tracked joints; words beside these are the law's own parameters."""

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
    friction: Switch = Field(True, description="dry friction of joints and tendons")
    gravity: Switch | Vector = True


class Solver(Item):
    """How it is computed; auto is explained by 'pantograph plan'."""

    engine: Literal["auto", "kinematic", "smooth", "contact"] = "auto"
    integrator: str = "auto"
    step: Positive | Literal["auto"] = Field("auto", description="seconds")
    tolerance: Positive | None = Field(None, description="relative tolerance, adaptive integrators only")


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


class Scene(Item):
    """A whole scene. ``Scene(**toml)`` and ``load_scene(path)`` give equal objects."""

    format: Literal[1] = Field(1, description="version of this format")
    title: str = ""
    duration: Positive = Field(description="seconds")
    angle: Literal["radian", "degree"] = Field("radian", description="unit of all angles in this scene")
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
