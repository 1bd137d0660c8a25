"""Closed-form solutions, recognised from the model: candidates for the search and proofs for the verdict.

Known: chains of one to three hinges to a point (planar 2R among them), planar 3R and six hinges with a
spherical wrist or with three parallel axes and two that meet to a pose (as UR's arms), and limbs of two bones
(a ball or three meeting hinges, then one hinge) to a point. Axes are parallel within 1e-9 rad and meet within
1e-8 of the chain's length.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ... import rotations
from ...kinds import BALL, HINGE
from ...kinematics import Frame
from ..goals import Pose, Position
from ..problem import Problem
from .axes import (
    Axis,
    across,
    around,
    cross,
    linear_trig,
    meeting_point,
    point_by_three,
    three_turns,
    turn_matrix,
    two_turns,
)

Array = NDArray[np.float64]
_SWIVELS = 12


class ClosedForm(NamedTuple):
    """All solutions q (k, nq) without regard to limits, but with the whole turns that fit them.

    `complete`: these are certainly all; `structure`: what was recognised.
    """

    q: Array
    complete: bool
    structure: str


class _Chain(NamedTuple):
    """Moving joints of a frame as axes in the reference pose, where every joint stands at its rest."""

    joints: tuple  # type: ignore[type-arg]
    axes: list[Axis]
    X0: Array


def closed_form(problem: Problem, start: Array) -> ClosedForm | None:
    """Closed form of a problem of one point or pose, or None when no structure is recognised."""
    if len(problem.goals) != 1 or problem.loops:
        return None
    goal = problem.goals[0]
    if not isinstance(goal, (Position, Pose)) or goal.relative_to is not None:
        return None
    if not np.isfinite(goal.tolerances(problem.model)).all():
        return None
    chain = _chain(problem.kinematics.frame(goal.at), problem, start)
    if chain is None:
        return None
    kinds = [int(j.type) for j in chain.joints]
    if isinstance(goal, Pose):
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = goal.back.T, np.asarray(goal.position)
        found = _pose(chain, kinds, X)
    else:
        found = _point(chain, kinds, np.asarray(goal.target), start)
    if found is None:
        return None
    q = [_placed(problem, chain, angles, start) for angles in found[0]]
    return ClosedForm(np.array(q).reshape(-1, problem.space.nq), found[1], found[2])


def _chain(f: Frame, problem: Problem, start: Array) -> _Chain | None:
    """Axes of the joints that move; None for joints other than hinges and balls."""
    from ..proofs.reach import stood

    joints, axes, T = [], [], np.eye(4)
    for joint in f.joints:
        if not problem.moved[joint.v]:
            T = stood(T, joint, start)
            continue
        T = T @ joint.X
        if int(joint.type) not in (HINGE, BALL):
            return None
        joints.append(joint)
        axes.append(Axis(T[:3, 3].copy(), T[:3, 2].copy()))
        if int(joint.type) == BALL:  # stands for three axes along its own
            axes[-1:] = [Axis(T[:3, 3].copy(), T[:3, k].copy()) for k in range(3)]
    return _Chain(tuple(joints), axes, T @ f.X_end) if joints else None


_Found = tuple[list[list[float]], bool, str]


def _pose(chain: _Chain, kinds: list[int], X: Array) -> _Found | None:
    if any(kind != HINGE for kind in kinds):
        return None
    axes, G = chain.axes, X @ np.linalg.inv(chain.X0)
    flat = all(np.linalg.norm(cross(a.u, axes[0].u)) < 1e-9 for a in axes)
    if flat and len(axes) <= 3:
        return _planar_pose(axes, G, chain.X0[:3, 3])
    if len(axes) != 6:
        return None
    if (w := meeting_point(axes[3:])) is not None:
        return _wrist(axes, G, w)
    if (w := _parallel(axes)) is not None:
        return _three_parallel(axes, G, w)
    if (w := _parallel(axes[::-1])) is not None:  # the same arm from its tip, all turns the other way
        found = _three_parallel(axes[::-1], np.linalg.inv(G), w)
        return [[-x for x in angles[::-1]] for angles in found[0]], found[1], found[2]
    return None


def _parallel(axes: list[Axis]) -> Array | None:
    """Where axes 5 and 6 meet, if 2, 3 and 4 are parallel and 1 and 5 are not along them."""
    u = axes[1].u
    along = [np.linalg.norm(cross(axis.u, u)) < 1e-9 for axis in axes]
    if not (along[2] and along[3]) or along[0] or along[4]:
        return None
    return meeting_point(axes[4:])


def _three_parallel(axes: list[Axis], G: Array, w: Array) -> _Found:
    """Six hinges, the middle ones along u: these keep heights along u, and u itself.

    w, where axes 5 and 6 meet, is carried by joints 1 to 4 alone, so that joint 1 brings G w to the height of
    w; joints 5 and 6 turn G's u back; the rest is planar (Hawkins 2013 for UR's arms, by sub-problems).
    """
    u, target = axes[1].u, G[:3, :3] @ w + G[:3, 3]
    one = axes[0]
    arm = target - one.o
    mean = float(one.u @ arm) * float(one.u @ u)
    firsts = linear_trig(
        float(u @ arm) - mean, float(u @ cross(one.u, arm)), float(u @ (w - one.o)) - mean
    )  # of exp(-u1 th1)
    out, complete = [], firsts.complete
    for back in firsts.angles:
        M = _screw(one, back) @ G
        pairs, all_pairs = two_turns(axes[5].u, axes[4].u, u, M[:3, :3].T @ u)
        complete = complete and all_pairs
        for minus_6, minus_5 in pairs:
            E = M @ _screw(axes[5], minus_6) @ _screw(axes[4], minus_5)
            planar = _planar_pose(axes[1:4], E, w)
            if planar is None:
                complete = False
                continue
            complete = complete and planar[1]
            out += [[-back, *angles, -minus_5, -minus_6] for angles in planar[0]]
    return out, complete, "three parallel axes"


def _screw(axis: Axis, angle: float) -> Array:
    """Turning about a line as a matrix (4, 4)."""
    X = np.eye(4)
    X[:3, :3] = turn_matrix(axis.u, angle)
    X[:3, 3] = axis.o - X[:3, :3] @ axis.o
    return X


def _planar_pose(axes: list[Axis], G: Array, tip: Array) -> _Found | None:
    """Up to three parallel hinges: the last one's anchor is a point for the others, the rest is turning."""
    u = axes[0].u
    name = f"planar {len(axes)}R"
    if np.linalg.norm(G[:3, :3] @ u - u) > 1e-4:
        return [], True, name
    signs = [1.0 if a.u @ u > 0 else -1.0 for a in axes]
    side = across(u)
    total = around(u, side, G[:3, :3] @ side) or 0.0
    if len(axes) == 1:
        return [[total]], True, name
    point = axes[-1].o
    inner = _planar_point(axes[:-1], point, G[:3, :3] @ point + G[:3, 3])
    if inner is None:
        return None
    out = []
    for angles in inner[0]:
        spent = sum(s * a for s, a in zip(signs, angles, strict=False))
        out.append([*angles, signs[-1] * (total - spent)])
    return out, inner[1], name


