"""Between a law and the joints: what sensors and drives of real machines do, sampled at the control rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.control import Law, Target
from ..sim.errors import PantographError, unknown
from ..sim.kinds import SCALAR
from .gains import Gain, force_limits, per_joint, positive
from .observers import Kalman, Observer, VelocityFilter

Array = NDArray[np.float64]
OBSERVERS = ("none", "filter", "kalman", "extended")


class LoopMemory(NamedTuple):
    """Memory of a loop: the law's own and the observer's, forces on their way (oldest first) and applied,
    where the play's middle is (nv,), last noise-free output."""

    law: Any
    observer: Any
    queue: tuple[Array, ...]
    applied: Array
    play: Array | None


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
    - ``friction`` [N m, N]: dry friction that drives lose, smoothed below ``stiction`` [rad/s, m/s].
    """

    def __init__(
        self,
        law: Law,
        model: mujoco.MjModel,
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
        friction: Gain = 0.0,
        stiction: float = 0.02,
    ) -> None:
        if observer not in OBSERVERS:
            raise PantographError(unknown("observer", str(observer), OBSERVERS, where="a loop"))
        self.law, self.model = law, model
        self.counts = positive("encoder", encoder, zero=True)
        self.backlash = per_joint(model, "backlash", backlash)
        self.late = int(np.ceil(positive("delay", delay, zero=True) / period - 1e-9))
        self.share = None if saturation is None else positive("saturation", saturation)
        self.low, self.high = force_limits(model)
        self.top = None if top_speed is None else per_joint(model, "top_speed", top_speed)
        self.friction, self.stiction = per_joint(model, "friction", friction), positive("stiction", stiction)
        self.observer = _observer(observer, model, q0, corner, self.counts)

    def start(self) -> LoopMemory:
        """Nothing on its way, nothing measured yet."""
        nothing = np.zeros(self.model.nv)
        seen = None if self.observer is None else self.observer.start()
        return LoopMemory(self.law.start(), seen, (nothing,) * self.late, nothing, None)

    def __call__(
        self, t: float, q: Array, v: Array, target: Target, memory: LoopMemory
    ) -> tuple[Array, LoopMemory]:
        """Joint forces (nv,) that arrive now; see :class:`~pantograph.sim.control.Law`."""
        y, play = self._measure(q, memory.play)
        seen, q_seen, v_seen = memory.observer, y, v
        if self.observer is not None:
            seen = self.observer.update(seen, t, y, memory.applied)
            q_seen, v_seen = seen.q, seen.v
        tau, inner = self.law(t, q_seen, v_seen, target, memory.law)
        queue = (*memory.queue, tau)
        given = self._drive(queue[0], v)
        return given, LoopMemory(inner, seen, queue[1:], given, play)

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

    def _drive(self, tau: Array, v: Array) -> Array:
        """What of the forces asked for arrives at the joints, (nv,)."""
        low, high = self.low, self.high
        if self.share is not None:
            low, high = self.share * low, self.share * high
        if self.top is not None:
            with np.errstate(invalid="ignore", divide="ignore"):
                # a motor gives its whole force against its motion, and none beyond its top speed
                push = np.clip(1.0 - np.where(self.top > 0, np.abs(v) / self.top, 0.0), 0.0, 1.0)
                high, low = np.where(v > 0, high * push, high), np.where(v < 0, low * push, low)
        if self.share is not None or self.top is not None:
            tau = np.clip(
                tau,
                np.nan_to_num(low, nan=-np.inf, neginf=-np.inf),
                np.nan_to_num(high, nan=np.inf, posinf=np.inf),
            )
        return np.asarray(tau - self.friction * np.tanh(v / self.stiction))


LOOP_WORDS = (
    "encoder", "backlash", "observer", "corner", "delay", "saturation", "top_speed", "friction", "stiction",
)  # fmt: skip


def with_reality(law: Law, model: mujoco.MjModel, q0: Array, period: float, words: Mapping[str, Any]) -> Law:
    """``law`` inside a :class:`Loop` when any of ``words`` asks for one."""
    return Loop(law, model, q0, period, **words) if words else law


def _observer(kind: str, model: mujoco.MjModel, q0: Array, corner: float, counts: float) -> Observer | None:
    if kind == "none":
        return None
    if kind == "filter":
        return VelocityFilter(model, q0, corner=corner)
    # an encoder's count is uniform noise of its own width: standard deviation width / sqrt(12)
    noise = max(2.0 * np.pi / counts / np.sqrt(12.0), 1e-6) if counts else 1e-4
    return Kalman(model, q0, noise=noise, extended=kind == "extended")
