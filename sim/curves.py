"""Curves through keys: position, velocity and acceleration, each the exact derivative of the one before.

Every kind of curve, of numbers here and of rotations in `rotations.py`, is a `Curve`: pieces between knots,
held or looped beyond its ends. At a time where a derivative jumps, a curve gives the value from the right,
or from the left when asked to; `breaks` lists these times.
"""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import numpy as np
import scipy
from numpy.typing import ArrayLike, NDArray

from .easings import EASINGS, evaluate_pieces
from .errors import KeyingError, unknown

Array = NDArray[np.float64]
Kind = Literal["step", "linear", "natural", "clamped", "auto"]
Beyond = Literal["hold", "loop"]

KINDS: tuple[Kind, ...] = ("step", "linear", "natural", "clamped", "auto")

_ULPS = 8 * np.finfo(float).eps  # times this close (relative) to a knot are taken to be at the knot
_SAME = 1e-9  # a jump below this fraction of the curve's largest rate is rounding, not a break


class Sample(NamedTuple):
    """A curve at times t: `q` (*t.shape, dim), `v` and `a` (*t.shape, dof), in the keys' unit and seconds."""

    q: Array
    v: Array
    a: Array


@dataclass(frozen=True, eq=False)
class Curve(ABC):
    """A curve through keys: `times` (k,) [s], `values` (k, dim), pieces between `knots`, and its ends.

    Subclasses say what a piece is (`_piece`); ends, loops, sides and breaks are the same for all.
    """

    times: Array
    values: Array
    knots: Array
    before: Beyond
    after: Beyond

    @abstractmethod
    def _piece(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array, Array]:
        """q (n, dim), v and a (n, dof) of pieces `i` (n,) at times `s` (n,) after their first knots."""

    @property
    def start(self) -> float:
        """Time of the first key [s]."""
        return float(self.knots[0])

    @property
    def end(self) -> float:
        """Time of the last key [s]."""
        return float(self.knots[-1])

    @property
    def dim(self) -> int:
        """Numbers a key has: columns of q."""
        return int(self.values.shape[1])

    @property
    def dof(self) -> int:
        """Degrees of freedom: columns of v and a (3 for a rotation, else `dim`)."""
        return self.dim

    def __call__(self, t: ArrayLike, *, left: bool = False) -> Sample:
        """Sample at times `t` [s] of any shape; where q, v or a jumps: from the right, or `left`.

        Outside a held curve v and a are zero. Times within rounding of a knot are taken to be at the knot.
        """
        t = np.asarray(t, dtype=float)
        if not np.all(np.isfinite(t)):
            raise KeyingError("a curve was asked for at a time that is not a finite number")
        tau = self._into_range(t.ravel(), left)
        i = np.searchsorted(self.knots, tau, side="left" if left else "right") - 1
        inside = (i >= 0) & (i < len(self.knots) - 1)
        if inside.all():
            q, v, a = self._piece(i, tau - self.knots[i])
        else:
            q = np.where(i[:, None] < 0, self.values[0], self.values[-1])
            v = np.zeros((tau.size, self.dof))
            a = np.zeros_like(v)
            i = i[inside]
            q[inside], v[inside], a[inside] = self._piece(i, tau[inside] - self.knots[i])
        return Sample(*(x.reshape(*t.shape, x.shape[-1]) for x in (q, v, a)))

    def _into_range(self, t: Array, left: bool) -> Array:
        """Times `t` (n,) brought into the keyed range where the curve loops, and onto knots they mean."""
        tolerance = _ULPS * np.maximum(np.abs(t), max(abs(self.start), abs(self.end)))
        period = self.end - self.start
        looped = np.zeros(t.shape, dtype=bool)
        if period > 0 and self.after == "loop":
            looped |= t > self.end - tolerance
        if period > 0 and self.before == "loop":
            looped |= t < self.start + tolerance
        if looped.any():
            t = np.where(looped, self.start + np.mod(t - self.start, period), t)
        j = np.searchsorted(self.knots, t)
        for knot in (self.knots[np.maximum(j - 1, 0)], self.knots[np.minimum(j, len(self.knots) - 1)]):
            t = np.where(np.abs(t - knot) <= tolerance, knot, t)
        if left:
            return np.where(looped & (t <= self.start), self.end, t)
        return np.where(looped & (t >= self.end), self.start, t)

    @cached_property
    def _jumps(self) -> tuple[Array, NDArray[np.intp]]:
        """Breaks and the order of the lowest derivative that jumps there."""
        before, after = self(self.knots, left=True), self(self.knots)
        order = np.full(self.knots.shape, 3)
        h = np.concatenate([[np.inf], np.diff(self.knots), [np.inf]])
        h = np.minimum(h[:-1], h[1:])  # what rounding of positions is divided by in rates
        for k in (2, 1, 0):
            scale = max(np.abs(before[k]).max(), np.abs(after[k]).max())
            rounding = 1e-12 * np.abs(self.values).max() / h**k
            jump = self._distance(before[k], after[k]) if k == 0 else np.abs(after[k] - before[k]).max(axis=1)
            order[jump > np.maximum(_SAME * scale, rounding)] = k
        found = order < 3
        return frozen(self.knots[found]), order[found]

    def _distance(self, q1: Array, q2: Array) -> Array:
        """Largest difference (n,) between positions (n, dim); rotations know that q and -q are one."""
        return np.asarray(np.abs(q1 - q2).max(axis=1))

    @property
    def breaks(self) -> Array:
        """Times in [start, end] where q, v or a jumps; in a loop, those of one period."""
        return self._jumps[0]

    @property
    def break_orders(self) -> NDArray[np.intp]:
        """For each of `breaks`, the lowest derivative that jumps: 0 position, 1 velocity, 2 acceleration."""
        return self._jumps[1]

    def breaks_between(self, t0: float, t1: float) -> Array:
        """Times strictly between `t0` and `t1` where q, v or a jumps, in every turn of a loop."""
        return self._between(self.breaks, t0, t1)

    def knots_between(self, t0: float, t1: float) -> Array:
        """Times strictly between `t0` and `t1` where a piece ends, in every turn of a loop."""
        return self._between(self.knots, t0, t1)

    def _between(self, times: Array, t0: float, t1: float) -> Array:
        period = self.end - self.start
        found = [times]
        if period > 0 and self.after == "loop":
            turns = range(1, int(np.ceil((t1 - self.start) / period)) + 1)
            found += [times[times > self.start] + k * period for k in turns]
        if period > 0 and self.before == "loop":
            turns = range(int(np.floor((t0 - self.start) / period)) - 1, 0)
            found += [times[times < self.end] + k * period for k in turns]
        every = np.unique(np.concatenate(found))
        return every[(every > t0) & (every < t1)]


