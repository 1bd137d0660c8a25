"""A scene's equations of motion as expressions: built once per model and roles, read out piece by piece."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property

import mujoco

from ..compile.graph import Graph, Node, Scalar
from ..compile.tape import Tape
from ..errors import EngineError
from . import spatial
from .articulated import articulated_solve
from .fields import Fields, Parameter, parameter_index
from .fluid import applied_wrenches
from .forces import actuator_forces, disabled, passive_forces
from .mass_matrix import Entries, Factor, dense, dof_parents, mass_matrix
from .motion import transforms
from .newton_euler import generalized_forces
from .support import unsupported
from .tree import BALL, COORDINATES, DOFS, FREE, Link, build_tree


class Layout:
    """Which coordinates, freedoms and activations are state, and which are prescribed inputs.

    The state is x = (q, v, act) over the joints that are not keyed; the prescribed motion is w = (q, v, a)
    over the keyed ones, each part in the model's order.
    """

    def __init__(self, model: mujoco.MjModel, keyed: Sequence[int] = ()):
        wrong = [j for j in keyed if not 0 <= j < model.njnt]
        if wrong:
            raise EngineError(f"keyed joints {wrong} do not exist: this model has {model.njnt} joints")
        self.keyed = tuple(sorted(set(int(j) for j in keyed)))
        self.q_free, self.v_free, self.q_keyed, self.v_keyed = [], [], [], []
        self.quaternions: list[int] = []  # first entries in x
        for joint in range(model.njnt):
            kind = int(model.jnt_type[joint])
            q, v = (self.q_keyed, self.v_keyed) if joint in self.keyed else (self.q_free, self.v_free)
            if joint not in self.keyed and kind in (FREE, BALL):
                self.quaternions.append(len(q) + (3 if kind == FREE else 0))
            q += range(model.jnt_qposadr[joint], model.jnt_qposadr[joint] + COORDINATES[kind])
            v += range(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + DOFS[kind])
        self.nq, self.nv, self.na = len(self.q_free), len(self.v_free), int(model.na)
        self.nx = self.nq + self.nv + self.na
        self.nu = int(model.nu)
        self.nw = len(self.q_keyed) + 2 * len(self.v_keyed)


class Equations:
    """Expressions of one model under given roles.

    `keyed` lists joints (ids) with prescribed motion, `parameters` the model entries that become inputs,
    `friction_width` the velocity [rad/s or m/s] over which dry friction is smoothed (None leaves it out).
    Raises EngineError naming everything in the model that is not supported.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        keyed: Sequence[int] = (),
        parameters: Sequence[Parameter] = (),
        friction_width: float | None = None,
    ):
        problems = unsupported(model, keyed=keyed)
        if problems:
            raise EngineError("the smooth engine cannot do:\n  " + "\n  ".join(problems))
        self.model, self.layout = model, Layout(model, keyed)
        lay, graph = self.layout, Graph()
        self.graph = graph
        self.x, self.u = graph.inputs("x", lay.nx), graph.inputs("u", lay.nu)
        self.w, self.p = graph.inputs("w", lay.nw), graph.inputs("p", len(parameters))
        self.tau, self.a = graph.inputs("tau", lay.nv), graph.inputs("a", lay.nv)
        symbols = {parameter_index(model, key): s for key, s in zip(parameters, self.p, strict=True)}
        self.fields = Fields(model, symbols)
        self.tree = build_tree(self.fields)
        self.q, self.v, self.prescribed = self._full_coordinates()
        self.where = transforms(self.tree, self.q)
        keyed_dofs = set(lay.v_keyed)
        self.skip = keyed_dofs
        self.friction_width = friction_width
        gravity = [0.0] * 3 if disabled(model, "GRAVITY") else [float(g) for g in model.opt.gravity]
        # a tree that floats freely falls with gravity: solve without it, add it to the base afterwards
        self.falling = {i for i, link in enumerate(self.tree.links) if self._falls(link)}
        self.gravity = [
            spatial.zeros() if i in self.falling else gravity for i in range(len(self.tree.links))
        ]
        self.field = gravity

    def _falls(self, link: Link) -> bool:
        armature = self.fields.vector("dof_armature", link.dadr) if link.kind == FREE else [1.0]
        light = all(not isinstance(x, Node) and x == 0.0 for x in armature)
        return link.kind == FREE and link.parent < 0 and link.dadr not in self.skip and light

    def _full_coordinates(self) -> tuple[list[Scalar], list[Scalar], list[Scalar]]:
        lay, model = self.layout, self.model
        q: list[Scalar] = [0.0] * model.nq
        v: list[Scalar] = [0.0] * model.nv
        a: list[Scalar] = [0.0] * model.nv
        for k, address in enumerate(lay.q_free):
            q[address] = self.x[k]
        for k, address in enumerate(lay.v_free):
            v[address] = self.x[lay.nq + k]
        nqk, nvk = len(lay.q_keyed), len(lay.v_keyed)
        for k, address in enumerate(lay.q_keyed):
            q[address] = self.w[k]
        for k, address in enumerate(lay.v_keyed):
            v[address], a[address] = self.w[nqk + k], self.w[nqk + nvk + k]
        return q, v, a

    @property
    def act(self) -> list[Node]:
        """Activations."""
        return self.x[self.layout.nq + self.layout.nv :]

    def _in_links(self, world: Sequence[Scalar]) -> list[Scalar]:
        """A vector over freedoms with the linear parts of free joints turned into their links' frames."""
        out = list(world)
        for link, at in zip(self.tree.links, self.where, strict=True):
            if link.kind == FREE:
                out[link.dadr : link.dadr + 3] = at.to_child(out[link.dadr : link.dadr + 3])
        return out

    def _in_world(self, local: Sequence[Scalar]) -> list[Scalar]:
        out = list(local)
        for link, at in zip(self.tree.links, self.where, strict=True):
            if link.kind == FREE:
                out[link.dadr : link.dadr + 3] = at.to_parent(out[link.dadr : link.dadr + 3])
        return out

    @cached_property
    def _driving(self) -> tuple[list[Scalar], list[Scalar]]:
        """Passive and actuator forces (free joints' linear parts in the world frame), rates of activations."""
        passive = passive_forces(self.fields, self.q, self.v, self.friction_width)
        actuator, rates = actuator_forces(self.fields, self.q, self.v, self.act, self.u)
        return spatial.add(passive, actuator), rates

    @cached_property
    def _applied(self) -> list[tuple[spatial.Vector, spatial.Vector] | None]:
        return applied_wrenches(self.fields, self.tree, self.where, self.v, self.field)

    def _inertial(self, a: Sequence[Scalar], gravity: Sequence[spatial.Vector]) -> list[Scalar]:
        return generalized_forces(
            self.tree, self.where, self.v, self._in_links(a), gravity, self._applied, self.model.nv
        )

    @cached_property
    def mass_entries(self) -> Entries:
        """The inertia matrix over the free dofs, linear parts of free joints in their links' frames."""
        return mass_matrix(self.tree, self.where, self.fields, self.skip)

    @cached_property
    def factor(self) -> Factor:
        """Factor of `mass_entries`."""
        parents = dof_parents(self.tree, self.model.nv, self.skip)
        return Factor.of(self.mass_entries, parents, self.layout.v_free)

    def _solve(self, b: Sequence[Scalar], formulation: str) -> list[Scalar]:
        if formulation == "composite":
            return self.factor.solve(b)
        return articulated_solve(self.tree, self.where, self.fields, b, self.skip)

    def acceleration(self, formulation: str, tau: Sequence[Scalar] | None = None) -> list[Scalar]:
        """Accelerations of the free dofs under actuators, passive forces and `tau` (free dofs)."""
        force = list(self._driving[0])
        if tau is not None:
            for k, dof in enumerate(self.layout.v_free):
                force[dof] = force[dof] + tau[k]
        bias = self._inertial(self.prescribed, self.gravity)
        a = self._in_world(self._solve(spatial.sub(self._in_links(force), bias), formulation))
        for index in self.falling:
            dof = self.tree.links[index].dadr
            a[dof : dof + 3] = spatial.add(a[dof : dof + 3], self.field)
        return [a[dof] for dof in self.layout.v_free]

    def state_rate(self, formulation: str) -> list[Scalar]:
        """dx/dt."""
        return [*self.coordinate_rate(), *self.acceleration(formulation), *self._driving[1]]

    def coordinate_rate(self) -> list[Scalar]:
        """dq/dt of the free coordinates."""
        rate: dict[int, Scalar] = {}
        for link in self.tree.links:
            q, v = link.qadr, link.dadr
            if link.kind in (FREE, BALL):
                if link.kind == FREE:
                    rate.update({q + k: self.v[v + k] for k in range(3)})
                    q, v = q + 3, v + 3
                turning = spatial.quaternion_rate(self.q[q : q + 4], self.v[v : v + 3])
                rate.update({q + k: r for k, r in enumerate(turning)})
            else:
                rate[q] = self.v[v]
        return [rate[address] for address in self.layout.q_free]

    def full_acceleration(self, a: Sequence[Scalar]) -> list[Scalar]:
        """Accelerations of all dofs: `a` for the free ones, prescribed for the keyed."""
        out = list(self.prescribed)
        for k, dof in enumerate(self.layout.v_free):
            out[dof] = a[k]
        return out

    def inverse(self, a: Sequence[Scalar], *, driven: bool = True) -> list[Scalar]:
        """Forces on all dofs (model order) that must be added to produce `a` (free dofs).

        With `driven`, what actuators and passive forces already give is taken off.
        """
        gravity = [self.field] * len(self.tree.links)
        full = self.full_acceleration(a)
        inertial = self._in_world(self._inertial(full, gravity))
        armature = [self.fields.scalar("dof_armature", i) * full[i] for i in range(self.model.nv)]
        total = spatial.add(inertial, armature)
        return spatial.sub(total, self._driving[0]) if driven else total

    def mass_matrix(self) -> list[Scalar]:
        """The inertia matrix over the free dofs, row-major, in MuJoCo's convention."""
        M = dict(self.mass_entries)
        for link, at in zip(self.tree.links, self.where, strict=True):
            if link.kind == FREE and link.dadr not in self.skip:
                first = link.dadr
                own = [
                    [M[max(i, j), min(i, j)] for j in range(first, first + 3)]
                    for i in range(first, first + 3)
                ]
                own = at.symmetric(own)
                for row in sorted({i for i, j in M if j == first and i >= first + 3}):
                    turned = at.to_parent([M[row, first + k] for k in range(3)])
                    M.update({(row, first + k): x for k, x in enumerate(turned)})
                M.update({(first + i, first + j): own[i][j] for i in range(3) for j in range(i + 1)})
        return dense(M, self.layout.v_free)

    def tape(self, inputs: str, **outputs: Sequence[Scalar]) -> Tape:
        """Program of `outputs` with the arguments named in `inputs` (of x, u, w, p, tau, a)."""
        sizes = {name: len(getattr(self, name)) for name in inputs.split()}
        return Tape.build(sizes, outputs)
