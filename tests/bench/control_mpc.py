"""The predictive half of `make bench NAME=control`: real time, distance from the optimum, IPOPT's time."""

import sys
import time
from pathlib import Path

import numpy as np
from figures import Figure, at_least, at_most, told
from pantograph.controllers.basin import advance
from pantograph.controllers.drives import Drives
from pantograph.controllers.predictive.nonlinear import NMPC
from pantograph.models import load_model
from pantograph.sim.clip import Clip
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1]))
from oracles.control_ipopt import TOLERANT, formulate


def cart() -> tuple[NMPC, np.ndarray, float]:
    """A cart-pole that hangs, 1 s ahead at 100 Hz; and its start and seconds."""
    model = load_model("cart_pole")
    clip = Clip(model, {"slide": keyed([0], [0.0])}, np.zeros(2))
    driven, none = np.array([True, False]), np.zeros(2, dtype=bool)
    law = NMPC(model, driven, np.zeros(2), clip, 0.01, none, horizon=1.0, step=0.04, goal={"hinge": 0.0})
    return law, np.array([0.3, np.pi - 0.1, 0.0, 0.0]), 4.0


def arm() -> tuple[NMPC, np.ndarray, float]:
    """The six-axis arm with weak drives, half a radian off its keys, 0.5 s ahead at 50 Hz."""
    model, rng, every = load_model("arm6"), np.random.default_rng(0), np.ones(6, dtype=bool)
    model = Drives(model, every, saturation=0.2).told(model)
    names = [model.joint(j).name for j in range(6)]
    times = np.linspace(0, 4, 6)
    tracks = {n: keyed(times, rng.uniform(-0.5, 0.5, 6), kind="clamped") for n in names}
    clip = Clip(model, tracks, model.qpos0)
    law = NMPC(model, every, model.qpos0, clip, 0.02, ~every, horizon=0.5)
    return law, np.concatenate([clip.evaluate(0.0).q + 0.5, np.zeros(6)]), 4.0


def run(console: Console, name: str, law: NMPC, x: np.ndarray, seconds: float) -> list[Figure]:
    """Closed loop; the cost of every tenth sample, and of all that limits hold, is compared with the least
    that is known of it: our own plan's, converged, or IPOPT's, which starts from the same guess."""
    nv, period, memory = law.model.nv, law.period, law.start()
    peers = {"IPOPT": formulate(law), "IPOPT to 1 %, warm": formulate(law, TOLERANT)}
    ticks, limited, costs, theirs = [], 0, [], {peer: [] for peer in peers}
    for k in range(round(seconds / period)):
        t, q, v = k * period, x[:nv], x[nv:]
        target, before = Target(*law.clip.evaluate(t)), memory
        begun = time.thread_time()
        tau, memory = law(t, q, v, target, before)
        ticks.append(time.thread_time() - begun)
        weights, u = law.shooting.weights, memory.plan.u
        held = bool(((u <= weights.low) | (u >= weights.high)).any())
        limited += held
        if k and (held or k % 10 == 5):
            ref = law.horizon(t)
            guess, row = law.carried(x, ref, t, before), [memory.plan.cost]
            for peer, solve in peers.items():
                begun = time.thread_time()
                row.append(solve(x, ref, guess.x, guess.u)[1])
                theirs[peer].append(time.thread_time() - begun)
            costs.append([*row, law.shooting.improve(memory.plan, ref, 200).cost])
        q, v = advance(law.nominal, q[None], v[None], tau[None], period / 4, 4)
        x = np.concatenate([q[0], v[0]])
    first, ticks, costs = ticks[0], np.array(ticks[1:]), np.array(costs)
    least = np.minimum(costs[:, 1], costs[:, 3])
    pad = 1e-6 * least.max()  # costs at the goal are rounding
    ratios, loose = ((costs[:, i] + pad) / (least + pad) for i in (0, 2))
    middle = float(np.median(ticks))
    ahead = {peer: float(np.median(times)) / middle for peer, times in theirs.items()}
    return [
        at_most(
            f"{name}: 99th percentile of a tick, processor time",
            1e3 * float(np.percentile(ticks, 99)),
            1e3 * period,
            "ms",
        ),
        told(f"{name}: median tick, processor time", 1e3 * middle, "ms"),
        told(f"{name}: longest tick after the first", 1e3 * float(ticks.max()), "ms"),
        told(f"{name}: first tick, from nothing", 1e3 * first, "ms"),
        at_least(f"{name}: plans that a limit holds", limited / (len(ticks) + 1), 0.05, ""),
        at_most(f"{name}: cost / least known, largest", float(ratios.max()), 1.01, ""),
        told(f"{name}: cost / least known, median", float(np.median(ratios)), ""),
        at_most(f"{name}: IPOPT's failures", float(np.isinf(costs[:, 1]).mean()), 0.1, ""),
        at_least(f"{name}: IPOPT's median time / ours", ahead["IPOPT"], 1.0, ""),
        told(f"{name}: IPOPT's to 1 %, warm, median time / ours", ahead["IPOPT to 1 %, warm"], ""),
        told(f"{name}: IPOPT's to 1 %, warm: cost / least known, median", float(np.median(loose)), ""),
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
