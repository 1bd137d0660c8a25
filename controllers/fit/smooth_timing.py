"""Timing with bounded jerk: the fastest along a path, from stop to stop, as one smooth nonlinear program.

Over the length p of the path, with r = dp/dt, u = dr/dt and j = du/dt constant on each piece, a point moves
at q' r, accelerates with q' u + q'' r^2 and jerks with q' j + 3 q'' r u + q''' r^3 (primes by p). Lengths of
time of the pieces are the variables that are minimised. Where the path has a corner, or its curvature jumps,
nothing but a stop keeps the jerk finite.
"""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip, Motion
from ...sim.errors import PantographError
from .machine import Machine
from .watch import interruptible, watch

Array = NDArray[np.float64]
Rows = Callable[[Motion], tuple[Array, Array, Array, Array]]
_INSIDE = 1e-5  # of a stretch: where the direction of a path that begins at rest is looked at


class Path(NamedTuple):
    """A path by its length, on n pieces from ``s`` (n + 1,) of the clip: lengths (n,), and motion by length
    (q, q', q'') at the beginning and the end of each, with q''' (n, nv) there."""

    s: Array
    length: Array
    begin: Motion
    end: Motion
    third: tuple[Array, Array]
    rate: Array  # dp/ds (n + 1,)


class Timing(NamedTuple):
    """Times t (n + 1,) from zero, and r, u at the nodes."""

    t: Array
    r: Array
    u: Array


def stretches(clip: Clip, fine: Array, still: NDArray[np.bool_]) -> list[tuple[float, float, bool]]:
    """(begin, end, moves) of what is between stops; pieces ``still`` (n,) of ``fine`` (n + 1,) rest."""
    breaks = clip.breaks_between(clip.start, clip.end)
    stops = [clip.start, clip.end]
    if len(breaks):
        reach = _INSIDE * np.diff(np.concatenate([[clip.start], breaks, [clip.end]]))
        before = _by_length(clip.evaluate(breaks - reach[:-1]))
        after = _by_length(clip.evaluate(breaks + reach[1:]))
        turn = np.abs(after.v - before.v).max(axis=1) > 1e-3
        left, right = _by_length(clip.evaluate(breaks, left=True)), _by_length(clip.evaluate(breaks))
        bend = np.abs(right.a - left.a).max(axis=1) > 1e-6 * (1.0 + np.abs(left.a).max(axis=1))
        stops += list(breaks[turn | bend])
    edges = fine[1:-1][still[1:] != still[:-1]]
    corners = np.unique(np.concatenate([stops, edges]))
    out = []
    for a, b in pairwise(corners):
        middle = 0.5 * (fine[1:] + fine[:-1])
        inner = still[(middle > a) & (middle < b)]
        out.append((float(a), float(b), not (len(inner) and inner.all())))
    return out


def even_nodes(clip: Clip, start: float, stop: float, points: int) -> Array:
    """Times of a clip from ``start`` to ``stop`` [s], as even by length as by time, breaks among them.

    Slow parts of keyed motion are often where it turns.
    """
    s = np.linspace(start, stop, 20 * points + 1)
    p = np.append(0.0, np.cumsum(_lengths(clip, s)))
    even = p / p[-1] + (s - start) / (stop - start)
    nodes = np.interp(np.linspace(0.0, 2.0, points + 1), even, s)
    nodes[0], nodes[-1] = start, stop
    nodes = np.union1d(nodes, clip.breaks_between(start, stop))
    return np.asarray(nodes[np.append(True, np.diff(nodes) > 1e-9 * (stop - start))])


