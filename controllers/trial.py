"""One run of a scene under one law, measured: errors, effort, saturation, settling, time of the computer."""

from __future__ import annotations

import copy
import time
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.compose import make_engine, make_law
from ..sim.control import Law, Sampled, Target
from ..sim.engines.common import Broken
from ..sim.engines.interface import Controls, Held, Problem, Role
from ..sim.errors import PantographError
from ..sim.plan import Plan
from ..sim.scene.angles import law_words
from .gains import force_limits
from .ilc import Fed, Learned, learn
from .nominal import difference
from .reality import LOOP_WORDS, LoopMemory, with_reality

Array = NDArray[np.float64]
ILC = "ilc"  # no law of its own: another one that learns
ILC_WORDS = ("of", "repeats", "share", "bandwidth")
_BAND = 0.02  # of its motion: a joint that stays this near to its last key has settled


@dataclass(frozen=True)
class Disturbance:
    """What a trial does to a machine that the law does not know.

    ``mass``: factor a body (nbody,) on mass and inertia; ``friction``: factor a freedom (nv,) on damping and
    dry friction; ``push``: joint forces (nv,) [N m, N] from ``start`` to ``stop`` [s]; ``say``: in words.
    """

    mass: tuple[float, ...] = ()
    friction: tuple[float, ...] = ()
    push: tuple[float, ...] = ()
    start: float = 0.0
    stop: float = 0.0
    say: str = "as modelled"


@dataclass(frozen=True)
class Figures:
    """What one trial measured, over the tracked joints.

    ``rms``, ``worst``: errors [rad, m]; ``effort``: RMS of all joint forces together [N m, N]; ``work``: sum
    of |force x speed| [J]; ``saturated``: part of the samples where a drive gave all it could, sooner where
    the law's reality says so; ``settling`` [s] after the keys rest until every joint stays within 2 % of its
    motion, or, where it has none, of the largest motion of its kind (infinite: it does not; NaN: the keys
    move until the end, or no joint has anything to do); ``overshoot`` beyond the last key, of the motion;
    ``build`` [s]: what it took to make the law and a first sample; ``tick``, ``tick99`` [s]: median and 99th
    percentile of the law's processor time a sample after that, ``longest`` its longest; ``status`` of the
    run, and why it ended early.
    """

    rms: float
    worst: float
    effort: float
    work: float
    saturated: float
    settling: float
    overshoot: float
    build: float
    tick: float
    tick99: float
    longest: float
    status: str
    message: str


@dataclass(frozen=True, eq=False)
class Trial:
    """Figures of a run, with its samples: t (n,) [s], error (n, nv), tau (n, nv); and what was ``learned``
    in repeats before it, if anything was."""

    figures: Figures
    t: Array
    error: Array
    tau: Array
    learned: Learned | None = None


class _Sample(NamedTuple):
    """What a law saw and gave at a sample, which drives gave all they could, and its time [s]."""

    t: float
    q: Array
    v: Array
    target: Target
    tau: Array
    cut: NDArray[np.bool_]
    seconds: float


class _Watched:
    """A law that keeps what it saw and gave, and how long it took; the measuring end of a trial."""

    def __init__(self, law: Law, limits: tuple[Array, Array]) -> None:
        self.law, (self.low, self.high) = law, limits
        self.lost = getattr(law, "lost", None)
        self.seen: list[_Sample] = []

    def start(self) -> Any:
        return self.law.start()

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: Any) -> tuple[Array, Any]:
        begun = time.thread_time()  # others on this machine are not the law's doing
        tau, memory = self.law(t, q, v, target, memory)
        took = time.thread_time() - begun
        cut = memory.cut if isinstance(memory, LoopMemory) else (tau <= self.low) | (tau >= self.high)
        self.seen.append(_Sample(t, q, v, target, tau, cut, took))
        return tau, memory


class _Pushed:
    """Controls with joint forces added that nobody ordered."""

    def __init__(self, controls: Controls, disturbance: Disturbance) -> None:
        self.controls, self.period, self.by = controls, controls.period, disturbance

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        held = self.controls.sample(k, t, q, v)
        on = self.by.push and self.by.start <= t < self.by.stop
        return Held(held.ctrl, held.qfrc + np.array(self.by.push)) if on else held


def run_trial(plan: Plan, law: str, words: Mapping[str, Any], disturbance: Disturbance) -> Trial:
    """Run a plan under the law ``law`` with parameters ``words`` in the units of its scene; the law believes
    the undisturbed model.

    The law "ilc" first learns on the disturbed machine, without its push. Raises SceneError for a law or
    parameter that does not fit, and PantographError when the scene has nothing to control. A run that breaks
    is measured until then; one that breaks at its first sample raises EngineError.
    """
    problem, period = plan.problem, plan.period
    assert period is not None
    words = law_words(plan.setup.scene, problem.model, words)
    begun, learned = time.perf_counter(), None
    true = _disturbed(problem, disturbance)
    if law == ILC:
        learned, made = _learned(plan, true, words, period)
    else:
        made = make_law(law, problem, words, period)
    q, v, _ = problem.state0
    try:
        made(0.0, q, v, Target(*problem.clip.evaluate(0.0)), made.start())  # builds what the law needs
    except PantographError as e:
        raise PantographError(f"law {law!r}: {e}") from e
    build = time.perf_counter() - begun
    watched = _Watched(made, force_limits(problem.model))
    controls = _Pushed(Sampled(watched, true, period), disturbance)
    try:
        segment = make_engine(plan.engine.what).run(true, (0.0, true.steps * true.step), controls)
    except Broken as broken:
        if not watched.seen:
            raise
        segment = broken.segment
    trial = _measured(problem, watched.seen, build, segment.status, segment.message)
    return replace(trial, learned=learned)


