"""The rig file: which servos there are, what joint each moves and how far, how fast and how hard it may.

TOML, angles in the unit that `angle` names, lengths in metres; values of a joint with a nonlinear
transmission are in the model's units. `load_rig` reports every mistake at once, with lines.
"""

from __future__ import annotations

import tomllib
from math import pi
from pathlib import Path
from typing import Annotated, Any, Literal

import mujoco
from pydantic import Field, PrivateAttr, ValidationError, model_validator

from ..models import load_model
from ..models.naming import joint_names
from ..sim.kinds import SCALAR
from ..sim.scene.load import locate
from ..sim.scene.mistakes import Mistake, Path_, report
from ..sim.scene.schema import Item
from ..sim.scene.values import Finite, Positive
from .errors import HardwareError, unknown
from .rig_checks import contradictions

Stop = Literal["hold", "park", "limp"]
Range = tuple[Finite, Finite]
VIRTUAL = "virtual"  # port name of virtual servos in memory


class RigError(HardwareError):
    """A rig file contradicts itself, its model or the servos that are there; lists every mistake."""


class ServoItem(Item):
    """A servo on the bus. Angles are the servo's own: zero in the middle of its turn."""

    name: str = Field(pattern=r"^[\w.-]+$")
    id: Annotated[int, Field(ge=0, le=252)]
    model: str = Field(description="model name, such as xm430-w350")
    range: Range | None = Field(None, description="soft limits of the servo's angle")
    velocity: Positive | None = Field(
        None, description="angle per second; default: the model's velocity limit"
    )
    acceleration: Positive | None = Field(None, description="angle per second squared; default: unlimited")
    torque: Positive | None = Field(None, description="N m; default: what the motor gives at that speed")
    current: Positive | None = Field(
        None, description="ampere; the servo runs in current-based position mode and gives way beyond it"
    )
    gain: Annotated[int, Field(ge=0, le=16383)] | None = Field(None, description="position P gain, in counts")
    profile_acceleration: Positive | None = Field(
        None, description="smooths each step of the goal, at the price of lag; default: none"
    )


class DriveItem(Item):
    """How a servo moves its joint: servo angle = direction * ratio * joint value + zero."""

    servo: str
    direction: Literal[1, -1] = 1
    zero: Finite = Field(0.0, description="servo angle where the joint is at zero")
    ratio: Positive = Field(1.0, description="turns of the servo for one turn of the joint")


class CrankItem(Item):
    """Slider-crank of a parallel gripper: x = radius sin(u) + sqrt(rod^2 - radius^2 cos(u)^2)."""

    radius: Positive = Field(description="of the crank, metres")
    rod: Positive = Field(description="length of the connecting rod, metres")

    @model_validator(mode="after")
    def _reaches(self) -> CrankItem:
        if self.rod <= self.radius:
            raise ValueError(f"the rod ({self.rod:g} m) must be longer than the radius ({self.radius:g} m)")
        return self


class JointItem(Item):
    """A joint of the model and the servo, or servos, that move it."""

    joint: str
    servo: str | None = Field(None, description="the servo, if there is one; several stand in 'servos'")
    direction: Literal[1, -1] = 1
    zero: Finite = 0.0
    ratio: Positive = 1.0
    servos: list[DriveItem] = Field(default_factory=list, description="servos that share the joint")
    crank: CrankItem | None = None
    points: list[tuple[Finite, Finite]] | None = Field(
        None,
        description="nonlinear transmission: pairs (metres, crank angle), ascending in the first",
    )
    range: Range | None = Field(None, description="soft limits; default: the model's")
    velocity: Positive | None = None
    acceleration: Positive | None = None
    torque: Positive | None = Field(None, description="N m, or N of a sliding joint")
    park: Finite | None = Field(
        None, description="where the stop 'park' brings it; default: where it started"
    )

    @model_validator(mode="after")
    def _one_way(self) -> JointItem:
        if self.servo is not None and self.servos:
            raise ValueError("give 'servo' or 'servos', not both")
        if self.crank is not None and self.points is not None:
            raise ValueError("give 'crank' or 'points', not both")
        if self.points is not None:
            steps = [(b[0] - a[0], b[1] - a[1]) for a, b in zip(self.points, self.points[1:], strict=False)]
            if len(self.points) < 2 or any(dx <= 0 for dx, _ in steps):
                raise ValueError("'points' needs two pairs at least, ascending in the joint value")
            if any(du * steps[0][1] <= 0 for _, du in steps):
                raise ValueError("'points' must rise or fall all the way, so that it can be inverted")
        return self

    @property
    def slides(self) -> bool:
        """Whether the joint's values are metres, in this file as well: with a crank or a table."""
        return self.crank is not None or self.points is not None

    @property
    def drives(self) -> list[DriveItem]:
        """Servos of this joint."""
        if self.servo is None:
            return self.servos
        one = DriveItem(servo=self.servo, direction=self.direction, zero=self.zero, ratio=self.ratio)
        return [one]


