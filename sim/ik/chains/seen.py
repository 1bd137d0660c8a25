"""Frames as expression graphs: poses and Jacobian columns by the freedoms that move."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...compile.graph import Node
from ...kinds import FREE, HINGE, SLIDE
from ...kinematics import Frame
from .algebra import (
    ZERO,
    Vector,
    cross,
    matrix,
    minus,
    offset,
    plus,
    product,
    scaled,
    spun,
    times,
    transposed,
)

if TYPE_CHECKING:
    from ..problem import Problem

Columns = dict[int, Vector]  # by freedom


class Seen(NamedTuple):
    """A frame: R_WF by rows, p_WF, and columns of its angular and linear Jacobians."""

    R: list[Vector]
    p: Vector
    w: Columns
    u: Columns


class Scene(NamedTuple):
    """What rows are made from: the problem's model and frames, and the symbols q (nq)."""

    problem: Problem
    q: Sequence[Node]

    def frame(self, text: str) -> Seen:
        """A frame by its text."""
        return seen(self.problem.kinematics.frame(text), self.q, self.problem.moved)

    def seen_from(self, at: str, base: str | None) -> Seen:
        """Frame `at` in the frame `base` (None: the world)."""
        if base is None:
            return self.frame(at)
        f, b = self.frame(at), self.frame(base)
        own = [v for v in f.u if v not in b.u] + [v for v in b.u if v not in f.u]  # joints of both carry both
        arm = minus(f.p, b.p)
        back = transposed(b.R)
        w: Columns = {}
        u: Columns = {}
        for v in own:
            u[v] = times(
                back, f.u[v] if v in f.u else minus(cross(arm, b.w[v]) if v in b.w else ZERO, b.u[v])
            )
            if v in f.w or v in b.w:
                w[v] = times(back, f.w[v] if v in f.w else [-x for x in b.w[v]])
        return Seen(product(back, f.R), times(back, arm), w, u)


def seen(f: Frame, q: Sequence[Node], moved: NDArray[np.bool_]) -> Seen:
    """Pose and Jacobian columns of a frame; joints that do not move stand where q says."""
    R: list[Vector] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    p: Vector = [0.0, 0.0, 0.0]
    spins: dict[int, tuple[Vector, Vector]] = {}
    u: Columns = {}
    for joint in f.joints:
        R, p = offset(R, p, joint.X)
        kind, v = int(joint.type), joint.v
        if kind == HINGE:
            R = spun(R, q[joint.q] - joint.rest)
            spins[v] = [row[2] for row in R], p
        elif kind == SLIDE:
            u[v] = [row[2] for row in R]
            p = plus(p, scaled(q[joint.q] - joint.rest, u[v]))
        else:
            at = joint.q
            if kind == FREE:
                p, R = list(q[at : at + 3]), [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
                u |= {v + k: R[k] for k in range(3)}
                at, v = at + 3, v + 3
            R = product(R, matrix(q[at : at + 4]))
            spins |= {v + k: ([row[k] for row in R], p) for k in range(3)}
    R, p = offset(R, p, f.X_end)
    w = {v: axis for v, (axis, _) in spins.items() if moved[v]}
    u = {v: axis for v, axis in u.items() if moved[v]}
    u |= {v: cross(axis, minus(p, o)) for v, (axis, o) in spins.items() if moved[v]}
    return Seen(R, p, w, u)
