"""Closed loops and coupled joints: a model's equalities as residual rows, and the projection onto them.

The projection is meant for everybody: inverse kinematics uses the rows, integrators use `project`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models.naming import name_of
from .. import rotations
from ..kinds import SLIDE
from .goals import Rows
from .pose import Configurations, Kinematics
from .space import Space

Array = NDArray[np.float64]
CONNECT, WELD = int(mujoco.mjtEq.mjEQ_CONNECT), int(mujoco.mjtEq.mjEQ_WELD)
JOINT, TENDON = int(mujoco.mjtEq.mjEQ_JOINT), int(mujoco.mjtEq.mjEQ_TENDON)
CLOSED = 1e-9  # [m or rad]


@dataclass(frozen=True, eq=False)
class Closure:
    """One equality of a model as rows that vanish when it holds.

    `a`, `b` are the frames that meet (connect: their origins, weld: their poses); a joint equality has the
    addresses of its joints and its polynomial instead (MuJoCo: q1 - q1_0 = c0 + c1 x + ..., x = q2 - q2_0).
    """

    label: str
    kind: int
    moved: NDArray[np.bool_]
    metres: NDArray[np.bool_]
    tolerance: Array
    a: str = ""
    b: str = ""
    joints: tuple[tuple[int, int, float], ...] = ()
    polynomial: tuple[float, ...] = ()

    def rows(self, c: Configurations) -> Rows:
        """Residuals (n, m) and Jacobian (n, m, nv)."""
        if self.kind == JOINT:
            return self._coupling(c)
        f, g = c.frame(self.a), c.frame(self.b)
        r, J = f.p - g.p, f.Jv - g.Jv
        if self.kind == CONNECT:
            return Rows(r, J)
        back = g.R.transpose(0, 2, 1)
        phi = rotations.log(rotations.from_matrix(back @ f.R))
        turn = rotations.inverse_right_jacobian(-phi) @ (back @ (f.Jw - g.Jw))
        return Rows(np.concatenate([r, phi], axis=1), np.concatenate([J, turn], axis=1))

    def _coupling(self, c: Configurations) -> Rows:
        (q1, v1, rest1), *other = self.joints
        p = np.polynomial.Polynomial(self.polynomial)
        J = np.zeros((len(c.q), 1, c.model.nv))
        J[:, 0, v1] = 1.0
        r = c.q[:, q1] - rest1
        if other:
            q2, v2, rest2 = other[0]
            x = c.q[:, q2] - rest2
            J[:, 0, v2] -= p.deriv()(x)
            return Rows((r - p(x))[:, None], J)
        return Rows((r - p(0.0))[:, None], J)


def closures(model: mujoco.MjModel, kinematics: Kinematics) -> list[Closure]:
    """Active connect, weld and joint equalities of `model` that can move."""
    out = []
    for e in np.flatnonzero(model.eq_active0):
        kind, data = int(model.eq_type[e]), model.eq_data[e]
        label = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_EQUALITY, int(e)) or f"equality {e}"
        if kind in (CONNECT, WELD):
            a, b = _meeting_frames(model, kinematics, int(e), data)
            moved = np.zeros(model.nv, dtype=bool)
            moved[kinematics.frame(a).dofs] = moved[kinematics.frame(b).dofs] = True
            metres = np.array([True] * 3 + [False] * (3 if kind == WELD else 0))
            closure = Closure(label, kind, moved, metres, np.full(len(metres), CLOSED), a, b)
        elif kind == JOINT:
            closure = _joint_closure(model, label, int(e), data)
        else:
            continue
        if closure.moved.any():
            out.append(closure)
    return out


def _joint_closure(model: mujoco.MjModel, label: str, e: int, data: Array) -> Closure:
    ids = [int(j) for j in (model.eq_obj1id[e], model.eq_obj2id[e]) if j >= 0]
    joints = tuple(
        (int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j]), float(model.qpos0[model.jnt_qposadr[j]]))
        for j in ids
    )
    moved = np.zeros(model.nv, dtype=bool)
    moved[[v for _, v, _ in joints]] = True
    label = label if not label.startswith("equality") else f"coupling of {name_of(model, 'joint', ids[0])}"
    polynomial = tuple(float(x) for x in data[:5])
    metres = np.array([int(model.jnt_type[ids[0]]) == SLIDE])
    return Closure(label, JOINT, moved, metres, np.array([CLOSED]), "", "", joints, polynomial)


def _meeting_frames(model: mujoco.MjModel, kinematics: Kinematics, e: int, data: Array) -> tuple[str, str]:
    """The two frames that a connect or weld brings together (MuJoCo's eq_data)."""
    one, two = int(model.eq_obj1id[e]), int(model.eq_obj2id[e])
    weld = int(model.eq_type[e]) == WELD
    if int(model.eq_objtype[e]) == int(mujoco.mjtObj.mjOBJ_SITE):
        return name_of(model, "site", one), name_of(model, "site", two)
    if not weld:
        return kinematics.anchored(one, data[0:3]), kinematics.anchored(two, data[3:6])
    # weld: anchor in body 2 is data[0:3], in body 1 data[3:6]; data[6:10] turns body 1 into body 2
    return kinematics.anchored(one, data[3:6], data[6:10]), kinematics.anchored(two, data[0:3])


class Projection(NamedTuple):
    """Configuration q (nq,) on the loops, what is left open [m or rad], steps, and whether it closed."""

    q: Array
    open: float
    steps: int
    closed: bool


class Loops:
    """The closed loops of a model, for many projections."""

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self.kinematics = Kinematics(model)
        self.closures = closures(model, self.kinematics)

    def rows(self, q: Array) -> Rows:
        """Residuals (n, m) and Jacobian (n, m, nv) of all loops."""
        c = self.kinematics.at(q)
        parts = [loop.rows(c) for loop in self.closures]
        if not parts:
            return Rows(np.zeros((len(q), 0)), np.zeros((len(q), 0, self.model.nv)))
        return Rows(
            np.concatenate([p.r for p in parts], axis=1), np.concatenate([p.J for p in parts], axis=1)
        )

    def project(
        self,
        q: ArrayLike,
        *,
        metric: ArrayLike | None = None,
        held: ArrayLike | None = None,
        tolerance: float = 1e-13,
        steps: int = 30,
    ) -> Projection:
        """Configuration near `q` (nq,) with all loops closed, by Gauss-Newton steps of least norm.

        `metric` (nv, nv) measures the steps, the mass matrix for integrators (default: unity). `held` (nv,)
        bool freedoms stay. Stops when nothing is open by more than `tolerance`, or progress ends.
        """
        space = Space(self.model, limits=False)
        x = space.clip(np.array(q, dtype=float)[None])
        fixed = np.zeros(self.model.nv, dtype=bool) if held is None else np.asarray(held, dtype=bool)
        free = np.flatnonzero(~fixed)
        inverse = (
            np.eye(len(free))
            if metric is None
            else np.linalg.inv(np.asarray(metric, dtype=float)[free][:, free])
        )
        r, J = self.rows(x)
        best, taken = _size(r), 0
        while best > tolerance and taken < steps:
            d = np.zeros(self.model.nv)
            d[free] = _least(J[0][:, free], inverse, -r[0])
            share = 1.0
            while share > 1e-4:  # a step that opens the loops further is cut
                trial = space.step(x, share * d[None])
                r_trial, J_trial = self.rows(trial)
                if _size(r_trial) < best:
                    break
                share *= 0.25
            else:
                break
            x, r, J, best, taken = trial, r_trial, J_trial, _size(r_trial), taken + 1
        return Projection(x[0], best, taken, best <= max(tolerance, CLOSED))

    def tangent(self, q: ArrayLike, v: ArrayLike, *, metric: ArrayLike | None = None) -> Array:
        """Velocity (nv,) nearest to `v` that keeps the loops closed."""
        _, J = self.rows(np.array(q, dtype=float)[None])
        inverse = np.eye(self.model.nv) if metric is None else np.linalg.inv(np.asarray(metric, dtype=float))
        v = np.asarray(v, dtype=float)
        return np.asarray(v + _least(J[0], inverse, -(J[0] @ v)))


def _size(r: Array) -> float:
    return float(np.abs(r).max(initial=0.0))


def _least(A: Array, inverse_metric: Array, b: Array) -> Array:
    """Least d in the metric M with A d = b, by a pseudo-inverse: redundant loops (a planar four-bar in space)
    make A lose rank. With M^-1 = L L^T: d = L (A L)^+ b."""
    L = np.linalg.cholesky(inverse_metric)
    return np.asarray(L @ np.linalg.lstsq(A @ L, b, rcond=1e-9)[0])
