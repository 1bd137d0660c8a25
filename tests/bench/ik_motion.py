"""Inverse kinematics along time for its benchmark: locked feet, a figure-eight through a singularity."""

import time

import mujoco
import numpy as np
from figures import at_most, told
from oracles import captures
from oracles.ik_motions import figure_eight, walk, wrist_arm
from pantograph.models import load_model
from pantograph.sim.ik import Follower, follow, lock
from pantograph.sim.ik.spline import smooth_clip
from pantograph.sim.kinematics import frame

RATE = 1000  # [1/s] at which locked feet are looked at, on the curve that a user gets


def motion(console):
    """Walks with locked feet, and a figure-eight through a wrist singularity."""
    puppet, times = load_model("puppet"), np.arange(0, 3, 1 / 60)
    stances = {"left_foot": [(0.2, 0.5), (1.2, 1.5), (2.2, 2.5)], "right_foot": [(0.7, 1.0), (1.7, 2.0)]}
    figures = locked("locked foot", puppet, times, walk(puppet, times), stances)
    if captures.folder() is None:
        console.print("no data folder with motion captures: no captured walk")
    else:
        figures += locked("captured walk, locked foot", *captures.capture("fb"))
    return [*figures, *figure()]


def locked(name, model, times, q, stances):
    """Slip of the feet at every millisecond of their stances, by MuJoCo's kinematics, and time."""
    begin = time.thread_time()
    out = lock(model, times, q, stances)
    spent = time.thread_time() - begin
    clip, data, slip = smooth_clip(model, out.t, out.q, range(model.njnt)), mujoco.MjData(model), 0.0
    for foot, spans in stances.items():
        kind, _, word = foot.rpartition(":")
        for start, end in spans:
            p = []
            for x in clip.evaluate(np.linspace(start, end, round((end - start) * RATE) + 1)).q:
                data.qpos[:] = x
                mujoco.mj_kinematics(model, data)
                p.append((data.body(word) if kind else data.site(word)).xpos.copy())
            slip = max(slip, float(np.linalg.norm(np.array(p) - p[len(p) // 2], axis=1).max()))
    return [
        at_most(f"{name}: largest slip on the curve", 1e3 * slip, 0.1, "mm"),
        at_most(f"{name}: instants not held", float((~out.met).sum()), 0, ""),
        told(f"{name}: time a given frame", 1e3 * spent / len(times), "ms"),
    ]


def figure():
    """A figure-eight through a wrist singularity, live and as a whole."""
    arm = wrist_arm()
    q, goals = figure_eight(arm)
    dt, speed, effort = 0.01, 2.0, 30.0
    f = frame(arm, "site", "tip")
    follower = Follower(arm, dt=dt, q0=q, velocity=speed, acceleration=effort)
    follower.compile(goals(0.0))
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
    fastest, hardest = finely(whole)
    return [
        at_most("figure-eight live: joint speed over its limit", worst_v / speed, 1 + 1e-9, "ratio"),
        at_most("figure-eight live: acceleration over its limit", worst_a / effort, 1 + 1e-6, "ratio"),
        at_most("figure-eight live: deviation not reported", untold, 1e-9, "m"),
        told("figure-eight live: largest deviation", 1e3 * far, "mm"),
        told("figure-eight live: time a tick", 1e3 * each, "ms"),
        at_most("figure-eight whole: joint speed over its limit", fastest / speed, 1 + 1e-9, "ratio"),
        at_most("figure-eight whole: acceleration over its limit", hardest / effort, 1 + 1e-6, "ratio"),
        told("figure-eight whole: largest deviation", 1e3 * whole.position.max(), "mm"),
        told("figure-eight whole: time", spent, "s"),
    ]  # fmt: skip


def finely(motion):
    """Largest joint speed and acceleration on a motion's curve, at every millisecond and on both sides of
    every break of the curve: between breaks the acceleration is straight."""
    clip = motion.clip()
    times = np.linspace(clip.start, clip.end, round((clip.end - clip.start) * RATE) + 1)
    times = np.concatenate([times, clip.breaks])
    sides = [clip.evaluate(times, left=left) for left in (False, True)]
    return (max(float(np.abs(getattr(side, word)).max()) for side in sides) for word in ("v", "a"))
