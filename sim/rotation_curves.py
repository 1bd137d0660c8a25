"""Curves through rotations, as ball and free joints have them: the interface of `curves.py` on SO(3).

Between two keys a curve is R_i exp(phi(t)) with phi a polynomial of t in the rotation vectors of key i, which
is slerp for a straight phi, and a rotation spline for a cubic one (Kang & Park 1998, SciPy's
RotationSpline). The samples are q: unit quaternions w x y z, v: angular velocity in the body's frame [rad/s],
a: its derivative [rad/s^2], as MuJoCo has them.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from .curves import (
    Array,
    Beyond,
    Curve,
    Kind,
    around,
    check_keys,
    check_kind,
    eased_pieces,
    frozen,
    limited_mean,
)
from .easings import evaluate_pieces
from .errors import KeyingError
from .rotations import (
    body_rates,
    conjugate,
    exp,
    inverse_right_jacobian,
    log,
    multiply,
    normalize,
    right_jacobian,
)

_HALF_TURN = 1e-8  # |cos(angle/2)| below which rounding, not the user, would choose the way round
_MAX_NEWTON = 30
_TIGHT, _LOOSE = 1e-15, 1e-12  # residuals to reach, and to accept when rounding stops the descent


@dataclass(frozen=True, eq=False)
class RotationCurve(Curve):
    """Rotations origin_i exp(phi(t)): `origins` (pieces, 4), `coefficients` of phi (deg + 1, pieces, 3)."""

    origins: Array
    coefficients: Array

    @property
    def dof(self) -> int:
        """Columns of v and a."""
        return 3

    def _piece(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array, Array]:
        phi, dphi, ddphi = evaluate_pieces(self.coefficients, i, s)
        v, a = body_rates(phi, dphi, ddphi)
        return multiply(self.origins[i], exp(phi)), v, a

    def _distance(self, q1: Array, q2: Array) -> Array:
        return np.asarray(np.minimum(np.abs(q1 - q2).max(axis=1), np.abs(q1 + q2).max(axis=1)))


def keyed_rotation(
    times: ArrayLike,
    quats: ArrayLike,
    *,
    kind: Kind = "auto",
    ease: str | None = None,
    before: Beyond = "hold",
    after: Beyond = "hold",
) -> RotationCurve:
    """Curve through rotations `quats` (k, 4) w x y z (any length, any sign) at increasing `times` (k,) [s].

    Consecutive keys are joined along the shortest arc. Kinds, easings and ends are those of `curves.keyed`:
      - `linear`: slerp; `natural`, `clamped`: rotation splines with continuous angular acceleration;
      - `auto`: C1, at rest where the keys turn back and at held ends, and always on its way from one key to
        the next: the angle made good along the arc never falls back and never passes the key.

    Raises KeyingError as `keyed` does, and for neighbours half a turn apart (both ways round are as short).
    """
    t, q = check_keys(times, quats)
    kind = check_kind(kind, ease, before, after)
    q = _same_side(normalize(q))
    loops = "loop" in (before, after) and len(t) > 1
    if loops:
        _check_closed(q)
    knots, origins = t, q[:-1]
    if len(t) == 1 or kind == "step":
        coefficients = np.zeros((1, len(t) - 1, 3))
    else:
        arcs = _arcs(t, q)
        if kind == "linear":
            knots, coefficients = eased_pieces(t, np.zeros_like(arcs), arcs, ease)
            origins = np.repeat(origins, (len(knots) - 1) // len(arcs), axis=0)
        else:
            h = np.diff(t)
            rates = _limited_rates(h, arcs, loops) if kind == "auto" else _spline_rates(h, arcs, kind, loops)
            coefficients = _cubics(h, arcs, rates)
    return RotationCurve(
        frozen(t), frozen(q), frozen(knots), before, after, frozen(origins), frozen(coefficients)
    )


def through(times: Array, quats: Array, rates: Array) -> RotationCurve:
    """C1 curve through rotations `quats` (k, 4) at `times` (k,) [s] with angular velocities `rates` (k, 3) in
    the body's frame [rad/s]; it ends held. Raises KeyingError for neighbours half a turn apart."""
    q = _same_side(normalize(quats))
    coefficients = _cubics(np.diff(times), _arcs(times, q), rates)
    t = frozen(times.copy())
    return RotationCurve(t, frozen(q), t, "hold", "hold", frozen(q[:-1].copy()), frozen(coefficients))


