"""What motors can give: a part of what their actuators may, less the faster they turn."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import name_of
from ..sim.compile.cache import key_of, source
from ..sim.compile.graph import Scalar, absolute, clip, less, maximum, minimum
from ..sim.errors import PantographError
from .gains import Gain, force_limits, limit_per_joint, positive

Array = NDArray[np.float64]


class Drives:
    """Motors of the freedoms ``tracked`` (nv,) that give at most the part ``saturation`` of their actuators'
    force, and less at speed: motoring force falls linearly to zero at ``top_speed`` [rad/s, m/s].

    ``low``, ``high``, ``top`` (nv,): limits at rest, and top speeds, infinite where there are none. Raises
    PantographError for values that make no sense, for joints that are not tracked, and for drives that can
    give anything.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        saturation: float | None = None,
        top_speed: Gain | None = None,
    ) -> None:
        share = 1.0 if saturation is None else positive("saturation", saturation)
        self.low, self.high = (np.where(tracked, share * limit, limit) for limit in force_limits(model))
        self.top = np.where(tracked, limit_per_joint(model, "top_speed", top_speed, tracked=tracked), np.inf)
        for word, slowed in (("saturation", share != 1.0), ("top_speed", np.isfinite(self.top))):
            for dof in np.flatnonzero(tracked & slowed & ~np.isfinite(self.high - self.low)):
                joint = name_of(model, "joint", int(model.dof_jntid[dof]))
                raise PantographError(
                    f"{word} needs to know what the drive of {joint!r} can give: it is an ideal force, or "
                    "its actuator has no ctrlrange or forcerange"
                )

        self.slow = bool(np.isfinite(self.top).any())

    def at(self, v: Array) -> tuple[Array, Array]:
        """Least and greatest force (nv,) at speeds ``v`` (nv,): a motor gives its whole force against its
        motion, and none beyond its top speed."""
        if not self.slow:
            return self.low, self.high
        return at_speed(self.low, self.high, self.top, v)

    @property
    def key(self) -> str:
        """Tells `express` of different drives apart."""
        return key_of(source(__file__), np.array([self.low, self.high, self.top]).tobytes())

    def express(self, dof: int, force: Scalar, v: Scalar) -> Scalar:
        """``force`` within what `at` gives, for one freedom, as an expression."""
        low, high = (float(x[dof]) for x in (self.low, self.high))
        if np.isinf(self.top[dof]):
            return clip(force, low, high)
        left = maximum(1.0 - absolute(v) / float(self.top[dof]), 0.0)
        back = less(v, 0.0)
        least, most = low * (1.0 - back * (1.0 - left)), high * (left + (1.0 - left) * (1.0 - less(0.0, v)))
        return minimum(maximum(force, least), most)

    def told(self, model: mujoco.MjModel) -> mujoco.MjModel:
        """``model`` with these limits at rest as its joints' own, for laws to know."""
        own, known = force_limits(model), copy.copy(model)
        changed = np.flatnonzero(
            np.isfinite(self.high - self.low) & ((self.low != own[0]) | (self.high != own[1]))
        )
        joints = model.dof_jntid[changed]
        known.jnt_actfrclimited[joints] = 1
        known.jnt_actfrcrange[joints] = np.column_stack([self.low, self.high])[changed]
        return known


def at_speed(low: Array, high: Array, top: Array, v: Array) -> tuple[Array, Array]:
    """Least and greatest force of motors at speeds ``v``, by those at rest and their ``top`` speeds."""
    left = np.clip(1.0 - np.abs(v) / top, 0.0, 1.0)
    return np.where(v < 0, left * low, low), np.where(v > 0, left * high, high)


def by_speed(low: Array, high: Array, top: Array, v: Array) -> tuple[Array, Array]:
    """Derivatives of :func:`at_speed` by ``v``."""
    turning = np.abs(v) < top
    return np.where(turning & (v < 0), low / top, 0.0), np.where(turning & (v > 0), -high / top, 0.0)
