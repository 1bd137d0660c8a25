"""Questions of several goals at once for the inverse-kinematics benchmark, ours and mink's answers."""

import os
import subprocess
import tempfile
import time
from contextlib import contextmanager
from pathlib import Path

import mujoco
import numpy as np
from figures import at_least, last_line, told
from pantograph.models import load_model
from pantograph.models.library import find
from pantograph.sim.ik import CenterOfMass, Pose, Position, solve
from pantograph.sim.ik.problem import Problem
from pantograph.sim.ik.space import Space
from rich.table import Table

HERE = Path(__file__).resolve().parent
TOLERANCE = 1e-6
QUESTIONS, SLOW_QUESTIONS = 200, 20
LIMBS = ("left_hand", "right_hand", "left_foot", "right_foot")
FEET = ("front_left_foot", "front_right_foot", "back_left_foot", "back_right_foot")


def families():
    """Name, model's name, sites whose points and whose poses are wanted, whether the centre of mass is."""
    yield "quadruped: four feet and the base's pose", "quadruped", FEET, ("imu",), False
    yield "puppet: hands, feet and centre of mass", "puppet", LIMBS, (), True
    yield "puppet: hands and centre of mass", "puppet", LIMBS[:2], (), True


def targets(model, points, poses, com, count):
    """Targets that random configurations near the start have: p (k, points, 3), X (k, poses, 4, 4), com."""
    rng, data = np.random.default_rng(5), mujoco.MjData(model)
    p, X, c = np.empty((count, len(points), 3)), np.tile(np.eye(4), (count, len(poses), 1, 1)), []
    low, high = model.jnt_range.T
    for k in range(count):
        q, v = model.qpos0.copy(), 0.3 * rng.normal(size=model.nv)
        v[:3] *= 0.2
        mujoco.mj_integratePos(model, q, v, 1.0)
        for j in np.flatnonzero(model.jnt_limited & (model.jnt_type >= 2)):
            q[model.jnt_qposadr[j]] = np.clip(q[model.jnt_qposadr[j]], low[j], high[j])
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        p[k] = [data.site(name).xpos for name in points]
        for i, name in enumerate(poses):
            X[k, i, :3, :3], X[k, i, :3, 3] = data.site(name).xmat.reshape(3, 3), data.site(name).xpos
        c.append(data.subtree_com[0].copy() if com else [])
    return p, X, np.array(c).reshape(count, -1)


def asked(points, poses, p, X, c):
    """The goals of one question."""
    goals = [Position(name, x) for name, x in zip(points, p, strict=True)]
    for name, x in zip(poses, X, strict=True):
        quat = np.empty(4)
        mujoco.mju_mat2Quat(quat, x[:3, :3].ravel())
        goals.append(Pose(name, x[:3, 3], quat))
    return goals + ([CenterOfMass(c)] if len(c) else [])


@contextmanager
def numpy_alone():
    """Without machine code."""
    kept, Problem.prepared = Problem.prepared, lambda self, **_: None
    try:
        yield
    finally:
        Problem.prepared = kept


def timed(model, questions):
    """Seconds (k,) of processor time, whether solved, and answers."""
    seconds, solved, q = [], [], []
    for goals in questions:
        begin = time.thread_time()
        solution = solve(model, goals)
        seconds.append(time.thread_time() - begin)
        solved.append(solution.solved)
        q.append(solution.q)
    return np.array(seconds), np.array(solved), np.array(q)


def away(model, q):
    """How far (k,) configurations are from the start, in all freedoms together."""
    d = np.empty(model.nv)
    out = []
    for x in q:
        mujoco.mj_differentiatePos(model, d, 1.0, model.qpos0, x)
        out.append(np.linalg.norm(d))
    return np.array(out)


def mink(python, model_name, model, points, poses, p, X, c):
    """mink's seconds, whether met, and answers; or a reason why not."""
    with tempfile.TemporaryDirectory() as folder:
        ask, answer = Path(folder) / "ask.npz", Path(folder) / "answer.npz"
        np.savez(ask, points=points, poses=poses, p=p, X=X, com=c, start=model.qpos0, tolerance=TOLERANCE)
        script = HERE / "peers" / "ik_goals.py"
        command = [python, script, find(model_name), ask, "0.5", answer]
        done = subprocess.run(
            command, capture_output=True, text=True, check=False, env={**os.environ, "OMP_NUM_THREADS": "1"}
        )
        if done.returncode:
            return f"absent: {last_line(done.stderr)}"
        data = np.load(answer)
        return data["seconds"], data["met"], data["q"]


def several(console, python):
    """Success, time and distance from the start: ours with and without machine code, and mink's."""
    table = Table(
        title=f"Several goals at once: {TOLERANCE:g} in every component, from the model's reference"
    )
    for column in ("goals", "solver", "questions", "solved", "median", "mean", "99 %", "away from the start"):
        table.add_column(column, justify="left" if column in ("goals", "solver") else "right")
    figures = []
    for name, model_name, points, poses, com in families():
        model = load_model(model_name)
        aims = targets(model, points, poses, com, QUESTIONS)
        questions = [asked(points, poses, *aim) for aim in zip(*aims, strict=True)]
        with numpy_alone():
            slow = timed(model, questions[:SLOW_QUESTIONS])
        for _ in range(200):  # until it pays to compile, as it would in use
            if Problem(model, questions[0], Space(model)).prepared(build=True) is not None:
                break
            solve(model, questions[0])
        quick = timed(model, questions)
        other = python if isinstance(python, str) else mink(python, model_name, model, points, poses, *aims)
        for solver, answer in (("Pantograph", quick), ("Pantograph, NumPy alone", slow), ("mink", other)):
            row = [name if solver == "Pantograph" else "", solver]
            if isinstance(answer, str):
                table.add_row(*row, answer)
                continue
            ms, solved = 1e3 * answer[0], answer[1]
            times = [f"{x:.2f} ms" for x in (np.median(ms), ms.mean(), np.percentile(ms, 99))]
            far = away(model, answer[2]).mean()
            table.add_row(*row, str(len(ms)), f"{100 * solved.mean():.1f} %", *times, f"{far:.2f}")
        figures += [
            at_least(f"{name}: solved", quick[1].mean(), 1.0, "share"),
            told(f"{name}: median time", 1e3 * np.median(quick[0]), "ms"),
            told(f"{name}: NumPy over ours, median", np.median(slow[0]) / np.median(quick[0]), "ratio"),
        ]
        if not isinstance(other, str):
            ratio = np.median(other[0]) / np.median(quick[0])
            figures.append(at_least(f"{name}: mink over ours, median", ratio, 1.0, "ratio"))
    console.print(table)
    return figures
