"""Solve M x = b by articulated bodies at rest: linear in the number of links, best for bushy trees.

Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 7, with velocities and gravity left to the bias.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

from ...compile.graph import Node, Scalar
from ..fields import Fields
from .motion import Transform
from .spatial import Matrix, Vector, add, cross, dot
from .tree import FREE, HINGE, SLIDE, Inertia, Link, Tree

Spatial = list[Scalar]  # angular components, then linear


class _Elimination:
    """One freedom removed from an articulated body: what the way back needs."""

    def __init__(self, dof: int, axis: list[Scalar], column: Spatial, inverse: Scalar, excess: Scalar):
        self.dof, self.axis, self.column, self.inverse, self.excess = dof, axis, column, inverse, excess


def articulated_solve(
    tree: Tree, where: Sequence[Transform], fields: Fields, b: Sequence[Scalar], skip: Collection[int]
) -> list[Scalar]:
    """x with M x = b; freedoms in `skip` are held. Linear freedoms of free joints are in the link's frame."""
    blocks = [_rigid(link.regrouped) for link in tree.links]
    loads: list[Spatial] = [[0.0] * 6 for _ in tree.links]
    removed: list[list[_Elimination]] = [[] for _ in tree.links]
    for index in reversed(range(len(tree.links))):
        link, at = tree.links[index], where[index]
        inertia, load = blocks[index], loads[index]
        if link.dadr not in skip:
            for dof, axis in reversed(_axes(link)):
                inertia, load, step = _eliminate(inertia, load, dof, axis, b[dof], fields.armature(dof))
                removed[index].append(step)
        if link.parent >= 0:
            _hand_over(at, inertia, load, blocks[link.parent], loads[link.parent])
    x: list[Scalar] = [0.0] * len(b)
    motion: list[Spatial] = []
    for index, (link, at) in enumerate(zip(tree.links, where, strict=True)):
        y: Spatial = [0.0] * 6
        if link.parent >= 0:
            angular, linear = motion[link.parent][:3], motion[link.parent][3:]
            y = at.to_child(angular) + at.to_child(add(linear, cross(angular, at.r)))
        for step in reversed(removed[index]):
            x[step.dof] = (step.excess - dot(step.column, y)) * step.inverse
            y = [c + a * x[step.dof] for c, a in zip(y, step.axis, strict=True)]
        motion.append(y)
    return x


def _axes(link: Link) -> list[tuple[int, list[Scalar]]]:
    """Freedoms of a joint with their unit motions (angular, linear) in the link's frame."""

    def unit(k: int) -> list[Scalar]:
        return [1.0 if i == k else 0.0 for i in range(6)]

    if link.kind == HINGE:
        return [(link.dadr, unit(2))]
    if link.kind == SLIDE:
        return [(link.dadr, [0.0, 0.0, 0.0, *link.axis])]
    order = (3, 4, 5, 0, 1, 2) if link.kind == FREE else (0, 1, 2)
    return [(link.dadr + k, unit(component)) for k, component in enumerate(order)]


def _rigid(body: Inertia) -> Matrix:
    """Spatial inertia about the origin: [[I, [h]], [-[h], m 1]]."""
    h = body.h
    skew: Matrix = [[0.0, -h[2], h[1]], [h[2], 0.0, -h[0]], [-h[1], h[0], 0.0]]
    top = [[*a, *b] for a, b in zip(body.rotational(), skew, strict=True)]
    bottom = [
        [skew[k][i] for k in range(3)] + [body.m if i == k else 0.0 for k in range(3)] for i in range(3)
    ]
    return top + bottom


def _eliminate(
    inertia: Matrix, load: Spatial, dof: int, axis: list[Scalar], force: Scalar, armature: Scalar
) -> tuple[Matrix, Spatial, _Elimination]:
    column = [dot(row, axis) for row in inertia]
    inverse = 1.0 / (dot(axis, column) + armature)
    excess = force - dot(axis, load)
    gain = [c * inverse for c in column]
    out = [list(row) for row in inertia]
    for i in range(6):
        for j in range(i, 6):
            out[i][j] = out[j][i] = inertia[i][j] - gain[i] * column[j]
    load = [p + g * excess for p, g in zip(load, gain, strict=True)]
    if axis.count(1.0) == 1 and not isinstance(armature, Node) and armature == 0.0:
        # exactly zero: an articulated body does not resist its own joint
        k = axis.index(1.0)
        for i in range(6):
            out[i][k] = out[k][i] = 0.0
        load[k] = force
    return out, load, _Elimination(dof, axis, column, inverse, excess)


def _hand_over(at: Transform, inertia: Matrix, load: Spatial, onto: Matrix, onto_load: Spatial) -> None:
    """Add a child's articulated inertia and load, moved to the parent's frame, to the parent's."""
    A = at.symmetric([row[:3] for row in inertia[:3]])
    B = at.general([row[3:] for row in inertia[:3]])
    M = at.symmetric([row[3:] for row in inertia[3:]])
    r = at.r
    # with a_child = a - r x al: B' = B + [r] M, A' = A + [r] B^T - B' [r]
    moved = [cross(r, [M[i][k] for i in range(3)]) for k in range(3)]
    B1 = [[B[i][k] + moved[k][i] for k in range(3)] for i in range(3)]
    left = [cross(r, B[k]) for k in range(3)]
    right = [cross(B1[i], r) for i in range(3)]
    for i in range(3):
        for k in range(3):
            onto[i][3 + k] = onto[i][3 + k] + B1[i][k]
            onto[3 + k][i] = onto[i][3 + k]
            if k >= i:
                onto[i][k] = onto[i][k] + (A[i][k] + left[k][i] - right[i][k])
                onto[k][i] = onto[i][k]
                onto[3 + i][3 + k] = onto[3 + i][3 + k] + M[i][k]
                onto[3 + k][3 + i] = onto[3 + i][3 + k]
    force = at.to_parent(load[3:])
    moment: Vector = add(at.to_parent(load[:3]), cross(r, force))
    for k in range(3):
        onto_load[k] = onto_load[k] + moment[k]
        onto_load[3 + k] = onto_load[3 + k] + force[k]
