"""Everything that a scene prescribes over time, as arrays at the times where an engine needs it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ..clip import Clip
from .interface import Array, Problem, Role


@dataclass(frozen=True)
class TimedInputs:
    """Prescribed inputs at n times.

    Keyed joints: q (n, nqk), v (n, k), a (n, k); servo ctrl (n, s); wrenches on bodies (n, w, 6), force
    before torque.
    """

    q: Array
    v: Array
    a: Array
    ctrl: Array
    wrench: Array


class Timed:
    """Evaluates the prescribed inputs of a problem."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.keyed = np.flatnonzero(problem.dofs(Role.KEYED))
        self.qpos = np.flatnonzero(keyed_qpos(problem))
        joints = {
            name_of(problem.model, "joint", int(j)) for j in np.flatnonzero(problem.roles == Role.KEYED)
        }
        clip = problem.clip
        self.clip = Clip(clip.model, {n: t for n, t in clip.tracks.items() if n in joints}, clip.q0)
        self.servos = np.array(sorted(problem.servo), dtype=int)
        self.bodies = np.array([w.body for w in problem.wrenches], dtype=int)
        self.body_frame = np.array([w.in_body_frame for w in problem.wrenches], dtype=bool)

    @property
    def empty(self) -> bool:
        """Whether nothing depends on time, so that steps need no Python between them."""
        return not (len(self.keyed) or len(self.servos) or len(self.bodies))

    def jumps(self, t0: float, step: float, steps: int) -> dict[int, Array]:
        """Jumps (k,) of keyed velocities, as at the keys of linear curves, by the step that begins with them.

        A jump within a step acts at the next one's start.
        """
        found: dict[int, Array] = {}
        times = self.clip.breaks_between(t0, t0 + steps * step)
        if not len(times) or not len(self.keyed):
            return found
        before, after = self.at(times, left=True), self.at(times)
        for time, jump, speed in zip(times, after.v - before.v, np.abs(after.v), strict=True):
            if np.any(np.abs(jump) > 1e-9 * (1.0 + speed)):
                k = int(np.ceil((time - t0) / step - 1e-6))
                found[k] = found.get(k, 0.0) + jump
        return found

    def breaks(self, t0: float, t1: float) -> Array:
        """Times strictly between ``t0`` and ``t1`` where a keyed motion or a wrench is known to bend."""
        found = [self.clip.breaks_between(t0, t1)]
        for w in self.problem.wrenches:
            found += [curve.breaks_between(t0, t1) for curve in (w.force, w.torque) if curve is not None]
            found.append(np.array([t for t in (w.start, w.stop) if t0 < t < t1]))
        return np.unique(np.concatenate(found))

    def knots(self, t0: float, t1: float) -> Array:
        """Times strictly between ``t0`` and ``t1`` where pieces of a keyed motion or a wrench end."""
        found = [self.clip.knots_between(t0, t1)]
        for w in self.problem.wrenches:
            found += [curve.knots_between(t0, t1) for curve in (w.force, w.torque) if curve is not None]
        return np.unique(np.concatenate(found))

    def at(self, t: NDArray[np.floating], *, left: bool = False) -> TimedInputs:
        """Inputs at times ``t`` (n,) [s]; where keys bend, from the right, or from the ``left``."""
        times: Array = np.asarray(t, dtype=np.float64)
        n, k = len(times), len(self.keyed)
        q, v, a = np.zeros((n, len(self.qpos))), np.zeros((n, k)), np.zeros((n, k))
        if k:
            motion = self.clip.evaluate(times, left=left)
            q, v, a = motion.q[:, self.qpos], motion.v[:, self.keyed], motion.a[:, self.keyed]
        ctrl = np.zeros((n, len(self.servos)))
        for i, actuator in enumerate(self.servos):
            # the limit from the left, up to what a servo's command changes in the shortest time that counts
            early = 1e-13 * np.maximum(1.0, np.abs(times)) if left else 0.0
            ctrl[:, i] = self.problem.servo[int(actuator)](times - early)
        wrench = np.zeros((n, len(self.bodies), 6))
        for i, w in enumerate(self.problem.wrenches):
            begun, ended = (times > w.start, times > w.stop) if left else (times >= w.start, times >= w.stop)
            for curve, part in ((w.force, slice(0, 3)), (w.torque, slice(3, 6))):
                if curve is not None:
                    wrench[:, i, part] = np.where((begun & ~ended)[:, None], curve(times, left=left).q, 0.0)
        return TimedInputs(q, v, a, ctrl, wrench)


def keyed_qpos(problem: Problem) -> NDArray[np.bool_]:
    """Mask (nq,) of the coordinates of keyed joints."""
    m = problem.model
    mask = np.zeros(m.nq, dtype=bool)
    width = {0: 7, 1: 4, 2: 1, 3: 1}
    for joint in np.flatnonzero(problem.roles == Role.KEYED):
        start = m.jnt_qposadr[joint]
        mask[start : start + width[int(m.jnt_type[joint])]] = True
    return mask
