"""The part of a motion that a rig makes: its joints over time, cubic Hermite curves between the samples."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.recording import Recording
from .mapping import Mapping, indices
from .rig import Rig

Array = NDArray[np.float64]
_BEND = 0.2  # relative difference of velocities at which a sample is a bend


@dataclass(frozen=True)
class Loads:
    """Joint forces (n, nj) that a motion needs, by how they change when it is slowed k times.

    static: gravity, springs, dry friction (as they are); viscous: damping (1/k); dynamic: inertia (1/k^2).
    """

    static: Array
    viscous: Array
    dynamic: Array


@dataclass(frozen=True)
class Motion:
    """Joints of a rig: t (n,) [s] rising; q, v, a (n, nj); slowed: how often slower than it was given."""

    t: Array
    q: Array
    v: Array
    a: Array
    slowed: float = 1.0

    @property
    def duration(self) -> float:
        """Seconds from the first sample to the last."""
        return float(self.t[-1] - self.t[0])

    def slow(self, factor: float) -> Motion:
        """The same path, `factor` times slower."""
        start, k = self.t[0], factor
        return replace(
            self,
            t=start + (self.t - start) * k,
            v=self.v / k,
            a=self.a / (k * k),
            slowed=self.slowed * k,
        )

    def at(self, t: Array | float) -> tuple[Array, Array]:
        """Joint values and velocities at times (...,), held outside of the motion."""
        t = np.clip(t, self.t[0], self.t[-1])
        i = np.clip(np.searchsorted(self.t, t, side="right") - 1, 0, len(self.t) - 2)
        h = (self.t[i + 1] - self.t[i])[..., None]
        x = (t - self.t[i])[..., None] / h
        q0, q1, v0, v1 = self.q[i], self.q[i + 1], h * self.v[i], h * self._arrival[i]
        # Hermite: q = q0 + x (v0 + x (c2 + x c3))
        c2, c3 = 3 * (q1 - q0) - 2 * v0 - v1, 2 * (q0 - q1) + v0 + v1
        return q0 + x * (v0 + x * (c2 + x * c3)), (v0 + x * (2 * c2 + 3 * x * c3)) / h

    @cached_property
    def _arrival(self) -> Array:
        """Velocity (n - 1, nj) at the end of each interval: that of the next sample, unless the motion
        bends there.

        Velocities are limits from the right. Where the next one is far from what the interval itself says
        (the parabola through its ends and first velocity), the keys bend, and a cubic would overshoot.
        """
        v0, v1 = self.v[:-1], self.v[1:]
        parabola = 2 * np.diff(self.q, axis=0) / np.diff(self.t)[:, None] - v0
        bends = np.abs(v1 - parabola) > _BEND * 0.5 * (np.abs(v0) + np.abs(v1)) + 1e-9
        return np.where(bends, parabola, v1)

    def dense(self, parts: int = 8) -> Array:
        """Times of every sample, with `parts` equal steps between two."""
        steps = np.append(
            np.linspace(0.0, 1.0, parts, endpoint=False), 1 - 1e-9
        )  # and the limit from the left
        return np.append((self.t[:-1, None] + np.diff(self.t)[:, None] * steps).ravel(), self.t[-1])


def motion_of(recording: Recording, rig: Rig, mapping: Mapping) -> Motion:
    """The rig's joints of a recording; ModelError for a joint that its model lacks."""
    qpos, dofs = indices(rig, mapping, recording.model)
    keep = np.concatenate([[True], np.diff(recording.t) > 0])
    t = np.asarray(recording.t[keep], dtype=float)
    q, v, a = recording.q[keep][:, qpos], recording.v[keep][:, dofs], recording.a[keep][:, dofs]
    if len(t) == 1:  # a pose: hold it for a moment
        t, q, v, a = np.array([t[0], t[0] + 1e-3]), np.repeat(q, 2, 0), np.zeros_like(q), np.zeros_like(q)
        v, a = np.repeat(v, 2, 0), np.repeat(a, 2, 0)
    return Motion(t, q, v, a)


def loads_of(recording: Recording, rig: Rig, mapping: Mapping) -> Loads:
    """Joint forces of a recording, by inverse dynamics of its model without contacts and constraints.

    A motion with contacts is taken as recorded, as if slowing did not relieve it.
    """
    model = recording.model
    _, dofs = indices(rig, mapping, model)
    keep = np.concatenate([[True], np.diff(recording.t) > 0])
    if np.any(recording.normal > 0):
        recorded = recording.tau[keep][:, dofs]
        return Loads(recorded, np.zeros_like(recorded), np.zeros_like(recorded))
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    data = mujoco.MjData(model)
    n = int(keep.sum())
    full, static = np.zeros((n, model.nv)), np.zeros((n, model.nv))
    q, v, a = recording.q[keep], recording.v[keep], recording.a[keep]
    for i in range(n):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(model, data)
        full[i] = data.qfrc_inverse
        data.qvel[:], data.qacc[:] = 0.0, 0.0
        mujoco.mj_inverse(model, data)
        static[i] = data.qfrc_inverse
    viscous = np.asarray(model.dof_damping).reshape(model.nv, -1)[:, 0] * v
    dynamic = full - static - viscous
    static = static + np.asarray(model.dof_frictionloss) * np.sign(v)
    return Loads(static[:, dofs], viscous[:, dofs], dynamic[:, dofs])
