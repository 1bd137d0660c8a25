"""What does an error cost? Engines and methods over steps and tolerances, against a far tighter reference."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import captured_warnings
from .accuracy import difference
from .dynamics.smooth import Smooth, compile_model
from .engines.contact import INTEGRATORS
from .errors import EngineError, unknown
from .integrate import TABLEAUS, Tableau, solve
from .integrate.problems import constraints_of

Array = NDArray[np.float64]

TOLERANCES = tuple(10.0 ** -np.arange(3, 14))
ROUNDING = 1e-8
"""An error below this that stops falling is taken for rounding."""
SCIPY = ("DOP853", "Radau", "LSODA")


@dataclass(frozen=True, eq=False)
class Case:
    """Motion of a model from an initial state under constant controls.

    Attributes:
        name: in tables and figures.
        model: compiled model; what it has is what is simulated.
        q, v: initial state, shapes (nq,), (nv,).
        duration: [s].
        ctrl: constant controls, shape (nu,); zero when None.
        frames: the error is looked at after this many equal spans.
        scale: size of the motion [rad, m]; absolute tolerances are relative to it.
    """

    name: str
    model: mujoco.MjModel
    q: Array
    v: Array
    duration: float
    ctrl: Array | None = None
    frames: int = 50
    scale: float = 1.0

    @property
    def times(self) -> Array:
        """Times of the frames [s], the start included, shape (frames + 1,)."""
        return np.linspace(0.0, self.duration, self.frames + 1)


@dataclass(frozen=True, eq=False)
class Motion:
    """States at the frames, shapes (frames + 1, nq) and (frames + 1, nv), and what they cost."""

    q: Array
    v: Array
    evaluations: int

    @property
    def finite(self) -> bool:
        """The motion reached its end."""
        return bool(np.isfinite(self.q).all() and np.isfinite(self.v).all())


class Runner(Protocol):
    """One method of one engine, by steps [s] or by tolerances."""

    @property
    def engine(self) -> str:
        """The engine's name."""
        ...

    @property
    def method(self) -> str:
        """The method's name."""
        ...

    @property
    def knob(self) -> str:
        """What is turned: "step" or "tolerance"."""
        ...

    def settings(self) -> Iterable[float]:
        """Steps or tolerances from coarse to fine."""
        ...

    def run(self, setting: float) -> Motion:
        """The motion of the case at that step or tolerance."""
        ...


def _steps(case: Case) -> list[float]:
    return [case.duration / case.frames / 2**k for k in range(15)]


class SmoothSteps:
    """Fixed steps of the smooth engine."""

    engine, knob = "smooth", "step"

    def __init__(self, case: Case, smooth: Smooth, tableau: Tableau) -> None:
        self.case, self.smooth, self.tableau, self.method = case, smooth, tableau, tableau.name

    def settings(self) -> Iterable[float]:
        """A frame's time and its halves."""
        return _steps(self.case)

    def run(self, setting: float) -> Motion:
        """See `Runner`."""
        case = self.case
        every = round(case.duration / case.frames / setting)
        path = self.smooth.rollout(
            case.q,
            case.v,
            case.ctrl,
            step=setting,
            steps=every * case.frames,
            every=every,
            method=self.tableau,
        )
        return Motion(path.q, path.v, int(np.sum(path.evaluations)))


class SmoothTolerances:
    """Adaptive steps of the smooth engine."""

    engine, knob = "smooth", "tolerance"

    def __init__(self, case: Case, smooth: Smooth, tableau: Tableau) -> None:
        self.case, self.smooth, self.tableau, self.method = case, smooth, tableau, tableau.name

    def settings(self) -> Iterable[float]:
        """Tolerances down to what doubles resolve."""
        return TOLERANCES

    def run(self, setting: float) -> Motion:
        """See `Runner`."""
        case = self.case
        path = self.smooth.integrate(
            case.q,
            case.v,
            case.times,
            case.ctrl,
            method=self.tableau,
            rtol=setting,
            atol=setting * case.scale,
        )
        return Motion(path.q, path.v, int(np.sum(path.evaluations)))


