"""Coordinates of the freedoms that a prediction moves: sums and differences in the tangent space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...sim import rotations
from ...sim.dynamics.layout import Layout
from ...sim.kinds import FREE, SCALAR

Array = NDArray[np.float64]


class Coordinates:
    """Configurations q (..., nq) of the joints that are not keyed, in the order of ``layout``."""

    def __init__(self, layout: Layout) -> None:
        self.nq, self.nv = layout.nq, layout.nv
        self.flat_q: list[int] = []  # what adds up as numbers do
        self.flat_v: list[int] = []
        self.turning: list[tuple[int, int]] = []  # first entries of a quaternion and of its angular velocity
        scalar = np.full(self.nv, -1)
        for kind, q, v in layout.blocks:
            width = 1 if kind in SCALAR else 3 if kind == FREE else 0
            self.flat_q += range(q, q + width)
            self.flat_v += range(v, v + width)
            if kind in SCALAR:
                scalar[v] = q
            else:
                self.turning.append((q + width, v + width))
        self.scalar = np.flatnonzero(scalar >= 0)
        self._scalar_q = scalar[self.scalar]

    def plus(self, q: Array, d: Array) -> Array:
        """The configuration that lies the tangent ``d`` (..., nv) away from ``q``."""
        if not self.turning:
            return np.asarray(q + d)
        out = np.array(q)
        out[..., self.flat_q] += d[..., self.flat_v]
        for i, j in self.turning:
            turned = rotations.multiply(q[..., i : i + 4], rotations.exp(d[..., j : j + 3]))
            out[..., i : i + 4] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
        return out

    def minus(self, to: Array, q: Array) -> Array:
        """Tangent (..., nv) from ``q`` to ``to``."""
        if not self.turning:
            return np.asarray(to - q)
        out = np.empty((*np.broadcast_shapes(to.shape[:-1], q.shape[:-1]), self.nv))
        out[..., self.flat_v] = to[..., self.flat_q] - q[..., self.flat_q]
        for i, j in self.turning:
            back = rotations.conjugate(q[..., i : i + 4])
            out[..., j : j + 3] = rotations.log(rotations.multiply(back, to[..., i : i + 4]))
        return out

    def positions(self, q: Array) -> Array:
        """Positions of hinges and slides by freedom (..., nv), zero for others."""
        if not self.turning:
            return q
        out = np.zeros((*q.shape[:-1], self.nv))
        out[..., self.scalar] = q[..., self._scalar_q]
        return out

    def turn(self, v: Array, D: Array) -> Array:
        """What the rate of a tangent D (s, nv, k) gets from the motion v (s, nv) itself: -w x D for rotations
        that turn at w in their own frame."""
        out = np.zeros_like(D)
        for _, j in self.turning:
            out[:, j : j + 3] = -np.cross(v[:, None, j : j + 3], D[:, j : j + 3].swapaxes(1, 2)).swapaxes(
                1, 2
            )
        return out
