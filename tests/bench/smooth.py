"""The smooth engine against MuJoCo, Pinocchio and Drake. `make bench NAME=smooth` (some minutes).

Ratios of CPU time in one run, the same stripped model for every engine; medians of alternating rounds with
their spread. A part is a function that returns figures; the last line is one JSON object of all of them.
Names of parts as arguments run only those.
"""

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import mujoco
import numpy as np
import smooth_models as models
import smooth_peers as peers
from figures import absent, at_least, at_most, main, ratio
from mujoco.rollout import rollout
from pantograph.sim.compile.program import workers
from pantograph.sim.dynamics import compile_model, unsupported
from pantograph.sim.integrate import TABLEAUS
from rich.progress import track

FIVE = ("double_pendulum", "ur5", "panda", "quadruped", "humanoid")
ROLLOUT_BARS = {  # one state, batch of 4096: steps per second and core over mujoco.rollout's
    "double_pendulum": (40, 140),
    "ur5": (15, 55),
    "panda": (9, 24),
    "quadruped": (4.5, 14),
    "humanoid": (3.5, 12),
}
SPAN = 5.0  # of the motions whose error is bought [s]
FRAMES = 25  # of the motions, where every engine's error is looked at
STEPS = FRAMES * np.unique(np.round(2.0 ** np.arange(1.0, 13.01, 0.25)).astype(int))  # tried by every engine
DERIVATIVE_BARS = {"ur5": 8, "panda": 3, "quadruped": 2.5, "humanoid": 1}


def alternating(calls: dict[str, Callable[[], None]], rounds: int = 9, clock=time.process_time):
    """Seconds of each call, rounds taken in turn: {name: array}."""
    for call in calls.values():
        call()
    out = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            begin = clock()
            call()
            out[name].append(clock() - begin)
    return {name: np.array(values) for name, values in out.items()}


# ---- agreement


def agreement(console):
    names = [p.stem for p in sorted(models.MJCF.glob("*.xml"))]
    names += [*models.ROBOTS, "ur5", "panda", "chain of 40 hinges", "chain of ball joints"]
    for name in track(names, "agreement with MuJoCo"):
        model = models.load(name)
        title = f"qacc against MuJoCo, {name}"
        if model is None:
            yield absent(title, "its data is not here")
            continue
        models.unconstrained(model)
        if missing := unsupported(model):
            yield absent(title, f"not supported: {missing[0]}")
            continue
        smooth = compile_model(model)
        q, v, act, u = models.states(model, 1000)
        a, data, worst = smooth.forward(q, v, u, act=act), mujoco.MjData(model), 0.0
        for i in range(1000):
            data.qpos[:], data.qvel[:], data.act[:], data.ctrl[:] = q[i], v[i], act[i], u[i]
            mujoco.mj_forward(model, data)
            worst = max(worst, np.abs(a[i] - data.qacc).max() / max(np.abs(data.qacc).max(), 1e-9))
        yield at_most(title, worst, 1e-10, "", f"1000 states, {smooth.stats.operations} operations")


def lanes(console):
    for name in FIVE:
        model = models.load(name)
        if model is None:
            yield absent(f"lanes, {name}", "its data is not here")
            continue
        model = models.stripped(model)
        q, v, _, _ = models.states(model, 13)
        alone = compile_model(model, lanes=1).forward(q, v)
        worst = 0.0
        for count in (2, 4, 8):
            got = compile_model(model, lanes=count).forward(q, v)
            worst = max(worst, np.abs(got - alone).max() / np.abs(alone).max())
        yield at_most(f"1, 2, 4 and 8 lanes differ by, {name}", worst, 1e-12)


# ---- speed


