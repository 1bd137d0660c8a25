"""Joints and servos: positions, rates and forces from one to the other, vectorised over time.

u = g(q)         transmission of each joint (identity, slider-crank, table)
s = A u + b      directions, gear ratios, shared joints, differentials
ds/dt = A g' v,  d2s/dt2 = A (g' a + g'' v^2)
tau_q = (A g')^T tau_s  (virtual work); the servo torques of least norm share a joint
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models.naming import lookup
from .rig import JointItem, Rig
from .virtual.motor import MOTORS

Array = NDArray[np.float64]


class Transmission(Protocol):
    """A monotone function of one joint."""

    def angle(self, q: Array) -> tuple[Array, Array, Array]:
        """Crank angle u, du/dq and d2u/dq2 of joint values (n,)."""
        ...

    def joint(self, u: Array) -> Array:
        """Joint values of crank angles (n,)."""
        ...


@dataclass(frozen=True)
class SliderCrank:
    """x = r sin(u) + sqrt(l^2 - r^2 cos(u)^2), for u in (-pi/2, pi/2).

    Of the triangle r, l, x follows sin(u) = (r^2 + x^2 - l^2) / (2 r x) (law of cosines).
    """

    radius: float
    rod: float

    def angle(self, q: Array) -> tuple[Array, Array, Array]:
        """See Transmission; NaN where the crank does not reach."""
        r, l2 = self.radius, self.rod**2
        with np.errstate(invalid="ignore", divide="ignore"):
            sine = (r * r + q * q - l2) / (2 * r * q)
            d1 = (q * q - r * r + l2) / (2 * r * q * q)
            d2 = (r * r - l2) / (r * q**3)
            cosine = np.sqrt(1 - sine * sine)
            return np.arcsin(sine), d1 / cosine, d2 / cosine + sine * d1 * d1 / cosine**3

    def joint(self, u: Array) -> Array:
        """See Transmission."""
        return np.asarray(
            self.radius * np.sin(u) + np.sqrt(self.rod**2 - (self.radius * np.cos(u)) ** 2), dtype=float
        )


class Table:
    """Monotone cubic through points (joint value, crank angle) (Fritsch, Carlson 1980); straight beyond."""

    def __init__(self, points: list[tuple[float, float]]) -> None:
        from scipy.interpolate import PchipInterpolator

        x, u = np.array(points).T
        self._curve = PchipInterpolator(x, u)
        self._slope, self._bend = self._curve.derivative(1), self._curve.derivative(2)
        self._x, self._u = x, u
        chords = np.diff(u)[[0, -1]] / np.diff(x)[[0, -1]]
        ends = self._slope(x[[0, -1]])
        self._ends = np.where(np.abs(ends) > 1e-3 * np.abs(chords), ends, chords)

    def angle(self, q: Array) -> tuple[Array, Array, Array]:
        """See Transmission."""
        inside = np.clip(q, self._x[0], self._x[-1])
        slope = np.where(q == inside, self._slope(inside), self._end_slope(q))
        return (
            self._curve(inside) + (q - inside) * slope,
            slope,
            np.where(q == inside, self._bend(inside), 0.0),
        )

    def _end_slope(self, q: Array) -> Array:
        """Slope at the nearer end; that of the chord where the cubic is flat there."""
        first, last = self._ends
        return np.asarray(np.where(q < self._x[0], first, last), dtype=float)

    def joint(self, u: Array) -> Array:
        """See Transmission: bisection, which a monotone curve needs and a flat spot survives."""
        u = np.asarray(u, dtype=float)
        rising = self._u[-1] > self._u[0]
        low, high = np.full(u.shape, self._x[0]), np.full(u.shape, self._x[-1])
        for _ in range(54):
            middle = 0.5 * (low + high)
            below = (self._curve(middle) < u) == rising
            low, high = np.where(below, middle, low), np.where(below, high, middle)
        q = 0.5 * (low + high)
        first, last = self._u[0], self._u[-1]
        before, after = ((u < first), (u > last)) if rising else ((u > first), (u < last))
        q = np.where(before, self._x[0] + (u - first) / self._end_slope(np.array(-np.inf)), q)
        return np.asarray(np.where(after, self._x[-1] + (u - last) / self._end_slope(np.array(np.inf)), q))


@dataclass(frozen=True)
class Mapping:
    """Joints (nj) and servos (ns) of a rig, SI.

    Args:
        joints, servos: Names.
        ids: Of the servos.
        matrix: A (ns, nj).
        zero: b (ns,) [rad].
        curves: Transmission of a joint that is not the identity, by column.
        units: Of the joints' values: rad, or m for one that slides.
    """

    joints: tuple[str, ...]
    servos: tuple[str, ...]
    ids: tuple[int, ...]
    matrix: Array
    zero: Array
    curves: dict[int, Transmission]
    units: tuple[str, ...]

    @cached_property
    def inverse(self) -> Array:
        """Least-squares inverse of A (nj, ns): servos that share a joint are averaged."""
        return np.asarray(np.linalg.pinv(self.matrix), dtype=float)

    def servo(self, q: Array) -> Array:
        """Servo angles (..., ns) of joint values (..., nj)."""
        if not self.curves:
            return q @ self.matrix.T + self.zero
        return self._angles(q)[0] @ self.matrix.T + self.zero

    def beyond(self, q: Array) -> NDArray[np.bool_]:
        """Where joint values (..., nj) are out of reach of their transmissions: `servo` gives NaN there."""
        return np.isnan(self._angles(q)[0])

    def rates(self, q: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """Servo velocities and accelerations (..., ns) of a joint motion (..., nj)."""
        _, d1, d2 = self._angles(q)
        return (d1 * v) @ self.matrix.T, (d1 * a + d2 * v * v) @ self.matrix.T

    def joint(self, s: Array) -> Array:
        """Joint values (..., nj) of servo angles (..., ns)."""
        q = (s - self.zero) @ self.inverse.T
        for j, curve in self.curves.items():
            q[..., j] = curve.joint(q[..., j])
        return q

    def joint_rates(self, q: Array, servo_velocity: Array) -> Array:
        """Joint velocities (..., nj) of servo velocities (..., ns) at joint values q."""
        _, d1, _ = self._angles(q)
        return (servo_velocity @ self.inverse.T) / d1

    def disagreement(self, s: Array) -> Array:
        """How far each servo (..., ns) is from where the others that share its joint put it [rad]."""
        d = s - self.zero
        return np.asarray(d - (d @ self.inverse.T) @ self.matrix.T)

    def torque(self, q: Array, tau: Array) -> Array:
        """Servo torques (..., ns) [N m] of least norm that give joint forces tau (..., nj)."""
        _, d1, _ = self._angles(q)
        return (tau / d1) @ self.inverse

    def joint_force(self, q: Array, torque: Array) -> Array:
        """Joint forces (..., nj) of servo torques (..., ns)."""
        _, d1, _ = self._angles(q)
        return d1 * (torque @ self.matrix)

    def _angles(self, q: Array) -> tuple[Array, Array, Array]:
        u, d1, d2 = np.array(q, dtype=float), np.ones(np.shape(q)), np.zeros(np.shape(q))
        for j, curve in self.curves.items():
            u[..., j], d1[..., j], d2[..., j] = curve.angle(q[..., j])
        return u, d1, d2


def make_mapping(rig: Rig) -> Mapping:
    """The mapping of a rig."""
    joints = [j.joint for j in rig.joints]
    row = {s.name: i for i, s in enumerate(rig.servos)}
    matrix, zero = np.zeros((len(row), len(joints))), np.zeros(len(row))
    for column, item in enumerate(rig.joints):
        for d in item.drives:
            matrix[row[d.servo], column] = d.direction * d.ratio
            zero[row[d.servo]] = d.zero * rig.unit
    for block in rig.differentials:
        columns = [joints.index(j) for j in block.joints]
        for k, name in enumerate(block.servos):
            matrix[row[name], columns] = block.matrix[k]
            zero[row[name]] = block.zero[k] * rig.unit if block.zero else 0.0
    curves = {i: c for i, item in enumerate(rig.joints) if (c := _curve(item, rig)) is not None}
    units = tuple("m" if item.slides else "rad" for item in rig.joints)
    return Mapping(tuple(joints), tuple(row), rig.ids, matrix, zero, curves, units)


def _curve(item: JointItem, rig: Rig) -> Transmission | None:
    if item.crank is not None:
        return SliderCrank(item.crank.radius, item.crank.rod)
    if item.points is not None:
        return Table([(x, u * rig.unit) for x, u in item.points])
    return None


@dataclass(frozen=True)
class Bounds:
    """What each servo (ns,) may do, in radian and N m; infinite where nothing limits it.

    `stall` and `free_speed` are the line of the motor: torque = stall (1 - speed / free_speed).
    """

    low: Array
    high: Array
    velocity: Array
    acceleration: Array
    torque: Array
    stall: Array
    free_speed: Array


def make_bounds(rig: Rig) -> Bounds:
    """Limits of the servos: the rig file's, else what the factory limits and the motor allow."""
    from .registers import control_table

    unit, rows = rig.unit, []
    for s in rig.servos:
        table, motor = control_table(s.model), MOTORS[control_table(s.model).model]
        limit = table["velocity_limit"]
        fastest = motor.no_load_speed
        if limit.default:
            fastest = min(fastest, limit.to_si(limit.default))
        current_share = 1.0 if s.current is None else min(1.0, s.current / motor.stall_current)
        low, high = (table[n] for n in ("min_position_limit", "max_position_limit"))
        rows.append(
            (
                s.range[0] * unit if s.range else low.to_si(low.default or 0),
                s.range[1] * unit if s.range else high.to_si(high.default or 4095),
                min(s.velocity * unit, fastest) if s.velocity else fastest,
                s.acceleration * unit if s.acceleration else np.inf,
                min(s.torque or np.inf, motor.stall_torque * current_share),
                motor.stall_torque,
                motor.no_load_speed,
            )
        )
    return Bounds(*np.array(rows, dtype=float).T)


