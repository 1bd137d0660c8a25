"""One step of damped least squares for a chain, as an expression graph specialised to its joints and goal.

    e   residual of the frame: metres over the chain's length, and 2 sin(angle / 2) along the turning axis
    d = -W J^T (J W J^T + lambda I)^-1 e,  lambda = mu e.e + least   (Sugihara 2011: no step is refused)

W holds back joints at their limits that -J^T e pushes outward. For fewer joints than rows the same step comes
from the joints' side, (W J^T J W + lambda I) d = -W J^T e.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compile.graph import Graph, Scalar, absolute, clip, cos, less, maximum, minimum, sin, sqrt
from ...compile.tape import Tape
from ...kinds import HINGE, SLIDE
from ...kinematics import Frame

Array = NDArray[np.float64]
Vector = list[Scalar]
_LEAST = 1e-11
_MU = 0.03
_LONGEST = 0.8  # [rad, or the chain's length] a step


@dataclass(frozen=True, eq=False)
class Chain:
    """What a compiled step knows: the frame, its joints' limits (n, 2), and which rows count.

    `scale` [m] is the length that makes metres and radians alike.
    """

    frame: Frame
    limits: Array
    position: bool
    rotation: bool
    scale: float

    @property
    def n(self) -> int:
        """Number of joints."""
        return len(self.frame.joints)

    def fingerprint(self) -> str:
        """Everything that the compiled code depends on."""
        joints = [(int(j.type), j.X.tolist(), j.rest) for j in self.frame.joints]
        numbers = (_LEAST, _MU, _LONGEST, self.position, self.rotation, self.scale)
        return repr((joints, self.frame.X_end.tolist(), self.limits.tolist(), numbers))


def fits(frame: Frame) -> bool:
    """Whether a frame's chain can be compiled: hinges and slides, one to twelve."""
    return 1 <= len(frame.joints) <= 12 and all(int(j.type) in (HINGE, SLIDE) for j in frame.joints)


def step_tape(chain: Chain) -> Tape:
    """Program (q, t) -> (next, error): the step from q (n), and the largest residual over tolerance at q.

    t (14): the target's R row by row and p, then tolerances of position [m] and rotation [rad].
    """
    graph = Graph()
    q, t = graph.inputs("q", chain.n), graph.inputs("t", 14)
    e, error, J = _residual(chain, list(q), list(t))
    g = [_dot(column, e) for column in J]
    W = [_free(x, y, *limits) for x, y, limits in zip(q, g, chain.limits.tolist(), strict=True)]
    damping = _MU * _dot(e, e) + _LEAST
    if chain.n >= len(e):
        A = [
            [_total(w * c[i] * c[k] for w, c in zip(W, J, strict=True)) for k in range(i + 1)]
            for i in range(len(e))
        ]
        y = _solve(A, damping, e)
        d = [-(w * _dot(c, y)) for w, c in zip(W, J, strict=True)]
    else:
        A = [[W[i] * W[k] * _dot(J[i], J[k]) for k in range(i + 1)] for i in range(chain.n)]
        d = [-x for x in _solve(A, damping, [w * x for w, x in zip(W, g, strict=True)])]
    longest = absolute(d[0])
    for x in d[1:]:
        longest = maximum(longest, absolute(x))
    share = minimum(1.0, _LONGEST / (longest + 1e-30))
    moved = []
    for x, dx, (low, high), joint in zip(q, d, chain.limits.tolist(), chain.frame.joints, strict=True):
        unit = chain.scale if int(joint.type) == SLIDE else 1.0
        x = x + share * dx * unit
        moved.append(clip(x, low, high) if np.isfinite(low) or np.isfinite(high) else x)
    return Tape.build({"q": chain.n, "t": 14}, {"next": moved, "error": [error]})


def _residual(chain: Chain, q: Vector, t: Vector) -> tuple[Vector, Scalar, list[Vector]]:
    """Residual rows, the largest ratio of a component to its tolerance, and the columns of the Jacobian."""
    at_joints, R, p = _walk(chain.frame, q)
    inverse = 1.0 / chain.scale
    e: Vector = []
    error: Scalar = 0.0
    if chain.position:
        off = [a - b for a, b in zip(p, t[9:12], strict=True)]
        e += [inverse * x for x in off]
        share = 1.0 / t[12]
        for x in off:
            error = maximum(error, absolute(x) * share)
    if chain.rotation:
        turn = _turning(R, t)
        e += turn
        share = 1.0 / t[13]
        for x in turn:
            error = maximum(error, absolute(x) * share)
    J = []
    for joint, (axis, origin) in zip(chain.frame.joints, at_joints, strict=True):
        column: Vector = []
        if int(joint.type) == SLIDE:  # the joint's coordinate is counted in lengths of the chain
            column = (list(axis) if chain.position else []) + ([0.0] * 3 if chain.rotation else [])
        else:
            if chain.position:
                arm = [a - b for a, b in zip(p, origin, strict=True)]
                column += [inverse * x for x in _cross(axis, arm)]
            column += axis if chain.rotation else []
        J.append(column)
    return e, error, J


