"""Goals that are known before the run as curves of joints."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from ....models import name_of
from ...clip import Clip
from ...errors import PantographError
from ...ik import blend, follow, lock
from ...ik.spline import smooth_clip
from ..mistakes import Mistake
from ..motion import Curves
from ..schema import Scene
from .assign import Goals, Part, joints_of
from .wanted import together

Array = NDArray[np.float64]
_RATE = 60.0  # [1/s] instants at which goals are met exactly; splines between them


def bake(scene: Scene, model: mujoco.MjModel, found: Curves, q0: Array, goals: Goals) -> list[Mistake]:
    """Add curves of the joints that the baked goals move to `found`; keyed joints stay as keyed, but for
    those that goals with a blend and locked feet move."""
    t = np.linspace(0.0, scene.duration, max(3, round(scene.duration * _RATE) + 1))
    locks = [part for part in goals.baked if part.wanted.item.kind == "lock"]
    others = [part for part in goals.baked if part.wanted.item.kind != "lock"]
    try:
        if others:
            _follow(model, found, q0, goals, others, t)
    except PantographError as e:
        return [Mistake(("goals",), str(e))]
    return _lock(model, found, q0, locks, t) if locks else []


def _around(model: mujoco.MjModel, found: Curves, q0: Array) -> Clip:
    """What the curves say so far."""
    return Clip(model, {name_of(model, "joint", j): track for j, track in found.tracks.items()}, q0)


def _follow(
    model: mujoco.MjModel, found: Curves, q0: Array, goals: Goals, parts: Sequence[Part], t: Array
) -> None:
    joints = joints_of(parts)
    names = [name_of(model, "joint", j) for j in joints]
    around = _around(model, found, q0).evaluate(t).q
    motion = follow(
        model, together([part.wanted for part in parts]), t, joints=names, around=around,
        velocity=goals.velocity, acceleration=goals.acceleration,
    )  # fmt: skip
    curves = motion.clip().tracks
    held = smooth_clip(model, t, motion.q, joints).tracks  # of joints that stand still
    found.tracks.update({j: curves.get(n, held[n]) for n, j in zip(names, joints, strict=True)})
    for part in parts:
        if part.wanted.item.blend is not None:
            own = sorted(part.ours)
            share = part.wanted.share(t)
            q = blend(model, around, motion.q, share, joints=[name_of(model, "joint", j) for j in own])
            tracks = smooth_clip(model, t, q, own).tracks
            found.tracks.update({j: tracks[name_of(model, "joint", j)] for j in own})


def _lock(model: mujoco.MjModel, found: Curves, q0: Array, locks: Sequence[Part], t: Array) -> list[Mistake]:
    stances: dict[str, list[tuple[float, float]]] = {}
    for part in locks:
        assert part.wanted.item.at is not None
        stances.setdefault(part.wanted.item.at, []).extend(part.wanted.item.stances or [])
    joints = joints_of(locks)
    names = [name_of(model, "joint", j) for j in joints]
    place = ("goals", locks[0].place, "stances")
    try:
        q = _around(model, found, q0).evaluate(t).q
        locked = lock(model, t, q, stances, ease=locks[0].wanted.item.lead, joints=names)
    except PantographError as e:
        return [Mistake(place, str(e))]
    tracks = smooth_clip(model, locked.t, locked.q, joints).tracks
    found.tracks.update({j: tracks[name] for j, name in zip(joints, names, strict=True)})
    return []