def _planar_point(axes: list[Axis], tip: Array, target: Array) -> _Found | None:
    """One or two parallel hinges that carry `tip` to `target`; out of plane there is none."""
    one, name = axes[0], f"planar {len(axes)}R"
    height = float(one.u @ (target - tip))
    if abs(height) > 1e-4:
        return [], True, name
    flat = target - one.o - (one.u @ (target - one.o)) * one.u
    if len(axes) == 1:
        arm = tip - one.o
        angle = around(one.u, arm, flat)
        return ([[angle]], True, name) if angle is not None else ([[0.0]], False, name)
    two = axes[1]
    a = two.o - one.o
    b = tip - two.o
    a, b = a - (a @ one.u) * one.u, b - (b @ one.u) * one.u
    # |a + turn(b)|^2 = |flat|^2
    roots = linear_trig(float(a @ b), float(a @ cross(two.u, b)), 0.5 * float(flat @ flat - a @ a - b @ b))
    out, complete = [], roots.complete
    for th2 in roots.angles:
        arm = two.turn(th2, tip) - one.o
        th1 = around(one.u, arm, flat)
        complete = complete and th1 is not None
        out.append([th1 or 0.0, th2])
    return out, complete, name


def _wrist(axes: list[Axis], G: Array, w: Array) -> _Found:
    """Six hinges, the last three through w: three place w, three turn (Pieper 1968)."""
    placed = point_by_three(axes[:3], w, G[:3, :3] @ w + G[:3, 3])
    out, complete = [], placed.complete
    for angles in placed.angles:
        R = G[:3, :3]
        for axis, angle in zip(axes[:3], angles, strict=True):
            R = turn_matrix(axis.u, -angle) @ R
        turns = three_turns(axes[3:], R)
        complete = complete and turns.complete
        out += [[*angles, *rest] for rest in turns.angles]
    return out, complete, "spherical wrist"


