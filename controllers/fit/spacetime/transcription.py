"""A fit as a nonlinear program: Hermite-Simpson collocation on the manifold, contacts as declared phases.

Between nodes a piece is q_0 exp(phi(t)); phi and v are collocated at both ends and in the middle
(C. Hargraves, S. Paris, J. Guidance 10, 1987). Sites that rest have no acceleration at these three points,
which decides their forces there; positions and velocities then stay as they were to the order of the method.
"""

from __future__ import annotations

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....models import lookup
from ....sim.clip import Clip, Motion
from ....sim.errors import PantographError
from ...nominal import difference, moved
from ..charts import Charts
from ..contact import Phase, carried, independent, places, sites_of, touching
from ..ends import moving
from ..machine import WIDTH, Machine

Array = NDArray[np.float64]
GRAVITY = 9.81
_RISE = 0.02  # s
_FORCES = 1e-4  # weight of contact forces, as parts of the whole weight
_SLACK = 1e-5  # rad, m: of hard keys while a site rests, which would else say twice where it is


class Wish(NamedTuple):
    """What a fit is asked for: see :func:`~.collocate.fit`."""

    clip: Clip
    hard: tuple[float, ...]
    phases: tuple[Phase, ...]
    effort: float
    deviation: float
    at_rest: tuple[bool, bool]
    slower: bool  # ends that move may do so slower than keyed


class Point(NamedTuple):
    """Values over n nodes and n - 1 middles: q (2 n - 1, nq) and v (2 n - 1, nv), node, middle, node, ...;
    drive forces (n, nd); accelerations (3, n - 1, nv) and contact forces (3, n - 1, 3 sites) at the
    beginning, middle and end of each piece."""

    q: Array
    v: Array
    tau: Array
    a: Array
    force: Array


class Program(NamedTuple):
    """Expressions of a nonlinear program: x, cost, g, of which the first ``equal`` vanish, the rest <= 0."""

    x: Any
    cost: Any
    g: Any
    equal: int