def _turning(R: list[Vector], t: Vector) -> Vector:
    """2 sin(angle / 2) times the axis of R R_T^T, from sin(angle) axis = 1/2 sum t_i x r_i over columns."""
    s: Vector = [0.0, 0.0, 0.0]
    trace: Scalar = 0.0
    for k in range(3):
        r = [R[i][k] for i in range(3)]
        c = [t[3 * i + k] for i in range(3)]
        s = [a + b for a, b in zip(s, _cross(c, r), strict=True)]
        trace = trace + _dot(r, c)
    # cos(angle / 2) = sqrt(1 + trace) / 2, kept away from a half turn
    half = 1.0 / sqrt(maximum(trace + 1.0, 1e-4))
    return [x * half for x in s]


def _walk(frame: Frame, q: Vector) -> tuple[list[tuple[Vector, Vector]], list[Vector], Vector]:
    """Axis and origin of every joint in the world, and rotation and origin of the frame."""
    R: list[Vector] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    p: Vector = [0.0, 0.0, 0.0]
    out = []
    for joint, x in zip(frame.joints, q, strict=True):
        R, p = _offset(R, p, joint.X)
        if int(joint.type) == SLIDE:
            axis = [row[2] for row in R]
            p = [a + b * (x - joint.rest) for a, b in zip(p, axis, strict=True)]
        else:
            c, s = cos(x - joint.rest), sin(x - joint.rest)
            R = [[c * a + s * b, c * b - s * a, z] for a, b, z in R]
            axis = [row[2] for row in R]
        out.append((axis, p))
    R, p = _offset(R, p, frame.X_end)
    return out, R, p


def _offset(R: list[Vector], p: Vector, X: Array) -> tuple[list[Vector], Vector]:
    X = np.where(np.abs(X) < 1e-13, 0.0, X)
    near = np.abs(np.abs(X[:3, :3]) - 1.0) < 1e-13
    X[:3, :3][near] = np.sign(X[:3, :3][near])
    turned = [[_dot(row, [float(x) for x in X[:3, k]]) for k in range(3)] for row in R]
    moved = [a + _dot(row, [float(x) for x in X[:3, 3]]) for a, row in zip(p, R, strict=True)]
    return turned, moved


def _free(x: Scalar, g: Scalar, low: float, high: float) -> Scalar:
    """0 for a joint at a limit that -g pushes outward, else 1."""
    held: Scalar = 0.0
    if np.isfinite(low):
        held = held + (1.0 - less(low, x)) * less(0.0, g)
    if np.isfinite(high):
        held = held + (1.0 - less(x, high)) * less(g, 0.0)
    return 1.0 - held


def _solve(A: list[Vector], damping: Scalar, b: Vector) -> Vector:
    """(A + damping I) x = b by the factors L D L^T of the lower triangle A, pivots at least the damping."""
    n = len(b)
    L: list[Vector] = [[0.0] * n for _ in range(n)]
    inverse: Vector = []
    y = list(b)
    scaled: list[Vector] = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for k in range(i):
            v = A[i][k] - _total(L[k][m] * scaled[i][m] for m in range(k))
            scaled[i][k] = v
            L[i][k] = v * inverse[k]
        pivot = A[i][i] + damping - _total(L[i][m] * scaled[i][m] for m in range(i))
        inverse.append(1.0 / maximum(pivot, damping))
        y[i] = y[i] - _total(L[i][m] * y[m] for m in range(i))
    x = [v * w for v, w in zip(y, inverse, strict=True)]
    for i in reversed(range(n)):
        x[i] = x[i] - _total(L[m][i] * x[m] for m in range(i + 1, n))
    return x


def _dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    return _total(x * y for x, y in zip(a, b, strict=True))


def _total(xs) -> Scalar:  # type: ignore[no-untyped-def]
    out: Scalar = 0.0
    for x in xs:
        out = out + x
    return out


def _cross(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