def path(clip: Clip, nodes: Array) -> Path:
    """A part of a clip by its length, over times ``nodes`` (n + 1,)."""
    inside = _INSIDE * np.diff(nodes)
    begin, later = (_by_length(clip.evaluate(nodes[:-1] + k * inside)) for k in (1.0, 1e3))
    end, sooner = (_by_length(clip.evaluate(nodes[1:] - k * inside)) for k in (1.0, 1e3))
    length = _lengths(clip, nodes)
    third = (
        (later.a - begin.a) / _way(clip, nodes[:-1] + inside, nodes[:-1] + 1e3 * inside),
        (end.a - sooner.a) / _way(clip, nodes[1:] - 1e3 * inside, nodes[1:] - inside),
    )
    right = clip.evaluate(nodes[:-1])
    last = clip.evaluate(nodes[-1:], left=True)
    rate = np.linalg.norm(np.vstack([right.v, last.v]), axis=1)
    return Path(nodes, length, begin, end, third, rate)


def fastest(along: Path, machine: Machine, rows: Rows, *, ends: tuple[float, float], keep: bool) -> Timing:
    """The fastest timing, at speeds dp/dt ``ends`` at both ends (and unaccelerated where these are zero).

    ``rows`` gives limits a u + b r^2 + e r <= c of motion by length; with ``keep`` nowhere faster than keyed.
    """
    import casadi as ca

    n, length = len(along.length), along.length
    speed = np.inf * np.ones(n + 1)
    for at, cut in ((along.begin, slice(None, -1)), (along.end, slice(1, None))):
        top = machine.velocity / np.maximum(np.abs(at.v), 1e-12)
        speed[cut] = np.minimum(speed[cut], top.min(axis=1))
    if keep:
        speed = np.minimum(speed, along.rate)
    sizes = (n, n, n + 1, n + 1)
    z: Any = ca.MX.sym("z", sum(sizes))
    dt: Any
    dt, j, r, u = ca.vertsplit(z, np.append(0, np.cumsum(sizes)).tolist())
    r0, r1, u0, u1 = r[:-1], r[1:], u[:-1], u[1:]
    gone = dt * (r0 + dt * (u0 / 2.0 + dt * j / 6.0))
    equal = [gone / length - 1.0, r1 - r0 - dt * (u0 + dt * j / 2.0), u1 - u0 - dt * j]
    below: list[Any] = []
    for at, bend, v, a in ((along.begin, along.third[0], r0, u0), (along.end, along.third[1], r1, u1)):
        for x, y, c, e in zip(*(part.T for part in rows(at)), strict=True):
            size = np.maximum(np.abs(c), 1e-9)
            below.append((x / size) * a + (y / size) * v**2 + (e / size) * v - c / size)
        for dof in np.flatnonzero(np.isfinite(machine.jerk)):
            parts = (at.v[:, dof], 3.0 * at.a[:, dof], bend[:, dof])
            one, two, three = (part / machine.jerk[dof] for part in parts)
            jerk = one * j + two * v * a + three * v**3
            below += [jerk - 1.0, -jerk - 1.0]
    g: Any = ca.vertcat(*equal, *below)
    inf = np.full(n, np.inf)
    u_low, u_high = np.full(n + 1, -np.inf), np.full(n + 1, np.inf)
    r_low, r_high = np.zeros(n + 1), speed.copy()
    for k, value in ((0, ends[0]), (-1, ends[1])):
        r_low[k] = r_high[k] = value
        if value == 0.0:
            u_low[k] = u_high[k] = 0.0
    low = np.concatenate([np.full(n, 1e-9), -inf, r_low, u_low])
    high = np.concatenate([inf, inf, r_high, u_high])
    lower = np.concatenate([np.zeros(3 * n), np.full(int(g.numel()) - 3 * n, -np.inf)])
    ipopt: dict[str, Any] = {
        "print_level": 0,
        "sb": "yes",
        "max_iter": 1000,
        "tol": 1e-7,
        "acceptable_tol": 1e-4,
    }
    ipopt |= {"acceptable_obj_change_tol": 1e-6, "acceptable_constr_viol_tol": 1e-8}
    options: dict[str, Any] = {"print_time": False, "error_on_fail": False, "ipopt": ipopt}
    guard = watch(int(z.numel()), int(g.numel()))
    options["iteration_callback"] = guard
    solver = ca.nlpsol("timing", "ipopt", {"x": z, "f": ca.sum1(dt), "g": g}, options)
    for slack in (2.0, 6.0, 1.3):
        guess = _guess(along, machine, speed, ends, slack)
        with interruptible(guard):
            done = solver(
                x0=np.clip(guess, low, high), lbx=low, ubx=high, lbg=lower, ubg=np.zeros(len(lower))
            )
        words, left = str(solver.stats()["return_status"]), np.asarray(done["g"]).ravel()
        rest = max(np.abs(left[: 3 * n]).max(), left[3 * n :].max(initial=0.0))
        if rest <= 1e-5:
            break
    else:
        raise PantographError(
            f"no timing with bounded jerk was found from {along.s[0]:.4g} to {along.s[-1]:.4g} s: limits are "
            f"missed by {rest:.2g} ({words.replace('_', ' ').lower()})"
        )
    out = np.asarray(done["x"]).ravel()
    return Timing(np.append(0.0, np.cumsum(out[:n])), out[2 * n : 3 * n + 1], out[3 * n + 1 :])


