"""Configurations as tangents, for optimisers: CasADi's side of integrating and differencing on the manifold.

Between neighbours a rotation is R_0 exp(phi), phi a rotation vector; its rate is J_r(phi)^-1 w with w in the
turned frame (G. Chirikjian, Stochastic Models, Information Theory, and Lie Groups 2, 2012, ch. 10.6). All
functions of the angle are written as series in its square: nothing is singular at zero, so that derivatives
of any order are exact.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise
from math import factorial
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ...sim.clip import Clip, FreeTrack, Track
from ...sim.curves import PolynomialCurve, frozen
from ...sim.kinds import BALL, FREE
from ...sim.rotation_curves import RotationCurve
from ...sim.rotations import body_rates, inverse_right_jacobian
from ..nominal import difference

Array = NDArray[np.float64]
_TERMS = 16  # of series: exact to rounding up to two turns


class _Joint(NamedTuple):
    """Where a joint's rotation, and what goes straight, lie in q and v."""

    name: str
    straight: tuple[tuple[int, int], ...]
    turn: tuple[int, int] | None


class Charts:
    """Functions of ``model`` for :mod:`casadi`; q (nq,), tangents and velocities (nv,)."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self.model = model
        self.joints = [self._joint(j) for j in range(model.njnt)]

    def _joint(self, j: int) -> _Joint:
        q, v, kind = int(self.model.jnt_qposadr[j]), int(self.model.jnt_dofadr[j]), self.model.jnt_type[j]
        name = name_of(self.model, "joint", j)
        if kind == FREE:
            return _Joint(name, tuple((q + k, v + k) for k in range(3)), (q + 3, v + 3))
        return _Joint(name, (), (q, v)) if kind == BALL else _Joint(name, ((q, v),), None)

    @cached_property
    def moved(self) -> Any:
        """(q, tangent) -> q."""
        return self._function("moved", self.model.nq, lambda q, d: self._moved(q, d))

    @cached_property
    def apart(self) -> Any:
        """(q, to) -> the tangent from q to ``to``, less than half a turn apart."""
        import casadi as ca

        q, to = ca.SX.sym("q", self.model.nq), ca.SX.sym("to", self.model.nq)
        return ca.Function("apart", [q, to], [self._apart(q, to)])

    @cached_property
    def rate(self) -> Any:
        """(tangent, v) -> the tangent's rate."""
        import casadi as ca

        d, v = ca.SX.sym("d", self.model.nv), ca.SX.sym("v", self.model.nv)
        out = ca.SX(v)
        for joint in self.joints:
            if joint.turn:
                at = joint.turn[1]
                out[at : at + 3] = _inverse_jacobian(d[at : at + 3], v[at : at + 3])
        return ca.Function("rate", [d, v], [out])

    @cached_property
    def flow(self) -> Any:
        """(q, v) -> dq/dt."""
        import casadi as ca

        return self._function(
            "flow",
            self.model.nq,
            lambda q, v: self._each(
                q, v, lambda x, w: w, lambda r, w: 0.5 * _product(r, ca.vertcat(ca.SX(1, 1), w))
            ),
        )

    def _function(self, name: str, size: int, law: Any) -> Any:
        import casadi as ca

        q, v = ca.SX.sym("q", size), ca.SX.sym("v", self.model.nv)
        return ca.Function(name, [q, v], [law(q, v)])

    def _each(self, q: Any, v: Any, straight: Any, turn: Any) -> Any:
        import casadi as ca

        out = ca.SX(self.model.nq, 1)
        for joint in self.joints:
            for a, b in joint.straight:
                out[a] = straight(q[a], v[b])
            if joint.turn:
                a, b = joint.turn
                out[a : a + 4] = turn(q[a : a + 4], v[b : b + 3])
        return out

    def _moved(self, q: Any, d: Any) -> Any:
        return self._each(q, d, lambda x, y: x + y, lambda r, phi: _product(r, _exp(phi)))

    def _apart(self, q: Any, to: Any) -> Any:
        import casadi as ca

        out = ca.SX(self.model.nv, 1)
        for joint in self.joints:
            for a, b in joint.straight:
                out[b] = to[a] - q[a]
            if joint.turn:
                a, b = joint.turn
                back = ca.vertcat(q[a], -q[a + 1 : a + 4])
                out[b : b + 3] = _log(_product(back, to[a : a + 4]))
        return out

    def clip(self, t: Array, q: Array, v: Array, a0: Array, a1: Array, like: Clip) -> Clip:
        """Quintics through q (n, nq), v (n, nv) and, from both sides, accelerations (n - 1, nv) at t (n,)."""
        h, t = np.diff(t)[:, None], frozen(t)
        step = np.array([difference(self.model, x, y) for x, y in pairwise(q)])
        v1, a1 = v[1:].copy(), a1.copy()
        for joint in self.joints:
            if joint.turn:
                cut = slice(joint.turn[1], joint.turn[1] + 3)
                phi, w = step[:, cut], v1[:, cut]
                v1[:, cut] = (inverse_right_jacobian(phi) @ w[:, :, None])[:, :, 0]
                bent = a1[:, cut] - body_rates(phi, v1[:, cut], np.zeros_like(phi)).a
                a1[:, cut] = (inverse_right_jacobian(phi) @ bent[:, :, None])[:, :, 0]
        tangents = quintic(h, (np.zeros_like(step), v[:-1], a0), (step, v1, a1))
        tracks: dict[str, Track] = {}
        for joint in self.joints:
            straight = turning = None
            if joint.straight:
                qs, vs = ([pair[k] for pair in joint.straight] for k in (0, 1))
                powers = tangents[:, :, vs].copy()
                powers[-1] += q[:-1, qs]
                straight = PolynomialCurve(t, frozen(q[:, qs]), t, "hold", "hold", frozen(powers))
            if joint.turn:
                a, b = joint.turn
                rows, powers = frozen(q[:, a : a + 4]), frozen(tangents[:, :, b : b + 3])
                turning = RotationCurve(t, rows, t, "hold", "hold", frozen(rows[:-1]), powers)
            if straight is not None and turning is not None:
                tracks[joint.name] = FreeTrack(straight, turning)
            else:
                only = straight if straight is not None else turning
                assert only is not None
                tracks[joint.name] = only
        return Clip(like.model, tracks, like.q0)


