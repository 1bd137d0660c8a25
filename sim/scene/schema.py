"""What a scene can say: the same objects whether written as TOML or in Python (format 1)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, PrivateAttr, field_validator, model_validator

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
Vector = tuple[Finite, Finite, Finite]
Quaternion = tuple[Finite, Finite, Finite, Finite]
Colour = tuple[Finite, Finite, Finite] | tuple[Finite, Finite, Finite, Finite]
Row = Finite | list[Finite]
Curve = Literal["step", "linear", "auto", "natural", "clamped"]


class Item(BaseModel):
    """Base of every table of a scene: unknown words are mistakes, values do not change after loading."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class Placement(Item):
    """Where something stands in the world: X_W of its root."""

    position: Vector = Field((0.0, 0.0, 0.0), description="metres")
    rotation: Quaternion | None = Field(None, description="quaternion w, x, y, z")
    euler: Vector | None = Field(None, description="rotations about the fixed x, y, z axes, in scene angles")

    @model_validator(mode="after")
    def _one_rotation(self) -> Placement:
        if self.rotation is not None and self.euler is not None:
            raise ValueError("give 'rotation' (quaternion) or 'euler', not both")
        if self.rotation is not None and sum(c * c for c in self.rotation) < 1e-12:
            raise ValueError("'rotation' is the zero quaternion; no rotation is [1, 0, 0, 0]")
        return self


class ChainItem(Item):
    """A chain of equal links hanging from its upper end, or loose; see ``pantograph.models.chain``."""

    links: Annotated[int, Field(ge=1, le=1000)]
    length: Positive = Field(1.0, description="of the whole chain, metres")
    mass: Positive = Field(1.0, description="of the whole chain, kg")
    joint: Literal["ball", "hinge"] = "ball"
    radius: Positive | None = Field(None, description="of the links, metres")
    damping: Annotated[float, Field(ge=0, allow_inf_nan=False)] = Field(0.0, description="N m s/rad")
    fixed: bool = Field(True, description="hangs from the world; otherwise it is loose")
    point_masses: bool = False
    contacts: bool = Field(False, description="links touch other things")


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
            raise ValueError("give 'file' or 'chain', one of them")
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
    fixed: bool = False

    @model_validator(mode="after")
    def _sizes(self) -> PropItem:
        need = {"plane": 2, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "mesh": 0}
        if len(self.size) != need[self.shape]:
            raise ValueError(f"a {self.shape} needs {need[self.shape]} sizes, got {len(self.size)}")
        if (self.shape == "mesh") != (self.file is not None):
            raise ValueError("'file' belongs to shape 'mesh', and a mesh needs it")
        if self.shape == "plane" and not self.fixed:
            raise ValueError("a plane must be fixed: fixed = true")
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
            raise ValueError(f"keys name one of joint, actuator, camera, light; got {given or 'none'}")
        allowed = {
            "joint": ("value", "position", "rotation"),
            "actuator": ("value",),
            "camera": ("position", "target", "fovy"),
            "light": ("position", "target", "intensity", "color"),
        }[given[0]]
        if self.channel is None and given[0] in ("camera", "light"):
            raise ValueError(f"keys of a {given[0]} need a channel: {', '.join(allowed)}")
        if self.channel is not None and self.channel not in allowed:
            raise ValueError(f"a {given[0]} has no channel {self.channel!r}; it has: {', '.join(allowed)}")
        if len(self.times) != len(self.values):
            raise ValueError(f"{len(self.times)} times but {len(self.values)} values; give one value a time")
        for t0, t1 in zip(self.times, self.times[1:], strict=False):
            if t1 <= t0:
                raise ValueError(f"times must ascend: {t1:g} follows {t0:g}")
        if len({len(r) if isinstance(r, list) else 0 for r in self.values}) > 1:
            raise ValueError("values differ in length; every row needs the same number of components")
        return self