@dataclass(frozen=True)
class JointBounds:
    """Soft limits of each joint (nj,) in the model's units; infinite where nothing limits it."""

    low: Array
    high: Array
    velocity: Array
    acceleration: Array
    torque: Array


def joint_bounds(rig: Rig, model: mujoco.MjModel | None = None) -> JointBounds:
    """Limits of the joints: the rig file's, for the range else the model's."""
    rows = []
    for item in rig.joints:
        unit = rig.joint_unit(item)
        low, high = (-np.inf, np.inf) if item.range is None else (r * unit for r in item.range)
        if item.range is None and model is not None:
            index = lookup(model, "joint", rig.joint_in(model, item.joint))
            if model.jnt_limited[index]:
                low, high = (float(x) for x in model.jnt_range[index])
        rate = [x * unit if x else np.inf for x in (item.velocity, item.acceleration)]
        rows.append((low, high, *rate, item.torque or np.inf))
    low, high, velocity, acceleration, torque = np.array(rows, dtype=float).T
    return JointBounds(low, high, velocity, acceleration, torque)


def park_pose(rig: Rig, start: Array) -> Array:
    """Joint values (nj,) of the stop 'park'; joints without one stay at `start`."""
    poses = zip(rig.joints, start, strict=True)
    return np.array([s if j.park is None else j.park * rig.joint_unit(j) for j, s in poses])


