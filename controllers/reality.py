"""Between a law and the joints: what sensors and drives of real machines do, sampled at the control rate."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.clip import Clip
from ..sim.control import Law, Target
from ..sim.errors import PantographError
from ..sim.formula import Formula
from ..sim.kinds import SCALAR
from .drives import Drives
from .gains import Gain, choice, felt_inertia, per_joint, positive, switch
from .ilc import Fed, load_learned
from .loop_formula import LoopFormula
from .nominal import difference
from .observers import Kalman, Observer, VelocityFilter
from .play import Play, Rotors
from .predictor import Predictor

Array = NDArray[np.float64]
OBSERVERS = ("none", "filter", "kalman", "extended")


class LoopMemory(NamedTuple):
    """Memory of a loop: the law's own and the observer's, forces on their way (oldest first) and those that
    the motors gave, where the encoders' plays have their middles (scalar joints,), the rotors of gears with
    play, and which drives gave all they could (nv,)."""

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
      through a filter of ``corner`` [Hz]; "kalman", "extended": by the law's model, measured positions having
      ``noise`` [rad, m] (default: what the encoder rounds away, or 1e-4) and accelerations that the model
      does not know being about ``push`` [rad/s^2, m/s^2]. It knows what motors were told to give, not what
      play and friction leave of it; joints ``keyed`` (nv,) are known to be where their keys say;
    - ``delay`` [s]: forces take effect that much later, rounded up to whole periods; with ``predict`` the law
      is asked for the moment when they do, at the state that its model foresees then;
    - ``saturation``: forces are cut at this fraction of what the drives can give;
    - ``top_speed`` [rad/s, m/s]: motor force falls linearly to zero at this joint speed;
    - ``play`` [rad, m]: full width of the play of the gears between motors and joints, see
      :class:`~pantograph.controllers.play.Play`;
    - ``learned``: file of forces that :mod:`~pantograph.controllers.ilc` has learned, added to the law's;
    - ``friction`` [N m, N]: dry friction at the joints, beside what drives give, smoothed below ``stiction``
      [rad/s, m/s], or below the speed that it stops within a period.

    Raises PantographError for values that make no sense, for what drives do at joints that are not
    ``tracked`` (nv,), and for ``saturation`` and ``top_speed`` of drives that can give anything.
    """

    def __init__(
        self,
        law: Law,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        q0: Array,
        period: float,
        keyed: NDArray[np.bool_] | None = None,
        clip: Clip | None = None,
        *,
        encoder: float = 0.0,
        backlash: Gain = 0.0,
        observer: str = "none",
        corner: float = 30.0,
        noise: Gain | None = None,
        push: Gain = 5.0,
        delay: float = 0.0,
        predict: bool = False,
        saturation: float | None = None,
        top_speed: Gain | None = None,
        play: Gain = 0.0,
        friction: Gain = 0.0,
        stiction: Gain = 0.02,
        learned: str = "",
    ) -> None:
        choice("observer", observer, OBSERVERS, "a loop")
        self.law: Law = law
        self.model = model
        self.counts = positive("encoder", encoder, zero=True)
        self.backlash = per_joint(model, "backlash", backlash)
        self._plays = bool(self.backlash.any())
        self.late = int(np.ceil(positive("delay", delay, zero=True) / period - 1e-9))
        self.drives = Drives(model, tracked, saturation, top_speed)
        self.friction = per_joint(model, "friction", friction, tracked=tracked)
        self.lost = self._lost if self.friction.any() else None
        stopped = self.friction * period / felt_inertia(model, q0)
        self.stiction = np.maximum(per_joint(model, "stiction", stiction, missing=0.02, zero=False), stopped)
        width = per_joint(model, "play", play, tracked=tracked)
        self.play = Play(model, np.where(tracked, width, 0.0), period)
        if learned:
            self.law = Fed(law, load_learned(learned, model.nv, period), period)
        self.keyed = np.zeros(model.nv, dtype=bool) if keyed is None else keyed
        self.keyed_q, self._any_keyed = np.zeros(model.nq, dtype=bool), bool(self.keyed.any())
        for joint in np.unique(model.dof_jntid[self.keyed]):
            ends = (*model.jnt_qposadr, model.nq)
            self.keyed_q[ends[joint] : ends[joint + 1]] = True
        self.predictor: Predictor | None = None
        if switch("predict", predict) and self.late:
            if learned:
                raise PantographError("predict: learned forces know the delay already; leave one of them out")
            known = Clip(model, {}, q0) if clip is None else clip
            self.predictor = Predictor(model, self.keyed, known, period, self.late, self.drives)
        self.ahead = self.late * period
        self.observer: Observer | None = None
        positive("corner", corner)
        if observer == "filter":
            self.observer = VelocityFilter(model, q0, corner=corner)
        elif observer != "none":
            rounding = self._rounding()
            spread = rounding if noise is None else per_joint(model, "noise", noise, missing=rounding)
            self.observer = Kalman(
                model, q0, self.keyed, noise=spread, push=push, extended=observer == "extended"
            )

    def _rounding(self) -> Array:
        """Standard deviation (nv,) [rad, m] of what the encoders round away: an error spread evenly over the
        width w of a count has w / sqrt(12)."""
        out = np.full(self.model.nv, 1e-4)
        if self.counts:
            scalar, unit = self.encoders()
            out[self.model.jnt_dofadr[scalar]] = np.maximum(unit / np.sqrt(12.0), 1e-6)
        return out

    def encoders(self) -> tuple[NDArray[np.intp], Array]:
        """Scalar joints, and what a count of their encoders is [rad, m], zero where they are exact."""
        scalar = np.flatnonzero(np.isin(self.model.jnt_type, SCALAR))
        turns = self.model.jnt_type[scalar] == mujoco.mjtJoint.mjJNT_HINGE
        return scalar, np.where(turns, 2.0 * np.pi, 1.0) / self.counts if self.counts else np.zeros(
            len(scalar)
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
        y = np.where(self.keyed_q, target.q, y) if self._any_keyed else y
        seen, q_seen, v_seen = memory.observer, y, v
        if self.observer is not None:
            seen = self.observer.update(seen, t, y, memory.applied, target if self._any_keyed else None)
            q_seen, v_seen = seen.q, np.where(self.keyed, target.v, seen.v) if self._any_keyed else seen.v
        if self.predictor is not None:
            target = self.predictor.target(t, target)
            q_seen, v_seen = self.predictor.state(t, q_seen, v_seen, memory.queue)
            t += self.ahead
        tau, inner = self.law(t, q_seen, v_seen, target, memory.law)
        queue, rotors = (*memory.queue, tau), memory.rotors
        given, cut = self._drive(queue[0], v)
        told = given
        if len(self.play.dofs):
            at = difference(self.model, self.model.qpos0, q)
            given, rotors = self.play.pass_on(given, at, v, rotors or self.play.start(at, v))
        return given, LoopMemory(inner, seen, queue[1:], told, middles, rotors, cut)

    def formula(self, period: float) -> Formula | None:
        """See :class:`~pantograph.sim.formula.Formula`; None around a law that has none, and with a filter
        that knows a model, a predictor, play of gears or friction."""
        make, watches = getattr(self.law, "formula", None), self.observer
        simple = watches is None or isinstance(watches, VelocityFilter)
        if make is None or not simple or self.predictor or len(self.play.dofs) or self.lost:
            return None
        inner: Formula | None = make(period)
        return None if inner is None else LoopFormula(self, inner, period).formula()

    def remarks(self, q: Array, memory: LoopMemory) -> tuple[str, ...]:
        """What the law remarks; see :class:`~pantograph.sim.control.Law`."""
        tell = getattr(self.law, "remarks", None)
        return () if tell is None else tuple(tell(q, memory.law))

    def _lost(self, v: Array) -> Array:
        """What dry friction takes (nv,) at speeds ``v`` (nv,), also from a drive at its limit."""
        return np.asarray(-self.friction * np.tanh(v / self.stiction))

    def _measure(self, q: Array, play: Array | None) -> tuple[Array, Array | None]:
        """What the encoders show, (nq,), and where the middles of the plays are now."""
        if not (self.counts or self._plays):
            return q, play
        m, y = self.model, q.copy()
        scalar, unit = self.encoders()
        at, dof = m.jnt_qposadr[scalar], m.jnt_dofadr[scalar]
        if self._plays:
            half = 0.5 * self.backlash[dof]
            play = y[at] if play is None else np.clip(play, y[at] - half, y[at] + half)
            y[at] = play
        if self.counts:
            y[at] = np.round(y[at] / unit) * unit
        return y, play

    def _drive(self, tau: Array, v: Array) -> tuple[Array, NDArray[np.bool_]]:
        """What motors give of the forces asked for, (nv,), and whether it is all they can."""
        low, high = self.drives.at(v)
        return np.clip(tau, low, high), (tau <= low) | (tau >= high)


LOOP_WORDS = (
    "encoder", "backlash", "observer", "corner", "noise", "push", "delay", "predict", "saturation",
    "top_speed", "play", "friction", "stiction", "learned",
)  # fmt: skip


def with_reality(
    law: Law,
    model: mujoco.MjModel,
    tracked: NDArray[np.bool_],
    q0: Array,
    period: float,
    words: Mapping[str, Any],
    keyed: NDArray[np.bool_] | None = None,
    clip: Clip | None = None,
) -> Law:
    """``law`` inside a :class:`Loop` when any of ``words`` asks for one."""
    return Loop(law, model, tracked, q0, period, keyed, clip, **words) if words else law
