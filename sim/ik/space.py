"""The space of configurations: limits, steps and differences on the manifold, random configurations.

Everything works on batches q (n, nq) and tangents d (n, nv) in MuJoCo's coordinates.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import rotations
from ..errors import ModelError
from ..kinds import BALL, FREE, SCALAR

Array = NDArray[np.float64]


class Ball(NamedTuple):
    """A quaternion at q[q:q+4] turned by v[v:v+3], at most `limit` [rad] from the identity."""

    q: int
    v: int
    limit: float


class Space:
    """Configurations of a model and their limits.

    `low`, `high` (nv,) bound hinges and slides, infinite for other freedoms and where `limits` is False.
    """

    def __init__(self, model: mujoco.MjModel, *, limits: bool = True):
        self.model, self.nq, self.nv = model, int(model.nq), int(model.nv)
        self.low, self.high = np.full(self.nv, -np.inf), np.full(self.nv, np.inf)
        scalar_q, scalar_v = [], []
        self.balls: list[Ball] = []
        self.shifts: list[tuple[int, int]] = []  # positions of free joints: q, v
        self.hinges: list[int] = []  # freedoms that are angles
        for j in range(model.njnt):
            kind, q, v = int(model.jnt_type[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
            limited = limits and bool(model.jnt_limited[j])
            if kind in SCALAR:
                scalar_q.append(q)
                scalar_v.append(v)
                if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_HINGE):
                    self.hinges.append(v)
                if limited:
                    self.low[v], self.high[v] = model.jnt_range[j]
            elif kind == BALL:
                self.balls.append(Ball(q, v, float(model.jnt_range[j, 1]) if limited else np.inf))
            else:
                assert kind == FREE
                self.shifts.append((q, v))
                self.balls.append(Ball(q + 3, v + 3, np.inf))
        self.scalar_q, self.scalar_v = np.array(scalar_q, dtype=int), np.array(scalar_v, dtype=int)
        self.quats = np.array([range(b.q, b.q + 4) for b in self.balls], dtype=int).reshape(-1, 4)
        self.turns = np.array([range(b.v, b.v + 3) for b in self.balls], dtype=int).reshape(-1, 3)
        self.cones = np.array([b.limit for b in self.balls])  # [rad], infinite without a limit
        self.q_of_v = np.full(self.nv, -1)
        self.q_of_v[self.scalar_v] = self.scalar_q

    def coordinates(self, moved: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which entries of q (nq,) belong to the freedoms in `moved` (nv,)."""
        out = np.zeros(self.nq, dtype=bool)
        out[self.q_of_v[np.flatnonzero(moved & (self.q_of_v >= 0))]] = True
        for i, v in self.shifts:
            out[i : i + 3] = moved[v : v + 3]
        for ball in self.balls:
            out[ball.q : ball.q + 4] = moved[ball.v]
        return out

    def check(self, q: ArrayLike) -> Array:
        """`q` (nq,) on the manifold and inside the limits; ModelError when it is no configuration."""
        q = np.array(q, dtype=float)
        if q.shape != (self.nq,) or not np.isfinite(q).all():
            raise ModelError(f"a configuration of this model is {self.nq} finite numbers, not {q!r:.200}")
        return np.asarray(self.clip(q[None])[0])

    def step(self, q: Array, d: Array) -> Array:
        """`q` moved by tangents `d`, clipped into the limits."""
        out = q.copy()
        out[:, self.scalar_q] += d[:, self.scalar_v]
        for i, v in self.shifts:
            out[:, i : i + 3] += d[:, v : v + 3]
        if self.balls:
            out[:, self.quats] = rotations.multiply(q[:, self.quats], rotations.exp(d[:, self.turns]))
        return self.clip(out)

    def clip(self, q: Array) -> Array:
        """Nearest configurations inside the limits, quaternions of unit length."""
        out = q.copy()
        v = self.scalar_v
        out[:, self.scalar_q] = np.clip(q[:, self.scalar_q], self.low[v], self.high[v])
        if not self.balls:
            return out
        quat = q[:, self.quats]
        length = np.linalg.norm(quat, axis=-1, keepdims=True)
        unit = np.where(length > 0, quat / np.maximum(length, 1e-300), [1.0, 0.0, 0.0, 0.0])
        if np.isfinite(self.cones).any():
            phi = rotations.log(unit)
            angle = np.linalg.norm(phi, axis=-1)
            over = angle > self.cones
            if over.any():
                share = np.where(over, self.cones, 1.0) / np.maximum(angle, 1e-300)
                unit = np.where(over[..., None], rotations.exp(phi * share[..., None]), unit)
        out[:, self.quats] = unit
        return out

    def difference(self, to: Array, start: Array) -> Array:
        """Tangents d with step(start, d) = to, limits apart."""
        to, start = np.broadcast_arrays(to, start)
        d = np.zeros((len(to), self.nv))
        d[:, self.scalar_v] = to[:, self.scalar_q] - start[:, self.scalar_q]
        for i, v in self.shifts:
            d[:, v : v + 3] = to[:, i : i + 3] - start[:, i : i + 3]
        if self.balls:
            turn = rotations.multiply(rotations.conjugate(start[:, self.quats]), to[:, self.quats])
            d[:, self.turns] = rotations.log(turn)
        return d

    def free_directions(self, q: Array, g: Array) -> tuple[NDArray[np.bool_], list[tuple[Ball, Array]]]:
        """What a descent along -g may move: mask (n, nv) of freedoms, and blocked axes of balls.

        A freedom at its limit is held when -g points outward (Bertsekas' two-metric projection); a ball at
        its limit loses the axis (n, 3) of its rotation, zero where nothing is lost.
        """
        x = np.zeros((len(q), self.nv))
        x[:, self.scalar_v] = q[:, self.scalar_q]
        mask = ~(((x <= self.low) & (g > 0)) | ((x >= self.high) & (g < 0)))
        blocked = []
        for ball in self.balls:
            if not np.isfinite(ball.limit):
                continue
            phi = rotations.log(q[:, ball.q : ball.q + 4])
            angle = np.linalg.norm(phi, axis=1)
            axis = phi / np.maximum(angle, 1e-300)[:, None]
            outward = -np.sum(axis * g[:, ball.v : ball.v + 3], axis=1) > 0
            held = (angle >= ball.limit * (1 - 1e-12)) & outward
            blocked.append((ball, np.where(held[:, None], axis, 0.0)))
        return mask, blocked

    def random(self, rng: np.random.Generator, n: int, around: Array, moved: NDArray[np.bool_]) -> Array:
        """Configurations (n, nq): freedoms in `moved` (nv,) uniform within their limits, others as `around`.

        Hinges without limits turn fully, slides without limits move by the model's extent, free bodies stay
        near `around`: within a third of the extent, turned by a normal rotation of 0.5 rad an axis.
        """
        q = np.tile(around, (n, 1))
        extent = float(self.model.stat.extent)
        for i, v in zip(self.scalar_q, self.scalar_v, strict=True):
            if not moved[v]:
                continue
            half = np.pi if v in self.hinges else extent
            low = self.low[v] if np.isfinite(self.low[v]) else around[i] - half
            high = self.high[v] if np.isfinite(self.high[v]) else around[i] + half
            q[:, i] = rng.uniform(low, high, n)
        for i, v in self.shifts:
            if moved[v : v + 3].any():
                q[:, i : i + 3] += 0.3 * extent * rng.normal(size=(n, 3))
        free = {i + 3 for i, _ in self.shifts}
        for ball in self.balls:
            if not moved[ball.v : ball.v + 3].any():
                continue
            quat = slice(ball.q, ball.q + 4)
            if ball.q in free:
                q[:, quat] = rotations.multiply(q[:, quat], rotations.exp(0.5 * rng.normal(size=(n, 3))))
            else:
                turn = rng.normal(size=(n, 4))
                q[:, quat] = turn / np.linalg.norm(turn, axis=1, keepdims=True)
        return self.clip(q)

    def middle(self, around: Array, moved: NDArray[np.bool_]) -> Array:
        """`around` (nq,) with limited hinges and slides of `moved` in the middle of their ranges."""
        q = around.copy()
        for i, v in zip(self.scalar_q, self.scalar_v, strict=True):
            if moved[v] and np.isfinite(self.low[v]) and np.isfinite(self.high[v]):
                q[i] = 0.5 * (self.low[v] + self.high[v])
        return q

    def nearest_turns(self, q: Array, to: Array) -> Array:
        """`q` (n, nq) with whole turns of hinges chosen: as near to `to` as the limits allow."""
        out, turn = q.copy(), 2 * np.pi
        v, i = self.hinges, self.q_of_v[self.hinges]
        low, high = self.low[v], self.high[v]
        near = q[:, i] - turn * np.round((q[:, i] - to[..., i]) / turn)
        near = np.where(near > high, near - turn, near)
        near = np.where(near < low, near + turn, near)
        out[:, i] = np.where((near <= high) & (near >= low), near, q[:, i])
        return out

    def excess(self, q: Array) -> Array:
        """How far (n, nv) `q` is outside the limits [rad or m]; of a ball, at its first freedom."""
        x = np.zeros((len(q), self.nv))
        x[:, self.scalar_v] = q[:, self.scalar_q]
        out = np.maximum(
            0.0,
            np.maximum(
                np.where(np.isfinite(self.low), self.low, x) - x,
                x - np.where(np.isfinite(self.high), self.high, x),
            ),
        )
        for ball in self.balls:
            if np.isfinite(ball.limit):
                angle = np.linalg.norm(rotations.log(q[:, ball.q : ball.q + 4]), axis=1)
                out[:, ball.v] = np.maximum(0.0, angle - ball.limit)
        return out