class ForceItem(Item):
    """A force and torque on a body at its centre of mass, constant or over time."""

    body: str
    force: Vector | list[Vector] | None = Field(None, description="newtons: one vector, or one a time")
    torque: Vector | list[Vector] | None = Field(None, description="newton metres")
    frame: Literal["world", "body"] = "world"
    times: list[Finite] | None = Field(None, description="seconds, for vectors over time")
    curve: Curve = "linear"
    start: Finite | None = Field(None, description="constant vectors: first moment, seconds")
    stop: Finite | None = Field(None, description="constant vectors: end, seconds")

    @model_validator(mode="after")
    def _shape(self) -> ForceItem:
        if self.force is None and self.torque is None:
            raise ValueError("give a force, a torque or both")
        for name in ("force", "torque"):
            value = getattr(self, name)
            if value is None:
                continue
            over_time = isinstance(value, list)
            if over_time != (self.times is not None):
                raise ValueError(f"{name}: one vector without 'times', or a list with as many 'times'")
            if over_time and self.times is not None and len(value) != len(self.times):
                raise ValueError(f"{name} has {len(value)} vectors for {len(self.times)} times")
        if self.times is not None:
            if self.start is not None or self.stop is not None:
                raise ValueError("'start' and 'stop' belong to constant vectors; use 'times' alone")
            if any(b <= a for a, b in zip(self.times, self.times[1:], strict=False)):
                raise ValueError("times must ascend")
        if self.start is not None and self.stop is not None and self.stop <= self.start:
            raise ValueError(f"stop ({self.stop:g}) must come after start ({self.start:g})")
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

    contacts: Literal["model", "none"] | list[tuple[str, str]] = Field(
        "model", description="as the model file has them, none, or pairs of bodies or geoms"
    )
    limits: bool = True
    friction: bool = Field(True, description="dry friction of joints and tendons")
    gravity: bool | Vector = True


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
    fovy: Annotated[float, Field(gt=0, lt=180)] = Field(45.0, description="vertical field of view, degrees")

    @model_validator(mode="after")
    def _kind_needs(self) -> CameraItem:
        if self.kind == "tracking" and self.body is None:
            raise ValueError("a tracking camera needs the 'body' to follow")
        return self


class LightItem(Item):
    """A light of the film."""

    name: str
    kind: Literal["directional", "point", "spot"] = "directional"
    position: Vector = (1.0, -1.0, 3.0)
    target: Vector = (0.0, 0.0, 0.0)
    color: Vector = (1.0, 1.0, 1.0)
    intensity: Annotated[float, Field(ge=0, allow_inf_nan=False)] = 1.0
    shadow: bool = True


class FilmItem(Item):
    """The film's format."""

    width: Annotated[int, Field(ge=16, le=7680)] = 640
    height: Annotated[int, Field(ge=16, le=4320)] = 480
    fps: Annotated[float, Field(gt=0, le=1000)] = 30.0
    camera: str | None = Field(None, description="name of a camera; default frames the whole motion")
    shadows: bool = True


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
    forces: list[ForceItem] = Field(default_factory=list)
    controller: ControllerItem | None = None
    physics: Physics = Physics()
    solver: Solver = Solver()
    cameras: list[CameraItem] = Field(default_factory=list)
    lights: list[LightItem] = Field(default_factory=list)
    film: FilmItem = FilmItem()

    _base: Path | None = PrivateAttr(None)
    _lines: dict[tuple[str | int, ...], int] = PrivateAttr(default_factory=dict)
    _file: str = PrivateAttr("scene")

    @field_validator("models", "props", "cameras", "lights")
    @classmethod
    def _names_once(cls, items: list[Any]) -> list[Any]:
        names = [i.name for i in items]
        twice = sorted({n for n in names if n is not None and names.count(n) > 1})
        if twice:
            raise ValueError(f"the name {twice[0]!r} is used twice")
        if len(names) > 1 and None in names:
            raise ValueError("with several models each needs a 'name'")
        return items

    @model_validator(mode="after")
    def _not_empty(self) -> Scene:
        if not self.models and not self.props:
            raise ValueError('a scene needs at least one model or prop: [[models]] file = "pendulum"')
        return self

    @property
    def base(self) -> Path:
        """Folder that relative paths of the scene start from."""
        return self._base or Path.cwd()