def rollouts(console):
    for name in FIVE:
        source = models.load(name)
        if source is None:
            yield absent(f"RK4 steps, {name}", "its data is not here")
            continue
        model = models.stripped(source)
        model.opt.integrator, model.opt.timestep = int(mujoco.mjtIntegrator.mjINT_RK4), 1e-3
        smooth = compile_model(model, threads=1)
        for count, bar in zip((1, 4096), ROLLOUT_BARS[name], strict=True):
            ours, theirs = (20000, 2000) if count == 1 else (24, 3)
            q, v, _, _ = models.states(model, count)
            v *= 0.3
            start = np.concatenate([np.zeros((count, 1)), q, v], axis=1)
            data, nothing = mujoco.MjData(model), np.zeros((count, theirs, 0))
            start_q, start_v = (q[0], v[0]) if count == 1 else (q, v)

            def ours_(q=start_q, v=start_v, n=ours, smooth=smooth):
                smooth.rollout(q, v, step=1e-3, steps=n)

            def theirs_(model=model, data=data, start=start, n=theirs, nothing=nothing):
                rollout(model, data, start, nstep=n, control=None)

            times = alternating({"mujoco": theirs_, "smooth": ours_})
            times["mujoco"] /= theirs * count
            times["smooth"] /= ours * count
            r, spread = ratio(times, "mujoco", "smooth")
            rate = 1e-6 / np.median(times["smooth"])
            detail = f"{rate:.3g} million steps/s, spread {spread}"
            yield at_least(f"RK4 steps over mujoco.rollout, {name}, {count}", r, bar, "x", detail)


def two_cores(console):
    if workers() < 2:
        yield absent("two cores", "one core here")
        return
    model = models.stripped(models.load("quadruped"))
    q, v, _, _ = models.states(model, 4096)
    engines = {n: compile_model(model, threads=n) for n in (1, 2)}
    calls = {
        str(n): lambda e=e: e.rollout(q, 0.3 * v, step=1e-3, steps=60, every=60) for n, e in engines.items()
    }
    times = alternating(calls, rounds=15, clock=time.perf_counter)
    best = times["1"].min() / times["2"].min()
    _, spread = ratio(times, "1", "2")
    yield at_least(
        "two cores over one, quadruped, 4096", best, 1.8, "x", f"wall time, best of 15; spread {spread}"
    )


REPEATS = 100


def _on_states(smooth, name, **arrays):
    """Function `name` on the states again and again, without Python in between."""
    bound = smooth.bind(name, len(arrays["q"]))
    for key, array in arrays.items():
        bound.inputs[key][:] = array

    def call():
        for _ in range(REPEATS):
            bound()

    return call


def pinocchio(console):
    binary = peers.program()
    if isinstance(binary, str):
        yield absent("Pinocchio", binary)
        return
    for name in track(FIVE, "Pinocchio"):
        source = models.load(name)
        if source is None:
            yield absent(f"Pinocchio, {name}", "its data is not here")
            continue
        model = models.stripped(source)
        n = 64  # as many states as Pinocchio goes round
        q, v, _, _ = models.states(model, n)
        tau = np.random.default_rng(1).normal(size=v.shape)
        bar = np.random.default_rng(2).normal(size=(n, model.nq + model.nv))
        one, batch = compile_model(model, lanes=1, threads=1), compile_model(model, threads=1)
        calls = {
            "forward 1": _on_states(one, "forward", q=q, v=v, tau=tau),
            "forward": _on_states(batch, "forward", q=q, v=v, tau=tau),
            "derivatives 1": _on_states(one, "derivatives", q=q, v=v, tau=tau),
            "derivatives": _on_states(batch, "derivatives", q=q, v=v, tau=tau),
            "vjp 1": _on_states(one, "vjp", q=q, v=v, tau=tau, bar=bar),
        }
        aba, derivatives, a = peers.pinocchio(binary, model, q, v, tau)
        times = alternating(calls, rounds=5)
        again = peers.pinocchio(binary, model, q, v, tau)
        aba, derivatives = (aba + again[0]) / 2, (derivatives + again[1]) / 2
        ns = {k: np.median(x) / (n * REPEATS) * 1e9 for k, x in times.items()}
        worst = np.abs(one.forward(q, v, tau=tau) - a).max() / np.abs(a).max()
        yield at_most(f"qacc against Pinocchio, {name}", worst, 1e-10)
        seen = f"Pinocchio's ABA {aba:.0f} ns, one lane {ns['forward 1']:.0f}, lanes {ns['forward']:.0f}"
        yield at_least(f"forward dynamics over Pinocchio, {name}", aba / ns["forward 1"], 1, "x", seen)
        if name in DERIVATIVE_BARS:
            seen = f"Pinocchio {derivatives / 1e3:.2f} us, one lane {ns['derivatives 1'] / 1e3:.2f} us"
            r = derivatives / ns["derivatives 1"]
            yield at_least(
                f"derivatives over Pinocchio, {name}, one state", r, DERIVATIVE_BARS[name], "x", seen
            )
            r, seen = derivatives / ns["derivatives"], f"{ns['derivatives'] / 1e3:.2f} us"
            yield at_least(f"derivatives over Pinocchio, {name}, batch", r, 4, "x", seen)
        if name == "humanoid":
            r, seen = derivatives / ns["vjp 1"], f"one lane {ns['vjp 1'] / 1e3:.2f} us"
            yield at_least("vector-Jacobian product over Pinocchio's derivatives, humanoid", r, 5, "x", seen)


