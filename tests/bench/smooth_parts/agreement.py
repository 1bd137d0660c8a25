"""Equal results: with MuJoCo, and of one state beside batches in any number of lanes."""

import mujoco
import numpy as np
from figures import absent, at_most
from pantograph.sim.dynamics import compile_model, unsupported
from pantograph.sim.integrate import TABLEAUS
from rich.progress import track

from . import models

STATES = 1000
NO_DATA = "its data is not here (set PANTOGRAPH_DATA)"


def worst_difference(a, b):
    """Largest difference of any component of a state's row, relative to the row's largest."""
    return float(np.max(np.abs(a - b).max(axis=-1) / np.maximum(np.abs(b).max(axis=-1), 1e-9)))


def agreement(console):
    """Accelerations of MuJoCo with its constraints disabled: whole models with their actuators."""
    for name in track(models.names(), "agreement with MuJoCo", console=console):
        model, title = models.load(name), f"qacc against MuJoCo, {name}"
        if model is None:
            yield absent(title, NO_DATA)
            continue
        models.unconstrained(model)
        if missing := unsupported(model):
            yield absent(title, f"not supported: {missing[0]}")
            continue
        smooth = compile_model(model)
        q, v, act, u = models.states(model, STATES)
        data, theirs = mujoco.MjData(model), np.empty((STATES, model.nv))
        for i in range(STATES):
            data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = q[i], v[i], act[i], u[i]
            mujoco.mj_forward(model, data)
            theirs[i] = data.qacc
        worst = worst_difference(smooth.forward(q, v, u, act=act), theirs)
        detail = f"{STATES} states, {smooth.stats.operations} operations"
        yield at_most(title, worst, 1e-10, "relative", detail)


COUNT = 13  # of a batch: full and cut groups of lanes
FORWARD, MOTION = 1e-12, 1e-11


def lanes(console):
    """A state alone in one lane, against batches in 1, 2, 4 and 8 lanes, wherever in the batch it is."""
    for name in track(models.FIVE, "lanes", console=console):
        source = models.load(name)
        if source is None:
            yield absent(f"lanes, {name}", NO_DATA)
            continue
        model = models.stripped(source)
        q, v, _, _ = models.states(model, COUNT)
        one = compile_model(model, lanes=1, threads=1)
        order = np.random.default_rng(3).permutation(COUNT)
        for what, run, bar in (
            ("one evaluation", _accelerations, FORWARD),
            ("100 steps of RK4", _fixed, MOTION),
            ("0.1 s by DOPRI5 to 1e-9", _adaptive, MOTION),
        ):
            alone = np.array([run(one, q[i], v[i]) for i in range(COUNT)])
            worst = 0.0
            for count in (1, 2, 4, 8):
                engine = compile_model(model, lanes=count)
                worst = max(worst, worst_difference(run(engine, q, v), alone))
                worst = max(worst, worst_difference(run(engine, q[order], v[order]), alone[order]))
            yield at_most(f"1 to 8 lanes beside a state alone, {what}, {name}", worst, bar, "relative")


def _accelerations(engine, q, v):
    return engine.forward(q, v)


def _fixed(engine, q, v):
    return engine.rollout(q, v, step=1e-3, steps=100).x[..., -1, :]


def _adaptive(engine, q, v):
    times = np.linspace(0, 0.1, 5)
    return engine.integrate(q, v, times, method=TABLEAUS["dopri5"], rtol=1e-9, atol=1e-9).x[..., -1, :]
