"""From the items of a scene to goals of inverse kinematics at every time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ....models import lookup, name_of
from ... import rotations
from ...curves import Curve, keyed
from ...errors import PantographError
from ...ik import (
    CenterOfMass,
    Distance,
    Goal,
    JointValue,
    LookAt,
    Mirror,
    Orientation,
    PointOnLine,
    PointOnPlane,
    Pole,
    Pose,
    Position,
    Posture,
    Spread,
)
from ...ik.goals import TOLERANCE
from ...ik.pose import Kinematics
from ...kinds import BALL, FREE, HINGE
from ...rotation_curves import keyed_rotation
from ..mistakes import Mistake
from ..names import Names
from ..schema import GoalItem, Scene

Array = NDArray[np.float64]
_FRAMES = ("at", "relative_to", "of", "to", "root", "mid", "tip")
_ROWS = ("position", "look_at", "point", "distance", "target", "value", "pole", "weight", "blend")
_FAINT = 1e-9  # weight of a wish that has faded out


@dataclass(frozen=True)
class Wanted:
    """One item of a scene with its curves: what is wanted of `model` at every time.

    `labels`: of the goals that it gives, each once in the scene. `joints`: ids of those it names.
    """

    item: GoalItem
    model: mujoco.MjModel
    curves: Mapping[str, Curve]
    angle: float  # [rad] of the scene's unit
    joints: tuple[int, ...] = ()
    posture: tuple[Array, NDArray[np.bool_]] | None = None  # (nq,), and which freedoms (nv,) it says
    labels: tuple[str, ...] = ()

    def goals(self, t: float) -> list[Goal]:
        """Goals at time t [s]; none of a lock, which is no goal of a single instant."""
        row = {word: curve(t).q for word, curve in self.curves.items()}
        weight = self.item.weight
        if "weight" in row:
            weight = max(float(row["weight"][0]), _FAINT)
        out = _MAKERS[self.item.kind](self, self.item, row, {"weight": weight})
        names = self.labels or (self.item.name,) * len(out)
        return [
            replace(goal, name=name, tolerance=self._tolerance(goal))
            for goal, name in zip(out, names, strict=False)
        ]

    def _tolerance(self, goal: Goal) -> float | tuple[float, ...]:
        """The item's tolerance in metres and radians; the goal's own where it says none."""
        given = self.item.tolerance
        if given is None:
            return goal.tolerance
        units = goal.units(self.model)
        rows = given if isinstance(given, list) else [given] * len(units)
        if len(rows) != len(units):
            listing = ", ".join("metres" if u == "m" else "angle" for u in units)
            raise PantographError(f"{len(rows)} tolerances for {len(units)} rows: give one, or {listing}")
        scaled = [x * (1.0 if u == "m" else self.angle) for x, u in zip(rows, units, strict=True)]
        return tuple(np.where(np.isinf(goal.tolerance), np.inf, scaled).tolist())  # free rows stay free

    def share(self, t: Array) -> Array:
        """How far goals overrule keys at times t (n,): (n,)."""
        if "blend" not in self.curves:
            return np.ones(len(t))
        return np.asarray(np.clip([self.curves["blend"](float(x)).q[0] for x in t], 0.0, 1.0))


Row_ = dict[str, Array]  # values of curves at a time
Words = dict[str, Any]


def _pose(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    out, base = list[Goal](), item.relative_to
    p, quat = row.get("position"), row.get("rotation")
    if p is not None and quat is not None:
        out.append(Pose(item.at, p, quat, base, **words))
    elif p is not None:
        out.append(Position(item.at, p, base, **words))
    elif quat is not None:
        out.append(Orientation(item.at, quat, base, **words))
    if "look_at" in row:
        out.append(LookAt(item.at, row["look_at"], item.axis, base, **words))
    return out


def _line(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    return [PointOnLine(item.at, row["point"], item.direction, **words)]


def _plane(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    return [PointOnPlane(item.at, row["point"], item.normal, **words)]


def _distance(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    return [Distance(item.at, item.to, max(0.0, float(row["distance"][0])), **words)]


def _center(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    return [CenterOfMass(row["target"], **words)]


def _joint(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    turns = w.model.jnt_type[w.joints[0]] == HINGE
    return [JointValue(item.joint, float(row["value"][0]) * (w.angle if turns else 1.0), **words)]


def _posture(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    assert w.posture is not None
    q, said = w.posture
    return [Posture(q, tolerance=tuple(np.where(said, TOLERANCE, np.inf).tolist()), **words)]


def _mirror(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    said = {"normal": item.normal, "point": row.get("point"), "flip": item.flip}
    plane = {word: x for word, x in said.items() if x is not None}
    return [Mirror(item.at, item.of, relative_to=item.relative_to, what=item.what, **plane, **words)]


def _pole(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    return [Pole(item.root, item.mid, item.tip, row["pole"], **words)]


def _spread(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    names = tuple(name_of(w.model, "joint", j) for j in w.joints)
    return [Spread(names, tuple(item.shares or ()), **words)]


def _lock(w: Wanted, item: Any, row: Row_, words: Words) -> list[Goal]:
    return []


_MAKERS: dict[str, Callable[[Wanted, Any, Row_, Words], list[Goal]]] = {
    "pose": _pose, "point_on_line": _line, "point_on_plane": _plane, "distance": _distance,
    "center_of_mass": _center, "joint_value": _joint, "posture": _posture, "mirror": _mirror, "pole": _pole,
    "spread": _spread, "lock": _lock,
}  # fmt: skip


def together(parts: Sequence[Wanted]) -> Callable[[float], list[Goal]]:
    """All goals of several items over time."""
    return lambda t: [goal for part in parts for goal in part.goals(t)]


def wanted(scene: Scene, model: mujoco.MjModel) -> tuple[list[Wanted], list[Mistake]]:
    """Every item of the scene with its curves; items with mistakes are left out."""
    out, mistakes, kinematics = list[Wanted](), list[Mistake](), Kinematics(model)
    counts: dict[str, int] = {}
    for i, item in enumerate(scene.goals):
        wrong = _names(item, i, model, kinematics)
        if not wrong:
            try:
                part = _wanted(scene, item, model)
                part = replace(part, labels=_labels(part, counts))
                part.goals(0.0)
                for goal in part.goals(0.0):
                    goal.moved(kinematics)
                    goal.rows(kinematics.at(model.qpos0[None]))
                out.append(part)
            except _At as e:
                wrong = [Mistake(("goals", i, *e.path), e.message)]
            except PantographError as e:
                wrong = [Mistake(("goals", i), str(e))]
        mistakes += wrong
    return out, mistakes


class _At(Exception):
    """A mistake at a place of an item."""

    def __init__(self, *path: str, message: str) -> None:
        self.path, self.message = path, message


def _names(item: GoalItem, i: int, model: mujoco.MjModel, kinematics: Kinematics) -> list[Mistake]:
    """Mistakes of the names of frames and joints."""
    mistakes, joints = list[Mistake](), Names(model, "joint")
    for word in _FRAMES:
        text = getattr(item, word)
        if isinstance(text, str):
            try:
                kinematics.frame(text)
            except PantographError as e:
                mistakes.append(Mistake(("goals", i, word), str(e)))
    for k, pattern in enumerate(item.joints):
        if not joints.match(pattern):
            mistakes.append(Mistake(("goals", i, "joints", k), joints.missing(pattern)))
    if item.joint is not None and item.joint not in joints.ids:
        mistakes.append(Mistake(("goals", i, "joint"), joints.missing(item.joint)))
    for k, pair in enumerate(item.apart):
        try:
            one, other = (lookup(model, "geom", name) for name in pair)
        except PantographError as e:
            mistakes.append(Mistake(("goals", i, "apart", k), str(e)))
            continue
        if model.geom_bodyid[one] == model.geom_bodyid[other]:
            message = f"geoms {pair[0]!r} and {pair[1]!r} are on one body: they never part"
            mistakes.append(Mistake(("goals", i, "apart", k), message))
    for name in item.posture or {}:
        if name not in joints.ids:
            mistakes.append(Mistake(("goals", i, "posture", name), joints.missing(name)))
    return mistakes


def _wanted(scene: Scene, item: GoalItem, model: mujoco.MjModel) -> Wanted:
    angle = np.pi / 180 if scene.angle == "degree" else 1.0
    ends: dict[str, Any] = {
        "kind": item.curve, "ease": item.ease, "before": item.before, "after": item.after,
    }  # fmt: skip
    curves: dict[str, Curve] = {}
    for word in (*_ROWS, "rotation"):
        rows = getattr(item, word)
        if not isinstance(rows, list):
            continue
        try:
            if word == "rotation":
                curves[word] = keyed_rotation(item.times, _quaternions(rows, angle), **ends)
            else:
                curves[word] = keyed(item.times, np.array(rows, dtype=float).reshape(len(rows), -1), **ends)
        except PantographError as e:
            raise _At(word, message=str(e)) from None
    names = Names(model, "joint")
    joints = [names.ids[item.joint]] if item.joint else [j for p in item.joints for j in names.match(p)]
    posture = None
    if item.posture is not None:
        posture = _posed(item.posture, model, names, angle)
        joints = [names.ids[name] for name in item.posture]
    return Wanted(item, model, curves, angle, tuple(dict.fromkeys(joints)), posture)


def _quaternions(rows: Sequence[Any], angle: float) -> Array:
    """Rows w, x, y, z, from those or euler x, y, z."""
    widths = {np.size(row) for row in rows}
    if not (len(widths) == 1 and widths <= {3, 4}):
        shown = ", ".join(str(n) for n in sorted(widths))
        raise PantographError(f"a rotation is w, x, y, z or euler x, y, z; got rows of {shown} numbers")
    out = np.array(rows, dtype=float)
    return rotations.from_euler("xyz", angle * out) if widths == {3} else out


def _posed(
    posture: Mapping[str, Any], model: mujoco.MjModel, names: Names, angle: float
) -> tuple[Array, NDArray[np.bool_]]:
    """Configuration (nq,) with the joints of a posture as it says, and their freedoms (nv,)."""
    q, said = model.qpos0.copy(), np.zeros(model.nv, dtype=bool)
    for name, value in posture.items():
        j = names.ids[name]
        kind, row = int(model.jnt_type[j]), np.atleast_1d(np.array(value, dtype=float))
        width = {FREE: 7, BALL: 4}.get(kind, 1)
        if len(row) != width:
            message = f"joint {name!r} needs {width} number{'s' * (width > 1)}, got {len(row)}"
            raise _At("posture", name, message=message)
        at = int(model.jnt_qposadr[j])
        q[at : at + width] = row * (angle if kind == HINGE else 1.0)
        if kind in (FREE, BALL):
            length = np.linalg.norm(row[-4:])
            if length < 1e-12:
                raise _At("posture", name, message="the zero quaternion is no rotation")
            q[at + width - 4 : at + width] = row[-4:] / length
        said |= model.dof_jntid == j
    return q, said


def _labels(part: Wanted, counts: dict[str, int]) -> tuple[str, ...]:
    """Labels of an item's goals, with a number behind those that `counts` has already."""
    labels = [goal.label for goal in part.goals(0.0)] or [part.item.name or f"lock {part.item.at}"]
    out = []
    for label in labels:
        counts[label] = counts.get(label, 0) + 1
        out.append(label if counts[label] == 1 else f"{label} ({counts[label]})")
    return tuple(out)
