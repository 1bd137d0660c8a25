"""The fitting half of `make bench NAME=control`: retiming against toppra, motion fitted to machines."""

import json
import subprocess
import time
from pathlib import Path
from typing import NamedTuple

import mujoco
import numpy as np
from figures import Figure, absent, at_least, at_most, environment, last_line, told
from pantograph.controllers.fit import check, fit, machine, prove, retime
from pantograph.controllers.fit.task import task_of
from pantograph.models import ModelError, load_model
from pantograph.sim.clip import Clip
from pantograph.sim.curves import keyed
from pantograph.sim.scene.load import load_scene
from retimed import Judged, judged
from rich.console import Console
from rich.progress import track

PATHS, KEYS, SECONDS = 100, 6, 4.0
BATCH = 10
POINTS = (250, 1000)
SPEED, BEND, JERK = 3.0, 10.0, 100.0  # rad/s, rad/s^2, rad/s^3
NO_ROBOT = "no wx250s here (set PANTOGRAPH_DATA)"
SCENES = Path(__file__).parents[2] / "models" / "scenes"


class Peer:
    """toppra in an environment of its own, asked batch by batch; ``absent`` says why there is none."""

    def __init__(self, job: dict) -> None:
        self.job, self.absent, python = job, "", environment("toppra", "toppra")
        if isinstance(python, str):
            self.absent = python
            return
        script = [str(python), str(Path(__file__).with_name("toppra_peer.py"))]
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        self.process = subprocess.Popen(script, text=True, **pipes)

    def ask(self, paths: np.ndarray) -> list:
        """Its results for paths (k, keys, n), each at every number of points."""
        if self.absent:
            return []
        print(json.dumps(self.job | {"paths": paths.tolist()}), file=self.process.stdin, flush=True)
        if answer := self.process.stdout.readline():
            return json.loads(answer)
        self.absent = f"absent: {last_line(self.process.stderr.read())}"
        return []

    def close(self) -> None:
        if not self.absent:
            self.process.stdin.close()
            self.process.wait()


class Task(NamedTuple):
    """The wx250s, its joints, times of keys, and random paths (paths, keys, joints)."""

    model: mujoco.MjModel
    names: list[str]
    times: np.ndarray
    paths: np.ndarray

    def clip(self, path: np.ndarray) -> Clip:
        tracks = {n: keyed(self.times, path[:, j], kind="natural") for j, n in enumerate(self.names)}
        return Clip(self.model, tracks, self.model.qpos0)

    def each(self, limit: float) -> dict[str, float]:
        return dict.fromkeys(self.names, limit)


def random_paths(count: int) -> Task | None:
    try:
        model = load_model("wx250s")
    except ModelError:
        return None
    rng, times = np.random.default_rng(0), np.linspace(0.0, SECONDS, KEYS)
    names = [model.joint(j).name for j in range(6)]
    return Task(model, names, times, rng.uniform(-0.9, 0.9, (count, KEYS, 6)))


