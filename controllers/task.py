"""A task in space for laws: a site's pose, Jacobian and their rates."""

from __future__ import annotations

from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import lookup, names_of
from ..sim.errors import PantographError
from .gains import choice

Array = NDArray[np.float64]
Axes = Literal["position", "pose"]


class TaskState(NamedTuple):
    """Pose of the site, p (3,) [m] and R (3, 3); J (k, nv); velocity J v (k,) and drift J' v (k,), in the
    world frame, translation first."""

    p: Array
    R: Array
    J: Array
    velocity: Array
    drift: Array


class Task:
    """The site ``site`` of ``model`` with its position (k = 3) or its whole pose (k = 6).

    Raises PantographError listing the sites when there is none of that name.
    """

    def __init__(self, model: mujoco.MjModel, site: str, axes: Axes) -> None:
        choice("axes", axes, ("position", "pose"), "a task")
        if not (site and isinstance(site, str)):
            sites = ", ".join(names_of(model, "site")) or "none: this model has no sites"
            raise PantographError(f"name the site to move: site = one of {sites}")
        self.model, self.data = model, mujoco.MjData(model)
        self.site, self.k = lookup(model, "site", site), 3 if axes == "position" else 6
        self.body = int(model.site_bodyid[self.site])

    def at(self, q: Array, v: Array) -> TaskState:
        """State of the task at q (nq,), v (nv,)."""
        m, d = self.model, self.data
        d.qpos[:], d.qvel[:] = q, v
        mujoco.mj_kinematics(m, d)
        mujoco.mj_comPos(m, d)
        mujoco.mj_comVel(m, d)
        J, rate = np.zeros((6, m.nv)), np.zeros((6, m.nv))
        p = d.site_xpos[self.site].copy()
        mujoco.mj_jacSite(m, d, J[:3], J[3:], self.site)
        mujoco.mj_jacDot(m, d, rate[:3], rate[3:], p, self.body)
        J, rate = J[: self.k], rate[: self.k]
        return TaskState(p, d.site_xmat[self.site].reshape(3, 3).copy(), J, J @ v, rate @ v)

    def error(self, now: TaskState, wanted: TaskState) -> Array:
        """Way to ``wanted``, (k,): position difference [m], then rotation vector [rad] in the world."""
        if self.k == 3:
            return wanted.p - now.p
        quaternion, turn = np.empty(4), np.empty(3)
        mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(wanted.R @ now.R.T).ravel())
        mujoco.mju_quat2Vel(turn, quaternion, 1.0)
        return np.concatenate([wanted.p - now.p, turn])
