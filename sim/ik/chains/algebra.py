"""Vectors, rotations and small linear systems of expressions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ...compile.graph import Scalar, absolute, atan2, cos, less, maximum, sin, sqrt

Array = NDArray[np.float64]
Vector = list[Scalar]
ZERO: Vector = [0.0, 0.0, 0.0]


def dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Inner product."""
    return total(x * y for x, y in zip(a, b, strict=True))


def total(xs) -> Scalar:  # type: ignore[no-untyped-def]
    """Sum."""
    out: Scalar = 0.0
    for x in xs:
        out = out + x
    return out


def cross(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """a x b."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def plus(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


def minus(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """a - b."""
    return [x - y for x, y in zip(a, b, strict=True)]


def scaled(s: Scalar, a: Sequence[Scalar]) -> Vector:
    """s a."""
    return [s * x for x in a]


def times(M: Sequence[Sequence[Scalar]], x: Sequence[Scalar]) -> Vector:
    """Matrix, by rows, times a vector."""
    return [dot(row, x) for row in M]


def transposed(M: Sequence[Sequence[Scalar]]) -> list[Vector]:
    """Rows of the transpose."""
    return [list(column) for column in zip(*M, strict=True)]


def product(A: Sequence[Sequence[Scalar]], B: Sequence[Sequence[Scalar]]) -> list[Vector]:
    """A B."""
    columns = transposed(B)
    return [[dot(row, column) for column in columns] for row in A]


def offset(R: list[Vector], p: Vector, X: Array) -> tuple[list[Vector], Vector]:
    """The pose R, p followed by the constant pose X (4, 4)."""
    X = np.where(np.abs(X) < 1e-13, 0.0, X)
    near = np.abs(np.abs(X[:3, :3]) - 1.0) < 1e-13
    X[:3, :3][near] = np.sign(X[:3, :3][near])
    turned = [[dot(row, [float(x) for x in X[:3, k]]) for k in range(3)] for row in R]
    moved = [a + dot(row, [float(x) for x in X[:3, 3]]) for a, row in zip(p, R, strict=True)]
    return turned, moved


def spun(R: list[Vector], angle: Scalar) -> list[Vector]:
    """R turned about its third axis."""
    c, s = cos(angle), sin(angle)
    return [[c * a + s * b, c * b - s * a, z] for a, b, z in R]


def matrix(quat: Sequence[Scalar]) -> list[Vector]:
    """Rotation matrix, by rows, of a unit quaternion."""
    w, x, y, z = quat
    return [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]


def quaternion(R: Sequence[Sequence[Scalar]]) -> Vector:
    """Quaternion of either sign, by the largest of its four components (Shepperd 1978)."""
    (a, b, c), (d, e, f), (g, h, i) = R
    rows: list[Vector] = [
        [1 + a + e + i, h - f, c - g, d - b],
        [h - f, 1 + a - e - i, b + d, c + g],
        [c - g, b + d, 1 - a + e - i, f + h],
        [d - b, c + g, f + h, 1 - a - e + i],
    ]
    best, largest = rows[0], rows[0][0]
    for k in (1, 2, 3):
        larger = less(largest, rows[k][k])
        best = [x + larger * (y - x) for x, y in zip(best, rows[k], strict=True)]
        largest = maximum(largest, rows[k][k])
    return scaled(1.0 / sqrt(dot(best, best)), best)


def log_quaternion(quat: Sequence[Scalar]) -> tuple[Vector, Scalar]:
    """Rotation vector on the shortest arc, and c = (1 - h / tan h) / |phi|^2 with h = |phi| / 2."""
    w, *u = quat
    n = sqrt(dot(u, u))
    half = atan2(n, absolute(w))
    inverse = 1.0 / maximum(n, 1e-100)
    sign = 1.0 - 2.0 * less(w, 0.0)
    phi = scaled(2.0 * half * inverse * sign, u)
    th2 = 4.0 * half * half
    series = 1 / 12 + th2 * (1 / 720 + th2 * (1 / 30240))
    closed = (1.0 - half * absolute(w) * inverse) / maximum(th2, 1e-10)
    return phi, series + less(0.0025, th2) * (closed - series)


def inverse_jacobian(phi: Vector, c: Scalar, sign: float) -> list[Vector]:
    """Inverse right (sign 1) or left (-1) Jacobian of SO(3), by rows (see `rotations`)."""
    x, y, z = phi
    S: list[Vector] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
    square = dot(phi, phi)
    out = []
    for i in range(3):
        row: Vector = []
        for k in range(3):
            value = c * (phi[i] * phi[k]) + (0.5 * sign) * S[i][k]
            row.append(value + (1.0 - c * square) if i == k else value)
        out.append(row)
    return out


def multiplied(p: Sequence[Scalar], q: Sequence[Scalar]) -> Vector:
    """Product of quaternions."""
    turned = plus(plus(scaled(p[0], q[1:]), scaled(q[0], p[1:])), cross(p[1:], q[1:]))
    return [p[0] * q[0] - dot(p[1:], q[1:]), *turned]


def solved(A: list[list[Scalar]], damping: list[Scalar], b: list[Scalar]) -> list[Scalar]:
    """(A + diag(damping)) x = b by L D L^T of the lower triangle A, pivots at least the damping."""
    n = len(b)
    L: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
    inverse: list[Scalar] = []
    y = list(b)
    half: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
    for i in range(n):
        for k in range(i):
            v = A[i][k] - total(L[k][m] * half[i][m] for m in range(k))
            half[i][k] = v
            L[i][k] = v * inverse[k]
        pivot = A[i][i] + damping[i] - total(L[i][m] * half[i][m] for m in range(i))
        inverse.append(1.0 / maximum(pivot, damping[i]))
        y[i] = y[i] - total(L[i][m] * y[m] for m in range(i))
    x = [v * w for v, w in zip(y, inverse, strict=True)]
    for i in reversed(range(n)):
        x[i] = x[i] - total(L[m][i] * x[m] for m in range(i + 1, n))
    return x
