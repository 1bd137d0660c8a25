"""The functions that the engine offers, each as a program: name -> arguments and outputs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import mujoco
import numpy as np

from ..compile.diff import directional, gradient
from ..compile.graph import Node, Scalar
from ..compile.tape import Tape
from .forces import disabled, rotation_spring_energy, tendon_stretch
from .rigid import spatial
from .rigid.kinematics import body_pose, gravity_energy, kinetic_energy, link_poses, momentum
from .rigid.tree import BALL, FREE, HINGE, SLIDE, Pose
from .symbolic import Equations

STATE = "q v act u tau w p"
FORMULATIONS = ("composite", "articulated")


def cheaper_formulation(eq: Equations) -> str:
    """The formulation of the forward dynamics with fewer operations."""
    tapes = {kind: eq.tape(STATE, {"a": eq.acceleration(kind)}) for kind in FORMULATIONS}
    return min(FORMULATIONS, key=lambda kind: tapes[kind].cost)


def _forward(eq: Equations, kind: str) -> Tape:
    return eq.tape(STATE, {"a": eq.acceleration(kind, eq.inputs["tau"])})


def _rate_terms(eq: Equations, kind: str) -> list[Scalar]:
    return [*eq.coordinate_rate(), *eq.acceleration(kind), *eq.actuation[1]]


def _rate(eq: Equations, kind: str) -> Tape:
    return eq.tape("q v act u w p", {"dx": _rate_terms(eq, kind)})


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


class _Implicit:
    """Derivatives of the accelerations from those of the equations' residual with the accelerations held.

    r(a_local, s) = 0 gives d a_local = -M^-1 dr; the world sees d(R a_local) = R d a_local + dR a_local.
    """

    def __init__(self, eq: Equations, kind: str, tau: Sequence[Scalar]):
        self.eq, self.kind = eq, kind
        a_local = eq.acceleration_local(kind, tau)
        self.a = eq.seen(a_local)
        held = [eq.graph.hold(x) for x in a_local]
        self.residual, self.seen = eq.residual_local(held, tau), eq.seen(held)

    def along(self, seeds: Sequence[Mapping[Node, Scalar]]) -> list[list[Scalar]]:
        """Derivatives along `seeds`, one column each."""
        eq, out = self.eq, []
        turned = directional(self.seen, seeds)
        for column, turn in zip(directional(self.residual, seeds), turned, strict=True):
            solved = eq.free(eq.world(eq.factor.solve([-x for x in column])))
            out.append(spatial.add(solved, turn))
        return out

    def weighted(self, bar: Sequence[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Rows and weights whose weighted sum has the gradient of bar . a."""
        eq = self.eq
        solved = eq.solve_local(eq.local(eq.spread(bar)), self.kind)
        return [*self.residual, *self.seen], [*(-eq.graph.hold(x) for x in solved), *bar]


def _inverse_mass(eq: Equations) -> list[list[Scalar]]:
    """M^-1 over the state's freedoms; only one triangle is computed."""
    lay = eq.layout
    columns = []
    for k in range(lay.nv):
        unit = eq.spread([1.0 if i == k else 0.0 for i in range(lay.nv)])
        columns.append(eq.free(eq.world(eq.factor.solve(eq.local(unit)))))
    return [[columns[max(i, j)][min(i, j)] for j in range(lay.nv)] for i in range(lay.nv)]


def _rows(columns: list[list[Scalar]], height: int) -> list[Scalar]:
    """Row-major matrix of `columns`."""
    return [column[i] for i in range(height) for column in columns]


def _derivatives(eq: Equations, kind: str) -> Tape:
    """Of the accelerations by q (tangent), v and tau."""
    lay = eq.layout
    implicit = _Implicit(eq, "composite", eq.inputs["tau"])  # whose factor the columns need anyway
    by_q = implicit.along([eq.tangent(k) for k in range(lay.nv)])
    by_v = implicit.along([{x: 1.0} for x in eq.inputs["v"]])
    outputs = {"a": implicit.a, "dq": _rows(by_q, lay.nv), "dv": _rows(by_v, lay.nv)}
    return eq.tape(STATE, outputs | {"dtau": [x for row in _inverse_mass(eq) for x in row]})


