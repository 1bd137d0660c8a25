"""What an error costs against MuJoCo, and how errors fall with the step."""

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from figures import absent, at_least, ratio, told
from mujoco.rollout import rollout
from pantograph.sim.accuracy import difference
from pantograph.sim.dynamics import compile_model
from pantograph.sim.integrate import TABLEAUS
from rich.progress import track

sys.path.insert(0, str(Path(__file__).resolve().parents[2]))
from oracles.mujoco_motion import motion

from . import models
from .clock import alternating

SPAN, FRAMES = 5.0, 50  # of the motions whose error is bought [s]; where every engine's error is looked at
TARGETS = {  # bars of the ratios of CPU time, by error [rad]; None: told
    "double_pendulum": {1e-6: 80, 1e-9: None},
    "ur5": {1e-6: 30, 1e-9: 40},
    "quadruped": {1e-6: None},
}
STEPS = FRAMES * np.unique(np.round(2.0 ** np.arange(0, 11.01, 0.125)).astype(int))  # tried by every engine
TOLERANCES = 10.0 ** np.arange(-3, -13.01, -0.25)
FINALISTS, ROUNDS = 3, 15


@dataclass(frozen=True)
class Setting:
    """One way to the motion: its error [rad], evaluations, and CPU time [s] by a quick look."""

    label: str
    call: Callable[[], object]
    error: float
    evaluations: int
    seconds: float


def to_an_error(console):
    """CPU time to a largest error over the trajectory: every method at its best step or tolerance.

    A quick sweep finds each side's finalists, which are then timed in turn; as called from Python.
    """
    for name, bars in track(TARGETS.items(), "CPU time to an error", console=console):
        model = models.stripped(models.load(name))
        smooth = compile_model(model)
        q, v = models.bent(model), np.zeros(model.nv)
        if (model.jnt_type == mujoco.mjtJoint.mjJNT_FREE).any():
            v = np.linspace(-1.0, 2.0, model.nv)  # what falls freely from rest does not move in itself
        times = np.linspace(0.0, SPAN, FRAMES + 1)
        exact = motion(model, q, v, times, rtol=1e-13, atol=1e-13)
        check = smooth.integrate(q, v, times, method=TABLEAUS["verner98"], rtol=1e-13, atol=1e-13)
        unsure = _error(model, check.q, exact)
        tightest = min(bars)
        ours = list(_ours(model, smooth, q, v, times, exact, tightest))
        theirs, left_out = _mujocos(model, q, v, exact, tightest)
        for target, bar in bars.items():
            title = f"CPU time of MuJoCo over ours to an error of {target:g}, {name}"
            sides = [_finalists(ours, target), _finalists(theirs, target)]
            if not all(sides):
                yield absent(title, f"not reached; reference sure to {unsure:.0e}")
                continue
            timed = alternating({s.label: s.call for side in sides for s in side}, ROUNDS)
            fast, slow = (min(side, key=lambda s: np.median(timed[s.label])) for side in sides)
            r, spread = ratio(timed, slow.label, fast.label)
            detail = f"{spread}; {_said(slow, timed)}; {_said(fast, timed)}; reference: SciPy's DOP853 on "
            detail += f"mj_forward, {unsure:.0e} from ours; {left_out}"
            yield at_least(title, r, bar, "x", detail) if bar else told(title, r, "x", detail)


def _said(setting, timed):
    seconds = np.median(timed[setting.label])
    text = f"{setting.label}: {1e3 * seconds:.3g} ms, {setting.evaluations} evaluations"
    return text + f", error {setting.error:.1e}"


def _finalists(settings, target):
    good = [s for s in settings if s.error <= target]
    return sorted(good, key=lambda s: s.seconds)[:FINALISTS]


def _error(model, q, exact):
    return float(difference(model, exact, q)[0].max())


def _quick(call):
    """Result and CPU seconds, the least of three runs."""
    best = np.inf
    for _ in range(3):
        begin = time.process_time()
        out = call()
        best = min(best, time.process_time() - begin)
        if best > 0.05:
            break
    return out, best