def drake(console):
    python = peers.drake_python()
    if isinstance(python, str):
        yield absent("Drake", python)
        return
    for name in track(FIVE, "Drake"):
        source = models.load(name)
        if source is None:
            yield absent(f"Drake, {name}", "its data is not here")
            continue
        model = models.stripped(source)
        q, v, _, _ = models.states(model, 64)
        tau = np.random.default_rng(1).normal(size=v.shape)
        one, batch = compile_model(model, lanes=1, threads=1), compile_model(model, threads=1)
        calls = {
            "one": _on_states(one, "forward", q=q, v=v, tau=tau),
            "batch": _on_states(batch, "forward", q=q, v=v, tau=tau),
        }
        before = peers.drake(python, model, q, v, tau)
        if isinstance(before, str):
            yield absent(f"Drake, {name}", before)
            continue
        times = alternating(calls, rounds=5)
        after = peers.drake(python, model, q, v, tau)
        theirs, off = (before[0] + after[0]) / 2, (before[1] + after[1]) / 2
        ns = {k: np.median(x) / (len(q) * REPEATS) * 1e9 for k, x in times.items()}
        worst = np.abs(one.forward(q, v, tau=tau) - before[2]).max() / np.abs(before[2]).max()
        yield at_most(f"qacc against Drake, {name}", worst, 1e-10)
        seen = f"Drake's evaluation {theirs:.0f} ns (before ours {before[0]:.0f}, after {after[0]:.0f}), its "
        seen += f"Python calls of {off:.0f} ns measured on cached answers and taken off; "
        seen += f"one lane {ns['one']:.0f}, lanes {ns['batch']:.0f}"
        yield at_least(f"forward dynamics over Drake, {name}", theirs / ns["one"], 1, "x", seen)


# ---- accuracy for its price


def to_an_error(console):
    """CPU time to a maximal error over the trajectory, against MuJoCo's integrators at their best steps."""
    for name, bars in (("double_pendulum", {1e-6: 80}), ("ur5", {1e-6: 30, 1e-9: 40})):
        model = models.stripped(models.load(name))
        smooth = compile_model(model)
        q, v = np.linspace(0.5, 1.5, model.nq), np.zeros(model.nv)
        times = np.linspace(0.0, SPAN, FRAMES + 1)
        exact = smooth.rollout(
            q, v, step=SPAN / 2e4, steps=20000, every=20000 // FRAMES, method=TABLEAUS["verner98"]
        ).q
        check = smooth.integrate(q, v, times, method=TABLEAUS["dop853"], rtol=1e-13, atol=1e-13).q
        theirs = _mujoco_costs(model, q, v, exact)
        ours = _our_costs(smooth, q, v, times, exact)
        for tolerance, bar in bars.items():
            slow, slow_by = _cheapest(theirs, tolerance)
            fast, fast_by = _cheapest(ours, tolerance)
            detail = f"{slow_by} {slow * 1e3:.3g} ms, {fast_by} {fast * 1e6:.3g} us, "
            detail += f"reference uncertain by {np.abs(check - exact).max():.1e}"
            yield at_least(f"CPU time to an error of {tolerance:g}, {name}", slow / fast, bar, "x", detail)


def _cheapest(costs, tolerance):
    good = [(seconds, label) for label, error, seconds in costs if error <= tolerance]
    return min(good) if good else (np.inf, "never")


def _cpu(call, rounds=7):
    repeat = 1
    while True:
        begin = time.process_time()
        for _ in range(repeat):
            call()
        spent = time.process_time() - begin
        if spent > 0.01:
            break
        repeat *= 4
    out = []
    for _ in range(rounds):
        begin = time.process_time()
        for _ in range(repeat):
            call()
        out.append((time.process_time() - begin) / repeat)
    return float(np.median(out))


