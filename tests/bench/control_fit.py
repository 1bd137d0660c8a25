"""The fitting half of `make bench NAME=control`: retiming against toppra, motion fitted to machines."""

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
from control_figures import Figure, at_most, info
from pantograph.controllers.fit import fit, machine, prove, retime
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


def fitting(console: Console) -> list[Figure]:
    """Impossible keys made possible: a pick at a torque limit, an acrobot's swing; certified, simulated."""
    arm, acrobot = load_model("planar_2r"), load_model("acrobot")
    up = {
        "shoulder": keyed([0, 4], [0, np.pi], kind="clamped"),
        "elbow": keyed([0, 4], [0, 0], kind="clamped"),
    }
    pick = {"shoulder": keyed([0, 0.5, 1], [-1.2, 0.3, 0.8], kind="clamped")}
    pick["elbow"] = keyed([0, 0.5, 1], [0.5, 1.8, 0.2], kind="clamped")
    weak = machine(arm, force={"shoulder": 85.0, "elbow": 25.0})
    free = machine(acrobot, driven=np.array([False, True]), force={"elbow": 15.0})
    cases = {
        "pick at a torque limit": (Clip(arm, pick, arm.qpos0), weak, {"hard": [1.0]}),
        "swing of the acrobot": (Clip(acrobot, up, acrobot.qpos0), free, {"hard": [4.0], "deviation": 0.1}),
    }
    figures = []
    for name, (clip, able, words) in cases.items():
        begun = time.perf_counter()
        found = fit(clip, able, **words)
        seconds = time.perf_counter() - begun
        proof = prove(found, able)
        console.print(f"{name}: {found.certificate}")
        figures += [
            at_most(f"{name}: share of limits in use, grid x 10", found.certificate.limits, 1.001, ""),
            at_most(f"{name}: force missing, relative", found.certificate.dynamics, 1e-3, ""),
            at_most(f"{name}: simulated with LQR, largest error", proof.worst, 0.01, "rad"),
            info(f"{name}: time of the fit", seconds, "s"),
        ]
    return figures


PARTS = {"retiming": retiming, "fitting": fitting}