def within_joints(servos: Bounds, mapping: Mapping, joints: JointBounds) -> Bounds:
    """Limits of the servos that also keep each joint's range and speed: what a single goal can be held to."""
    low, high = joints.low.copy(), joints.high.copy()
    speed = joints.velocity.copy()
    for j, curve in mapping.curves.items():
        if np.isfinite(high[j] - low[j]):
            u, slope, _ = curve.angle(np.linspace(low[j], high[j], 257))
            low[j], high[j] = u.min(), u.max()
            speed[j] *= np.abs(slope).max()
        else:
            low[j], high[j], speed[j] = -np.inf, np.inf, np.inf
    used = mapping.matrix != 0
    with np.errstate(invalid="ignore"):
        ends = np.stack([mapping.matrix * low, mapping.matrix * high])
        fast = np.abs(mapping.matrix) * speed
    return replace(
        servos,
        low=np.maximum(servos.low, mapping.zero + np.where(used, ends.min(axis=0), 0.0).sum(axis=1)),
        high=np.minimum(servos.high, mapping.zero + np.where(used, ends.max(axis=0), 0.0).sum(axis=1)),
        velocity=np.minimum(servos.velocity, np.where(used, fast, 0.0).sum(axis=1)),
    )


def indices(rig: Rig, mapping: Mapping, model: mujoco.MjModel) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Places of the rig's joints in qpos and in qvel; ModelError for one that the model lacks."""
    joints = [lookup(model, "joint", rig.joint_in(model, n)) for n in mapping.joints]
    return model.jnt_qposadr[joints].astype(np.intp), model.jnt_dofadr[joints].astype(np.intp)
