"""Where the links of a tree stand: the transform across every joint, over generic scalars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import pi

from ...compile.graph import Scalar, cos, sin
from . import spatial
from .spatial import Matrix, Turn, Vector
from .tree import BALL, FREE, HINGE, SLIDE, Link, Tree, quaternion_of_rotation, snap


@dataclass(frozen=True)
class Transform:
    """Rotation from a link's frame to its parent's, as successive turns or as a matrix, and origin `r`."""

    turns: tuple[Turn, ...]
    matrix: Matrix | None
    r: Vector

    def to_parent(self, v: Sequence[Scalar]) -> Vector:
        """A vector's components in the parent's frame."""
        if self.matrix is not None:
            return spatial.times(self.matrix, v)
        for t in reversed(self.turns):
            v = spatial.turn(t, v)
        return list(v)

    def to_child(self, v: Sequence[Scalar]) -> Vector:
        """A vector's components in the link's frame."""
        if self.matrix is not None:
            return spatial.transposed_times(self.matrix, v)
        for t in self.turns:
            v = spatial.turn_back(t, v)
        return list(v)

    def symmetric(self, m: Matrix) -> Matrix:
        """A symmetric tensor in the parent's frame."""
        if self.matrix is not None:
            return spatial.congruence(self.matrix, m, symmetric=True)
        for t in reversed(self.turns):
            m = spatial.turn_symmetric(t, m)
        return m

    def general(self, m: Matrix) -> Matrix:
        """Any tensor in the parent's frame."""
        if self.matrix is not None:
            return spatial.congruence(self.matrix, m, symmetric=False)
        for t in reversed(self.turns):
            m = spatial.turn_general(t, m)
        return m


def transforms(tree: Tree, q: Sequence[Scalar]) -> list[Transform]:
    """Transforms of all links at the coordinates `q` (the model's qpos; quaternions of any length)."""
    return [_transform(link, q) for link in tree.links]


def _transform(link: Link, q: Sequence[Scalar]) -> Transform:
    at = link.qadr
    if link.kind == FREE:
        return Transform((), spatial.rotation_of_quaternion(q[at + 3 : at + 7]), list(q[at : at + 3]))
    if link.kind == BALL:
        constant = quaternion_of_rotation(link.X.R)
        turned = spatial.quaternion_product(constant, q[at : at + 4])
        return Transform((), spatial.rotation_of_quaternion(turned), link.X.p)
    if link.kind == SLIDE:
        return Transform(_constant_turns(link), None, spatial.add(link.X.p, spatial.scale(q[at], link.axis)))
    assert link.kind == HINGE
    quarters = round(link.offset / (pi / 2))
    if abs(link.offset - quarters * pi / 2) < 1e-13:
        c, s = cos(q[at]), sin(q[at])
        c, s = ((c, s), (-s, c), (-c, -s), (s, -c))[quarters % 4]
    else:
        angle = q[at] + link.offset
        c, s = cos(angle), sin(angle)
    return Transform((*_constant_turns(link), (2, c, s)), None, link.X.p)


def _constant_turns(link: Link) -> tuple[Turn, ...]:
    """The turns Rz(phi) Rx(alpha) before the joint, without those that do nothing."""
    if link.kind == SLIDE:
        return ()
    turns = [(2, link.phi), (0, link.alpha)]
    exact = [(axis, snap(cos(angle)), snap(sin(angle))) for axis, angle in turns]
    return tuple(t for t in exact if t[1] != 1.0 or t[2] != 0.0)
