"""The predictive half of `make bench NAME=control`: real time, distance from the optimum, IPOPT's time."""

import sys
import time
from pathlib import Path

import numpy as np
from figures import Figure, at_least, at_most, told
from pantograph.controllers.basin import advance
from pantograph.controllers.predictive.nonlinear import NMPC
from pantograph.models import load_model
from pantograph.sim.clip import Clip
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1]))
from oracles.control_ipopt import formulate


def cart() -> tuple[NMPC, np.ndarray, float]:
    """A cart-pole that hangs, 1 s ahead at 100 Hz; and its start and seconds."""
    model = load_model("cart_pole")
    clip = Clip(model, {"slide": keyed([0], [0.0])}, np.zeros(2))
    driven, none = np.array([True, False]), np.zeros(2, dtype=bool)
    law = NMPC(model, driven, np.zeros(2), clip, 0.01, none, horizon=1.0, step=0.04, goal={"hinge": 0.0})
    return law, np.array([0.3, np.pi - 0.1, 0.0, 0.0]), 4.0


def arm() -> tuple[NMPC, np.ndarray, float]:
    """The six-axis arm off its keys by 0.1 rad, 0.5 s ahead at 50 Hz."""
    model, rng = load_model("arm6"), np.random.default_rng(0)
    names = [model.joint(j).name for j in range(6)]
    times = np.linspace(0, 4, 6)
    tracks = {n: keyed(times, rng.uniform(-0.5, 0.5, 6), kind="clamped") for n in names}
    clip = Clip(model, tracks, model.qpos0)
    law = NMPC(model, np.ones(6, dtype=bool), model.qpos0, clip, 0.02, np.zeros(6, dtype=bool), horizon=0.5)
    return law, np.concatenate([clip.evaluate(0.0).q + 0.1, np.zeros(6)]), 4.0


def run(console: Console, name: str, law: NMPC, x: np.ndarray, seconds: float) -> list[Figure]:
    """Closed loop; every tenth sample is compared with its converged plan and with IPOPT, started alike."""
    nv, period, memory = law.model.nv, law.period, law.start()
    peer, ticks, ratios, theirs = formulate(law), [], [], []
    for k in range(round(seconds / period)):
        t, q, v = k * period, x[:nv], x[nv:]
        target, before = Target(*law.clip.evaluate(t)), memory
        begun = time.perf_counter()
        tau, memory = law(t, q, v, target, before)
        ticks.append(time.perf_counter() - begun)
        if k % 10 == 5:
            ref = law.horizon(t)
            guess = law.carried(x, ref, t, before)
            begun = time.perf_counter()
            peer(x, ref, guess.x, guess.u)
            theirs.append(time.perf_counter() - begun)
            best = law.shooting.improve(memory.plan, ref, 200).cost
            ratios.append((memory.plan.cost + 1e-6) / (best + 1e-6))
        q, v = advance(law.nominal, q[None], v[None], tau[None], period / 4, 4)
        x = np.concatenate([q[0], v[0]])
    first, ticks = ticks[0], np.array(ticks[1:])
    late = float(np.percentile(ticks, 99))
    return [
        at_most(f"{name}: 99th percentile of a tick", 1e3 * late, 1e3 * period, "ms"),
        told(f"{name}: median tick", 1e3 * float(np.median(ticks)), "ms"),
        told(f"{name}: first tick, from nothing", 1e3 * first, "ms"),
        at_most(f"{name}: cost / converged optimum, largest", max(ratios), 1.01, ""),
        told(f"{name}: cost / converged optimum, median", float(np.median(ratios)), ""),
        at_least(f"{name}: IPOPT's median time / ours", float(np.median(theirs) / np.median(ticks)), 1.0, ""),
        told(
            f"{name}: distance from the goal at the end",
            float(np.abs(x - law.horizon(seconds).x[0]).max()),
            "",
        ),
    ]


def prediction(console: Console) -> list[Figure]:
    """Both machines."""
    cases = (("NMPC cart-pole, 100 Hz", cart()), ("NMPC 6-DOF arm, 50 Hz", arm()))
    return [figure for name, case in cases for figure in run(console, name, *case)]


PARTS = {"prediction": prediction}
