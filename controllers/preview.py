"""Where the keys will be: targets of a clip on the grid of a controller, evaluated once for all samples."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..models import joint_names
from ..sim.clip import Clip
from ..sim.control import Target
from ..sim.errors import PantographError, unknown
from ..sim.kinds import SCALAR
from .gains import number
from .nominal import moved

Array = NDArray[np.float64]


class Preview:
    """Targets of ``clip`` at times (k + ``offset``) ``period`` [s], k = 0, 1, ... up to ``duration`` [s]."""

    def __init__(self, clip: Clip, period: float, duration: float, *, offset: float = 0.5) -> None:
        self.clip, self.period, self.duration, self.offset = clip, period, duration, offset

    @cached_property
    def times(self) -> Array:
        """All times of the grid [s]."""
        ticks = max(1, int(np.ceil(self.duration / self.period - 1e-9)))
        return np.asarray((np.arange(ticks) + self.offset) * self.period, dtype=np.float64)

    @cached_property
    def targets(self) -> Target:
        """Targets at all times: q (ticks, nq), v and a (ticks, nv)."""
        return Target(*self.clip.evaluate(self.times))

    def at(self, t: float, now: Target) -> Target:
        """The target ``offset`` periods after ``t`` [s], where it is ``now``: freedoms without keys, as
        those of live goals, go on with their acceleration."""
        ahead, clip, s = self._keyed(t), self.clip, self.offset * self.period
        if not len(self._loose):
            return ahead
        if not (now.v[self._loose].any() or now.a[self._loose].any()):
            return Target(np.where(clip.qpos_mask, ahead.q, now.q), ahead.v, ahead.a)
        q = moved(clip.model, now.q, s * now.v + 0.5 * s**2 * now.a)
        return Target(
            np.where(clip.qpos_mask, ahead.q, q),
            np.where(clip.dofs, ahead.v, now.v + s * now.a),
            np.where(clip.dofs, ahead.a, now.a),
        )

    def ahead(self, first: int, count: int) -> Target:
        """The keys ``offset`` periods after ``count`` ticks from ``first`` on, those after the last as it."""
        ticks = np.minimum(np.arange(first, first + count), len(self.times) - 1)
        return Target(*(x[ticks] for x in self.targets))

    @cached_property
    def _loose(self) -> NDArray[np.intp]:
        """Freedoms without keys."""
        return np.flatnonzero(~self.clip.dofs)

    def known(self, now: Target) -> bool:
        """Whether the target ``now`` is the clip's own also where it has no keys."""
        if not len(self._loose):
            return True
        rest = now.v[self._loose].any() or now.a[self._loose].any()
        loose_q = ~self.clip.qpos_mask
        return not rest and bool((now.q[loose_q] == self.clip.q0[loose_q]).all())

    def _keyed(self, t: float) -> Target:
        """The keys ``offset`` periods after ``t``: from the grid where ``t`` is a tick of it."""
        tick = t / self.period
        k = round(tick)
        if abs(tick - k) > 1e-6 or not 0 <= k < len(self.times):
            return Target(*self.clip.evaluate(t + self.offset * self.period))
        q, v, a = self.targets
        return Target(q[k], v[k], a[k])


def aimed(clip: Clip, goal: Mapping[str, float], what: str) -> tuple[Clip, NDArray[np.bool_]]:
    """``clip`` with joints that have no keys at ``goal`` (joint -> value), and the mask (nq,) of these.

    Raises PantographError, saying ``what`` it is about, for names that are no hinge or slide, or have keys,
    and for values that are no numbers.
    """
    model, q0, mask = clip.model, clip.q0.copy(), np.zeros(clip.model.nq, dtype=bool)
    if not isinstance(goal, Mapping):
        raise PantographError(f"{what} is a value for each joint, as {{hinge = 0.0}}, not {goal!r}")
    names = joint_names(model)
    free = [n for j, n in enumerate(names) if model.jnt_type[j] in SCALAR and n not in clip.tracks]
    for name, value in goal.items():
        if name not in free:
            raise PantographError(f"{what}: {unknown('joint without keys', name, free)}")
        at = model.jnt_qposadr[names.index(name)]
        q0[at], mask[at] = number(f"{what} of {name!r}", value), True
    return Clip(model, clip.tracks, q0), mask
