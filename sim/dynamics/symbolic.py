"""A scene's equations of motion as expressions: built once per model and roles, read out piece by piece."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cached_property
from typing import Any

import mujoco

from ..compile.graph import Graph, Node, Scalar
from ..compile.tape import Tape
from ..errors import EngineError
from .fields import Fields, Parameter, parameter_index
from .fluid import applied_wrenches, push_body
from .forces import actuator_forces, disabled, passive_forces
from .layout import Layout
from .limbs import limbs
from .rigid import spatial
from .rigid.articulated import articulated_solve
from .rigid.mass_matrix import Entries, Factor, dense, dof_parents, mass_matrix
from .rigid.motion import transforms
from .rigid.newton_euler import generalized_forces
from .rigid.tree import BALL, FREE, Link, build_tree
from .support import unsupported

STATE = "q v act u tau w p"


class Equations:
    """Expressions of one model under given roles.

    `layout` says which joints are state and which are prescribed, `parameters` are model entries that become
    inputs, `friction_width` is the speed [rad/s or m/s] below which dry friction is smoothed (None leaves dry
    friction out). `given` are expressions of another `graph` in place of the arguments q, v, ...; those that
    are missing are zero. Raises EngineError naming everything in the model that is not supported.

    Vectors over freedoms are in the model's convention (linear parts of free joints in the world frame)
    unless a name says `local` (in the link's frame).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        layout: Layout,
        *,
        parameters: Sequence[Parameter] = (),
        friction_width: float | None = None,
        graph: Graph | None = None,
        given: Mapping[str, Sequence[Scalar]] | None = None,
    ):
        problems = unsupported(model, keyed=layout.keyed)
        if problems:
            raise EngineError("the smooth engine cannot do:\n  " + "\n  ".join(problems))
        self.model, self.layout, self.friction_width = model, layout, friction_width
        sizes = {"q": layout.nq, "v": layout.nv, "act": layout.na, "u": layout.nu, "tau": layout.nv}
        sizes |= {"a": layout.nv, "w": layout.nw, "p": len(parameters), "bar": max(layout.nx, layout.nv)}
        self.graph = graph or Graph()
        self.inputs: dict[str, Sequence[Any]] = {  # nodes; what is given may be numbers
            name: self.graph.inputs(name, size) if given is None else given.get(name, [0.0] * size)
            for name, size in sizes.items()
        }
        symbols = [parameter_index(model, key) for key in parameters]
        self.fields = Fields(model, dict(zip(symbols, self.inputs["p"], strict=True)))
        self.tree = build_tree(self.fields)
        self.q, self.v, self.prescribed = self._model_coordinates()
        self.where = transforms(self.tree, self.q)
        self.skip = frozenset(layout.v_keyed)
        self.gravity: list[Scalar] = [0.0] * 3
        if not disabled(model, "GRAVITY"):
            self.gravity = [float(g) for g in model.opt.gravity]
        # a tree that floats freely falls with gravity: solved without it, which its base is given afterwards
        self.falling = [link.dadr for link in self.tree.links if self._falls(link)]
        falls = {index: link.dadr in self.falling for index, link in enumerate(self.tree.links)}
        self._felt = [spatial.zeros() if falls[i] else self.gravity for i in range(len(self.tree.links))]

    def _falls(self, link: Link) -> bool:
        if link.kind != FREE or link.dadr in self.skip:
            return False
        return all(not isinstance(x, Node) and x == 0.0 for x in self.armature[link.dadr : link.dadr + 3])

    @cached_property
    def armature(self) -> list[Scalar]:
        """Rotor inertia of every freedom."""
        return [self.fields.armature(dof) for dof in range(self.model.nv)]

    def _model_coordinates(self) -> tuple[list[Scalar], list[Scalar], list[Scalar]]:
        """qpos, qvel and prescribed accelerations of the whole model."""
        lay, w = self.layout, self.inputs["w"]
        q: list[Scalar] = [0.0] * self.model.nq
        v: list[Scalar] = [0.0] * self.model.nv
        a: list[Scalar] = [0.0] * self.model.nv
        nqk, nvk = len(lay.q_keyed), len(lay.v_keyed)
        for target, addresses, source in (
            (q, lay.q_free, self.inputs["q"]),
            (v, lay.v_free, self.inputs["v"]),
            (q, lay.q_keyed, w[:nqk]),
            (v, lay.v_keyed, w[nqk : nqk + nvk]),
            (a, lay.v_keyed, w[nqk + nvk : nqk + 2 * nvk]),
        ):
            for address, node in zip(addresses, source, strict=True):
                target[address] = node
        return q, v, a

    def local(self, world: Sequence[Scalar]) -> list[Scalar]:
        """A vector over freedoms with the linear parts of free joints turned into their links' frames."""
        return self._turned(world, to_world=False)

    def world(self, local: Sequence[Scalar]) -> list[Scalar]:
        """Inverse of `local`."""
        return self._turned(local, to_world=True)

    def _turned(self, vector: Sequence[Scalar], *, to_world: bool) -> list[Scalar]:
        out = list(vector)
        for link, at in zip(self.tree.links, self.where, strict=True):
            if link.kind == FREE:
                part = out[link.dadr : link.dadr + 3]
                out[link.dadr : link.dadr + 3] = at.to_parent(part) if to_world else at.to_child(part)
        return out

    def spread(self, free: Sequence[Scalar]) -> list[Scalar]:
        """Values of the state's freedoms, zero for the others, in the model's order."""
        out: list[Scalar] = [0.0] * self.model.nv
        for dof, x in zip(self.layout.v_free, free, strict=True):
            out[dof] = x
        return out

    def free(self, vector: Sequence[Scalar]) -> list[Scalar]:
        """The entries of the state's freedoms."""
        return [vector[dof] for dof in self.layout.v_free]

    @cached_property
    def passive(self) -> list[Scalar]:
        """Springs, dampers and dry friction."""
        return passive_forces(self.fields, self.q, self.v, self.friction_width)

    @cached_property
    def actuation(self) -> tuple[list[Scalar], list[Scalar]]:
        """Generalized forces of the actuators, and rates of their activations."""
        lay, u, w = self.layout, self.inputs["u"], self.inputs["w"]
        ctrl: list[Scalar] = [0.0] * self.model.nu
        for actuator, node in zip(lay.u_held, u, strict=False):
            ctrl[actuator] = node
        for actuator, node in zip(lay.timed, w[lay.w_timed : lay.w_wrenches], strict=True):
            ctrl[actuator] = node
        return actuator_forces(self.fields, self.q, self.v, self.inputs["act"], ctrl)

    def driving(self, tau: Sequence[Scalar] | None = None) -> list[Scalar]:
        """Passive, actuator and applied (`tau`, over the state's freedoms) forces."""
        total = spatial.add(self.passive, self.actuation[0])
        if self.layout.forces:
            total = spatial.add(total, self.spread(self.inputs["u"][len(self.layout.u_held) :]))
        return total if tau is None else spatial.add(total, self.spread(tau))

    @cached_property
    def _wrenches(self) -> list[tuple[spatial.Vector, spatial.Vector] | None]:
        out = applied_wrenches(self.fields, self.tree, self.where, self.v, self.gravity)
        for k, (body, own_frame) in enumerate(self.layout.wrenches):
            first = self.layout.w_wrenches + 6 * k
            part = self.inputs["w"][first : first + 6]
            push_body(self.fields, self.tree, self.where, body, part[:3], part[3:], out, own_frame=own_frame)
        return out

    def inertial_local(self, a: Sequence[Scalar], gravity: Sequence[spatial.Vector]) -> list[Scalar]:
        """Rigid-body forces at the local accelerations `a` of all freedoms, without armature."""
        return generalized_forces(self.tree, self.where, self.v, a, gravity, self._wrenches, self.model.nv)

    @cached_property
    def mass_local(self) -> Entries:
        """Inertia matrix over the state's freedoms."""
        return mass_matrix(self.tree, self.where, self.fields, self.skip)

    @cached_property
    def factor(self) -> Factor:
        """Factor of `mass_local`."""
        return Factor.of(
            self.mass_local, dof_parents(self.tree, self.model.nv, self.skip), self.layout.v_free
        )

    def solve_local(self, b: Sequence[Scalar], formulation: str) -> list[Scalar]:
        """x with M x = b over the state's freedoms, in the model's order."""
        if formulation == "composite":
            return self.factor.solve(b)
        return articulated_solve(self.tree, self.where, self.fields, b, self.skip)

    def acceleration(self, formulation: str, tau: Sequence[Scalar] | None = None) -> list[Scalar]:
        """Accelerations of the state's freedoms under actuators, passive forces and `tau`."""
        return self.seen(self.acceleration_local(formulation, tau))

    def acceleration_local(self, formulation: str, tau: Sequence[Scalar] | None) -> list[Scalar]:
        """Accelerations of all freedoms that do not come from falling (zero for the keyed ones)."""
        bias = self.inertial_local(self.local(self.prescribed), self._felt)
        return self.solve_local(spatial.sub(self.local(self.driving(tau)), bias), formulation)

    def seen(self, a_local: Sequence[Scalar]) -> list[Scalar]:
        """What the world sees of local accelerations, falling included, over the state's freedoms."""
        out = self.world(a_local)
        for dof in self.falling:
            out[dof : dof + 3] = spatial.add(out[dof : dof + 3], self.gravity)
        return self.free(out)

    def residual_local(self, a_local: Sequence[Scalar], tau: Sequence[Scalar]) -> list[Scalar]:
        """M a + c - forces, which vanishes at the local accelerations of the solution.

        Its derivative by anything, times -M^-1, is that of `acceleration_local`.
        """
        full = spatial.add(a_local, self.local(self.prescribed))
        inertial = self.inertial_local(full, self._felt)
        rotors = [m * x for m, x in zip(self.armature, full, strict=True)]
        return spatial.sub(spatial.add(inertial, rotors), self.local(self.driving(tau)))

    def coordinate_rate(self) -> list[Scalar]:
        """dq/dt of the state's coordinates."""
        q, v = self.inputs["q"], self.inputs["v"]
        out: list[Scalar] = []
        for kind, at, dof in self.layout.blocks:
            if kind == FREE:
                out += v[dof : dof + 3]
                at, dof = at + 3, dof + 3
            if kind in (FREE, BALL):
                out += spatial.quaternion_rate(q[at : at + 4], v[dof : dof + 3])
            else:
                out.append(v[dof])
        return out

    def rate(self, formulation: str) -> list[Scalar]:
        """d(q, v, act)/dt."""
        return [*self.coordinate_rate(), *self.acceleration(formulation), *self.actuation[1]]

    def inverse(self, a: Sequence[Scalar]) -> list[Scalar]:
        """Forces on all freedoms, beside passive ones, that produce `a` (state) and the prescribed motion."""
        full = spatial.add(self.spread(a), self.prescribed)
        inertial = self.inertial_local(self.local(full), [self.gravity] * len(self.tree.links))
        rotors = [m * x for m, x in zip(self.armature, full, strict=True)]
        return spatial.sub(spatial.add(self.world(inertial), rotors), self.passive)

    def mass_matrix(self) -> list[Scalar]:
        """The inertia matrix over the state's freedoms, row-major."""
        M = dict(self.mass_local)
        for link, at in zip(self.tree.links, self.where, strict=True):
            if link.kind == FREE and link.dadr not in self.skip:
                first = link.dadr
                block = [
                    [M[max(i, j), min(i, j)] for j in range(first, first + 3)]
                    for i in range(first, first + 3)
                ]
                block = at.symmetric(block)
                for row in sorted({i for i, j in M if j == first and i >= first + 3}):
                    turned = at.to_parent([M[row, first + k] for k in range(3)])
                    M.update({(row, first + k): x for k, x in enumerate(turned)})
                M.update({(first + i, first + j): block[i][j] for i in range(3) for j in range(i + 1)})
        return dense(M, self.layout.v_free)

    def tangent(self, index: int) -> dict[Node, Scalar]:
        """Change of the state's q along its freedom `index` (MuJoCo's tangent: body frame for rotations)."""
        q = self.inputs["q"]
        for kind, at, dof in self.layout.blocks:
            size = {FREE: 6, BALL: 3}.get(kind, 1)
            if not dof <= index < dof + size:
                continue
            k = index - dof
            if kind not in (FREE, BALL):
                return {q[at]: 1.0}
            if kind == FREE:
                if k < 3:
                    return {q[at + k]: 1.0}
                at, k = at + 3, k - 3
            turning = spatial.quaternion_rate(q[at : at + 4], [1.0 if i == k else 0.0 for i in range(3)])
            return dict(zip(q[at : at + 4], turning, strict=True))
        raise IndexError(index)

    def tape(self, inputs: str, outputs: Mapping[str, Sequence[Scalar]], *, bar: str = "v") -> Tape:
        """Program of `outputs` with the arguments named in `inputs` (of q, v, act, u, tau, a, w, p, bar).

        `bar` says whether the weights of that name belong to freedoms ("v") or to the state ("x").
        """
        alike = limbs(self.model, self.tree, self.layout, bar=bar)
        return Tape.build({name: len(self.inputs[name]) for name in inputs.split()}, outputs, alike)
