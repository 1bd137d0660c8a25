"""Inverse kinematics: speed beside mink and pink, verdicts against known truths, motion, closed loops.

`make bench NAME=ik`, or `python tests/bench/ik.py [part ...]` with parts protocol, goals,
verdicts, motion, loops.
"""

import os
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE), str(HERE.parent)]

import mujoco  # noqa: E402
import numpy as np  # noqa: E402
from arms import bare, panda, ur5  # noqa: E402
from figures import at_least, at_most, environment, last_line, main, told  # noqa: E402
from ik_clock import clocked, spin  # noqa: E402
from ik_goals import several  # noqa: E402
from oracles import ik_cases, ik_loops  # noqa: E402
from oracles.ik_motions import figure_eight, walk, wrist_arm  # noqa: E402
from pantograph.models import data_robots, load_model  # noqa: E402
from pantograph.sim.ik import ChainSolver, Follower, Loops, follow, lock, solve  # noqa: E402
from pantograph.sim.kinematics import frame  # noqa: E402
from rich.progress import track  # noqa: E402
from rich.table import Table  # noqa: E402

BUDGET = 5e-3  # [s], of the TRAC-IK protocol; of processor time, so that other work does not count
TOLERANCE = 1e-5
RANDOM_TARGETS, PEER_TARGETS, CASES = 10_000, 200, 1000
PACKAGES = ("mink", "pin-pink", "daqp", "qpsolvers", "mujoco>=4")


# Targets.


def questions():
    """Arms with targets: name, model with one chain to `tip`, R (k, 3, 3), p (k, 3), the configurations."""
    folder = next((p.parents[2] / "references" for p in data_robots().values()), None)
    model = panda()
    if folder is not None and (folder / "panda_targets.csv").is_file():
        rows = np.loadtxt(folder / "panda_targets.csv", delimiter=",", comments="#")
        yield "Panda, given targets", model, rows[:, :9].reshape(-1, 3, 3), rows[:, 9:12]
    else:
        yield "Panda, random targets", model, *random_targets(model, 2000)
    yield "UR5", ur5(), *random_targets(ur5(), RANDOM_TARGETS)
    if "wx250s" in data_robots():
        arm = bare(frame(load_model("wx250s"), "body", "wx250s/gripper_link"), load_model("wx250s"))
        yield "wx250s", arm, *random_targets(arm, RANDOM_TARGETS)


def random_targets(model, k):
    q = np.random.default_rng(12).uniform(*model.jnt_range.T, (k, model.nq))
    X = frame(model, "site", "tip").pose(q)
    return X[:, :3, :3], X[:, :3, 3]


def worst_error(model, q, R, p):
    """Largest component of position and rotation error, by MuJoCo's own kinematics."""
    data, worst = mujoco.MjData(model), np.zeros(len(q))
    for i, x in enumerate(q):
        data.qpos[:] = x
        mujoco.mj_kinematics(model, data)
        E = data.site("tip").xmat.reshape(3, 3) @ R[i].T
        quat, turn = np.empty(4), np.empty(3)
        mujoco.mju_mat2Quat(quat, E.ravel())
        mujoco.mju_quat2Vel(turn, quat, 1.0)
        worst[i] = max(np.abs(data.site("tip").xpos - p[i]).max(), np.abs(turn).max())
    return worst


# The TRAC-IK protocol.


