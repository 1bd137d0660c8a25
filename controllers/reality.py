"""Between a law and the joints: what sensors and drives of real machines do, sampled at the control rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import name_of
from ..sim.control import Law, Target
from ..sim.errors import PantographError
from ..sim.kinds import SCALAR
from .gains import Gain, choice, felt_inertia, force_limits, limit_per_joint, per_joint, positive
from .ilc import Fed, load_learned
from .nominal import difference
from .observers import Kalman, Observer, VelocityFilter
from .play import Play, Rotors

Array = NDArray[np.float64]
OBSERVERS = ("none", "filter", "kalman", "extended")


class LoopMemory(NamedTuple):
    """Memory of a loop: the law's own and the observer's, forces on their way (oldest first) and applied,
    where the encoders' plays have their middles (scalar joints,), the rotors of gears with play, and which
    drives gave all they could (nv,)."""

    law: Any
    observer: Any
    queue: tuple[Array, ...]
    applied: Array
    middles: Array | None
    rotors: Rotors | None
    cut: NDArray[np.bool_]


class Loop:
    """``law`` as it works in a machine: it sees what encoders show, its forces come late and bounded.

    - ``encoder``: counts a turn (a metre for slides) of joint encoders, 0: exact;
    - ``backlash`` [rad, m]: full width of the play between joint and encoder: what is measured follows the
      joint only once that has taken up the play;
    - ``observer``: where velocities come from. "none": they are measured; "filter": differences of positions
      through a filter of ``corner`` [Hz]; "kalman", "extended": by the law's model;
    - ``delay`` [s]: forces take effect that much later, rounded up to whole periods;
    - ``saturation``: forces are cut at this fraction of what the drives can give (see also ``top_speed``);
    - ``top_speed`` [rad/s, m/s]: motor force falls linearly to zero at this joint speed;
    - ``play`` [rad, m]: full width of the play of the gears between motors and joints, see
      :class:`~pantograph.controllers.play.Play`;
    - ``learned``: file of forces that :mod:`~pantograph.controllers.ilc` has learned, added to the law's;
    - ``friction`` [N m, N]: dry friction that drives lose, smoothed below ``stiction`` [rad/s, m/s], or below
      the speed that it stops within a period.

    Raises PantographError for values that make no sense, and for ``saturation`` and ``top_speed`` of drives
    ``tracked`` (nv,) that can give anything.
    """

    def __init__(
        self,
        law: Law,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        period: float,
        *,
        encoder: float = 0.0,
        backlash: Gain = 0.0,
        observer: str = "none",
        corner: float = 30.0,
        delay: float = 0.0,
        saturation: float | None = None,
        top_speed: Gain | None = None,
        play: Gain = 0.0,
        friction: Gain = 0.0,
        stiction: float = 0.02,
        learned: str = "",
    ) -> None:
        choice("observer", observer, OBSERVERS, "a loop")
        self.law: Law = law
        self.model = model
        self.counts = positive("encoder", encoder, zero=True)
        self.backlash = per_joint(model, "backlash", backlash)
        self.late = int(np.ceil(positive("delay", delay, zero=True) / period - 1e-9))
        share = 1.0 if saturation is None else positive("saturation", saturation)
        self.low, self.high = (share * limit for limit in force_limits(model))
        self.top = np.where(tracked, limit_per_joint(model, "top_speed", top_speed), np.inf)
        for word, slowed in (("saturation", share != 1.0), ("top_speed", np.isfinite(self.top))):
            self._needs_limits(word, tracked & slowed)
        self.friction = per_joint(model, "friction", friction)
        stopped = self.friction * period / felt_inertia(model, q0)
        self.stiction = np.maximum(positive("stiction", stiction), stopped)
        self.play = Play(model, np.where(tracked, per_joint(model, "play", play), 0.0), period)
        if learned:
            self.law = Fed(law, load_learned(learned, model.nv, period), period)
        self.observer = _observer(observer, model, q0, positive("corner", corner), self.counts)

    def _needs_limits(self, word: str, dofs: NDArray[np.bool_]) -> None:
        for dof in np.flatnonzero(dofs & ~np.isfinite(self.high - self.low)):
            joint = name_of(self.model, "joint", int(self.model.dof_jntid[dof]))
            raise PantographError(
                f"{word} needs to know what the drive of {joint!r} can give: it is an ideal force, or its "
                "actuator has no ctrlrange or forcerange"
            )

    def start(self) -> LoopMemory:
        """Nothing on its way, nothing measured yet."""
        nothing = np.zeros(self.model.nv)
        seen = None if self.observer is None else self.observer.start()
        queue = (nothing,) * self.late
        return LoopMemory(self.law.start(), seen, queue, nothing, None, None, nothing != 0.0)

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: LoopMemory
    ) -> tuple[Array, LoopMemory]:
        """Joint forces (nv,) that arrive now; see :class:`~pantograph.sim.control.Law`."""
        y, middles = self._measure(q, memory.middles)
        seen, q_seen, v_seen = memory.observer, y, v
        if self.observer is not None:
            seen = self.observer.update(seen, t, y, memory.applied)
            q_seen, v_seen = seen.q, seen.v
        tau, inner = self.law(t, q_seen, v_seen, target, memory.law)
        queue, rotors = (*memory.queue, tau), memory.rotors
        given, cut = self._drive(queue[0], v)
        if len(self.play.dofs):
            at = difference(self.model, self.model.qpos0, q)
            given, rotors = self.play.pass_on(given, at, v, rotors or self.play.start(at, v))
        given = np.asarray(given - self.friction * np.tanh(v / self.stiction))
        return given, LoopMemory(inner, seen, queue[1:], given, middles, rotors, cut)

    def _measure(self, q: Array, play: Array | None) -> tuple[Array, Array | None]:
        """What the encoders show, (nq,), and where the middles of the plays are now."""
        m, y = self.model, q.copy()
        scalar = np.flatnonzero(np.isin(m.jnt_type, SCALAR))
        at, dof = m.jnt_qposadr[scalar], m.jnt_dofadr[scalar]
        if self.backlash.any():
            half = 0.5 * self.backlash[dof]
            play = y[at] if play is None else np.clip(play, y[at] - half, y[at] + half)
            y[at] = play
        if self.counts:
            unit = np.where(m.jnt_type[scalar] == mujoco.mjtJoint.mjJNT_HINGE, 2.0 * np.pi, 1.0) / self.counts
            y[at] = np.round(y[at] / unit) * unit
        return y, play

    def _drive(self, tau: Array, v: Array) -> tuple[Array, NDArray[np.bool_]]:
        """What motors give of the forces asked for, (nv,), and whether it is all they can."""
        # a motor gives its whole force against its motion, and none beyond its top speed
        left = np.clip(1.0 - np.abs(v) / self.top, 0.0, 1.0)
        high, low = np.where(v > 0, left * self.high, self.high), np.where(v < 0, left * self.low, self.low)
        return np.clip(tau, low, high), (tau <= low) | (tau >= high)


LOOP_WORDS = (
    "encoder", "backlash", "observer", "corner", "delay", "saturation", "top_speed", "play", "friction",
    "stiction", "learned",
)  # fmt: skip


def with_reality(
    law: Law,
    model: mujoco.MjModel,
    tracked: NDArray[np.bool_],
    q0: Array,
    period: float,
    words: Mapping[str, Any],
) -> Law:
    """``law`` inside a :class:`Loop` when any of ``words`` asks for one."""
    return Loop(law, model, tracked, q0, period, **words) if words else law


def _observer(kind: str, model: mujoco.MjModel, q0: Array, corner: float, counts: float) -> Observer | None:
    if kind == "none":
        return None
    if kind == "filter":
        return VelocityFilter(model, q0, corner=corner)
    # an encoder's count is uniform noise of its own width: standard deviation width / sqrt(12)
    noise = max(2.0 * np.pi / counts / np.sqrt(12.0), 1e-6) if counts else 1e-4
    return Kalman(model, q0, noise=noise, extended=kind == "extended")
