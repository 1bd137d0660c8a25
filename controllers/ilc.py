"""Iterative learning control: what a law left wrong on one run of a clip, the next run knows beforehand.

u_{j+1} = S (u_j + share (law(x_j) - law(x_d))), S a low pass without phase: what feedback had to add becomes
known beforehand. The error shrinks by |1 - share T| a repeat, T the closed loop's complementary sensitivity
(M. Kawato, K. Furukawa, R. Suzuki, Biological Cybernetics 57, 1987; D. Bristow, M. Tharayil, A. Alleyne, IEEE
Control Systems Magazine 26, 2006).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.compile.cache import key_of, source
from ..sim.control import Law, Sampled, Target
from ..sim.engines.common import Broken
from ..sim.engines.interface import Engine, Problem, Role
from ..sim.errors import PantographError
from ..sim.formula import Expressed, Formula, Symbols
from .gains import positive, whole
from .nominal import difference

Array = NDArray[np.float64]


class Trace(NamedTuple):
    """Memory of a run: the law's own, and what was seen: (error, feedback, all before), newest first."""

    law: Any
    seen: tuple[Array, Array, Any] | None


class Fed:
    """``law`` with forces ``learned`` (ticks, nv) added, one row a ``period`` [s]."""

    def __init__(self, law: Law, learned: Array, period: float) -> None:
        self.law, self.learned, self.period = law, learned, period

    def start(self) -> Any:
        """The law's own memory."""
        return self.law.start()

    def __call__(self, t: float, q: Array, v: Array, target: Target, memory: Any) -> tuple[Array, Any]:
        """Joint forces (nv,); see :class:`~pantograph.sim.control.Law`."""
        tau, memory = self.law(t, q, v, target, memory)
        return tau + self.learned[min(round(t / self.period), len(self.learned) - 1)], memory

    def formula(self, period: float) -> Formula | None:
        """See :class:`~pantograph.sim.formula.Formula`; None around a law that has none."""
        make = getattr(self.law, "formula", None)
        inner: Formula | None = None if make is None else make(period)
        if inner is None:
            return None
        nv = self.learned.shape[1]

        def rows(first: int, targets: Target) -> Array:
            ticks = np.minimum(np.arange(first, first + len(targets.q)), len(self.learned) - 1)
            return np.hstack([self.learned[ticks], inner.rows(first, targets)])

        def express(q: Symbols, v: Symbols, row: Symbols, gains: Symbols, memory: Symbols) -> Expressed:
            tau, after = inner.express(q, v, row[nv:], gains, memory)
            return [x + more for x, more in zip(tau, row[:nv], strict=True)], after

        key = key_of(source(__file__), inner.key)
        return replace(inner, key=key, width=nv + inner.width, rows=rows, express=express)


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
    """Learned forces (ticks, nv), one row a ``period`` [s], of the best repeat, and the RMS error [rad, m] of
    every repeat, infinite for one that did not reach its end."""

    forces: Array
    period: float
    errors: tuple[float, ...]

    def save(self, path: str | Path) -> Path:
        """Write the forces to a file (.npz), for the controller's word ``learned``."""
        path = Path(path)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            with path.open("wb") as f:
                np.savez_compressed(f, forces=self.forces, period=self.period)
        except OSError as e:
            raise PantographError(f"cannot write {path}: {e.strerror or e}") from None
        return path


def load_learned(path: object, nv: int, period: float) -> Array:
    """Forces (ticks, nv) from a file that :meth:`Learned.save` wrote for this model and ``period`` [s].

    Raises PantographError for files that cannot be read or are of another model or period.
    """
    try:
        with np.load(Path(str(path)), allow_pickle=False) as file:
            forces, made = np.asarray(file["forces"], dtype=np.float64), float(file["period"])
    except (OSError, KeyError, ValueError) as e:
        raise PantographError(
            f"learned: cannot read forces from {path}: {e}; 'pantograph control --compare ilc' writes them"
        ) from None
    if forces.ndim != 2 or forces.shape[1] != nv or not len(forces):
        raise PantographError(
            f"learned: {path} has forces of shape {forces.shape}; this model needs (n, {nv})"
        )
    if abs(made - period) > 1e-9 * period:
        raise PantographError(
            f"learned: {path} was learned with a period of {made:g} s; this controller's is {period:g} s"
        )
    return forces


def learn(
    law: Callable[[], Law],
    problem: Problem,
    engine: Engine,
    period: float,
    *,
    repeats: int = 10,
    share: float = 1.0,
    bandwidth: float = 20.0,
    delay: float = 0.0,
    around: Callable[[Law], Law] = lambda law: law,
    progress: Callable[[int, float], None] | None = None,
) -> Learned:
    """Run ``problem`` again and again under ``law`` and learn the forces that it lacks.

    ``share`` in (0, 1]: part of the feedback that one repeat takes over; ``bandwidth`` [Hz]: what is faster
    is not learned; ``delay`` [s]: forces are learned so much earlier; ``around`` puts the law behind sensors
    and drives. A repeat that diverges is the last one.
    Raises PantographError for parameters that make no sense.
    """
    from scipy.signal import butter, sosfiltfilt

    ticks = int(np.ceil(problem.duration / period - 1e-9))
    if positive("share", share) > 1.0:
        raise PantographError(f"share must be at most 1, all of the feedback, got {share!r}")
    filter = butter(2, min(0.99, 2.0 * positive("bandwidth", bandwidth) * period), output="sos")
    late = int(np.ceil(positive("delay", delay, zero=True) / period - 1e-9))
    tracked = problem.dofs(Role.TRACKED)
    forces, history = np.zeros((ticks, problem.model.nv)), []
    best = forces
    for repeat in range(whole("repeats", repeats)):
        controls = Sampled(around(Repeated(law(), problem.model, forces, period)), problem, period)
        error, feedback = _seen_by(engine, problem, controls)
        history.append(float(np.sqrt(np.mean(error[:, tracked] ** 2))) if len(error) else np.inf)
        if history[-1] <= min(history):
            best = forces
        if progress:
            progress(repeat, history[-1])
        if not len(error):
            break
        later = np.minimum(np.arange(ticks) + late, ticks - 1)
        wanted = forces + share * np.where(tracked, feedback[later], 0.0)
        forces = np.asarray(sosfiltfilt(filter, wanted, axis=0)) if ticks > 12 else wanted
    return Learned(best, period, tuple(history))


def _seen_by(engine: Engine, problem: Problem, controls: Sampled) -> tuple[Array, Array]:
    """Position errors and feedback forces (ticks, nv) of a run; none of one that does not reach its end."""
    try:
        status = engine.run(problem, (0.0, problem.steps * problem.step), controls).status
    except Broken:
        status = "broken"
    if status != "done":
        return np.zeros((0, problem.model.nv)), np.zeros((0, problem.model.nv))
    memory = controls.memory
    return seen_in(memory if isinstance(memory, Trace) else memory.law)
