"""The functions that the engine offers, each as a program: name -> arguments and outputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np

from ..compile.graph import Scalar
from ..compile.tape import Tape
from .derivatives import VJPS
from .forces import disabled, rotation_spring_energy, tendon_stretch
from .rigid import spatial
from .rigid.kinematics import body_pose, gravity_energy, kinetic_energy, link_poses, momentum
from .rigid.tree import BALL, FREE, HINGE, SLIDE, Pose
from .symbolic import STATE, Equations

FORMULATIONS = ("composite", "articulated")


def cheaper_formulation(eq: Equations) -> str:
    """The formulation of the forward dynamics with fewer operations."""
    tapes = {kind: eq.tape(STATE, {"a": eq.acceleration(kind)}) for kind in FORMULATIONS}
    return min(FORMULATIONS, key=lambda kind: tapes[kind].cost)


def _forward(eq: Equations, kind: str) -> Tape:
    return eq.tape(STATE, {"a": eq.acceleration(kind, eq.inputs["tau"])})


def _rate(eq: Equations, kind: str) -> Tape:
    return eq.tape("q v act u w p", {"dx": eq.rate(kind)})


def _inverse(eq: Equations, kind: str) -> Tape:
    return eq.tape("q v a w p", {"tau": eq.inverse(eq.inputs["a"])})


def _bias(eq: Equations, kind: str) -> Tape:
    nothing = [0.0] * eq.model.nv
    local = eq.inertial_local(nothing, [eq.gravity] * len(eq.tree.links))
    return eq.tape("q v w p", {"bias": eq.world(local)})


def drive_forces(eq: Equations, kind: str, tau: Sequence[Scalar] | None = None) -> list[Scalar]:
    """Forces that the keyed freedoms' drives must give, with the others moving as they do."""
    total = spatial.sub(eq.inverse(eq.acceleration(kind, tau)), eq.actuation[0])
    return [total[dof] for dof in eq.layout.v_keyed]


def _drive(eq: Equations, kind: str) -> Tape:
    return eq.tape(STATE, {"drive": drive_forces(eq, kind, eq.inputs["tau"])})


def _actuation(eq: Equations, kind: str) -> Tape:
    return eq.tape("q v act u w p", {"force": eq.actuation[0]})


def _mass_matrix(eq: Equations, kind: str) -> Tape:
    return eq.tape("q w p", {"M": eq.mass_matrix()})


def _energy(eq: Equations, kind: str) -> Tape:
    model = eq.model
    kinetic = kinetic_energy(eq.tree, eq.where, eq.v)
    for m, v in zip(eq.armature, eq.v, strict=True):
        kinetic = kinetic + 0.5 * m * (v * v)
    potential = gravity_energy(eq.tree, eq.where, eq.gravity)
    for body in range(1, model.nbody):
        if eq.tree.body_link[body] < 0:
            place = eq.tree.body_pose[body].apply(eq.fields.vector("body_ipos", body))
            potential = potential - eq.fields.scalar("body_mass", body) * spatial.dot(eq.gravity, place)
    if not disabled(model, "SPRING"):
        for joint in np.flatnonzero(np.isin(model.jnt_type, (HINGE, SLIDE))):
            at = int(model.jnt_qposadr[joint])
            stretch = eq.q[at] - eq.fields.scalar("qpos_spring", at)
            potential = potential + _spring_energy(eq.fields.polynomial("jnt_stiffness", int(joint)), stretch)
        for joint in np.flatnonzero(np.isin(model.jnt_type, (BALL, FREE))):
            potential = potential + rotation_spring_energy(eq.fields, int(joint), eq.q)
        for tendon in range(model.ntendon):
            coefficients = eq.fields.polynomial("tendon_stiffness", tendon)
            potential = potential + _spring_energy(coefficients, tendon_stretch(eq.fields, tendon, eq.q))
    return eq.tape("q v w p", {"kinetic": [kinetic], "potential": [potential]})


def _spring_energy(coefficients: Sequence[Scalar], x: Scalar) -> Scalar:
    """Integral of x (c0 + c1 x + c2 x^2 + ...)."""
    total: Scalar = 0.0
    power: Scalar = x * x
    for k, c in enumerate(coefficients):
        total = total + c * (1.0 / (k + 2)) * power
        power = power * x
    return total


def _momentum(eq: Equations, kind: str) -> Tape:
    linear, angular = momentum(eq.tree, eq.where, eq.v)
    return eq.tape("q v w p", {"linear": linear, "angular": angular})


def _poses(eq: Equations, kind: str) -> Tape:
    """Position and rotation of all bodies."""
    links = link_poses(eq.tree, eq.where)
    poses = [body_pose(eq.tree, links, body) for body in range(eq.model.nbody)]
    places = [x for pose in poses for x in pose.p]
    return eq.tape("q w p", {"p": places, "R": [x for pose in poses for row in pose.R for x in row]})


def _sites(eq: Equations, kind: str) -> Tape:
    """Position and rotation of all sites."""
    model, links, poses = eq.model, link_poses(eq.tree, eq.where), []
    for site in range(model.nsite):
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, model.site_quat[site])
        X = Pose(R.reshape(3, 3), [float(x) for x in model.site_pos[site]])
        poses.append(body_pose(eq.tree, links, int(model.site_bodyid[site])).carried(X))
    places = [x for pose in poses for x in pose.p]
    return eq.tape("q w p", {"p": places, "R": [x for pose in poses for row in pose.R for x in row]})


FUNCTIONS: Mapping[str, Callable[[Equations, str], Tape]] = {
    "forward": _forward,
    "rate": _rate,
    "inverse": _inverse,
    "bias": _bias,
    "drive": _drive,
    "actuation": _actuation,
    "mass_matrix": _mass_matrix,
    "energy": _energy,
    "momentum": _momentum,
    "poses": _poses,
    "sites": _sites,
    **VJPS,
}
