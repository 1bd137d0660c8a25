"""What a linear loop is worth: modes, margins, step response figures, root locus."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from .linear import LinearSystem

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
_EDGE = 1e-9  # poles so near the edge of stability lie on it
_SPLIT = 1e-7  # rounding splits double poles by about so much


@dataclass(frozen=True)
class Mode:
    """A pole, with its natural ``frequency`` [rad/s] and ``damping`` ratio (of a discrete pole: of the
    continuous one it samples; NaN without a period), whether it dies out, and ``of`` which states."""

    pole: complex
    frequency: float
    damping: float
    stable: bool
    of: str = ""

    @property
    def damped(self) -> float:
        """Real part of a continuous pole [1/s]."""
        return self.pole.real

    def __str__(self) -> str:
        of = f" of {self.of}" if self.of else ""
        if not np.isfinite(self.frequency):
            return f"{self.pole:.4g}{of} ({'stable' if self.stable else 'unstable'})"
        stable = "dies out" if self.stable else "does not die out"
        return f"{self.frequency:.4g} rad/s{of} (damping {self.damping:.2f}, {stable})"


def modes(A: ArrayLike, *, period: float | None = None) -> tuple[Mode, ...]:
    """Modes of dx/dt = A x, or of x+ = A x with a ``period`` [s], slowest first."""
    poles = np.asarray(linalg.eigvals(np.asarray(A, dtype=float)), dtype=complex)
    found = [mode_of(complex(p), discrete=period is not None, period=period) for p in poles]
    return tuple(sorted(found, key=lambda m: (m.frequency, m.pole.imag)))


def mode_of(pole: complex, *, discrete: bool, period: float | None = None) -> Mode:
    """The mode of a pole, of dx/dt = A x or, ``discrete``, of x+ = A x."""
    if not discrete:
        size = abs(pole)
        return Mode(pole, size, -pole.real / size if size else 1.0, pole.real < -_EDGE * min(size, 1.0))
    stable = abs(pole) < 1.0 - _EDGE
    if period is None or pole == 0:
        return Mode(pole, np.nan, np.nan, stable)
    s = np.log(pole) / period
    return Mode(pole, abs(s), -s.real / abs(s) if s else 1.0, stable)


def closed_loop(system: LinearSystem, K: ArrayLike) -> LinearSystem:
    """``system`` under u = -K x, its inputs disturbances added to u."""
    A = system.A - system.B @ np.asarray(K, dtype=float)
    return LinearSystem(A, system.B.copy(), system.states, system.inputs, system.period)


def loop_response(system: LinearSystem, K: ArrayLike, w: ArrayLike, *, input: int = 0) -> Complex:
    """Loop gain L(jw) seen when the loop u = -K x is cut at one ``input``, the others closed; w [rad/s]."""
    K = np.asarray(K, dtype=float)
    others = np.arange(len(K)) != input
    A = system.A - system.B[:, others] @ K[others]
    b, k, w = system.B[:, input], K[input], np.asarray(w, dtype=float)
    points = 1j * w if system.period is None else np.exp(1j * w * system.period)
    eye = np.eye(len(A))
    return np.array([k @ np.linalg.solve(s * eye - A, b.astype(complex)) for s in points.ravel()]).reshape(
        w.shape
    )


@dataclass(frozen=True)
class Margins:
    """How much a loop stands before it loses stability.

    ``gain``: factors (least < 1, greatest > 1) on the loop gain; ``phase`` [rad] of lag; ``delay`` [s];
    ``disk``: distance of the loop's curve to -1 (1 / peak sensitivity), the one number that covers gain and
    phase together; ``crossover`` [rad/s] where the phase margin is. An unstable loop has no room at all: its
    factors are 1, the others 0.
    """

    gain: tuple[float, float]
    phase: float
    delay: float
    disk: float
    crossover: float
    stable: bool = True


def margins(system: LinearSystem, K: ArrayLike, *, input: int = 0, points: int = 2000) -> Margins:
    """Margins of the loop cut at one ``input``; crossings are refined between ``points`` frequencies."""
    poles = linalg.eigvals(system.A - system.B @ np.asarray(K, dtype=float))
    if growth(poles, system.period) > 0.0:
        return Margins((1.0, 1.0), 0.0, 0.0, 0.0, np.nan, stable=False)
    if system.period is None:
        sizes = np.abs(np.concatenate([linalg.eigvals(system.A), poles]))
        high = 1e3 * max(sizes.max(), 1e-3)
        low = 1e-3 * max(sizes[sizes > 1e-9].min(initial=1.0), 1e-6)
    else:
        high, low = np.pi / system.period, 1e-6 / system.period
    w = np.geomspace(low, high, points)
    L = loop_response(system, K, w, input=input)
    turn = np.unwrap(np.angle(L))
    upper, lower, crossover, phase, delay = np.inf, 0.0, np.nan, np.inf, np.inf

    def at(frequency: float) -> complex:
        return complex(loop_response(system, K, np.array([frequency]), input=input)[0])

    for i in np.flatnonzero(np.diff(np.sign(np.abs(L) - 1.0))):
        root = _refine(lambda x: abs(at(x)) - 1.0, w[i], w[i + 1])
        lag = float(np.mod(np.angle(at(root)) + np.pi, 2.0 * np.pi))
        if lag < phase:
            phase, crossover = lag, root
        delay = min(delay, lag / root)
    for i in np.flatnonzero(np.diff(np.floor((turn - np.pi) / (2.0 * np.pi)))):
        root = _refine(lambda x: (at(x) / abs(at(x))).imag, w[i], w[i + 1])
        factor = 1.0 / abs(at(root))
        upper, lower = (min(upper, factor), lower) if factor > 1 else (upper, max(lower, factor))
    for edge in (0.0,) if system.period is None else (0.0, np.pi / system.period):
        # the real axis is met at zero frequency, and at Nyquist's, without being crossed
        if np.abs((0.0 if edge == 0.0 else -1.0) - _as_seen(system, K, input)).min() < 1e-9:
            continue  # a pole lies there: the curve ends at infinity
        value = at(edge).real
        if value < 0:
            factor = -1.0 / value
            upper, lower = (min(upper, factor), lower) if factor > 1 else (upper, max(lower, factor))
    return Margins((lower, upper), phase, delay, float(np.abs(1.0 + L).min()), crossover)


def growth(poles: ArrayLike, period: float | None = None) -> float:
    """Rate [1/s] of the fastest growing of ``poles``, 0 where none grows: what lasts counts as such, also
    double poles that rounding splits."""
    poles = np.asarray(poles, dtype=complex)
    rate = float(poles.real.max() if period is None else np.log(np.abs(poles).max()) / period)
    edge = _SPLIT * max(1.0, float(np.abs(poles).max())) if period is None else _SPLIT / period
    return rate if rate > edge else 0.0


def _as_seen(system: LinearSystem, K: ArrayLike, input: int) -> Complex:
    """Poles of the cut loop, shifted so that zero frequency lies at 0 and (sampled) Nyquist's at -1."""
    others = np.arange(system.B.shape[1]) != input
    A = system.A - system.B[:, others] @ np.asarray(K, dtype=float)[others]
    poles = np.asarray(linalg.eigvals(A), dtype=complex)
    return np.asarray(poles if system.period is None else 0.5 * (poles - 1.0), dtype=complex)


