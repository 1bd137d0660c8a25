"""A simulation that runs a little ahead of the rig that follows it, in a process of its own."""

from __future__ import annotations

import pickle
import queue
import signal
import subprocess
import sys
import threading
from contextlib import suppress
from types import TracebackType
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...sim.plan import Plan
from ...sim.scene.schema import Scene
from ..errors import HardwareError, SourceFault
from ..mapping import Mapping, indices
from ..motion import Motion
from ..rig import Rig

Array = NDArray[np.float64]
Window = tuple[Array, Array, Array]

_PATIENCE = 1.0  # s that a process whose pipe is closed has to end
AHEAD = 3  # windows that are computed before they are needed


class Live:
    """A running simulation as a source of joint values; a context manager.

    Args:
        plan: What runs.
        rig, mapping: The rig and its joints.
        patient: Wait for the simulation when it is late (virtual time); else hold and count.
    """

    def __init__(self, plan: Plan, rig: Rig, mapping: Mapping, *, patient: bool) -> None:
        self.model: mujoco.MjModel = plan.problem.model
        self.duration = plan.problem.steps * plan.problem.step
        self._scene = plan.setup.scene
        self.scene: dict[str, Any] = self._scene.model_dump(mode="json", exclude_defaults=True)
        self.patient = patient
        self.starved = 0  # targets that the simulation had not computed in time
        self._qpos, self._dofs = indices(rig, mapping, self.model)
        self._ready: queue.Queue[Window | str] = queue.Queue(AHEAD)
        self._parts: list[Window] = []
        self._current: Motion | None = None
        self._failure = ""
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._receive, name="live simulation", daemon=True)
        self.first: Array = plan.problem.state0.q[self._qpos].copy()

    def __enter__(self) -> Live:
        # A session of its own: Ctrl-C is the mirror's business, also while the process loads.
        self._process = subprocess.Popen(
            [sys.executable, "-m", f"{__package__}.windows"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            start_new_session=True,
        )
        self._thread.start()
        try:
            self._send(self._scene)
            self._take(wait=True)
        except BaseException:  # nothing else ends the process and the thread then
            self.__exit__(None, None, None)
            raise
        self.first = self._parts[0][1][0][self._qpos]
        return self

    def _send(self, scene: Scene) -> None:
        """The scene to the process; one that ended before is left to `_take`, which is told why."""
        try:
            data = pickle.dumps(scene)
        except Exception as e:
            raise HardwareError(f"a simulation beside the rig cannot take this scene: {e}") from e
        assert self._process.stdin is not None
        with suppress(OSError), self._process.stdin as pipe:
            pipe.write(data)

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop.set()
        self._process.kill()
        self._process.wait()
        self._thread.join()
        assert self._process.stdout is not None
        self._process.stdout.close()

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the report should know."""
        if not self.starved:
            return ()
        return (f"the simulation was late for {self.starved} goals; the rig held its pose meanwhile",)

    def at(self, t: float) -> Array | None:
        """Joint values (nj,) at time t [s]; those of the last moment known when it is not computed yet.

        Raises SourceFault when the simulation failed.
        """
        while self._end < min(t, self.duration) - 1e-9:
            if self._failure:
                raise SourceFault(f"the simulation stopped at t = {self._end:.3f} s: {self._failure}")
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

    def _receive(self) -> None:
        """The thread: from the process to the queue, which is told how it ended in any case."""
        assert self._process.stdout is not None
        item: Window | str | None
        while not self._stop.is_set():
            try:
                item = pickle.load(self._process.stdout)
            except EOFError:
                item = self._ending()
            except Exception as e:  # torn bytes raise nearly anything
                item = f"{self._ending()} in the middle of a window ({type(e).__name__}: {e})"
            if item is None:
                return
            self._put(item)
            if isinstance(item, str):
                return

    def _ending(self) -> str:
        """How the process ended; one that still runs has nothing more to say and is ended."""
        try:
            code = self._process.wait(_PATIENCE)
        except subprocess.TimeoutExpired:
            self._process.kill()
            return "what its process sends is no motion"
        if code < 0:
            return f"its process was ended by signal {-code} ({signal.strsignal(-code)})"
        return f"its process ended with exit status {code}"

    def _put(self, item: Window | str) -> None:
        while not self._stop.is_set():
            try:
                self._ready.put(item, timeout=0.1)
                return
            except queue.Full:
                continue
