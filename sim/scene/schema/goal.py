"""What a scene wants of frames, joints and the centre of mass: goals of inverse kinematics."""

from __future__ import annotations

from typing import Annotated, Literal, NamedTuple

from pydantic import Field, model_validator

from ..values import Finite, NotNegative, Positive, Row, Span, Vector, at
from .timed import Timed

Share = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]
Room = Annotated[float, Field(gt=0)]


class _Words(NamedTuple):
    """The words of one kind of goal: needed, rows over time, others; `some`: not all rows are needed."""

    needs: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()
    takes: tuple[str, ...] = ()
    some: bool = False


KINDS = {
    "pose": _Words(("at",), ("position", "rotation", "look_at"), ("axis", "relative_to"), some=True),
    "point_on_line": _Words(("at", "direction"), ("point",)),
    "point_on_plane": _Words(("at", "normal"), ("point",)),
    "distance": _Words(("at", "to"), ("distance",)),
    "center_of_mass": _Words((), ("target",)),
    "joint_value": _Words(("joint",), ("value",)),
    "posture": _Words(("posture",)),
    "mirror": _Words(("at", "of"), (), ("normal", "point", "what", "flip", "relative_to")),
    "pole": _Words(("root", "mid", "tip"), ("pole",)),
    "spread": _Words(("joints",), (), ("shares",)),
    "lock": _Words(("at", "stances"), (), ("lead",)),
}
_ROWS = ("position", "rotation", "look_at", "point", "distance", "target", "value", "pole", "weight", "blend")
_EVERY = (
    "kind", "name", "solve", "velocity", "acceleration", "apart", "clearance", "weight", "blend", "tolerance",
    "joints",
)  # fmt: skip
_TIMED = ("times", "curve", "ease", "before", "after")