def _refine(f, a: float, b: float) -> float:  # type: ignore[no-untyped-def]
    from scipy.optimize import brentq

    return float(brentq(f, a, b, xtol=1e-12 * b)) if f(a) * f(b) < 0 else 0.5 * (a + b)


@dataclass(frozen=True)
class StepInfo:
    """Figures of a step response: ``rise`` [s] from 10 to 90 %, ``settling`` [s] to within 2 %, ``overshoot``
    relative to the step, ``final`` value."""

    rise: float
    settling: float
    overshoot: float
    final: float


def step_info(t: ArrayLike, y: ArrayLike, *, final: float | None = None, band: float = 0.02) -> StepInfo:
    """Figures of the response y (n,) at times t (n,) [s] from y[0] to ``final`` (default: its last value).

    NaN for what did not happen within the times.
    """
    t, y = np.asarray(t, dtype=float), np.asarray(y, dtype=float)
    final = float(y[-1]) if final is None else final
    size = final - y[0]
    if size == 0.0:
        return StepInfo(0.0, 0.0, 0.0, final)
    part = (y - y[0]) / size
    outside = np.flatnonzero(np.abs(part - 1.0) > band)
    settling = np.nan
    if not len(outside):
        settling = 0.0
    elif outside[-1] + 1 < len(t):
        i = int(outside[-1])
        level = 1.0 + np.sign(part[i] - 1.0) * band
        settling = float(np.interp(level, *_ordered(part[i : i + 2], t[i : i + 2])) - t[0])
    return StepInfo(
        _first(t, part, 0.9) - _first(t, part, 0.1), settling, float(max(part.max() - 1.0, 0.0)), final
    )


def _ordered(x: Array, y: Array) -> tuple[Array, Array]:
    return (x, y) if x[0] <= x[-1] else (x[::-1], y[::-1])


def _first(t: Array, y: Array, level: float) -> float:
    """First time that y reaches a level, between samples; NaN if never."""
    i = int(np.argmax(y >= level))
    if y[i] < level:
        return np.nan
    return float(t[0] if i == 0 else t[i - 1] + (level - y[i - 1]) / (y[i] - y[i - 1]) * (t[i] - t[i - 1]))


def step_response(
    system: LinearSystem, C: ArrayLike, t: ArrayLike, *, input: int = 0, D: float = 0.0
) -> Array:
    """y = C x + D u (n,) at equally spaced times t (n,) [s] after a unit step of one ``input``, exact."""
    from .linear import held

    t = np.asarray(t, dtype=float)
    step = system if system.period is not None else held(system, float(t[1] - t[0]))
    x, out = np.zeros(len(step.A)), []
    row = np.asarray(C, dtype=float)
    for _ in t:
        out.append(float(row @ x) + D)
        x = step.A @ x + step.B[:, input]
    return np.array(out)


def root_locus(system: LinearSystem, K: ArrayLike, factors: ArrayLike) -> Complex:
    """Closed-loop poles (f, n) under u = -factor K x, branches joined by nearness."""
    from scipy.optimize import linear_sum_assignment

    K = np.asarray(K, dtype=float)
    rows: list[Complex] = []
    for factor in np.asarray(factors, dtype=float):
        poles = linalg.eigvals(system.A - factor * system.B @ K)
        if rows:
            _, order = linear_sum_assignment(np.abs(rows[-1][:, None] - poles[None, :]))
            poles = poles[order]
        rows.append(poles)
    return np.array(rows)
