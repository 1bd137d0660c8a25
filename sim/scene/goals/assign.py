"""Which joints move for which goals of a scene, and whether that is known before the run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ....models import name_of
from ...ik.pose import Kinematics
from ...kinds import FREE, SLIDE
from ..mistakes import Mistake
from ..motion import Curves
from ..names import Names
from ..schema import Scene
from .wanted import Wanted, wanted

Array = NDArray[np.float64]
_DEFAULTS = {"velocity": (1.0, np.pi), "acceleration": (10.0, 6 * np.pi)}  # of live goals: slides, turns


class Part(NamedTuple):
    """One item with its joints: `ours` move for it, `others` move what it looks at beside them.

    `place`: of the item in the scene.
    """

    place: int
    wanted: Wanted
    ours: frozenset[int]
    others: frozenset[int]


@dataclass(frozen=True)
class Goals:
    """The goals of a scene and who moves for them: items and joint ids, baked and live.

    ``choices``: for every item what it is, how it is solved, and why. ``velocity``, ``acceleration`` (nv,):
    limits of the freedoms that move, infinite without one. ``apart``: pairs of geoms that live joints keep
    ``clearance`` [m] apart.
    """

    baked: tuple[Part, ...] = ()
    live: tuple[Wanted, ...] = ()
    live_joints: tuple[int, ...] = ()
    choices: tuple[tuple[str, str, str], ...] = ()
    velocity: Array = field(default_factory=lambda: np.zeros(0))
    acceleration: Array = field(default_factory=lambda: np.zeros(0))
    apart: tuple[tuple[str, str], ...] = ()
    clearance: float = 0.0


def assign(scene: Scene, model: mujoco.MjModel, found: Curves) -> tuple[Goals, list[Mistake]]:
    """Who moves for which goal, and which are known before the run: those are baked, the others live."""
    every, mistakes = wanted(scene, model)
    if mistakes:
        return Goals(), mistakes
    kinematics, keyed = Kinematics(model), frozenset(found.tracks)
    parts = [_part(scene, kinematics, keyed, i, w) for i, w in enumerate(every)]
    for part in parts:
        if not part.ours:
            at = part.wanted.item.at
            message = f"no joint without keys moves {'for it' if at is None else repr(at)}"
            mistakes.append(Mistake(("goals", part.place, *(() if at is None else ("at",))), message))
    reasons = _live(model, parts)
    mistakes += _must_be_baked(parts, reasons) + _blended(model, parts) + _kept_apart(parts, reasons)
    live = [part for part in parts if part.place in reasons]
    choices = tuple(
        (
            ", ".join(part.wanted.labels),
            "live" if part.place in reasons else "baked",
            reasons.get(part.place, "all it depends on is known before the run: smooth over the whole of it"),
        )
        for part in parts
    )
    goals = Goals(
        baked=tuple(part for part in parts if part.place not in reasons),
        live=tuple(part.wanted for part in live),
        live_joints=joints_of(live),
        choices=choices,
        velocity=_limits(model, parts, reasons, "velocity"),
        acceleration=_limits(model, parts, reasons, "acceleration"),
        apart=tuple(dict.fromkeys(pair for part in live for pair in part.wanted.item.apart)),
        clearance=max((p.wanted.item.clearance for p in live if p.wanted.item.apart), default=0.0),
    )
    return goals, mistakes


def joints_of(parts: Sequence[Part]) -> tuple[int, ...]:
    """Ids of the joints that move for some of `parts`."""
    return tuple(sorted(frozenset[int]().union(*(part.ours for part in parts))))


def _part(scene: Scene, kinematics: Kinematics, keyed: frozenset[int], i: int, w: Wanted) -> Part:
    item, model, names = w.item, kinematics.model, Names(kinematics.model, "joint")
    free = frozenset(np.flatnonzero(model.jnt_type == FREE).tolist())
    passive = {j for pattern in scene.roles.passive for j in names.match(pattern)}
    moving, allowed = _moving(w, kinematics)
    allowed -= passive
    if item.solve == "live" or item.kind == "lock":
        allowed -= free
    if w.joints:
        allowed &= frozenset(w.joints)
    ours = allowed if item.kind == "lock" or item.blend is not None else allowed - keyed
    return Part(i, w, ours, moving - ours - keyed)


def _moving(w: Wanted, kinematics: Kinematics) -> tuple[frozenset[int], frozenset[int]]:
    """Joints that what an item looks at hangs on, and those of them that can move for it.

    Frames that something is measured from stay where they are for it: `relative_to`, `of`, and `to`. What
    moves all frames alike changes nothing, except in the world.
    """
    item = w.item

    def of(text: str) -> frozenset[int]:
        return frozenset(int(j) for j in kinematics.model.dof_jntid[kinematics.frame(text).dofs])

    if item.kind == "lock":
        assert item.at is not None
        return of(item.at), of(item.at)
    if item.at is None:
        masks = [goal.moved(kinematics) for goal in w.goals(0.0)]
        every = frozenset(int(j) for j in kinematics.model.dof_jntid[np.any(masks, axis=0)])
        if item.kind in ("posture", "spread"):
            every = frozenset(w.joints)
        return every, every
    bases = [of(text) for text in (item.relative_to, item.of, item.to) if isinstance(text, str)]
    mine = of(item.at)
    every = mine.union(*bases)
    if item.relative_to is not None or isinstance(item.to, str):
        every -= mine.intersection(*bases)
    return every, mine.difference(*bases)


def _live(model: mujoco.MjModel, parts: Sequence[Part]) -> dict[int, str]:
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


def _must_be_baked(parts: Sequence[Part], reasons: Mapping[int, str]) -> list[Mistake]:
    """Mistakes of items that must be known before the run and are not."""
    out = []
    for part in parts:
        item, why = part.wanted.item, reasons.get(part.place)
        if why is None:
            continue
        if item.kind == "lock":
            message = f"feet are locked before the run, but here {why}"
            out.append(Mistake(("goals", part.place, "kind"), message))
        elif item.blend is not None:
            message = f"goals are blended with keys before the run, but here {why}"
            out.append(Mistake(("goals", part.place, "blend"), message))
        elif item.solve == "baked":
            message = f'this goal cannot be baked: {why}; solve = "live" follows as it runs'
            out.append(Mistake(("goals", part.place, "solve"), message))
    return out


def _kept_apart(parts: Sequence[Part], reasons: Mapping[int, str]) -> list[Mistake]:
    """Mistakes of items that keep geoms apart but are baked, and of different clearances."""
    out, keeping = list[Mistake](), [part for part in parts if part.wanted.item.apart]
    sizes = sorted({part.wanted.item.clearance for part in keeping})
    for part in keeping:
        if part.place not in reasons:
            message = 'this goal is baked, which keeps no geoms apart: give it solve = "live"'
            out.append(Mistake(("goals", part.place, "apart"), message))
        elif len(sizes) > 1:
            listing = ", ".join(f"{x:g}" for x in sizes)
            message = f"all live goals are followed at once: give them one clearance, not {listing} m"
            out.append(Mistake(("goals", part.place, "clearance"), message))
    return out


def _blended(model: mujoco.MjModel, parts: Sequence[Part]) -> list[Mistake]:
    """Mistakes of joints that move for goals with different blends, and of locks with different leads."""
    out, owners = list[Mistake](), dict[int, Part]()
    leads = {part.wanted.item.lead for part in parts if part.wanted.item.kind == "lock"}
    for part in parts:
        if part.wanted.item.kind == "lock":
            if len(leads) > 1:
                listing = ", ".join(f"{x:g}" for x in sorted(leads))
                message = f"all feet are locked at once: give all locks one lead, not {listing} s"
                out.append(Mistake(("goals", part.place, "lead"), message))
            continue
        for j in sorted(part.ours):
            first = owners.setdefault(j, part)
            one, other = first.wanted.item, part.wanted.item
            if one.blend != other.blend or (one.blend and one.times != other.times):
                name = name_of(model, "joint", j)
                message = f"joint {name!r} moves for goals[{first.place}] too: give both the same blend"
                out.append(Mistake(("goals", part.place, "blend"), message))
                break
    return out


def _limits(model: mujoco.MjModel, parts: Sequence[Part], reasons: Mapping[int, str], word: str) -> Array:
    """Limits (nv,) of velocity or acceleration of the freedoms that move for goals."""
    out = np.full(model.nv, np.inf)
    for part in parts:
        given = getattr(part.wanted.item, word)
        for j in part.ours:
            slide = int(model.jnt_type[j]) == SLIDE
            if given is not None:
                most = given * (1.0 if slide else part.wanted.angle)
            elif part.place in reasons:
                most = _DEFAULTS[word][0 if slide else 1]
            else:
                continue
            mask = model.dof_jntid == j
            out[mask] = np.minimum(out[mask], most)
    return out