@dataclass(frozen=True, eq=False)
class PolynomialCurve(Curve):
    """Piecewise polynomials in time: `coefficients` (degree + 1, pieces, dim), highest power first."""

    coefficients: Array

    def _piece(self, i: NDArray[np.intp], s: Array) -> tuple[Array, Array, Array]:
        return evaluate_pieces(self.coefficients, i, s)


def keyed(
    times: ArrayLike,
    values: ArrayLike,
    *,
    kind: Kind = "auto",
    ease: str | None = None,
    before: Beyond = "hold",
    after: Beyond = "hold",
) -> PolynomialCurve:
    """Curve through `values` (k,) or (k, d) at increasing `times` (k,) [s].

    `kind`:
      - `step`: each value until the next key; `linear`;
      - `natural`: cubic spline, C2 inside, no acceleration at the ends (periodic C2 in a loop);
      - `clamped`: cubic spline, C2 inside, at rest at the ends;
      - `auto`: monotone cubic (Fritsch & Butland 1984), C1 everywhere: at rest where the keys turn
        and where the curve begins or ends to be held, never outside of the two keys around it.
    `ease`: name of an easing (`easings.EASINGS`) that times straight ways between keys, instead of a `kind`.
    `before`, `after`: `hold` the end value, or `loop` with period end - start (first and last value equal).

    Raises KeyingError for keys that are unsorted, not finite, of wrong shape, or do not close their loop.
    """
    t, q = check_keys(times, values)
    kind = check_kind(kind, ease, before, after)
    loops = "loop" in (before, after) and len(t) > 1
    if loops:
        q = _close(q)
    knots, coefficients = t, np.zeros((1, max(len(t) - 1, 0), q.shape[1]))
    if len(t) == 1 or kind == "step":
        coefficients = q[None, :-1]
    elif kind == "linear":
        knots, coefficients = eased_pieces(t, q[:-1], np.diff(q, axis=0), ease)
    elif kind == "auto":
        coefficients = scipy.interpolate.CubicHermiteSpline(t, q, _monotone_slopes(t, q, loops)).c
    else:
        end_condition = "periodic" if loops and kind == "natural" else kind
        coefficients = scipy.interpolate.CubicSpline(t, q, bc_type=end_condition).c
    return PolynomialCurve(frozen(t), frozen(q), frozen(knots), before, after, frozen(coefficients))


def eased_pieces(t: Array, q0: Array, dq: Array, ease: str | None) -> tuple[Array, Array]:
    """Knots and coefficients of q0_i + dq_i e((t - t_i)/h_i) for the m intervals of `t` (m + 1,)."""
    if ease is None:
        return t, np.stack([dq / np.diff(t)[:, None], q0])
    easing, h = EASINGS[ease], np.diff(t)
    knots = np.append((t[:-1, None] + h[:, None] * easing.knots[:-1]).ravel(), t[-1])
    degree = len(easing.coefficients) - 1
    power = np.arange(degree, -1, -1)[:, None]
    scale = 1.0 / h[None, :] ** power
    c = easing.coefficients[:, None, :, None] * scale[:, :, None, None] * dq[None, :, None, :]
    c[-1] += q0[:, None, :]
    return knots, c.reshape(degree + 1, -1, q0.shape[1])


