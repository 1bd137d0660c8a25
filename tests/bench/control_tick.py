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
from pantograph.sim.engines.interface import Problem
from rich.console import Console

ARM = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]
PERIOD, SHORT, LONG, ROUNDS = 1e-3, 1.0, 5.0, 9
LAWS = ("pd", "pid", "lqr", "computed-torque")


class Unknown:
    """A law that engines know nothing of, so that Python samples it."""

    def __init__(self, law) -> None:
        self.law, self.start = law, law.start

    def __call__(self, *sample):
        return self.law(*sample)


def arm(engine: str) -> Problem:
    rng = np.random.default_rng(0)
    keys = [
        {
            "joint": j,
            "times": np.linspace(0, LONG, 11),
            "values": rng.uniform(-0.4, 0.4, 11),
            "curve": "clamped",
        }
        for j in ARM
    ]
    scene = Scene(
        duration=LONG,
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
    """Runs with each law, in machine code and by Python, and the steps of physics alone, in turn."""
    return [figure for name in ("smooth", "contact") for figure in of_engine(name)]


def of_engine(name: str) -> list[Figure]:
    """What a second more of simulated time costs, so that what a run costs once is no part of it."""
    problem, engine = arm(name), make_engine(name)
    laws = {law: make_law(law, problem, {}, PERIOD) for law in LAWS}
    laws |= {f"{law} by Python": Unknown(laws[law]) for law in LAWS}

    def controlled(law: str, seconds: float):
        return engine.run(problem, (0.0, seconds), Sampled(laws[law], problem, PERIOD))

    forces = controlled("computed-torque", LONG).tick_qfrc
    runs = {law: partial(controlled, law) for law in laws}
    runs["physics"] = _steps(problem, forces) if name == "smooth" else _mujoco(problem, forces)
    times = {what: [] for what in runs}
    for again in range(ROUNDS + 1):
        for what, work in runs.items():
            took = []
            for seconds in (SHORT, LONG):
                begun = time.thread_time()
                work(seconds)
                took.append(time.thread_time() - begun)
            if again:  # the first builds and warms
                times[what].append((took[1] - took[0]) * PERIOD / (LONG - SHORT))
    took = {what: np.array(each) for what, each in times.items()}
    figures = [told(f"{name} engine, arm6: physics of 1 ms", 1e6 * float(np.median(took["physics"])), "us")]
    for law in laws:
        middle, spread = ratio(took, law, "physics")
        cost = 1e6 * float(np.median(took[law]))
        figures.append(
            told(
                f"{name} engine, {law}: 1 ms with its tick / physics", middle, "", f"{cost:.2f} us; {spread}"
            )
        )
    return figures


def _steps(problem: Problem, forces: np.ndarray):
    """The smooth engine's steps under recorded forces, compiled whole."""
    smooth = compile_model(problem.model, forces=True)
    q, v, _ = problem.state0
    u = np.hstack([np.zeros((len(forces), smooth.layout.nu - forces.shape[1])), forces])

    def run(seconds: float):
        steps = round(seconds / PERIOD)
        smooth.rollout(q, v, u[:steps], step=PERIOD, steps=steps, every=steps)

    return run


def _mujoco(problem: Problem, forces: np.ndarray):
    """MuJoCo's steps under recorded forces."""
    model, data = problem.model, mujoco.MjData(problem.model)
    model.opt.timestep = PERIOD

    def run(seconds: float):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:], _ = problem.state0
        for row in forces[: round(seconds / PERIOD)]:
            data.qfrc_applied[:] = row
            mujoco.mj_step(model, data)

    return run


PARTS = {"tick": tick}
