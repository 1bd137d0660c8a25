"""Poses, velocities, energies and momenta of a tree, over generic scalars."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from ...compile.graph import Scalar
from . import spatial
from .motion import Transform
from .spatial import Matrix, Vector
from .tree import FREE, HINGE, SLIDE, Pose, Tree


@dataclass(frozen=True)
class WorldPose:
    """Rotation and position of a frame in the world."""

    R: Matrix
    p: Vector

    def carried(self, X: Pose) -> WorldPose:
        """Pose of a frame fixed at `X` in this one."""
        R = spatial.product(self.R, [[float(x) for x in row] for row in X.R])
        return WorldPose(R, spatial.add(self.p, spatial.times(self.R, X.p)))


def link_poses(tree: Tree, where: Sequence[Transform]) -> list[WorldPose]:
    """World poses of all links."""
    out: list[WorldPose] = []
    for link, at in zip(tree.links, where, strict=True):
        if link.parent < 0:
            base = WorldPose([[1.0 if i == j else 0.0 for j in range(3)] for i in range(3)], spatial.zeros())
        else:
            base = out[link.parent]
        R = [at.to_child(row) for row in base.R]  # a row of R_WP R_PL is R_PL^T applied to a row of R_WP
        out.append(WorldPose(R, spatial.add(base.p, spatial.times(base.R, at.r))))
    return out


def body_pose(tree: Tree, poses: Sequence[WorldPose], body: int) -> WorldPose:
    """World pose of a body."""
    link, X = tree.body_link[body], tree.body_pose[body]
    if link < 0:
        return WorldPose([[float(x) for x in row] for row in X.R], X.p)
    return poses[link].carried(X)


def directions_in_links(tree: Tree, where: Sequence[Transform], direction: Vector) -> list[Vector]:
    """A world vector in every link's frame."""
    out: list[Vector] = []
    for link, at in zip(tree.links, where, strict=True):
        out.append(at.to_child(direction if link.parent < 0 else out[link.parent]))
    return out


def velocities(tree: Tree, where: Sequence[Transform], v: Sequence[Scalar]) -> list[tuple[Vector, Vector]]:
    """Angular velocity of every link and velocity of its origin, in its frame (v as in the model)."""
    out: list[tuple[Vector, Vector]] = []
    for link, at in zip(tree.links, where, strict=True):
        w, lin = out[link.parent] if link.parent >= 0 else (spatial.zeros(), spatial.zeros())
        lin = at.to_child(spatial.add(lin, spatial.cross(w, at.r)))
        w, i = at.to_child(w), link.dadr
        if link.kind == HINGE:
            w = [w[0], w[1], w[2] + v[i]]
        elif link.kind == SLIDE:
            lin = spatial.add(lin, spatial.scale(v[i], link.axis))
        elif link.kind == FREE:
            w, lin = spatial.add(w, v[i + 3 : i + 6]), spatial.add(lin, at.to_child(v[i : i + 3]))
        else:
            w = spatial.add(w, v[i : i + 3])
        out.append((w, lin))
    return out


def kinetic_energy(tree: Tree, where: Sequence[Transform], v: Sequence[Scalar]) -> Scalar:
    """Energy of motion of all matter (without armature) [J]."""
    total: Scalar = 0.0
    for link, (w, lin) in zip(tree.links, velocities(tree, where, v), strict=True):
        body = link.inertia
        turning = spatial.dot(w, spatial.times(body.rotational(), w))
        total = total + 0.5 * (body.m * spatial.dot(lin, lin) + turning)
        total = total + spatial.dot(lin, spatial.cross(w, body.h))
    return total


def gravity_energy(tree: Tree, where: Sequence[Transform], gravity: Vector) -> Scalar:
    """-sum m g . c over all moving matter [J]."""
    total: Scalar = 0.0
    for link, pose in zip(tree.links, link_poses(tree, where), strict=True):
        lever = spatial.add(spatial.scale(link.inertia.m, pose.p), spatial.times(pose.R, link.inertia.h))
        total = total - spatial.dot(gravity, lever)
    return total


def momentum(tree: Tree, where: Sequence[Transform], v: Sequence[Scalar]) -> tuple[Vector, Vector]:
    """Linear momentum [kg m/s] and angular momentum about the world's origin [kg m^2/s]."""
    linear, angular = spatial.zeros(), spatial.zeros()
    poses = link_poses(tree, where)
    for link, pose, (w, lin) in zip(tree.links, poses, velocities(tree, where, v), strict=True):
        body = link.inertia
        P = spatial.add(spatial.scale(body.m, lin), spatial.cross(w, body.h))
        L = spatial.add(spatial.times(body.rotational(), w), spatial.cross(body.h, lin))
        P, L = spatial.times(pose.R, P), spatial.times(pose.R, L)
        linear = spatial.add(linear, P)
        angular = spatial.add(angular, spatial.add(L, spatial.cross(pose.p, P)))
    return linear, angular
