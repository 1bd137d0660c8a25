"""What a tick of a law costs beside the physics of its period: part of `make bench NAME=control`."""

import time
from functools import partial

import mujoco
import numpy as np
from figures import Figure, ratio, told
from pantograph.sim import Scene, make_plan
from pantograph.sim.compose import make_engine, make_law
from pantograph.sim.control import Sampled
from pantograph.sim.dynamics.smooth import compile_model
from pantograph.sim.engines.interface import Held, Problem
from rich.console import Console

ARM = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]
PERIOD, SECONDS, ROUNDS = 1e-3, 1.0, 9
LAWS = ("pd", "lqr", "computed-torque")


class Replay:
    """Controls that give what was recorded: the engine's own tick without a law."""

    def __init__(self, forces: np.ndarray, nu: int) -> None:
        self.period, self.held = PERIOD, [Held(np.zeros(nu), row) for row in forces]

    def sample(self, k, t, q, v):
        return self.held[k]


def arm(engine: str) -> Problem:
    rng = np.random.default_rng(0)
    keys = [
        {"joint": j, "times": [0, 0.5, 1.0], "values": rng.uniform(-0.4, 0.4, 3).tolist(), "curve": "clamped"}
        for j in ARM
    ]
    scene = Scene(
        duration=SECONDS,
        models=[{"file": "arm6"}],
        roles={"tracked": ARM},
        actuators={"*": "off"},
        keys=keys,
        physics={"friction": False, "contacts": "none"},
        controller={"law": "pd", "period": PERIOD},
        solver={"engine": engine, "step": PERIOD},
    )
    return make_plan(scene).problem


def tick(console: Console) -> list[Figure]:
    """Runs with each law, with its recorded forces instead, and the steps of physics alone, in turn."""
    return [figure for name in ("smooth", "contact") for figure in of_engine(name)]


def of_engine(name: str) -> list[Figure]:
    problem, engine, ticks = arm(name), make_engine(name), round(SECONDS / PERIOD)
    laws = {law: make_law(law, problem, {}, PERIOD) for law in LAWS}

    def controlled(law: str):
        return engine.run(problem, (0.0, SECONDS), Sampled(laws[law], problem, PERIOD))

    forces = controlled("computed-torque").tick_qfrc
    runs = {law: partial(controlled, law) for law in LAWS}
    replay = Replay(forces, problem.model.nu)
    runs["recorded forces"] = lambda: engine.run(problem, (0.0, SECONDS), replay)
    runs["steps"] = _steps(problem, forces) if name == "smooth" else _mujoco(problem, forces)
    times = {what: [] for what in runs}
    for again in range(ROUNDS + 1):
        for what, work in runs.items():
            begun = time.thread_time()
            work()
            if again:  # the first builds and warms
                times[what].append((time.thread_time() - begun) / ticks)
    took = {what: np.array(each) for what, each in times.items()}
    figures = [told(f"{name} engine, arm6: physics of 1 ms", 1e6 * float(np.median(took["steps"])), "us")]
    for what in ("recorded forces", *LAWS):
        middle, spread = ratio(took, what, "steps")
        figures.append(told(f"{name} engine, {what}: tick", 1e6 * float(np.median(took[what])), "us"))
        figures.append(told(f"{name} engine, {what}: tick / physics of a period", middle, "", spread))
    return figures


def _steps(problem: Problem, forces: np.ndarray):
    """The smooth engine's steps under recorded forces, compiled whole."""
    smooth = compile_model(problem.model, forces=True)
    q, v, _ = problem.state0
    u = np.hstack([np.zeros((len(forces), smooth.layout.nu - forces.shape[1])), forces])
    return lambda: smooth.rollout(q, v, u, step=PERIOD, steps=len(forces), every=len(forces))


def _mujoco(problem: Problem, forces: np.ndarray):
    """MuJoCo's steps under recorded forces."""
    model, data = problem.model, mujoco.MjData(problem.model)
    model.opt.timestep = PERIOD

    def run():
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], _ = problem.state0
        for row in forces:
            data.qfrc_applied[:] = row
            mujoco.mj_step(model, data)

    return run


PARTS = {"tick": tick}