class Foreign:
    """A foreign solver on the compiled equations of motion: "scipy:..." or "torch:..." by tolerance."""

    knob = "tolerance"

    def __init__(self, case: Case, smooth: Smooth, name: str) -> None:
        self.engine, _, self.method = name.partition(":")
        self.case, self.problem, self.name = case, smooth.problem(case.ctrl), name

    def settings(self) -> Iterable[float]:
        """Tolerances that such solvers accept."""
        return TOLERANCES[:-2:2]

    def run(self, setting: float) -> Motion:
        """See `Runner`."""
        case = self.case
        y0 = np.concatenate([case.q, case.v, np.zeros(case.model.na)])
        s = solve(
            self.problem,
            (0.0, case.duration),
            y0,
            method=self.name,
            rtol=setting,
            atol=setting * case.scale,
            t_eval=case.times,
        )
        return _motion(case, s.y, s.stats.evaluations)


class MujocoSteps:
    """An integrator of MuJoCo, its loop in C."""

    engine, knob = "mujoco", "step"

    def __init__(self, case: Case, integrator: str) -> None:
        self.case, self.method = case, integrator
        self.model = deepcopy(case.model)
        self.model.opt.integrator = int(INTEGRATORS[integrator])
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)
        self.data = mujoco.MjData(self.model)

    def settings(self) -> Iterable[float]:
        """A frame's time and its halves."""
        return _steps(self.case)

    def run(self, setting: float) -> Motion:
        """See `Runner`."""
        case, model, data = self.case, self.model, self.data
        model.opt.timestep = setting
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = case.q, case.v
        if case.ctrl is not None:
            data.ctrl[:] = case.ctrl
        every = round(case.duration / case.frames / setting)
        q, v = np.full((case.frames + 1, model.nq), np.nan), np.full((case.frames + 1, model.nv), np.nan)
        q[0], v[0] = case.q, case.v
        with captured_warnings():
            for frame in range(1, case.frames + 1):
                mujoco.mj_step(model, data, every)
                q[frame], v[frame] = data.qpos, data.qvel
                if not np.isfinite(data.qvel).all():
                    break
        return Motion(q, v, every * case.frames * (4 if self.method == "rk4" else 1))


def _motion(case: Case, y: Array, evaluations: int) -> Motion:
    nq, nv = case.model.nq, case.model.nv
    states = np.full((case.frames + 1, y.shape[1]), np.nan)
    states[: len(y)] = y
    return Motion(states[:, :nq], states[:, nq : nq + nv], evaluations)


@dataclass(frozen=True)
class Row:
    """One point of the table.

    Attributes:
        engine, method, knob, setting: what ran; `setting` is a step [s] or a tolerance.
        error: global error; NaN where the motion did not reach its end.
        cpu_s: processor time of a run, the least of several [s].
        first_s: time of the first run of this method on the clock [s]: it includes compilation.
        evaluations: of the equations of motion.
    """

    engine: str
    method: str
    knob: str
    setting: float
    error: float
    cpu_s: float
    first_s: float
    evaluations: int


@dataclass(frozen=True, eq=False)
class Reference:
    """The motion that errors are measured against.

    Attributes:
        motion: states at the frames.
        uncertainty: its own error: largest difference to another method's at its tightest.
        source: what computed it, in words.
    """

    motion: Motion
    uncertainty: float
    source: str


def smooth_reference(case: Case, smooth: Smooth) -> Reference:
    """Verner's method of order 9 at its tightest tolerance; DOP853's tells how far to trust it."""
    rtol, atol = 1e-13, 1e-14 * case.scale
    motions = []
    for tableau in (TABLEAUS["verner98"], TABLEAUS["dop853"]):
        path = smooth.integrate(case.q, case.v, case.times, case.ctrl, method=tableau, rtol=rtol, atol=atol)
        motions.append(Motion(path.q, path.v, int(np.sum(path.evaluations))))
    if not motions[0].finite:
        raise EngineError(f"{case.name}: the reference did not reach the end of {case.duration} s")
    source = "smooth engine, verner98 at rtol = 1e-13; uncertainty by dop853"
    return Reference(motions[0], trajectory_error(case, motions[0], motions[1]), source)