def _learned(plan: Plan, true: Problem, words: Mapping[str, Any], period: float) -> tuple[Learned, Law]:
    """What the law ``of`` of these words learns on the ``true`` machine, and that law with it."""
    how = {word: words[word] for word in ILC_WORDS if word in words}
    base, problem = how.pop("of", "pd"), plan.problem
    own = {word: x for word, x in words.items() if word not in ILC_WORDS and word not in LOOP_WORDS}
    real = {word: x for word, x in words.items() if word in LOOP_WORDS}
    tracked = problem.dofs(Role.TRACKED)
    if real.get("predict"):
        raise PantographError("predict: what learns knows the delay already; leave it out")

    def around(law: Law) -> Law:
        start, keyed = problem.state0.q, problem.dofs(Role.KEYED)
        return with_reality(law, problem.model, tracked, start, period, real, keyed, problem.clip)

    def law() -> Law:
        return make_law(base, problem, own, period)

    engine, delay = make_engine(plan.engine.what), real.get("delay", 0.0)
    learned = learn(law, true, engine, period, around=around, delay=delay, **how)
    return learned, around(Fed(law(), learned.forces, period))


def _disturbed(problem: Problem, disturbance: Disturbance) -> Problem:
    if not (disturbance.mass or disturbance.friction):
        return problem
    model = copy.copy(problem.model)
    factors = np.array(disturbance.mass or 1.0)
    model.body_mass[:] *= factors
    model.body_inertia[:] *= factors[..., None]
    for lossy in (model.dof_damping, model.dof_frictionloss):
        lossy[:] *= np.array(disturbance.friction or 1.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(problem, model=model)


def _measured(problem: Problem, seen: list[_Sample], build: float, status: str, message: str) -> Trial:
    m, tracked = problem.model, problem.dofs(Role.TRACKED)
    t = np.array([row.t for row in seen])
    error = np.array([difference(m, row.q, row.target.q) for row in seen])[:, tracked]
    v, tau, cut = (np.array([getattr(row, word) for row in seen])[:, tracked] for word in ("v", "tau", "cut"))
    given = np.clip(tau, *(limit[tracked] for limit in force_limits(m)))
    seconds = np.array([row.seconds for row in seen])
    finite = bool(np.isfinite(error).all()) and status == "done"
    settling, overshoot = np.inf, np.inf
    if finite:
        settling, overshoot = _arrival(t, error, [row.target for row in seen], tracked, m)
    figures = Figures(
        rms=float(np.sqrt(np.mean(error**2))) if finite else np.inf,
        worst=float(np.abs(error).max()) if finite else np.inf,
        effort=float(np.sqrt(np.mean(np.sum(given**2, axis=1)))),
        work=float(np.sum(np.abs(given * v)) * (t[1] - t[0])) if len(t) > 1 else 0.0,
        saturated=float(cut.any(axis=1).mean()),
        settling=settling,
        overshoot=overshoot,
        build=build,
        tick=float(np.median(seconds)),
        tick99=float(np.percentile(seconds, 99)),
        longest=float(seconds.max()),
        status=status,
        message=message,
    )
    return Trial(figures, t, error, tau)


def _arrival(
    t: Array, error: Array, targets: list[Target], tracked: NDArray[np.bool_], m: mujoco.MjModel
) -> tuple[float, float]:
    """Settling time [s] after the keys rest and overshoot beyond the last key, the worst joint's."""
    last = targets[-1].q
    way = np.array([difference(m, target.q, last) for target in targets])[:, tracked]
    moving = np.flatnonzero((np.abs(way) > 1e-9).any(axis=1) | [x.v[tracked].any() for x in targets])
    rest = int(moving[-1]) + 1 if len(moving) else 0
    start = way[0] + error[0]
    scale = np.maximum(np.abs(way).max(axis=0), np.abs(start))
    angles = np.asarray(m.jnt_type[m.dof_jntid[tracked]] != mujoco.mjtJoint.mjJNT_SLIDE)
    for kind in (angles, ~angles):
        scale[kind] = np.where(scale[kind] > 1e-9, scale[kind], scale[kind].max(initial=0.0))
    left = error[rest:]
    if not len(left) or not (scale > 1e-9).any():
        return np.nan, 0.0
    scale = np.where(scale > 1e-9, scale, np.inf)  # nothing of its kind has anything to do
    outside = np.flatnonzero((np.abs(left) > _BAND * scale).any(axis=1))
    settling = 0.0 if not len(outside) else np.inf
    if len(outside) and outside[-1] + 1 < len(left):
        settling = float(t[rest + outside[-1] + 1] - t[rest])
    beyond = -left * np.sign(start)
    return settling, max(0.0, float(np.max(beyond / scale)))
