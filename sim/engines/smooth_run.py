"""What runs of the smooth engine share: their state, impacts at limits, and the segment they become."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from ...models import name_of
from .common import HUGE, Broken, Ticks, fastest_joint, place_of, recorded, rows
from .compiled import Compiled
from .interface import Array, Controls, Event, Held, Problem, Segment, State
from .limits import Limit, complementary, limits_of, rebound, slack
from .smooth import width_of
from .tick import Tick, tick_of
from .timed import Timed

if TYPE_CHECKING:
    from ..integrate import Tableau

NARROW = 1e-12
"""Moments of events are known to this share of their step."""

MOST = 1000
"""Events within one step, or without time between them."""

TOUCHING = 1e-9
"""Joints this near to a limit [rad, m] take part in an impact."""


class Moment(NamedTuple):
    """The first event within a step: the share of the step before it, the limit, and whether it is met."""

    share: float
    limit: Limit
    met: bool


class _Diverged(Exception):
    """The state makes no sense any more, why is the message."""


class Run(ABC):
    """State of one run: the whole model's q, v, act at `offset` seconds after its start."""

    def __init__(
        self, problem: Problem, t_span: tuple[float, float], controls: Controls | None, method: Tableau
    ) -> None:
        self.problem, self.controls, self.method, self.t0 = problem, controls, method, t_span[0]
        self.h = problem.step
        self.steps = round((t_span[1] - t_span[0]) / self.h)
        self.timed, self.limits = Timed(problem), limits_of(problem)
        self.resting: tuple[Limit, ...] = ()
        self.compiled: dict[tuple[Limit, ...], Compiled] = {}
        self.offset = 0.0
        self.q, self.v, self.act = (np.array(x, dtype=float) for x in problem.state0)
        self.held = Held(np.zeros(problem.model.nu), np.zeros(problem.model.nv))
        self.mark()
        self.samples: list[tuple[float, State]] = []
        self.rests: list[tuple[Limit, ...]] = []
        self.ticks = Ticks(problem.model)
        self.events: list[Event] = []
        self.evaluations = 0
        self.build_s = 0.0
        self.done = 0  # steps

    def segment(self, progress: Callable[[float], None] | None) -> Segment:
        """Run to the end, or as far as it goes."""
        started, status, message, failure = time.perf_counter(), "done", "", None
        try:
            if self.limits.each:
                with self.preparing():
                    import scipy.optimize  # noqa: F401  # takes its time when it is needed first
            message = self.advance(progress)
            status = "diverged" if message else "done"
        except _Diverged as why:
            status, message = "diverged", str(why)
            self._keep_last()
        except KeyboardInterrupt:
            status, message = "interrupted", f"interrupted at t = {self._keep_last():.4g} s"
        except Exception as error:
            status, failure = "failed", error
            message = f"failed at t = {self._keep_last():.4g} s: {place_of(error)}"
        segment = self.result(status, message, time.perf_counter() - started)
        if failure is not None:
            raise Broken(segment) from failure
        return segment

    def mark(self) -> None:
        """The state is whole: what a run that is stopped before the next mark ends with."""
        self.last = self.offset, State(self.q.copy(), self.v.copy(), self.act.copy()), self.resting

    def _keep_last(self) -> float:
        """Record the last whole state of a run that was stopped; its time [s]."""
        offset, state, self.resting = self.last
        self.ticks.forget_after(self.t0 + offset)
        if not (self.samples and self.samples[-1][0] >= self.t0 + offset):
            self.keep(offset, *state)
        return self.t0 + offset

    @abstractmethod
    def advance(self, progress: Callable[[float], None] | None) -> str:
        """Move the state to the end, keeping samples; why the state makes no sense, or an empty string."""

    @property
    def now(self) -> float:
        """Time of the state [s]."""
        return self.t0 + self.offset

    @cached_property
    def width(self) -> float | None:
        """Speed below which dry friction is smoothed."""
        return width_of(self.problem)

    def model(self, resting: tuple[Limit, ...] | None = None) -> Compiled:
        """The compiled model, with the joints that rest at a limit taken out of the unknowns."""
        resting = self.resting if resting is None else resting
        if resting not in self.compiled:
            with self.preparing():
                self.compiled[resting] = Compiled(
                    self.problem, self.timed, self.t0, self.method, width=self.width, resting=resting
                )
        return self.compiled[resting]

    @contextmanager
    def preparing(self) -> Iterator[None]:
        """Time that is no integration."""
        begun = time.perf_counter()
        yield
        self.build_s += time.perf_counter() - begun

    def compile(self, c: Compiled, *names: str, count: int = 1) -> None:
        """Have functions of the compiled model for ``count`` states."""
        with self.preparing():
            for name in names:
                c.smooth.program(name, 1 if count == 1 else c.smooth.lanes)

    def sample(self, k: int) -> None:
        """Sample the controller at its tick ``k``."""
        assert self.controls is not None
        self.held = self.controls.sample(k, self.now, self.q.copy(), self.v.copy())
        self.ticks.add(self.now, self.held)

    @cached_property
    def tick(self) -> Tick | None:
        """The controller's tick, where it can be compiled."""
        with self.preparing():
            return tick_of(self.controls, self.steps * self.h)

    def ticked(self, c: Compiled, times: Array, u: Array, memory: Array) -> None:
        """Machine code has sampled the controller at ``times`` (n,), gave rows ``u`` (n, ...), and ends with
        this memory."""
        assert self.tick is not None
        ctrl, qfrc = c.whole_held(u)
        self.held = Held(ctrl[-1], qfrc[-1])
        self.ticks.extend(times, ctrl, qfrc)
        self.tick.remember(float(times[-1]), memory)

    def keep(self, offset: float, q: Array, v: Array, act: Array) -> None:
        """Record a state; of several at one moment the last, from which the run goes on."""
        if self.samples and self.samples[-1][0] == self.t0 + offset:
            del self.samples[-1], self.rests[-1]
        self.rests.append(self.resting)  # first, so that an interrupt leaves no sample without it
        self.samples.append((self.t0 + offset, State(q.copy(), v.copy(), act.copy())))

    def roll(self, length: float) -> tuple[Array, Array, Array]:
        """The state one step of ``length`` seconds later; what looks for events in it needs it to be sane."""
        c = self.model()
        w = c.prescribed(np.array([self.offset]), length)
        x = c.stepper(c.gather(self.q, self.v, self.act), c.held(self.held), 1, length, w)
        self.evaluations += c.stepper.stages
        state = c.spread(x[-1], c.at(np.array([self.offset + length]))[0])
        if message := self._nonsense(*state[:2]):
            raise _Diverged(message)
        return state

    def first_event(self, length: float) -> Moment | None:
        """What happens first within one step of ``length`` seconds from here."""
        q, v, _ = self.roll(length)
        found: list[Moment] = []
        for limit in self.limits.near(self.q, self.v, q, v, length, self.resting):
            share = self._meeting(limit, q, v, length)
            if share is not None:
                found.append(Moment(share, limit, True))
        for i, limit in enumerate(self.resting):
            pulled = self._weakest(i, length)
            if pulled is not None:
                found.append(Moment(self._leaving(i, pulled, length), limit, False))
        return min(found, key=lambda moment: moment.share, default=None)

    def _meeting(self, limit: Limit, q: Array, v: Array, length: float) -> float | None:
        """Share of the step at which a gap closes, to rounding; None if it stays open."""
        from scipy.optimize import brentq

        def gap(share: float) -> float:
            return limit.gap(self.roll(share * length)[0]) if share > 0.0 else limit.gap(self.q)

        def closing(share: float) -> float:
            return limit.side * float(
                self.roll(share * length)[1][limit.dof] if share > 0.0 else self.v[limit.dof]
            )

        first, last = 0.0, 1.0
        if limit.gap(q) >= 0.0:  # it may have closed and opened again: look where it is smallest
            last = float(brentq(closing, 0.0, 1.0, xtol=1e-9))
            if gap(last) >= 0.0:
                return None
        elif gap(0.0) <= 0.0 and closing(0.0) < 0.0 < closing(1.0):  # it leaves the limit and comes back
            first = float(brentq(closing, 0.0, 1.0, xtol=NARROW))
        if gap(first) <= 0.0:
            tries = (share for share in (1e-3, 0.03, 0.1, 0.3, 0.6, 0.9) if share < last)
            first = next((share for share in tries if gap(share) > 0.0), 0.0)
        return first if gap(first) <= 0.0 else float(brentq(gap, first, last, xtol=NARROW))

    def _force(self, i: int, share: float, length: float) -> float:
        """Force of the limit on the joint that rests on it, a share of the step from here."""
        state = self.roll(share * length) if share > 0.0 else (self.q, self.v, self.act)
        return float(self.limit_forces(self.offset + share * length, *state)[i])

    def _weakest(self, i: int, length: float) -> float | None:
        """A share of the step, the first that is found, at which the limit pulls; None if it never does."""
        from scipy.optimize import minimize_scalar

        shares = np.linspace(0.0, 1.0, 9)
        forces = np.array([self._force(i, float(share), length) for share in shares])
        if (forces < 0).any():
            return float(shares[np.argmax(forces < 0)])
        least = int(np.argmin(forces))
        around = shares[max(0, least - 1)], shares[min(8, least + 1)]
        found = minimize_scalar(lambda share: self._force(i, share, length), bounds=around, method="bounded")
        return float(found.x) if found.fun < 0 else None

    def _leaving(self, i: int, last: float, length: float) -> float:
        """Share of the step at which the limit begins to pull the joint on it, as it does at the ``last``."""
        from scipy.optimize import brentq

        if last == 0.0 or self._force(i, 0.0, length) <= 0.0:
            return 0.0
        root = float(brentq(lambda share: self._force(i, share, length), 0.0, last, xtol=NARROW))
        # on the side where it pulls, so that the joint is let go
        after = min(last, root + 4 * NARROW)
        return after if self._force(i, after, length) < 0.0 else last

    def move(self, share: float, length: float) -> None:
        """Go on by a ``share`` of a step."""
        if share > 0.0:
            self.q, self.v, self.act = self.roll(share * length)
            self.offset += share * length

    def happen(self, moment: Moment) -> None:
        """The event at the current state."""
        self._settle(moment.limit if moment.met else None)

    def limit_forces(self, offset: float, q: Array, v: Array, act: Array) -> Array:
        """Forces (resting,) that the limits give, positive away from them."""
        return np.asarray(self.forces_at(np.array([offset]), q[None], v[None], act[None])[0])

    def forces_at(self, offsets: Array, q: Array, v: Array, act: Array) -> Array:
        """Forces (n, resting) that the limits give at n states, and may just pull: see `slack`."""
        c = self.model()
        self.compile(c, "drive", count=len(q))
        drive = c.smooth.drive(q[:, c.q_free], v[:, c.v_free], c.held(self.held), act=act, w=c.at(offsets))
        at = [int(np.flatnonzero(c.v_keyed == limit.dof)[0]) for limit in self.resting]
        sides = np.array([limit.side for limit in self.resting], dtype=float)
        pushed = np.array([self.held.qfrc[limit.dof] for limit in self.resting])
        return np.asarray(sides * (pushed - drive[:, at]) + slack(pushed))

    def release(self) -> None:
        """Let joints go that their limits would have to pull."""
        if self.resting and (self.limit_forces(self.offset, self.q, self.v, self.act) < 0).any():
            self._settle(None)

    def _settle(self, hit: Limit | None) -> None:
        """An impact on the limit ``hit``, if any, and which joints rest on their limits from here on.

        Of the joints at their limits, impulses p and velocities u away from them satisfy u+ = u + W p >= 0,
        p >= 0, p u+ = 0, W = J M^-1 J', or rebound (see `rebound`); of those that stay, forces and
        accelerations do likewise (R. Featherstone, Rigid Body Dynamics Algorithms, ch. 11).
        """
        gaps = self.limits.gaps(self.q[None])[0]
        at = [
            limit
            for limit, gap in zip(self.limits.each, gaps, strict=True)
            if gap <= TOUCHING or limit is hit
        ]
        c = self.model(())
        self.compile(c, "mass_matrix", "forward")
        side = -np.array([limit.side for limit in at], dtype=float)
        dof = np.array([int(np.flatnonzero(c.v_free == limit.dof)[0]) for limit in at])
        w = c.at(np.array([self.offset]))[0]
        inverse = np.linalg.inv(c.smooth.mass_matrix(self.q[c.q_free], w=w))[:, dof] * side
        W = side[:, None] * inverse[dof]
        u = side * self.v[c.v_free[dof]]
        scale = 1.0 + np.abs(u).max(initial=0.0)
        if hit is not None:
            self._note("limit", hit)
            self.q[hit.qpos] = hit.bound
            u[at.index(hit)] = min(0.0, u[at.index(hit)])  # back before rounding lets it see a gap
            impulse, u = rebound(W, u, self.problem.restitution)
            self.v[c.v_free] += inverse @ impulse
        stays = np.abs(u) <= 1e-12 * scale
        self.v[c.v_free[dof]] = np.where(stays, 0.0, side * u)
        a = c.smooth.forward(self.q[c.q_free], self.v[c.v_free], c.held(self.held), act=self.act, w=w)
        away, W = side[stays] * a[dof[stays]], W[np.ix_(stays, stays)]
        force = complementary(W, away)
        # what a limit may pull accelerates its joint by least when all the others stay
        rests = (force > 0) | (away + W @ force <= 0.5 * slack(force) / np.diag(np.linalg.inv(W)))
        kept = tuple(
            limit for limit, stay in zip(np.array(at, dtype=object)[stays], rests, strict=True) if stay
        )
        for limit in kept:
            self.q[limit.qpos] = limit.bound
            if limit is not hit and limit not in self.resting:
                self._note("limit", limit)
        for limit in at:
            if limit not in kept and (limit is hit or limit in self.resting):
                self._note("limit end", limit)
        self.resting = kept

    def _note(self, kind: str, limit: Limit) -> None:
        self.events.append(Event(self.now, kind, name_of(self.problem.model, "joint", limit.joint)))

    def nonsense(self) -> str:
        """Why the state makes no sense, or an empty string."""
        return self._nonsense(self.q, self.v)

    def _nonsense(self, q: Array, v: Array) -> str:
        joint = fastest_joint(self.problem.model, q, v)
        if joint is None:
            return ""
        sooner = "a smaller step" + (" or period of the controller" if self.controls else "")
        return (
            f"diverged at t = {self.now:.4g} s at joint {joint!r}: with {self.problem.integrator} and "
            f"{self.pace} the motion is too fast or too stiff; try {sooner}, or check forces and initial "
            "state"
        )

    @property
    def pace(self) -> str:
        """What sets the steps, in words."""
        return f"a step of {self.h:g} s"

    def _accelerations(self, kept: list[tuple[float, State]]) -> tuple[Array, Array]:
        """Accelerations and forces of the drives (n, nv) at the samples, those at rest apart."""
        n, m = len(kept), self.problem.model
        a, drive = np.zeros((n, m.nv)), np.zeros((n, m.nv))
        t = np.array([t for t, _ in kept])
        ticks, ctrl, qfrc = self.ticks.arrays()
        tick = np.searchsorted(ticks, t + 1e-9, side="right") - 1
        for resting in dict.fromkeys(self.rests[:n]):
            at = np.array([i for i in range(n) if self.rests[i] == resting])
            c = self.model(resting)
            q, v = (rows([getattr(kept[i][1], x) for i in at], w) for x, w in (("q", m.nq), ("v", m.nv)))
            act = rows([kept[i][1].act for i in at], m.na)
            u = np.zeros((len(at), c.smooth.layout.nu))
            under = tick[at] >= 0
            u[under] = c.held(Held(ctrl[tick[at[under]]], qfrc[tick[at[under]]]))
            w = c.at(t[at] - self.t0)
            state = {"q": q[:, c.q_free], "v": v[:, c.v_free], "act": act, "u": u, "w": w}
            a[np.ix_(at, c.v_free)] = c.smooth.evaluate("forward", **state)["a"]
            if len(c.v_keyed):
                a[np.ix_(at, c.v_keyed)] = c.accelerations(w)
                drive[np.ix_(at, c.v_keyed)] = c.smooth.evaluate("drive", **state)["drive"]
                drive[np.ix_(at, np.array([limit.dof for limit in resting], dtype=int))] = 0.0
        return a, drive

    def facts(self) -> dict[str, Any]:
        """Statistics of this kind of run."""
        return {}

    def result(self, status: str, message: str, wall: float) -> Segment:
        """The segment of what was computed."""
        kept = [
            (t, s) for t, s in self.samples if np.isfinite(s.q).all() and np.abs(s.v).max(initial=0) < HUGE
        ]
        a, drive = self._accelerations(kept)
        builds = [c.smooth.stats for c in self.compiled.values()]
        stats = {
            "engine": "smooth",
            "integrator": self.problem.integrator,
            "step": self.h,
            "steps": self.done,
            "evaluations": self.evaluations,
            "wall_s": wall - self.build_s,
            "build_s": self.build_s,
            "build_cached": all(b.cached for b in builds),
            "friction_width": self.width,
            "restitution": self.problem.restitution if self.limits.each else None,
        }
        return Segment(
            **recorded(self.problem.model, kept, self.ticks),
            status=status,
            message=message,
            stats=stats | self.facts(),
            events=tuple(self.events),
            a=a,
            drive=drive,
        )
