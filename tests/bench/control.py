"""Control: gains, tracking, swing-up, fitting, prediction. `make bench NAME=control`.

A part is a function that returns figures; the last line is one JSON object of all of them. Parts can be
named: python tests/bench/control.py gains tracking swing_up
"""

import sys
import time
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
from control_fit import PARTS as FIT
from control_linear import PARTS as LINEAR
from control_mpc import PARTS as MPC
from control_tick import PARTS as TICK
from figures import Figure, at_least, at_most, main, told
from pantograph.controllers.basin import Catch, advance, map_basin, picture
from pantograph.controllers.design import LinearSystem, dlqr, held, lqr
from pantograph.controllers.experiments import compare
from pantograph.controllers.gains import force_limits
from pantograph.controllers.nominal import Nominal
from pantograph.controllers.swing_up import SwingUp
from pantograph.controllers.trial import Disturbance, run_trial
from pantograph.models import load_model
from pantograph.sim import Scene, make_plan
from pantograph.sim.dynamics.smooth import compile_model
from rich.console import Console
from rich.progress import track

sys.path.insert(0, str(Path(__file__).parents[1]))
from oracles import control_gains

STARTS, SWING_S, STAY_S, PERIOD = 1000, 15.0, 10.0, 0.01
SEEDS = (0, 1)
ARM = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]
OUT = Path("out")


def gains(console: Console) -> list[Figure]:
    """Reference gains, residuals, and the limit of small periods."""
    figures = []
    for case in (
        control_gains.double_integrator,
        control_gains.inverted_pendulum,
        control_gains.ctms_cart_pendulum,
    ):
        A, B, Q, R, K = case()
        found = lqr(A, B, Q, R)
        error = float(np.abs(found.K[0] - K).max() / np.abs(K).max())
        figures.append(at_most(f"{case.__name__}: gain, relative error", error, 1e-9, ""))
        figures.append(told(f"{case.__name__}: Riccati residual", found.residual, ""))
        errors = []
        for T in (4e-4, 2e-4, 1e-4):
            n, m = B.shape
            step = held(LinearSystem(A, B, ("x",) * n, ("u",) * m), T)
            errors.append(np.abs(dlqr(step.A, step.B, Q * T, R * T).K - K).max())
        order = min(np.log2(a / b) for a, b in pairwise(errors))
        figures.append(at_least(f"{case.__name__}: discrete tends to continuous, order", order, 0.95, ""))
    return figures


def arm_scene(period: float, seed: int) -> Scene:
    """The six-axis arm with ideal drives along smooth random keys, on the smooth engine."""
    rng = np.random.default_rng(seed)
    times = [0, 0.8, 1.6, 2.4, 3.2]
    keys = [{"joint": j, "times": times, "values": rng.uniform(-0.6, 0.6, 5).tolist()} for j in ARM]
    return Scene(
        duration=3.2,
        models=[{"file": "arm6"}],
        roles={"tracked": ARM},
        actuators={"*": "off"},
        keys=[k | {"curve": "clamped"} for k in keys],
        physics={"friction": False, "contacts": "none"},
        controller={"law": "computed-torque", "period": period},
        solver={"engine": "smooth", "step": period / 2},
    )


def tracking(console: Console) -> list[Figure]:
    """Computed torque with an exact model."""
    errors, ticks = [], []
    for seed in range(5):
        trial = run_trial(make_plan(arm_scene(1e-3, seed)), "computed-torque", {}, Disturbance())
        errors.append(trial.figures.worst)
        ticks.append(trial.figures.tick)
    return [
        at_most("computed torque, exact model, 1 kHz: largest error of 5 clips", max(errors), 1e-6, "rad"),
        told("computed torque: median tick", 1e6 * float(np.median(ticks)), "us"),
    ]


def swing_law(which: str, **words: float) -> tuple[mujoco.MjModel, SwingUp]:
    model = load_model("cart_pole" if which == "cart-pole" else "acrobot")
    if which == "cart-pole":  # half the total weight
        limit = 0.5 * 9.81 * float(model.body_mass.sum())
        model.actuator_ctrlrange[0] = [-limit, limit]
    tracked = np.array([True, False]) if which == "cart-pole" else np.array([False, True])
    return model, SwingUp(model, tracked, model.qpos0, PERIOD, **words)