class GoalItem(Timed):
    """What is wanted over time; joints without keys are solved for it (inverse kinematics).

    Words over time have one row a time; without ``times`` one row holds all the time. The kinds and their
    words are those of ``pantograph.sim.ik``.
    """

    kind: Literal[
        "pose", "point_on_line", "point_on_plane", "distance", "center_of_mass", "joint_value", "posture",
        "mirror", "pole", "spread", "lock",
    ] = "pose"  # fmt: skip
    name: str = Field("", description="what reports call it")
    times: list[Finite] = Field(default_factory=lambda: [0.0], min_length=1, description="seconds, ascending")
    at: str | None = Field(None, description="site, or body:NAME")
    position: list[Vector] | None = Field(None, description="pose: of its origin, metres, over time")
    rotation: list[Row] | None = Field(None, description="pose: w, x, y, z or euler x, y, z, over time")
    look_at: list[Vector] | None = Field(None, description="pose: point that its axis points to, over time")
    axis: Vector = Field((0.0, 0.0, 1.0), description="pose: local axis that looks")
    relative_to: str | None = Field(
        None, description="pose, mirror: site or body:NAME that carries the goal; default world"
    )
    point: list[Vector] | None = Field(None, description="of the line, plane or mirror, over time")
    direction: Vector | None = Field(None, description="of the line")
    normal: Vector | None = Field(None, description="of the plane; of the mirror, default y")
    to: str | Vector | None = Field(None, description="distance: from this site, body:NAME or point")
    distance: list[NotNegative] | None = Field(None, description="metres, over time")
    target: list[Vector] | None = Field(None, description="of the centre of mass, metres, over time")
    joint: str | None = Field(None, description="joint_value: a hinge or slide")
    value: list[Finite] | None = Field(None, description="joint_value: scene angles or metres, over time")
    posture: dict[str, Row] | None = Field(None, description="joint -> value, as in [initial.position]")
    of: str | None = Field(None, description="mirror: site or body:NAME whose image it is")
    what: Literal["position", "orientation", "pose"] = Field("position", description="mirror: of the frame")
    flip: Vector | None = Field(None, description="mirror: local axis turned around; default the normal")
    root: str | None = Field(None, description="pole: site or body:NAME where the limb begins")
    mid: str | None = Field(None, description="pole: elbow or knee")
    tip: str | None = Field(None, description="pole: hand or foot")
    pole: list[Vector] | None = Field(None, description="pole: point that mid bends towards, over time")
    shares: list[Positive] | None = Field(None, description="spread: of every joint; default all alike")
    stances: list[Span] | None = Field(None, min_length=1, description="lock: [start, end] while it stands")
    lead: NotNegative = Field(0.15, description="lock: seconds to its place before a stance, and back after")
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
    apart: list[tuple[str, str]] = Field(
        default_factory=list, description="live: pairs of geoms that its joints keep apart"
    )
    clearance: Positive = Field(0.01, description="live: metres between the geoms of `apart`")
    weight: Positive | list[NotNegative] | None = Field(
        None, description="a wish of this weight, also over time; without it, a hard goal"
    )
    blend: list[Share] | None = Field(
        None, description="over time: 0 leaves its joints as their keys have them (FK), 1 follows (IK)"
    )
    tolerance: Room | list[Room] | None = Field(
        None, description="metres or scene angles, for all or one a row; inf leaves a row free"
    )
    joints: list[str] = Field(default_factory=list, description="names or patterns; default all that move it")

    @model_validator(mode="after")
    def _of_a_kind(self) -> GoalItem:
        words, given = KINDS[self.kind], self._given()
        allowed = (*words.needs, *words.rows, *words.takes, *_EVERY, *_TIMED)
        for word in given:
            if word not in allowed:
                owners = [k for k, w in KINDS.items() if word in (*w.needs, *w.rows, *w.takes)]
                own = ", ".join((*words.needs, *words.rows, *words.takes))
                message = f"a goal of kind {self.kind!r} has no {word!r}, but: {own}; kinds with it: "
                raise at(word, message=message + ", ".join(owners))
        missing = [w for w in words.needs if w not in given] + [
            w for w in words.rows if not words.some and w not in given
        ]
        if missing:
            listing = ", ".join((*words.needs, *words.rows))
            message = f"{missing[0]!r} is missing: a goal of kind {self.kind!r} needs {listing}"
            raise at(message=message)
        if words.some and not any(w in given for w in words.rows):
            message = "a goal says where to: give 'position', 'rotation', 'look_at', or several; or a 'kind'"
            raise at(message=message)
        return self

    @model_validator(mode="after")
    def _one_row_a_time(self) -> GoalItem:
        for word in _ROWS:
            rows = getattr(self, word)
            if not isinstance(rows, list):
                continue
            if "times" not in self.model_fields_set and len(rows) > 1:
                raise at(word, message=f"{len(rows)} rows need 'times', one a row")
            if len(rows) != len(self.times):
                raise at(word, message=f"{len(self.times)} times but {len(rows)} rows; give one row a time")
        return self

    @model_validator(mode="after")
    def _fits_its_kind(self) -> GoalItem:
        if self.shares is not None and len(self.shares) != len(self.joints):
            message = f"{len(self.joints)} joints but {len(self.shares)} shares; give one share a joint"
            raise at("shares", message=message)
        if self.kind == "lock":
            for word in ("weight", "blend", "tolerance", "velocity", "acceleration", "apart"):
                if word in self._given():
                    raise at(word, message=f"a lock holds to a tenth of a millimetre: it has no {word!r}")
            if self.solve == "live":
                raise at("solve", message="a lock must know the motion to come: it is baked, never live")
        if self.blend is not None and self.solve == "live":
            raise at("blend", message="a goal is blended with keys before the run: it cannot be live")
        if self.apart and self.solve == "baked":
            message = 'a baked goal keeps no geoms apart: give it solve = "live"'
            raise at("apart", message=message)
        if "clearance" in self.model_fields_set and not self.apart:
            raise at("clearance", message="a clearance needs pairs of geoms: give 'apart' with it")
        for word in ("velocity", "acceleration"):
            if self.blend is not None and getattr(self, word) is not None:
                raise at(word, message=f"a goal that is blended with keys cannot keep a limit of {word}")
        return self

    def _given(self) -> list[str]:
        """Words that the item says."""
        return [
            w
            for w in type(self).model_fields
            if w in self.model_fields_set and getattr(self, w) not in (None, [])
        ]
