"""One step of damped least squares for a chain, as an expression graph specialised to its joints and goal.

    e   residual of the frame: metres over the chain's length, and 2 sin(angle / 2) along the turning axis
    d = -W J^T (J W J^T + lambda I)^-1 e,  lambda = mu e.e + least   (Sugihara 2011: no step is refused)

W holds back joints at their limits that -J^T e pushes outward. For fewer joints than rows the same step comes
from the joints' side, (W J^T J W + lambda I) d = -W J^T e.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...compile.graph import Graph, Scalar, absolute, clip, less, maximum, minimum, sqrt
from ...compile.tape import Tape
from ...kinds import HINGE, SLIDE
from ...kinematics import Frame
from .algebra import Vector, cross, dot, offset, solved, spun, total

Array = NDArray[np.float64]
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
    g = [dot(column, e) for column in J]
    W = [_free(x, y, *limits) for x, y, limits in zip(q, g, chain.limits.tolist(), strict=True)]
    damping = _MU * dot(e, e) + _LEAST
    if chain.n >= len(e):
        A = [
            [total(w * c[i] * c[k] for w, c in zip(W, J, strict=True)) for k in range(i + 1)]
            for i in range(len(e))
        ]
        y = solved(A, [damping] * len(e), e)
        d = [-(w * dot(c, y)) for w, c in zip(W, J, strict=True)]
    else:
        A = [[W[i] * W[k] * dot(J[i], J[k]) for k in range(i + 1)] for i in range(chain.n)]
        b = [w * x for w, x in zip(W, g, strict=True)]
        d = [-x for x in solved(A, [damping] * chain.n, b)]
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
    error = maximum(error, 1e-30 * dot(e, e))  # the larger of two is the second where one is NaN
    J = []
    for joint, (axis, origin) in zip(chain.frame.joints, at_joints, strict=True):
        column: Vector = []
        if int(joint.type) == SLIDE:  # the joint's coordinate is counted in lengths of the chain
            column = (list(axis) if chain.position else []) + ([0.0] * 3 if chain.rotation else [])
        else:
            if chain.position:
                arm = [a - b for a, b in zip(p, origin, strict=True)]
                column += [inverse * x for x in cross(axis, arm)]
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
        s = [a + b for a, b in zip(s, cross(c, r), strict=True)]
        trace = trace + dot(r, c)
    # cos(angle / 2) = sqrt(1 + trace) / 2, kept away from a half turn
    half = 1.0 / sqrt(maximum(trace + 1.0, 1e-4))
    return [x * half for x in s]


def _walk(frame: Frame, q: Vector) -> tuple[list[tuple[Vector, Vector]], list[Vector], Vector]:
    """Axis and origin of every joint in the world, and rotation and origin of the frame."""
    R: list[Vector] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    p: Vector = [0.0, 0.0, 0.0]
    out = []
    for joint, x in zip(frame.joints, q, strict=True):
        R, p = offset(R, p, joint.X)
        if int(joint.type) == SLIDE:
            axis = [row[2] for row in R]
            p = [a + b * (x - joint.rest) for a, b in zip(p, axis, strict=True)]
        else:
            R = spun(R, x - joint.rest)
            axis = [row[2] for row in R]
        out.append((axis, p))
    R, p = offset(R, p, frame.X_end)
    return out, R, p


def _free(x: Scalar, g: Scalar, low: float, high: float) -> Scalar:
    """0 for a joint at a limit that -g pushes outward, else 1."""
    held: Scalar = 0.0
    if np.isfinite(low):
        held = held + (1.0 - less(low, x)) * less(0.0, g)
    if np.isfinite(high):
        held = held + (1.0 - less(x, high)) * less(g, 0.0)
    return 1.0 - held
