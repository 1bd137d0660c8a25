"""Differential inverse kinematics, one tick at a time, within limits and clear of geoms.

    least  sum w |J d + r|^2 + damping |d|^2   over the step d = v dt
    with   joint ranges with room to brake, |v| <= v_max, |v - v_before| <= a_max dt,
           n^T J d >= -share (distance - clearance)  for every named pair of geoms (velocity damper,
           Faverjon & Tournassoud 1987), and with room to brake

A velocity v leaves room to brake before a limit at distance s when v^2 / 2a + v dt <= s; then the next tick
has a velocity that does, too, so that ranges, velocities and accelerations never contradict each other. With
the same law joints slow down before the configuration that meets the goals, relative to how that moves: a
goal that jumps is approached without overshoot. Where no such step serves, as at a stretched arm whose goal
lies inwards, the tick goes along a direction of negative curvature (`saddle.py`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ModelError
from .collision import Clearance, Gap
from .goals import Goal, Rows
from .numeric.qp import minimise
from .problem import Problem, freedom_names
from .saddle import ways_down
from .series import Series
from .solve import residuals
from .space import Space
from .verdict import Residual

Array = NDArray[np.float64]
_HARD = 1e6  # weight of hard goals and loops over wishes of weight 1
_LEAST = 1e-8  # damping; it grows where steps do not help, before goals that cannot be met
_CLOSE, _GAIN = 1e-20, 1e-6  # a cost, and a relative change of it, that need no further linearisation
_SHARE = 0.5  # of the distance to a geom that a tick may use up
_RELIED = 0.5  # of the acceleration with which joints can part a pair: its derivative turns
_BENT = 0.5  # of that more, where ways bend
_FAR = 1e3  # [m] up to which geoms are seen: a tick without limits of velocity may be long
_SLACK, _PENALTY = 1e4, 1e7  # curvature and slope: walls give way only when they contradict each other
_ITERATIONS = 4  # linearisations a tick
_CALM = 0.3  # of the greatest velocity, below which a configuration ahead counts as at rest
_STRIDE = 0.5  # [rad or m] of one of them in search of where to brake, and out of a saddle
_PUSHED, _EDGE = 1e-6, 1e-6  # share of a residual that a joint feels, and of its room, that count
_FLAT = 1e-4  # share of |J| |r| below which J'r counts as zero
_SHORTER = (1.0, 0.1, 0.01)  # of it, that are tried
_MOST = 1e6  # damping; that of a tick's first linearisation is at most 1


@dataclass(frozen=True)
class Tick:
    """State after one tick.

    Attributes:
        q (nq,), v (nv,): configuration and velocity over the tick.
        residuals: of every goal there.
        followed: all judged goals are within their tolerance.
        held: why it was not followed, empty when it was: names of joints that the goals push against a limit
            of range, velocity or acceleration (also one that makes them brake ahead), and pairs of geoms.
            Where there are none, `"no step nearer"`: small steps bring the goals no nearer, as out of reach
            or where goals contradict each other; or `"under way"`: the next tick gets nearer.
    """

    q: Array
    v: Array
    residuals: tuple[Residual, ...]
    followed: bool
    held: tuple[str, ...]


class _Point(NamedTuple):
    """A configuration (nq,): rows as the programme weighs them, distances of geoms, and what it costs."""

    q: Array
    r: Array
    J: Array
    gaps: list[Gap]
    cost: float


class _Least(NamedTuple):
    """Of a pair of geoms after a tick [m]: the distance aimed at, and that below which a step is refused."""

    aim: float
    bar: float


class Follower:
    """Follows goals that change from tick to tick, as in teleoperation.

    Args:
        model: constant.
        dt: of a tick [s].
        q0: start (nq,); default the model's qpos0.
        velocity, acceleration: limits (nv,) or one for all [rad/s or m/s, and per s]; None for no limit.
        joints: names of the joints that may move; default all that the goals depend on.
        apart: pairs of geoms that keep `clearance` [m]. Exactly, where accelerations have no limits; with
            limits joints brake ahead of a geom, but along it may use up a part where they slow each other.

    Raises ModelError for ticks or limits that are not positive, and names that do not exist.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        *,
        dt: float,
        q0: ArrayLike | None = None,
        velocity: ArrayLike | None = None,
        acceleration: ArrayLike | None = None,
        joints: Sequence[str] | None = None,
        apart: Sequence[tuple[str, str]] = (),
        clearance: float = 0.01,
    ):
        if not (np.isfinite(dt) and dt > 0):
            raise ModelError(f"a tick lasts a positive time, not {dt} s")
        self.model, self.dt = model, dt
        self.space = Space(model)
        self.series = Series(model, self.space, joints)
        self.q = self.space.check(model.qpos0 if q0 is None else q0)
        self.v: Array = np.zeros(model.nv)
        self._damping = _LEAST
        self._aim: Array | None = (
            None  # (nq,) configuration that meets the last goals, and its velocity (nv,)
        )
        self._aim_v: Array = np.zeros(model.nv)
        self._aim_damping = _LEAST * _HARD  # kept where no step of a tick helped
        self.v_max, self.a_max = (
            limit("velocity", velocity, model.nv),
            limit("acceleration", acceleration, model.nv),
        )
        self.clearance = clearance
        self.apart = Clearance(model, apart, reach=_FAR) if apart else None
        self.names = [f"{a} near {b}" for a, b in apart]

    def compile(self, goals: Sequence[Goal]) -> bool:
        """Prepare ticks with goals like these in machine code: ahead of a loop, for it takes a second unless
        it was done before. Without it, and where it returns False, NumPy does the same several times slower.
        """
        return self.series.compile(goals)

    def step(self, goals: Sequence[Goal]) -> Tick:
        """Move one tick towards `goals`."""
        problem = self.series.problem(goals)
        columns = np.flatnonzero(problem.moved)
        before, low, high = self.q, *self._box()
        low, high = self._braked(problem, low, high)
        allowed = self._allowed(problem.moved)
        d = np.clip(np.zeros(self.model.nv), low, high)
        here, walls = self._at(problem, self.space.step(before[None], d[None])[0], allowed), tuple[str, ...]()
        self._damping, began = min(self._damping, 1.0), here.cost
        for _ in range(_ITERATIONS):
            trial, near = self._programme(here, columns, d, low, high, allowed)
            there = self._at(problem, self.space.step(before[None], trial[None])[0], allowed)
            better = there.cost < here.cost
            self._damping = min(max(self._damping * (0.03 if better else 30.0), _LEAST), _MOST)
            walls = near if better or not walls else walls
            if better:
                gain, here, d = here.cost - there.cost, there, trial
                if here.cost < _CLOSE or gain < _GAIN * here.cost:
                    break
        met = bool(problem.met(problem.raw(here.q[None]).r)[0])
        if not met and began - here.cost <= _GAIN * here.cost:
            here, d = self._out_of_saddle(problem, here, d, low, high, allowed)
            met = bool(problem.met(problem.raw(here.q[None]).r)[0])
        self.q = here.q
        self.v = self.space.difference(self.q[None], before[None])[0] / self.dt
        held = tuple[str, ...]()
        if not met:
            held = (*self._pushed(here, d, low, high), *walls)
            still = began - here.cost <= _GAIN * here.cost
            held = held or (("no step nearer",) if still else ("under way",))
            if still:  # what lies ahead may be beyond a singular pose, where no step from here leads
                self._aim = None
        return Tick(frozen(self.q), frozen(self.v), residuals(problem, self.q), met, held)

    def _at(self, problem: Problem, q: Array, allowed: list[_Least]) -> _Point:
        """The goals' rows and the geoms' distances at q (nq,); walls that are passed cost most."""
        w = problem.weighted(problem.raw(q[None]))
        gaps = [] if self.apart is None else self.apart.gaps(q)
        passed = max((x.bar - gap.distance for gap, x in zip(gaps, allowed, strict=True)), default=0.0)
        r, J = w.r[0], w.J[0]
        cost = float(r @ (r * np.where(problem.judged, 1.0, 1.0 / _HARD))) + 1e3 * max(0.0, passed)
        weight = _weights(problem)
        return _Point(q, r * weight, J * weight[:, None], gaps, cost)

    def _out_of_saddle(
        self, problem: Problem, here: _Point, d: Array, low: Array, high: Array, allowed: list[_Least]
    ) -> tuple[_Point, Array]:
        """A point beside q + d that costs less, where there is one along negative curvature, and the step
        (nv,) to it; else `here` and `d`."""
        before, weight = self.q, _weights(problem)
        roomy = problem.moved & (low < d) & (d < high)
        walls = self._walls(here, np.arange(self.model.nv), allowed)[:2]
        for free in (problem.moved, roomy):
            for way in ways_down(problem, here.q, weight, free):
                most = _along(way, d, low, high, *walls)
                for share in _SHORTER:
                    trial = d + share * most * way
                    there = self._at(problem, self.space.step(before[None], trial[None])[0], allowed)
                    if there.cost < here.cost:
                        self._damping = _LEAST
                        return there, trial
        return here, d

    def _programme(
        self,
        here: _Point,
        columns: NDArray[np.intp],
        d: Array,
        low: Array,
        high: Array,
        allowed: list[_Least],
    ) -> tuple[Array, tuple[str, ...]]:
        """Step (nv,) better than `d`, by the quadratic programme at q + d, and pairs of geoms in its way."""
        J = here.J[:, columns]
        A, b, names = self._walls(here, columns, allowed)
        n, k = len(columns), len(b)
        H = np.zeros((n + k, n + k))
        damping = self._damping * _HARD
        H[:n, :n] = J.T @ J + damping * np.eye(n)
        H[n:, n:] = _SLACK * np.eye(k)
        g = np.concatenate([J.T @ here.r, np.full(k, _PENALTY)])
        eye = np.eye(n + k)
        rows = np.concatenate([eye[:n], -eye[:n], np.concatenate([A, -np.eye(k)], axis=1), -eye[n:]])
        room = np.concatenate([(high - d)[columns], (d - low)[columns], b, np.zeros(k)])
        bounded = np.isfinite(room)
        found = minimise(H, g, rows[bounded], room[bounded])
        out = d.copy()
        out[columns] = np.clip(d[columns] + found.x[:n], low[columns], high[columns])
        active = np.flatnonzero(bounded)[list(found.active)] - 2 * n
        return out, tuple(names[i] for i in active if 0 <= i < k)

    def _box(self) -> tuple[Array, Array]:
        """Least and greatest step (nv,) that ranges, velocities and accelerations allow."""
        x = np.zeros(self.space.nv)
        x[self.space.scalar_v] = self.q[self.space.scalar_q]
        return step_box(self.space.low - x, self.space.high - x, self.v, self.v_max, self.a_max, self.dt)

    def _braked(self, problem: Problem, low: Array, high: Array) -> tuple[Array, Array]:
        """Steps (nv,) between `low` and `high` after which joints can still stop where the goals are met."""
        if not np.isfinite(self.a_max[problem.moved]).any():
            return low, high
        away, moved, speed = self._seek(problem)
        a = np.where(problem.moved, self.a_max, np.inf)
        if not self._catches_up(moved, away - moved * self.dt, a):
            return low, high
        gap = away - speed * self.dt  # left when the goals' own motion is taken off
        most = self.dt * (speed + _braking(np.maximum(gap, 0.0), a, self.dt))
        least = self.dt * (speed - _braking(np.maximum(-gap, 0.0), a, self.dt))
        if self.apart is not None:  # the way around a geom leads away from the goal
            most, least = np.where(gap > 0, most, high), np.where(gap < 0, least, low)
        bounded = np.isfinite(a)
        return (
            np.where(bounded, np.clip(least, low, high), low),
            np.where(bounded, np.clip(most, low, high), high),
        )

    def _catches_up(self, moved: Array, gap: Array, a: Array) -> bool:
        """Whether slowing down serves: the configuration ahead can be followed, and rests or is near.

        Where it runs away, as past a singularity, joints that waited for it could not stand in for slow ones.
        """
        calm = np.abs(moved) <= _CALM * self.v_max
        near = 2 * np.where(np.isfinite(a), a, 0.0) * np.abs(gap) <= self.v_max**2  # way to brake in
        return bool((np.abs(moved) <= self.v_max).all() and (calm.all() or near.all()))

    def _seek(self, problem: Problem) -> tuple[Array, Array, Array]:
        """Way (nv,) from here to a configuration that meets the goals, how fast it moved since the last tick
        (nv,), and its velocity (nv,): zero where it has begun to move or jumped."""
        last = self._aim
        aim = self.q if last is None else np.where(self.space.coordinates(problem.moved), last, self.q)
        weight = _weights(problem)
        w, damping = problem.weighted(problem.raw(aim[None])), self._aim_damping
        for _ in range(_ITERATIONS):
            r, J = w.r[0] * weight, w.J[0] * weight[:, None]
            cost, slope = float(r @ r), J.T @ r
            if cost < _CLOSE * _HARD:
                break
            inside = self.space.free_directions(aim[None], slope[None])[0][0]
            free = np.flatnonzero(problem.moved & inside)
            d: Array = np.zeros(self.model.nv)
            d[free] = -np.linalg.solve(J[:, free].T @ J[:, free] + damping * np.eye(len(free)), slope[free])
            trial = self.space.step(aim[None], np.clip(d, -_STRIDE, _STRIDE)[None])[0]
            w_trial = problem.weighted(problem.raw(trial[None]))
            better = float(np.sum((w_trial.r[0] * weight) ** 2)) < cost
            damping = min(max(damping * (0.1 if better else 100.0), _LEAST * _HARD), 1e2 * _HARD)
            aim, w = (trial, w_trial) if better else (aim, w)
        if self._flat(aim, w, weight) and not problem.met(problem.raw(aim[None]).r)[0]:
            cost = float(np.sum((w.r[0] * weight) ** 2))
            aim, damping = self._aside(problem, aim, cost, damping)
        self._aim_damping = damping
        moved: Array = np.zeros(self.model.nv)
        if last is not None:
            moved = self.space.difference(aim[None], last[None])[0] / self.dt * problem.moved
        steady = np.abs(moved - self._aim_v) <= np.minimum(self.a_max, 1e6) * self.dt * (1 + 1e-9)
        self._aim, self._aim_v = aim, moved
        return self.space.difference(aim[None], self.q[None])[0], moved, np.where(steady, moved, 0.0)

    def _flat(self, q: Array, w: Rows, weight: Array) -> bool:
        """Whether no freedom changes the rows' cost at q (nq,) to first order, but against its limit."""
        r, J = w.r[0] * weight, w.J[0] * weight[:, None]
        slope = J.T @ r
        inside = self.space.free_directions(q[None], slope[None])[0][0]
        return bool(np.linalg.norm(slope[inside]) <= _FLAT * np.linalg.norm(J) * np.linalg.norm(r))

    def _aside(self, problem: Problem, aim: Array, cost: float, damping: float) -> tuple[Array, float]:
        """A configuration (nq,) that costs less than `aim` along negative curvature, or that, and damping."""
        weight = _weights(problem)
        for way in ways_down(problem, aim, weight, problem.moved):
            for share in _SHORTER:
                there = self.space.step(aim[None], share * _STRIDE * way[None])
                if float(np.sum((problem.weighted(problem.raw(there)).r[0] * weight) ** 2)) < cost:
                    return there[0], _LEAST * _HARD
        return aim, damping

    def _allowed(self, moved: NDArray[np.bool_]) -> list[_Least]:
        """Least distance of every pair of geoms after this tick: a damper that leaves room to brake."""
        out = []
        for gap in [] if self.apart is None else self.apart.gaps(self.q):
            spare, ours = gap.distance - self.clearance, moved & (gap.J != 0)
            closing = _SHARE * spare
            if spare > 0 and ours.any():
                a = np.array([_RELIED * (np.abs(gap.J[ours]) @ self.a_max[ours])])
                closing = min(closing, self.dt * float(_braking(np.array([spare]), a, self.dt)[0]))
            aim = gap.distance - closing
            out.append(_Least(aim, aim - _BENT * abs(closing)))
        return out

    def _walls(
        self, here: _Point, columns: NDArray[np.intp], allowed: list[_Least]
    ) -> tuple[Array, Array, list[str]]:
        """Rows A d <= b that keep geoms apart, for pairs near enough to matter."""
        near = [x for x in zip(here.gaps, allowed, self.names, strict=False) if np.any(x[0].J)]
        A = np.array([-gap.J[columns] for gap, _, _ in near]).reshape(len(near), len(columns))
        b = np.array([gap.distance - least.aim for gap, least, _ in near])
        return A, b, [name for _, _, name in near]

    def _pushed(self, here: _Point, d: Array, low: Array, high: Array) -> tuple[str, ...]:
        """Names of joints at an end of `low` to `high` (nv,) that would go further for the goals."""
        slope, J = here.J.T @ here.r, np.linalg.norm(here.J, axis=0)
        counts = np.abs(slope) > _PUSHED * J * np.linalg.norm(here.r)
        edge = _EDGE * np.minimum(high - low, 1.0)
        outward = np.where(slope < 0, d >= high - edge, d <= low + edge)
        return freedom_names(self.model, counts & outward)


