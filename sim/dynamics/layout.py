"""Which coordinates of a model are state and which are prescribed."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from ..errors import EngineError, unknown
from .rigid.tree import BALL, COORDINATES, DOFS, FREE

Keyed = Sequence[str | int] | np.ndarray


def keyed_joints(model: mujoco.MjModel, keyed: Keyed) -> tuple[int, ...]:
    """Joint ids of `keyed`: names or ids of joints, or a mask over freedoms (bool, shape (nv,)).

    Raises EngineError for a joint that does not exist and for a mask that cuts a joint in two.
    """
    array = np.asarray(keyed)
    if array.dtype == bool:
        if array.shape != (model.nv,):
            raise EngineError(
                f"a mask of keyed freedoms has shape {array.shape}; this model needs ({model.nv},)"
            )
        counts = np.bincount(model.dof_jntid, weights=array, minlength=model.njnt)
        whole = np.bincount(model.dof_jntid, minlength=model.njnt)
        cut = [_name(model, j) for j in np.flatnonzero((counts > 0) & (counts < whole)).tolist()]
        if cut:
            raise EngineError(f"joints {', '.join(cut)} are keyed in part: a joint is keyed as a whole")
        return tuple(int(j) for j in np.flatnonzero(counts))
    found = set()
    for entry in keyed:
        joint = (
            mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, entry)
            if isinstance(entry, str)
            else int(entry)
        )
        if not 0 <= joint < model.njnt:
            names = [_name(model, j) for j in range(model.njnt)]
            raise EngineError(unknown("joint", str(entry), names))
        found.add(joint)
    return tuple(sorted(found))


def _name(model: mujoco.MjModel, joint: int) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_JOINT, int(joint)) or f"#{joint}"


class Layout:
    """Sizes and addresses of state and prescribed inputs.

    The state is x = (q, v, act) over the joints that are not keyed; the prescribed motion is w = (q, v, a)
    over the keyed ones, each part in the model's order, after it the controls of the `timed` actuators, and
    the `wrenches`: for each pair of a body's id and whether its frame or the world's is meant, a force [N] at
    its centre of mass and a torque [N m].
    The held controls u are those of the other actuators and, with `forces`, generalized forces on the
    freedoms of the state.

    Attributes:
        q_free, v_free, q_keyed, v_keyed: addresses in the model's qpos and qvel.
        quaternions: first entries of quaternions in q (state).
        u_held: actuators whose controls are in u.
        w_timed, w_wrenches: where those parts of w begin.
        blocks: (kind, first entry in q, first entry in v) of every free joint, in order.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        keyed: tuple[int, ...] = (),
        *,
        timed: tuple[int, ...] = (),
        wrenches: tuple[tuple[int, bool], ...] = (),
        forces: bool = False,
    ):
        self.keyed, self.timed, self.wrenches, self.forces = keyed, timed, wrenches, forces
        self.u_held = [i for i in range(model.nu) if i not in timed]
        self.q_free: list[int] = []
        self.v_free: list[int] = []
        self.q_keyed: list[int] = []
        self.v_keyed: list[int] = []
        self.quaternions: list[int] = []
        self.blocks: list[tuple[int, int, int]] = []
        for joint in range(model.njnt):
            kind = int(model.jnt_type[joint])
            held = joint in keyed
            q, v = (self.q_keyed, self.v_keyed) if held else (self.q_free, self.v_free)
            if not held:
                self.blocks.append((kind, len(q), len(v)))
                if kind in (FREE, BALL):
                    self.quaternions.append(len(q) + (3 if kind == FREE else 0))
            q += range(model.jnt_qposadr[joint], model.jnt_qposadr[joint] + COORDINATES[kind])
            v += range(model.jnt_dofadr[joint], model.jnt_dofadr[joint] + DOFS[kind])
        self.nq, self.nv, self.na = len(self.q_free), len(self.v_free), int(model.na)
        self.nu = len(self.u_held) + (self.nv if forces else 0)
        self.nx = self.nq + self.nv + self.na
        self.w_timed = len(self.q_keyed) + 2 * len(self.v_keyed)
        self.w_wrenches = self.w_timed + len(timed)
        self.nw = self.w_wrenches + 6 * len(wrenches)
