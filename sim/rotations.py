"""Quaternions, w x y z and unit, over any leading shape; rotation curves are in `rotation_curves.py`.

exp and log map rotation vectors (axis times angle, rad) to rotations and back; products read as frames do,
q_WC = multiply(q_WB, q_BC). The only place that converts quaternion orders.
"""

from math import factorial
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from .errors import KeyingError

Array = NDArray[np.float64]


def multiply(p: ArrayLike, q: ArrayLike) -> Array:
    """Product p q (..., 4): the rotation q followed, in the outer frame, by p."""
    p, q = np.asarray(p, dtype=float), np.asarray(q, dtype=float)
    pw, px, py, pz = np.moveaxis(p, -1, 0)
    qw, qx, qy, qz = np.moveaxis(q, -1, 0)
    return np.stack(
        [
            pw * qw - px * qx - py * qy - pz * qz,
            pw * qx + px * qw + py * qz - pz * qy,
            pw * qy - px * qz + py * qw + pz * qx,
            pw * qz + px * qy - py * qx + pz * qw,
        ],
        axis=-1,
    )


def conjugate(q: ArrayLike) -> Array:
    """Inverse rotation (..., 4)."""
    return np.asarray(np.asarray(q, dtype=float) * [1.0, -1.0, -1.0, -1.0])


def normalize(q: ArrayLike) -> Array:
    """Unit quaternions (..., 4) along `q`; KeyingError for one that is zero or not finite."""
    q = np.asarray(q, dtype=float)
    if q.shape[-1:] != (4,):
        raise KeyingError(f"a quaternion has four numbers w, x, y, z, not an array of shape {q.shape}")
    largest = np.abs(q).max(
        axis=-1, keepdims=True
    )  # divided out first, so that no square over- or underflows
    if not np.all(np.isfinite(largest) & (largest > 0)):
        raise KeyingError(
            "a quaternion is zero or not finite: it means no rotation; the identity is 1, 0, 0, 0"
        )
    q = q / largest
    return np.asarray(q / np.linalg.norm(q, axis=-1, keepdims=True))


def exp(phi: ArrayLike) -> Array:
    """Rotation (..., 4) by the rotation vector `phi` (..., 3) [rad]."""
    phi = np.asarray(phi, dtype=float)
    half = 0.5 * np.linalg.norm(phi, axis=-1, keepdims=True)
    return np.concatenate([np.cos(half), 0.5 * np.sinc(half / np.pi) * phi], axis=-1)


def log(q: ArrayLike) -> Array:
    """Rotation vector (..., 3) [rad] of `q` on the shortest arc: at most pi long, the same for q and -q."""
    q = np.asarray(q, dtype=float)
    w, u = q[..., :1], q[..., 1:]
    n = np.linalg.norm(u, axis=-1, keepdims=True)
    half = np.arctan2(n, np.abs(w))
    factor = 2.0 * np.divide(half, n, out=np.ones_like(n), where=n > 0)
    return np.asarray(np.copysign(factor, w) * u)


def rotate(q: ArrayLike, x: ArrayLike) -> Array:
    """Vectors `x` (..., 3) turned by `q` (..., 4)."""
    q, x = np.asarray(q, dtype=float), np.asarray(x, dtype=float)
    w, u = q[..., :1], q[..., 1:]
    c = 2.0 * np.cross(u, x)
    return np.asarray(x + w * c + np.cross(u, c))


def to_matrix(q: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3)."""
    w, x, y, z = np.moveaxis(np.asarray(q, dtype=float), -1, 0)
    out = np.empty((*w.shape, 3, 3))
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    for i, row in enumerate(rows):
        for j, entry in enumerate(row):
            out[..., i, j] = entry
    return out


def from_matrix(R: ArrayLike) -> Array:
    """Quaternions (..., 4), w >= 0, of rotation matrices (..., 3, 3); the nearest if not orthogonal."""
    R = np.asarray(R, dtype=float)
    q = scipy.spatial.transform.Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(
        canonical=True, scalar_first=True
    )
    return np.asarray(q).reshape(*R.shape[:-2], 4)


def from_euler(seq: str, angles: ArrayLike) -> Array:
    """Quaternions (..., 4) of angles (..., len(seq)) [rad] about fixed ("xyz") or moving axes ("XYZ")."""
    angles = np.asarray(angles, dtype=float)
    if angles.shape[-1:] != (len(seq),):
        raise KeyingError(
            f"Euler angles {seq!r} are {len(seq)} numbers, not an array of shape {angles.shape}"
        )
    try:
        q = scipy.spatial.transform.Rotation.from_euler(seq, angles.reshape(-1, len(seq))).as_quat(
            scalar_first=True
        )
    except ValueError as error:
        raise KeyingError(f"Euler sequence {seq!r}: {error}") from None
    return np.asarray(q).reshape(*angles.shape[:-1], 4)


def wxyz_from_xyzw(q: ArrayLike) -> Array:
    """Ours from the order of SciPy, glTF, ROS and URDF tools."""
    return np.roll(np.asarray(q, dtype=float), 1, axis=-1)


def xyzw_from_wxyz(q: ArrayLike) -> Array:
    """Order of SciPy, glTF, ROS and URDF tools from ours."""
    return np.roll(np.asarray(q, dtype=float), -1, axis=-1)


class BodyRates(NamedTuple):
    """Angular velocity `v` and acceleration `a` (..., 3) in the body's frame."""

    v: Array
    a: Array


