"""Swing-up of underactuated pendulums: energy shaping, hand-over to LQR, and foresight between the two.

How soon a motion of shaped energy passes the top slowly enough to be caught depends on gains and chance: the
law therefore tries many gains on its model and takes those that arrive first, again and again until it has
arrived.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import joint_names
from ..sim.control import Target
from .basin import advance
from .energy_shaping import EnergyShaping
from .gains import Gain, per_joint, positive, whole

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PARTS = 16  # stretches of added force on the way to the goal
_SAMPLES, _ROUNDS, _BRANCHES = 64, 5, 3  # of the cross-entropy method; gains it starts from
_ARRIVED, _OFF = 1e12, 1e9  # arrivals are better than any value, whatever crosses a limit is worse
_CATCHING = 2.0  # seconds that a corrected motion has after its nearest point to be caught
_ALONE = 1.0  # seconds at least without the catch for machines that it would lose
_WELL_IN = 0.1  # of the catch's level: a machine that it has brought there is home
_HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
_NO_WAY = "no way home was found: more force, foresight, tries or time may do"
_AS_FORESEEN = 0.01  # rad, m, and per second: a machine so near to where it was foreseen needs no new look


class Intent(NamedTuple):
    """What a batch of machines (b,) is about to do: gains by their index; forces added to theirs in equal
    stretches of time (b, s) and the length of a stretch (b,) [ticks]; when it was decided (b,) [ticks];
    whether the catch waits until these forces are through (b,); and the states (b, looks, 2 n) in which the
    next looks ahead will find it on its way home, NaN where none is known."""

    choice: NDArray[np.intp]
    extra: Array
    stretch: Array
    begun: Array
    alone: Mask
    marks: Array

    def of(self, rows: NDArray[np.intp] | Mask) -> Intent:
        """Those of some machines, as arrays of their own."""
        first = (self.choice[rows], self.extra[rows], self.stretch[rows])
        return Intent(*first, self.begun[rows], self.alone[rows], self.marks[rows])

    def put(self, rows: NDArray[np.intp] | Mask, other: Intent) -> None:
        """Overwrite those of some machines."""
        for mine, theirs in zip(self, other, strict=True):
            mine[rows] = theirs


class SwingMemory(NamedTuple):
    """Intentions of a batch of machines, whether the catch has them (b,), ticks so far, and the tick of the
    next look ahead."""

    intent: Intent
    caught: Mask
    tick: int
    again: int


class SwingUp:
    """Brings a machine with one driven joint to its highest equilibrium, or to ``goal`` [rad, m] (joint ->
    value).

    ``foresight`` [s] of simulated time is looked ahead for each of ``tries`` sets of gains, and again every
    ``every`` [s] until the catch has the machine, unless it is on its way home as foreseen; zero foresight
    takes the first set. Joints that have a range must stay in it with ``room`` [rad, m] to spare. Hinges
    count modulo a turn: a driven one without a range may end some turns from its goal. :meth:`remarks` tells
    what became of it.
    Keys of the driven joint play no part. A look ahead takes far longer than a sample (the control bench
    tells how long); the last answer is kept, so that one who asks once before a run has the first one in
    time. Raises PantographError when the machine has not exactly one driven joint, or no such goal;
    :meth:`start` when nothing can hold it there.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        period: float,
        *,
        goal: Mapping[str, float] | None = None,
        foresight: float = 8.0,
        tries: int = 128,
        every: float = 1.0,
        room: Gain = 0.05,
        seed: int = 1,
    ) -> None:
        tries, seed = whole("tries", tries), whole("seed", seed, least=0)
        self.shaping = EnergyShaping(model, tracked, period, {} if goal is None else goal, tries, seed)
        self.model, self.tracked, self.period = model, tracked, period
        self.nominal, self.a, self.tries, self.seed = self.shaping.nominal, self.shaping.a, tries, seed
        self.low, self.high = self.shaping.low, self.shaping.high
        self.foresight, self.every = positive("foresight", foresight, zero=True), positive("every", every)
        self._answer: tuple[tuple[object, ...], Intent] | None = None
        self.looks = max(1, int(self.foresight / self.every))
        self.room = per_joint(model, "room", room, missing=0.05)

    # ---- the law, on a batch of machines q, v (b, n)

    def force(
        self, q: Array, v: Array, intent: Intent, tick: Array | int, caught: Mask
    ) -> tuple[Array, Mask, Array]:
        """Joint forces (b, nv) within the limits at a tick, who is in the catch's hands, and its value."""
        catch, level = self.shaping.catch
        x = catch.state(q, v)
        value = catch.value(x)
        caught = value < np.where(caught, 9.0 * level, level)
        pump = self.shaping.push(q, v, x[:, self.a], self.shaping.gains[intent.choice])
        part = ((tick - intent.begun) // intent.stretch).astype(np.intp)
        planned = part < intent.extra.shape[1]
        caught &= ~(intent.alone & planned)
        rows = np.arange(len(q))
        pump[:, self.a] += np.where(planned, intent.extra[rows, np.where(planned, part, 0)], 0.0)
        tau = np.where(caught[:, None], catch.force(x), pump)
        return np.clip(tau, self.low, self.high), caught, value

    def foresee(
        self,
        q: Array,
        v: Array,
        intent: Intent,
        tick: int,
        machine: NDArray[np.intp],
        until: Array | float = np.inf,
    ) -> tuple[Array, Array, Array, Array]:
        """What comes ``until`` (b,) ticks later of intentions (b,), several for each ``machine`` (b,): ticks
        until the catch has brought it well into its basin (infinite: another of the machine's is quicker, a
        limit is crossed, or it does not), the least value on the way (much more where a limit is crossed),
        ticks until then, and the states at the next looks ahead (b, looks, 2 n)."""
        b, (_, level) = len(q), self.shaping.catch
        until = np.broadcast_to(until, b)
        home, least, when = np.full(b, np.inf), np.full(b, np.inf), np.zeros(b)
        marks, look = np.full((b, self.looks, 2 * q.shape[1]), np.nan), round(self.every / self.period)
        rows, caught, inside = np.arange(b), np.zeros(b, dtype=bool), np.ones(b, dtype=bool)
        done = np.zeros(int(machine.max(initial=0)) + 1, dtype=bool)
        for k in range(int(self.foresight / self.period)):
            if k and k % look == 0:
                marks[rows, k // look - 1] = np.hstack([q, v])
            tau, caught, value = self.force(q, v, intent, tick + k, caught)
            near = inside & (value < least[rows])
            least[rows[near]], when[rows[near]] = value[near], k
            arrived = rows[inside & caught & (value < _WELL_IN * level)]
            home[arrived], done[machine[arrived]] = k, True
            q, v = advance(self.nominal, q, v, tau, self.period / 2, 2)
            still = inside & self._inside(q)
            least[rows[inside & ~still]] += _OFF
            inside = still
            if k % 10 == 9 or len(arrived):
                keep = inside & (np.abs(v) < 1e3).all(axis=1) & ~done[machine[rows]] & (k < until[rows])
                if not keep.any():
                    break
                q, v, intent = q[keep], v[keep], intent.of(keep)
                rows, caught, inside = rows[keep], caught[keep], inside[keep]
        return home, least, when, marks

    def intend(self, q: Array, v: Array, tick: int, before: Intent) -> Intent:
        """For each machine (b,) what brings it home first in simulation: one of the gains, or what it was
        about to do ``before``. Where nothing does, forces are added to the gains that come nearest until they
        do (cross-entropy method, R. Rubinstein 1999)."""
        b, k = len(q), self.tries
        if self.foresight == 0.0:
            return self._plain(np.zeros(b, dtype=np.intp), tick)
        gains = self._plain(np.tile(np.arange(k), b), tick)
        many = Intent(*(np.concatenate(pair) for pair in zip(gains, before, strict=True)))
        machine = np.concatenate([np.repeat(np.arange(b), k), np.arange(b)])
        home, least, when, marks = self.foresee(q[machine], v[machine], many, tick, machine)
        best, out = home[: b * k].reshape(b, k).argmin(axis=1), before.of(np.arange(b))
        place = np.arange(b) * k + best
        first = home[place]
        better = first < home[b * k :]
        out.put(better, self._plain(best[better], tick))
        out.marks[:] = np.where(better[:, None, None], marks[place], marks[b * k :])
        lost = np.flatnonzero(~np.isfinite(np.minimum(first, home[b * k :])))
        if len(lost):
            near = np.argsort(least[: b * k].reshape(b, k)[lost], axis=1)[:, :_BRANCHES]
            when = np.take_along_axis(when[: b * k].reshape(b, k)[lost], near, axis=1)
            out.put(lost, self._corrected(q[lost], v[lost], near, when, tick, self._held(q[lost], v[lost])))
        return out

    def _plain(self, choice: NDArray[np.intp], tick: int) -> Intent:
        b = len(choice)
        none = np.zeros(b, dtype=bool)
        marks = np.full((b, self.looks, 2 * self.model.nv), np.nan)
        return Intent(choice, np.zeros((b, _PARTS)), np.ones(b), np.full(b, float(tick)), none, marks)

    def _held(self, q: Array, v: Array) -> Mask:
        """Whether the catch would have machines (b,) now."""
        catch, level = self.shaping.catch
        return np.asarray(catch.value(catch.state(q, v)) < level)

    def _corrected(
        self, q: Array, v: Array, choice: NDArray[np.intp], when: Array, tick: int, held: Mask
    ) -> Intent:
        """Intentions of machines (b,) with added forces that arrive first, or come nearest to the goal, about
        several gains ``choice`` (b, c) each, which came nearest after ``when`` (b, c) ticks. From those that
        it would lose although it has them already, ``held`` (b,), the catch keeps its hands for a while."""
        rng, (b, c), p = np.random.default_rng(self.seed), choice.shape, _SAMPLES
        limit, rows = 0.5 * (self.shaping.strongest - self.shaping.weakest), np.arange(b * c)
        when = np.where(held[:, None], np.maximum(when, _ALONE / self.period), when)
        stretch = np.maximum(1.0, np.ceil((when.ravel() + 1.0) / _PARTS))
        until = np.repeat(when.ravel(), p) + _CATCHING / self.period
        mean, spread = np.zeros((b * c, _PARTS)), np.full((b * c, _PARTS), 0.6 * limit)
        best = self._plain(choice.ravel(), tick)._replace(stretch=stretch, alone=np.repeat(held, c))
        score, machine, sample = np.full(b * c, np.inf), np.repeat(np.arange(b), c * p), np.repeat(rows, p)
        for _ in range(_ROUNDS):
            noise = np.tile(rng.normal(size=(c, p, _PARTS)), (b, 1, 1))  # the same for every machine
            extra = mean[:, None] + spread[:, None] * noise
            extra[:, 0] = mean
            many = best.of(sample)._replace(extra=extra.reshape(b * c * p, -1))
            home, least, _, marks = self.foresee(q[machine], v[machine], many, tick, machine, until)
            points = np.where(np.isfinite(home), home - _ARRIVED, least).reshape(b * c, p)
            order = np.argsort(points, axis=1)[:, : max(4, p // 8)]
            elite = np.take_along_axis(extra, order[:, :, None], axis=1)
            mean, spread = elite.mean(axis=1), elite.std(axis=1) + 1e-3 * limit
            marks = np.where(np.isfinite(home)[:, None, None], marks, np.nan)  # others want another look
            now = points[rows, order[:, 0]] < score
            score = np.where(now, points[rows, order[:, 0]], score)
            best.extra[now] = extra[rows, order[:, 0]][now]
            best.marks[now] = marks.reshape(b * c, p, *marks.shape[1:])[rows, order[:, 0]][now]
            if (score.reshape(b, c).min(axis=1) < 0.0).all():
                break
        return best.of(np.arange(b) * c + score.reshape(b, c).argmin(axis=1))

    def _inside(self, q: Array) -> Mask:
        """Whether limited joints are in their range."""
        m = self.model
        limited = np.flatnonzero(m.jnt_limited)
        low, high = m.jnt_range[limited].T
        at = q[:, m.jnt_qposadr[limited]]
        room = self.room[m.jnt_dofadr[limited]]
        return np.asarray(((at > low + room) & (at < high - room)).all(axis=1))

    def begin(self, machines: int) -> SwingMemory:
        """Memory of a batch before its first sample."""
        return SwingMemory(
            self._plain(np.zeros(machines, dtype=np.intp), 0), np.zeros(machines, dtype=bool), 0, 0
        )

    def batch(self, q: Array, v: Array, memory: SwingMemory) -> tuple[Array, SwingMemory]:
        """Forces (b, nv) for a batch of machines q, v (b, n), one sample a period."""
        intent, caught, tick, again = memory
        if tick >= again:
            again = tick + round(self.every / self.period)
            kept = (np.abs(intent.marks[:, 0] - np.hstack([q, v])) < _AS_FORESEEN).all(axis=1)
            intent = intent.of(np.arange(len(q)))
            intent.marks[:] = np.concatenate(
                [intent.marks[:, 1:], np.full_like(intent.marks[:, :1], np.nan)], 1
            )
            away = np.flatnonzero(~caught & ~kept)
            if len(away):
                intent.put(away, self._intended(q[away], v[away], tick, intent.of(away)))
        tau, caught, _ = self.force(q, v, intent, tick, caught)
        return tau, SwingMemory(intent, caught, tick + 1, again)

    def _intended(self, q: Array, v: Array, tick: int, before: Intent) -> Intent:
        """:meth:`intend`, the last answer kept: who asks before a run has it when the run begins."""
        asked = (tick, *(x.tobytes() for x in (q, v, *before)))
        if self._answer is None or self._answer[0] != asked:
            self._answer = asked, self.intend(q, v, tick, before)
        return self._answer[1]

    # ---- the law on one machine

    def start(self) -> SwingMemory:
        """Nothing decided yet. Raises PantographError when no catch can hold the machine at its goal."""
        _ = self.shaping.catch
        return self.begin(1)

    def remarks(self, q: Array, memory: SwingMemory) -> tuple[str, ...]:
        """What a person should know of a run that ends at q (nq,) with this memory, as sentences."""
        goal, name = self.shaping.goal_says, joint_names(self.model)[int(self.model.dof_jntid[self.a])]
        if not memory.caught[0]:
            known = bool(np.isfinite(memory.intent.marks).any())
            hope = "it was on its way home: give the scene more time" if known else _NO_WAY
            low, high = self.shaping.weakest, self.shaping.strongest
            return (
                f"swing-up: not caught at the goal ({goal}) within {memory.tick * self.period:.4g} s; {hope} "
                f"(the drive of {name!r} gives {low:.4g} to {high:.4g} [N m, N])",
            )
        off = float(q[self.a] - self.shaping.goal[self.a])
        turns = round(off / (2.0 * np.pi)) if self.model.jnt_type[self.a] == _HINGE else 0
        if not turns:
            return ()
        wound = f"{abs(turns)} turn{'s' if abs(turns) > 1 else ''}"
        return (
            f"swing-up: {name!r} is held {wound} from its goal, at {q[self.a]:.4g} rad: hinges count modulo "
            "a turn; one that must not wind up needs a range",
        )

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: SwingMemory
    ) -> tuple[Array, SwingMemory]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        tau, memory = self.batch(q[None], v[None], memory)
        return tau[0], memory