def _control_derivatives(eq: Equations, kind: str) -> Tape:
    """Of the accelerations by activations, controls and parameters."""
    lay = eq.layout
    implicit = _Implicit(eq, "composite", eq.inputs["tau"])
    outputs = {}
    for name in ("act", "u", "p"):
        columns = implicit.along([{x: 1.0} for x in eq.inputs[name]])
        outputs["d" + name] = _rows(columns, lay.nv)
    return eq.tape(STATE, outputs)


def _rate_jacobian(eq: Equations, kind: str) -> Tape:
    """Of dx/dt by x (plain coordinates, quaternions included), u and p."""
    zero: list[Scalar] = [0.0] * eq.layout.nv
    implicit = _Implicit(eq, "composite", zero)
    outputs = {"rate": _rate_terms(eq, "composite")}
    kinematic, activation = eq.coordinate_rate(), eq.actuation[1]
    for name, keys in (("x", ("q", "v", "act")), ("u", ("u",)), ("p", ("p",))):
        seeds = [{node: 1.0} for key in keys for node in eq.inputs[key]]
        q_part, act_part = directional(kinematic, seeds), directional(activation, seeds)
        columns = [[*q, *a, *s] for q, a, s in zip(q_part, implicit.along(seeds), act_part, strict=True)]
        outputs["d" + name] = _rows(columns, eq.layout.nx)
    return eq.tape("q v act u w p", outputs)


def _pulled_back(eq: Equations, by_q: Sequence[Scalar]) -> list[Scalar]:
    """Gradient by q in the tangent space."""
    place = {node: k for k, node in enumerate(eq.inputs["q"])}
    return [
        spatial.dot(list(seed.values()), [by_q[place[node]] for node in seed])
        for seed in (eq.tangent(k) for k in range(eq.layout.nv))
    ]


def _vjp(eq: Equations, kind: str) -> Tape:
    """bar . d(accelerations): by q (tangent), v, act, u, tau and p."""
    bar = eq.inputs["bar"][: eq.layout.nv]
    rows, weights = _Implicit(eq, kind, eq.inputs["tau"]).weighted(bar)
    names = ("q", "v", "act", "u", "tau", "p")
    by = _gradients(eq, rows, weights, names)
    return eq.tape(STATE + " bar", {"q": _pulled_back(eq, by["q"])} | {n: by[n] for n in names[1:]})


def _rate_vjp(eq: Equations, kind: str) -> Tape:
    """bar . d(dx/dt): by x (plain coordinates), u and p."""
    lay, bar = eq.layout, eq.inputs["bar"]
    zero: list[Scalar] = [0.0] * lay.nv
    rows, weights = _Implicit(eq, kind, zero).weighted(bar[lay.nq : lay.nq + lay.nv])
    rows = [*eq.coordinate_rate(), *rows, *eq.actuation[1]]
    by = _gradients(
        eq, rows, [*bar[: lay.nq], *weights, *bar[lay.nq + lay.nv : lay.nx]], ("q", "v", "act", "u", "p")
    )
    outputs = {"x": by["q"] + by["v"] + by["act"], "u": by["u"], "p": by["p"]}
    return eq.tape("q v act u w p bar", outputs, bar="x")


def _gradients(
    eq: Equations, rows: Sequence[Scalar], weights: Sequence[Scalar], names: Sequence[str]
) -> dict[str, list[Scalar]]:
    flat = gradient(rows, weights, [node for name in names for node in eq.inputs[name]])
    out, at = {}, 0
    for name in names:
        size = len(eq.inputs[name])
        out[name] = flat[at : at + size]
        at += size
    return out


FUNCTIONS: dict[str, Callable[[Equations, str], Tape]] = {
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
    "derivatives": _derivatives,
    "control_derivatives": _control_derivatives,
    "rate_jacobian": _rate_jacobian,
    "vjp": _vjp,
    "rate_vjp": _rate_vjp,
}
