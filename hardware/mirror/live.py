"""A simulation that runs a little ahead of the rig that follows it, window by window, in its own thread."""

from __future__ import annotations

import dataclasses
import queue
import threading
from math import ceil
from pathlib import Path
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.compose import make_engine, make_law
from ...sim.control import Sampled
from ...sim.engines.interface import Controls, Held, Problem, State
from ...sim.plan import Plan, make_plan
from ...sim.scene.load import load_scene
from ...sim.scene.schema import Scene
from ..errors import HardwareError
from ..mapping import Mapping, indices
from ..motion import Motion
from ..rig import Rig

Array = NDArray[np.float64]

WINDOW = 0.1  # s of motion that are computed at once, about
AHEAD = 3  # windows that are computed before they are needed


class _Later:
    """Controls whose first tick is tick `first` of the whole run."""

    def __init__(self, controls: Controls, first: int) -> None:
        self.period, self._controls, self._first = controls.period, controls, first

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        return self._controls.sample(self._first + k, t, q, v)


class Live:
    """A running simulation as a source of joint values.

    Args:
        scene: What runs.
        rig, mapping: The rig and its joints.
        patient: Wait for the simulation when it is late (virtual time); else hold and count.
    """

    def __init__(
        self, scene: Scene | Plan | str | Path, rig: Rig, mapping: Mapping, *, patient: bool
    ) -> None:
        if isinstance(scene, str | Path):
            scene = load_scene(scene)
        plan = scene if isinstance(scene, Plan) else make_plan(scene)
        self.problem: Problem = plan.problem
        self.model: mujoco.MjModel = plan.problem.model
        self.duration = self.problem.steps * self.problem.step
        base = plan.setup.scene
        self.scene: dict[str, Any] = base.model_dump(mode="json", exclude_defaults=True)
        self.patient = patient
        self.starved = 0  # targets that the simulation had not computed in time
        self._qpos, self._dofs = indices(rig, mapping, self.model)
        self._engine = make_engine(plan.engine.what)
        self._controls: Controls | None = None
        if plan.period is not None:
            item = base.controller
            law = make_law(item.law if item else "pd", plan.problem, item.parameters if item else {})
            self._controls = Sampled(law, plan.problem, plan.period)
        self._window = _window(self.problem, plan.period)
        self._ready: queue.Queue[tuple[Array, Array, Array] | str] = queue.Queue(AHEAD)
        self._parts: list[tuple[Array, Array, Array]] = []
        self._current: Motion | None = None
        self._failure = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._compute, name="live simulation", daemon=True)
        self.first: Array = self.problem.state0.q[self._qpos].copy()

    def __enter__(self) -> Live:
        self._thread.start()
        while len(self._parts) < 1:
            self._take(wait=True)
        self.first = self._parts[0][1][0][self._qpos]
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        while self._thread.is_alive():
            try:
                self._ready.get(timeout=0.05)
            except queue.Empty:
                continue
        self._thread.join()

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the report should know."""
        if not self.starved:
            return ()
        return (f"the simulation was late for {self.starved} goals; the rig held its pose meanwhile",)

    def at(self, t: float) -> Array | None:
        """Joint values (nj,) at time t [s]; those of the last moment known when it is not computed yet.

        Raises HardwareError when the simulation failed.
        """
        while self._end < min(t, self.duration) - 1e-9:
            if self._failure:
                raise HardwareError(f"the simulation stopped at t = {self._end:.3f} s: {self._failure}")
            if not self._take(wait=self.patient):
                self.starved += 1
                break
        assert self._current is not None
        return self._current.at(t)[0]

    def whole(self, t: Array) -> Array:
        """qpos (n, nq) at times (n,), as far as it was computed."""
        times = np.concatenate([p[0] for p in self._parts])
        q = np.concatenate([p[1] for p in self._parts])
        return np.asarray(q[np.clip(np.searchsorted(times, t), 0, len(times) - 1)])

    @property
    def _end(self) -> float:
        return float(self._current.t[-1]) if self._current is not None else -1.0

    def _take(self, *, wait: bool) -> bool:
        """Fetch a window from the simulation; False when there is none yet."""
        try:
            item = self._ready.get(block=wait)
        except queue.Empty:
            return False
        if isinstance(item, str):
            self._failure = item
            if not self._parts:
                raise HardwareError(f"the simulation did not start: {item}")
            return True
        self._parts.append(item)
        t, q, v = item
        q, v = q[:, self._qpos], v[:, self._dofs]
        self._current = Motion(t, q, v, np.zeros_like(v))
        return True

    def _compute(self) -> None:
        """The thread: windows, one after the other, each from the state where the last ended."""
        problem, h = self.problem, self.problem.step
        state, step = problem.state0, 0
        try:
            while step < problem.steps and not self._stop.is_set():
                n = min(self._window, problem.steps - step)
                controls = self._controls
                if controls is not None:
                    controls = _Later(controls, round(step * h / controls.period))
                part = dataclasses.replace(problem, state0=state)
                segment = self._engine.run(part, (step * h, (step + n) * h), controls)
                if segment.status != "done":
                    self._put(segment.message or segment.status)
                    return
                self._put((segment.t, segment.q, segment.v))
                state = State(segment.q[-1].copy(), segment.v[-1].copy(), segment.act[-1].copy())
                step += n
        except Exception as e:
            self._put(str(e))

    def _put(self, item: tuple[Array, Array, Array] | str) -> None:
        while not self._stop.is_set():
            try:
                self._ready.put(item, timeout=0.1)
                return
            except queue.Full:
                continue


def _window(problem: Problem, period: float | None) -> int:
    """Steps of a window: whole samples and whole controller periods."""
    steps = problem.sample_every
    if period is not None:
        steps = int(np.lcm(steps, round(period / problem.step)))
    return steps * max(1, ceil(WINDOW / (steps * problem.step)))