def mujoco_reference(case: Case, step: float) -> Reference:
    """MuJoCo's RK4 at `step` / 4; twice that step tells how far to trust it."""
    runner = MujocoSteps(case, "rk4")
    finest, finer = runner.run(step / 4), runner.run(step / 2)
    source = f"MuJoCo, rk4 at {step / 4:.3g} s; uncertainty by twice that step"
    return Reference(finest, trajectory_error(case, finer, finest), source)


def trajectory_error(case: Case, motion: Motion, reference: Motion) -> float:
    """Largest difference over all frames of any rotation [rad] or translation [m] of a joint."""
    if not motion.finite:
        return float("nan")
    angle, length = difference(case.model, reference.q, motion.q)
    return float(max(angle.max(initial=0.0), length.max(initial=0.0)))


def runners(case: Case, smooth: Smooth | None, engines: Sequence[str]) -> list[Runner]:
    """All methods of the engines asked for: "smooth", "mujoco", "scipy", "torch".

    Raises:
        EngineError: an unknown engine.
    """
    found: list[Runner] = []
    for engine in engines:
        if engine == "mujoco":
            found += [MujocoSteps(case, name) for name in INTEGRATORS]
        elif engine not in ("smooth", "scipy", "torch"):
            known = ("smooth", "mujoco", "scipy", "torch")
            raise EngineError(unknown("engine", engine, known, where="a report"))
        elif smooth is None:
            continue
        elif engine == "smooth":
            found += [SmoothSteps(case, smooth, tableau) for tableau in TABLEAUS.values()]
            pairs = (tableau for tableau in TABLEAUS.values() if tableau.adaptive)
            found += [SmoothTolerances(case, smooth, tableau) for tableau in pairs]
        else:
            names = [f"scipy:{name}" for name in SCIPY] if engine == "scipy" else ["torch:dopri5"]
            found += [Foreign(case, smooth, name) for name in names]
    return found


def sweep(runner: Runner, error: Callable[[Motion], float], *, floor: float, budget_s: float) -> list[Row]:
    """Rows of one method from coarse to fine.

    They end where the error is at `floor` or no longer falls by rounding, where a run costs `budget_s`, and
    where one fails that is finer than one that did not.
    """
    rows: list[Row] = []
    first_s, stalled = 0.0, 0
    for n, setting in enumerate(runner.settings()):
        wall = time.perf_counter()
        motion, cpu = _timed(runner, setting)
        if n == 0:
            first_s = time.perf_counter() - wall
            motion, cpu = _timed(runner, setting)
        spent = cpu
        for _ in range(4):
            if spent > budget_s / 4:
                break
            again = _timed(runner, setting)[1]
            cpu, spent = min(cpu, again), spent + again
        e = error(motion)
        rows.append(
            Row(runner.engine, runner.method, runner.knob, setting, e, cpu, first_s, motion.evaluations)
        )
        best = min((row.error for row in rows[:-1] if np.isfinite(row.error)), default=np.inf)
        stalled = stalled + 1 if best < ROUNDING and e >= best else 0
        failed = not np.isfinite(e) and np.isfinite(best)
        if cpu > budget_s or e < floor or stalled == 2 or failed:
            break
    return rows


def _timed(runner: Runner, setting: float) -> tuple[Motion, float]:
    began = time.process_time()
    motion = runner.run(setting)
    return motion, time.process_time() - began


def smooth_or_none(model: mujoco.MjModel) -> tuple[Smooth | None, str]:
    """The smooth engine of a model, or None and why it has none."""
    found = constraints_of(model)
    if found:
        return None, f"the model has {', '.join(found)}"
    try:
        return compile_model(model), ""
    except EngineError as error:
        return None, str(error)
