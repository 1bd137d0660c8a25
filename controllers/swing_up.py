"""Swing-up of underactuated pendulums: energy shaping, hand-over to LQR, and foresight between the two.

Energy shaping after R. Lozano, I. Fantoni, D. Block (Systems & Control Letters 40, 2000) and X. Xin,
M. Kaneda (Int. J. Robust Nonlinear Control 17, 2007), for any machine with one driven joint a: with E the
energy, V = (E - E_up)^2 / 2 + kd v_a^2 / 2 + kp q_a^2 / 2 falls as -kv v_a^2 under
tau = -(kv v_a + kp q_a + kd b) / (E - E_up + kd c), where v_a' = c tau + b. How soon such a motion passes the
top slowly enough to be caught depends on gains and chance: the law therefore tries many gains on its model
and takes those that arrive first, again and again until it has arrived.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import product
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import joint_names
from ..sim.control import Target
from ..sim.errors import PantographError, unknown
from .basin import Catch, advance, comes_home
from .gains import force_limits, positive, whole
from .nominal import Nominal

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_PARTS = 16  # stretches of added force on the way to the goal
_SAMPLES, _ROUNDS, _BRANCHES = 64, 5, 3  # of the cross-entropy method; gains it starts from
_ARRIVED = 1e12  # that arrivals are better than any value
_CATCHING = 2.0  # seconds that a corrected motion has after its nearest point to be caught
_WELL_IN = 0.1  # of the catch's level: a machine that it has brought there is home


class Intent(NamedTuple):
    """What a batch of machines (b,) is about to do: gains by their index; forces added to theirs in equal
    stretches of time (b, s) and the length of a stretch (b,) [ticks]; when it was decided (b,) [ticks]."""

    choice: NDArray[np.intp]
    extra: Array
    stretch: Array
    begun: Array

    def of(self, rows: NDArray[np.intp] | Mask) -> Intent:
        """Those of some machines, as arrays of their own."""
        return Intent(self.choice[rows], self.extra[rows], self.stretch[rows], self.begun[rows])

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
    """Brings a machine with one driven joint to its highest equilibrium, or to ``goal`` (joint -> value).

    ``foresight`` [s] of simulated time is looked ahead for each of ``tries`` sets of gains, every
    ``every`` [s] until the catch has the machine; zero foresight takes the first set. Slides without range
    and hinges alike; slides must stay in their range with ``room`` [m] to spare. Hinges count modulo a turn.
    Raises PantographError when the machine has not exactly one driven joint, or no such goal.
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
        room: float = 0.05,
        seed: int = 1,
    ) -> None:
        if int(tracked.sum()) != 1:
            raise PantographError(f"swing-up needs exactly one tracked joint, got {int(tracked.sum())}")
        self.model, self.tracked, self.period = model, tracked, period
        self.nominal, self.a = Nominal(model), int(np.flatnonzero(tracked)[0])
        self.low, self.high = force_limits(model)
        self.foresight, self.every = positive("foresight", foresight, zero=True), positive("every", every)
        self.tries, self.seed = whole("tries", tries), whole("seed", seed, least=0)
        self.room = positive("room", room, zero=True)
        if not np.isfinite(self.high[self.a] - self.low[self.a]):
            raise PantographError(
                "swing-up needs to know what the drive can give: set the actuator's ctrlrange"
            )
        self.given = dict(goal or {})
        names = joint_names(model)
        for name in self.given:
            if name not in names:
                raise PantographError(unknown("joint", name, names))

    # ---- what is worked out once

    @cached_property
    def goal(self) -> Array:
        """The equilibrium to reach, (nq,): every hinge at 0 or pi, highest in energy, unless it was given."""
        m, names = self.model, joint_names(self.model)
        free = [
            j
            for j in range(m.njnt)
            if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and names[j] not in self.given
        ]
        base = np.zeros(m.nq)
        for name, value in self.given.items():
            base[m.jnt_qposadr[names.index(name)]] = value
        choices = []
        for turn in product((0.0, np.pi), repeat=len(free)):
            q = base.copy()
            q[m.jnt_qposadr[free]] = turn
            choices.append(q)
        heights = [float(self.nominal.smooth.energy(q, np.zeros(m.nv))[1]) for q in choices]
        return choices[int(np.argmax(heights))]

    @cached_property
    def top(self) -> float:
        """Energy at the goal [J]."""
        return float(self.nominal.smooth.energy(self.goal, np.zeros(self.model.nv))[1])

    @cached_property
    def gains(self) -> Array:
        """Sets of gains (tries, 4): natural frequency [rad/s] and damping of the driven joint, weight of its
        motion in V relative to the energy to be gained, and part of the pull to its middle while pumping."""
        rng = np.random.default_rng(self.seed)
        w = self.rate * np.exp(rng.uniform(np.log(0.2), np.log(1.5), self.tries))
        zeta = np.exp(rng.uniform(np.log(0.05), np.log(0.7), self.tries))
        weight = np.exp(rng.uniform(np.log(0.01), np.log(1.0), self.tries))
        pull = np.exp(rng.uniform(np.log(0.02), np.log(0.7), self.tries))
        return np.stack([w, zeta, weight, pull], axis=1)

    @cached_property
    def rate(self) -> float:
        """Fastest pole about the goal [rad/s]: the machine's own time scale."""
        poles = np.abs(np.log(np.abs(np.linalg.eigvals(self.catch_open)))) / self.period
        return float(max(poles.max(), 1e-3))

    @cached_property
    def catch_open(self) -> Array:
        """A of the machine about its goal over one period."""
        from .design.linear import held_matrices, linearise_path

        still = np.zeros((1, self.model.nv))
        path = (self.goal[None], still, still, self.nominal.weight(self.goal)[None])
        return held_matrices(*linearise_path(self.nominal, *path, inputs=self.tracked), self.period)[0]

    @cached_property
    def catch(self) -> tuple[Catch, float]:
        """The LQR about the goal and the value below which it brings the machine home.

        States cost little beside forces: that makes the basin of cut forces wide. The level is the highest at
        which 95 % of random states come home in simulation.
        """
        rng, n = np.random.default_rng(self.seed), self.model.nv
        little = 1.0 / min(-self.low[self.a], self.high[self.a])
        catch = Catch(
            self.nominal, self.tracked, self.goal, self.period, reach=little, speed=10.0 * little / self.rate
        )
        root = np.linalg.cholesky(np.linalg.inv(catch.regulator.P))
        x = rng.normal(size=(128, 2 * n))
        x = (x / np.linalg.norm(x, axis=1)[:, None]) @ root.T

        def works(size: float) -> bool:
            q, v = self.goal + size * x[:, :n], size * x[:, n:]
            home = comes_home(catch, q, v, (self.low, self.high), seconds=25.0 / self.rate)
            return bool(home.mean() >= 0.95)

        size = 1e-3
        while size < 1e6 and works(2.0 * size):
            size *= 2.0
        for factor in (2.0**0.5, 2.0**0.25):
            size *= factor if works(factor * size) else 1.0
        return catch, size**2

    # ---- the law, on a batch of machines q, v (b, n)

    def force(
        self, q: Array, v: Array, intent: Intent, tick: Array | int, caught: Mask
    ) -> tuple[Array, Mask, Array]:
        """Joint forces (b, nv) within the limits at a tick, who is in the catch's hands, and its value."""
        catch, level = self.catch
        x = catch.state(q, v)
        value = catch.value(x)
        caught = value < np.where(caught, 9.0 * level, level)
        pump = self._pump(q, v, x[:, self.a], self.gains[intent.choice])
        part = ((tick - intent.begun) // intent.stretch).astype(np.intp)
        planned = part < intent.extra.shape[1]
        rows = np.arange(len(q))
        pump[:, self.a] += np.where(planned, intent.extra[rows, np.where(planned, part, 0)], 0.0)
        tau = np.where(caught[:, None], catch.force(x), pump)
        return np.clip(tau, self.low, self.high), caught, value

    def _pump(self, q: Array, v: Array, where: Array, gains: Array) -> Array:
        """Energy shaping, (b, nv), with the driven joints ``where`` (b,) from their goals."""
        smooth, a = self.nominal.smooth, self.a
        w, zeta, weight, pull = gains.T
        kinetic, potential = smooth.energy(q, v)
        missing = self.top - kinetic - potential
        unit = np.zeros(self.model.nv)
        unit[a] = 1.0
        b = smooth.forward(q, v)[:, a]
        c = smooth.forward(q, v, tau=unit)[:, a] - b
        scale = self._lift * weight / self._mobility
        spring = w**2 * where + 2.0 * zeta * w * v[:, a]
        # while energy is missing the denominator may vanish: the sign of the pump is what counts then
        below = scale * c - missing
        safe = np.where(
            np.abs(below) < 0.05 * scale * c, 0.05 * scale * c * np.where(below < 0, -1.0, 1.0), below
        )
        shaped = -(scale * (spring + b)) / safe
        limit = np.minimum(-self.low[a], self.high[a])
        push = (
            limit
            * np.clip(5.0 * missing / self._lift, -1.0, 1.0)
            * np.sign(np.where(v[:, a] == 0.0, 1.0, v[:, a]))
        )
        pumped = push - pull * spring / c
        tau = np.zeros_like(v)
        tau[:, a] = np.where(below > 0.05 * scale * c, shaped, pumped)
        return tau

    @cached_property
    def _lift(self) -> float:
        """Energy between the lowest and the highest equilibrium [J]."""
        low = self.goal.copy()
        heights = []
        hinges = np.flatnonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
        for turn in product((0.0, np.pi), repeat=len(hinges)):
            low[self.model.jnt_qposadr[hinges]] = turn
            heights.append(float(self.nominal.smooth.energy(low, np.zeros(self.model.nv))[1]))
        return max(self.top - min(heights), 1e-9)

    @cached_property
    def _mobility(self) -> float:
        """Acceleration of the driven joint by its force at the goal [1/(kg m^2), 1/kg]."""
        return float(np.linalg.inv(self.nominal.mass_matrix(self.goal))[self.a, self.a])

    def foresee(
        self,
        q: Array,
        v: Array,
        intent: Intent,
        tick: int,
        machine: NDArray[np.intp],
        until: Array | float = np.inf,
    ) -> tuple[Array, Array, Array]:
        """What comes ``until`` (b,) ticks later of intentions (b,), several for each ``machine`` (b,): ticks
        until the catch has brought it well into its basin (infinite: another of the machine's is quicker, a
        limit is crossed, or it does not), the least value on the way, and ticks until then."""
        b, (_, level) = len(q), self.catch
        until = np.broadcast_to(until, b)
        home, least, when = np.full(b, np.inf), np.full(b, np.inf), np.zeros(b)
        rows, caught, inside = np.arange(b), np.zeros(b, dtype=bool), np.ones(b, dtype=bool)
        done = np.zeros(int(machine.max(initial=0)) + 1, dtype=bool)
        for k in range(int(self.foresight / self.period)):
            tau, caught, value = self.force(q, v, intent, tick + k, caught)
            near = inside & (value < least[rows])
            least[rows[near]], when[rows[near]] = value[near], k
            arrived = rows[inside & caught & (value < _WELL_IN * level)]
            home[arrived], done[machine[arrived]] = k, True
            q, v = advance(self.nominal, q, v, tau, self.period / 2, 2)
            inside &= self._inside(q)
            if k % 10 == 9 or len(arrived):
                keep = inside & (np.abs(v) < 1e3).all(axis=1) & ~done[machine[rows]] & (k < until[rows])
                if not keep.any():
                    break
                q, v, intent = q[keep], v[keep], intent.of(keep)
                rows, caught, inside = rows[keep], caught[keep], inside[keep]
        return home, least, when

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
        home, least, when = self.foresee(q[machine], v[machine], many, tick, machine)
        best, out = home[: b * k].reshape(b, k).argmin(axis=1), before.of(np.arange(b))
        first = home[np.arange(b) * k + best]
        better = first < home[b * k :]
        out.put(better, self._plain(best[better], tick))
        lost = np.flatnonzero(~np.isfinite(np.minimum(first, home[b * k :])))
        if len(lost):
            near = np.argsort(least[: b * k].reshape(b, k)[lost], axis=1)[:, :_BRANCHES]
            when = np.take_along_axis(when[: b * k].reshape(b, k)[lost], near, axis=1)
            out.put(lost, self._corrected(q[lost], v[lost], near, when, tick))
        return out

    def _plain(self, choice: NDArray[np.intp], tick: int) -> Intent:
        b = len(choice)
        return Intent(choice, np.zeros((b, _PARTS)), np.ones(b), np.full(b, float(tick)))

    def _corrected(self, q: Array, v: Array, choice: NDArray[np.intp], when: Array, tick: int) -> Intent:
        """Intentions of machines (b,) with added forces that arrive first, or come nearest to the goal, about
        several gains ``choice`` (b, c) each, which came nearest after ``when`` (b, c) ticks."""
        rng, (b, c), p = np.random.default_rng(self.seed), choice.shape, _SAMPLES
        limit, rows = min(-self.low[self.a], self.high[self.a]), np.arange(b * c)
        stretch = np.maximum(1.0, np.ceil((when.ravel() + 1.0) / _PARTS))
        until = np.repeat(when.ravel(), p) + _CATCHING / self.period
        mean, spread = np.zeros((b * c, _PARTS)), np.full((b * c, _PARTS), 0.6 * limit)
        best = self._plain(choice.ravel(), tick)._replace(stretch=stretch)
        score, machine, sample = np.full(b * c, np.inf), np.repeat(np.arange(b), c * p), np.repeat(rows, p)
        for _ in range(_ROUNDS):
            noise = np.tile(rng.normal(size=(c, p, _PARTS)), (b, 1, 1))  # the same for every machine
            extra = mean[:, None] + spread[:, None] * noise
            extra[:, 0] = mean
            many = best.of(sample)._replace(extra=extra.reshape(b * c * p, -1))
            home, least, _ = self.foresee(q[machine], v[machine], many, tick, machine, until)
            points = np.where(np.isfinite(home), home - _ARRIVED, least).reshape(b * c, p)
            order = np.argsort(points, axis=1)[:, : max(4, p // 8)]
            elite = np.take_along_axis(extra, order[:, :, None], axis=1)
            mean, spread = elite.mean(axis=1), elite.std(axis=1) + 1e-3 * limit
            now = points[rows, order[:, 0]] < score
            score = np.where(now, points[rows, order[:, 0]], score)
            best.extra[now] = extra[rows, order[:, 0]][now]
            if (score.reshape(b, c).min(axis=1) < 0.0).all():
                break
        return best.of(np.arange(b) * c + score.reshape(b, c).argmin(axis=1))

    def _inside(self, q: Array) -> Mask:
        """Whether limited joints are in their range."""
        m = self.model
        limited = np.flatnonzero(m.jnt_limited)
        low, high = m.jnt_range[limited].T
        at = q[:, m.jnt_qposadr[limited]]
        return np.asarray(((at > low + self.room) & (at < high - self.room)).all(axis=1))

    def begin(self, machines: int) -> SwingMemory:
        """Memory of a batch before its first sample."""
        return SwingMemory(
            self._plain(np.zeros(machines, dtype=np.intp), 0), np.zeros(machines, dtype=bool), 0, 0
        )

    def batch(self, q: Array, v: Array, memory: SwingMemory) -> tuple[Array, SwingMemory]:
        """Forces (b, nv) for a batch of machines q, v (b, n), one sample a period."""
        intent, caught, tick, again = memory
        if tick >= again:
            away, again = np.flatnonzero(~caught), tick + round(self.every / self.period)
            if len(away):
                intent = intent.of(np.arange(len(q)))
                intent.put(away, self.intend(q[away], v[away], tick, intent.of(away)))
        tau, caught, _ = self.force(q, v, intent, tick, caught)
        return tau, SwingMemory(intent, caught, tick + 1, again)

    # ---- the law on one machine

    def start(self) -> SwingMemory:
        """Nothing decided yet."""
        return self.begin(1)

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: SwingMemory
    ) -> tuple[Array, SwingMemory]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        tau, memory = self.batch(q[None], v[None], memory)
        return tau[0], memory
