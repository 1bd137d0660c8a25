"""The nearest possible motion: spacetime constraints by direct collocation under the machine's full dynamics.

Hermite-Simpson collocation (C. Hargraves, S. Paris, J. Guidance 10, 1987; A. Witkin, M. Kass, Spacetime
constraints, SIGGRAPH 1988) with exact derivatives of the compiled model's own program, solved by IPOPT.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...models import lookup, name_of
from ...sim.clip import Clip, Track
from ...sim.curves import PolynomialCurve, frozen
from ...sim.errors import PantographError
from .check import check_motion
from .machine import Machine

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Phase:
    """Contact from ``start`` to ``stop`` [s]: the ``sites`` rest where they are, pushed within the friction
    cone of ``friction`` on level ground at height ``ground`` [m]; None leaves the height free."""

    start: float
    stop: float
    sites: tuple[str, ...]
    friction: float = 0.8
    ground: float | None = 0.0


@dataclass(frozen=True, eq=False)
class Certificate:
    """How possible a fitted motion is, on a grid ten times finer than the one it was computed on.

    ``limits``: largest share of any limit in use; ``dynamics``: largest force missing where nothing drives,
    relative to the largest force at all; ``solver``: what IPOPT left of its constraints; ``status``: its
    words; ``iterations``; ``seconds``.
    """

    limits: float
    dynamics: float
    solver: float
    status: str
    iterations: int
    seconds: float

    def __str__(self) -> str:
        return (
            f"limits in use {self.limits:.2%}, missing force {self.dynamics:.2e} of the largest, "
            f"constraints to {self.solver:.1e} "
            f"({self.status}, {self.iterations} iterations, {self.seconds:.2f} s)"
        )


@dataclass(frozen=True, eq=False)
class Fitted:
    """A possible clip; at its nodes t (n,) forces ``tau`` (n, nv) and contact forces (n, 3 sites) [N], and
    the largest ``deviation`` from the keys there [rad, m]; its certificate."""

    clip: Clip
    t: Array
    tau: Array
    contact: Array
    deviation: float
    certificate: Certificate


def fit(
    clip: Clip,
    machine: Machine,
    *,
    hard: Sequence[float] = (),
    phases: Sequence[Phase] = (),
    effort: float = 1e-3,
    deviation: float = 1.0,
    step: float = 0.04,
    at_rest: bool = True,
    tolerance: float = 1e-3,
    refine: int = 3,
    most: int = 500,
) -> Fitted:
    """The motion nearest to ``clip`` that ``machine`` can make, through its poses at the ``hard`` times [s].

    Minimises the integral of ``deviation`` |q - keys|^2 plus ``effort`` |tau / strength|^2 + jerkiness over
    all keyed joints; joints without keys move as physics and the fit want. ``phases`` declare contacts.
    It begins and ends at the keyed velocity, or ``at_rest``. ``step`` [s] is the longest piece of the grid,
    ``most`` the most iterations. Raises PantographError for models with ball or free joints, for keys outside
    of the clip, and when no motion fits, saying what is left over.

    The grid is refined, and the limits are drawn in by what the motion exceeds between its points, until the
    certificate holds to ``tolerance`` or the grid has been halved ``refine`` times.
    """
    guess: Fitted | None = None
    margin = 1.0
    for round_ in range(refine + 1):
        problem = _Transcription(clip, _drawn_in(machine, margin), tuple(hard), tuple(phases), step, at_rest)
        guess = problem.solve(machine, effort, deviation, most, guess)
        found = guess.certificate
        if found.limits <= 1.0 + tolerance and found.dynamics <= tolerance:
            break
        if round_ > 0 or found.limits < 1.02:
            margin = min(margin, max(0.9, margin / max(found.limits, 1.0)))
        step *= 0.5
    assert guess is not None
    return guess


def _drawn_in(machine: Machine, margin: float) -> Machine:
    """``machine`` with less of everything, so that what lies between grid points stays within its own."""
    names = ("velocity", "acceleration", "jerk", "force_low", "force_high", "top_speed")
    return replace(
        machine, **{n: margin * getattr(machine, n) for n in names}, current=margin * machine.current
    )


class _Transcription:
    """The nonlinear program of a fit."""

    def __init__(
        self,
        clip: Clip,
        machine: Machine,
        hard: tuple[float, ...],
        phases: tuple[Phase, ...],
        step: float,
        at_rest: bool,
    ) -> None:
        m = machine.model
        if m.nq != m.nv:
            raise PantographError("fitting takes hinges and slides; this model has ball or free joints")
        for t in hard:
            if not clip.start <= t <= clip.end:
                raise PantographError(
                    f"a hard key at {t:g} s lies outside of the clip, {clip.start:g} to {clip.end:g} s"
                )
        self.clip, self.machine, self.hard, self.phases, self.at_rest = clip, machine, hard, phases, at_rest
        corners = [clip.start, clip.end, *hard, *(t for p in phases for t in (p.start, p.stop))]
        edges = np.unique(np.clip(corners, clip.start, clip.end))
        pieces = [np.linspace(a, b, int(np.ceil((b - a) / step - 1e-9)) + 1)[:-1] for a, b in pairwise(edges)]
        self.t = np.append(np.concatenate(pieces), edges[-1])
        self.sites = tuple(dict.fromkeys(s for p in phases for s in p.sites))
        for site in self.sites:
            lookup(m, "site", site)
        self.driven = np.flatnonzero(machine.driven)
        self.wanted = clip.evaluate(self.t)
        high = np.minimum(machine.force_high, -machine.force_low)
        weight = np.abs(machine.nominal.smooth.inverse(*self.wanted)).max(axis=0) + 1e-3
        self.strength = np.where(np.isfinite(high), high, np.maximum(weight, 0.1 * weight.max()))

    def _functions(self) -> tuple[Any, Any]:
        """(q, v, tau, f) -> a, and (q, v, a) -> positions, velocities, accelerations of the contact sites."""
        import casadi as ca

        m, smooth = self.machine.model, self.machine.nominal.smooth
        q, v = ca.SX.sym("q", m.nq), ca.SX.sym("v", m.nv)
        tau, f = ca.SX.sym("tau", len(self.driven)), ca.SX.sym("f", 3 * len(self.sites))
        full = ca.SX.zeros(m.nv)
        for k, dof in enumerate(self.driven):
            full[int(dof)] = tau[k]
        places = ca.SX(0, 1)
        if self.sites:
            p = smooth.tape("sites").casadi("sites")(q, [], [])[0]
            rows = [lookup(m, "site", site) for site in self.sites]
            places = ca.vertcat(*[p[3 * r : 3 * r + 3] for r in rows])
            full += ca.jacobian(places, q).T @ f
        forward = smooth.tape("forward").casadi("forward")
        a = forward(q, v, [], ca.DM.zeros(m.nu), full, [], [])
        rate = ca.SX.sym("a", m.nv)
        speeds = ca.jtimes(places, q, v) if self.sites else ca.SX(0, 1)
        bends = ca.jtimes(speeds, q, v) + ca.jtimes(places, q, rate) if self.sites else ca.SX(0, 1)
        foot = ca.Function("sites", [q, v, rate], [places, speeds, bends])
        return ca.Function("a", [q, v, tau, f], [a]), foot

    def solve(
        self, true: Machine, effort: float, deviation: float, most: int, start: Fitted | None
    ) -> Fitted:
        """Build, solve from ``start`` or the keys, certify against the ``true`` machine."""
        import time

        import casadi as ca

        m, n, nd, nf = self.machine.model, len(self.t), len(self.driven), 3 * len(self.sites)
        h, nv = np.diff(self.t), m.nv
        accelerate, foot = self._functions()
        Q, V, T, F = (
            ca.MX.sym(name, size, n) for name, size in (("q", nv), ("v", nv), ("tau", nd), ("f", nf))
        )
        # forces are straight between nodes, and of a contact there are none beyond its phase
        on: Any = ca.DM(self._touched.astype(float))
        T0, T1, F0, F1 = T[:, :-1], T[:, 1:], F[:, :-1] * on, F[:, 1:] * on
        Tm = 0.5 * (T0 + T1)
        q0, q1, v0, v1 = Q[:, :-1], Q[:, 1:], V[:, :-1], V[:, 1:]
        piece = accelerate.map(n - 1)
        a0, a1 = piece(q0, v0, T0, F0), piece(q1, v1, T1, F1)
        H: Any = ca.DM(h).T
        each: Any = ca.repmat(H, nv, 1)
        qm = 0.5 * (q0 + q1) + each / 8.0 * (v0 - v1)
        vm = 0.5 * (v0 + v1) + each / 8.0 * (a0 - a1)
        am = piece(qm, vm, Tm, 0.5 * (F0 + F1))
        equal = [
            (q1 - q0 - each / 6.0 * (v0 + 4.0 * vm + v1)) / each,
            v1 - v0 - each / 6.0 * (a0 + 4.0 * am + a1),
        ]
        below: list[Any] = []
        self._machine_limits(below, V, (a0, am, a1), T, Tm, vm, H)
        low, high = self._bounds(n, nd, nf)
        self._contacts(equal, below, foot, (Q, V, F), (a0, a1))
        keyed = np.flatnonzero(self.clip.dofs)
        wq = ca.DM(np.gradient(self.t))
        miss = (Q - ca.DM(self.wanted.q.T))[keyed.tolist(), :]
        scale = ca.DM(1.0 / self.strength[self.driven])
        push = T * ca.repmat(scale, 1, n)
        cost = deviation * ca.dot(ca.sum1(miss**2), wq.T)
        # joints without keys need not move more than the motion asks
        loose = np.flatnonzero(~self.clip.dofs).tolist()
        cost += 0.1 * effort * ca.dot(ca.sum1(V[loose, :] ** 2), wq.T)
        cost += effort * ca.dot(ca.sum1(push**2), wq.T)
        cost += 1e-4 * effort * ca.sumsqr((push[:, 1:] - push[:, :-1]) / ca.repmat(ca.sqrt(H), nd, 1))
        if nf:
            cost += 1e-3 * effort * ca.sumsqr(F) / max(float(m.body_mass.sum()) * 9.81, 1e-9) ** 2
        x = ca.veccat(Q, V, T, F)
        g = ca.veccat(*equal, *below)
        count = sum(int(e.numel()) for e in equal)
        limits = np.zeros(int(g.numel()))
        lower = np.concatenate([np.zeros(count), np.full(len(limits) - count, -np.inf)])
        options = {"print_time": False, "error_on_fail": False}
        options["ipopt"] = {
            "print_level": 0,
            "sb": "yes",
            "max_iter": most,
            "tol": 1e-9,
            "constr_viol_tol": 1e-10,
            "acceptable_tol": 1e-7,
        }  # type: ignore[assignment]
        begun = time.perf_counter()
        solver = ca.nlpsol("fit", "ipopt", {"x": x, "f": cost, "g": g}, options)
        done = solver(x0=self._guess(n, nf, low, high, start), lbx=low, ubx=high, lbg=lower, ubg=limits)
        seconds, stats = time.perf_counter() - begun, solver.stats()
        left = np.asarray(done["g"]).ravel()
        rest = float(max(np.abs(left[:count]).max(initial=0.0), left[count:].max(initial=0.0)))
        if rest > 1e-5:
            how = f"by {rest:.2g} after {stats['iter_count']} iterations ({stats['return_status']})"
            fix = "loosen hard keys, give more time, or a stronger machine"
            raise PantographError(f"no motion was found that fits: constraints are missed {how}; {fix}")
        parts = np.split(np.asarray(done["x"]).ravel(), np.cumsum([nv * n, nv * n, nd * n, nf * n]))
        q, v, tau, f = (p.reshape(n, k) for p, k in zip(parts[:4], (nv, nv, nd, nf), strict=True))
        ends = [
            np.asarray(piece(q[cut].T, v[cut].T, tau[cut].T, f[cut].T * self._touched)).T
            for cut in (slice(None, -1), slice(1, None))
        ]
        fitted = self._clip(q, v, ends[0], ends[1])
        full = np.zeros((n, nv))
        full[:, self.driven] = tau
        limit, missing = self._certify(true, fitted, full, f)
        words = str(stats["return_status"]).replace("_", " ").lower()
        certificate = Certificate(limit, missing, rest, words, int(stats["iter_count"]), seconds)
        off = float(np.abs(q[:, keyed] - self.wanted.q[:, keyed]).max(initial=0.0))
        return Fitted(fitted, self.t, full, f, off, certificate)

    def _bounds(self, n: int, nd: int, nf: int) -> tuple[Array, Array]:
        m, mm = self.machine.model, self.machine
        q_low, q_high = np.tile(mm.low, (n, 1)), np.tile(mm.high, (n, 1))
        v_low, v_high = np.tile(-mm.velocity, (n, 1)), np.tile(mm.velocity, (n, 1))
        pinned = [0, *(int(np.argmin(np.abs(self.t - t))) for t in self.hard)]
        keyed = self.clip.dofs
        for k in dict.fromkeys(pinned):
            rows = np.ones(m.nv, dtype=bool) if k == 0 else keyed
            q_low[k, rows] = q_high[k, rows] = self.wanted.q[k, rows]
        for k in (0, n - 1):
            rows = np.ones(m.nv, dtype=bool) if k == 0 or self.at_rest else keyed
            v_low[k, rows] = v_high[k, rows] = 0.0 if self.at_rest else self.wanted.v[k, rows]
        t_low, t_high = mm.force_low[self.driven], mm.force_high[self.driven]
        f_low, f_high = np.full((n, nf), -np.inf), np.full((n, nf), np.inf)
        for k, site in enumerate(self.sites):
            cut = slice(3 * k, 3 * k + 3)
            free = ~self._touching(site, self.t)
            f_low[free, cut], f_high[free, cut] = 0.0, 0.0
        low = [q_low, v_low, np.tile(t_low, (n, 1)), f_low]
        high = [q_high, v_high, np.tile(t_high, (n, 1)), f_high]
        return np.concatenate([x.ravel() for x in low]), np.concatenate([x.ravel() for x in high])

    def _touching(self, site: str, t: Array) -> NDArray[np.bool_]:
        """Whether a site touches at times t (n,)."""
        on = np.zeros(len(t), dtype=bool)
        for p in self.phases:
            on |= (site in p.sites) & (t >= p.start - 1e-9) & (t <= p.stop + 1e-9)
        return on

    @cached_property
    def _touched(self) -> NDArray[np.bool_]:
        """Pieces in which a site pushes, (3 sites, n - 1)."""
        middle = 0.5 * (self.t[1:] + self.t[:-1])
        rows = [self._touching(site, middle) for site in self.sites for _ in range(3)]
        return np.array(rows, dtype=bool).reshape(3 * len(self.sites), len(middle))

    def _guess(self, n: int, nf: int, low: Array, high: Array, start: Fitted | None) -> Array:
        """The last solution on this grid, or the keys with the forces they would need."""
        if start is not None:
            q, v, _ = start.clip.evaluate(self.t)
            forces = [_between(start.t, x, self.t) for x in (start.tau[:, self.driven], start.contact)]
            last = np.concatenate([p.ravel() for p in (q, v, *forces)])
            return np.asarray(np.clip(last, low, high))
        tau = self.machine.nominal.smooth.inverse(*self.wanted)[:, self.driven]
        f = np.zeros((n, nf))
        weight = 9.81 * float(self.machine.model.body_mass.sum())
        for k, site in enumerate(self.sites):
            f[self._touching(site, self.t), 3 * k + 2] = weight / len(self.sites)
        parts = [self.wanted.q, self.wanted.v, tau, f]
        return np.asarray(np.clip(np.concatenate([p.ravel() for p in parts]), low, high))

    def _machine_limits(
        self, below: list[Any], V: Any, A: tuple[Any, Any, Any], T: Any, Tm: Any, vm: Any, H: Any
    ) -> None:
        """Rows <= 0 for what bounds of single variables do not say."""
        import casadi as ca

        mm = self.machine
        for dof in np.flatnonzero(np.isfinite(mm.acceleration)):
            for a in (a[int(dof), :] for a in A):
                below += [a / float(mm.acceleration[dof]) - 1.0, -a / float(mm.acceleration[dof]) - 1.0]
        for dof in np.flatnonzero(np.isfinite(mm.jerk)):
            first, middle, last = (a[int(dof), :] for a in A)
            for change in (middle - first, last - middle):
                jerk = 2.0 * change / H / float(mm.jerk[dof])
                below += [jerk - 1.0, -jerk - 1.0]
        for k, dof in enumerate(self.driven):
            top, high, low = mm.top_speed[dof], mm.force_high[dof], mm.force_low[dof]
            if np.isfinite(top) and np.isfinite(high - low):
                for tau, v in ((T[k, :], V[int(dof), :]), (Tm[k, :], vm[int(dof), :])):
                    below += [tau / high + v / top - 1.0, tau / low - v / top - 1.0]
        if np.isfinite(mm.current):
            each = ca.DM(mm.ampere[self.driven] / mm.current).T
            below += [each @ ca.sqrt(x**2 + 1e-12) - 1.0 for x in (T, Tm)]

    def _contacts(
        self, equal: list[Any], below: list[Any], foot: Any, state: tuple[Any, Any, Any], a: tuple[Any, Any]
    ) -> None:
        """Sites that touch come to rest where their phase begins, and are not accelerated in it.

        The condition on accelerations decides the contact force at every node; conditions on positions or
        velocities at every node would leave it to swing from one to the next.
        """
        Q, V, F = state
        weight = 9.81 * float(self.machine.model.body_mass.sum())
        for phase in self.phases:
            on = np.flatnonzero((self.t >= phase.start - 1e-9) & (self.t <= phase.stop + 1e-9)).tolist()
            rests = self.at_rest and on[-1] == len(self.t) - 1
            for site in phase.sites:
                k = self.sites.index(site)
                for i in on:
                    now = a[0][:, i] if i < on[-1] else a[1][:, i - 1]
                    p, speed, bend = (x[3 * k : 3 * k + 3] for x in foot(Q[:, i], V[:, i], now))
                    if i == on[0] and i > 0:  # the pose at the start is given
                        equal += [] if phase.ground is None else [p[2] - phase.ground]
                        # rest at the end follows from rest here, and would be asked for twice
                        equal += [] if rests else [speed[[0, 2]]]
                    equal.append(bend[[0, 2]] / 9.81)
                    x, y, z = (F[3 * k + j, i] / weight for j in range(3))
                    # the pyramid inside of the cone: linear, and smooth where nothing pushes
                    below += [sx * x + sy * y - phase.friction * z for sx in (1, -1) for sy in (1, -1)]

    def _clip(self, q: Array, v: Array, a0: Array, a1: Array) -> Clip:
        """Quintics through position, velocity and, from each side, acceleration at the nodes."""
        m, tracks, t = self.machine.model, {}, frozen(self.t)
        powers = _quintic(np.diff(self.t)[:, None], (q[:-1], v[:-1], a0), (q[1:], v[1:], a1))
        for joint in range(m.njnt):
            dof = int(m.jnt_dofadr[joint])
            track = PolynomialCurve(t, frozen(q[:, [dof]]), t, "hold", "hold", frozen(powers[:, :, [dof]]))
            tracks[name_of(m, "joint", joint)] = track
        return Clip(self.clip.model, dict[str, Track](tracks), self.clip.q0)

    def _certify(self, machine: Machine, clip: Clip, tau: Array, f: Array) -> tuple[float, float]:
        """Largest share of a limit in use, and largest force missing relative to the largest at all."""
        fine = np.interp(np.arange(10 * (len(self.t) - 1) + 1) / 10.0, np.arange(len(self.t)), self.t)
        motion = clip.evaluate(fine)
        need = machine.nominal.smooth.inverse(*motion)
        largest = max(float(np.abs(need).max()), 1e-12)
        if f.shape[1]:
            piece = np.minimum(np.arange(len(fine)) // 10, len(self.t) - 2)
            part = ((fine - self.t[piece]) / np.diff(self.t)[piece])[:, None]
            given = (1.0 - part) * f[piece] + part * f[piece + 1]
            need = need - self._pushed(motion.q, given * self._touched.T[piece])
        missing = float(np.abs(need[:, ~machine.driven]).max(initial=0.0)) / largest
        kinematic = replace(machine, driven=np.zeros_like(machine.driven), current=np.inf)
        worst = check_motion(fine, motion, kinematic, keyed=np.ones(len(tau[0]), dtype=bool)).worst
        for k in self.driven:
            low, high, top = machine.force_low[k], machine.force_high[k], machine.top_speed[k]
            if np.isfinite(high - low):
                part = np.where(need[:, k] >= 0, need[:, k] / high, need[:, k] / low)
                part = part + np.where(need[:, k] * motion.v[:, k] > 0, np.abs(motion.v[:, k]) / top, 0.0)
                worst = max(worst, float(part.max()))
        if np.isfinite(machine.current):
            worst = max(worst, float((np.abs(need) @ machine.ampere).max() / machine.current))
        return worst, missing

    def _pushed(self, q: Array, f: Array) -> Array:
        """Joint forces (n, nv) of contact forces."""
        import casadi as ca

        m = self.machine.model
        x, y = ca.SX.sym("q", m.nq), ca.SX.sym("f", f.shape[1])
        p = self.machine.nominal.smooth.tape("sites").casadi("sites")(x, [], [])[0]
        rows = [lookup(m, "site", site) for site in self.sites]
        places = ca.vertcat(*[p[3 * r : 3 * r + 3] for r in rows])
        push = ca.Function("push", [x, y], [ca.jtimes(places, x, y, True)])
        return np.array(push.map(len(q))(q.T, f.T), dtype=np.float64).T


def _between(t: Array, rows: Array, at: Array) -> Array:
    """Rows (n, k) at times t (n,), linearly at other times (m,)."""
    out = np.empty((len(at), rows.shape[1]))
    for k in range(rows.shape[1]):
        out[:, k] = np.interp(at, t, rows[:, k])
    return out


def _quintic(h: Array, start: tuple[Array, Array, Array], end: tuple[Array, Array, Array]) -> Array:
    """Coefficients (6, n, k), highest first, of quintics over lengths h (n, 1) with q, v, a at both ends."""
    (q0, v0, a0), (q1, v1, a1) = start, end
    d, e, g = q1 - q0 - h * v0 - 0.5 * h**2 * a0, v1 - v0 - h * a0, a1 - a0
    c3 = 10.0 * d / h**3 - 4.0 * e / h**2 + 0.5 * g / h
    c4 = -15.0 * d / h**4 + 7.0 * e / h**3 - g / h**2
    c5 = 6.0 * d / h**5 - 3.0 * e / h**4 + 0.5 * g / h**3
    return np.stack([c5, c4, c3, 0.5 * a0, v0, q0])