def retiming(console: Console) -> list[Figure]:
    """100 random spline clips of the wx250s: limits, duration and time beside toppra, in turns."""
    task = random_paths(PATHS)
    if task is None:
        return [absent("retiming", NO_ROBOT)]
    able = machine(task.model, velocity=task.each(SPEED), acceleration=task.each(BEND), force=np.inf)
    job = {"times": task.times.tolist(), "points": POINTS}
    other = Peer(job | {"velocity": [SPEED] * 6, "acceleration": [BEND] * 6})
    batches = np.array_split(task.paths, max(1, PATHS // BATCH))
    theirs = other.ask(batches[0][:1])[:0]  # what is done once is not timed
    retime(task.clip(batches[0][0]), able, points=POINTS[0])
    mine, found = {n: [] for n in POINTS}, []
    for k, batch in track(list(enumerate(batches)), "retiming", console=console):
        theirs += other.ask(batch) if k % 2 else []
        for path in batch:
            clip = task.clip(path)
            for n in POINTS:
                begun = time.perf_counter()
                new = retime(clip, able, points=n)
                mine[n].append((new.duration, time.perf_counter() - begun))
                found.append(judged(new, (task.times, path), {1: SPEED, 2: BEND}, degree=6))
        theirs += [] if k % 2 else other.ask(batch)
    other.close()
    figures = _judgement("retiming", found)
    if other.absent:
        return [*figures, absent("retiming beside toppra", other.absent)]
    return figures + [f for k, n in enumerate(POINTS) for f in _beside(n, np.array(mine[n]), theirs, k)]


def _judgement(name: str, found: list[Judged]) -> list[Figure]:
    """What positions alone say of retimed motion."""
    excess, rough, off = np.array(found).T
    detail = f"derivatives of positions, own grid; {len(found)} clips, {rough.max():.1%} of one too fine"
    return [
        at_most(f"{name}: limits exceeded by at most", excess.max(), 1e-6, "", detail),
        at_most(f"{name}: off the spline of the keys", off.max(), 1e-9, "rad", "SciPy's CubicSpline"),
        told(f"{name}: limits left unused at most", -float(excess.min()), ""),
    ]


def _beside(n: int, ours: np.ndarray, theirs: list, k: int) -> list[Figure]:
    """Durations and times of both; toppra's motion is slowed until it holds on its own fine grid."""
    other = np.array([[r[k]["duration"] * r[k]["scale"], r[k]["seconds"]] for r in theirs])
    ratio, speed = ours[:, 0] / other[:, 0], ours[:, 1] / other[:, 1]
    low, middle, high = np.quantile(speed, [0.25, 0.5, 0.75])
    spread = f"quartiles {low:.3g} to {high:.3g}, in turns by batches of {BATCH}"
    return [
        at_most(f"retiming, {n} points: duration / toppra's, largest", ratio.max(), 1.0 + 1e-6, ""),
        told(f"retiming, {n} points: duration / toppra's, median", float(np.median(ratio)), ""),
        told(f"retiming, {n} points: toppra slowed by up to", max(r[k]["scale"] for r in theirs), ""),
        at_most(f"retiming, {n} points: time / toppra's, median", middle, 1.2, "", spread),
        told(f"retiming, {n} points: time / toppra's, 90 %", float(np.percentile(speed, 90)), ""),
        told(f"retiming, {n} points: our time", 1e3 * float(np.median(ours[:, 1])), "ms"),
    ]


def forced(console: Console) -> list[Figure]:
    """Twenty of the same clips with drives a third stronger than the weight, dry friction counted."""
    task = random_paths(20)
    if task is None:
        return [absent("limited forces", NO_ROBOT)]
    friction, found, seconds, slowed = task.model.dof_frictionloss[:6], [], [], []
    for path in track(list(task.paths), "limited forces", console=console):
        clip = task.clip(path)
        still = clip.evaluate(np.linspace(0.0, SECONDS, 401)).q
        weight = np.max([np.abs(machine(task.model).nominal.weight(q)) for q in still[::20]], axis=0)[:6]
        force = 1.4 * weight + 0.3
        able = machine(task.model, velocity=task.each(SPEED), force=dict(zip(task.names, force, strict=True)))
        begun = time.perf_counter()
        new = retime(clip, able, points=1000)
        seconds.append(time.perf_counter() - begun)
        slowed.append(new.slowed)
        words = {"model": task.model, "force": force, "friction": friction}
        found.append(judged(new, (task.times, path), {1: SPEED}, degree=6, **words))
    return [
        *_judgement("limited forces", found),
        told("limited forces: slowed as a whole by up to", max(slowed) - 1.0, ""),
        told("limited forces: our time, median", 1e3 * float(np.median(seconds)), "ms"),
    ]


def smooth(console: Console) -> list[Figure]:
    """Ten of the same clips with a limit on jerk: what it costs in duration, and to compute."""
    task = random_paths(10)
    if task is None:
        return [absent("bounded jerk", NO_ROBOT)]
    limits = {"velocity": task.each(SPEED), "acceleration": task.each(BEND), "force": np.inf}
    able, free = machine(task.model, **limits, jerk=task.each(JERK)), machine(task.model, **limits)
    found, longer, seconds = [], [], []
    for path in track(list(task.paths), "bounded jerk", console=console):
        clip = task.clip(path)
        begun = time.perf_counter()
        new = retime(clip, able, points=1000)
        seconds.append(time.perf_counter() - begun)
        longer.append(new.duration / retime(clip, free, points=1000).duration)
        found.append(judged(new, (task.times, path), {1: SPEED, 2: BEND, 3: JERK}, degree=5))
    return [
        *_judgement("bounded jerk", found),
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


PARTS = {"retiming": retiming, "forced": forced, "smooth": smooth, "fitting": fitting}
