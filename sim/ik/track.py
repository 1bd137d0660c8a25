"""Inverse kinematics along time: a joint motion that follows goals over a whole clip.

The smoothest motion near the goals is found at once for all instants t_k (sequential quadratic programming):

    least  sum |r_k / tolerance|^2 + sum |(q_k+1 - 2 q_k + q_k-1) / (dt^2 a)|^2
    with   joint ranges, |q_k+1 - q_k| <= v_max dt, |q_k+1 - 2 q_k + q_k-1| <= a_max dt^2

whose matrices are banded, so that the cost grows linearly with the number of instants. With limits of
velocity or acceleration the q_k are control points of a quadratic B-spline, which keeps them at every time
(`spline.py`), and r_k is taken on it; without, the motion is a natural cubic spline through them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..clip import Clip
from ..errors import ModelError
from .goals import Goal
from .numeric.band import Limits, smoothest_step
from .pose import Kinematics
from .problem import Problem, freedom_names
from .solve import residuals, solve
from .space import Space
from .spline import on_curve, smooth_clip, spline_clip
from .stream import Follower, frozen, limit
from .verdict import Residual, Verdict
from .wholes import Posture

Array = NDArray[np.float64]
Goals = Callable[[float], Sequence[Goal]] | Sequence[Sequence[Goal]]
_TRACKING = 1e-4  # [m or rad] of deviation that costs as much as the reference acceleration
_REFERENCE = 10.0  # [rad/s^2] where no acceleration limit gives a scale
_WISHED = 1e-2  # weight of wishes beside hard goals
_RESTED = 1.0  # weight of rest beside goals in the first guess, tick by tick
_RESTING = 0.3  # [1/rad or 1/m] of what goals leave open: a ten-thousandth of a goal's weight and less
_STARTS, _CLEARLY = 6, 0.5  # seen from the nearest; share of its cost with which another start is taken
_ROUNDING = 1e-9  # of a limit
_WALL = 100.0  # weight of the limit of a ball joint beside that of goals
_SETTLED = 15  # programmes from a motion that is nearly right
_LAST, _SMALL = 4, 1e-3  # steps that may still meet goals exactly, and their greatest length [rad or m]
_USED = 0.9  # of a limit, from which it counts as used up
_JUMP = 0.2  # [rad or m] from a motion, from which a configuration counts as elsewhere
_TIGHTER = 4  # times that limits are drawn in until rotations keep them

Stopped = Literal["goals", "velocity", "acceleration", "jump", "smoothness"]


@dataclass(frozen=True)
class Missed:
    """A stretch of time in which goals were not followed, with the worst instant and why.

    Attributes:
        start, end, worst: times [s].
        position, rotation: deviation at the worst [m], [rad].
        stopped: by what: "goals" that cannot be met there, as `verdict` tells; limits of "velocity" or
            "acceleration" that are used up; a "jump", where the nearest configuration that meets them is too
            far from the motion to be reached between two instants; else "smoothness", which weighs more
            than what is left.
        verdict: of the worst instant by itself; None where the goals can be met there.
    """

    start: float
    end: float
    worst: float
    position: float
    rotation: float
    stopped: Stopped
    verdict: Verdict | None


@dataclass(frozen=True)
class Motion:
    """Joint motion along goals.

    Attributes:
        t (k,), q (k, nq), v (k, nv), a (k, nv): instants, configurations, velocities and accelerations (with
            limits those of the curves, otherwise central differences).
        position, rotation (k,): deviation from the judged goals [m], [rad].
        missed: stretches where they are not within tolerance, and what stopped it there.
        speed, effort: largest |velocity| and |acceleration| of the curves, at any time, over their limits; 0
            without limits.
    """

    model: mujoco.MjModel
    t: Array
    q: Array
    v: Array
    a: Array
    position: Array
    rotation: Array
    missed: tuple[Missed, ...]
    speed: float
    effort: float
    curves: Clip = field(repr=False)

    @property
    def followed(self) -> bool:
        """Whether the goals were within tolerance at every instant."""
        return not self.missed

    def clip(self) -> Clip:
        """The motion as curves, of all joints that move: through q at all instants, and within the limits of
        velocity and acceleration at every time between them."""
        return self.curves


def follow(
    model: mujoco.MjModel,
    goals: Goals,
    times: ArrayLike,
    *,
    q0: ArrayLike | None = None,
    joints: Sequence[str] | None = None,
    velocity: ArrayLike | None = None,
    acceleration: ArrayLike | None = None,
    start: ArrayLike | None = None,
    around: ArrayLike | None = None,
    iterations: int = 30,
) -> Motion:
    """Motion of `model` along goals at evenly spaced `times` (k,), smooth over the whole clip.

    `goals`: a function of time [s] that gives them, or one list of goals an instant, as from a capture.
    `velocity`, `acceleration`: limits (nv,) or one for all. `start` (nq,): the motion begins exactly there;
    by default at the one of the first goals' solutions, seen from `q0`, that can be continued best.
    `around` (k, nq): motion of the joints that do not move for the goals; default they stay as `q0`. What
    the goals leave open stays near `around`, `q0` or `start`, and smooth. Unlike
    `Follower` it cannot keep geoms apart.
    Raises ModelError for times that are not evenly spaced or goals that do not fit them.
    """
    t = np.asarray(times, dtype=float)
    evenly(t)
    if around is not None and q0 is None:
        q0 = np.asarray(around, dtype=float)[0]
    v_max, a_max = limit("velocity", velocity, model.nv), limit("acceleration", acceleration, model.nv)
    bounded = bool(np.isfinite([v_max, a_max]).any())
    rest = next((x for x in (around, q0, start) if x is not None), model.qpos0)
    line = _Line(model, goals, t, joints, around, rest, bounded=bounded)
    q = _first_guess(line, q0, start, v_max, a_max)
    limits = Limits(line.space, float(t[1] - t[0]), v_max, a_max, start is not None)
    q = _smoothed(line, q, limits, iterations)
    if max(_ratios(line.clip(q), line.t, line.moved, limits)) > 1.0 + _ROUNDING:
        q = _within(line, q, limits)
    elif not line.bounded:
        q = _tightened(line, q)
    return _motion(line, q, limits)


def evenly(t: Array) -> None:
    """ModelError when times t (k,) are not at least three, increasing by even steps (to a thousandth)."""
    if t.ndim != 1 or len(t) < 3 or t[1] <= t[0] or not np.allclose(np.diff(t), t[1] - t[0], rtol=1e-3):
        raise ModelError("a track needs at least three evenly spaced, increasing times")


def near_path(
    model: mujoco.MjModel, goals: Sequence[Sequence[Goal]], t: Array, q: Array, joints: Sequence[str]
) -> Array:
    """Smooth motion (k, nq) along goals, one list an instant t (k,), found from a motion q (k, nq); joints
    that are not named stay as in it."""
    evenly(t)
    line = _Line(model, goals, t, joints, q, q, bounded=False)
    free = np.full(model.nv, np.inf)
    limits = Limits(line.space, float(t[1] - t[0]), free, free, False)
    return _smoothed(line, line.space.clip(q), limits, _SETTLED)


class _Line:
    """Problems of all instants, over one model."""

    def __init__(
        self,
        model: mujoco.MjModel,
        goals: Goals,
        t: Array,
        joints: Sequence[str] | None,
        around: ArrayLike | None,
        rest: ArrayLike,
        *,
        bounded: bool,
    ):
        self.model, self.t, self.space, self.joints = model, t, Space(model), joints
        self.bounded = bounded
        kinematics = Kinematics(model)
        rows = [goals(float(x)) for x in t] if callable(goals) else goals
        if len(rows) != len(t):
            raise ModelError(f"{len(rows)} lists of goals for {len(t)} instants; give one an instant")
        self.problems = [
            Problem(model, row, self.space, joints=joints, kinematics=kinematics) for row in rows
        ]
        self.moved = np.any([p.moved for p in self.problems], axis=0)
        self.around = None if around is None else np.asarray(around, dtype=float)
        if self.around is not None and self.around.shape != (len(t), model.nq):
            raise ModelError(f"the motion around has shape {self.around.shape}, not ({len(t)}, {model.nq})")
        self.rest = np.broadcast_to(np.asarray(rest, dtype=float), (len(t), model.nq))
        self._ours = self.space.coordinates(self.moved)

    def placed(self, k: int, q: Array) -> Array:
        """q (nq,) with the joints that do not move for the goals as they are at instant k."""
        return q if self.around is None else np.where(self._ours, q, self.around[k])

    def on_curve(self, q: Array) -> Array:
        """Where the motion of control points q (k, nq) is at the instants."""
        return np.where(self._ours, on_curve(self.space, q), q) if self.bounded else q

    def clip(self, q: Array) -> Clip:
        """The motion of control points q (k, nq) as curves."""
        moving = self.moved | (np.ptp(self.space.difference(q, q[:1]), axis=0) > 1e-12)
        joints = sorted({int(j) for j in self.model.dof_jntid[moving]})
        make = spline_clip if self.bounded else smooth_clip
        return make(self.model, self.t, q, joints)

    def rows(self, q: Array) -> list[tuple[Array, Array]]:
        """Weighted residuals of every instant and their Jacobians, as if each depended on its own control
        point alone (three quarters of it do); judged rows count most, the way from rest least."""
        on, out = self.on_curve(q), []
        away = _RESTING * self.space.difference(on, self.rest)[:, self.moved]
        back = _RESTING * np.eye(self.space.nv)[self.moved]
        for problem, x, d in zip(self.problems, on, away, strict=True):
            w = problem.weighted(problem.raw(x[None]))
            weight = np.where(problem.judged, 1.0, _WISHED) / _TRACKING
            r, J = w.r[0] * weight, w.J[0] * weight[:, None]
            out.append((np.concatenate([r, d]), np.concatenate([J, back])))
        return out


def _walled(space: Space, q: Array, rows: list[tuple[Array, Array]]) -> list[tuple[Array, Array]]:
    """`rows` with one more where goals push a ball joint out of its limit: it may only move along that."""
    out = []
    for x, (r, J) in zip(q, rows, strict=True):
        walls = []
        for ball, axis in space.free_directions(x[None], (J.T @ r)[None])[1]:
            if axis[0].any():
                wall = np.zeros((1, J.shape[1]))
                wall[0, ball.v : ball.v + 3] = _WALL / _TRACKING * axis[0]
                walls.append(wall)
        out.append((np.concatenate([r, np.zeros(len(walls))]), np.concatenate([J, *walls])))
    return out


def _first_guess(
    line: _Line, q0: ArrayLike | None, start: ArrayLike | None, v_max: Array, a_max: Array
) -> Array:
    """The nearest start, or one that differential inverse kinematics follows much better, and its motion
    (k, nq)."""
    model = line.model
    first = line.problems[0]
    if start is not None:
        starts = line.space.check(start)[None]
    else:
        found = solve(model, first.goals, q0=q0, joints=line.joints, all=True, restarts=40)
        starts = found.solutions[:_STARTS] if found.solved else found.q[None]
    best: tuple[float, Array] | None = None
    for q in starts:
        path, cost = _streamed(line, q, v_max)
        if best is None or cost < _CLEARLY * best[0]:
            best = cost, path
    assert best is not None
    return best[1]


def _streamed(line: _Line, q: Array, v_max: Array) -> tuple[Array, float]:
    """Motion (k, nq) by one tick after the other, and its sum of squared deviations and accelerations."""
    dt = float(line.t[1] - line.t[0])
    names = freedom_names(line.model, line.moved)
    follower = Follower(line.model, dt=dt, q0=q, velocity=v_max, joints=names)
    out, cost = [q], 0.0
    for k, problem in enumerate(line.problems[1:], start=1):
        follower.q = line.placed(k, follower.q)
        tick = follower.step([*problem.goals, Posture(line.rest[k], weight=_RESTED)])
        w = problem.weighted(problem.raw(tick.q[None]))
        cost += float(np.sum(w.r**2)) / _TRACKING**2
        out.append(tick.q)
    path = np.array(out)
    v = line.space.difference(path[1:], path[:-1]) / dt
    return path, cost + float(np.sum(np.diff(v, axis=0) ** 2)) / (dt * _REFERENCE) ** 2


def _smoothed(line: _Line, q: Array, limits: Limits, iterations: int) -> Array:
    """Sequential quadratic programming from q (k, nq): each step is cut until the cost falls."""
    reach = 0.5
    rows = line.rows(q)
    cost = limits.cost(q, rows)
    for _ in range(iterations):
        walled = _walled(line.space, q, rows)
        step = smoothest_step(line.space, q, walled, limits, line.moved, reach)
        trial = line.space.step(q, step)
        rows_trial = line.rows(trial)
        lower = limits.cost(trial, rows_trial)
        if lower >= cost and limits.broken(q) <= limits.broken(trial) + 1e-9:
            reach *= 0.25
            if reach < 1e-6:
                break
            continue
        gain, moved = cost - lower, float(np.abs(step).max())
        q, rows, cost, reach = trial, rows_trial, lower, min(2 * reach, 1.0)
        if moved < 1e-7 or (0 <= gain < 1e-9 * cost):
            break
    return q


def _tightened(line: _Line, q: Array) -> Array:
    """q (k, nq) with the last digits of hard goals, which wishes and smoothness bend a little, where a small
    change of a configuration brings them."""
    out = q.copy()
    for k, problem in enumerate(line.problems):
        x = q[k : k + 1]
        for _ in range(_LAST):
            rows = problem.raw(x)
            w = problem.weighted(rows)
            if problem.met(rows.r)[0]:
                out[k] = x[0]
                break
            r, J = w.r[0][problem.judged], w.J[0][problem.judged]
            free = line.space.free_directions(x, (J.T @ r)[None])[0][0]  # not against a limit
            d = np.linalg.lstsq(J * free, -r, rcond=1e-6)[0]
            if np.abs(d).max(initial=0.0) > _SMALL:
                break
            x = line.space.step(x, d[None])
    return out


def _within(line: _Line, q: Array, limits: Limits) -> Array:
    """A motion near q (k, nq) that keeps the limits, also where rotations turn so fast that neither the
    programmes, which see them straight, nor the hull of control points holds them."""
    v_max, a_max = limits.v_max, limits.a_max
    for _ in range(_TIGHTER):
        c = _chased(line, q, limits.dt, v_max, a_max)
        speed, effort = _ratios(line.clip(c), line.t, line.moved, limits)
        if max(speed, effort) <= 1.0:
            break
        v_max, a_max = (x / max(1.0, 1.001 * over) for x, over in ((v_max, speed), (a_max, effort)))
    return c


def _chased(line: _Line, q: Array, dt: float, v_max: Array, a_max: Array) -> Array:
    """A motion after q (k, nq), tick by tick."""
    follower = Follower(line.model, dt=dt, q0=q[0], velocity=v_max, acceleration=a_max, joints=line.joints)
    first = line.space.difference(q[1:2], q[:1])[0] / dt
    follower.v = np.clip(first, -v_max, v_max) * line.moved
    out = [q[0]]
    for k in range(1, len(q)):
        follower.q = line.placed(k, follower.q)
        out.append(follower.step([Posture(q[k])]).q)
    return np.array(out)


def _motion(line: _Line, c: Array, limits: Limits) -> Motion:
    """The motion of control points c (k, nq) and what it leaves of the goals."""
    space, dt = line.space, limits.dt
    steps = space.difference(c[1:], c[:-1]) / dt
    v = np.concatenate([steps[:1], 0.5 * (steps[1:] + steps[:-1]), steps[-1:]])
    inner = np.diff(steps, axis=0) / dt
    a = np.concatenate([inner[:1], inner, inner[-1:]])
    q = line.on_curve(c)
    reports = [residuals(p, x) for p, x in zip(line.problems, q, strict=True)]
    judged = [_judged(p, report) for p, report in zip(line.problems, reports, strict=True)]
    position = np.array([max((r.position for r in rs), default=0.0) for rs in judged])
    rotation = np.array([max((r.rotation for r in rs), default=0.0) for rs in judged])
    off = np.array([not all(r.met for r in rs) for rs in judged])
    clip = line.clip(c)
    missed = _stretches(line, q, off, position, rotation, limits, clip)
    t, q, v, a, position, rotation = (frozen(x) for x in (line.t, q, v, a, position, rotation))
    speed, effort = _ratios(clip, line.t, line.moved, limits)
    return Motion(line.model, t, q, v, a, position, rotation, missed, speed, effort, clip)


def _ratios(clip: Clip, t: Array, moved: NDArray[np.bool_], limits: Limits) -> tuple[float, float]:
    """Largest velocity and acceleration of the curves over their limits, ten times as finely as at t."""
    if not np.isfinite([limits.v_max, limits.a_max]).any():
        return 0.0, 0.0
    fine = np.linspace(t[0], t[-1], 10 * (len(t) - 1) + 1)
    sides = [clip.evaluate(fine, left=left) for left in (False, True)]
    speeds = [limits.ratio(motion.v * moved, limits.v_max) for motion in sides]
    return max(speeds), max(limits.ratio(motion.a * moved, limits.a_max) for motion in sides)


def _judged(problem: Problem, report: tuple[Residual, ...]) -> list[Residual]:
    return [r for r, group in zip(report, problem.groups, strict=True) if problem.judged[group.rows].any()]


def _stretches(
    line: _Line,
    q: Array,
    off: NDArray[np.bool_],
    position: Array,
    rotation: Array,
    limits: Limits,
    clip: Clip,
) -> tuple[Missed, ...]:
    out = []
    edges = np.flatnonzero(np.diff(np.concatenate([[False], off, [False]]).astype(int)))
    for i, j in edges.reshape(-1, 2):
        k = int(i + np.argmax(position[i:j] + rotation[i:j]))
        once = solve(line.model, line.problems[k].goals, q0=q[k], joints=line.joints, restarts=60)
        t, far = line.t, (float(position[k]), float(rotation[k]))
        stopped: Stopped = "goals"
        if once.solved:
            around = t[max(i - 2, 0) : j + 2]
            way = np.abs(line.space.difference(once.q[None], q[k : k + 1])).max()
            stopped = _used_up(line, clip, around, limits) or ("jump" if way > _JUMP else "smoothness")
        verdict = None if once.solved else once.verdict
        out.append(Missed(float(t[i]), float(t[j - 1]), float(t[k]), *far, stopped, verdict))
    return tuple(out)


def _used_up(line: _Line, clip: Clip, t: Array, limits: Limits) -> Literal["velocity", "acceleration"] | None:
    """Which limit of the motion is used up somewhere around times t (n,), most of all; None where neither."""
    speed, effort = _ratios(clip, t, line.moved, limits)
    if max(speed, effort) < _USED:
        return None
    return "velocity" if speed >= effort else "acceleration"
