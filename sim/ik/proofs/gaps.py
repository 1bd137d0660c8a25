"""Proofs that goals cannot be met: distances that no joint changes, closed forms, subdivision."""

from __future__ import annotations

from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ... import rotations
from ...kinds import HINGE, SLIDE
from ...kinematics import Frame
from ..chains.closed_form import ClosedForm
from ..goals import Distance, Goal, LookAt, Orientation, PointOnLine, PointOnPlane, Pose, Position
from ..mirror import Mirror
from ..problem import Problem
from ..wholes import CenterOfMass, JointValue, scalar_joint
from .balls import mass_gap, mirror_gap, sight_gap
from .reach import at_point, offset, path, reach, turning_gap

Array = NDArray[np.float64]
Place = Position | Pose | PointOnLine | PointOnPlane
PLACES = (Position, Pose, PointOnLine, PointOnPlane)
_BOXES = 40_000
_PARALLEL = 1e-12  # sine of an angle
_ROUNDING = 1e-12  # [m]
_DEEP = 24


class Gap(NamedTuple):
    """Proved least violation of goals: metres and radians, with what proves it."""

    position: float
    rotation: float
    by: str


NO_GAP = Gap(0.0, 0.0, "")


def goal_gap(problem: Problem, goal: Goal, q: Array) -> Gap:
    """Least violation of one goal that the lengths of its chain and the problem's limits prove."""
    position = rotation = 0.0
    by, model = "", problem.model
    if isinstance(goal, (Position, Pose)):
        target = goal.target if isinstance(goal, Position) else goal.position
        position = _between(problem, _base(problem, goal.relative_to, np.asarray(target)), goal.at, q)
        by = "the reach of the chain"
    if isinstance(goal, (Orientation, Pose)):
        rotation = _turning(problem, goal, q)
        by = by if position > 0 or rotation == 0 else "the axes of the chain"
    if isinstance(goal, Distance):
        ends = problem.kinematics.frame(goal.at), _end(problem, goal.to)
        hops = path(*ends, problem.space, problem.moved, q)
        position, by = (0.0 if hops is None else reach(hops).gap(goal.distance)), "the reach of the chain"
    if isinstance(goal, (PointOnPlane, PointOnLine)):
        position, by = _surface_gap(problem, goal, q), "the reach of the chain"
    if isinstance(goal, CenterOfMass):
        position, by = mass_gap(problem, goal, q), "the lengths and masses of the links"
    if isinstance(goal, Mirror):
        position, by = mirror_gap(problem, goal, q), "the reach of both chains"
    if isinstance(goal, LookAt):
        rotation, by = sight_gap(problem, goal, q), "the axes of the chain"
    if isinstance(goal, JointValue):
        _, v = scalar_joint(model, goal.joint)
        beyond = max(0.0, problem.space.low[v] - goal.value, goal.value - problem.space.high[v])
        position, rotation = (beyond, 0.0) if goal.units(model) == ("m",) else (0.0, beyond)
        by = "the joint's range"
    return Gap(position, rotation, by) if position > 0 or rotation > 0 else NO_GAP


def _base(problem: Problem, relative_to: str | None, p: Array) -> Frame:
    if relative_to is None:
        return at_point(p, problem.space.nq, problem.space.nv)
    return offset(problem.kinematics.frame(relative_to), p)


def _end(problem: Problem, to: object) -> Frame:
    return problem.kinematics.frame(to) if isinstance(to, str) else _base(problem, None, np.asarray(to))


def _between(problem: Problem, base: Frame, at: str, q: Array) -> float:
    hops = path(base, problem.kinematics.frame(at), problem.space, problem.moved, q)
    return 0.0 if hops is None else reach(hops).low


