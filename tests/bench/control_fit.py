"""The fitting half of `make bench NAME=control`: retiming against toppra, motion fitted to machines."""

import json
import subprocess
import time
from pathlib import Path

import numpy as np
from figures import Figure, absent, at_least, at_most, environment, last_line, told
from pantograph.controllers.fit import check, fit, machine, prove, retime
from pantograph.controllers.fit.task import task_of
from pantograph.models import ModelError, load_model
from pantograph.sim.clip import Clip
from pantograph.sim.curves import keyed
from pantograph.sim.scene.load import load_scene
from rich.console import Console
from rich.progress import track

PATHS, KEYS, SECONDS = 100, 6, 4.0
POINTS = (250, 1000)
SPEED, BEND, JERK = 3.0, 10.0, 100.0  # rad/s, rad/s^2, rad/s^3
NO_ROBOT = "no wx250s here (set PANTOGRAPH_DATA)"
SCENES = Path(__file__).parents[2] / "models" / "scenes"


def peer(job: dict) -> list | str:
    """toppra's results, installed into an environment of its own; a sentence when it cannot be."""
    python = environment("toppra", "toppra")
    if isinstance(python, str):
        return python
    script = Path(__file__).with_name("toppra_peer.py")
    done = subprocess.run(
        [str(python), str(script)], input=json.dumps(job), capture_output=True, text=True, check=False
    )
    return json.loads(done.stdout) if done.returncode == 0 else f"absent: {last_line(done.stderr)}"


def retiming(console: Console) -> list[Figure]:
    """100 random spline clips of the wx250s: limits, duration and time beside toppra."""
    try:
        model = load_model("wx250s")
    except ModelError:
        return [absent("retiming", NO_ROBOT)]
    names = [model.joint(j).name for j in range(6)]
    rng, times = np.random.default_rng(0), np.linspace(0.0, SECONDS, KEYS)
    paths = rng.uniform(-0.9, 0.9, (PATHS, KEYS, 6))
    limits = {"velocity": dict.fromkeys(names, SPEED), "acceleration": dict.fromkeys(names, BEND)}
    able = machine(model, **limits, force=np.inf)
    share, mine = 0.0, {n: [] for n in POINTS}
    for path in track(list(paths), "retiming", console=console):
        tracks = {n: keyed(times, path[:, j], kind="natural") for j, n in enumerate(names)}
        clip = Clip(model, tracks, model.qpos0)
        for n in POINTS:
            begun = time.perf_counter()
            found = retime(clip, able, points=n)
            mine[n].append((found.duration, time.perf_counter() - begun))
            share = max(share, found.report.worst)
    figures = [at_most("retiming: largest share of a limit, grid x 10", share - 1.0, 1e-6, "")]
    job = {"times": times.tolist(), "paths": paths.tolist(), "points": POINTS}
    theirs = peer(job | {"velocity": [SPEED] * 6, "acceleration": [BEND] * 6})
    if isinstance(theirs, str):
        return [*figures, absent("retiming beside toppra", theirs)]
    for k, n in enumerate(POINTS):
        ours, other = (
            np.array(mine[n]),
            np.array([[r[k]["duration"] * r[k]["scale"], r[k]["seconds"]] for r in theirs]),
        )
        ratio, speed = ours[:, 0] / other[:, 0], ours[:, 1] / other[:, 1]
        scale = max(r[k]["scale"] for r in theirs)
        figures += [
            at_most(f"retiming, {n} points: duration / toppra's, largest", ratio.max(), 1.0 + 1e-6, ""),
            told(f"retiming, {n} points: duration / toppra's, median", float(np.median(ratio)), ""),
            told(f"retiming, {n} points: toppra slowed by up to", scale, ""),
            at_most(f"retiming, {n} points: time / toppra's, median", float(np.median(speed)), 1.2, ""),
            told(f"retiming, {n} points: time / toppra's, 90 %", float(np.percentile(speed, 90)), ""),
            told(f"retiming, {n} points: our time", 1e3 * float(np.median(ours[:, 1])), "ms"),
        ]
    return figures


def smooth(console: Console) -> list[Figure]:
    """Ten of the same clips with a limit on jerk: what it costs in duration, and to compute."""
    try:
        model = load_model("wx250s")
    except ModelError:
        return [absent("bounded jerk", NO_ROBOT)]
    names = [model.joint(j).name for j in range(6)]
    rng, times = np.random.default_rng(0), np.linspace(0.0, SECONDS, KEYS)
    limits = {"velocity": dict.fromkeys(names, SPEED), "acceleration": dict.fromkeys(names, BEND)}
    able = machine(model, **limits, jerk=dict.fromkeys(names, JERK), force=np.inf)
    free = machine(model, **limits, force=np.inf)
    share, longer, seconds = 0.0, [], []
    for path in track(list(rng.uniform(-0.9, 0.9, (10, KEYS, 6))), "bounded jerk", console=console):
        tracks = {n: keyed(times, path[:, j], kind="natural") for j, n in enumerate(names)}
        clip = Clip(model, tracks, model.qpos0)
        begun = time.perf_counter()
        found = retime(clip, able, points=1000)
        seconds.append(time.perf_counter() - begun)
        longer.append(found.duration / retime(clip, free, points=1000).duration)
        share = max(share, found.report.worst)
    return [
        at_most("bounded jerk: largest share of a limit, grid x 10", share - 1.0, 1e-6, ""),
        told("bounded jerk: duration / that without, median", float(np.median(longer)), ""),
        told("bounded jerk: our time, median", float(np.median(seconds)), "s"),
    ]


def fitting(console: Console) -> list[Figure]:
    """Scenes with impossible keys made possible: a pick, a swing, a jump; certified, and simulated."""
    figures = []
    for name, near in (("two_link_pick", 0.01), ("acrobot_swing", 0.01), ("hopper_jump", 0.05)):
        task = task_of(load_scene(SCENES / f"{name}.toml"))
        drawn = check(task.clip, task.machine, phases=task.phases)
        begun = time.perf_counter()
        found = fit(task.clip, task.machine, hard=task.hard, phases=task.phases, **task.words)
        seconds = time.perf_counter() - begun
        proof = prove(found, task.machine)
        console.print(f"{name}: {found.certificate}")
        figures += [
            at_least(f"{name}: limits that the keys cross", len(drawn.violations), 1, ""),
            at_most(f"{name}: share of limits in use, grid x 10", found.certificate.limits, 1.001, ""),
            at_most(f"{name}: force missing, relative", found.certificate.dynamics, 1e-3, ""),
            at_most(f"{name}: resting sites stray", found.certificate.contact, 1e-3, "m"),
            at_most(
                f"{name}: simulated with the law in the loop, largest error", proof.worst, near, "rad, m"
            ),
            told(f"{name}: time of the fit", seconds, "s"),
        ]
    return figures


PARTS = {"retiming": retiming, "smooth": smooth, "fitting": fitting}
