"""Three-vectors, rotations and second moments over generic scalars (numbers or graph nodes).

Vectors are lists of three, matrices lists of three rows; products with exact zeros and ones vanish.
"""

from __future__ import annotations

from collections.abc import Sequence

from ...compile.graph import Scalar, absolute, atan2, cos, less, sin, sqrt

Vector = list[Scalar]
Matrix = list[list[Scalar]]
Turn = tuple[int, Scalar, Scalar]  # axis, cosine, sine

_PLANE = ((1, 2), (2, 0), (0, 1))


def zeros() -> Vector:
    """The zero vector."""
    return [0.0, 0.0, 0.0]


def add(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """a + b."""
    return [x + y for x, y in zip(a, b, strict=True)]


def sub(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """a - b."""
    return [x - y for x, y in zip(a, b, strict=True)]


def scale(k: Scalar, a: Sequence[Scalar]) -> Vector:
    """k a."""
    return [k * x for x in a]


def dot(a: Sequence[Scalar], b: Sequence[Scalar]) -> Scalar:
    """Scalar product."""
    total: Scalar = 0.0
    for x, y in zip(a, b, strict=True):
        total = total + x * y
    return total


def cross(a: Sequence[Scalar], b: Sequence[Scalar]) -> Vector:
    """Vector product."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


def times(m: Matrix, v: Sequence[Scalar]) -> Vector:
    """m v."""
    return [dot(row, v) for row in m]


def transposed_times(m: Matrix, v: Sequence[Scalar]) -> Vector:
    """m^T v."""
    return [dot([m[j][i] for j in range(3)], v) for i in range(3)]


def product(a: Matrix, b: Matrix) -> Matrix:
    """a b."""
    return [[dot(row, [b[k][j] for k in range(3)]) for j in range(3)] for row in a]


def rotation_of_quaternion(q: Sequence[Scalar]) -> Matrix:
    """Rotation matrix of the quaternion `q` (wxyz) of any length; R = 1 + (2/|q|^2)(w [u] + [u]^2)."""
    w, x, y, z = q
    s = 2.0 / (w * w + x * x + y * y + z * z)
    sx, sy, sz = s * x, s * y, s * z
    xx, yy, zz, xy, xz, yz = x * sx, y * sy, z * sz, x * sy, x * sz, y * sz
    wx, wy, wz = w * sx, w * sy, w * sz
    return [
        [1.0 - (yy + zz), xy - wz, xz + wy],
        [xy + wz, 1.0 - (xx + zz), yz - wx],
        [xz - wy, yz + wx, 1.0 - (xx + yy)],
    ]


def quaternion_product(a: Sequence[Scalar], b: Sequence[Scalar]) -> list[Scalar]:
    """Hamilton product of quaternions wxyz."""
    v = add(add(scale(a[0], b[1:]), scale(b[0], a[1:])), cross(a[1:], b[1:]))
    return [a[0] * b[0] - dot(a[1:], b[1:]), *v]


def quaternion_rate(q: Sequence[Scalar], w: Sequence[Scalar]) -> list[Scalar]:
    """Time derivative of a quaternion for the angular velocity `w` in the turned frame: q (0, w) / 2."""
    return quaternion_product(q, [0.0, *scale(0.5, w)])


def quaternion(turn: Sequence[Scalar]) -> list[Scalar]:
    """Unit quaternion (wxyz) of the rotation vector `turn`."""
    angle = sqrt(dot(turn, turn) + 1e-200)  # never zero: the ratio below stays exact
    return [cos(0.5 * angle), *scale(sin(0.5 * angle) / angle, turn)]


def rotation_vector(q: Sequence[Scalar]) -> Vector:
    """Axis times angle (at most pi) of the quaternion `q` (wxyz) of any length."""
    w, u = q[0], list(q[1:])
    length = sqrt(dot(u, u) + 1e-200)  # never zero: the ratio below stays exact
    half = atan2(length, absolute(w)) / length
    return scale(2.0 * half * (1.0 - 2.0 * less(w, 0.0)), u)


def turn(t: Turn, v: Sequence[Scalar]) -> Vector:
    """Rotation of `v` about one axis."""
    axis, c, s = t
    i, j = _PLANE[axis]
    out = list(v)
    out[i], out[j] = c * v[i] - s * v[j], s * v[i] + c * v[j]
    return out


def turn_back(t: Turn, v: Sequence[Scalar]) -> Vector:
    """Inverse of `turn`."""
    axis, c, s = t
    return turn((axis, c, -s), v)


def _quarter(t: Turn) -> bool:
    return not (hasattr(t[1], "op") or hasattr(t[2], "op")) and (t[1] == 0.0 or t[2] == 0.0)


def turn_symmetric(t: Turn, m: Matrix) -> Matrix:
    """R m R^T for a symmetric `m`, with the fewest products: A' = A - s k, D' = D + s k, B' = c k - B."""
    axis, c, s = t
    i, j = _PLANE[axis]
    k = axis
    a, b, d, e, f = m[i][i], m[i][j], m[j][j], m[i][k], m[j][k]
    out = [list(row) for row in m]
    if _quarter(t):
        out[i][i], out[j][j], new_b = (d, a, -b) if c == 0.0 else (a, d, b)
    else:
        common = s * (a - d) + c * (b + b)
        shift = s * common
        out[i][i], out[j][j], new_b = a - shift, d + shift, c * common - b
    out[i][j] = out[j][i] = new_b
    out[i][k] = out[k][i] = c * e - s * f
    out[j][k] = out[k][j] = s * e + c * f
    return out


def turn_general(t: Turn, m: Matrix) -> Matrix:
    """R m R^T for any `m`."""
    axis, c, s = t
    i, j = _PLANE[axis]
    k = axis
    a, b1, b2, d = m[i][i], m[i][j], m[j][i], m[j][j]
    out = [list(row) for row in m]
    if _quarter(t):
        if c == 0.0:
            out[i][i], out[j][j], out[i][j], out[j][i] = d, a, -b2, -b1
    else:
        common = s * (a - d) + c * (b1 + b2)
        shift, mixed = s * common, c * common
        out[i][i], out[j][j] = a - shift, d + shift
        out[i][j], out[j][i] = mixed - b2, mixed - b1
    out[i][k], out[j][k] = c * m[i][k] - s * m[j][k], s * m[i][k] + c * m[j][k]
    out[k][i], out[k][j] = c * m[k][i] - s * m[k][j], s * m[k][i] + c * m[k][j]
    return out


def congruence(r: Matrix, m: Matrix, *, symmetric: bool) -> Matrix:
    """r m r^T."""
    half = product(r, m)
    if not symmetric:
        return [[dot(half[i], r[j]) for j in range(3)] for i in range(3)]
    out = [zeros() for _ in range(3)]
    for i in range(3):
        for j in range(i, 3):
            out[i][j] = out[j][i] = dot(half[i], r[j])
    return out
