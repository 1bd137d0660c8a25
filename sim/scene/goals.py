"""Goals of a scene: curves of where frames go, baked to curves of joints by inverse kinematics."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from .. import rotations
from ..clip import Clip
from ..curves import Curve, keyed
from ..errors import PantographError
from ..ik import Goal, LookAt, Motion, Orientation, Pose, Position, follow
from ..ik.pose import Kinematics
from ..rotation_curves import keyed_rotation
from .mistakes import Mistake
from .motion import Curves
from .names import Names
from .schema import GoalItem, Scene

Array = NDArray[np.float64]
_RATE = 60.0  # [1/s] instants at which goals are met exactly; splines between them


class _Wanted(NamedTuple):
    """Curves of one item and what its goals are called."""

    item: GoalItem
    position: Curve | None
    rotation: Curve | None
    look_at: Curve | None

    def goals(self, t: float) -> list[Goal]:
        """Goals at time t [s]."""
        item, out = self.item, list[Goal]()
        p = None if self.position is None else self.position(t).q
        quat = None if self.rotation is None else self.rotation(t).q
        if p is not None and quat is not None:
            out.append(Pose(item.at, p, quat, weight=item.weight))
        elif p is not None:
            out.append(Position(item.at, p, weight=item.weight))
        elif quat is not None:
            out.append(Orientation(item.at, quat, weight=item.weight))
        if self.look_at is not None:
            out.append(LookAt(item.at, self.look_at(t).q, axis=item.axis, weight=item.weight))
        return out


def _wanted(scene: Scene, item: GoalItem) -> _Wanted:
    ends = {"kind": item.curve, "ease": item.ease, "before": item.before, "after": item.after}
    position = None if item.position is None else keyed(item.times, item.position, **ends)  # type: ignore[arg-type]
    look_at = None if item.look_at is None else keyed(item.times, item.look_at, **ends)  # type: ignore[arg-type]
    rotation = None
    if item.rotation is not None:
        rows = np.array([np.atleast_1d(row) for row in item.rotation], dtype=float)
        if rows.shape[1] == 3:
            rows = rotations.from_euler("xyz", np.deg2rad(rows) if scene.angle == "degree" else rows)
        rotation = keyed_rotation(item.times, rows, **ends)  # type: ignore[arg-type]
    return _Wanted(item, position, rotation, look_at)


def _all(scene: Scene) -> Callable[[float], list[Goal]]:
    wanted = [_wanted(scene, item) for item in scene.goals]
    return lambda t: [goal for w in wanted for goal in w.goals(t)]


def bake(scene: Scene, model: mujoco.MjModel, found: Curves, q0: Array) -> list[Mistake]:
    """Add curves of the joints that the scene's goals move to `found`; keyed joints stay as keyed."""
    mistakes, free = _joints(scene, model, found)
    if mistakes:
        return mistakes
    try:
        motion = _solve(scene, model, found, q0, free)
    except PantographError as e:
        return [Mistake(("goals",), str(e))]
    ids = {name_of(model, "joint", j): j for j in free}
    for name, track in motion.clip().tracks.items():
        if name in ids:
            found.tracks[ids[name]] = track
    return []


def _joints(scene: Scene, model: mujoco.MjModel, found: Curves) -> tuple[list[Mistake], list[int]]:
    """Joints that goals may move: named ones, or all that move a goal's frame; never those with keys."""
    mistakes, kinematics, names = [], Kinematics(model), Names(model, "joint")
    free: dict[int, None] = {}
    for i, item in enumerate(scene.goals):
        try:
            _wanted(scene, item)
            moves = {int(j) for j in model.dof_jntid[kinematics.frame(item.at).dofs]}
        except PantographError as e:
            mistakes.append(Mistake(("goals", i, "at"), str(e)))
            continue
        allowed = moves
        for k, pattern in enumerate(item.joints):
            ids = names.match(pattern)
            if not ids:
                mistakes.append(Mistake(("goals", i, "joints", k), names.missing(pattern)))
            allowed = set(ids) if k == 0 else allowed | set(ids)
        ours = sorted((allowed & moves) - set(found.tracks))
        if not ours:
            mistakes.append(Mistake(("goals", i, "at"), f"no joint without keys moves {item.at!r}"))
        free.update(dict.fromkeys(ours))
    return mistakes, list(free)


def _solve(scene: Scene, model: mujoco.MjModel, found: Curves, q0: Array, free: list[int]) -> Motion:
    count = max(3, round(scene.duration * _RATE) + 1)
    t = np.linspace(0.0, scene.duration, count)
    tracks = {name_of(model, "joint", j): track for j, track in found.tracks.items()}
    around = Clip(model, tracks, q0).evaluate(t).q
    joints = [name_of(model, "joint", j) for j in free]
    return follow(model, _all(scene), t, joints=joints, around=around)


def deviations(scene: Scene, model: mujoco.MjModel, t: Array, q: Array) -> dict[str, Array]:
    """How far a motion q (n, nq) at times t (n,) is from the scene's goals: by goal, (n, 2) [m], [rad]."""
    kinematics, wanted = Kinematics(model), _all(scene)
    out: dict[str, list[tuple[float, float]]] = {}
    for x, row in zip(t, q, strict=True):
        c = kinematics.at(row[None])
        for goal in wanted(float(x)):
            position, rotation = goal.errors(goal.rows(c).r)
            out.setdefault(goal.label, []).append((float(position[0]), float(rotation[0])))
    return {label: np.array(rows) for label, rows in out.items()}


def sentences(missed: Mapping[str, Array], t: Array) -> list[str]:
    """A sentence for every goal of `deviations`: how far the motion is from it at most, and when."""
    out = []
    for label, rows in missed.items():
        k = int(np.argmax(rows.sum(axis=1)))
        far = " and ".join(
            f"{x:.3g} {unit}" for x, unit in zip(rows[k], ("m", "rad"), strict=True) if x > 1e-6
        )
        out.append(
            f"goal {label!r} is missed by {far} at t = {t[k]:.3g} s" if far else f"goal {label!r} is met"
        )
    return out
