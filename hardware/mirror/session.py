"""One rig from scan to stop: the order of the safety contract, and what happens when it is left early."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..driver import Driver, NoAnswer, Refused
from ..errors import BusError, SourceFault
from ..mapping import Mapping, joint_bounds, make_bounds, make_mapping, park_pose, within_joints
from ..rig import Rig, RigError, Stop
from .contract import Phase, Ready, RigFault, freeze, prepare, release, scan, sentences, torque_on
from .loop import Log, Loop

Array = NDArray[np.float64]
_RAMP_LEAST = 0.2  # s
_PEAK = 1.875  # greatest speed of a minimum-jerk motion over its mean


@dataclass
class Outcome:
    """How a session went.

    status: 'done', 'interrupted' or 'fault', with message, phase where it ended and servo; stop: what was
    done in the end; unconfirmed: what could not be confirmed then; phases: when each began [s]; ready, log:
    of the loop."""

    status: str = "done"
    message: str = ""
    phase: Phase = "scan"
    servo: int | None = None
    stop: str = ""
    unconfirmed: list[str] = field(default_factory=list)
    phases: list[tuple[Phase, float]] = field(default_factory=list)
    ready: Ready | None = None
    log: Log = field(default_factory=Log)


class Session:
    """Runs a rig once.

    Args:
        rig, driver: The rig; its port open.
        stop: How it ends: 'hold' (torque stays on), 'park' (to the park pose, then limp) or 'limp'.
        take_over: Accept servos whose torque is on.
        on_phase: Told each phase as it begins.
        model: For ranges of joints that the rig file leaves to it.
    """

    def __init__(
        self,
        rig: Rig,
        driver: Driver,
        *,
        stop: Stop = "hold",
        take_over: bool = False,
        on_phase: Callable[[Phase], None] | None = None,
        model: mujoco.MjModel | None = None,
    ) -> None:
        self.rig, self.driver, self.stop_how, self.take_over = rig, driver, stop, take_over
        self.mapping: Mapping = make_mapping(rig)
        self.bounds = within_joints(make_bounds(rig), self.mapping, joint_bounds(rig, model))
        self.outcome = Outcome()
        self._on_phase = on_phase
        self._loop: Loop | None = None
        self._torque = False
        self._now: Phase = "scan"

    def run(
        self,
        first: Array | Callable[[Array], Array],
        target: Callable[[float], Array | None],
        duration: float,
    ) -> Outcome:
        """Bring the servos to `first` (ns,) [rad], then stream target(t); always stop as promised.

        `first` may be a function of where the servos stand; a target of None ends the stream.
        A fault or Ctrl-C ends in an outcome; any other exception stops the rig and goes on to the caller.
        """
        out, sound = self.outcome, True
        try:
            self._start()
            assert self._loop is not None
            self._phase("ramp")
            self.move(first(self._loop.present.copy()) if callable(first) else first, "ramp")
            self._phase("stream")
            self._loop.run(target, duration, "stream")
        except KeyboardInterrupt:
            out.status, out.message = "interrupted", f"interrupted in phase {self._now!r}"
        except SourceFault as e:
            self._record(e)
        except (RigFault, NoAnswer, Refused, BusError) as e:
            self._record(e)
            sound = False
        except BaseException as e:
            out.status, out.phase, out.message = "fault", self._now, f"{type(e).__name__}: {e}"
            self._stop(sound=True)
            raise
        else:
            out.phase = "stop"
        if out.status == "interrupted":
            out.phase = self._now
        self._stop(sound=sound)
        return out

    @property
    def goal(self) -> Array:
        """Goal sent last (ns,) [rad]."""
        assert self._loop is not None
        return self._loop.goal

    def _record(self, e: Exception) -> None:
        """A fault, where it happened, naming who is concerned."""
        out = self.outcome
        out.status, out.phase, out.message = "fault", self._now, str(e)
        out.servo = getattr(e, "servo", None)
        if out.servo is None and isinstance(e, BusError):
            out.message += "; out of reach: " + "; ".join(self.rig.label(i) for i in self.rig.ids)

    def _phase(self, phase: Phase) -> None:
        self._now = phase
        self.outcome.phases.append((phase, self.driver.clock.now()))
        if self._on_phase:
            self._on_phase(phase)

    def _start(self) -> None:
        """Everything before the first goal that moves something."""
        rig, driver, out = self.rig, self.driver, self.outcome
        self._phase("scan")
        held = scan(driver, rig, self.bounds, take_over=self.take_over)
        self._phase("prepare")
        out.ready = prepare(driver, rig, self.mapping, self.bounds, torque=held)
        cost = driver.cycle_time(out.ready.block)
        if cost > 1 / rig.rate:
            raise RigError(
                f"{rig.rate:g} Hz does not fit the bus: one cycle takes {cost * 1e3:.2f} ms on the wire at "
                f"{rig.baud:,} bit/s; lower the rate to {0.8 / cost:.0f} Hz or raise the bit rate"
            )
        self._phase("torque on")
        self._torque = True
        torque_on(driver, rig)
        self._loop = Loop(driver, rig, self.bounds, out.ready, out.log)

    def move(self, to: Array, phase: Phase) -> None:
        """Minimum-jerk motion of all servos (ns,) from the last goal, at the ramp's capped speed."""
        assert self._loop is not None
        loop = self._loop
        begin = loop.goal.copy()
        way = to - begin
        duration = max(_RAMP_LEAST, _PEAK * float(np.max(np.abs(way))) / self.rig.ramp_velocity)

        def at(t: float) -> Array:
            x = t / duration
            return np.asarray(begin + way * (x**3 * (10 - 15 * x + 6 * x * x)))

        loop.run(at, duration, phase)

    def _stop(self, *, sound: bool) -> None:
        """The promised stop; `sound`: no servo is faulty. What fails is noted, and the rest goes on."""
        out = self.outcome
        if not self._torque:
            out.stop = "nothing was given torque, nothing moved"
            return
        how = self.stop_how
        if self._loop is None:
            held = out.ready is not None and out.ready.torque
            how = "hold" if held else "limp"  # as it was found
        self._phase("stop")
        if how == "park":
            how = self._park() if sound else "hold"
            if not sound:
                out.unconfirmed.append("not parked: after a fault of the rig nothing moves; it holds instead")
        for _ in range(2):  # a second Ctrl-C does not prevent a stop
            try:
                self._end(how)
                break
            except KeyboardInterrupt:
                continue
        if out.unconfirmed and out.status == "done":
            out.status, out.phase, out.message = "fault", "stop", "; ".join(out.unconfirmed)

    def _end(self, how: Stop) -> None:
        out, driver, rig = self.outcome, self.driver, self.rig
        if how == "hold":
            failed = freeze(driver, rig, at_present=out.status != "done")
            out.stop = "holds its pose; torque stays on and warms it until 'pantograph servo stop'"
        else:
            failed = release(driver, rig)
            out.stop = "parked, then limp" if how == "park" else "limp: torque is off"
        out.unconfirmed += sentences(rig, failed)
        if len(failed) == len(rig.ids):
            out.stop = "left to the watchdogs: no servo confirmed anything"
        elif failed:
            out.stop += "; but " + ", ".join(map(rig.label, failed)) + ": see below"

    def _park(self) -> Stop:
        """Move to the park pose; 'hold' instead when that fails or is interrupted."""
        assert self._loop is not None
        out = self.outcome
        start = self.mapping.joint(self._loop.goal.copy())
        try:
            self.move(self.mapping.servo(park_pose(self.rig, start)), "stop")
        except KeyboardInterrupt:
            out.status, out.message = "interrupted", "interrupted while parking"
        except (RigFault, BusError, Refused) as e:
            self._record(e)
        else:
            return "park"
        out.unconfirmed.append("not parked; it holds instead")
        return "hold"
