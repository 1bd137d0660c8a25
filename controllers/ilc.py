"""Iterative learning control: what a law left wrong on one run of a clip, the next run knows beforehand.

u_{j+1} = S (u_j + gain (law(x_j) - law(x_d))), S a low pass without phase: what feedback had to add becomes
known beforehand. The error shrinks by |1 - gain T| a trial, T the closed loop's complementary sensitivity
(M. Kawato, K. Furukawa, R. Suzuki, Biological Cybernetics 57, 1987; D. Bristow, M. Tharayil, A. Alleyne, IEEE
Control Systems Magazine 26, 2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.signal import butter, sosfiltfilt

from ..sim.control import Law, Sampled, Target
from ..sim.engines.interface import Engine, Problem
from ..sim.errors import PantographError
from .gains import positive
from .nominal import difference

Array = NDArray[np.float64]


class Trace(NamedTuple):
    """Memory of a run: the law's own, and what was seen: (error, feedback, all before), newest first."""

    law: Any
    seen: tuple[Array, Array, Any] | None


class Repeated:
    """``law`` with forces ``learned`` (ticks, nv) added, one row a ``period`` [s]; it remembers its errors
    and what its feedback added."""

    def __init__(self, law: Law, model: mujoco.MjModel, learned: Array, period: float) -> None:
        self.law, self.model, self.learned, self.period = law, model, learned, period

    def start(self) -> Trace:
        """Nothing seen yet."""
        return Trace(self.law.start(), None)

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: Trace) -> tuple[Array, Trace]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        tick = min(round(t / self.period), len(self.learned) - 1)
        tau, inner = self.law(t, q, v, target, memory.law)
        on_target, _ = self.law(t, target.q, target.v, target, memory.law)
        error = difference(self.model, q, target.q)
        return tau + self.learned[tick], Trace(inner, (error, tau - on_target, memory.seen))


def seen_in(memory: Trace) -> tuple[Array, Array]:
    """Position errors and feedback forces (ticks, nv) of a finished run."""
    errors, feedback, seen = [], [], memory.seen
    while seen is not None:
        errors.append(seen[0])
        feedback.append(seen[1])
        seen = seen[2]
    return np.array(errors[::-1]), np.array(feedback[::-1])


@dataclass(frozen=True, eq=False)
class Learned:
    """Learned forces (ticks, nv) of the best trial, and the RMS error [rad, m] of every trial."""

    forces: Array
    errors: tuple[float, ...]


def learn(
    law: Callable[[], Law],
    problem: Problem,
    engine: Engine,
    period: float,
    *,
    trials: int = 10,
    gain: float = 1.0,
    corner: float = 20.0,
    tracked: NDArray[np.bool_],
    progress: Callable[[int, float], None] | None = None,
) -> Learned:
    """Run ``problem`` again and again under ``law`` and learn the forces that it lacks.

    ``gain`` in (0, 1]: part of the feedback that one trial takes over; ``corner`` [Hz]: what is faster is not
    learned. Raises PantographError when a run diverges.
    """
    share, ticks = positive("gain", gain), int(np.ceil(problem.duration / period - 1e-9))
    filter = butter(2, min(0.99, 2.0 * positive("corner", corner) * period), output="sos")
    forces, best, history = np.zeros((ticks, problem.model.nv)), None, []
    for trial in range(trials):
        controls = Sampled(Repeated(law(), problem.model, forces, period), problem, period)
        segment = engine.run(problem, (0.0, problem.duration), controls)
        if segment.status != "done":
            raise PantographError(f"trial {trial + 1} {segment.message or segment.status}: learn more slowly")
        error, feedback = seen_in(controls.memory)
        history.append(float(np.sqrt(np.mean(error[:, tracked] ** 2))))
        if best is None or history[-1] <= min(history[:-1]):
            best = forces
        if progress:
            progress(trial, history[-1])
        wanted = forces + share * np.where(tracked, feedback, 0.0)
        forces = np.asarray(sosfiltfilt(filter, wanted, axis=0)) if ticks > 12 else wanted
    assert best is not None
    return Learned(best, tuple(history))