class Transcription:
    """The program of a ``wish`` of ``machine`` over nodes ``t`` (n,) [s]."""

    def __init__(self, wish: Wish, machine: Machine, t: Array) -> None:
        self.wish, self.machine, self.t, self.h = wish, machine, t, np.diff(t)
        m = self.model = machine.model
        self.sites = sites_of(m, wish.phases)
        self.driven = np.flatnonzero(machine.driven)
        self.inside = moving(machine, wish.clip, wish.phases)
        self.charts = Charts(m)
        middle = 0.5 * (t[1:] + t[:-1])
        self.touched = {s: touching(wish.phases, s, middle) for s in self.sites}
        # an instant is where forces balance: all states, those where contacts change from both sides
        on = np.array(list(self.touched.values()), dtype=bool).reshape(len(self.sites), len(middle))
        changes = np.append(np.any(on[:, 1:] != on[:, :-1], axis=0), True)
        steps = np.stack([np.zeros(len(middle)), np.ones(len(middle)), np.full(len(middle), 2)])
        self.instants = (steps + np.append(0, np.cumsum(2 + changes)[:-1])).astype(int)  # (3, n - 1)
        self.states = steps.astype(int) + 2 * np.arange(len(middle))
        count, nv = int(self.instants.max()) + 1, m.nv
        self.state_of = np.empty(count, dtype=int)
        self.state_of[self.instants] = self.states
        self.times = np.sort(np.concatenate([t, middle]))
        self.wanted = _within(wish.clip, self.times)
        self.shape = {"x": (nv, len(self.times)), "v": (nv, len(self.times))}
        self.shape |= {"tau": (len(self.driven), len(t)), "a": (nv, count), "f": (3 * len(self.sites), count)}
        weight = np.abs(machine.nominal.smooth.inverse(*self.wanted)).max(axis=0) + 1e-3
        high = np.minimum(machine.force_high, -machine.force_low)
        self.strength = np.where(np.isfinite(high), high, np.maximum(weight, 0.1 * weight.max()))
        self.weight = max(GRAVITY * float(m.body_mass.sum()), 1e-9)

    # ---- functions of one state, q = wanted exp(x)

    @cached_property
    def balance(self) -> Any:
        """(wanted, x, v, a, drive forces, contact forces) -> missing joint forces, as parts of their size."""
        import casadi as ca

        m, (wanted, x, v, a) = self.model, self._arguments
        tau, f = ca.SX.sym("tau", len(self.driven)), ca.SX.sym("f", 3 * len(self.sites))
        q = self.charts.moved(wanted, x)
        need = self.machine.nominal.smooth.tape("inverse").casadi("inverse")(q, v, a, [], [])
        for k, dof in enumerate(self.driven):
            need[int(dof)] -= tau[k]
        if self.sites:
            # J'f is the gradient by v of the power f'p'
            at = ca.SX.sym("q", m.nq)
            power = ca.dot(ca.jtimes(self._places(at), at, self.charts.flow(at, v)), f)
            pushed = ca.Function("pushed", [at, v, f], [ca.gradient(power, v)])
            need -= pushed(q, v, f)
        for rubs in np.flatnonzero(self.machine.friction).tolist():
            width = WIDTH if self.machine.driven[rubs] else self.machine.width
            dry = v[rubs] / ca.sqrt(v[rubs] ** 2 + width**2)
            need[rubs] += self.machine.friction[rubs] * dry
        size = np.maximum(self.strength, 0.1 * self.strength.max())
        rows = np.flatnonzero(self.inside).tolist()
        return ca.Function("balance", [wanted, x, v, a, tau, f], [(need / ca.DM(size))[rows]])

    @cached_property
    def feet(self) -> Any:
        """(wanted, x, v, a) -> positions, velocities, accelerations (3 sites,) of the sites."""
        import casadi as ca

        wanted, x, v, a = self._arguments
        q = ca.SX.sym("q", self.model.nq)
        flow, p = self.charts.flow(q, v), self._places(q)
        speed = ca.jtimes(p, q, flow)
        bend = ca.jtimes(speed, q, flow) + ca.jtimes(speed, v, a)
        at = ca.Function("at", [q, v, a], [p, speed, bend])
        return ca.Function("feet", [wanted, x, v, a], at(self.charts.moved(wanted, x), v, a))

    @cached_property
    def step(self) -> Any:
        """(wanted, x, v of the beginning, middle, end; h) -> the way's two conditions of Hermite-Simpson."""
        import casadi as ca

        m, charts, h = self.model, self.charts, ca.SX.sym("h")
        points = [[ca.SX.sym(w, k) for w, k in (("w", m.nq), ("x", m.nv), ("v", m.nv))] for _ in range(3)]
        q0, qm, q1 = (charts.moved(wanted, x) for wanted, x, _ in points)
        v0, vm, v1 = (v for _, _, v in points)
        way, half = charts.apart(q0, q1), charts.apart(q0, qm)
        end = charts.rate(way, v1)
        whole = way / h - (v0 + 4.0 * charts.rate(half, vm) + end) / 6.0
        inner = half / h - 0.5 * way / h - (v0 - end) / 8.0
        return ca.Function("step", [*points[0], *points[1], *points[2], h], [whole, inner])

    @property
    def _arguments(self) -> tuple[Any, Any, Any, Any]:
        import casadi as ca

        m = self.model
        return tuple(ca.SX.sym(w, k) for w, k in (("w", m.nq), ("x", m.nv), ("v", m.nv), ("a", m.nv)))  # type: ignore[return-value]

    def _places(self, q: Any) -> Any:
        import casadi as ca

        p = self.machine.nominal.smooth.tape("sites").casadi("sites")(q, [], [])[0]
        rows = [lookup(self.model, "site", site) for site in self.sites]
        return ca.vertcat(*[p[3 * r : 3 * r + 3] for r in rows])

    # ---- the program

    def program(self) -> Program:
        """Variables are tangents from the keys, velocities, drive forces, accelerations, contact forces."""
        import casadi as ca

        pieces, inside = len(self.h), np.flatnonzero(self.inside).tolist()
        var = {name: ca.MX.sym(name, *size) for name, size in self.shape.items()}
        wanted, H = ca.DM(self.wanted.q.T), ca.DM(self.h).T
        each: Any = ca.repmat(H, len(inside), 1)
        ends = [_columns(self.states[k]) for k in range(3)]
        arguments = [x[:, cut] for cut in ends for x in (wanted, var["x"], var["v"])]
        equal = [rows[inside, :] for rows in self.step.map(pieces)(*arguments, H)]
        v0, vm, v1 = (var["v"][inside, cut] for cut in ends)
        a0, am, a1 = (var["a"][inside, _columns(row)] for row in self.instants)
        equal += [
            (v1 - v0) / each - (a0 + 4.0 * am + a1) / 6.0,
            (vm - 0.5 * (v0 + v1)) / each - (a0 - a1) / 8.0,
        ]
        at, count = _columns(self.state_of), len(self.state_of)
        tau = var["tau"] @ ca.sparsify(ca.DM(self._straight().T))
        here = [wanted[:, at], var["x"][:, at], var["v"][:, at], var["a"]]
        equal.append(self.balance.map(count)(*here, tau[:, at], var["f"]))
        below: list[Any] = []
        sides = tuple(var["a"][:, _columns(row)] for row in self.instants)
        self._limits(equal, below, sides, tau, var["v"])
        if self.sites:
            self._contacts(equal, below, self.feet.map(count)(*here), var["f"])
        g = ca.veccat(*equal, *below)
        count = sum(int(e.numel()) for e in equal)
        return Program(ca.veccat(*var.values()), self._cost(var), g, count)

    def _straight(self) -> Array:
        """Weights (2 n - 1, n) of the nodes' forces at all states."""
        eye = np.eye(len(self.t))
        out = np.empty((len(self.times), len(self.t)))
        out[::2], out[1::2] = eye, 0.5 * (eye[1:] + eye[:-1])
        return out

    def _cost(self, var: dict[str, Any]) -> Any:
        import casadi as ca

        wish, keyed = self.wish, self.wish.clip.dofs
        share: Any = ca.DM(np.gradient(self.t)).T

        def integral(rows: Any) -> Any:
            return ca.dot(ca.sum1(rows**2), share)

        scale = ca.DM(1.0 / self.strength[self.driven])
        push = var["tau"] * ca.repmat(scale, 1, len(self.t))
        cost = wish.deviation * integral(var["x"][np.flatnonzero(keyed).tolist(), ::2])
        # joints without keys need not move more than the motion asks
        cost += 0.1 * wish.effort * integral(var["v"][np.flatnonzero(~keyed).tolist(), ::2])
        cost += wish.effort * integral(push)
        root: Any = ca.repmat(ca.DM(np.sqrt(self.h)).T, len(self.driven), 1)
        # a force that comes within this time costs as much as the force
        cost += _RISE**2 * wish.effort * ca.sumsqr((push[:, 1:] - push[:, :-1]) / root)
        if self.sites:
            # chooses between forces that do the same, and hardly between motions
            lengths = np.zeros(len(self.state_of))
            for row, many in zip(self.instants, (1.0, 4.0, 1.0), strict=True):
                np.add.at(lengths, row, many * self.h / 6.0)
            cost += _FORCES * ca.dot(ca.sum1((var["f"] / self.weight) ** 2), ca.DM(lengths).T)
        return cost

    def _limits(self, equal: list[Any], below: list[Any], A: tuple[Any, ...], tau: Any, v: Any) -> None:
        """Rows for what bounds of single variables do not say.

        Drives have to bear all of dry friction at any speed: what of it is smoothed away at low speed,
        f (1 - |v| / sqrt(v^2 + w^2)), is less than f w^2 / (v^2 + w^2), by which limits are drawn in.
        """
        import casadi as ca

        mm, H = self.machine, ca.DM(self.h).T
        for dof in np.flatnonzero(np.isfinite(mm.jerk)).tolist():
            first, middle, last = (a[dof, :] / mm.jerk[dof] for a in A)
            # slopes of the parabola at both ends; what is held before and after does not accelerate
            for jerk in ((4.0 * middle - 3.0 * first - last) / H, (first - 4.0 * middle + 3.0 * last) / H):
                below += [jerk - 1.0, -jerk - 1.0]
            equal += [a for a, rests in zip((first[0], last[-1]), self.wish.at_rest, strict=True) if rests]
        for k, dof in enumerate(self.driven.tolist()):
            top, high, low = mm.top_speed[dof], mm.force_high[dof], mm.force_low[dof]
            if np.isfinite(high - low) and (np.isfinite(top) or mm.friction[dof]):
                hidden = mm.friction[dof] * WIDTH**2 / (v[dof, :] ** 2 + WIDTH**2)
                push, speed = tau[k, :], v[dof, :] / top
                below += [(push + hidden) / high + speed - 1.0, (push - hidden) / low - speed - 1.0]
        if np.isfinite(mm.current):
            each: Any = ca.DM(mm.ampere[self.driven] / mm.current).T
            below.append(each @ ca.sqrt(tau**2 + 1e-12) - 1.0)

    def _contacts(self, equal: list[Any], below: list[Any], feet: Any, f: Any) -> None:
        """Sites that touch come to rest where their phase begins, and are not accelerated in it."""
        wish, middle, f = self.wish, 0.5 * (self.t[1:] + self.t[:-1]), f / self.weight
        p, speed, bend = feet
        for phase in wish.phases:
            on = np.flatnonzero(phase.holds(middle))
            if not len(on):
                raise PantographError(f"the contact from {phase.start:g} s lies outside of the clip")
            now = np.unique(self.instants[:, on]).tolist()
            rows = self._rows(phase)
            equal.append(bend[rows, now] / GRAVITY)
            for k in (self.sites.index(s) for s in phase.sites):
                x, y, z = (f[3 * k + j, now] for j in range(3))
                # the pyramid inside of the cone: linear, and smooth where nothing pushes
                below += [sx * x + sy * y - phase.friction * z for sx in (1, -1) for sy in (1, -1)]
            if on[0] > 0:
                new = [r for r in rows if not self.touched[self.sites[r // 3]][on[0] - 1]]
                # a pose that is given says already how high its feet are
                given = wish.clip.dofs.all() and phase.holds(np.array(wish.hard)).any()
                if phase.ground is not None and not given:
                    equal += [p[r, now[0]] - phase.ground for r in new if r % 3 == 2]
                # rest at the end follows from rest here, and would be asked for twice
                if not (wish.at_rest[1] and on[-1] == len(middle) - 1):
                    equal += [speed[new, now[0]]]
        grounds = [p.ground for p in wish.phases if p.ground is not None]
        for k, site in enumerate(self.sites):
            resting = np.zeros(len(self.state_of), dtype=bool)
            resting[self.instants[:, self.touched[site]]] = True
            rests = np.isin(self.state_of, self.state_of[resting])
            free = np.flatnonzero(~rests).tolist()
            if free and grounds:
                below.append(min(grounds) - p[3 * k + 2, free])

    def _rows(self, phase: Phase) -> list[int]:
        """Rows of all sites' coordinates that hold the sites of a phase, each motion once."""
        mine = independent(self.model, phase.sites, self.wanted.q[self._node(phase.start)])
        return [3 * self.sites.index(phase.sites[r // 3]) + r % 3 for r in mine]

    # ---- numbers

    def bounds(self) -> tuple[Array, Array]:
        """Least and greatest values of all variables."""
        m, mm = self.model, self.machine
        low = {name: np.full(size[::-1], -np.inf) for name, size in self.shape.items()}
        high = {name: np.full(size[::-1], np.inf) for name, size in self.shape.items()}
        for charted in self.charts.joints:
            for a, b in charted.straight:
                low["x"][:, b] = mm.low[b] - self.wanted.q[:, a]
                high["x"][:, b] = mm.high[b] - self.wanted.q[:, a]
        low["v"][:], high["v"][:] = -mm.velocity, mm.velocity
        low["a"][:], high["a"][:] = -mm.acceleration, mm.acceleration
        low["tau"][:], high["tau"][:] = mm.force_low[self.driven], mm.force_high[self.driven]
        keyed = self.wish.clip.dofs
        for t in (self.t[0], *self.wish.hard):
            k = self._node(t)
            rows = np.ones(m.nv, dtype=bool) if k == 0 else keyed
            slack = _SLACK if k and any(p.holds(self.times[k : k + 1])[0] for p in self.wish.phases) else 0.0
            low["x"][k, rows], high["x"][k, rows] = -slack, slack
        most = mm.velocity if self.wish.slower else np.inf
        for k in (0, -1):
            rows = self._bound_speeds(k)
            v = np.zeros(m.nv) if self.wish.at_rest[k] else np.clip(self.wanted.v[k], -most, most)
            low["v"][k, rows] = (np.minimum(v, 0.0) if self.wish.slower else v)[rows]
            high["v"][k, rows] = (np.maximum(v, 0.0) if self.wish.slower else v)[rows]
        for name in ("x", "v", "a"):
            low[name][:, ~self.inside] = high[name][:, ~self.inside] = 0.0
        for k, site in enumerate(self.sites):
            free = np.ones(len(self.state_of), dtype=bool)
            free[self.instants[:, self.touched[site]]] = False
            low["f"][free, 3 * k : 3 * k + 3] = high["f"][free, 3 * k : 3 * k + 3] = 0.0
        return tuple(np.concatenate([x.ravel() for x in side.values()]) for side in (low, high))  # type: ignore[return-value]

    def _bound_speeds(self, k: int) -> NDArray[np.bool_]:
        """Freedoms (nv,) whose speeds at the begin (``k`` 0) and the end (-1) are given: of what is thrown,
        hung on, or left to swing they are not."""
        wish, driven = self.wish, self.machine.driven
        now = [p for p in wish.phases if p.holds(self.t[[k]])[0]]
        held = driven | carried(self.model, now)
        if wish.at_rest[k]:
            return held | wish.clip.dofs if k else np.ones(self.model.nv, dtype=bool)
        return held & wish.clip.dofs if k else held | ~wish.clip.dofs

    def _node(self, t: float) -> int:
        """Row of the node at a time among all states."""
        return 2 * int(np.argmin(np.abs(self.t - t)))

    def off_ground(self) -> str | None:
        """A hard pose whose resting sites are not on their ground, in words."""
        size = float(self.model.stat.extent)
        for t in (self.t[0], *self.wish.hard):
            for phase in self.wish.phases:
                if phase.ground is None or not phase.holds(np.array([t]))[0]:
                    continue
                k = self._node(t)
                p, _ = places(self.model, phase.sites, self.wanted.q[k : k + 1])
                for site, z in zip(phase.sites, p[0, 2::3] - phase.ground, strict=True):
                    if abs(z) > 1e-4 * size:
                        return (
                            f"at {t:g} s the keyed pose is fixed, and site {site!r}, which is to rest on the "
                            f"ground, is {1e3 * abs(z):.3g} mm {'above' if z > 0 else 'below'} it: "
                            f"move the keys, or the phase's 'ground'"
                        )
        return None

    def guess(self) -> Point:
        """The keys, with the forces that they would need, and the weight on what touches."""
        pieces = len(self.h)
        tau = self.machine.nominal.smooth.inverse(*(x[::2] for x in self.wanted))[:, self.driven]
        force = np.zeros((3, pieces, 3 * len(self.sites)))
        many = np.sum(list(self.touched.values()), axis=0) if self.sites else 0
        for k, site in enumerate(self.sites):
            force[:, :, 3 * k + 2] = np.where(self.touched[site], self.weight / np.maximum(many, 1), 0.0)
        return Point(self.wanted.q, self.wanted.v, tau, self.wanted.a[self.states], force)

    def pack(self, point: Point) -> Array:
        """Variables of a point, within their bounds."""
        rows = zip(self.wanted.q, point.q, strict=True)
        x = np.array([difference(self.model, wanted, q) for wanted, q in rows])
        a, f = (np.empty(self.shape[w][::-1]) for w in ("a", "f"))
        a[self.instants], f[self.instants] = point.a, point.force
        low, high = self.bounds()
        return np.asarray(
            np.clip(np.concatenate([p.ravel() for p in (x, point.v, point.tau, a, f)]), low, high)
        )

    def unpack(self, x: Array) -> tuple[Point, Array]:
        """The point of variables, and its tangents (2 n - 1, nv) from the keys."""
        sizes = np.cumsum([a * b for a, b in self.shape.values()])[:-1]
        parts = zip(np.split(x, sizes), self.shape.values(), strict=True)
        x, v, tau, a, f = (p.reshape(size[::-1]) for p, size in parts)
        q = np.array([moved(self.model, wanted, d) for wanted, d in zip(self.wanted.q, x, strict=True)])
        return Point(q, v, tau, a[self.instants], f[self.instants]), x


def _within(clip: Clip, t: Array) -> Motion:
    """A clip at times t (n,), at the last one as it gets there: what is held after it has no speed."""
    before, last = clip.evaluate(t[:-1]), clip.evaluate(t[-1:], left=True)
    return Motion(*map(np.concatenate, zip(before, last, strict=True)))


def _columns(row: Array) -> list[int]:
    return [int(k) for k in row]