def _point(chain: _Chain, kinds: list[int], target: Array, start: Array) -> _Found | None:
    axes, tip = chain.axes, chain.X0[:3, 3]
    hinges = all(kind == HINGE for kind in kinds)
    flat = all(np.linalg.norm(cross(a.u, axes[0].u)) < 1e-9 for a in axes)
    if hinges and flat and len(axes) <= 2:
        return _planar_point(axes, tip, target)
    if hinges and len(axes) == 3 and not flat:
        found = point_by_three(axes, tip, target)
        return [list(a) for a in found.angles], found.complete, "three hinges"
    if len(axes) in (4, 5) and len(kinds) in (2, 4) and (c := meeting_point(axes[:3])) is not None:
        return _two_bones(axes[:4], c, tip, target, chain, start)
    return None


def _two_bones(
    axes: list[Axis], c: Array, tip: Array, target: Array, chain: _Chain, start: Array
) -> _Found | None:
    """Three turns about c and an elbow: the elbow sets the distance, the swivel about c-target is free."""
    if len(chain.axes) != 4:
        return None
    elbow = axes[3]
    far = float(np.linalg.norm(target - c))
    a, b = elbow.o - c, tip - elbow.o
    across = b - (b @ elbow.u) * elbow.u
    lift = a + (b @ elbow.u) * elbow.u
    rest = 0.5 * (far * far - lift @ lift - across @ across)
    roots = linear_trig(float(lift @ across), float(lift @ cross(elbow.u, across)), float(rest))
    out: list[list[float]] = []
    for th in roots.angles:
        arm = elbow.turn(th, tip) - c
        if min(far, float(np.linalg.norm(arm))) < 1e-9:
            continue
        onto = _shortest(arm, target - c)
        for k in range(_SWIVELS):
            swivel = rotations.exp(2 * np.pi * k / _SWIVELS * (target - c) / far)
            R = rotations.to_matrix(rotations.multiply(swivel, onto))
            out += [[*turns, th] for turns in three_turns(axes[:3], R).angles]
    return out, roots.complete and not roots.angles, "two bones"


def _shortest(a: Array, b: Array) -> Array:
    """Quaternion of the least turn of direction a onto b."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    axis = cross(a, b)
    length = float(np.linalg.norm(axis))
    if length < 1e-12:
        if a @ b > 0:
            return np.array([1.0, 0.0, 0.0, 0.0])
        return rotations.exp(np.pi * np.linalg.svd(a[None])[2][1])
    return rotations.exp(axis / length * np.arctan2(length, a @ b))


def _placed(problem: Problem, chain: _Chain, angles: list[float], start: Array) -> Array:
    """Configuration (nq,) of angles about the axes, each the whole turns into its limits."""
    q, at = start.copy(), 0
    space = problem.space
    for joint in chain.joints:
        if int(joint.type) == BALL:
            parts = [rotations.exp(a * np.eye(3)[k]) for k, a in enumerate(angles[at : at + 3])]
            q[joint.q : joint.q + 4] = rotations.multiply(rotations.multiply(parts[0], parts[1]), parts[2])
            at += 3
            continue
        x, turn = angles[at] + joint.rest, 2 * np.pi
        low, high = float(space.low[joint.v]), float(space.high[joint.v])
        near = x - turn * round((x - float(start[joint.q])) / turn)
        options = [near, near - turn, near + turn, x]
        inside = [o for o in options if low - 1e-9 <= o <= high + 1e-9]
        if not inside and np.isfinite(low) and np.isfinite(high):  # nearest to the range
            inside = [min(options, key=lambda o: max(low - o, o - high))]
        q[joint.q] = inside[0] if inside else near
        at += 1
    return q