def _turning(problem: Problem, goal: Orientation | Pose, q: Array) -> float:
    """Angle that a chain of parallel axes cannot make up."""
    f = problem.kinematics.frame(goal.at)
    base = None if goal.relative_to is None else problem.kinematics.frame(goal.relative_to)
    joints = list(f.joints) + ([] if base is None else list(base.joints))
    turning = [j for j in joints if problem.moved[j.v] and int(j.type) != SLIDE]
    if any(int(j.type) != HINGE for j in turning):
        return 0.0
    R = _rotation(f, q) if base is None else _rotation(base, q).T @ _rotation(f, q)
    axes = [
        _axis(g, j, q)
        for g in ([f] if base is None else [f, base])
        for j in g.joints
        if j.v in {t.v for t in turning}
    ]
    if any(np.linalg.norm(np.cross(a, axes[0])) > 1e-9 for a in axes):
        return 0.0
    axis = axes[0] if axes else None
    if base is not None and axis is not None:
        axis = _rotation(base, q).T @ axis
    gap = turning_gap(axis, False, R, np.asarray(goal.quat))
    return gap if gap > 1e-9 else 0.0


def _rotation(f: Frame, q: Array) -> Array:
    return np.asarray(f.pose(q)[:3, :3])


def _axis(f: Frame, joint: Any, q: Array) -> Array:
    """Direction of a hinge in the world at q; along parallel axes it is the same at every q."""
    J = f.jacobian(q)
    return np.asarray(J[:3, joint.v])


def _surface_gap(problem: Problem, goal: PointOnPlane | PointOnLine, q: Array) -> float:
    """Distance of plane or line from the ball around the first anchor that the chain stays within."""
    if goal.relative_to is not None:
        return 0.0
    f = problem.kinematics.frame(goal.at)
    base = at_point(np.asarray(goal.point), problem.space.nq, problem.space.nv)
    hops = path(base, f, problem.space, problem.moved, q)
    if hops is None or hops.hops[0].travels or not hops.turns:
        return 0.0
    first = hops.hops[0].vector  # from the goal's point to the first anchor, in the world
    if isinstance(goal, PointOnPlane):
        far = abs(float(first @ np.asarray(goal.normal)))
    else:
        along = np.asarray(goal.direction)
        far = float(np.linalg.norm(first - (first @ along) * along))
    radius = sum(h.lengths()[1] for h in hops.hops[1:])
    return max(0.0, far - radius)


def pair_gap(problem: Problem, a: Goal, b: Goal, q: Array) -> Gap:
    """Least sum of violations of two goals, where the chain between their frames proves one."""
    if isinstance(a, PLACES) and isinstance(b, PLACES) and a.relative_to == b.relative_to:
        frames = problem.kinematics.frame(a.at), problem.kinematics.frame(b.at)
        hops = path(frames[0], frames[1], problem.space, problem.moved, q)
        points = isinstance(a, (Position, Pose)) and isinstance(b, (Position, Pose))
        if hops is not None:
            bounds, apart = reach(hops), _apart(a, b)
            gap = bounds.gap(apart) if points else max(0.0, apart - bounds.high)
            if gap > _ROUNDING:
                return Gap(gap, 0.0, "the chain between their frames" if a.at != b.at else "one point")
    if (
        isinstance(a, (Orientation, Pose))
        and isinstance(b, (Orientation, Pose))
        and a.relative_to == b.relative_to
    ):
        return _turn_conflict(problem, a, b, q)
    if isinstance(a, JointValue) and isinstance(b, JointValue) and a.joint == b.joint and a.value != b.value:
        apart, slides = abs(a.value - b.value), a.units(problem.model) == ("m",)
        return Gap(apart * slides, apart * (not slides), "one joint")
    return NO_GAP


def _apart(a: Place, b: Place) -> float:
    """Distance of the points, lines or planes of two goals: what no direction in either closes."""
    (p, U), (r, V) = _flat(a), _flat(b)
    _, s, Vt = np.linalg.svd(np.concatenate([U, V, np.zeros((1, 3))]))
    across = Vt[int(np.sum(s > _PARALLEL)) :]
    return float(np.linalg.norm(across @ (p - r)))


def _flat(goal: Place) -> tuple[Array, Array]:
    """A point, and orthonormal rows (k, 3) along the point, line or plane."""
    if isinstance(goal, PointOnPlane):
        return np.asarray(goal.point), np.linalg.svd(np.asarray(goal.normal)[None])[2][1:]
    if isinstance(goal, PointOnLine):
        return np.asarray(goal.point), np.asarray(goal.direction)[None]
    return np.asarray(goal.target if isinstance(goal, Position) else goal.position), np.zeros((0, 3))