def _same_side(q: Array) -> Array:
    """Keys (k, 4) with signs such that each is nearest to the one before."""
    sign = np.where(np.sum(q[1:] * q[:-1], axis=1) < 0, -1.0, 1.0)
    return np.asarray(q * np.concatenate([[1.0], np.cumprod(sign)])[:, None])


def _check_closed(q: Array) -> None:
    gap = float(np.linalg.norm(log(multiply(conjugate(q[0]), q[-1]))))
    if gap > 1e-8:
        raise KeyingError(
            f"a loop ends where it begins: the last rotation is {np.degrees(gap):.3g} degrees from the first"
        )


def _arcs(t: Array, q: Array) -> Array:
    """Rotation vectors (k - 1, 3) from each key to the next, in the frame of either."""
    for i in np.flatnonzero(np.abs(np.sum(q[1:] * q[:-1], axis=1)) < _HALF_TURN)[:1]:
        raise KeyingError(
            f"keys {i + 1} and {i + 2} (t = {t[i]:g} s, {t[i + 1]:g} s) are half a turn apart, so that no "
            "way round is the shortest: put a key between them"
        )
    return log(multiply(conjugate(q[:-1]), q[1:]))


def _cubics(h: Array, arcs: Array, rates: Array) -> Array:
    """Coefficients (4, k - 1, 3) of phi from 0 to the arc, with angular velocities `rates` (k, 3) at keys."""
    h = h[:, None]
    d0 = rates[:-1]
    d1 = np.einsum("nij,nj->ni", inverse_right_jacobian(arcs), rates[1:])
    return np.stack(
        [(h * (d0 + d1) - 2 * arcs) / h**3, (3 * arcs - h * (2 * d0 + d1)) / h**2, d0, np.zeros_like(arcs)]
    )


def _limited_rates(h: Array, arcs: Array, loops: bool) -> Array:
    """Angular velocities (k, 3) at the keys that never overshoot an arc.

    The limited mean of the speeds of both arcs times the mean of their directions: on a common axis that is
    the monotone slope of numbers; its part along either arc is between 0 and three
    times that arc's speed, the condition for monotone progress (Fritsch & Carlson 1980).
    """
    h, u = around(h, arcs / h[:, None], loops)
    speed = np.linalg.norm(u, axis=1, keepdims=True)
    direction = np.divide(u, speed, out=np.zeros_like(u), where=speed > 0)
    return np.asarray(limited_mean(h, speed) * 0.5 * (direction[:-1] + direction[1:]))


