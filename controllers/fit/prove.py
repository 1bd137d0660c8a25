"""A fitted motion tried: simulated by MuJoCo with a law in the loop, forces cut at what the machine gives."""

from __future__ import annotations

import copy
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip, FreeTrack, Track
from ...sim.control import Law, Sampled, Target
from ...sim.curves import Curve, frozen
from ...sim.engines.common import Broken
from ...sim.engines.contact import ContactEngine
from ...sim.engines.interface import Problem, Role, State
from ...sim.scene.schema import ControllerItem
from ..lqr import LQR
from ..nominal import difference
from .contact import places, touching
from .fitted import Fitted
from .machine import WIDTH, Machine

Array = NDArray[np.float64]
WITHIN = 0.05
"""How far [rad, m] a simulated motion may be from the fitted one that it proves."""
_HORIZON = 1.0  # s: of deviations at the end count


@dataclass(frozen=True, eq=False)
class Proof:
    """A simulated run of a fitted motion under ``law``: t (n,) [s], q (n, nq), ``error`` (n, nv) of what was
    fitted, its largest ``worst`` [rad, m], infinite if the run broke off, as ``message`` says; and the part
    ``saturated`` of the law's samples in which it asked for more than the machine gives."""

    law: str
    t: Array
    q: Array
    error: Array
    worst: float
    within: float
    saturated: float
    message: str = ""

    @property
    def holds(self) -> bool:
        """Whether the motion stayed ``within`` [rad, m] of the fitted one."""
        return self.worst <= self.within

    def __str__(self) -> str:
        verdict = "holds" if self.holds else "DOES NOT HOLD"
        far = f"within {self.worst:.3g} rad or m of the fitted motion" if self.t.size else "no motion"
        return (
            f"proof to {self.within:g} rad or m {verdict}: simulated with {self.law} in the loop, "
            f"{self.message or far}, drives at their limits {self.saturated:.0%} of the time"
        )


def prove(
    fitted: Fitted,
    machine: Machine,
    *,
    controller: ControllerItem | None = None,
    period: float | None = None,
    steps: int | None = None,
    within: float = WITHIN,
) -> Proof:
    """Simulate the clip from its start by the contact engine: contacts, limits and dry friction are the
    model's own, each joint with a drive takes the law's forces as far as :func:`given_by` has them.

    The law is the scene's ``controller``, at its own period, or LQR along the clip. With contacts, of which
    LQR's mechanism does not know, it is the fitted forces and a servo at each driven joint. It is sampled
    every ``period`` [s] (default: 2 ms, with contacts 0.5 ms), ``steps`` steps each.
    """
    period = controller.period if controller else period or (0.0005 if fitted.phases else 0.002)
    steps = steps or (max(1, round(period / 0.0005)))
    fitted = _from_zero(fitted)
    clip, model = fitted.clip, copy.copy(fitted.clip.model)
    model.actuator_gainprm[:] = 0.0
    model.actuator_biasprm[:] = 0.0
    tracked = np.zeros(model.njnt, dtype=bool)
    tracked[model.dof_jntid[machine.driven]] = True
    start = clip.evaluate(0.0)
    problem = Problem(
        model=model,
        state0=State(start.q, start.v, np.zeros(model.na)),
        duration=max(1, round(clip.end / period)) * period,
        roles=np.where(tracked, Role.TRACKED, Role.PASSIVE).astype(np.int8),
        clip=clip,
        integrator="implicitfast" if fitted.phases else "rk4",
        step=period / steps,
        sample_every=steps,
        drives=np.zeros(model.nu, dtype=np.int8),
    )
    name, law = _law(fitted, machine, problem, controller, period)
    controls = Sampled(_Given(law, machine), problem, period)
    try:
        segment = ContactEngine().run(problem, (0.0, problem.duration), controls)
    except Broken as broken:
        segment = broken.segment
    wanted = clip.evaluate(segment.t, left=True).q
    error = np.array([difference(model, *row) for row in zip(segment.q, wanted, strict=True)])
    error = np.where(clip.dofs, error.reshape(-1, model.nv), 0.0)
    whole = segment.status == "done" and bool(np.isfinite(error).all())
    worst = float(np.abs(error).max(initial=0.0)) if whole else np.inf
    memory: _Count = controls.memory
    cut = memory.cut / max(memory.ticks, 1)
    return Proof(name, segment.t, segment.q, error, worst, within, cut, "" if whole else segment.message)


def given_by(machine: Machine, tau: Array, v: Array) -> Array:
    """What drives give of forces tau (nv,) at velocities v (nv,): less the faster they turn, and together no
    more than the battery does."""
    low, high = machine.force_low.copy(), machine.force_high.copy()
    for force, way in ((low, -1.0), (high, 1.0)):
        limited = np.isfinite(force)
        force[limited] *= np.maximum(1.0 - np.maximum(way * v, 0.0) / machine.top_speed, 0.0)[limited]
    given = np.clip(tau, low, high)
    draw = float(np.abs(given) @ machine.ampere)
    return given * min(1.0, machine.current / draw) if draw > 0.0 else given


