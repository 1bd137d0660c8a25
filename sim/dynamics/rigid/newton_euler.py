"""Inverse dynamics by the recursive Newton-Euler scheme in link frames.

The velocity-dependent tensor U = [alpha] + w w^T - |w|^2 1 of a link gives the acceleration of any of its
points by one product, and with the second moment J the rate of angular momentum: N = vee(U J - (U J)^T)
(Balafoutis & Patel, Dynamic Analysis of Robot Manipulators, 1991, ch. 4-5).
"""

from __future__ import annotations

from collections.abc import Sequence

from ...compile.graph import Scalar
from .motion import Transform
from .spatial import Matrix, Vector, add, cross, dot, scale, sub, zeros
from .tree import BALL, FREE, HINGE, SLIDE, Link, Tree

Wrench = tuple[Vector, Vector]  # force, moment about the link's origin; both in the link's frame


def generalized_forces(
    tree: Tree,
    where: Sequence[Transform],
    v: Sequence[Scalar],
    a: Sequence[Scalar],
    gravity: Sequence[Vector],
    applied: Sequence[Wrench | None],
    nv: int,
) -> list[Scalar]:
    """Forces of the joints for velocity `v` and acceleration `a`: M a + c - (gravity and `applied` wrenches).

    `gravity` is given per link's root; the linear part of a free joint (its v, a and force) is taken in the
    link's frame here, not in the world's.
    """
    U: list[Matrix] = []
    acc: list[Vector] = []
    spin: list[tuple[Vector, Vector]] = []
    for index, (link, at) in enumerate(zip(tree.links, where, strict=True)):
        if link.parent < 0:
            w0, al0, lin = zeros(), zeros(), scale(-1.0, gravity[index])
        else:
            w0, al0 = spin[link.parent]
            lin = add(acc[link.parent], [dot(row, at.r) for row in U[link.parent]])
        w, al, lin = _step(link, at.to_child(w0), at.to_child(al0), at.to_child(lin), v, a)
        spin.append((w, al))
        acc.append(lin)
        U.append(_tensor(w, al))
    tau: list[Scalar] = [0.0] * nv
    forces = [zeros() for _ in tree.links]
    moments = [zeros() for _ in tree.links]
    for index in reversed(range(len(tree.links))):
        link, at = tree.links[index], where[index]
        F, N = _rate_of_momentum(link, U[index], acc[index])
        F, N = add(F, forces[index]), add(N, moments[index])
        extra = applied[index]
        if extra is not None:
            F, N = sub(F, extra[0]), sub(N, extra[1])
        for k, value in enumerate(joint_components(link, F, N)):
            tau[link.dadr + k] = value
        if link.parent >= 0:
            f = at.to_parent(F)
            forces[link.parent] = add(forces[link.parent], f)
            moments[link.parent] = add(moments[link.parent], add(at.to_parent(N), cross(at.r, f)))
    return tau


def joint_components(link: Link, F: Vector, N: Vector) -> list[Scalar]:
    """What a joint must hold of the wrench (F, N) about its link's origin."""
    if link.kind == HINGE:
        return [N[2]]
    if link.kind == SLIDE:
        return [dot(link.axis, F)]
    return list(N) if link.kind == BALL else [*F, *N]


def _step(
    link: Link, w: Vector, al: Vector, lin: Vector, v: Sequence[Scalar], a: Sequence[Scalar]
) -> tuple[Vector, Vector, Vector]:
    """Velocity and accelerations behind a joint, from those before it in the link's frame."""
    i = link.dadr
    if link.kind == HINGE:
        rate = v[i]
        turned = [al[0] + w[1] * rate, al[1] - w[0] * rate, al[2] + a[i]]
        return [w[0], w[1], w[2] + rate], turned, lin
    if link.kind == SLIDE:
        coriolis = cross(scale(2.0, w), scale(v[i], link.axis))
        return w, al, add(add(lin, coriolis), scale(a[i], link.axis))
    k = i + 3 if link.kind == FREE else i
    rate3, turn3 = list(v[k : k + 3]), list(a[k : k + 3])
    al = add(add(al, cross(w, rate3)), turn3)
    return add(w, rate3), al, (add(lin, a[i : i + 3]) if link.kind == FREE else lin)


def _tensor(w: Vector, al: Vector) -> Matrix:
    xx, yy, zz = w[0] * w[0], w[1] * w[1], w[2] * w[2]
    xy, xz, yz = w[0] * w[1], w[0] * w[2], w[1] * w[2]
    return [
        [-(yy + zz), xy - al[2], xz + al[1]],
        [xy + al[2], -(xx + zz), yz - al[0]],
        [xz - al[1], yz + al[0], -(xx + yy)],
    ]


def _rate_of_momentum(link: Link, U: Matrix, acc: Vector) -> Wrench:
    m, h, J = link.regrouped.m, link.regrouped.h, link.regrouped.J

    def entry(i: int, j: int) -> Scalar:
        return dot(U[i], [J[k][j] for k in range(3)])

    F = add(scale(m, acc), [dot(row, h) for row in U])
    N = [entry(2, 1) - entry(1, 2), entry(0, 2) - entry(2, 0), entry(1, 0) - entry(0, 1)]
    return F, add(N, cross(h, acc))