def _turn_conflict(problem: Problem, a: Orientation | Pose, b: Orientation | Pose, q: Array) -> Gap:
    """Two orientations of frames that no turning joint lies between."""
    f, g = (problem.kinematics.frame(x.at) for x in (a, b))
    ours = {j.q for j in f.joints if problem.moved[j.v] and int(j.type) != SLIDE}
    theirs = {j.q for j in g.joints if problem.moved[j.v] and int(j.type) != SLIDE}
    if ours != theirs:
        return NO_GAP
    R = _rotation(f, q).T @ _rotation(g, q)
    wanted = rotations.to_matrix(a.quat).T @ rotations.to_matrix(b.quat)
    angle = float(np.linalg.norm(rotations.log(rotations.from_matrix(wanted.T @ R))))
    return Gap(0.0, angle, "one link") if angle > 1e-9 else NO_GAP


def rooms(problem: Problem, goal: Goal) -> tuple[float, float]:
    """Size of residuals, in metres and in radians, that a goal's tolerances allow, free rows left out."""
    t, units = goal.tolerances(problem.model), goal.units(problem.model)
    kept = np.where(np.isfinite(t), t, 0.0)
    position, rotation = (float(np.linalg.norm(kept[[u == unit for u in units]])) for unit in ("m", "rad"))
    return position, rotation * (0.5 * np.pi if isinstance(goal, LookAt) else 1.0)  # angles by their chords


def pairs(goals: tuple[Goal, ...]) -> list[tuple[Goal, Goal]]:
    """All pairs of goals."""
    return list(combinations(goals, 2))


def closed_form_outside(problem: Problem, form: ClosedForm | None) -> Array | None:
    """Solutions (k, nq) of a complete closed form when all of them are outside the limits; else None.

    k = 0: there is no solution at all. Solutions within 1e-7 of the limits prove nothing.
    """
    if form is None or not form.complete:
        return None
    from ..space import Space

    free = Space(problem.model, limits=False)
    q = free.clip(form.q) if len(form.q) else form.q
    if len(q):
        r = problem.raw(q).r
        near = (np.abs(r) <= np.maximum(1e-6, problem.tolerance)) | ~problem.judged
        q = q[near.all(axis=1)]
    if not len(q):
        return q
    outside = problem.space.excess(q).max(axis=1)
    return q if (outside > 1e-7).all() else None


def subdivision(problem: Problem, q0: Array, *, boxes: int = _BOXES) -> bool:
    """Whether a subdivision of the limited range of at most four joints proves that nothing meets the goals.

    In a box around q_c with half widths h, a point moves at most sum_j h_j R_j, R_j the farthest it can be
    from joint j's axis; directions and angles at most sum_j h_j. A box whose residual at the centre is larger
    than that and the tolerance holds no solution. Joints that do not move stand as in q0 (nq,).
    """
    columns = np.flatnonzero(problem.moved)
    low, high = problem.space.low[columns], problem.space.high[columns]
    low, high = _whole_turns(problem, columns, low, high)
    for goal in problem.goals:
        if isinstance(goal, JointValue):
            at = columns == scalar_joint(problem.model, goal.joint)[1]
            near = float(goal.tolerances(problem.model)[0])
            bottom, top = (problem.space.low[columns][at], problem.space.high[columns][at])
            low[at], high[at] = np.maximum(bottom, goal.value - near), np.minimum(top, goal.value + near)
    if (low > high).any():
        return True
    if problem.loops or not 1 <= len(columns) <= 4 or not np.isfinite([low, high]).all():
        return False
    rates = [rate for g in problem.goals if (rate := _rates(problem, g, columns, q0)) is not None]
    if len(rates) < len(problem.goals):
        return False
    centre, half = 0.5 * (low + high)[None], 0.5 * (high - low)[None]
    seen = 0
    for _ in range(_DEEP * len(columns)):
        seen += len(centre)
        if seen > boxes:
            return False
        q = np.tile(q0, (len(centre), 1))
        q[:, problem.space.q_of_v[columns]] = centre
        r = problem.raw(q).r
        alive = np.ones(len(centre), dtype=bool)
        for goal, group, rate in zip(problem.goals, problem.groups, rates, strict=True):
            position, rotation = goal.errors(r[:, group.rows], problem.model)
            travel, near, straight = half @ rate, *rooms(problem, goal)
            alive &= (position <= travel[:, 0] + near) & (rotation <= travel[:, 1] + straight)
        centre, half = centre[alive], half[alive]
        if not len(centre):
            return True
        reach_of = half * np.maximum(np.sum([r.sum(axis=1) for r in rates], axis=0), 1e-12)
        widest = np.argmax(reach_of, axis=1)
        step = np.zeros_like(half)
        step[np.arange(len(half)), widest] = 0.5 * half[np.arange(len(half)), widest]
        half = half - step
        centre, half = np.concatenate([centre - step, centre + step]), np.concatenate([half, half])
    return False


