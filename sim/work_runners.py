"""Engines and methods on free motion, by steps and by tolerances, and the references they are judged by."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from copy import deepcopy

import mujoco
import numpy as np

from ..models import captured_warnings
from .dynamics.smooth import Smooth, compile_model
from .engines.contact import INTEGRATORS
from .errors import EngineError, unknown
from .integrate import TABLEAUS, Tableau, solve
from .integrate.problems import constraints_of
from .work_precision import TOLERANCES, Array, Case, Motion, Reference, Runner, sure_until, trajectory_error

ENGINES = ("smooth", "mujoco", "scipy", "torch")
"""What a report can compare."""
FOREIGN = {"scipy": ("scipy:DOP853", "scipy:Radau", "scipy:LSODA"), "torch": ("torch:dopri5", "torch:dopri8")}
"""Solvers that we did not write, by library."""


def check_engines(engines: Sequence[str]) -> None:
    """Raise EngineError for an engine that no report knows, and for torch where it is missing."""
    for engine in engines:
        if engine not in ENGINES:
            raise EngineError(unknown("engine", engine, ENGINES, where="a report"))
    if "torch" in engines:
        try:
            import torchdiffeq  # noqa: F401
        except ImportError as missing:
            raise EngineError(
                f"engine 'torch' needs torchdiffeq: pip install 'pantograph-sim[torch]' ({missing})"
            ) from missing


def _steps(case: Case) -> list[float]:
    return [case.duration / case.frames / 2**k for k in range(15)]


class SmoothSteps:
    """Fixed steps of the smooth engine."""

    engine, knob = "smooth", "step"

    def __init__(self, case: Case, smooth: Smooth, tableau: Tableau) -> None:
        self.case, self.smooth, self.tableau, self.method = case, smooth, tableau, tableau.name
        self.order = tableau.order

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

    engine, knob, order = "smooth", "tolerance", 1

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

    knob, order = "tolerance", 1

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
        # at contacts and limits no method keeps its order
        self.order = 4 if integrator == "rk4" and not constraints_of(case.model) else 1
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
    unsure = trajectory_error(case, motions[0], motions[1])
    return Reference(motions[0], unsure, source, sure_until(case, *motions))


def mujoco_reference(case: Case, step: float) -> Reference:
    """MuJoCo's RK4 at `step` / 4; twice that step tells how far to trust it."""
    runner = MujocoSteps(case, "rk4")
    finest, finer = runner.run(step / 4), runner.run(step / 2)
    source = f"MuJoCo, rk4 at {step / 4:.3g} s; uncertainty by twice that step"
    unsure = trajectory_error(case, finer, finest)
    return Reference(finest, unsure, source, sure_until(case, finest, finer))


def runners(case: Case, smooth: Smooth | None, engines: Sequence[str]) -> list[Runner]:
    """All methods of the engines asked for, those of MuJoCo alone where there is no smooth engine."""
    found: list[Runner] = []
    for engine in engines:
        if engine == "mujoco":
            found += [MujocoSteps(case, name) for name in INTEGRATORS]
        elif smooth is None:
            continue
        elif engine == "smooth":
            found += [SmoothSteps(case, smooth, tableau) for tableau in TABLEAUS.values()]
            pairs = (tableau for tableau in TABLEAUS.values() if tableau.adaptive)
            found += [SmoothTolerances(case, smooth, tableau) for tableau in pairs]
        else:
            found += [Foreign(case, smooth, name) for name in FOREIGN[engine]]
    return found


def smooth_or_none(model: mujoco.MjModel) -> tuple[Smooth | None, str]:
    """The smooth engine of a model, or None and why it has none."""
    found = constraints_of(model)
    if found:
        return None, f"the model has {', '.join(found)}"
    try:
        return compile_model(model), ""
    except EngineError as error:
        return None, str(error)