def ours(model, R, p, rounds=3):
    """Times, answers (k, n) and whether they are right; the median round."""
    arm = ChainSolver(model, "tip")
    for i in range(20):
        arm(R[i], p[i], tolerance=TOLERANCE)
    runs = []
    for _ in range(rounds):
        q = np.empty((len(p), model.nq))

        def one(i, q=q):
            q[i] = arm(R[i], p[i], tolerance=TOLERANCE, most=20_000).q[0]

        runs.append((clocked(partial(one, i) for i in track(range(len(p)), "our solver", transient=True)), q))
    times, q = sorted(runs, key=lambda run: run[0].processor.mean())[rounds // 2]
    low, high = model.jnt_range.T
    right = (worst_error(model, q, R, p) <= TOLERANCE * (1 + 1e-9)) & ((q >= low) & (q <= high)).all(axis=1)
    return times, right


def plain(model, R, p, budget):
    """A plain damped least squares on MuJoCo's Jacobian with random restarts, in Python."""
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    low, high = model.jnt_range.T
    J, seconds, met = np.empty((6, model.nv)), np.empty(len(p)), np.zeros(len(p), dtype=bool)
    site, quat, turn = data.site("tip"), np.empty(4), np.empty(3)
    for i in range(len(p)):
        begin = time.thread_time()
        q, best, stalled = 0.5 * (low + high), np.inf, 0
        while True:
            data.qpos[:] = q
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            mujoco.mju_mat2Quat(quat, (site.xmat.reshape(3, 3) @ R[i].T).ravel())
            mujoco.mju_quat2Vel(turn, quat, 1.0)
            e = np.concatenate([site.xpos - p[i], turn])
            error, seconds[i] = np.abs(e).max(), time.thread_time() - begin
            if error <= TOLERANCE or seconds[i] > budget:
                break
            best, stalled = (error, 0) if error < 0.9 * best else (best, stalled + 1)
            if stalled >= 10:
                q, best, stalled = rng.uniform(low, high), np.inf, 0
                continue
            mujoco.mj_jacSite(model, data, J[:3], J[3:], site.id)
            q = np.clip(q - J.T @ np.linalg.solve(J @ J.T + (1e-6 + 1e-2 * e @ e) * np.eye(6), e), low, high)
        met[i] = error <= TOLERANCE and seconds[i] <= budget
    return seconds, met


def peer(python, name, model, R, p, budget, folder):
    """Seconds and successes of mink or pink in their own environment; a sentence when it cannot be had."""
    if isinstance(python, str):
        return python
    path, targets, result = folder / "arm.xml", folder / "targets.npz", folder / f"{name}.npz"
    mujoco.mj_saveLastXML(str(path), model) if not path.is_file() else None
    np.savez(targets, R=R, p=p, tolerance=TOLERANCE)
    command = [python, HERE / "peers" / "ik_peers.py", name, path, targets]
    done = subprocess.run([*command, str(budget * 1e3), result], capture_output=True, text=True, check=False)
    if done.returncode:
        return f"absent: {last_line(done.stderr)}"
    data = np.load(result)
    return data["seconds"], data["met"]


def protocol(console):
    """Success within the budget, mean and 99th percentile of time, ours and peers on the same targets."""
    import tempfile

    python = environment("ik", *PACKAGES)
    table = Table(
        title=f"TRAC-IK protocol: {TOLERANCE:g} in every component, from mid-range, {BUDGET * 1e3:g} ms"
    )
    for column in (
        "arm",
        "solver",
        "targets",
        "solved in 5 ms",
        "mean",
        "median",
        "99 %",
        "solved in 100 ms",
    ):
        table.add_column(column, justify="left" if column in ("arm", "solver") else "right")
    figures = []
    for name, model, R, p in questions():
        times, right = ours(model, R, p)
        seconds, left = times.processor, ~times.taken
        us, met = seconds * 1e6, right & (seconds <= BUDGET)
        table.add_row(name, "Pantograph", str(len(p)), f"{100 * met.mean():.3f} %", f"{us.mean():.1f} us",
                      f"{np.median(us):.1f} us", f"{np.percentile(us, 99):.1f} us",
                      f"{100 * right.mean():.3f} %")  # fmt: skip
        on_time = right & (times.wall <= BUDGET)
        idle = clocked([partial(spin, np.median(seconds))] * len(p))
        figures += [
            at_least(f"{name}: solved in 5 ms", met.mean(), 0.9999, "share"),
            at_most(f"{name}: mean time", us.mean(), 100, "us"),
            at_most(f"{name}: 99th percentile", np.percentile(us, 99), 1000, "us"),
            at_least(f"{name}: solved in 5 ms of wall clock, processor left to it", on_time[left].mean(),
                     0.9999, "share"),
            told(f"{name}: solved in 5 ms of wall clock", on_time.mean(), "share"),
            told(f"{name}: as much idling done in 5 ms of wall clock", (idle.wall <= BUDGET).mean(), "share"),
        ]  # fmt: skip
        few = slice(0, PEER_TARGETS)
        s, m = plain(model, R[few], p[few], BUDGET)
        _, late = plain(model, R[few], p[few], 0.1)
        rows = [("damped least squares", (s, m), late)]
        with tempfile.TemporaryDirectory() as folder:
            (Path(folder) / "arm.xml").write_text(model_xml(model))
            for solver in ("mink", "pink"):
                quick = peer(python, solver, model, R[few], p[few], BUDGET, Path(folder))
                slow = (
                    quick
                    if isinstance(quick, str)
                    else peer(python, solver, model, R[few], p[few], 0.1, Path(folder))
                )
                rows.append(
                    (
                        solver,
                        slow if isinstance(slow, str) else quick,
                        None if isinstance(slow, str) else slow,
                    )
                )
        for solver, quick, slow in rows:
            if isinstance(quick, str):
                table.add_row("", solver, quick)
                continue
            t, m = quick
            t_late, m_late = (t, slow) if isinstance(slow, np.ndarray) else slow
            us = t_late * 1e6
            table.add_row("", solver, str(len(t)), f"{100 * m.mean():.1f} %", f"{us.mean():.0f} us",
                          f"{np.median(us):.0f} us", f"{np.percentile(us, 99):.0f} us",
                          f"{100 * m_late.mean():.1f} %")  # fmt: skip
            figures.append(told(f"{name}: {solver} solved in 5 ms", m.mean(), "share"))
            figures.append(
                told(f"{name}: {solver} mean over ours", us.mean() / (seconds.mean() * 1e6), "ratio")
            )
    console.print(table)
    return figures


def model_xml(model):
    """The bare arm as MJCF: the same file for every peer."""
    spec = bare_spec(model)
    spec.compile()
    return spec.to_xml()


def bare_spec(model):
    from arms import chain_spec

    return chain_spec(frame(model, "site", "tip"), model)


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


# Along time.


def motion(console):
    """A walk with locked feet, and a figure-eight through a wrist singularity."""
    puppet, times = load_model("puppet"), np.arange(0, 3, 1 / 60)
    stances = {"left_foot": [(0.2, 0.5), (1.2, 1.5), (2.2, 2.5)], "right_foot": [(0.7, 1.0), (1.7, 2.0)]}
    begin = time.thread_time()
    locked = lock(puppet, times, walk(puppet, times), stances)
    spent = time.thread_time() - begin
    slip = 0.0
    for foot, spans in stances.items():
        places = frame(puppet, "site", foot).pose(locked.q)[:, :3, 3]
        for start, end in spans:
            on = (times >= start) & (times <= end)
            slip = max(slip, float(np.linalg.norm(places[on] - places[on][0], axis=1).max()))
    figures = [at_most("locked foot: largest slip", 1e3 * slip, 0.1, "mm"),
               told("locked feet: time a frame", 1e3 * spent / len(times), "ms")]  # fmt: skip
    arm = wrist_arm()
    q, goals = figure_eight(arm)
    dt, speed, effort = 0.01, 2.0, 30.0
    f = frame(arm, "site", "tip")
    follower = Follower(arm, dt=dt, q0=q, velocity=speed, acceleration=effort)
    worst_v = worst_a = far = untold = 0.0
    before, begin = np.zeros(arm.nv), time.thread_time()
    for k in range(800):
        tick = follower.step(goals(k * dt))
        true = float(np.linalg.norm(f.pose(tick.q)[:3, 3] - goals(k * dt)[0].position))
        untold = max(untold, abs(true - tick.residuals[0].position))
        worst_v = max(worst_v, float(np.abs(tick.v).max()))
        worst_a = max(worst_a, float(np.abs(tick.v - before).max()) / dt)
        before, far = tick.v, max(far, true)
    each = (time.thread_time() - begin) / 800
    begin = time.thread_time()
    whole = follow(arm, goals, np.arange(0, 4, dt), q0=q, velocity=speed, acceleration=effort)
    spent = time.thread_time() - begin
    steps = np.diff(whole.q, axis=0) / dt
    figures += [
        at_most("figure-eight live: joint speed over its limit", worst_v / speed, 1 + 1e-9, "ratio"),
        at_most("figure-eight live: acceleration over its limit", worst_a / effort, 1 + 1e-6, "ratio"),
        at_most("figure-eight live: deviation not reported", untold, 1e-9, "m"),
        told("figure-eight live: largest deviation", 1e3 * far, "mm"),
        told("figure-eight live: time a tick", 1e3 * each, "ms"),
        at_most("figure-eight whole: joint speed over its limit", np.abs(steps).max() / speed, 1 + 1e-9,
                "ratio"),
        at_most("figure-eight whole: acceleration over its limit",
                np.abs(np.diff(steps, axis=0)).max() / dt / effort, 1 + 1e-6, "ratio"),
        told("figure-eight whole: largest deviation", 1e3 * whole.position.max(), "mm"),
        told("figure-eight whole: time", spent, "s"),
    ]  # fmt: skip
    return figures


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