def body_rates(phi: Array, dphi: Array, ddphi: Array) -> BodyRates:
    """Rates of the rotation exp(phi(t)) from phi and its derivatives (..., 3).

    v = J phi', a = J phi'' + J' phi' with the right Jacobian of SO(3),
    J(phi) x = x - A phi × x + B phi × (phi × x), A = (1 - cos th)/th^2, B = (th - sin th)/th^3, th = |phi|
    (Chirikjian 2012, ch. 10.6).
    """
    A, B, dA, dB = _jacobian_coefficients(phi)
    d = np.sum(phi * dphi, axis=-1, keepdims=True)  # th th'
    c = np.cross(phi, dphi)
    cc = np.cross(phi, c)
    v = dphi - A * c + B * cc
    e = np.cross(phi, ddphi)
    a = ddphi - A * e + B * (np.cross(phi, e) + np.cross(dphi, c)) + d * (dB * cc - dA * c)
    return BodyRates(np.asarray(v), np.asarray(a))


def inverse_right_jacobian(phi: ArrayLike) -> Array:
    """J(phi)^-1 (..., 3, 3): phi' = J^-1 v for exp(phi(t)) with body velocity v; |phi| < 2 pi."""
    phi = np.asarray(phi, dtype=float)
    th = np.linalg.norm(phi, axis=-1)[..., None, None]
    h = 0.5 * th
    with np.errstate(invalid="ignore", divide="ignore"):
        c = np.where(th < 0.05, 1 / 12 + th**2 / 720 + th**4 / 30240, (1.0 - h / np.tan(h)) / th**2)
    S = skew(phi)
    return np.asarray(np.eye(3) + 0.5 * S + c * (S @ S))


def right_jacobian(phi: ArrayLike) -> Array:
    """J(phi) (..., 3, 3), see `body_rates`."""
    phi = np.asarray(phi, dtype=float)
    A, B, _, _ = (x[..., None] for x in _jacobian_coefficients(phi))
    S = skew(phi)
    return np.asarray(np.eye(3) - A * S + B * (S @ S))


def skew(x: ArrayLike) -> Array:
    """Matrices (..., 3, 3) with skew(x) y = x × y."""
    x = np.asarray(x, dtype=float)
    S = np.zeros((*x.shape, 3))
    S[..., 2, 1] = x[..., 0]
    S[..., 0, 2] = x[..., 1]
    S[..., 1, 0] = x[..., 2]
    return S - np.swapaxes(S, -1, -2)


# Taylor coefficients in th^2 of A, B, A'/th, B'/th; closed forms lose digits below th = 1.5.
_k = range(12)
_TAYLOR = np.array(
    [
        [(-1.0) ** k / factorial(2 * k + 2) for k in _k],
        [(-1.0) ** k / factorial(2 * k + 3) for k in _k],
        [(-1.0) ** (k + 1) * 2 * (k + 1) / factorial(2 * k + 4) for k in _k],
        [(-1.0) ** (k + 1) * 2 * (k + 1) / factorial(2 * k + 5) for k in _k],
    ]
)


def _jacobian_coefficients(phi: Array) -> tuple[Array, Array, Array, Array]:
    """A, B, A'/th and B'/th (..., 1) of `body_rates`."""
    th = np.linalg.norm(phi, axis=-1, keepdims=True)
    small = np.minimum(th, 1.5) ** 2
    series = [np.polynomial.polynomial.polyval(small, c) for c in _TAYLOR]
    if (th < 1.5).all():
        return tuple(series)
    x = np.maximum(th, 1.5)
    s, c = np.sin(x), np.cos(x)
    closed = (
        (1 - c) / x**2,
        (x - s) / x**3,
        (x * s - 2 * (1 - c)) / x**4,
        (3 * s - x * c - 2 * x) / x**5,
    )
    A, B, dA, dB = (np.where(th < 1.5, low, high) for low, high in zip(series, closed, strict=True))
    return A, B, dA, dB
