"""One run of a scene under one law, measured: errors, effort, saturation, settling, time of the computer."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import dof_names, joint_names
from ..sim.compose import make_engine, make_law
from ..sim.control import Law, Sampled, Target
from ..sim.engines.common import Broken
from ..sim.engines.interface import Controls, Engine, Held, Problem, Role, Segment, State
from ..sim.engines.tick import tick_of
from ..sim.errors import PantographError
from ..sim.kinds import SCALAR
from ..sim.plan import Plan
from ..sim.scene.angles import law_words
from .gains import force_limits
from .ilc import Fed, Learned, learn
from .judged import Judged, delivered, judged
from .nominal import moved
from .reality import LOOP_WORDS, Loop, LoopMemory, with_reality
from .swing_up import SwingUp

Array = NDArray[np.float64]
ILC = "ilc"  # no law of its own: another one that learns
ILC_WORDS = ("of", "repeats", "share", "bandwidth")
_TIMED = 200  # states at which machine code is timed


@dataclass(frozen=True)
class Disturbance:
    """What a trial does to a machine that the law does not know.

    ``mass``: factor a body (nbody,) on mass and inertia; ``friction``: factor a freedom (nv,) on damping and
    dry friction; ``push``: joint forces (nv,) [N m, N] from ``start`` to ``stop`` [s]; ``offset`` (nv,)
    [rad, m] and ``speed`` (nv,): what is added to the state at the start; ``say``: in words.
    """

    mass: tuple[float, ...] = ()
    friction: tuple[float, ...] = ()
    push: tuple[float, ...] = ()
    start: float = 0.0
    stop: float = 0.0
    offset: tuple[float, ...] = ()
    speed: tuple[float, ...] = ()
    say: str = "as modelled"


@dataclass(frozen=True)
class Figures:
    """What one trial measured, over the joints that count (:class:`~pantograph.controllers.judged.Judged`).

    ``rms``, ``worst``: errors [rad, m], the largest that of joint ``where``; ``effort``: RMS of all forces
    that drives give together [N m, N]; ``work``: sum of |force x speed| [J]; ``saturated``: part of the
    samples where a drive gave all it could, sooner where the law's reality says so; ``settling`` [s] after
    the keys rest until every joint stays within 2 % of its motion, or, where it has none, of the largest of
    its kind or else of the other kind, metres for radians at an arm as long as the model (infinite: it does
    not; NaN: the keys move until the end, or no joint has anything to do); ``overshoot`` beyond the last key
    or the goal, of that motion; ``build`` [s]: what it took to make the law and a first sample; ``tick``,
    ``tick99`` [s]: median and 99th percentile of the law's processor time a sample after that, called from
    Python, ``longest`` its longest; ``code`` [s]: median time of the machine code that engines run in its
    place, one call (NaN: they run none); ``status`` of the run, and why it ended early.
    """

    rms: float
    worst: float
    where: str
    effort: float
    work: float
    saturated: float
    settling: float
    overshoot: float
    build: float
    tick: float
    tick99: float
    longest: float
    code: float
    status: str
    message: str


@dataclass(frozen=True, eq=False)
class Trial:
    """Figures of a run, with its samples: t (n,) [s], ``error`` (n, joints) of the freedoms ``joints`` that
    count, ``tau`` (n, inputs): what the drives of the freedoms ``inputs`` give, and ``low``, ``high``
    (inputs,): the least and the most that they can; and what was ``learned`` in repeats before it, if
    anything was."""

    figures: Figures
    t: Array
    error: Array
    tau: Array
    joints: tuple[str, ...] = ()
    inputs: tuple[str, ...] = ()
    low: Array = field(default_factory=lambda: np.zeros(0))
    high: Array = field(default_factory=lambda: np.zeros(0))
    learned: Learned | None = None

    @property
    def brief(self) -> Trial:
        """Without its samples."""
        none = np.zeros(0)
        return replace(self, t=none, error=none, tau=none)


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

    def column(self, word: str) -> NDArray[Any]:
        """One of the things that it keeps, of all samples."""
        return np.array([getattr(row, word) for row in self.seen])


class _Pushed:
    """Controls with joint forces added that nobody ordered; it keeps the ``ctrl`` of every sample."""

    def __init__(self, controls: Sampled, disturbance: Disturbance) -> None:
        self.controls, self.period, self.by = controls, controls.period, disturbance
        self.ctrl: list[Array] = []

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        held = self.controls.sample(k, t, q, v)
        self.ctrl.append(held.ctrl)
        on = self.by.push and self.by.start <= t < self.by.stop
        return Held(held.ctrl, held.qfrc + np.array(self.by.push)) if on else held

    def given(self, watched: _Watched) -> Array:
        """What drives gave at the samples of ``watched`` (n, nv); not a number where that was none."""
        m, count = self.controls.clip.model, len(watched.seen)
        ctrl = np.array(self.ctrl + [np.full(m.nu, np.nan)] * (count - len(self.ctrl)))
        tau, q, v = map(watched.column, ("tau", "q", "v"))
        return delivered(m, self.controls.actuators, tau, ctrl, q, v)


class _Interrupted:
    """An engine whose runs raise KeyboardInterrupt where others return what was computed until then."""

    def __init__(self, engine: Engine) -> None:
        self.engine, self.name = engine, engine.name

    def order(self, integrator: str) -> int:
        return self.engine.order(integrator)

    def run(
        self,
        problem: Problem,
        t_span: tuple[float, float],
        controls: Controls | None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Segment:
        segment = self.engine.run(problem, t_span, controls, progress=progress)
        if segment.status == "interrupted":
            raise KeyboardInterrupt
        return segment


def run_trial(plan: Plan, law: str, words: Mapping[str, Any], disturbance: Disturbance) -> Trial:
    """Run a plan under the law ``law`` with parameters ``words`` in the units of its scene; the law believes
    the undisturbed model and start.

    The law "ilc" first learns on the disturbed machine, without its push. Joints with a ``goal`` count beside
    tracked ones: that of ``words``, or the scene's own for laws that know of none. Raises SceneError for a
    law or parameter that does not fit, PantographError when the scene has nothing to control, and
    KeyboardInterrupt. A run that breaks is measured until then; one that breaks at its first sample raises
    EngineError.
    """
    problem, period, scene = plan.problem, plan.period, plan.setup.scene
    assert period is not None
    words = law_words(scene, problem.model, words)
    aims = judged(problem, _goal(plan, words))
    begun, learned = time.perf_counter(), None
    true, engine = disturbed(problem, disturbance), _Interrupted(make_engine(plan.engine.what))
    if law == ILC:
        learned, made = _learned(plan, true, engine, words, period)
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
        segment = engine.run(true, (0.0, true.steps * true.step), controls)
    except Broken as broken:
        if not watched.seen:
            raise
        segment = broken.segment
    trial = _measured(problem, aims, watched, controls.given(watched), build, segment)
    code = _code_time(Sampled(made, true, period), watched.seen) if disturbance == Disturbance() else np.nan
    return replace(trial, learned=learned, figures=replace(trial.figures, code=code))


def _goal(plan: Plan, words: Mapping[str, Any]) -> Any:
    """The goal [rad, m] of these words of a law, else of the scene's own controller; in the scene of a
    swing-up its goal for every joint, whether or not keys move it."""
    scene, problem, period = plan.setup.scene, plan.problem, plan.period
    own = law_words(scene, problem.model)
    goal = words.get("goal", own.get("goal"))
    if scene.controller is None or scene.controller.law != "swing-up" or period is None:
        return goal
    law = make_law("swing-up", problem, {"goal": goal}, period)
    assert isinstance(law, SwingUp)
    names, at, home = joint_names(problem.model), problem.model.jnt_qposadr, law.shaping.goal
    return {n: float(home[at[j]]) for j, n in enumerate(names) if problem.roles[j] != Role.KEYED}


def _learned(
    plan: Plan, true: Problem, engine: Engine, words: Mapping[str, Any], period: float
) -> tuple[Learned, Law]:
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

    delay = real.get("delay", 0.0)
    learned = learn(law, true, engine, period, around=around, delay=delay, **how)
    return learned, around(Fed(law(), learned.forces, period))


def disturbed(problem: Problem, by: Disturbance) -> Problem:
    """A machine that differs from that of ``problem`` and starts elsewhere; joints stay within their ranges,
    and keyed ones where their keys are."""
    if by.offset or by.speed:
        problem = replace(problem, state0=_elsewhere(problem, by))
    if not (by.mass or by.friction):
        return problem
    model = copy.copy(problem.model)
    factors = np.array(by.mass or 1.0)
    model.body_mass[:] *= factors
    model.body_inertia[:] *= factors[..., None]
    for lossy in (model.dof_damping, model.dof_frictionloss):
        lossy[:] *= np.array(by.friction or 1.0)
    mujoco.mj_setConst(model, mujoco.MjData(model))
    return replace(problem, model=model)


def _elsewhere(problem: Problem, by: Disturbance) -> State:
    """The state at the start with the offsets of a disturbance."""
    m, state, free = problem.model, problem.state0, ~problem.dofs(Role.KEYED)
    offset, speed = (np.where(free, np.array(x or 0.0), 0.0) for x in (by.offset, by.speed))
    q = moved(m, state.q, offset)
    ranged = np.flatnonzero(np.isin(m.jnt_type, SCALAR) & m.jnt_limited.astype(bool))
    at = m.jnt_qposadr[ranged]
    low, high = m.jnt_range[ranged].T
    q[at] = np.clip(q[at], np.minimum(low, state.q[at]), np.maximum(high, state.q[at]))
    return State(q, state.v + speed, state.act)


def _measured(
    problem: Problem, aims: Judged, watched: _Watched, given: Array, build: float, segment: Segment
) -> Trial:
    m, tracked, status = problem.model, problem.dofs(Role.TRACKED), segment.status
    t, q, v, tau, cut, seconds = map(watched.column, ("t", "q", "v", "tau", "cut", "seconds"))
    cut |= ~np.isclose(given, tau, rtol=1e-9, atol=1e-12)
    given, cut, v = given[:, tracked], cut[:, tracked], v[:, tracked]
    targets = aims.targets(*(np.array([getattr(row.target, word) for row in watched.seen]) for word in "qv"))
    error = aims.errors(q, targets[0])
    finite = bool(np.isfinite(error).all()) and status == "done"
    settling, overshoot = aims.arrival(t, error, *targets) if finite else (np.inf, np.inf)
    largest = np.abs(error).max(axis=0)
    figures = Figures(
        rms=float(np.sqrt(np.mean(error**2))) if finite else np.inf,
        worst=float(largest.max()) if finite else np.inf,
        where=aims.names[int(np.argmax(largest))],
        effort=float(np.sqrt(np.mean(np.sum(given**2, axis=1)))),
        work=float(np.sum(np.abs(given * v)) * (t[1] - t[0])) if len(t) > 1 else 0.0,
        saturated=float(cut.any(axis=1).mean()),
        settling=settling,
        overshoot=overshoot,
        build=build,
        tick=float(np.median(seconds)),
        tick99=float(np.percentile(seconds, 99)),
        longest=float(seconds.max()),
        code=np.nan,
        status=status,
        message=segment.message,
    )
    own = watched.law
    limits = (own.drives.low, own.drives.high) if isinstance(own, Loop) else force_limits(m)
    names = dof_names(m)
    inputs = tuple(names[i] for i in np.flatnonzero(tracked))
    low, high = (x[tracked] for x in limits)
    return Trial(figures, t, error, given, aims.names, inputs, low, high)


def failed(message: str) -> Trial:
    """What a run that did not even begin measured: nothing."""
    nothing, no = np.zeros(0), np.nan
    figures = Figures(
        np.inf, np.inf, "", no, no, no, np.inf, np.inf, no, no, no, no, no, status="failed", message=message
    )
    return Trial(figures, nothing, nothing, nothing)


def _code_time(controls: Sampled, seen: list[_Sample]) -> float:
    """Median time [s] of a call of the tick's machine code, at states of the run; NaN where engines have
    none for a run of this length."""
    tick = tick_of(controls, len(seen) * controls.period)
    if tick is None:
        return float("nan")
    bound, times = tick.bound(controls.clip.model), []
    ins = bound.inputs
    ins["g"][:], ins["m"][:] = tick.formula.gains, tick.memory
    for k in np.unique(np.linspace(0, len(seen) - 1, _TIMED).astype(int)):
        ins["q"][:], ins["v"][:], ins["r"][:] = seen[k].q, seen[k].v, controls.rows(int(k), 1)[0]
        begun = time.perf_counter()
        for _ in range(10):
            bound()
        times.append((time.perf_counter() - begun) / 10)
    return float(np.median(times))