def quintic(h: Array, start: tuple[Array, Array, Array], end: tuple[Array, Array, Array]) -> Array:
    """Coefficients (6, n, k), highest first, of quintics over lengths h (n, 1) with q, v, a at both ends."""
    (q0, v0, a0), (q1, v1, a1) = start, end
    d, e, g = q1 - q0 - h * v0 - 0.5 * h**2 * a0, v1 - v0 - h * a0, a1 - a0
    c3 = 10.0 * d / h**3 - 4.0 * e / h**2 + 0.5 * g / h
    c4 = -15.0 * d / h**4 + 7.0 * e / h**3 - g / h**2
    c5 = 6.0 * d / h**5 - 3.0 * e / h**4 + 0.5 * g / h**3
    return np.stack([c5, c4, c3, 0.5 * a0, v0, q0])


def _series(x: Any, coefficients: list[float]) -> Any:
    out = coefficients[-1]
    for c in coefficients[-2::-1]:
        out = c + x * out
    return out


def _exp(phi: Any) -> Any:
    """Unit quaternion of a rotation vector: cos(th/2), phi sin(th/2) / th."""
    import casadi as ca

    y = 0.25 * ca.dot(phi, phi)
    w = _series(y, [(-1) ** k / factorial(2 * k) for k in range(_TERMS)])
    s = _series(y, [0.5 * (-1) ** k / factorial(2 * k + 1) for k in range(_TERMS)])
    return ca.vertcat(w, s * phi)


def _log(r: Any) -> Any:
    """Rotation vector of a unit quaternion of less than half a turn, the same for r and -r."""
    import casadi as ca

    w, u = r[0], r[1:4]
    x = ca.dot(u, u)
    small = x < 1e-2
    away = ca.if_else(small, 1e-2, x)  # keeps the other branch finite, derivatives included
    # asin(s) / s in x = s^2: (2k)! / (4^k (k!)^2 (2k + 1))
    near = _series(x, [factorial(2 * k) / (4**k * factorial(k) ** 2 * (2 * k + 1)) for k in range(10)])
    ratio = ca.if_else(small, near, ca.atan2(ca.sqrt(away), ca.fabs(w)) / ca.sqrt(away))
    return 2.0 * ca.if_else(w < 0, -1.0, 1.0) * ratio * u


def _inverse_jacobian(phi: Any, w: Any) -> Any:
    """J_r(phi)^-1 w = w + phi x w / 2 + c phi x (phi x w), c = sum |B_2k| th^(2k - 2) / (2k)!."""
    import casadi as ca
    from scipy.special import bernoulli

    numbers = np.abs(bernoulli(2 * _TERMS)[2::2])
    c = _series(ca.dot(phi, phi), [float(b) / factorial(2 * k + 2) for k, b in enumerate(numbers)])
    cross = ca.cross(phi, w)
    return w + 0.5 * cross + c * ca.cross(phi, cross)


def _product(p: Any, q: Any) -> Any:
    """Product of quaternions w, x, y, z."""
    import casadi as ca

    return ca.vertcat(
        p[0] * q[0] - ca.dot(p[1:4], q[1:4]), p[0] * q[1:4] + q[0] * p[1:4] + ca.cross(p[1:4], q[1:4])
    )