class _Count(NamedTuple):
    """Memory of a law that is cut: its own, its samples, and those in which it was cut."""

    law: Any
    ticks: int
    cut: int


class _Given:
    """A law's forces as far as the machine gives them."""

    def __init__(self, law: Law, machine: Machine) -> None:
        self.law, self.machine, self.lost = law, machine, getattr(law, "lost", None)

    def start(self) -> _Count:
        return _Count(self.law.start(), 0, 0)

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: _Count) -> tuple[Array, _Count]:
        tau, inner = self.law(t, q, v, target, memory.law)
        given = given_by(self.machine, tau, v)
        cut = bool(np.any((given != tau) & self.machine.driven))
        return given, _Count(inner, memory.ticks + 1, memory.cut + cut)


def _law(
    fitted: Fitted, machine: Machine, problem: Problem, controller: ControllerItem | None, period: float
) -> tuple[str, Law]:
    """The law of a proof, and what it is called."""
    if controller:
        from ...sim.compose import make_law

        law = make_law(controller.law, problem, controller.parameters, period, model=fitted.clip.model)
        return f"the scene's {controller.law}", law
    if fitted.phases:
        return "contacts and servos", _Servo(fitted, machine, period)
    return "LQR", _Along(fitted, machine, period)


def _from_zero(fitted: Fitted) -> Fitted:
    """The same motion from time zero on, where runs begin."""
    start = fitted.clip.start
    phases = tuple(replace(p, start=p.start - start, stop=p.stop - start) for p in fitted.phases)
    return replace(fitted, clip=shifted(fitted.clip, -start), t=fitted.t - start, phases=phases)


def shifted(clip: Clip, by: float) -> Clip:
    """A clip the time ``by`` [s] later."""

    def later(track: Track) -> Track:
        if isinstance(track, FreeTrack):
            parts = (None if c is None else later(c) for c in (track.position, track.rotation))
            return FreeTrack(*parts)  # type: ignore[arg-type]
        assert isinstance(track, Curve)
        return replace(track, times=frozen(track.times + by), knots=frozen(track.knots + by))

    return Clip(clip.model, {name: later(track) for name, track in clip.tracks.items()}, clip.q0)


class _Along:
    """LQR along the fitted motion, to its end and no further, and what its dry friction needs."""

    def __init__(self, fitted: Fitted, machine: Machine, period: float) -> None:
        clip, keyed = fitted.clip, np.zeros(machine.model.nv, dtype=bool)
        # a finite horizon: there is none without end where something cannot be steered, as a body in flight
        self.lqr = LQR(machine.model, machine.driven, clip.q0, clip, period, clip.end, keyed, final=_HORIZON)
        self.machine = machine

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        tau, _ = self.lqr(t, q, v, target, None)
        dry = self.machine.friction * target.v / np.sqrt(target.v**2 + WIDTH**2)
        return tau + np.where(self.machine.driven, dry, 0.0), None


class _Servo:
    """The fitted forces, and a servo of ``frequency`` [Hz] on what each driven joint feels at the time."""

    def __init__(self, fitted: Fitted, machine: Machine, period: float, *, frequency: float = 5.0) -> None:
        self.fitted, self.driven, self.w = fitted, machine.driven, 2.0 * np.pi * frequency
        model, t = machine.model, fitted.t
        q = fitted.clip.evaluate(t).q
        _, J = places(model, fitted.sites, q)
        on = np.stack([touching(fitted.phases, s, t) for s in fitted.sites], axis=1)
        self.felt, self.most = np.empty((len(t), model.nv)), np.empty((len(t), model.nv))
        for i in range(len(t)):
            # accelerations by forces where resting sites hold: M^-1 - M^-1 J' (J M^-1 J')^-1 J M^-1
            inverse = np.linalg.inv(machine.nominal.mass_matrix(q[i]))
            rows = J[i][np.repeat(on[i], 3)]
            ways = inverse @ rows.T
            free = inverse - ways @ np.linalg.pinv(rows @ ways, rcond=1e-8) @ ways.T
            self.felt[i] = 1.0 / np.maximum(np.diag(free), 1e-3 * np.diag(inverse))
            # a foot may come off: damping of what then moves must not swing up from sample to sample
            self.most[i] = 0.5 / np.diag(inverse) / period

    def start(self) -> None:
        """No memory."""

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: None) -> tuple[Array, None]:
        """Joint forces (nv,)."""
        k = max(int(np.searchsorted(self.fitted.t, t, side="right")) - 1, 0)
        kp = self.felt[k] * self.w**2
        kd = np.minimum(2.0 * kp / self.w, self.most[k])
        error = difference(self.fitted.clip.model, q, target.q)
        tau = self.fitted.drives(t) + kp * error + kd * (target.v - v)
        return np.where(self.driven, tau, 0.0), None
