"""The joint-space inertia matrix by composite bodies, and its branch-sparse factor.

Featherstone, Rigid Body Dynamics Algorithms (2008), ch. 6: the composite-rigid-body algorithm and the
factorization M = L^T D L, which fills nothing outside the branches of the tree.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ...compile.graph import Scalar
from ..fields import Fields
from .motion import Transform
from .newton_euler import joint_components
from .spatial import Vector, add, cross, scale, zeros
from .tree import FREE, HINGE, SLIDE, Inertia, Link, Tree

Entries = dict[tuple[int, int], Scalar]  # lower triangle, by (row, column) with row >= column


def _unit(k: int) -> Vector:
    return [1.0 if i == k else 0.0 for i in range(3)]


def _columns(link: Link, composite: Inertia) -> list[tuple[Vector, Vector]]:
    """Wrench that accelerates a composite body by one unit along each freedom of its joint."""
    m, h, moments = composite.m, composite.h, composite.rotational()

    def turning(k: int) -> tuple[Vector, Vector]:
        return cross(_unit(k), h), [moments[i][k] for i in range(3)]

    if link.kind == HINGE:
        return [turning(2)]
    if link.kind == SLIDE:
        return [(scale(m, link.axis), cross(h, link.axis))]
    angular = [turning(k) for k in range(3)]
    if link.kind == FREE:
        return [(scale(m, _unit(k)), cross(h, _unit(k))) for k in range(3)] + angular
    return angular


def mass_matrix(tree: Tree, where: Sequence[Transform], fields: Fields, skip: Collection[int]) -> Entries:
    """Entries of the inertia matrix that the tree does not force to zero, without the dofs in `skip`.

    The linear freedoms of a free joint are taken in the link's frame.
    """
    composite = [link.regrouped for link in tree.links]
    M: Entries = {}
    for index in reversed(range(len(tree.links))):
        link, at = tree.links[index], where[index]
        if link.dadr not in skip:
            for k, (F, N) in enumerate(_columns(link, composite[index])):
                row = link.dadr + k
                for j, value in enumerate(joint_components(link, F, N)[: k + 1]):
                    M[row, link.dadr + j] = value + (fields.armature(row) if j == k else 0.0)
                _walk_down(tree, where, index, row, F, N, M, skip)
        if link.parent >= 0:
            composite[link.parent] = composite[link.parent] + _carried(composite[index], at)
    return M


def _walk_down(
    tree: Tree,
    where: Sequence[Transform],
    index: int,
    row: int,
    F: Vector,
    N: Vector,
    M: Entries,
    skip: Collection[int],
) -> None:
    """Entries of `row` with the freedoms of all links that carry link `index`."""
    while tree.links[index].parent >= 0:
        at = where[index]
        F = at.to_parent(F)
        N = add(at.to_parent(N), cross(at.r, F))
        index = tree.links[index].parent
        link = tree.links[index]
        if link.dadr not in skip:
            for j, value in enumerate(joint_components(link, F, N)):
                M[row, link.dadr + j] = value


def _carried(body: Inertia, at: Transform) -> Inertia:
    """A composite body seen from the parent's frame: J' = R J R^T + (R h + m r) r^T + r (R h)^T."""
    h, J, r = at.to_parent(body.h), at.symmetric(body.J), at.r
    whole = add(h, scale(body.m, r))
    out = [zeros() for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            out[i][j] = out[j][i] = J[i][j] + r[i] * h[j] + whole[i] * r[j]
    return Inertia(body.m, whole, out)


def dof_parents(tree: Tree, nv: int, skip: Collection[int]) -> list[int]:
    """For every freedom the next one towards the root that is not in `skip` (-1: none)."""
    parents, last = [-1] * nv, {-1: -1}
    for index, link in enumerate(tree.links):
        below = last[link.parent]
        if link.dadr not in skip:
            for k in range(link.ndof):
                parents[link.dadr + k], below = below, link.dadr + k
        last[index] = below
    return parents


@dataclass(frozen=True)
class Factor:
    """M = L^T D L over the freedoms of a tree; solves M x = b."""

    parents: list[int]
    L: Entries
    inverse_D: dict[int, Scalar]

    @staticmethod
    def of(M: Entries, parents: list[int], dofs: Sequence[int]) -> Factor:
        """Factor of `M` (Featherstone 2008, table 6.3)."""
        H, L, inverse_D = dict(M), {}, {}
        for k in reversed(dofs):
            inverse_D[k] = 1.0 / H[k, k]
            i = parents[k]
            while i >= 0:
                entry = H.get((k, i), 0.0)
                if hasattr(entry, "op") or entry != 0.0:
                    L[k, i] = factor = entry * inverse_D[k]
                    j = i
                    while j >= 0:
                        if (k, j) in H:
                            H[i, j] = H.get((i, j), 0.0) - factor * H[k, j]
                        j = parents[j]
                i = parents[i]
        return Factor(parents, L, inverse_D)

    def solve(self, b: Sequence[Scalar]) -> list[Scalar]:
        """x with M x = b; entries of skipped freedoms stay zero."""
        x = [b[i] if i in self.inverse_D else 0.0 for i in range(len(b))]
        for i in sorted(self.inverse_D, reverse=True):
            j = self.parents[i]
            while j >= 0:
                if (i, j) in self.L:
                    x[j] = x[j] - self.L[i, j] * x[i]
                j = self.parents[j]
        for i, d in self.inverse_D.items():
            x[i] = x[i] * d
        for i in sorted(self.inverse_D):
            j = self.parents[i]
            while j >= 0:
                if (i, j) in self.L:
                    x[i] = x[i] - self.L[i, j] * x[j]
                j = self.parents[j]
        return x


def multiply(M: Entries, x: Sequence[Scalar]) -> list[Scalar]:
    """M x."""
    out: list[Scalar] = [0.0] * len(x)
    for (i, j), value in M.items():
        out[i] = out[i] + value * x[j]
        if i != j:
            out[j] = out[j] + value * x[i]
    return out


def dense(M: Entries, dofs: Sequence[int]) -> list[Scalar]:
    """Row-major full matrix over `dofs`."""
    return [M.get((max(i, j), min(i, j)), 0.0) for i in dofs for j in dofs]
