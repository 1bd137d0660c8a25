"""Speed: rollouts beside MuJoCo's, dynamics and derivatives beside Pinocchio's and Drake's."""

import time

import mujoco
import numpy as np
from figures import absent, at_least, at_most, ratio, told
from mujoco.rollout import rollout
from pantograph.sim.compile.program import workers
from pantograph.sim.dynamics import compile_model
from rich.progress import track

from . import models, peers
from .agreement import NO_DATA, STATES, worst_difference
from .clock import alternating

ROLLOUT_BARS = {  # one state, batch of 4096: steps per second and core over mujoco.rollout's
    "double_pendulum": (40, 140),
    "ur5": (15, 55),
    "panda": (9, 24),
    "quadruped": (4.5, 14),
    "humanoid": (3.5, 12),
}
STEPS = {1: 2000, 4096: 8}  # of 1 ms, by the number of states
ROUNDS = {1: 9, 4096: 5}
DERIVATIVE_BARS = {"ur5": 8, "panda": 3, "quadruped": 2.5, "humanoid": 1}
BATCH_BAR, PRODUCT_BAR = 4, 5  # of the humanoid's derivatives


def rollouts(console):
    """RK4 on one core, every state recorded: the same steps from the same states, called from Python."""
    for name, bars in track(ROLLOUT_BARS.items(), "rollouts", console=console):
        source = models.load(name)
        if source is None:
            yield absent(f"RK4 steps, {name}", NO_DATA)
            continue
        model = models.stripped(source)
        model.opt.integrator, model.opt.timestep = int(mujoco.mjtIntegrator.mjINT_RK4), 1e-3
        smooth, data = compile_model(model, threads=1), mujoco.MjData(model)
        for count, bar in zip(STEPS, bars, strict=True):
            steps = STEPS[count]
            q, v, _, _ = models.states(model, count, spread=0.3)  # farther, some humanoids whirl apart
            v *= 0.3
            start, nothing = np.concatenate([np.zeros((count, 1)), q, v], axis=1), np.zeros((count, steps, 0))
            start_q, start_v = (q[0], v[0]) if count == 1 else (q, v)

            def ours(q=start_q, v=start_v, n=steps, smooth=smooth):
                return smooth.rollout(q, v, step=1e-3, steps=n).x[..., -1, :]

            def theirs(model=model, data=data, start=start, n=steps, nothing=nothing):
                return rollout(model, data, start, nstep=n, control=None)[0][:, -1, 1:]

            apart = worst_difference(np.atleast_2d(ours()), theirs())
            times = alternating({"mujoco": theirs, "smooth": ours}, ROUNDS[count])
            r, spread = ratio(times, "mujoco", "smooth")
            rates = [1e-6 * steps * count / np.median(times[who]) for who in ("smooth", "mujoco")]
            detail = f"{spread}; {rates[0]:.3g} million steps/s, MuJoCo {rates[1]:.3g}; {steps} steps of "
            detail += "4 evaluations"
            yield at_most(f"ends of the rollouts differ by, {name}, {count}", apart, 1e-8, "relative")
            yield at_least(f"RK4 steps over mujoco.rollout, {name}, {count}", r, bar, "x", detail)


TWO_CORES = (("quadruped", 60, 1.8), ("double_pendulum", 60, 1.8), ("double_pendulum", 8, None))
"""Models, steps and bars: much work a state, little beside what is written, and calls that are soon over."""


def two_cores(console):
    """Wall time of a batch's rollout, every state recorded, on one core over that on two."""
    if workers() < 2:
        yield absent("two cores", "one core here")
        return
    for name, steps, bar in TWO_CORES:
        model = models.stripped(models.load(name))
        q, v, _, _ = models.states(model, 4096)
        engines = {n: compile_model(model, threads=n) for n in (1, 2)}
        calls = {
            str(n): lambda e=e, q=q, v=v, n=steps: e.rollout(q, 0.3 * v, step=1e-3, steps=n)
            for n, e in engines.items()
        }
        times = alternating(calls, rounds=15, clock=time.perf_counter)
        r, spread = ratio(times, "1", "2")
        best, alone = times["1"].min() / times["2"].min(), _longer_thread(calls)
        detail = f"wall time of {1e3 * times['1'].min():.3g} ms on one; {spread}; least times {best:.3g}, by "
        detail += f"processor time of the longer of two threads {alone:.3g}: other programs take a core away "
        detail += "from two first"
        title = f"two cores over one, {name}, 4096 states, {steps} steps"
        yield told(title, r, "x", detail) if bar is None else at_least(title, r, bar, "x", detail)


def _longer_thread(calls, rounds=9, repeats=5):
    """Processor time on one core over that of the longer of two threads, the calling one and the other."""
    ratios = []
    for _ in range(rounds):
        spent = {}
        for threads, call in calls.items():
            everything, caller = time.process_time(), time.thread_time()
            for _ in range(repeats):
                call()
            caller = time.thread_time() - caller
            spent[threads] = max(caller, time.process_time() - everything - caller)
        ratios.append(spent["1"] / spent["2"])
    return np.median(ratios)


