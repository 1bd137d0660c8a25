"""Wrenches on bodies from outside: gravity compensation, drag in the inertia-box model, given ones.

Formulas: MuJoCo's documentation, chapter Fluid forces, "Inertia model".
"""

from __future__ import annotations

from collections.abc import Sequence
from math import pi

import mujoco
import numpy as np

from ..compile.graph import Scalar, absolute
from .fields import Fields
from .rigid import spatial
from .rigid.kinematics import directions_in_links, velocities
from .rigid.motion import Transform
from .rigid.newton_euler import Wrench
from .rigid.spatial import Vector
from .rigid.tree import Pose, Tree


def applied_wrenches(
    fields: Fields,
    tree: Tree,
    where: Sequence[Transform],
    v: Sequence[Scalar],
    gravity: Vector,
) -> list[Wrench | None]:
    """Wrench on every link about its origin, in its frame; None where nothing acts."""
    model = fields.model
    out: list[Wrench | None] = [None] * len(tree.links)
    if model.ngravcomp and any(gravity):
        _compensate(fields, tree, where, gravity, out)
    if model.opt.viscosity > 0 or model.opt.density > 0:
        _drag(fields, tree, where, v, out)
    return out


def _push(out: list[Wrench | None], index: int, F: Vector, N: Vector) -> None:
    before = out[index] or (spatial.zeros(), spatial.zeros())
    out[index] = spatial.add(before[0], F), spatial.add(before[1], N)


def push_body(
    fields: Fields,
    tree: Tree,
    where: Sequence[Transform],
    body: int,
    force: Sequence[Scalar],
    torque: Sequence[Scalar],
    out: list[Wrench | None],
    *,
    own_frame: bool,
) -> None:
    """Add a force at a body's centre of mass and a torque, in the body's own frame or the world's."""
    index = tree.body_link[body]
    if index < 0:
        return  # it stands still
    X_LB = tree.links[index].bodies[body]
    if own_frame:
        turn = Pose(X_LB.R, spatial.zeros())
        F, N = turn.apply(list(force)), turn.apply(list(torque))
    else:
        F, N = (directions_in_links(tree, where, list(part))[index] for part in (force, torque))
    arm = X_LB.apply(fields.vector("body_ipos", body))
    _push(out, index, F, spatial.add(N, spatial.cross(arm, F)))


def _compensate(
    fields: Fields, tree: Tree, where: Sequence[Transform], gravity: Vector, out: list[Wrench | None]
) -> None:
    fall = directions_in_links(tree, where, gravity)
    for index, link in enumerate(tree.links):
        for body, X_LB in link.bodies.items():
            share = float(fields.model.body_gravcomp[body])
            if share:
                F = spatial.scale(fields.scalar("body_mass", body) * -share, fall[index])
                _push(out, index, F, spatial.cross(X_LB.apply(fields.vector("body_ipos", body)), F))


def _drag(
    fields: Fields, tree: Tree, where: Sequence[Transform], v: Sequence[Scalar], out: list[Wrench | None]
) -> None:
    model = fields.model
    wind = directions_in_links(tree, where, [float(x) for x in model.opt.wind])
    for index, (w, lin) in enumerate(velocities(tree, where, v)):
        for body, X_LB in tree.links[index].bodies.items():
            if model.body_mass[body] < mujoco.mjMINVAL:
                continue
            R = np.zeros(9)
            mujoco.mju_quat2Mat(R, model.body_iquat[body])
            X_LI = Pose(X_LB.R @ R.reshape(3, 3), X_LB.apply(fields.vector("body_ipos", body)))
            there = Pose(X_LI.R.T, spatial.zeros())
            moving = spatial.sub(spatial.add(lin, spatial.cross(w, X_LI.p)), wind[index])
            F, N = _box_drag(model, body, there.apply(w), there.apply(moving))
            back = Pose(X_LI.R, spatial.zeros())
            F, N = back.apply(F), back.apply(N)
            _push(out, index, F, spatial.add(N, spatial.cross(X_LI.p, F)))


def _box_drag(model: mujoco.MjModel, body: int, w: Vector, u: Vector) -> Wrench:
    """Force and moment on the equivalent inertia box turning at `w`, moving at `u` through the fluid."""
    inertia, mass = model.body_inertia[body], model.body_mass[body]
    excess = np.maximum(mujoco.mjMINVAL, inertia.sum() - 2.0 * inertia)
    box = [float(x) for x in np.sqrt(excess / mass * 6.0)]
    rho, beta = float(model.opt.density), float(model.opt.viscosity)
    diameter = sum(box) / 3.0
    F = spatial.scale(-3.0 * pi * diameter * beta, u)
    N = spatial.scale(-pi * diameter**3 * beta, w)
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        F[i] = F[i] - 0.5 * rho * box[j] * box[k] * (absolute(u[i]) * u[i])
        N[i] = N[i] - rho * box[i] * (box[j] ** 4 + box[k] ** 4) / 64.0 * (absolute(w[i]) * w[i])
    return F, N
