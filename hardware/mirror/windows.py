"""A simulation computed window by window; as a program, in a process of its own for `Live`.

Program: a pickled Scene comes in on standard input. Windows go out on what was its standard output, as
pickles (t, q, v), then None; a string in place of a window says why there are no more. A full pipe makes it
wait. What a law or a library prints goes to standard error, so that it cannot tear a window.
"""

from __future__ import annotations

import dataclasses
import os
import pickle
import signal
import sys
from collections.abc import Iterator
from contextlib import suppress
from math import ceil
from typing import BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...sim.compose import make_controls, make_engine
from ...sim.engines.interface import Controls, Held, Problem, State
from ...sim.plan import Plan, make_plan
from ..errors import HardwareError

Array = NDArray[np.float64]
Window = tuple[Array, Array, Array]

LENGTH = 0.1  # s of motion in a window, about


class _Later:
    """Controls whose first tick is tick `first` of the whole run."""

    def __init__(self, controls: Controls, first: int) -> None:
        self.period, self._controls, self._first = controls.period, controls, first

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        return self._controls.sample(self._first + k, t, q, v)


def windows(plan: Plan) -> Iterator[Window]:
    """t (n,), q (n, nq), v (n, nv) of one window after the other, each from the state where the last ended.

    Raises HardwareError when the simulation diverges.
    """
    problem, h = plan.problem, plan.problem.step
    engine = make_engine(plan.engine.what)
    controls = make_controls(plan.setup.scene, problem, plan.period)
    state, step = problem.state0, 0
    while step < problem.steps:
        n = min(_steps(problem, plan.period), problem.steps - step)
        later = _Later(controls, round(step * h / controls.period)) if controls is not None else None
        part = dataclasses.replace(problem, state0=state)
        segment = engine.run(part, (step * h, (step + n) * h), later)
        if segment.status != "done":
            raise HardwareError(segment.message or segment.status)
        yield segment.t, segment.q, segment.v
        state = State(segment.q[-1].copy(), segment.v[-1].copy(), segment.act[-1].copy())
        step += n


def _steps(problem: Problem, period: float | None) -> int:
    """Steps of a window: whole samples and whole controller periods."""
    steps = problem.sample_every
    if period is not None:
        steps = int(np.lcm(steps, round(period / problem.step)))
    return steps * max(1, ceil(LENGTH / (steps * problem.step)))


def main() -> None:
    """See the module."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the mirror's business
    with suppress(BrokenPipeError), _taken_stdout() as out:  # a reader that left needs no more windows
        try:
            scene = pickle.load(sys.stdin.buffer)
            for window in windows(make_plan(scene)):
                pickle.dump(window, out)
                out.flush()
            pickle.dump(None, out)
        except BrokenPipeError:
            raise
        except Exception as e:
            pickle.dump(str(e) or type(e).__name__, out)


def _taken_stdout() -> BinaryIO:
    """Standard output as a file of its own; descriptor 1 is standard error from now on."""
    sys.stdout.flush()
    out = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)
    return out


if __name__ == "__main__":
    main()