TIMED = {"forward": STATES, "derivatives": 64, "vjp": 64}
"""States of one call: many hide Python's part of it, few keep large answers in the processor's cache, where
Pinocchio's, written over each time, stay as well."""


def _on_states(smooth, name, **arrays):
    """Function `name` on its states at a call, from and to arrays that are there."""
    bound = smooth.bind(name, TIMED[name])
    for key, array in arrays.items():
        bound.inputs[key][:] = array[: TIMED[name]]
    return bound


def _given(model):
    """States and forces that every engine goes round."""
    q, v, _, _ = models.states(model, STATES)
    return q, v, np.random.default_rng(1).normal(size=v.shape)


def pinocchio(console):
    """Its C++ compiled for this processor, beside one call of ours on as many states; all models agree."""
    binary = peers.program()
    if isinstance(binary, str):
        yield absent("Pinocchio", binary)
        return
    for name in track([*models.FIVE, *models.OTHERS], "Pinocchio", console=console):
        source = models.load(name)
        if source is None:
            yield absent(f"Pinocchio, {name}", NO_DATA)
            continue
        model = models.stripped(source)
        q, v, tau = _given(model)
        peer = peers.Pinocchio(binary, model, q, v, tau)
        one = compile_model(model, lanes=1, threads=1)
        worst = worst_difference(one.forward(q, v, tau=tau), peer.accelerations())
        yield at_most(f"qacc against Pinocchio, {name}", worst, 1e-10, "relative", f"{STATES} states")
        if name in models.FIVE:
            yield from _beside_pinocchio(name, model, peer, one, q=q, v=v, tau=tau)


def _beside_pinocchio(name, model, peer, one, **given):
    batch = compile_model(model, threads=1)
    calls = {
        f"{what}{lanes}": _on_states(engine, what, **given)
        for what in ("forward", "derivatives")
        for lanes, engine in (("", one), (" in lanes", batch))
    }
    bar = np.random.default_rng(2).normal(size=(STATES, model.nq + model.nv))
    calls["vjp"] = _on_states(one, "vjp", bar=bar, **given)
    rounds = []
    for _ in range(5):  # in turn, a process of its own for Pinocchio
        theirs = peer.seconds()
        ours = alternating(calls, 1)
        rounds.append(theirs + [x[0] / TIMED[name.split()[0]] for name, x in ours.items()])
    columns = ("aba", "theirs", *calls)
    times = dict(zip(columns, np.array(rounds).T, strict=True))

    def row(title, slow, fast, bar=None):
        r, spread = ratio(times, slow, fast)
        us = [1e6 * float(np.median(times[who])) for who in (slow, fast)]
        detail = f"{spread}; C++ without Python {us[0]:.4g} us, ours {us[1]:.4g} us, with a "
        detail += f"{TIMED[fast.split()[0]]}th of a call from Python"
        return told(title, r, "x", detail) if bar is None else at_least(title, r, bar, "x", detail)

    yield row(f"forward dynamics over Pinocchio's ABA, {name}, one lane", "aba", "forward", 1)
    yield row(f"forward dynamics over Pinocchio's ABA, {name}, in lanes", "aba", "forward in lanes")
    title = f"derivatives by q, v, tau over Pinocchio's, {name}"
    if name in DERIVATIVE_BARS:
        yield row(f"{title}, one lane", "theirs", "derivatives", DERIVATIVE_BARS[name])
        is_bar = BATCH_BAR if name == "humanoid" else None
        yield row(f"{title}, in lanes", "theirs", "derivatives in lanes", is_bar)
    if name == "humanoid":
        yield row(
            "vector-Jacobian product over Pinocchio's derivatives, humanoid", "theirs", "vjp", PRODUCT_BAR
        )


def drake(console):
    """Drake from Python, since its package has no headers: cached answers tell what its calls cost."""
    python = peers.drake_python()
    if isinstance(python, str):
        yield absent("Drake", python)
        return
    for name in track(models.FIVE, "Drake", console=console):
        source = models.load(name)
        if source is None:
            yield absent(f"Drake, {name}", NO_DATA)
            continue
        model = models.stripped(source)
        q, v, tau = _given(model)
        peer, one = peers.Drake(python, model, q, v, tau), compile_model(model, lanes=1, threads=1)
        call, rounds = _on_states(one, "forward", q=q, v=v, tau=tau), []
        for _ in range(3):
            got = peer.run()
            if isinstance(got, str):
                break
            rounds.append([*got[:2], alternating({"": call}, 1)[""][0] / STATES])
        if isinstance(got, str):
            yield absent(f"Drake, {name}", got)
            continue
        times = dict(zip(("drake", "calls", "ours"), np.array(rounds).T, strict=True))
        worst = worst_difference(one.forward(q, v, tau=tau), got[2])
        yield told(f"qacc against Drake, {name}", worst, "relative", f"{STATES} states")
        r, spread = ratio(times, "drake", "ours")
        us = {who: 1e6 * float(np.median(x)) for who, x in times.items()}
        detail = (
            f"{spread}; Drake {us['drake']:.4g} us, Python's calls of {us['calls']:.4g} us taken off; ours "
        )
        detail += f"{us['ours']:.4g} us"
        yield at_least(f"forward dynamics over Drake, {name}, one lane", r, 1, "x", detail)
