"""Goals that are followed while a run goes on: one tick of differential inverse kinematics a sample.

The joints that move for the goals go along a reference of their own, so that no drive's error comes back into
it; everything else is as the run has it, carried on by its velocity to the end of the tick.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from math import ceil

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ..clip import Clip
from ..control import Target
from ..engines.interface import Aims, Role
from ..ik import Follower
from ..ik.space import Space
from ..ik.spline import curve_clip
from .goals import Goals, together
from .mistakes import Mistake
from .motion import Curves
from .names import Names
from .schema import Scene

Array = NDArray[np.float64]
_TICK = 0.005  # [s] at most, of inverse kinematics


def settle_roles(
    scene: Scene, model: mujoco.MjModel, roles: NDArray[np.int8], live: tuple[int, ...], said: set[int]
) -> list[Mistake]:
    """Settle the roles of joints that follow live goals, where the scene has not `said` them."""
    joints = Names(model, "joint")
    named = said | {
        j for word in ("tracked", "keyed") for p in getattr(scene.roles, word) for j in joints.match(p)
    }
    beside = np.ones(model.njnt, dtype=bool)
    beside[list(live)] = False
    simulated = (roles[beside] != Role.KEYED).any() or scene.controller is not None
    simulated = simulated or any(roles[j] == Role.TRACKED for j in live)
    mistakes = []
    for j in live:
        if j not in named:
            roles[j] = Role.TRACKED if simulated else Role.KEYED
        elif roles[j] == Role.KEYED and simulated:
            name = name_of(model, "joint", j)
            message = f"joint {name!r} follows a live goal beside simulated joints: it must be tracked"
            mistakes.append(Mistake(("roles", "keyed"), message))
    return mistakes


def samples(period: float) -> int:
    """Periods [s] of a controller in a tick of inverse kinematics."""
    return max(1, int(_TICK / period + 1e-9))


class Live:
    """Targets of the joints that move for live goals, at every `period` [s] of a controller; the run starts
    at q0 (nq,) with velocity v0 (nv,).

    Ticks of inverse kinematics are whole periods of at most 5 ms. They give control points of a quadratic
    B-spline, so that the targets have no jump in velocity and keep the limits at every time; a point shapes
    the curve half a tick after it is known, and goals are asked for that much ahead.
    """

    def __init__(self, model: mujoco.MjModel, goals: Goals, q0: Array, v0: Array, period: float) -> None:
        self.goals, self.period = together(goals.live), period
        self.samples, self.count = samples(period), 0
        self.dt = self.samples * period
        self.dofs = np.isin(model.dof_jntid, goals.live_joints)
        self.space = Space(model, limits=False)
        self.mine = self.space.coordinates(self.dofs)
        names = [name_of(model, "joint", j) for j in goals.live_joints]
        self.v = np.where(self.dofs, v0, 0.0)  # at the end of the tick
        start = self.space.step(q0[None], 0.5 * self.dt * self.v[None])[0]
        self.follower = Follower(
            model,
            dt=self.dt,
            q0=start,
            velocity=goals.velocity,
            acceleration=goals.acceleration,
            joints=names,
            apart=goals.apart,
            clearance=goals.clearance,
        )
        self.follower.v = self.v
        self.follower.compile(self.goals(0.0))
        self.seen: tuple[float, Array] | None = None  # time and velocity of the run at the last tick
        self.tick = Target(q0, self.v, np.zeros(model.nv))  # the curve where the present tick began

    def at(self, t: float, q: Array, v: Array, target: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        """See :class:`~pantograph.sim.engines.interface.Aims`."""
        since = self.count % self.samples * self.period
        if since == 0.0:
            self._advance(t, q, v)
        self.count += 1
        begin = self.tick
        here = self.space.step(begin.q[None], (since * begin.v + 0.5 * since**2 * begin.a)[None])[0]
        return (
            np.where(self.mine, here, target[0]),
            np.where(self.dofs, begin.v + since * begin.a, target[1]),
            np.where(self.dofs, begin.a, target[2]),
        )

    def _advance(self, t: float, q: Array, v: Array) -> None:
        """The next control point, from the state q (nq,), v (nv,) of the run at t [s]."""
        follower, ahead = self.follower, 1.5 * self.dt
        a = np.zeros_like(v) if self.seen is None else (v - self.seen[1]) / (t - self.seen[0])
        carried = self.space.step(q[None], (ahead * v + 0.5 * ahead**2 * a)[None])[0]
        here, before = follower.q, self.v
        follower.q = np.where(self.mine, here, carried)
        self.v = np.where(self.dofs, follower.step(self.goals(t + ahead)).v, 0.0)
        follower.v, self.seen = self.v, (t, v.copy())
        begin = self.space.step(here[None], -0.5 * self.dt * before[None])[0]
        self.tick = Target(begin, before, (self.v - before) / self.dt)


def chaser(model: mujoco.MjModel, goals: Goals, q0: Array, v0: Array) -> Callable[[float], Aims]:
    """Makes the targets of a run that starts at q0 (nq,), v0 (nv,), for a controller's period [s]."""
    return partial(Live, model, goals, q0, v0)


def streamed(
    model: mujoco.MjModel, goals: Goals, found: Curves, q0: Array, duration: float, rate: float
) -> Clip:
    """Motion of the live joints where everything else has keys: each tick knows only what came before."""
    ticks = max(2, ceil(duration * max(rate, 1.0 / _TICK)))
    dt = duration / ticks
    t: Array = dt * np.arange(ticks + 1, dtype=np.float64)
    around = Clip(model, {name_of(model, "joint", j): track for j, track in found.tracks.items()}, q0)
    motion = around.evaluate(t)
    live = Live(model, goals, motion.q[0], np.zeros(model.nv), dt)
    targets = [
        live.at(float(x), *(row := (motion.q[k], motion.v[k])), (*row, motion.a[k])) for k, x in enumerate(t)
    ]
    q, v = (np.array(rows) for rows in list(zip(*targets, strict=True))[:2])
    return curve_clip(model, t, q, v, goals.live_joints)
