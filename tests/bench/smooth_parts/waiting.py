"""What a user waits for: a whole process from its start to the first results, imports and compilation too."""

import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from figures import absent, at_least, at_most, told
from rich.progress import track

from . import models
from .agreement import NO_DATA

BARS = {"ur5": 0.5, "humanoid": 3.0}  # [s]
QUICKER, ROUNDS = 10, 5
PARTS = ("Python", "numpy", "mujoco", "pantograph", "llvmlite", "the model", "first accelerations", "batch")
PROCESS = """
import time
seen = [time.monotonic()]
lap = lambda: seen.append(time.monotonic())
import sys, json
sys.modules["torch"] = None  # its import fails
import numpy as np; lap()
import mujoco; lap()
started = []  # programs, after those of MuJoCo's own imports
sys.addaudithook(lambda event, _: started.append(event) if event.startswith(STARTS) else None)
from pantograph.sim.dynamics import compile_model; lap()
import llvmlite.binding; lap()
from pathlib import Path
model = mujoco.MjModel.from_xml_path(sys.argv[1]); lap()
states = np.load(sys.argv[2])
smooth = compile_model(model, cache=Path(sys.argv[3]))
a = smooth.forward(states["q"][0], states["v"][0]); lap()
path = smooth.rollout(states["q"], states["v"], step=1e-3, steps=10); lap()
built = [build.name for build in smooth.stats.builds]
said = {"built": built, "started": len(started), "finite": bool(np.isfinite(path.x).all())}
print(json.dumps(said | {"seen": seen, "cpu": time.process_time()}))
""".replace("STARTS", '("subprocess.Popen", "os.fork", "os.exec", "os.posix_spawn", "os.system")')


def _process(*arguments):
    """Seconds of PARTS, and what else the process says; without compilers within reach."""
    environment = {**os.environ, "PATH": "", "CUDA_VISIBLE_DEVICES": ""}
    begin = time.monotonic()
    done = subprocess.run(
        [sys.executable, "-c", PROCESS, *arguments],
        capture_output=True, text=True, check=True, env=environment,
    )  # fmt: skip
    said = json.loads(done.stdout)
    return np.diff([begin, *said["seen"]]), said


def first_use(console):
    """Fresh processes, the first with an empty cache folder, the second with what the first left there."""
    for name, bar in track(BARS.items(), "first use", console=console):
        source = models.load(name)
        if source is None:
            yield absent(f"first use, {name}", NO_DATA)
            continue
        runs = {"first": [], "second": []}
        with tempfile.TemporaryDirectory() as folder:
            xml, given = Path(folder) / "model.xml", Path(folder) / "states.npz"
            model = models.stripped(source)
            mujoco.mj_saveLastXML(str(xml), model)
            q, v, _, _ = models.states(model, 64, spread=0.3)
            np.savez(given, q=q, v=v)
            _process(xml, given, Path(folder) / "warm")  # libraries into the system's memory
            busy = []
            for k in range(ROUNDS):
                for kind, found in runs.items():
                    seconds, said = _process(xml, given, Path(folder) / f"cache{k}")
                    found.append(seconds)
                    busy += [said["cpu"]] * (kind == "first")
        yield from _told(name, bar, np.array(runs["first"]), np.array(runs["second"]), np.median(busy))
        yield at_most(f"derivatives built unasked, {name}", said["built"].count("derivatives"), 0)
        bad = said["started"] + (not said["finite"])
        yield at_most(f"programs started without compiler, GPU and torch, {name}", bad, 0)


def _told(name, bar, first, second, busy):
    parts = dict(zip(PARTS, np.median(first, axis=0), strict=True))
    spread = np.quantile(first.sum(axis=1), [0.25, 0.75])
    detail = f"quartiles {spread[0]:.3g} to {spread[1]:.3g}, processor time {busy:.3g}; "
    detail += ", ".join(f"{part} {seconds:.3f}" for part, seconds in parts.items())
    whole = float(np.median(first.sum(axis=1)))
    yield at_most(f"first use, {name}: start of the process to a batch's rollout", whole, bar, "s", detail)
    again = np.median(second, axis=0)
    detail = f"{1e3 * again[:-2].sum():.0f} ms of it imports and the model"
    yield told(f"second use, {name}: start of the process to a batch's rollout", again.sum(), "s", detail)
    built = np.array([x[:, -2:].sum(axis=1) for x in (first, second)])
    detail = f"{1e3 * np.median(built[0]):.0f} ms to {1e3 * np.median(built[1]):.2g} ms; the whole process "
    detail += f"{whole / again.sum():.2g}x, since imports are as before"
    r = float(np.median(built[0] / built[1]))
    yield at_least(f"second use quicker, {name}: building, compiling, first results", r, QUICKER, "x", detail)