def swing_up(console: Console) -> list[Figure]:
    """From 1,000 random starts within 15 s to the top, and 10 s there; by the smooth engine's own drives.
    Half of them are of another seed than the law was made with."""
    figures = []
    for which in ("cart-pole", "acrobot"):
        model, law = swing_law(which)
        begun, arrived, failed = time.perf_counter(), np.zeros(0), 0
        for seed in SEEDS:
            times, failures = swing(console, which, model, law, STARTS // len(SEEDS), seed=seed)
            arrived, failed = np.append(arrived, times), failed + len(failures)
            for k, why in failures:
                console.print(f"{which}: start {k} of seed {seed} fails: {why}")
        share = 1.0 - failed / STARTS
        figures.append(at_least(f"{which}: swings up within 15 s and stays 10 s", share, 0.999, ""))
        figures.append(told(f"{which}: median time to the top", float(np.median(arrived)), "s"))
        figures.append(told(f"{which}: 99.9 % of times to the top", float(np.percentile(arrived, 99.9)), "s"))
        figures.append(told(f"{which}: computing time a start", (time.perf_counter() - begun) / STARTS, "s"))
        figures.append(told(f"{which}: longest tick of one machine", look_ahead(law), "s"))
    return [*figures, *basin()]


def look_ahead(law: SwingUp) -> float:
    """The longest tick [s] of processor time in the first two seconds of a machine that hangs."""
    q, v, longest = law.shaping.goal[None].copy(), np.zeros((1, 2)), 0.0
    q[0, int(np.argmax(law.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE))] += np.pi - 0.1
    memory = law.begin(1)
    law.batch(q, v, memory)  # what is worked out once
    for _ in range(round(2.0 / PERIOD)):
        begun = time.thread_time()
        tau, memory = law.batch(q, v, memory)
        longest = max(longest, time.thread_time() - begun)
        q, v = advance(law.nominal, q, v, tau, PERIOD / 4, 4)
    return longest


def swing(
    console: Console, which: str, model: mujoco.MjModel, law: SwingUp, starts: int, seed: int
) -> tuple[np.ndarray, list[tuple[int, str]]]:
    """Times of arrival [s] of all, and failures."""
    rng, smooth = np.random.default_rng(seed), compile_model(model)
    q, v = np.zeros((starts, 2)), rng.uniform(-1.0, 1.0, (starts, 2))
    if which == "cart-pole":
        q[:, 1] = rng.uniform(-np.pi, np.pi, starts)
    else:
        q = rng.uniform(-np.pi, np.pi, (starts, 2))
    driven = int(np.flatnonzero(law.tracked)[0])
    memory, down, off = law.begin(starts), np.zeros(starts), np.zeros(starts, dtype=bool)
    for tick in track(range(round((SWING_S + STAY_S) / PERIOD)), which, console=console):
        tau, memory = law.batch(q, v, memory)
        path = smooth.rollout(q, v, tau[:, None, driven : driven + 1], step=PERIOD / 10, steps=10, hold=10)
        q, v = path.q[:, -1].copy(), path.v[:, -1].copy()
        x = law.shaping.catch[0].state(q, v)
        tilt = np.abs(x[:, 1]) if which == "cart-pole" else np.abs([x[:, 0], x[:, 0] + x[:, 1]]).max(axis=0)
        down = np.where(tilt > 0.5, (tick + 1) * PERIOD, down)
        if which == "cart-pole":
            low, high = model.jnt_range[0]
            off |= (q[:, 0] < low) | (q[:, 0] > high)
    why = [(int(k), "leaves its rail") for k in np.flatnonzero(off)]
    why += [(int(k), f"down until {down[k]:.2f} s") for k in np.flatnonzero((down > SWING_S) & ~off)]
    return down, why


def basin() -> list[Figure]:
    """The basin of LQR for the double inverted pendulum on a cart, as a picture with its area, which a grid
    twice as fine must give again."""
    model = load_model("cart_double_pole")
    catch = Catch(Nominal(model), np.array([True, False, False]), np.zeros(3), 0.005, reach=0.1, speed=1.0)
    coarse, found = (map_basin(catch, force_limits(model), (1, 2), (0.8, 1.2), points=n) for n in (61, 121))
    OUT.mkdir(exist_ok=True)
    picture(found, ("lower angle [rad]", "upper angle, relative [rad]")).savefig(OUT / "basin.png", dpi=120)
    name = "LQR basin, double pole on a cart, all else at rest"
    return [
        told(f"{name} ({OUT / 'basin.png'}): area", found.area, "rad^2"),
        at_most(
            f"{name}: area on a grid half as fine, relative", abs(coarse.area / found.area - 1), 0.02, ""
        ),
    ]


def robust(console: Console) -> list[Figure]:
    """Which law keeps what: each body's mass wrong by up to 10 %, with pushes of a fifth of the weight."""
    laws, figures = ["pd", "pid", "computed-torque", "lqr", "mpc"], []
    for name, mass, push in (("masses wrong by 10 %", 0.1, 0.0), ("and pushed", 0.1, 0.2)):
        for row in compare(arm_scene(2e-3, 1), laws, trials=8, mass=mass, push=push).rows:
            law = row.variant.name
            figures.append(told(f"{name}, {law}: RMS as modelled", row.nominal.rms, "rad"))
            figures.append(told(f"{name}, {law}: worst RMS of 8", row.robust, "rad"))
    plan = make_plan(arm_scene(1e-3, 0))
    heavy = Disturbance(mass=(1.1,) * plan.problem.model.nbody)
    for law in laws:
        worst = run_trial(plan, law, {}, heavy).figures.worst
        figures.append(told(f"all masses 10 % larger, {law}: largest error", worst, "rad"))
    return figures


PARTS = {
    "gains": gains,
    "tracking": tracking,
    "robust": robust,
    "swing_up": swing_up,
    **LINEAR,
    **FIT,
    **MPC,
    **TICK,
}


if __name__ == "__main__":
    sys.exit(main("control", PARTS))
