"""Turning about fixed axes: the sub-problems that closed forms are made of (Paden & Kahan; Pieper 1968).

Joints are axes in the reference pose, where all turn by zero: points o_i and unit directions u_i in the
world; the frame moves by exp(u_1, th_1) ... exp(u_n, th_n) (product of exponentials; Murray, Li & Sastry
1994, ch. 3).
"""

from __future__ import annotations

from math import acos, atan2, cos, hypot, sin, sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_FLAT = 1e-9  # sines and relative distances below this are zero
_CLEAR = 1e-4  # roots this far from the unit circle are certainly complex


class Roots(NamedTuple):
    """Angles where a function vanishes, and whether these are certainly all."""

    angles: list[float]
    complete: bool


class Axis(NamedTuple):
    """A line: a point and a unit direction."""

    o: Array
    u: Array

    def turn(self, angle: float, p: Array) -> Array:
        """The point p turned about the line."""
        return self.o + turned(self.u, angle, p - self.o)


def turned(u: Array, angle: float, x: Array) -> Array:
    """The vector x turned about the direction u (Rodrigues)."""
    c, s = cos(angle), sin(angle)
    (a, b, d), (x0, x1, x2) = u.tolist(), x.tolist()
    along = (1.0 - c) * (a * x0 + b * x1 + d * x2)
    return np.array(
        [
            c * x0 + s * (b * x2 - d * x1) + along * a,
            c * x1 + s * (d * x0 - a * x2) + along * b,
            c * x2 + s * (a * x1 - b * x0) + along * d,
        ]
    )


def cross(a: Array, b: Array) -> Array:
    """a x b, many times quicker than NumPy's for single vectors."""
    x, y, z = a.tolist()
    u, v, w = b.tolist()
    return np.array([y * w - z * v, z * u - x * w, x * v - y * u])


def turn_matrix(u: Array, angle: float) -> Array:
    """Rotation matrix (3, 3) about the direction u."""
    c, s = cos(angle), sin(angle)
    x, y, z = u.tolist()
    v = 1.0 - c
    return np.array(
        [
            [c + v * x * x, v * x * y - s * z, v * x * z + s * y],
            [v * x * y + s * z, c + v * y * y, v * y * z - s * x],
            [v * x * z - s * y, v * y * z + s * x, c + v * z * z],
        ]
    )


def trig_roots(f: list[float] | Array) -> Roots:
    """Zeros of a trigonometric polynomial of degree 2 given by its values at 0, 72, ..., 288 degrees.

    With z = exp(i th) it is a quartic in z, whose roots on the unit circle count. A root near the circle is
    given, too, but then nothing is certain.
    """
    c = np.fft.fft(np.asarray(f)) / 5  # coefficients of z^0, z^1, z^2, z^-2, z^-1
    quartic = np.array([c[2], c[1], c[0], c[4], c[3]])
    size = np.abs(quartic).max()
    if size < 1e-300:
        return Roots([], False)
    scale = max(float(np.abs(f).max()), 1e-300)
    while len(quartic) > 2 and abs(quartic[0]) < 1e-13 * size and abs(quartic[-1]) < 1e-13 * size:
        quartic = quartic[1:-1]
    if len(quartic) == 1 or size < 1e-12 * scale:
        return Roots([], bool(size > 1e-12 * scale))
    z = np.roots(quartic)
    off = np.abs(np.log(np.maximum(np.abs(z), 1e-300)))
    near = z[off < _CLEAR]
    doubtful = bool(((off > 1e-7) & (off < _CLEAR)).any())
    return Roots([float(a) for a in np.angle(near)], not doubtful)


def around(axis: Array, a: Array, b: Array) -> float | None:
    """Angle about `axis` that turns a's direction onto b's, seen along it; None when one is along it."""
    (x, y, z), (a0, a1, a2), (b0, b1, b2) = axis.tolist(), a.tolist(), b.tolist()
    s, t = a0 * x + a1 * y + a2 * z, b0 * x + b1 * y + b2 * z
    aa, bb = a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2
    a0, a1, a2, b0, b1, b2 = a0 - s * x, a1 - s * y, a2 - s * z, b0 - t * x, b1 - t * y, b2 - t * z
    least = min(a0 * a0 + a1 * a1 + a2 * a2, b0 * b0 + b1 * b1 + b2 * b2)
    if least < _FLAT**2 * max(aa, bb, 1e-300):
        return None
    sine = x * (a1 * b2 - a2 * b1) + y * (a2 * b0 - a0 * b2) + z * (a0 * b1 - a1 * b0)
    return atan2(sine, a0 * b0 + a1 * b1 + a2 * b2)


def linear_trig(a: float, b: float, c: float) -> Roots:
    """Angles with a cos th + b sin th = c; the nearest one, uncertain, when just out of reach."""
    size = hypot(a, b)
    if size < _FLAT * max(1.0, abs(c)):
        return Roots([], abs(c) > 1e-6)
    ratio = c / size
    if abs(ratio) > 1 + _CLEAR:
        return Roots([], True)
    middle, half = atan2(b, a), acos(min(max(ratio, -1.0), 1.0))
    return Roots([middle + half, middle - half], abs(ratio) < 1 - 1e-12)


def two_turns(u1: Array, u2: Array, a: Array, b: Array) -> tuple[list[tuple[float, float]], bool]:
    """(th1, th2) with exp(u1 th1) exp(u2 th2) a = b for unit vectors, and whether these are all.

    a on the second axis leaves th2 open: it is then 0.
    """
    along = a - (a @ u2) * u2
    side = cross(u2, a)
    roots = linear_trig(float(u1 @ along), float(u1 @ side), float(u1 @ b - (a @ u2) * (u1 @ u2)))
    out, complete = [], roots.complete
    for th2 in roots.angles or ([] if roots.complete else [0.0]):
        th1 = around(u1, turned(u2, th2, a), b)
        complete = complete and th1 is not None
        out.append((th1 or 0.0, th2))
    return out, complete


