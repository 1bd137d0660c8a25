"""Goals and equalities as expression graphs: residual rows with sparse Jacobians, by the freedoms that move.

The formulas are those of the goals themselves (`goals.py`, `wholes.py`, `animate.py`, `loops.py`); what a
goal aims at stays an argument, so that another target needs no other program.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....models.naming import lookup
from ...compile.graph import Node, Scalar, maximum, sqrt
from ...kinds import BALL
from ..goals import Distance, Goal, LookAt, Orientation, PointOnLine, PointOnPlane, Pose, Position
from ..loops import CONNECT, JOINT, Closure
from ..mirror import Mirror
from ..space import Space
from ..wholes import CenterOfMass, JointValue, Posture, scalar_joint
from .algebra import (
    ZERO,
    Vector,
    cross,
    dot,
    inverse_jacobian,
    log_quaternion,
    minus,
    multiplied,
    plus,
    product,
    quaternion,
    scaled,
    times,
    transposed,
)
from .seen import Columns, Scene, Seen, seen

if TYPE_CHECKING:
    from ..problem import Problem

Array = NDArray[np.float64]


class Row(NamedTuple):
    """One residual and its derivatives by the freedoms that move it."""

    r: Scalar
    J: dict[int, Scalar]


def _rows(r: Vector, J: Columns) -> list[Row]:
    return [Row(x, {v: column[k] for v, column in J.items()}) for k, x in enumerate(r)]


def _each(J: Columns, M: Sequence[Sequence[Scalar]]) -> Columns:
    return {v: times(M, x) for v, x in J.items()}


def _together(a: Columns, b: Columns, sign: float = 1.0) -> Columns:
    """a + sign b."""
    out = dict(a)
    for v, x in b.items():
        out[v] = plus(out.get(v, ZERO), x if sign > 0 else [-y for y in x])
    return out


def _position(scene: Scene, goal: Position, t: Vector) -> list[Row]:
    f = scene.seen_from(goal.at, goal.relative_to)
    return _rows(minus(f.p, t), f.u)


def _turn(f: Seen, back: list[Vector]) -> list[Row]:
    phi, c = log_quaternion(quaternion(product(back, f.R)))
    return _rows(phi, _each(f.w, product(inverse_jacobian(phi, c, -1.0), back)))


def _orientation(scene: Scene, goal: Orientation, t: Vector) -> list[Row]:
    return _turn(scene.seen_from(goal.at, goal.relative_to), [t[0:3], t[3:6], t[6:9]])


def _pose(scene: Scene, goal: Pose, t: Vector) -> list[Row]:
    f = scene.seen_from(goal.at, goal.relative_to)
    return _rows(minus(f.p, t[:3]), f.u) + _turn(f, [t[3:6], t[6:9], t[9:12]])


def _look_at(scene: Scene, goal: LookAt, t: Vector) -> list[Row]:
    f = scene.frame(goal.at)
    a, target, J = times(f.R, t[3:6]), t[:3], {v: [-x for x in u] for v, u in f.u.items()}
    if goal.relative_to is not None:
        b = scene.frame(goal.relative_to)
        arm = times(b.R, target)
        target = plus(b.p, arm)
        J = _together(_together(J, b.u), {v: cross(w, arm) for v, w in b.w.items()})
    sight = minus(target, f.p)
    inverse = 1.0 / maximum(sqrt(dot(sight, sight)), 1e-9)
    d = scaled(inverse, sight)
    swept = {v: scaled(inverse, minus(u, scaled(dot(d, u), d))) for v, u in J.items()}
    return _rows(minus(a, d), _together({v: cross(w, a) for v, w in f.w.items()}, swept, -1.0))


def _on_line(scene: Scene, goal: PointOnLine, t: Vector) -> list[Row]:
    f = scene.seen_from(goal.at, goal.relative_to)
    across = [t[3:6], t[6:9]]
    return _rows(times(across, minus(f.p, t[:3])), _each(f.u, across))


def _on_plane(scene: Scene, goal: PointOnPlane, t: Vector) -> list[Row]:
    f = scene.seen_from(goal.at, goal.relative_to)
    return _rows([dot(t[3:6], minus(f.p, t[:3]))], _each(f.u, [t[3:6]]))


def _distance(scene: Scene, goal: Distance, t: Vector) -> list[Row]:
    f = scene.frame(goal.at)
    p, J = minus(f.p, t[1:4]), f.u
    if isinstance(goal.to, str):
        g = scene.frame(goal.to)
        p, J = minus(f.p, g.p), _together(f.u, g.u, -1.0)
    long = sqrt(dot(p, p))
    u = scaled(1.0 / maximum(long, 1e-12), p)
    return _rows([long - t[0]], _each(J, [u]))


def _mirror(scene: Scene, goal: Mirror, t: Vector) -> list[Row]:
    f, g = (scene.seen_from(at, goal.relative_to) for at in (goal.at, goal.of))
    n, point, flip = t[:3], t[3:6], t[6:9]

    def reflected(x: Vector, along: Vector = n) -> Vector:
        return minus(x, scaled(2.0 * dot(along, x), along))

    image = plus(reflected(minus(g.p, point)), point)
    place = _rows(minus(f.p, image), _together(f.u, {v: reflected(x) for v, x in g.u.items()}, -1.0))
    if goal.what == "position":
        return place
    back = [reflected(column) for column in transposed([reflected(row, flip) for row in g.R])]
    turns = _together(f.w, {v: reflected(x) for v, x in g.w.items()})
    turn = _turn(Seen(f.R, f.p, turns, {}), back)
    return turn if goal.what == "orientation" else place + turn


def _center(scene: Scene, goal: CenterOfMass, t: Vector) -> list[Row]:
    masses = scene.problem.kinematics.masses()
    whole = sum(mass for mass, _ in masses)
    p, J = ZERO, Columns()
    for mass, frame in masses:
        f = seen(frame, scene.q, scene.problem.moved)
        p = plus(p, scaled(mass / whole, f.p))
        J = _together(J, {v: scaled(mass / whole, x) for v, x in f.u.items()})
    return _rows(minus(p, t), J)


def _joint_value(scene: Scene, goal: JointValue, t: Vector) -> list[Row]:
    q, v = scalar_joint(scene.problem.model, goal.joint)
    return [Row(scene.q[q] - t[0], {v: 1.0})]


def difference(
    space: Space, q: Sequence[Node], start: Vector
) -> tuple[list[Scalar], dict[int, list[Vector]]]:
    """Tangent from `start` to q (nv,), and inverse right Jacobians of balls by their first freedom."""
    d: list[Scalar] = [0.0] * space.nv
    blocks = {}
    for i, v in zip(space.scalar_q, space.scalar_v, strict=True):
        d[v] = q[i] - start[i]
    for i, v in space.shifts:
        d[v : v + 3] = minus(q[i : i + 3], start[i : i + 3])
    for ball in space.balls:
        s, to = start[ball.q : ball.q + 4], q[ball.q : ball.q + 4]
        phi, c = log_quaternion(multiplied([s[0], -s[1], -s[2], -s[3]], to))
        d[ball.v : ball.v + 3] = phi
        blocks[ball.v] = inverse_jacobian(phi, c, 1.0)
    return d, blocks


def _posture(scene: Scene, goal: Posture, t: Vector) -> list[Row]:
    d, blocks = difference(scene.problem.space, scene.q, t)
    out = [Row(x, {v: 1.0}) for v, x in enumerate(d)]
    for v, block in blocks.items():
        for k in range(3):
            out[v + k] = Row(d[v + k], {v + i: block[k][i] for i in range(3)})
    return out


def _pole(scene: Scene, goal: Any, t: Vector) -> list[Row]:
    root, mid, tip = (scene.frame(name) for name in goal.frames())
    keys = [*dict.fromkeys([*root.u, *mid.u, *tip.u])]

    def moving(a: Columns, v: int) -> Vector:
        return a.get(v, ZERO)

    def unit(x: Vector) -> tuple[Vector, Scalar]:
        inverse = 1.0 / maximum(sqrt(dot(x, x)), 1e-9)
        return scaled(inverse, x), inverse

    def turned(u: Vector, inverse: Scalar, dx: Vector) -> Vector:
        return scaled(inverse, minus(dx, scaled(dot(u, dx), u)))

    A, short = unit(minus(tip.p, root.p))
    x, y = minus(mid.p, root.p), minus(t, root.p)
    m, across = (minus(z, scaled(dot(z, A), A)) for z in (x, y))
    w, wide = unit(across)
    u, _ = unit(m)
    long = sqrt(dot(m, m))
    J = {}
    for v in keys:
        dA = turned(A, short, minus(moving(tip.u, v), moving(root.u, v)))

        def fallen(z: Vector, dz: Vector, dA: Vector = dA) -> Vector:
            return minus(minus(dz, scaled(dot(dz, A) + dot(z, dA), A)), scaled(dot(z, A), dA))

        dm = fallen(x, minus(moving(mid.u, v), moving(root.u, v)))
        dw = turned(w, wide, fallen(y, [-z for z in moving(root.u, v)]))
        J[v] = minus(minus(dm, scaled(dot(u, dm), w)), scaled(long, dw))
    return _rows(minus(m, scaled(long, w)), J)


def _spread(scene: Scene, goal: Any, t: Vector) -> list[Row]:
    model = scene.problem.model
    parts = []
    for name, share in zip(goal.joints, t, strict=True):
        j = lookup(model, "joint", name)
        at, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        inverse = 1.0 / share
        if int(model.jnt_type[j]) == BALL:
            phi, c = log_quaternion(scene.q[at : at + 4])
            block = inverse_jacobian(phi, c, 1.0)
            part = [(phi[k], {v + i: block[k][i] for i in range(3)}) for k in range(3)]
        else:
            part = [(scene.q[at] - float(model.qpos0[at]), {v: 1.0})]
        parts.append([(r * inverse, {i: x * inverse for i, x in J.items()}) for r, J in part])
    out = []
    for a, b in pairwise(parts):
        for (r, J), (s, K) in zip(a, b, strict=True):
            out.append(Row(s - r, _sum(K, {v: -x for v, x in J.items()})))
    return out


def _sum(a: dict[int, Scalar], b: dict[int, Scalar]) -> dict[int, Scalar]:
    return {v: a.get(v, 0.0) + b.get(v, 0.0) for v in dict.fromkeys([*a, *b])}


def closure_rows(scene: Scene, loop: Closure) -> list[Row]:
    """Rows of one equality of the model."""
    if loop.kind == JOINT:
        (q1, v1, rest), *other = loop.joints
        r = scene.q[q1] - rest
        if not other:
            return [Row(r - loop.polynomial[0], {v1: 1.0})]
        q2, v2, rest2 = other[0]
        x: Scalar = scene.q[q2] - rest2
        value: Scalar = 0.0
        slope: Scalar = 0.0
        for c in reversed(loop.polynomial):
            slope = slope * x + value
            value = value * x + c
        return [Row(r - value, _sum({v1: 1.0}, {v2: -slope}))]
    f, g = scene.frame(loop.a), scene.frame(loop.b)
    apart = _rows(minus(f.p, g.p), _together(f.u, g.u, -1.0))
    if loop.kind == CONNECT:
        return apart
    back = transposed(g.R)
    phi, curve = log_quaternion(quaternion(product(back, f.R)))
    M = product(inverse_jacobian(phi, curve, -1.0), back)
    return apart + _rows(phi, _each(_together(f.w, g.w, -1.0), M))


def _flat(*parts: Any) -> Array:
    return np.concatenate([np.ravel(np.asarray(x, dtype=float)) for x in parts])


@cache
def _known() -> dict[type, tuple[Callable[[Any], Array], Callable[[Scene, Any, Vector], list[Row]]]]:
    """What each kind of goal aims at, as numbers, and its rows."""
    from ..animate import Pole, Spread

    return {
        Position: (lambda g: _flat(g.target), _position),
        Orientation: (lambda g: _flat(g.back), _orientation),
        Pose: (lambda g: _flat(g.position, g.back), _pose),
        LookAt: (lambda g: _flat(g.target, g.axis), _look_at),
        PointOnLine: (
            lambda g: _flat(g.point, np.linalg.svd(np.asarray(g.direction)[None])[2][1:]), _on_line
        ),
        PointOnPlane: (lambda g: _flat(g.point, g.normal), _on_plane),
        Distance: (lambda g: _flat(g.distance, np.zeros(3) if isinstance(g.to, str) else g.to), _distance),
        Mirror: (lambda g: _flat(g.normal, g.point, g.flip), _mirror),
        CenterOfMass: (lambda g: _flat(g.target), _center),
        JointValue: (lambda g: _flat(g.value), _joint_value),
        Posture: (lambda g: _flat(g.q), _posture),
        Pole: (lambda g: _flat(g.pole), _pole),
        Spread: (lambda g: _shares(g), _spread),
    }  # fmt: skip


def _shares(goal: Any) -> Array:
    shares = np.array(goal.shares or (1.0,) * len(goal.joints), dtype=float)
    return np.asarray(shares / shares.sum())


def expressible(problem: Problem) -> bool:
    """Whether every goal is of a kind known here; a goal of a user's own class is not."""
    return all(is_known(goal) for goal in problem.goals)


def is_known(goal: Goal) -> bool:
    """Whether a goal's kind is known here."""
    return type(goal) in _known()


def aims(problem: Problem) -> Array:
    """What all goals aim at, one after the other."""
    known = _known()
    parts = [known[type(goal)][0](goal) for goal in problem.goals]
    return np.concatenate([*parts, np.zeros(0)])


def problem_rows(scene: Scene, t: Sequence[Node]) -> list[Row]:
    """Rows of all goals, aimed at t, and of all equalities, in the problem's order."""
    known, out, at = _known(), [], 0
    for goal in scene.problem.goals:
        pack, rows = known[type(goal)]
        n = len(pack(goal))
        out += rows(scene, goal, list(t[at : at + n]))
        at += n
    for loop in scene.problem.loops:
        out += closure_rows(scene, loop)
    moved = scene.problem.moved
    return [Row(r, {v: x for v, x in J.items() if moved[v]}) for r, J in out]