def _ours(model, smooth, q, v, times, exact, tightest):
    for name, method in TABLEAUS.items():
        ways = []
        if method.order > 2:
            for n in map(int, STEPS):
                words = {"step": SPAN / n, "steps": n, "every": n // FRAMES, "method": method}
                ways.append((f"{name}, {n} steps", lambda w=words: smooth.rollout(q, v, **w)))
        if method.adaptive and method.order > 3:
            for tol in TOLERANCES:
                words = {"method": method, "rtol": tol, "atol": tol}
                ways.append((f"{name} to {tol:.1e}", lambda w=words: smooth.integrate(q, v, times, **w)))
        met = False
        for label, call in ways:
            if met and label.endswith("steps"):
                continue
            path, seconds = _quick(call)
            error = _error(model, path.q, exact)
            met = met or (error <= tightest and label.endswith("steps"))
            yield Setting(label, call, error, int(np.sum(path.evaluations)), seconds)


def _mujocos(model, q, v, exact, tightest):
    """Settings of MuJoCo's integrators, and in words which of them do not come near."""
    out, poor = [], []
    start = np.concatenate([[0.0], q, v])[None]
    for integrator in ("EULER", "IMPLICIT", "IMPLICITFAST", "RK4", "DISCRETE"):
        stages = 4 if integrator == "RK4" else 1

        def way(n, integrator=integrator, stages=stages):
            data = mujoco.MjData(model)

            def call():
                model.opt.integrator = int(getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}"))
                model.opt.timestep = SPAN / n
                return rollout(model, data, start, nstep=n, control=None)[0]

            states, seconds = _quick(call)
            path = np.concatenate([q[None], states[0, n // FRAMES - 1 :: n // FRAMES, 1 : 1 + model.nq]])
            label = f"MuJoCo {integrator}, {n} steps"
            return Setting(label, call, _error(model, path, exact), stages * n, seconds)

        finest = way(int(STEPS[-1]))
        if not finest.error <= max(TARGETS["ur5"]):
            poor.append(f"{integrator} {finest.error:.0e}")
            continue
        for n in map(int, STEPS):
            out.append(way(n))
            if out[-1].error <= tightest:
                break
    return out, f"at {STEPS[-1]} steps MuJoCo's {', '.join(poor)}" if poor else ""


# ---- orders

BELOW = (
    0.3  # that a slope may lie below its order; above it, methods of high order are until errors are rounding
)
STARTS = 16  # motions whose median error is looked at
MOTIONS = {"hinges": ("ur5", 1.0), "ball joints": ("3 ball joints", 0.25), "a free tree": ("quadruped", 1.0)}


def orders(console):
    """Slopes of the error over the step of each method: hinges, ball joints, a free tree."""
    for kind, (name, seconds) in MOTIONS.items():
        model = models.stripped(models.load(name))
        smooth = compile_model(model)
        q, v, _, _ = models.states(model, STARTS, spread=0.5)
        exact = _ends(smooth, q, v, seconds, 3000, TABLEAUS["verner98"])
        for i in range(2):
            true = motion(model, q[i], v[i], np.array([0.0, seconds]), rtol=1e-13, atol=1e-13)[-1]
            unsure = _error(model, exact[i : i + 1], true[None])
            if unsure > 1e-10:
                raise RuntimeError(f"{name}: the reference is {unsure:.0e} from SciPy's on mj_forward")
        for method in track(list(TABLEAUS.values()), f"orders on {kind}", console=console):
            rows = []
            for n in np.unique(np.round(2.0 ** np.arange(1, 12.01, 0.5)).astype(int)):
                apart = difference(model, _ends(smooth, q, v, seconds, int(n), method), exact)[0]
                rows.append((seconds / n, np.median(apart)))
            h, error = np.array([row for row in rows if 1e-11 < row[1] < 0.1][-6:]).T
            slope = float(np.polyfit(np.log(h), np.log(error), 1)[0])
            detail = f"median errors of {STARTS} motions {error[0]:.1e} to {error[-1]:.1e} rad"
            yield at_least(f"order of {method.name} on {kind}", slope, method.order - BELOW, "", detail)


def _ends(smooth, q, v, seconds, n, method):
    return smooth.rollout(q, v, step=seconds / n, steps=n, every=n, method=method).q[:, -1]