class ThreeTurns(NamedTuple):
    """Angles (k, 3) and whether these are all."""

    angles: list[tuple[float, float, float]]
    complete: bool


def point_by_three(axes: list[Axis], w: Array, target: Array) -> ThreeTurns:
    """Angles about three axes that carry the point `w` to `target` (Pieper's quartic, Craig 2005, ch. 4.6).

    Turning about axis 1 keeps height along and distance from a point o of it; with o and o2 the feet of the
    common normal of axes 1 and 2 (a apart, directions e, f = u2 x e), p = exp(u3 th3) w has x, y, z along
    e, f, u2 from o2 and must fulfil
        x cos th2 - y sin th2 = (r - a^2 - x^2 - y^2 - z^2) / 2a,  r = |target - o|^2
        x sin th2 + y cos th2 = (h - z cos al) / (u1 . f),         h = u1 . (target - o).
    """
    one, two, three = axes
    o, o2, e, a = _feet(one, two)
    f = cross(two.u, e)
    sine, cosine = float(one.u @ f), float(one.u @ two.u)
    r, h = float((target - o) @ (target - o)), float(one.u @ (target - o))
    size = max(a, float(np.linalg.norm(w - o2)), sqrt(r), 1e-9)

    def local(th3: float) -> tuple[float, float, float]:
        p = three.turn(th3, w) - o2
        return float(p @ e), float(p @ f), float(p @ two.u)

    def right(th3: float) -> tuple[float, float, float, float, float]:
        x, y, z = local(th3)
        P = (r - a * a - x * x - y * y - z * z) / 2.0  # times a
        Q = h - z * cosine  # times sine
        return x, y, z, P, Q

    with_a, with_sine = a > 1e-7 * size, abs(sine) > 1e-7

    def residual(th3: float) -> float:
        x, y, _, P, Q = right(th3)
        if with_a and with_sine:
            return float(((P / a) ** 2 + (Q / sine) ** 2 - x * x - y * y) / size**2)
        return float(P / size**2 if with_sine else Q / size)

    roots = trig_roots([residual(2 * np.pi * k / 5) for k in range(5)])
    out: list[tuple[float, float, float]] = []
    complete = roots.complete
    for th3 in roots.angles:
        x, y, _, P, Q = right(th3)
        if with_a and with_sine:
            seconds = [float(np.arctan2(x * Q / sine - y * P / a, x * P / a + y * Q / sine))]
            complete = complete and np.hypot(x, y) > 1e-7 * size
        else:
            second = (
                linear_trig(y, x, Q / sine) if with_sine else linear_trig(x, -y, P / a) if with_a else None
            )
            if second is None:
                return ThreeTurns([], False)
            seconds, complete = second.angles, complete and second.complete
        for th2 in seconds:
            th1 = around(one.u, two.turn(th2, three.turn(th3, w)) - o, target - o)
            complete = complete and th1 is not None
            out.append((th1 or 0.0, th2, th3))
    return ThreeTurns(out, complete)


def _feet(one: Axis, two: Axis) -> tuple[Array, Array, Array, float]:
    """Feet of the common normal on both axes, its unit direction and length; any normal for parallel axes."""
    d = two.o - one.o
    n = cross(one.u, two.u)
    sine = float(np.linalg.norm(n))
    if sine < _FLAT:
        o2 = two.o
        o = one.o + (d @ one.u) * one.u
        e = o2 - o
        a = float(np.linalg.norm(e))
        return o, o2, (e / a if a > 1e-12 else across(one.u)), a
    n = n / sine
    s, _, t = np.linalg.solve(np.column_stack([one.u, n, -two.u]), d)
    o, o2 = one.o + s * one.u, two.o + t * two.u
    a = float(n @ (o2 - o))
    return o, o2, (n if a >= 0 else -n), abs(a)


def across(u: Array) -> Array:
    """A unit vector across u."""
    k = int(np.argmin(np.abs(u)))
    e = np.zeros(3)
    e[k] = 1.0
    out = e - u[k] * u
    return np.asarray(out / sqrt(out @ out))


def meeting_point(axes: list[Axis]) -> Array | None:
    """The point where all axes meet, or None."""
    A = np.concatenate([np.eye(3) - np.outer(axis.u, axis.u) for axis in axes])
    b = np.concatenate([axis.o - (axis.u @ axis.o) * axis.u for axis in axes])
    p, _, rank, _ = np.linalg.lstsq(A, b, rcond=1e-9)
    apart = max(float(np.linalg.norm(cross(axis.u, p - axis.o))) for axis in axes)
    reach = max(float(np.linalg.norm(axis.o - axes[0].o)) for axis in axes)
    return np.asarray(p) if rank == 3 and apart < 1e-8 * max(reach, 1.0) else None


def three_turns(axes: list[Axis], R: Array) -> ThreeTurns:
    """Angles with exp(u1 th1) exp(u2 th2) exp(u3 th3) = R, and whether these are all."""
    u1, u2, u3 = (axis.u for axis in axes)
    pairs, complete = two_turns(u1, u2, u3, R @ u3)
    out = []
    side = across(u3)
    for th1, th2 in pairs:
        before = R @ side
        back = turned(u2, -th2, turned(u1, -th1, before))
        th3 = around(u3, side, back)
        out.append((th1, th2, th3 or 0.0))
    return ThreeTurns(out, complete)
