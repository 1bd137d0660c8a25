"""Ways between configurations, as expressions: on the manifold where joints turn in space."""

from __future__ import annotations

from collections.abc import Sequence

from ..compile.graph import Scalar
from .rigid import spatial
from .rigid.tree import BALL, FREE

Blocks = Sequence[tuple[int, int, int]]
"""(kind, first entry in q, first entry in v) of every joint, in order."""


def difference(blocks: Blocks, q: Sequence[Scalar], to: Sequence[Scalar]) -> list[Scalar]:
    """Tangent from `q` to `to`, as mj_differentiatePos over one second."""
    out: list[Scalar] = []
    for kind, at, _ in blocks:
        if kind == FREE:
            out += spatial.sub(to[at : at + 3], q[at : at + 3])
            at += 3
        if kind in (FREE, BALL):
            w, x, y, z = q[at : at + 4]
            turn = spatial.quaternion_product([w, -x, -y, -z], to[at : at + 4])
            out += spatial.rotation_vector(turn)
        else:
            out.append(to[at] - q[at])
    return out


def moved(blocks: Blocks, q: Sequence[Scalar], by: Sequence[Scalar]) -> list[Scalar]:
    """Where the tangent `by` leads from `q`, as mj_integratePos over one second."""
    out: list[Scalar] = []
    for kind, at, dof in blocks:
        if kind == FREE:
            out += spatial.add(q[at : at + 3], by[dof : dof + 3])
            at, dof = at + 3, dof + 3
        if kind in (FREE, BALL):
            out += spatial.quaternion_product(q[at : at + 4], spatial.quaternion(by[dof : dof + 3]))
        else:
            out.append(q[at] + by[dof])
    return out