def motion(along: Path, clip: Clip, timing: Timing) -> Motion:
    """q, v, a (n + 1, ...) at the nodes."""
    q = np.vstack([clip.evaluate(along.s[:-1]).q, clip.evaluate(along.s[-1:], left=True).q])
    way = np.vstack([along.begin.v, along.end.v[-1:]])
    bend = np.vstack([along.begin.a, along.end.a[-1:]])
    r, u = timing.r[:, None], timing.u[:, None]
    bend = np.where(r > 0, bend, 0.0)
    return Motion(q, way * r, way * u + bend * r**2)


def _by_length(at: Motion) -> Motion:
    """q, dq/dp, d2q/dp2 from motion by time of the clip."""
    rate = np.maximum(np.linalg.norm(at.v, axis=1, keepdims=True), 1e-150)
    way = at.v / rate
    return Motion(at.q, way, (at.a - way * np.sum(way * at.a, axis=1, keepdims=True)) / rate**2)


def _way(clip: Clip, start: Array, stop: Array) -> Array:
    """Lengths (n, 1) of short ways."""
    middle = np.linalg.norm(clip.evaluate(0.5 * (start + stop)).v, axis=1)
    return np.asarray(np.maximum(middle * (stop - start), 1e-150)[:, None])


def _lengths(clip: Clip, s: Array) -> Array:
    """Lengths (n,) of the path between times s (n + 1,), by Gauss's rule of five points."""
    x, w = np.polynomial.legendre.leggauss(5)
    h = np.diff(s)
    at = s[:-1, None] + 0.5 * h[:, None] * (x + 1.0)
    return np.asarray(0.5 * h * (np.linalg.norm(clip.evaluate(at).v, axis=2) @ w))


def _guess(along: Path, machine: Machine, speed: Array, ends: tuple[float, float], slack: float) -> Array:
    """The way of least integrated jerk from rest to rest, in ``slack`` times the time that limits ask for."""
    p = np.append(0.0, np.cumsum(along.length))
    total = float(p[-1])
    most = [float(np.min(limit)) for limit in (machine.jerk, machine.acceleration, machine.velocity)]
    least = np.cbrt(60.0 * total / most[0]), np.sqrt(5.8 * total / most[1]), 1.9 * total / most[2]
    seconds, even = slack * max(least), np.linspace(0.0, 1.0, 4001)
    x = np.interp(p / total, even**3 * (10.0 + even * (6.0 * even - 15.0)), even)
    r = 30.0 * x**2 * (1.0 - x) ** 2 * total / seconds
    u = 60.0 * x * (1.0 - x) * (1.0 - 2.0 * x) * total / seconds**2
    r[0], r[-1] = ends
    dt = seconds * np.maximum(np.diff(x), 1e-9)
    return np.concatenate([dt, np.diff(u) / dt, np.minimum(r, speed), u])