def _spline_rates(h: Array, arcs: Array, kind: Kind, loops: bool) -> Array:
    """Angular velocities w (k, 3) at the keys that make the angular acceleration continuous, by Newton.

    At key i, between pieces 0 and 1 with J the right Jacobian of arc 0 and K that of arc 1:
        2/h0 J w[i-1] + 4 (1/h0 + 1/h1) w[i] + 2/h1 K^-1 w[i+1] + N0(w[i]) = 6 (arc0/h0^2 + arc1/h1^2),
    where N0(w) = J'(arc0; b) b, b = J^-1 w, is quadratic: its Jacobian comes exactly from its values.
    """
    unit = h.mean()
    h = h[:, None, None] / unit
    m = len(h)
    closed = loops and kind == "natural"
    k = m if closed else m + 1  # the last key of a closed spline is its first
    left, right = np.arange(m), np.arange(1, m + 1) % k
    J, J_inv = right_jacobian(arcs), inverse_right_jacobian(arcs)
    pull = 6 * arcs / h[:, 0] ** 2
    target = np.zeros((k, 3))
    np.add.at(target, left, pull)
    np.add.at(target, right, pull)
    stay = 4 / h * np.eye(3)
    linear = _blocks(
        [(left, left, stay), (left, right, 2 / h * J_inv), (right, left, 2 / h * J), (right, right, stay)], k
    )
    free = np.ones(3 * k, dtype=bool)
    if kind == "clamped":
        free[:3] = free[-3:] = False

    def bend(w: Array) -> Array:
        """N (..., m, 3) for velocities (..., m, 3) at the right keys of all pieces."""
        b = np.einsum("nij,...nj->...ni", J_inv, w)
        return body_rates(np.broadcast_to(arcs, b.shape), b, np.zeros_like(b)).a

    def residual(w: Array, share: float) -> Array:
        r = linear @ w - target.ravel()
        np.add.at(r.reshape(k, 3), right, share * bend(w.reshape(k, 3)[right]))
        return np.where(free, r, 0.0)

    def jacobian(w: Array, share: float) -> Any:
        at = w.reshape(k, 3)[right]
        axes = np.eye(3)[:, None, :] * max(float(np.abs(at).max()), 1.0)
        columns = (bend(at + axes) - bend(at) - bend(np.broadcast_to(axes, (3, m, 3)))) / axes.max()
        every = linear + share * _blocks([(right, right, np.moveaxis(columns, 0, -1))], k)
        return every[free][:, free]

    w = _continued(residual, jacobian, free).reshape(k, 3) / unit
    return np.concatenate([w, w[:1]]) if closed else w


def _blocks(entries: list[tuple[NDArray[np.intp], NDArray[np.intp], Array]], k: int) -> Any:
    """Sparse (3 k, 3 k) matrix of 3 x 3 blocks (n, 3, 3) at block rows and columns (n,)."""
    row = np.concatenate([np.repeat(3 * r[:, None] + np.arange(3), 3, axis=1).ravel() for r, _, _ in entries])
    col = np.concatenate([np.tile(3 * c[:, None] + np.arange(3), 3).ravel() for _, c, _ in entries])
    values = np.concatenate([block.ravel() for _, _, block in entries])
    return scipy.sparse.csc_array((values, (row, col)), shape=(3 * k, 3 * k))


_Residual = Callable[[Array, float], Array]
_Jacobian = Callable[[Array, float], Any]


def _continued(residual: _Residual, jacobian: _Jacobian, free: NDArray[np.bool_]) -> Array:
    """Root of `residual` with all of its nonlinear part, in as few growing shares of it as converge."""
    w, share, step = np.zeros(free.shape), 0.0, 1.0
    while share < 1.0:
        after = min(1.0, share + step)
        found = _newton(residual, jacobian, free, w, after)
        if found is not None:
            w, share, step = found, after, 2 * step
            continue
        step /= 2
        if step < 1e-3:
            raise KeyingError(
                "no rotation spline with continuous angular acceleration was found through these keys, which "
                "turn too far from one to the next: put keys between them, or use kind 'auto'"
            )
    return w


def _newton(
    residual: _Residual, jacobian: _Jacobian, free: NDArray[np.bool_], w: Array, share: float
) -> Array | None:
    """Root over the `free` unknowns from `w` on, or None; from zero, one step solves the linear part."""
    scale = float(np.linalg.norm(residual(np.zeros_like(w), 0.0)))
    r = residual(w, share)
    for _ in range(_MAX_NEWTON):
        if np.linalg.norm(r) <= _TIGHT * scale:
            return w
        dw = np.zeros_like(w)
        dw[free] = scipy.sparse.linalg.splu(jacobian(w, share)).solve(-r[free])
        step, trial = 1.0, residual(w + dw, share)
        while np.linalg.norm(trial) > (1 - 0.1 * step) * np.linalg.norm(r) and step > 0.01:
            step /= 2
            trial = residual(w + step * dw, share)
        if np.linalg.norm(trial) >= np.linalg.norm(r):
            break
        w, r = w + step * dw, trial
    return w if np.linalg.norm(r) <= _LOOSE * scale else None
