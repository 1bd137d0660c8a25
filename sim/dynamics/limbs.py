"""Limbs of a robot that are built alike: siblings in the tree with the same joints."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import mujoco

from .layout import Layout
from .rigid.tree import COORDINATES, Tree

Leaf = tuple[str, int]
WIDEST = 8  # limbs in one set: as many as stand side by side in a vector register


def limbs(model: mujoco.MjModel, tree: Tree, layout: Layout, *, bar: str = "v") -> list[list[list[Leaf]]]:
    """Sets of limbs alike; a limb is the list of its inputs (name, index), in the same order in each.

    `bar` says what the weights `bar` of a gradient belong to: "v", freedoms, or "x", the state.
    """
    shapes: dict[int, str] = {}
    for index in reversed(range(len(tree.links))):
        link = tree.links[index]
        shapes[index] = f"{link.kind}({','.join(sorted(shapes[i] for i in link.children))})"

    def below(index: int) -> list[int]:
        children = sorted(tree.links[index].children, key=shapes.__getitem__)
        return [index, *(i for child in children for i in below(child))]

    inputs = _inputs_of_joints(model, layout, bar)
    found: list[list[list[Leaf]]] = []
    level = [i for i, link in enumerate(tree.links) if link.parent < 0]
    while level:
        groups: dict[str, list[int]] = {}
        for i in level:
            groups.setdefault(shapes[i], []).append(i)
        level = []
        for members in groups.values():
            for first in range(0, len(members), WIDEST):
                alike = members[first : first + WIDEST]
                leaves = [[leaf for i in below(m) for leaf in inputs[tree.links[i].joint]] for m in alike]
                if len(alike) > 1 and len({tuple(name for name, _ in limb) for limb in leaves}) == 1:
                    found.append(leaves)
                else:
                    level += [child for i in alike for child in tree.links[i].children]
    return found


def _inputs_of_joints(model: mujoco.MjModel, layout: Layout, bar: str) -> Mapping[int, Sequence[Leaf]]:
    """Inputs that belong to every joint: coordinates, velocities, forces and controls."""
    nq, first_v, first_a = layout.nq, len(layout.q_keyed), len(layout.q_keyed) + len(layout.v_keyed)
    q = {address: [("q", i)] + [("bar", i)] * (bar == "x") for i, address in enumerate(layout.q_free)}
    q |= {address: [("w", i)] for i, address in enumerate(layout.q_keyed)}
    v = {
        address: [("v", i), ("tau", i), ("a", i), ("bar", i if bar == "v" else nq + i)]
        for i, address in enumerate(layout.v_free)
    }
    v |= {address: [("w", first_v + i), ("w", first_a + i)] for i, address in enumerate(layout.v_keyed)}
    out: dict[int, list[Leaf]] = {}
    for joint in range(model.njnt):
        first, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
        count = COORDINATES[int(model.jnt_type[joint])]
        last = dof + int((model.dof_jntid == joint).sum())
        out[joint] = [leaf for i in range(first, first + count) for leaf in q[i]]
        out[joint] += [leaf for i in range(dof, last) for leaf in v[i]]
    for i, actuator in enumerate(layout.u_held):
        if model.actuator_trntype[actuator] == mujoco.mjtTrn.mjTRN_JOINT:
            out[int(model.actuator_trnid[actuator, 0])].append(("u", i))
    return out