def _monotone_slopes(t: Array, q: Array, loops: bool) -> Array:
    """Slopes (k, d) at the keys: zero where the keys turn, else the limited mean of both sides."""
    h, u = around(np.diff(t), np.diff(q, axis=0) / np.diff(t)[:, None], loops)
    speed = limited_mean(h, np.abs(u))
    return np.asarray(np.where(np.sign(u[:-1]) == np.sign(u[1:]), np.sign(u[1:]) * speed, 0.0))


def around(h: Array, u: Array, loops: bool) -> tuple[Array, Array]:
    """Lengths (m,) and slopes (m, d) of the intervals, with those before and after: still, or of the loop."""
    still = np.zeros_like(u[:1])
    u = np.concatenate([u[-1:] if loops else still, u, u[:1] if loops else still])
    return np.concatenate([h[-1:], h, h[:1]]), u


def limited_mean(h: Array, speed: Array) -> Array:
    """Harmonic mean (k, d), at most three times either, of the speeds (k + 1, d) on both sides of a key.

    1/v = (w0/s0 + w1/s1)/(w0 + w1), w0 = h0 + 2 h1, w1 = 2 h0 + h1 (Fritsch & Butland 1984).
    """
    s0, s1, h0, h1 = speed[:-1], speed[1:], h[:-1, None], h[1:, None]
    w0, w1 = h0 + 2 * h1, 2 * h0 + h1
    slower, faster = np.minimum(s0, s1), np.maximum(s0, s1)
    ratio = np.divide(slower, faster, out=np.zeros_like(slower), where=faster > 0)
    # Written so that no product or quotient of tiny speeds can under- or overflow.
    return np.asarray(slower * (w0 + w1) / np.where(s0 < s1, w0 + w1 * ratio, w0 * ratio + w1))


def check_keys(times: ArrayLike, values: ArrayLike) -> tuple[Array, Array]:
    """Own copies of times (k,) and values (k, d), or KeyingError saying which key is wrong and how."""
    try:
        t = np.array(times, dtype=float)
        q = np.array(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise KeyingError(f"keys must be numbers, the same count in every key: {error}") from None
    if t.ndim != 1 or t.size == 0:
        raise KeyingError(f"key times must be a list of at least one time, not an array of shape {t.shape}")
    if q.ndim == 1:
        q = q[:, None]
    if q.ndim != 2 or q.shape[1] == 0:
        raise KeyingError(f"key values must have shape ({t.size},) or ({t.size}, d), not {q.shape}")
    if len(q) != t.size:
        raise KeyingError(f"{t.size} key times but {len(q)} key values: every key needs both")
    for i in np.flatnonzero(~np.isfinite(t) | ~np.isfinite(q).all(axis=1))[:1]:
        raise KeyingError(f"key {i + 1} is not finite: t = {t[i]}, value {_show(q[i])}")
    for i in np.flatnonzero(np.diff(t) <= 0)[:1]:
        order = "have the same time" if t[i] == t[i + 1] else "are out of order"
        raise KeyingError(
            f"keys {i + 1} and {i + 2} {order} (t = {t[i]:g} s, {t[i + 1]:g} s): times must increase"
        )
    return t, q


def check_kind(kind: str, ease: str | None, before: str, after: str) -> Kind:
    """The kind that is meant, or KeyingError listing what exists."""
    where = "a curve"
    if ease is not None and ease not in EASINGS:
        raise KeyingError(unknown("easing", ease, EASINGS, where=where))
    for end in (before, after):
        if end not in ("hold", "loop"):
            raise KeyingError(unknown("way to go on beyond the keys", end, ("hold", "loop"), where=where))
    if kind not in KINDS:
        raise KeyingError(unknown("kind of curve", kind, KINDS, where=where))
    if ease is None:
        return kind
    if kind not in ("auto", "linear"):
        raise KeyingError(f"ease {ease!r} times straight ways between keys: kind {kind!r} cannot be eased")
    return "linear"


def _close(q: Array) -> Array:
    """Values of a loop, the last exactly as the first."""
    if not np.allclose(q[0], q[-1], rtol=0.0, atol=1e-9 * max(1.0, float(np.abs(q).max()))):
        raise KeyingError(
            f"a loop ends where it begins: make the last key ({_show(q[-1])}) "
            f"equal to the first ({_show(q[0])})"
        )
    return np.concatenate([q[:-1], q[:1]])


def _show(q: Array) -> str:
    return ", ".join(f"{x:.9g}" for x in q)


def frozen(x: Array) -> Array:
    """`x` contiguous and read-only."""
    x = np.ascontiguousarray(x)
    x.setflags(write=False)
    return x
