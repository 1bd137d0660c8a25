"""Pantograph's Python integrators against SciPy's and torchdiffeq's: same problem, same error, same f.

Compiled loops are measured by `smooth`; here it is the price of the front door itself, which integrates what
cannot be compiled: user functions, events, Python controllers.
"""

from __future__ import annotations

import statistics
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
from figures import Figure, absent, at_least, main
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1]))
from oracles import pendulum
from oracles.rigid_body import FreeBody
from pantograph.sim.hard_cases import HARD_CASES
from pantograph.sim.integrate import ODE, Solution, mujoco_problem, solve

TOLERANCES = 10.0 ** -np.arange(3.0, 13.5, 0.25)
TARGETS = (1e-5, 1e-6, 1e-7, 1e-8, 1e-9, 1e-10)
ROUNDS = 3
RIVALS = {"dopri5": "scipy:RK45", "dop853": "scipy:DOP853", "verner98": "scipy:DOP853"}
BAR = 1.0

Error = Callable[[Solution], float]


def cases() -> dict[str, tuple[object, tuple[float, float], np.ndarray, Error]]:
    """Problem, span, start and error of each case."""
    swing = ODE(lambda t, y: np.array([y[1], -9.81 * np.sin(y[0])]), 2)
    swing_end = pendulum.swing([10.0], 2.0)[0]
    tumbling = next(case for case in HARD_CASES if case.name == "tumbling body")
    model = tumbling.case().model
    rates = FreeBody([0.80833333, 0.68333333, 0.14166667], tumbling.v).omega([10.0])[0]
    double = next(case for case in HARD_CASES if case.name == "double pendulum for 10 s").case()
    double_end = np.array(next(c for c in HARD_CASES if c.name == double.name).expected)
    return {
        "pendulum, f in numpy": (
            swing, (0, 10), np.array([2.0, 0.0]), lambda s: float(np.abs(s.y[-1] - swing_end).max()),
        ),
        "double pendulum, f by mj_forward": (
            mujoco_problem(double.model), (0, 10), np.concatenate([double.q, double.v]),
            lambda s: float(np.abs(s.y[-1, :2] - double_end).max()),
        ),
        "tumbling body, quaternions, f by mj_forward": (
            mujoco_problem(model), (0, 10), np.array([1.0, 0, 0, 0, *tumbling.v]),
            lambda s: float(np.abs(s.y[-1, 4:] - rates).max()),
        ),
    }  # fmt: skip


def curve(problem, span, y0, error: Error, method: str) -> list[tuple[float, float, int]]:
    """(tolerance, error, evaluations) from loose to tight."""
    rows = []
    for rtol in TOLERANCES:
        solution = solve(problem, span, y0, method=method, rtol=rtol)
        rows.append((rtol, error(solution) if solution.success else np.inf, solution.stats.evaluations))
    return rows


def cpu(problem, span, y0, method: str, rtol: float) -> float:
    began = time.process_time()
    solve(problem, span, y0, method=method, rtol=rtol)
    return time.process_time() - began


def duel(case, method: str, peer: str) -> tuple[list[float], list[float], list[float]]:
    """Ratios peer/ours of CPU time (each a median of alternating rounds) and of evaluations, by target."""
    problem, span, y0, error = case
    curves = [curve(problem, span, y0, error, name) for name in (method, peer)]
    ratios, work, times = [], [], []
    for target in TARGETS:
        ours, theirs = (next((row for row in rows if row[1] <= target), None) for rows in curves)
        if ours is None or theirs is None:
            continue
        rounds = [
            (cpu(problem, span, y0, method, ours[0]), cpu(problem, span, y0, peer, theirs[0]))
            for _ in range(ROUNDS)
        ]
        ratios.append(statistics.median(b / a for a, b in rounds))
        times.append(statistics.median(a for a, _ in rounds))
        work.append(theirs[2] / ours[2])
    return ratios, work, times


def duels(console: Console) -> Iterator[Figure]:
    """Peer's CPU time over ours: geometric mean over the targets that both reach."""
    for name, case in cases().items():
        for method, peer in RIVALS.items():
            title = f"{name}: CPU time of {peer} over {method}"
            ratios, work, times = duel(case, method, peer)
            if len(ratios) < len(TARGETS):
                yield absent(title, f"{len(ratios)} of {len(TARGETS)} errors reached")
                continue
            detail = f"mean of errors {TARGETS[0]:g} to {TARGETS[-1]:g}, ratios {min(ratios):.2f} to "
            detail += f"{max(ratios):.2f}; evaluations {statistics.geometric_mean(work):.2f} times ours; "
            detail += f"ours {1e3 * times[0]:.3g} to {1e3 * times[-1]:.3g} ms"
            yield at_least(title, statistics.geometric_mean(ratios), BAR, "x", detail)


if __name__ == "__main__":
    sys.exit(main("integrators", {"duels": duels}))
