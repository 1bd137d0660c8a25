"""Play between motor and joint: while a rotor crosses the gap of its gear nothing arrives at the joint.

The rotor moves freely under its motor's torque until it meets the other flank, which stops it relative to
the joint without a bounce; the joint gets its momentum, and the torque as long as it presses on (M. Nordin,
P.-O. Gutman, Automatica 38, 2002, rigid and inelastic). Within a sample the torque is held and the joint goes
on at its speed; the forces returned are means over a sample, which keeps every impulse.
"""

from __future__ import annotations

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import name_of
from ..sim.errors import PantographError

Array = NDArray[np.float64]


class Rotors(NamedTuple):
    """Positions (nv,) [rad, m] and speeds (nv,) of the rotors, in units of their joints."""

    q: Array
    v: Array


class Play:
    """Gears of play ``width`` (nv,) [rad, m] and rotors of the inertia that ``model`` gives as armature.

    A joint's inertia counts its rotor also while that crosses. Raises PantographError for play of a joint
    without armature: a rotor without inertia would cross in no time.
    """

    def __init__(self, model: mujoco.MjModel, width: Array, period: float) -> None:
        self.half, self.inertia, self.period = 0.5 * width, model.dof_armature.copy(), period
        self.dofs = np.flatnonzero(width > 0.0)
        for dof in self.dofs[self.inertia[self.dofs] <= 0.0]:
            joint = name_of(model, "joint", int(model.dof_jntid[dof]))
            raise PantographError(
                f"play of joint {joint!r} needs the inertia of its rotor: give the joint an armature"
            )

    def start(self, q: Array, v: Array) -> Rotors:
        """Rotors in the middle of their gaps, moving with joints at q, v (nv,)."""
        return Rotors(q.copy(), v.copy())

    def pass_on(self, tau: Array, q: Array, v: Array, rotors: Rotors) -> tuple[Array, Rotors]:
        """What arrives (nv,) of motor forces ``tau`` (nv,) over the next sample, and the rotors after it."""
        given, at, speed = tau.copy(), rotors.q.copy(), rotors.v.copy()
        for i in self.dofs:
            gap = float(np.clip(at[i] - q[i], -self.half[i], self.half[i]))
            arrived, gap, rate = self._cross(i, float(tau[i]), gap, float(speed[i] - v[i]))
            given[i], at[i], speed[i] = arrived, q[i] + self.period * v[i] + gap, v[i] + rate
        return given, Rotors(at, speed)

    def _cross(self, i: np.intp, tau: float, gap: float, rate: float) -> tuple[float, float, float]:
        """Mean force on joint ``i`` over a sample, and the rotor's place in the gap and its rate after it."""
        half, inertia, left, impulse = float(self.half[i]), float(self.inertia[i]), self.period, 0.0
        pull = tau / inertia
        while left > 0.0:
            until, side = _meets(gap, rate, pull, half)
            if until >= left:
                return impulse / self.period, gap + left * (rate + 0.5 * left * pull), rate + left * pull
            left -= until
            impulse += inertia * (rate + until * pull)
            gap, rate = side * half, 0.0
            if side * pull >= 0.0:  # it leans on the flank from now on
                return (impulse + left * tau) / self.period, gap, rate
        return impulse / self.period, gap, rate


def _meets(gap: float, rate: float, pull: float, half: float) -> tuple[float, float]:
    """When gap + rate t + pull t^2 / 2 first reaches ``half`` or its negative, and the sign of that flank;
    infinite when it does not."""
    when = {side: _reached(half - side * gap, side * rate, side * pull) for side in (1.0, -1.0)}
    side = min(when, key=lambda s: when[s])
    return when[side], side


def _reached(way: float, rate: float, pull: float) -> float:
    """First time t >= 0 at which rate t + pull t^2 / 2 = ``way`` >= 0, coming from below."""
    if way <= 0.0:
        if rate > 0.0 or (rate == 0.0 and pull >= 0.0):
            return 0.0
        return -2.0 * rate / pull if pull > 0.0 else np.inf
    root = rate * rate + 2.0 * pull * way
    sum_ = rate + np.sqrt(root) if root >= 0.0 else 0.0
    return float(2.0 * way / sum_) if sum_ > 0.0 else np.inf
