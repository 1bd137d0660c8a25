"""Distances between named geoms, and the rows that keep them apart."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models.naming import lookup
from ..errors import ModelError
from .goals import Rows

Array = NDArray[np.float64]


class Gap(NamedTuple):
    """Signed distance of two geoms [m], negative when they overlap, and its derivative (nv,)."""

    distance: float
    J: Array


class Clearance:
    """Distances of pairs of geoms of a model, by MuJoCo's convex distance, up to `reach` [m].

    As a preference, a pair nearer than `reach` is pushed apart.
    """

    def __init__(self, model: mujoco.MjModel, pairs: Sequence[tuple[str, str]], *, reach: float = 0.1):
        if not pairs:
            raise ModelError("to keep geoms apart, name the pairs: [('hand', 'table'), ...]")
        self.model, self.reach = model, reach
        self.pairs = [(lookup(model, "geom", a), lookup(model, "geom", b)) for a, b in pairs]
        for (a, b), names in zip(self.pairs, pairs, strict=True):
            if model.geom_bodyid[a] == model.geom_bodyid[b]:
                raise ModelError(f"geoms {names[0]!r} and {names[1]!r} are on one body: they never part")
        self._data = mujoco.MjData(model)

    def gaps(self, q: Array) -> list[Gap]:
        """Distances (up to `reach`) and derivatives at q (nq,)."""
        model, data = self.model, self._data
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        out = []
        for a, b in self.pairs:
            ends = np.zeros(6)
            distance = mujoco.mj_geomDistance(model, data, a, b, self.reach, ends)
            out.append(Gap(float(distance), self._derivative(a, b, ends, distance)))
        return out

    def _derivative(self, a: int, b: int, ends: Array, distance: float) -> Array:
        """n^T (J_b - J_a) at the nearest points, n the unit normal from a to b."""
        across = ends[3:] - ends[:3]
        length = np.linalg.norm(across)
        if distance >= self.reach or length < 1e-12:
            return np.zeros(self.model.nv)
        n = across / length * np.sign(distance)
        Ja, Jb = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        mujoco.mj_jac(self.model, self._data, Ja, None, ends[:3], int(self.model.geom_bodyid[a]))
        mujoco.mj_jac(self.model, self._data, Jb, None, ends[3:], int(self.model.geom_bodyid[b]))
        return np.asarray(n @ (Jb - Ja))

    def rows(self, q: Array) -> Rows:
        """1 - distance / reach for every pair nearer than `reach`, over a batch q (n, nq)."""
        r = np.zeros((len(q), len(self.pairs)))
        J = np.zeros((len(q), len(self.pairs), self.model.nv))
        for i, x in enumerate(q):
            for k, gap in enumerate(self.gaps(x)):
                r[i, k] = 1.0 - gap.distance / self.reach
                J[i, k] = -gap.J / self.reach
        return Rows(r, J)
