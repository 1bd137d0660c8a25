"""Timing with bounded jerk: the fastest along a path, from stop to stop, as one smooth nonlinear program.

Over the length p of the path, with r = dp/dt, u = dr/dt and j = du/dt constant on each piece, a point moves
at q' r, accelerates with q' u + q'' r^2 and jerks with q' j + 3 q'' r u + q''' r^3 (primes by p). Lengths of
time of the pieces are the variables that are minimised. Units are the length of the path and the time of a
guess, so that the program looks alike whatever the limits are.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....sim.clip import Clip, Motion
from ....sim.errors import PantographError
from ..machine import Machine
from ..watch import interruptible, watch
from .halfspaces import needed
from .path import Path

Array = NDArray[np.float64]
Rows = Callable[[Motion, Motion], tuple[Array, Array, Array, Array]]


class Timed(NamedTuple):
    """Times t (n + 1,) from zero along a path, r at its nodes, u (n,) at the beginning and the end of each
    piece."""

    along: Path
    t: Array
    r: Array
    begin: Array
    end: Array


def fastest(
    along: Path,
    machine: Machine,
    rows: Rows,
    known: Timed | None,
    *,
    ends: tuple[float, float],
    keep: bool,
) -> Timed:
    """The fastest timing, at speeds dp/dt ``ends`` at both ends (and unaccelerated where these are zero).

    It begins with a guess, or with what is ``known`` over fewer nodes.
    ``rows`` gives limits a u + b r^2 + e r <= c of motion by length; with ``keep`` nowhere faster than keyed.
    Raises PantographError where none is found.
    """
    import casadi as ca

    n = len(along.length)
    tops = _tops(along, machine)
    speed = np.minimum(np.append(tops[0], np.inf), np.append(np.inf, tops[1]))
    speed = np.where(along.back, 0.0, np.minimum(speed, along.rate) if keep else speed)
    guess = _guess(along, machine, rows, speed, ends) if known is None else _between(along, known)
    length, seconds = float(along.length.sum()), float(guess[0].sum())
    units = [seconds * 0.1, length / seconds**3, length / seconds, length / seconds**2]
    sizes = (n, n, n + 1, n + 1)
    z: Any = ca.MX.sym("z", sum(sizes))
    parts = ca.vertsplit(z, np.append(0, np.cumsum(sizes)).tolist())
    dt, j, r, u = (unit * part for part, unit in zip(parts, units, strict=True))
    equal, below = _conditions(along, machine, rows, (dt, j, r, u), units, np.min(tops, axis=0))
    g: Any = ca.vertcat(*equal, *below)
    many = sum(int(e.numel()) for e in equal)
    low, high = _bounds(along, speed, ends)
    unit = np.repeat(units, sizes)
    low, high = low / unit, high / unit
    lower = np.concatenate([np.zeros(many), np.full(int(g.numel()) - many, -np.inf)])
    guard = watch(int(z.numel()), int(g.numel()))
    ipopt: dict[str, Any] = {"print_level": 0, "sb": "yes", "max_iter": 400, "tol": 1e-7}
    # what is left of lengths is divided by the cube of times where jerk is judged
    ipopt |= {"constr_viol_tol": 1e-11}
    ipopt |= {"mu_init": 1.0 if known is None else 1e-3}
    ipopt |= {"acceptable_tol": 1e-4, "acceptable_obj_change_tol": 1e-6, "acceptable_constr_viol_tol": 1e-11}
    options = {"print_time": False, "error_on_fail": False, "ipopt": ipopt, "iteration_callback": guard}
    solver = ca.nlpsol("timing", "ipopt", {"x": z, "f": 100.0 * ca.sum1(dt) / seconds, "g": g}, options)
    best, words, rest = None, "", np.inf
    for slack in (1.5, 4.0, 1.0) if known is None else (1.02, 1.5, 4.0):
        x0 = np.concatenate([x / slack**k for x, k in zip(guess, (-1, 3, 1, 2), strict=True)]) / unit
        with interruptible(guard):
            done = solver(x0=np.clip(x0, low, high), lbx=low, ubx=high, lbg=lower, ubg=np.zeros(len(lower)))
        words, left = str(solver.stats()["return_status"]), np.asarray(done["g"]).ravel()
        miss = float(max(np.abs(left[:many]).max(), left[many:].max(initial=0.0)))
        rest = min(rest, miss) if np.isfinite(miss) else rest
        if miss <= 1e-8 and (best is None or float(done["f"]) < float(best["f"])):
            best = done
        if solver.stats()["success"]:
            break
    if best is None:
        raise PantographError(
            f"no timing with bounded jerk was found from {along.s[0]:.4g} to {along.s[-1]:.4g} s: limits are "
            f"missed by {rest:.2g} ({words.replace('_', ' ').lower()})"
        )
    out = np.asarray(best["x"]).ravel() * unit
    u = out[3 * n + 1 :]
    t, first = np.append(0.0, np.cumsum(out[:n])), np.where(along.back, -u, u)[:-1]
    return Timed(along, t, out[2 * n : 3 * n + 1], first, u[1:])


def _conditions(
    along: Path,
    machine: Machine,
    rows: Rows,
    var: tuple[Any, Any, Any, Any],
    units: list[float],
    speed: Array,
) -> tuple[list[Any], list[Any]]:
    """What vanishes (the motion along the path), and what is at most zero (the limits at nodes)."""
    dt, j, r, u = var
    r0, r1, u1 = r[:-1], r[1:], u[1:]
    u0 = u[:-1] * np.where(along.back[:-1], -1.0, 1.0)  # on the way back the same pushes the other way
    gone = dt * (r0 + dt * (u0 / 2.0 + dt * j / 6.0))
    equal = [
        gone / along.length - 1.0,
        (r1 - r0 - dt * (u0 + dt * j / 2.0)) / units[2],
        (u1 - u0 - dt * j) / units[3],
    ]
    # between nodes r is a parabola
    middle, top = r0 + dt * (u0 / 2.0 + dt * j / 8.0), speed
    fast = np.flatnonzero(np.isfinite(top) & (top > 0)).tolist()
    below: list[Any] = [middle[fast] / top[fast] - 1.0] if fast else []
    sides = (
        (along.begin, along.end, along.third[0], r0, u0),
        (along.end, along.begin, along.third[1], r1, u1),
    )
    for at, other, bend, v, a in sides:
        x, y, c, e = rows(at, other)
        size = np.maximum(np.abs(c), 1e-9)
        forces = np.stack([x / size, y / size, e / size], axis=2)
        room = c / size
        mine = needed(np.where((room > 0.5)[:, :, None], forces, np.inf), (False, True, True))
        k, (one, two, three) = np.nonzero(mine)[0].tolist(), forces[mine].T
        below.append(one * a[k] + two * v[k] ** 2 + three * v[k] - room[mine])
        limit = machine.jerk
        jerk = np.stack([at.v / limit, 3.0 * at.a / limit, bend / limit], axis=2)
        jerk = np.concatenate([jerk, -jerk], axis=1)
        mine = needed(jerk, (False, False, True))
        k, (one, two, three) = np.nonzero(mine)[0].tolist(), jerk[mine].T
        below.append(one * j[k] + two * v[k] * a[k] + three * v[k] ** 3 - 1.0)
    return equal, below


def _tops(along: Path, machine: Machine) -> tuple[Array, Array]:
    """Largest r (n,) at the beginning and the end of each piece."""
    first, last = (
        (machine.velocity / np.maximum(np.abs(at.v), 1e-12)).min(axis=1) for at in (along.begin, along.end)
    )
    return first, last


def _bounds(along: Path, speed: Array, ends: tuple[float, float]) -> tuple[Array, Array]:
    n = len(along.length)
    inf = np.full(n, np.inf)
    u_low, u_high = np.full(n + 1, -np.inf), np.full(n + 1, np.inf)
    r_low, r_high = np.zeros(n + 1), speed.copy()
    for k, value in ((0, ends[0]), (-1, ends[1])):
        r_low[k] = r_high[k] = value
        if value == 0.0:
            u_low[k] = u_high[k] = 0.0
    return np.concatenate([np.zeros(n), -inf, r_low, u_low]), np.concatenate([inf, inf, r_high, u_high])


def motion(clip: Clip, now: Timed, jerky: NDArray[np.bool_]) -> tuple[Array, Array, Array, Array]:
    """q (n + 1, nq) and v (n + 1, nv) at the nodes, accelerations (n, nv) at the beginning and the end of
    each piece; those of the freedoms ``jerky`` (nv,) do not jump."""
    along, r = now.along, now.r[:, None]
    q = np.vstack([clip.evaluate(along.s[:-1]).q, clip.evaluate(along.s[-1:], left=True).q])
    v = np.vstack([along.begin.v, along.end.v[-1:]]) * r
    a0 = along.begin.v * now.begin[:, None] + np.where(r[:-1] > 0, along.begin.a, 0.0) * r[:-1] ** 2
    a1 = along.end.v * now.end[:, None] + np.where(r[1:] > 0, along.end.a, 0.0) * r[1:] ** 2
    a1[:-1, jerky] = a0[1:, jerky]
    return q, v, a0, a1


def _between(along: Path, known: Timed) -> list[Array]:
    """dt, j (n,) and r, u (n + 1,) of what is known over fewer nodes, by the length of the path."""
    p, old = (np.append(0.0, np.cumsum(x.length)) for x in (along, known.along))
    p = p * old[-1] / p[-1]
    t, fine = _times(known, old, p)
    dt = np.maximum(np.diff(t), 1e-12 * t[-1])
    r, u = (np.interp(t, known.t, x) for x in (known.r, np.append(known.begin[0], known.end)))
    return [dt, np.interp(0.5 * (t[1:] + t[:-1]), 0.5 * (known.t[1:] + known.t[:-1]), fine), r, u]


def _times(known: Timed, old: Array, p: Array) -> tuple[Array, Array]:
    """Times (m,) at lengths p (m,) of the path of what is known over lengths ``old`` (n,); its j (n - 1,)."""
    dt = np.diff(known.t)
    j = (known.end - known.begin) / np.maximum(dt, 1e-300)
    part = np.linspace(0.0, 1.0, 21)
    s = dt[:, None] * part
    gone = old[:-1, None] + s * (known.r[:-1, None] + s * (known.begin[:, None] / 2.0 + s * j[:, None] / 6.0))
    return np.interp(p, np.maximum.accumulate(gone.ravel()), (known.t[:-1, None] + s).ravel()), j


def _guess(along: Path, machine: Machine, rows: Rows, speed: Array, ends: tuple[float, float]) -> list[Array]:
    """dt, j (n,) and r, u (n + 1,) of a way that would hold most limits: as fast as the path's curvature and
    what pushes along it let it be, and slow near where it rests."""
    n, length = len(along.length), along.length
    top, push, jerk = speed.copy(), np.full(n + 1, np.inf), np.full(n + 1, np.inf)
    sides = (
        (along.begin, along.end, along.third[0], slice(None, -1)),
        (along.end, along.begin, along.third[1], slice(1, None)),
    )
    with np.errstate(divide="ignore", invalid="ignore"):
        for at, other, third, cut in sides:
            x, y, c, e = rows(at, other)
            root = (-e + np.sqrt(e**2 + 4.0 * np.maximum(y, 0.0) * c)) / (2.0 * np.maximum(y, 0.0))
            top[cut] = np.fmin(top[cut], np.nanmin(np.where(y > 0, root, c / e), axis=1))
            top[cut] = np.fmin(top[cut], np.cbrt(machine.jerk / np.abs(third)).min(axis=1))
            push[cut] = np.fmin(push[cut], np.nanmin(c / np.abs(x), axis=1))
            jerk[cut] = np.fmin(jerk[cut], (machine.jerk / np.abs(at.v)).min(axis=1))
    p = np.append(0.0, np.cumsum(length))
    rests = (
        along.back | (np.arange(n + 1) == 0) & (ends[0] == 0.0) | (np.arange(n + 1) == n) & (ends[1] == 0.0)
    )
    if rests.any():
        away = np.min(np.abs(p[:, None] - p[rests]), axis=1)
        top = np.minimum(top, np.cbrt(4.5 * jerk * away**2))
    top = np.minimum(np.maximum(top, 1e-9 * p[-1]), 1e9 * p[-1])
    top[rests] = 0.0
    top[[0, -1]] = ends
    for order in (range(n), range(n - 1, -1, -1)):
        for i in order:
            a, b = (i, i + 1) if order.step > 0 else (i + 1, i)
            top[b] = min(top[b], np.sqrt(top[a] ** 2 + 1.4 * min(push[a], push[b], 1e12) * length[i]))
    dt = 2.0 * length / (top[1:] + top[:-1])
    pull = np.diff(top**2) / (2.0 * length)
    u = np.concatenate([pull[:1], 0.5 * (pull[1:] + pull[:-1]), pull[-1:]])
    u[[0, -1]] = np.where(np.array(ends) == 0.0, 0.0, u[[0, -1]])
    return [dt, np.diff(u) / dt, top, u]