def _weights(problem: Problem) -> Array:
    """Of a problem's rows (m,): what is judged comes before wishes."""
    return np.where(problem.judged, np.sqrt(_HARD), 1.0)


def _along(way: Array, d: Array, low: Array, high: Array, A: Array, b: Array) -> float:
    """How far [rad or m] a step `d` can be lengthened by x along a unit direction: between `low` and `high`,
    and with A x <= b."""
    towards = np.concatenate([way, -way, A @ way])
    room = np.concatenate([high - d, d - low, b])
    bound = towards > 1e-9
    return max(0.0, min(_STRIDE, float((room[bound] / towards[bound]).min(initial=np.inf))))


def limit(name: str, value: ArrayLike | None, nv: int) -> Array:
    """A limit for every freedom (nv,), infinite without one."""
    out = np.broadcast_to(np.asarray(np.inf if value is None else value, dtype=float), (nv,)).copy()
    if not (out > 0).all():
        raise ModelError(f"limits of {name} must be positive; this has {out.min()}")
    return out


def step_box(
    below: Array, above: Array, v: Array, v_max: Array, a_max: Array, dt: float
) -> tuple[Array, Array]:
    """Least and greatest step (nv,) with limits `below` <= 0 <= `above` away (see the module's text)."""

    def braking(room: Array) -> Array:
        return _braking(np.maximum(room, 0.0), a_max, dt)

    high = np.minimum(np.minimum(v_max, v + a_max * dt), braking(above))
    low = np.maximum(np.maximum(-v_max, v - a_max * dt), -braking(-below))
    empty = low > high  # only after a change from outside: then ranges come first
    middle = np.clip(
        0.5 * (np.where(empty, low, 0.0) + np.where(empty, high, 0.0)), -braking(-below), braking(above)
    )
    return np.where(empty, middle, low) * dt, np.where(empty, middle, high) * dt


def _braking(room: Array, a_max: Array, dt: float) -> Array:
    """Greatest velocities (nv,) that can be braked within `room` (nv,) from the next tick on."""
    bounded = np.isfinite(a_max) & np.isfinite(room)
    a, s = np.where(bounded, a_max, 1.0), np.where(bounded, room, 0.0)
    speed = a * (np.sqrt(dt * dt + 2 * s / a) - dt)
    return np.where(bounded, speed, room / dt)


def frozen(x: Array) -> Array:
    """A read-only copy."""
    out = x.copy()
    out.setflags(write=False)
    return out
