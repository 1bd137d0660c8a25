"""Goals of a scene: curves of where frames go, baked to curves of joints or followed live.

A goal is baked when all that it depends on is known before the run: keys, and joints that goals move. It is
live when it hangs on what physics moves, or when the scene asks for it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from .. import rotations
from ..clip import Clip
from ..curves import Curve, keyed
from ..errors import PantographError
from ..ik import Goal, LookAt, Orientation, Pose, Position, follow
from ..ik.pose import Kinematics
from ..kinds import FREE, SLIDE
from ..rotation_curves import keyed_rotation
from .mistakes import Mistake
from .motion import Curves
from .names import Names
from .schema import GoalItem, Scene

Array = NDArray[np.float64]
_RATE = 60.0  # [1/s] instants at which goals are met exactly; splines between them
_MET = 1e-6  # [m or rad]
_DEFAULTS = {"velocity": (1.0, np.pi), "acceleration": (10.0, 6 * np.pi)}  # of live goals: slides, turns


class Wanted(NamedTuple):
    """Curves of one item and the goals that they give."""

    item: GoalItem
    position: Curve | None
    rotation: Curve | None
    look_at: Curve | None

    def goals(self, t: float) -> list[Goal]:
        """Goals at time t [s]."""
        item, out = self.item, list[Goal]()
        base, weight = item.relative_to, item.weight
        p = None if self.position is None else self.position(t).q
        quat = None if self.rotation is None else self.rotation(t).q
        if p is not None and quat is not None:
            out.append(Pose(item.at, p, quat, base, weight=weight))
        elif p is not None:
            out.append(Position(item.at, p, base, weight=weight))
        elif quat is not None:
            out.append(Orientation(item.at, quat, base, weight=weight))
        if self.look_at is not None:
            out.append(LookAt(item.at, self.look_at(t).q, item.axis, base, weight=weight))
        return out


def wanted(scene: Scene, item: GoalItem) -> Wanted:
    """The curves of one item. Raises PantographError for rows that make none."""
    ends = {"kind": item.curve, "ease": item.ease, "before": item.before, "after": item.after}
    position = None if item.position is None else keyed(item.times, item.position, **ends)  # type: ignore[arg-type]
    look_at = None if item.look_at is None else keyed(item.times, item.look_at, **ends)  # type: ignore[arg-type]
    rotation = None
    if item.rotation is not None:
        rows = np.array([np.atleast_1d(row) for row in item.rotation], dtype=float)
        if rows.shape[1] == 3:
            rows = rotations.from_euler("xyz", np.deg2rad(rows) if scene.angle == "degree" else rows)
        rotation = keyed_rotation(item.times, rows, **ends)  # type: ignore[arg-type]
    return Wanted(item, position, rotation, look_at)


def together(parts: Sequence[Wanted]) -> Callable[[float], list[Goal]]:
    """All goals of several items over time."""
    return lambda t: [goal for part in parts for goal in part.goals(t)]


@dataclass(frozen=True)
class Goals:
    """The goals of a scene and who moves for them: items and joint ids, baked and live.

    ``choices``: for every item what it is, how it is solved, and why. ``velocity``, ``acceleration`` (nv,):
    limits of the freedoms that move, infinite without one.
    """

    baked: tuple[Wanted, ...] = ()
    live: tuple[Wanted, ...] = ()
    baked_joints: tuple[int, ...] = ()
    live_joints: tuple[int, ...] = ()
    choices: tuple[tuple[str, str, str], ...] = ()
    velocity: Array = field(default_factory=lambda: np.zeros(0))
    acceleration: Array = field(default_factory=lambda: np.zeros(0))


class _Part(NamedTuple):
    """One item with its joints: `ours` move for it, `others` move its frames beside them."""

    place: int
    wanted: Wanted
    ours: frozenset[int]
    others: frozenset[int]


def assign(scene: Scene, model: mujoco.MjModel, found: Curves) -> tuple[Goals, list[Mistake]]:
    """Who moves for which goal, and which are known before the run: those are baked, the others live."""
    parts, mistakes = list[_Part](), list[Mistake]()
    for i, item in enumerate(scene.goals):
        try:
            parts.append(_part(scene, model, found, i, item, mistakes))
        except PantographError as e:
            mistakes.append(Mistake(("goals", i, "at"), str(e)))
    if mistakes:
        return Goals(), mistakes
    reasons = _live(model, parts)
    for part in parts:
        if part.wanted.item.solve == "baked" and part.place in reasons:
            message = f'this goal cannot be baked: {reasons[part.place]}; solve = "live" follows as it runs'
            mistakes.append(Mistake(("goals", part.place, "solve"), message))
    live = [part for part in parts if part.place in reasons]
    baked = [part for part in parts if part.place not in reasons]
    choices = tuple(
        (
            ", ".join(goal.label for goal in part.wanted.goals(0.0)),
            "live" if part.place in reasons else "baked",
            reasons.get(part.place, "all it depends on is known before the run: smooth over the whole of it"),
        )
        for part in parts
    )
    goals = Goals(
        baked=tuple(part.wanted for part in baked),
        live=tuple(part.wanted for part in live),
        baked_joints=_joints(baked),
        live_joints=_joints(live),
        choices=choices,
        velocity=_limits(scene, model, parts, reasons, "velocity"),
        acceleration=_limits(scene, model, parts, reasons, "acceleration"),
    )
    return goals, mistakes


def _joints(parts: Sequence[_Part]) -> tuple[int, ...]:
    return tuple(sorted(frozenset[int]().union(*(part.ours for part in parts))))


def _part(
    scene: Scene, model: mujoco.MjModel, found: Curves, i: int, item: GoalItem, mistakes: list[Mistake]
) -> _Part:
    kinematics, names = Kinematics(model), Names(model, "joint")
    at = {int(j) for j in model.dof_jntid[kinematics.frame(item.at).dofs]}
    base = set[int]()
    if item.relative_to is not None:
        base = {int(j) for j in model.dof_jntid[kinematics.frame(item.relative_to).dofs]}
    passive = {j for pattern in scene.roles.passive for j in names.match(pattern)}
    allowed = at - base - passive
    if item.solve == "live":
        allowed -= set(np.flatnonzero(model.jnt_type == FREE).tolist())
    named = set[int]()
    for k, pattern in enumerate(item.joints):
        ids = names.match(pattern)
        if not ids:
            mistakes.append(Mistake(("goals", i, "joints", k), names.missing(pattern)))
        named |= set(ids)
    if item.joints:
        allowed &= named
    ours = allowed - set(found.tracks)
    if not ours:
        mistakes.append(Mistake(("goals", i, "at"), f"no joint without keys moves {item.at!r}"))
    moving = (at ^ base) if item.relative_to is not None else at
    return _Part(i, wanted(scene, item), frozenset(ours), frozenset(moving - ours - set(found.tracks)))


def _live(model: mujoco.MjModel, parts: Sequence[_Part]) -> dict[int, str]:
    """Which items must be solved live, by their place, and why."""
    ours = frozenset[int]().union(*(part.ours for part in parts))
    reasons = {p.place: "the scene asks for it" for p in parts if p.wanted.item.solve == "live"}
    for part in parts:
        if part.place not in reasons and (loose := part.others - ours):
            names = ", ".join(name_of(model, "joint", j) for j in sorted(loose)[:3])
            reasons[part.place] = f"where it is depends on {names}, which physics moves"
    while True:
        moved = frozenset[int]().union(*(p.ours for p in parts if p.place in reasons))
        more = [p for p in parts if p.place not in reasons and (p.ours | p.others) & moved]
        if not more:
            return reasons
        shared = name_of(model, "joint", min((more[0].ours | more[0].others) & moved))
        reasons[more[0].place] = f"joint {shared} moves for a live goal"


def _limits(
    scene: Scene, model: mujoco.MjModel, parts: Sequence[_Part], reasons: Mapping[int, str], word: str
) -> Array:
    """Limits (nv,) of velocity or acceleration of the freedoms that move for goals."""
    out = np.full(model.nv, np.inf)
    angle = np.pi / 180.0 if scene.angle == "degree" else 1.0
    for part in parts:
        given = getattr(part.wanted.item, word)
        for j in part.ours:
            slide = int(model.jnt_type[j]) == SLIDE
            if given is not None:
                most = given * (1.0 if slide else angle)
            elif part.place in reasons:
                most = _DEFAULTS[word][0 if slide else 1]
            else:
                continue
            mask = model.dof_jntid == j
            out[mask] = np.minimum(out[mask], most)
    return out


def bake(scene: Scene, model: mujoco.MjModel, found: Curves, q0: Array, goals: Goals) -> list[Mistake]:
    """Add curves of the joints that the baked goals move to `found`; keyed joints stay as keyed."""
    if not goals.baked:
        return []
    count = max(3, round(scene.duration * _RATE) + 1)
    t = np.linspace(0.0, scene.duration, count)
    tracks = {name_of(model, "joint", j): track for j, track in found.tracks.items()}
    names = [name_of(model, "joint", j) for j in goals.baked_joints]
    try:
        around = Clip(model, tracks, q0).evaluate(t).q
        motion = follow(
            model, together(goals.baked), t, joints=names, around=around,
            velocity=goals.velocity, acceleration=goals.acceleration,
        )  # fmt: skip
    except PantographError as e:
        return [Mistake(("goals",), str(e))]
    curves = motion.clip().tracks
    found.tracks.update({j: curves[name] for name, j in zip(names, goals.baked_joints, strict=True)})
    return []


def deviations(scene: Scene, model: mujoco.MjModel, t: Array, q: Array) -> dict[str, Array]:
    """How far a motion q (n, nq) at times t (n,) is from the scene's goals: by goal, (n, 2) [m], [rad]."""
    kinematics, goals = Kinematics(model), together([wanted(scene, item) for item in scene.goals])
    out: dict[str, list[tuple[float, float]]] = {}
    for x, row in zip(t, q, strict=True):
        c = kinematics.at(row[None])
        for goal in goals(float(x)):
            position, rotation = goal.errors(goal.rows(c).r, model)
            out.setdefault(goal.label, []).append((float(position[0]), float(rotation[0])))
    return {label: np.array(rows) for label, rows in out.items()}


def sentences(missed: Mapping[str, Array], t: Array) -> list[str]:
    """A sentence for every goal of `deviations`: how far the motion is from it at most, and when."""
    out = []
    for label, rows in missed.items():
        k = int(np.argmax(rows.sum(axis=1)))
        if rows[k].max() <= _MET:
            out.append(f"goal {label!r} is met")
        else:
            usual = _sizes(np.median(rows, axis=0)) or f"less than {_MET:g}"
            out.append(
                f"goal {label!r} is missed by {_sizes(rows[k])} at t = {t[k]:.3g} s, "
                f"half of the time by {usual} at most"
            )
    return out


def _sizes(row: Array) -> str:
    return " and ".join(f"{x:.3g} {unit}" for x, unit in zip(row, ("m", "rad"), strict=True) if x > _MET)