def _mujoco_costs(model, q, v, exact):
    out = []
    start = np.concatenate([[0.0], q, v])[None]
    for integrator in ("EULER", "IMPLICIT", "IMPLICITFAST", "RK4", "DISCRETE"):
        model.opt.integrator = int(getattr(mujoco.mjtIntegrator, f"mjINT_{integrator}"))
        for steps in STEPS:  # MuJoCo records every step
            if integrator != "RK4" and steps > FRAMES * 2**11:
                continue
            model.opt.timestep = SPAN / steps
            data = mujoco.MjData(model)

            def call(data=data, steps=steps):
                return rollout(model, data, start, nstep=steps, control=None)[0]

            path = call()[0, steps // FRAMES - 1 :: steps // FRAMES, 1 : 1 + model.nq]
            error = np.abs(path - exact[1:]).max()
            out.append((f"MuJoCo {integrator} {steps} steps", error, _cpu(call, rounds=3)))
            if error < 1e-10:
                break
    return out


def _our_costs(smooth, q, v, times, exact):
    """Costs of fixed steps and of adaptive ones, as a user calls them."""
    out = []
    for name, method in TABLEAUS.items():
        for n in STEPS[STEPS < 1e5] if method.order > 2 else ():

            def fixed(method=method, n=int(n)):
                return smooth.rollout(q, v, step=SPAN / n, steps=n, every=n // FRAMES, method=method)

            out.append((f"{name} {n} steps", np.abs(fixed().q - exact).max(), _cpu(fixed)))
        for exponent in np.arange(-13, -3, 0.5) if method.adaptive and method.order > 3 else ():

            def adaptive(method=method, tolerance=10.0**exponent):
                return smooth.integrate(q, v, times, method=method, rtol=tolerance, atol=tolerance)

            label = f"{name} to {10.0**exponent:.0e}"
            out.append((label, np.abs(adaptive().q - exact).max(), _cpu(adaptive)))
    return out


# ---- waiting


FIRST_USE = """
import json, sys, time
from pathlib import Path
sys.path.insert(0, sys.argv[1])
import numpy as np
import smooth_models as models
clock = time.process_time  # other programs on the machine do not count
begin = clock()
import llvmlite.binding
from pantograph.sim.dynamics import compile_model
imported = clock() - begin
model = models.stripped(models.load(sys.argv[3]))
q, v, _, _ = models.states(model, 64)
begin = clock()
smooth = compile_model(model, cache=Path(sys.argv[2]))
smooth.forward(q[0], v[0])
one = clock() - begin
smooth.rollout(q, v, step=1e-3, steps=10)
print(json.dumps([imported, one, clock() - begin]))
"""


def first_use(console):
    here = str(Path(__file__).parent)
    for name, bar in (("ur5", 0.5), ("humanoid", 3.0)):
        if models.load(name) is None:
            yield absent(f"first use, {name}", "its data is not here")
            continue
        runs = {"first": [], "second": []}
        for _ in range(3):
            with tempfile.TemporaryDirectory() as folder:
                for kind in runs:
                    out = subprocess.run(
                        [sys.executable, "-c", FIRST_USE, here, folder, name],
                        capture_output=True,
                        text=True,
                        check=True,
                    )
                    runs[kind].append(json.loads(out.stdout))
        first, second = (np.median(runs[kind], axis=0) for kind in ("first", "second"))
        detail = f"one forward dynamics after {first[1]:.2g} s; imports {first[0]:.2g} s beside"
        yield at_most(f"first use: a function and a batch's rollout, {name}", first[2], bar, "CPU s", detail)
        seen = f"{second[2] * 1e3:.1f} ms"
        yield at_least(f"second use quicker, {name}", first[2] / second[2], 10, "x", seen)


PARTS = {
    "agreement": agreement,
    "lanes": lanes,
    "rollouts": rollouts,
    "two_cores": two_cores,
    "pinocchio": pinocchio,
    "drake": drake,
    "to_an_error": to_an_error,
    "first_use": first_use,
}


if __name__ == "__main__":
    sys.exit(main("smooth", PARTS))