class DifferentialItem(Item):
    """Several joints moved by as many servos together: servo angles = matrix @ joint values + zero."""

    joints: list[str] = Field(min_length=2)
    servos: list[str]
    matrix: list[list[Finite]] = Field(description="one row a servo")
    zero: list[Finite] | None = None

    @model_validator(mode="after")
    def _square(self) -> DifferentialItem:
        import numpy as np

        n = len(self.joints)
        shape = [len(self.servos), len(self.matrix), *(len(r) for r in self.matrix)]
        if self.zero is not None:
            shape.append(len(self.zero))
        if any(s != n for s in shape):
            raise ValueError(f"{n} joints need {n} servos, {n} rows of {n} numbers, and {n} zeros if any")
        if abs(np.linalg.det(np.array(self.matrix))) < 1e-9:
            raise ValueError("the matrix cannot be inverted: two servos do the same")
        return self


class Rig(Item):
    """A whole rig."""

    format: Literal[1] = 1
    name: str = "rig"
    model: str | None = Field(
        None, description="the robot that it embodies, for calibration and teleoperation"
    )
    prefix: str = Field("", description="name of the model in a scene of several: joints are 'prefix/joint'")
    angle: Literal["radian", "degree"] = "radian"
    port: str = Field(VIRTUAL, description=f"serial device, or {VIRTUAL!r} for virtual servos in memory")
    baud: int = Field(1_000_000, description="bit rate")
    rate: Annotated[float, Field(gt=0, le=1000)] = Field(50.0, description="goals a second")
    watchdog: Annotated[float, Field(ge=0.02, le=2.54)] = Field(
        0.2, description="seconds without a word from the host after which every servo stops by itself"
    )
    ramp_velocity: Positive = Field(0.5, description="greatest servo speed on the way in and to park, rad/s")
    following_error: Positive = Field(
        0.5, description="servo angle [rad] behind its goal at which the rig stops"
    )
    servos: list[ServoItem] = Field(min_length=1)
    joints: list[JointItem] = Field(min_length=1)
    differentials: list[DifferentialItem] = Field(default_factory=list)

    _file: str = PrivateAttr("rig")
    _base: Path | None = PrivateAttr(None)
    _lines: dict[Path_, int] = PrivateAttr(default_factory=dict)

    @property
    def unit(self) -> float:
        """Radians in one unit of this file's angles."""
        return pi / 180 if self.angle == "degree" else 1.0

    @property
    def file(self) -> str:
        """Name of the file, for messages."""
        return self._file

    @property
    def ids(self) -> tuple[int, ...]:
        """IDs of the servos, in the file's order."""
        return tuple(s.id for s in self.servos)

    def servo(self, name: str) -> ServoItem:
        """Servo by name."""
        for s in self.servos:
            if s.name == name:
                return s
        raise RigError(unknown("servo", name, [s.name for s in self.servos], where=self._file))

    def joints_of(self, servo: str) -> list[str]:
        """Joints that a servo moves."""
        found = [j.joint for j in self.joints if any(d.servo == servo for d in j.drives)]
        return found + [j for d in self.differentials if servo in d.servos for j in d.joints]

    def joint_unit(self, item: JointItem) -> float:
        """SI value of one unit of a joint's numbers in this file: a metre, or this file's unit of angles."""
        return 1.0 if item.slides else self.unit

    def joint_in(self, model: mujoco.MjModel, joint: str) -> str:
        """Name of a rig's joint in a model: its own, with the prefix, or the only one 'anything/joint'."""
        names = joint_names(model)
        if self.prefix:
            return f"{self.prefix}/{joint}"
        if joint in names:
            return joint
        inside = [n for n in names if n.endswith(f"/{joint}")]
        if len(inside) > 1:
            raise RigError(
                f"{self._file}: the scene has several joints {joint!r}: {', '.join(inside)}; "
                f"say which model the rig is, with a line such as: prefix = {inside[0].rsplit('/', 1)[0]!r}"
            )
        return inside[0] if inside else joint

    def label(self, id: int) -> str:
        """A servo for messages: ID, name and joint."""
        for s in self.servos:
            if s.id == id:
                joints = ", ".join(self.joints_of(s.name)) or "none"
                return f"servo {id} {s.name!r} (joint {joints})"
        return f"servo {id} (not in the rig)"

    def load_model(self) -> mujoco.MjModel:
        """The robot that the rig embodies; RigError when the file names none."""
        if self.model is None:
            raise RigError(f'{self._file} names no model; add a line such as: model = "wx250s"')
        return load_model(self.model, base=self._base)


