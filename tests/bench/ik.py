"""Inverse kinematics: speed beside mink and pink, verdicts against known truths, motion, closed loops.

`make bench NAME=ik`, or `python tests/bench/ik.py [part ...]` with parts protocol, goals,
verdicts, motion, loops.
"""

import os
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from figures import at_most, environment, main, told  # noqa: E402
from ik_goals import several  # noqa: E402
from ik_motion import motion  # noqa: E402
from ik_protocol import PACKAGES, protocol  # noqa: E402
from oracles import ik_cases, ik_loops  # noqa: E402
from pantograph.sim.ik import Loops, solve  # noqa: E402
from rich.progress import track  # noqa: E402
from rich.table import Table  # noqa: E402

CASES = 1000


# Verdicts.

FAMILIES = {"reachable": ik_cases.REACHABLE, "out of reach": ik_cases.BEYOND,
            "beyond a limit": ik_cases.LIMITED, "conflict": ik_cases.CONFLICT}  # fmt: skip


def judge(job):
    """Mistakes of one case, the seconds, and whether a negative verdict is proved."""
    group, index = job
    families = FAMILIES[group]
    rng = np.random.default_rng([index, *group.encode()])
    case = families[index % len(families)](rng)
    begin = time.thread_time()
    solution = solve(case.model, case.goals)
    seconds = time.thread_time() - begin
    return case.family, ik_cases.mistakes(case, solution), seconds, solution.verdict.proved


def verdicts(console):
    """A thousand questions of each kind whose truth is known by construction."""
    table = Table(title="Verdicts")
    for column in ("truth", "cases", "wrong", "proved", "median", "slowest"):
        table.add_column(column, justify="right")
    figures, total = [], 0
    with ProcessPoolExecutor(max_workers=os.cpu_count()) as pool:
        for group in FAMILIES:
            jobs = [(group, i) for i in range(CASES)]
            answers = list(track(pool.map(judge, jobs, chunksize=10), group, total=CASES, transient=True))
            wrong = [a for a in answers if a[1]]
            for family, mistakes, *_ in wrong[:5]:
                console.print(f"wrong: {family}: {'; '.join(mistakes)}")
            times = np.array([a[2] for a in answers])
            total += len(wrong)
            proved = np.mean([a[3] for a in answers])
            table.add_row(group, str(CASES), str(len(wrong)), f"{100 * proved:.1f} %",
                          f"{np.median(times) * 1e3:.0f} ms", f"{times.max() * 1e3:.0f} ms")  # fmt: skip
            figures.append(told(f"wrong verdicts, {group}", len(wrong), f"of {CASES}"))
    console.print(table)
    return [*figures, at_most("wrong verdicts", total / (CASES * len(FAMILIES)), 1e-3 * (1 - 1e-9), "share")]


# Closed loops.


def loops(console):
    """A four-bar and a Stewart platform closed from random starts; openings by MuJoCo's own constraints."""
    rng = np.random.default_rng(0)
    bar, (plate, _) = ik_loops.four_bar(), ik_loops.stewart()
    figures = []
    for name, model, count in (("four-bar", bar, 1000), ("Stewart platform", plate, 300)):
        closing, data, worst, spent = Loops(model), mujoco.MjData(model), 0.0, 0.0
        for _ in range(count):
            q = model.qpos0.copy()
            held = np.zeros(model.nv, dtype=bool)
            if model is bar:
                q[0] = rng.uniform(-np.pi, np.pi)
                q[1:] = ik_loops.four_bar_angles(q[0])[0] + 0.2 * rng.normal(size=2)
                held[0] = True
            else:
                q[:3] += 0.1 * rng.normal(size=3)
                mujoco.mju_axisAngle2Quat(q[3:7], ik_cases.unit(rng), 0.3 * rng.normal())
                held[:6] = True
            begin = time.thread_time()
            found = closing.project(q, held=held)
            spent += time.thread_time() - begin
            data.qpos[:] = found.q
            mujoco.mj_forward(model, data)
            worst = max(worst, float(np.abs(data.efc_pos[: data.ne]).max()))
        figures.append(at_most(f"{name}: largest opening", worst, 1e-12, "m"))
        figures.append(told(f"{name}: time", 1e3 * spent / count, "ms"))
    return figures


def goals(console):
    """Several goals at once beside mink."""
    return several(console, environment("ik", *PACKAGES))


PARTS = {"motion": motion, "loops": loops, "goals": goals, "protocol": protocol, "verdicts": verdicts}


if __name__ == "__main__":
    sys.exit(main("ik", PARTS))
