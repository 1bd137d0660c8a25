"""The fitting half of `make bench NAME=control`: retiming against toppra, motion fitted to machines."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from control_figures import Figure, at_most, info
from pantograph.controllers.fit import machine, retime
from pantograph.models import ModelError, load_model
from pantograph.sim.clip import Clip
from pantograph.sim.curves import keyed
from rich.console import Console
from rich.progress import track

PATHS, KEYS, SECONDS = 100, 6, 4.0
POINTS = (250, 1000)
SPEED, BEND = 3.0, 10.0  # rad/s, rad/s^2
VENV = Path(".bench/toppra")


def peer(job: dict) -> list | None:
    """toppra's results, installed into an environment of its own; None when it cannot be."""
    python = VENV / "bin" / "python"
    if not python.exists():
        steps = (
            [sys.executable, "-m", "venv", str(VENV)],
            [str(VENV / "bin" / "pip"), "install", "-q", "toppra"],
        )
        if any(subprocess.run(step, check=False).returncode for step in steps):
            return None
    script = Path(__file__).with_name("toppra_peer.py")
    done = subprocess.run(
        [str(python), str(script)], input=json.dumps(job), capture_output=True, text=True, check=False
    )
    return json.loads(done.stdout) if done.returncode == 0 else None


def retiming(console: Console) -> list[Figure]:
    """100 random spline clips of the wx250s: limits, duration and time beside toppra."""
    try:
        model = load_model("wx250s")
    except ModelError:
        console.print("retiming: no wx250s here (set PANTOGRAPH_DATA)")
        return [Figure("retiming: wx250s present", 0.0, "", "present", False)]
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
    if theirs is None:
        return [*figures, Figure("retiming: toppra present", 0.0, "", "present", False)]
    for k, n in enumerate(POINTS):
        ours, other = (
            np.array(mine[n]),
            np.array([[r[k]["duration"] * r[k]["scale"], r[k]["seconds"]] for r in theirs]),
        )
        ratio, speed = ours[:, 0] / other[:, 0], ours[:, 1] / other[:, 1]
        scale = max(r[k]["scale"] for r in theirs)
        figures += [
            at_most(f"retiming, {n} points: duration / toppra's, largest", ratio.max(), 1.0 + 1e-6, ""),
            info(f"retiming, {n} points: duration / toppra's, median", float(np.median(ratio)), ""),
            info(f"retiming, {n} points: toppra slowed by up to", scale, ""),
            at_most(f"retiming, {n} points: time / toppra's, median", float(np.median(speed)), 1.2, ""),
            info(f"retiming, {n} points: time / toppra's, 90 %", float(np.percentile(speed, 90)), ""),
            info(f"retiming, {n} points: our time", 1e3 * float(np.median(ours[:, 1])), "ms"),
        ]
    return figures


PARTS = {"retiming": retiming}