def find_rig(name_or_path: str | Path) -> Path:
    """File of a rig: a path, or the name of one that comes with Pantograph."""
    path = Path(name_or_path)
    built_in = {p.stem: p for p in (Path(__file__).parent / "rigs").glob("*.toml")}
    if path.is_file():
        return path
    if str(name_or_path) in built_in:
        return built_in[str(name_or_path)]
    raise RigError(f"no rig file {path}; rigs that come with Pantograph: {', '.join(sorted(built_in))}")


def load_rig(name_or_path: str | Path) -> Rig:
    """Read and check a rig file; RigError with every mistake and its line."""
    path = find_rig(name_or_path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as e:
        raise RigError(f"cannot read {path}: {e}") from None
    return parse_rig(text, file=str(path), base=path.parent)


def parse_rig(text: str, *, file: str = "rig", base: Path | None = None) -> Rig:
    """A rig from TOML text; `file` names it in errors, `base` resolves the path of its model."""
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as e:
        raise RigError(f"{file}: not valid TOML: {e}") from None
    lines = locate(text)
    mistakes = contradictions(data)
    rig = None
    try:
        rig = Rig(**data)
    except ValidationError as e:
        mistakes += [Mistake(_path(err["loc"], data), _say(err)) for err in e.errors()]
    if mistakes:
        raise RigError(str(report(mistakes, file, lines)))
    assert rig is not None
    rig._file, rig._base, rig._lines = file, base, lines
    return rig


def check_model(rig: Rig, model: mujoco.MjModel) -> None:
    """Hold a rig against a model; RigError with every joint that does not fit."""
    mistakes = []
    names = joint_names(model)
    for i, item in enumerate(rig.joints):
        name = rig.joint_in(model, item.joint)
        if name not in names:
            mistakes.append(Mistake(("joints", i, "joint"), unknown("joint", name, names, where="the model")))
            continue
        index = names.index(name)
        kind = mujoco.mjtJoint(int(model.jnt_type[index]))
        slide = kind == mujoco.mjtJoint.mjJNT_SLIDE
        if kind not in SCALAR:
            mistakes.append(
                Mistake(
                    ("joints", i, "joint"), f"{item.joint!r} is a ball or free joint; a servo moves one axis"
                )
            )
        elif item.slides and not slide:
            message = f"{item.joint!r} turns; 'crank' and 'points' are for joints that slide, in metres"
            mistakes.append(Mistake(("joints", i, "joint"), message))
        elif slide and not item.slides:
            mistakes.append(
                Mistake(
                    ("joints", i, "joint"),
                    f"{item.joint!r} slides; add 'crank' or 'points', or a ratio in 'points'",
                )
            )
        elif model.jnt_limited[index] and item.range is not None:
            unit = 1.0 if slide else rig.unit
            low, high = (float(x) / unit for x in model.jnt_range[index])
            slack = 1e-3 * (high - low)
            if item.range[0] < low - slack or item.range[1] > high + slack:
                mistakes.append(
                    Mistake(
                        ("joints", i, "range"),
                        f"[{item.range[0]:g}, {item.range[1]:g}] is wider than the model's "
                        f"[{low:.5g}, {high:.5g}]",
                    )
                )
    if mistakes:
        raise RigError(str(report(mistakes, rig.file, rig._lines)))


_ITEMS: dict[Any, type[Item]] = {
    "servos": ServoItem,
    "joints": JointItem,
    "differentials": DifferentialItem,
    "crank": CrankItem,
}


def _path(loc: tuple[str | int, ...], data: Any) -> Path_:
    """Pydantic's location without what is not in the file (members of unions)."""
    out: list[str | int] = []
    for i, part in enumerate(loc):
        if isinstance(data, dict) and (part in data or i == len(loc) - 1):
            data = data.get(part)
        elif isinstance(data, list) and isinstance(part, int) and part < len(data):
            data = data[part]
        else:
            continue
        out.append(part)
    return tuple(out)


def _say(error: Any) -> str:
    """Pydantic's finding in a person's words."""
    kind = error["type"]
    if kind == "extra_forbidden":
        table = next((_ITEMS[p] for p in error["loc"][-2::-1] if p in _ITEMS), Rig)
        return f"there is no such word here; there are: {', '.join(table.model_fields)}"
    if kind == "missing":
        return "is missing"
    if kind == "value_error":
        return str(error["ctx"]["error"])
    return f"{error['msg'][0].lower()}{error['msg'][1:]}, got {error.get('input')!r}"
