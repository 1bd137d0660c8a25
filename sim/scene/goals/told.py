"""How far a motion is from the goals of its scene, in numbers and in words."""

from __future__ import annotations

from collections.abc import Mapping

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...ik.pose import Kinematics
from ..schema import Scene
from .wanted import Wanted, wanted

Array = NDArray[np.float64]
_MET = 1e-6  # [m or rad]
_STILL = 1e-4  # [m] of locked feet


def deviations(scene: Scene, model: mujoco.MjModel, t: Array, q: Array) -> dict[str, Array]:
    """How far a motion q (n, nq) at times t (n,) is from the scene's goals: by goal, (n, 2) [m], [rad].

    Of a locked foot: how far it is from where it is in the middle of its stance, zero between stances.
    """
    kinematics, parts = Kinematics(model), wanted(scene, model)[0]
    out = {label: np.zeros((len(t), 2)) for part in parts for label in part.labels}
    for part in parts:
        if part.item.kind == "lock":
            out[part.labels[0]][:, 0] = _slid(part, kinematics, t, q)
    for k, (x, row) in enumerate(zip(t, q, strict=True)):
        c = kinematics.at(row[None])
        for part in parts:
            for goal in part.goals(float(x)):
                metres, radians = goal.errors(goal.rows(c).r, model)
                out[goal.name][k] = metres[0], radians[0]
    return out


def _slid(part: Wanted, kinematics: Kinematics, t: Array, q: Array) -> Array:
    """How far a locked frame is from its places at times t (n,)."""
    assert part.item.at is not None
    out, frame = np.zeros(len(t)), kinematics.frame(part.item.at)
    for start, end in part.item.stances or ():
        on = np.flatnonzero((t >= start - 1e-9) & (t <= end + 1e-9))
        if len(on):
            p = frame.pose(q[on])[:, :3, 3]
            out[on] = np.linalg.norm(p - p[int(np.argmin(np.abs(t[on] - 0.5 * (start + end))))], axis=1)
    return out


def sentences(scene: Scene, model: mujoco.MjModel, missed: Mapping[str, Array], t: Array) -> list[str]:
    """A sentence for every goal of `deviations`: how far the motion is from it at most, and when; of a goal
    that is blended with keys, where it rules alone."""
    out = []
    for part in wanted(scene, model)[0]:
        ruled = part.share(t) >= 1.0
        bars = _bars(part)
        for label, bar in zip(part.labels, bars, strict=True):
            rows = missed[label] * ruled[:, None]
            k = int(np.argmax(rows.sum(axis=1)))
            if not ruled.any():
                out.append(f"goal {label!r} is never blended in as a whole")
            elif (rows <= bar).all():
                out.append(f"goal {label!r} is met")
            else:
                usual = _sizes(np.median(rows[ruled], axis=0)) or f"less than {_MET:g}"
                out.append(
                    f"goal {label!r} is missed by {_sizes(rows[k])} at t = {t[k]:.3g} s, "
                    f"half of the time by {usual} at most"
                )
    return out


def _bars(part: Wanted) -> list[Array]:
    """Size [m], [rad] up to which every goal of an item counts as met."""
    if part.item.kind == "lock":
        return [np.array([_STILL, 0.0])]
    out = []
    for goal in part.goals(0.0):
        tolerance, units = goal.tolerances(part.model), np.array(goal.units(part.model))
        kept = np.isfinite(tolerance)
        sizes = [np.linalg.norm(tolerance[kept & (units == unit)]) for unit in ("m", "rad")]
        out.append(np.maximum(sizes, _MET))
    return out


def _sizes(row: Array) -> str:
    return " and ".join(f"{x:.3g} {unit}" for x, unit in zip(row, ("m", "rad"), strict=True) if x > _MET)
