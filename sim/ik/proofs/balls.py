"""What the vectors fixed in the links prove of centres of mass, mirror images and sights.

A point that hangs on turning joints is at a constant plus one vector of constant length for every link
between:
it stays in a ball, and a centre of mass as well, whose vectors are those of all bodies of a link weighted by
their masses. About parallel axes the height along them stays, and so does the angle of a direction to them.
"""

from __future__ import annotations

from collections import defaultdict
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...kinds import FREE, HINGE, SLIDE
from ...kinematics import Frame
from ..goals import LookAt
from ..mirror import Mirror
from ..problem import Problem
from ..wholes import CenterOfMass
from .reach import at_point, hops_of, path, reach

Array = NDArray[np.float64]


class Ball(NamedTuple):
    """Where a point can be: between `low` and `high` [m] from `center` (3,)."""

    center: Array
    low: float
    high: float

    def gap(self, p: Array) -> float:
        """Least distance of p (3,) from what can be reached [m]."""
        far = float(np.linalg.norm(p - self.center))
        return max(0.0, self.low - far, far - self.high)


def ball_of(problem: Problem, parts: list[tuple[float, Frame]], q: Array) -> Ball | None:
    """Where the mean of frames' origins with weights of sum one is; None where a body floats freely."""
    links: dict[int, Array] = defaultdict(lambda: np.zeros(3))
    center, play = np.zeros(3), 0.0
    for weight, f in parts:
        found = hops_of(f, f.joints, problem.space, problem.moved, q)
        if found is None:
            return None
        first, rest, _ = found
        turning = [j.v for j in f.joints if problem.moved[j.v] and int(j.type) not in (SLIDE, FREE)]
        center += weight * first.vector
        for v, hop in zip(turning, rest, strict=True):
            links[v] += weight * hop.vector
        play += weight * sum(max(abs(t.low), abs(t.high)) for hop in (first, *rest) for t in hop.travels)
    if not np.isfinite(play):
        return None
    lengths = [float(np.linalg.norm(x)) for x in links.values()]
    total, longest = sum(lengths), max(lengths, default=0.0)
    return Ball(center, max(0.0, 2 * longest - total - play), total + play)


def mass_gap(problem: Problem, goal: CenterOfMass, q: Array) -> float:
    """How far the centre of mass stays from its target [m], free axes left out."""
    masses = problem.kinematics.masses()
    whole = sum(mass for mass, _ in masses)
    ball = ball_of(problem, [(mass / whole, f) for mass, f in masses], q)
    if ball is None:
        return 0.0
    kept, target = np.isfinite(goal.tolerances(problem.model)), np.asarray(goal.target)
    if kept.all():
        return ball.gap(target)
    return max(0.0, float(np.linalg.norm((target - ball.center)[kept])) - ball.high)


def mirror_gap(problem: Problem, goal: Mirror, q: Array) -> float:
    """How far a point stays from the mirror image of the other [m]."""
    if goal.what == "orientation":
        return 0.0
    frames = _seen(problem, goal)
    if frames is None:
        return 0.0
    one, other = (ball_of(problem, [(1.0, f)], q) for f in frames)
    if one is None or other is None:
        return 0.0
    n, point = np.asarray(goal.normal), np.asarray(goal.point)
    image = other.center - 2 * float((other.center - point) @ n) * n
    far = float(np.linalg.norm(one.center - image))
    return max(0.0, far - one.high - other.high, one.low - far - other.high, other.low - far - one.high)


def _seen(problem: Problem, goal: Mirror) -> list[Frame] | None:
    """The two frames of a mirror in the plane's frame; None where joints between that and theirs move it."""
    frames = [problem.kinematics.frame(text) for text in (goal.at, goal.of)]
    if goal.relative_to is None:
        return frames
    base = problem.kinematics.frame(goal.relative_to)
    shared = len(base.joints)
    if any([j.q for j in f.joints[:shared]] != [j.q for j in base.joints] for f in frames):
        return None
    back = np.linalg.inv(base.X_end)
    out = []
    for f in frames:
        rest = f.joints[shared:]
        if rest:
            rest = (rest[0]._replace(X=back @ rest[0].X), *rest[1:])
            out.append(replace(f, joints=rest))
        else:
            out.append(replace(f, joints=(), X_end=back @ f.X_end))
    return out


def sight_gap(problem: Problem, goal: LookAt, q: Array) -> float:
    """Angle that a direction stays away from its sight when all its joints turn about parallel axes [rad]."""
    f = problem.kinematics.frame(goal.at)
    if goal.relative_to is not None:
        return 0.0
    joints = [j for j in f.joints if problem.moved[j.v]]
    if not joints or any(int(j.type) != HINGE for j in joints):
        return 0.0
    J, X = f.jacobian(q), f.pose(q)
    sight = np.asarray(goal.target) - X[:3, 3]
    axes = np.array([J[:3, j.v] for j in joints])
    n = axes[0] / np.linalg.norm(axes[0])
    if np.linalg.norm(np.cross(axes, n), axis=1).max() > 1e-9:
        return 0.0
    target = at_point(np.asarray(goal.target), problem.space.nq, problem.space.nv)
    hops = path(target, f, problem.space, problem.moved, q)
    if hops is None:
        return 0.0
    bounds, height = reach(hops), float(sight @ n)
    near, far = max(bounds.low, abs(height), 1e-12), max(bounds.high, abs(height), 1e-12)
    angles = np.arccos(np.clip([height / near, height / far], -1.0, 1.0))
    own = float(np.arccos(np.clip((X[:3, :3] @ np.asarray(goal.axis)) @ n, -1.0, 1.0)))
    gap = max(0.0, float(angles.min()) - own, own - float(angles.max()))
    return gap if gap > 1e-7 else 0.0
