"""The linear predictive part of `make bench NAME=control`: against LQR, and QP by QP against qpOASES."""

import sys
import time
from pathlib import Path

import casadi as ca
import numpy as np
from figures import Figure, at_most, told
from pantograph.controllers.basin import advance
from pantograph.controllers.lqr import LQR
from pantograph.controllers.predictive import linear as predictive
from pantograph.controllers.predictive.quadratic import LeastChange
from pantograph.models import load_model
from pantograph.sim.clip import Clip
from pantograph.sim.control import Target
from pantograph.sim.curves import keyed
from rich.console import Console

sys.path.insert(0, str(Path(__file__).parents[1]))
from oracles import control_qp

PERIOD, SECONDS = 0.01, 4.0
STILL = Target(np.zeros(2), np.zeros(2), np.zeros(2))


def cart(kind: type, limit: float, reach: float, **words: float) -> predictive.MPC | LQR:
    """A pole to balance on a cart that drives towards the end of its rail."""
    model = load_model("cart_pole")
    model.actuator_ctrlrange[0], model.jnt_range[0] = [-limit, limit], [-reach, reach]
    clip = Clip(model, {"slide": keyed([0], [0.0])}, np.zeros(2))
    driven, none = np.array([True, False]), np.zeros(2, dtype=bool)
    return kind(model, driven, np.zeros(2), clip, PERIOD, SECONDS, none, position=100.0, **words)


def linear(console: Console) -> list[Figure]:
    """Without limits in the way the optimum of the plain program; with them too, and in real time."""
    rng, apart = np.random.default_rng(0), unlimited(np.random.default_rng(0))
    law, seen, ticks = cart(predictive.MPC, 12.0, 0.4, horizon=1.0), [], []
    plain, furthest = law.least_change, 0.0

    def watched(*arguments):
        begun = time.thread_time()
        out = plain(*arguments)
        seen.append((time.thread_time() - begun, arguments[:4], out))
        return out

    law.least_change = watched
    for _ in range(6):
        q, v = np.array([rng.uniform(0.2, 0.35), rng.uniform(-0.1, 0.1)]), rng.uniform(0.0, 0.4, 2)
        memory = law.start()
        for k in range(round(SECONDS / PERIOD)):
            begun = time.thread_time()
            tau, memory = law(k * PERIOD, q, v, STILL, memory)
            ticks.append(time.thread_time() - begun)
            tau[1] = 0.1 * rng.normal()  # gusts at the pole
            q, v = (x[0] for x in advance(law.lqr.nominal, q[None], v[None], tau[None], PERIOD / 4, 4))
            furthest = max(furthest, abs(q[0]))
    error, ratios, cold = _against(seen)
    late = float(np.percentile(ticks, 99))
    name = f"linear MPC, 100 Hz, {len(law.powers)} moves over 1 s"
    return [
        at_most("linear MPC without limits against the plain QP, relative", apart, 1e-6, ""),
        at_most(f"{name}: 99th percentile of a tick, processor time", 1e3 * late, 1e3 * PERIOD, "ms"),
        told(f"{name}: median tick, processor time", 1e3 * float(np.median(ticks)), "ms"),
        told(f"{name}: ticks that limits change", len(seen) / len(ticks), ""),
        told(f"{name}: way of the cart, of its range", furthest / 0.4, ""),
        at_most(f"{name}: first force against qpOASES, of the drive's", error, 1e-6, ""),
        told(f"{name}: qpOASES' time from nothing / ours, median", float(np.median(ratios)), ""),
        told(f"{name}: our time from nothing / from the sample before, median", cold, ""),
    ]


def unlimited(rng: np.random.Generator) -> float:
    """Largest relative difference of first forces, from random states, between the law without limits in the
    way and the program with states as unknowns."""
    law, apart, steps = cart(predictive.MPC, 1e6, 1e6), 0.0, 25
    A, B, _, P, _ = law.lqr.solution
    free = np.full((2, steps, 4), np.inf)
    for _ in range(20):
        q, v = rng.normal(size=2), rng.normal(size=2)
        tau, _ = law(0.0, q, v, STILL, law.start())
        u, _ = control_qp.solve(
            np.tile(A, (steps, 1, 1)), np.tile(B, (steps, 1, 1)), law.lqr.Q, law.lqr.R, P[0],
            np.concatenate([q, v]), needed=np.zeros((steps, 1)), force=np.array([[-np.inf], [np.inf]]),
            slew=np.array([np.inf]), before=None, states=free * [[[-1.0]], [[1.0]]], soft=1.0,
        )  # fmt: skip
        apart = max(apart, abs(tau[0] / u[0, 0] - 1.0))
    return apart


def _against(seen: list) -> tuple[float, list[float], float]:
    """Largest difference of the first unknown from qpOASES, which takes every row, its time over ours for
    each program, and our own time without the guess over that with it, medians."""
    peers, worst, ratios, cold, ours = {}, 0.0, [], [], LeastChange()
    for seconds, (M, low, high, give), (z, _, _) in seen:
        soft = np.flatnonzero(give)
        full = np.hstack([M, np.sqrt(give)[:, None] * np.eye(len(M))[:, soft]])
        rows, n = full.shape
        if (rows, n) not in peers:
            shape = {"h": ca.Sparsity.diag(n), "a": ca.Sparsity.dense(rows, n)}
            peers[rows, n] = ca.conic("peer", "qpoases", shape, {"printLevel": "none", "print_time": False})
        given = {"h": ca.DM.eye(n), "g": 0, "a": ca.DM(full), "lba": low, "uba": high}
        begun = time.thread_time()
        done = peers[rows, n](**given)
        ratios.append((time.thread_time() - begun) / seconds)
        begun = time.thread_time()
        ours(M, low, high, give)
        cold.append(time.thread_time() - begun)
        worst = max(worst, abs(float(done["x"][0]) - z[0]) * abs(M[0, 0]) / 12.0)
    return worst, ratios, float(np.median(cold) / np.median([seconds for seconds, _, _ in seen]))


PARTS = {"linear": linear}