def _whole_turns(problem: Problem, columns: NDArray[np.intp], low: Array, high: Array) -> tuple[Array, Array]:
    """Ranges with one whole turn for hinges that have no limits."""
    hinge = np.isin(columns, problem.space.hinges)
    return np.where(hinge & ~np.isfinite(low), -np.pi, low), np.where(hinge & ~np.isfinite(high), np.pi, high)


def _rates(problem: Problem, goal: Goal, columns: NDArray[np.intp], q0: Array) -> Array | None:
    """Bounds (k, 2) on how fast the goal's metres and radians change with each joint, or None."""
    if isinstance(goal, JointValue):
        out = np.zeros((len(columns), 2))
        unit = 0 if goal.units(problem.model) == ("m",) else 1
        out[columns == scalar_joint(problem.model, goal.joint)[1], unit] = 1.0
        return out
    if isinstance(goal, CenterOfMass):
        masses = problem.kinematics.masses()
        parts = [(mass, _frame_rates(problem, f, columns)) for mass, f in masses]
        rates = [mass * rate for mass, rate in parts if rate is not None]
        if len(rates) < len(parts):
            return None
        whole = sum(mass for mass, _ in masses)
        return np.asarray(np.sum(rates, axis=0) / whole * [1.0, 0.0])
    known = (Position, Orientation, Pose, Distance, Mirror, LookAt)
    if not isinstance(goal, known) or getattr(goal, "relative_to", None) is not None:
        return None
    found = [_frame_rates(problem, problem.kinematics.frame(text), columns) for text in goal.frames()]
    out = np.zeros((len(columns), 2))
    for rate in found:
        if rate is None:
            return None
        out += rate
    if isinstance(goal, LookAt):  # the axis turns with the frame, the sight by the way over the distance
        near = _nearest_sight(problem, goal, q0)
        if near <= 0:
            return None
        out[:, 1] += out[:, 0] / near
        out[:, 0] = 0.0
    return out


def _nearest_sight(problem: Problem, goal: LookAt, q0: Array) -> float:
    """Least distance of a frame from what it looks at [m]."""
    base = at_point(np.asarray(goal.target), problem.space.nq, problem.space.nv)
    hops = path(base, problem.kinematics.frame(goal.at), problem.space, problem.moved, q0)
    return 0.0 if hops is None else reach(hops).low


def _frame_rates(problem: Problem, f: Frame, columns: NDArray[np.intp]) -> Array | None:
    """Bounds (k, 2) on how fast a frame moves [m] and turns [rad] with each joint; None with balls on it."""
    out = np.zeros((len(columns), 2))
    for k, joint in enumerate(f.joints):
        if joint.v not in columns:
            continue
        row = int(np.flatnonzero(columns == joint.v)[0])
        if int(joint.type) == SLIDE:
            out[row, 0] += 1.0
        elif int(joint.type) == HINGE:
            out[row] += [_farthest(problem, f, k), 1.0]
        else:
            return None
    return out


def _farthest(problem: Problem, f: Frame, k: int) -> float:
    """Greatest distance of a frame's origin from the anchor of its k-th joint [m]."""
    total = float(np.linalg.norm(f.X_end[:3, 3]))
    for joint in f.joints[k + 1 :]:
        total += float(np.linalg.norm(joint.X[:3, 3]))
        if int(joint.type) == SLIDE:
            span = problem.space.low[joint.v] - joint.rest, problem.space.high[joint.v] - joint.rest
            total += max(abs(span[0]), abs(span[1]))
    return total
