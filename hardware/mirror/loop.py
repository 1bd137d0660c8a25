"""The control loop: goals out at an absolute schedule, feedback in, a fault as soon as it can be seen."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from math import ceil

import numpy as np
from numpy.typing import NDArray

from ..driver import Driver
from ..mapping import Bounds
from ..rig import Rig
from ..tables.rows import CENTRE, POSITION
from .contract import Phase, Ready, RigFault, error_names

Array = NDArray[np.float64]
Rows = list[tuple[float, ...]]

PATIENCE = 5  # cycles without an answer, or with an old goal, after which a servo is lost
LAGGING = 10  # cycles behind its goal after which a servo is obstructed
_LATE = 0.5  # periods that a cycle may begin late; beyond that it is skipped
HEALTH_PERIOD = 1.0  # s between looks at voltage and temperature
_STEP_MARGIN = 1.25  # of the greatest step of a goal over velocity limit x time
_HOT = 2.0  # K below the temperature limit at which the rig stops, before the servo lets go by itself


@dataclass
class Log:
    """What every cycle did: lists of the same length, times [s] of the bus clock, goals [rad].

    feedback: counts of the feedback block (ns, registers), NaN for a servo that did not answer.
    """

    due: list[float] = field(default_factory=list)
    begun: list[float] = field(default_factory=list)
    ended: list[float] = field(default_factory=list)
    phase: list[Phase] = field(default_factory=list)
    goal: list[Array] = field(default_factory=list)
    feedback: list[Array] = field(default_factory=list)
    skipped: int = 0  # cycles that were due while another was still under way
    clamped: int = 0  # goals that software limits changed
    lost_goals: int = 0  # goals sent that a servo was seen not to have
    oldest_goal: int = 0  # cycles
    hottest: float = -np.inf
    lowest_voltage: float = np.inf


class Loop:
    """Streams goals to a rig that is ready and under torque.

    Args:
        driver, rig, bounds: The rig.
        ready: From `prepare`.
        log: Where cycles are written.
    """

    def __init__(self, driver: Driver, rig: Rig, bounds: Bounds, ready: Ready, log: Log) -> None:
        self.driver, self.rig, self.ready, self.log = driver, rig, ready, log
        self.period = 1.0 / rig.rate
        self.goal = ready.present.copy()  # last one sent [rad]
        self._x = [float(x) for x in self._counts(ready.present)]  # last position heard, in counts
        # A rig that stands outside of its soft limits may come back, not go further.
        self._low = np.minimum(bounds.low, ready.present)
        self._high = np.maximum(bounds.high, ready.present)
        self._speed = bounds.velocity
        self._following = rig.following_error / POSITION
        self._silent, self._stale, self._behind = ([0] * len(rig.ids) for _ in range(3))
        self._last = driver.clock.now()
        self._health_due = self._last
        self._health = driver.block(rig.ids, ["present_input_voltage", "present_temperature"])
        self._too_hot = np.array([driver.read(i, "temperature_limit") for i in rig.ids]) - _HOT
        self._cost = driver.cycle_time(ready.block) + driver.margin

    @staticmethod
    def _counts(angle: Array) -> list[int]:
        counts: list[int] = (np.rint(angle / POSITION) + CENTRE).astype(int).tolist()
        return counts

    @property
    def present(self) -> Array:
        """Positions heard last (ns,) [rad]."""
        return (np.array(self._x) - CENTRE) * POSITION

    def run(
        self, target: Callable[[float], Array | None], duration: float, phase: Phase, *, capped: bool = True
    ) -> None:
        """Stream target(t) (ns,) [rad] for t from 0 to `duration` [s]; a target of None ends it.

        Cycle k is due at start + k * period whatever happened before: one that could only begin later than
        half a period is skipped, never made up for.
        """
        clock, period = self.driver.clock, self.period
        start, k = clock.now(), 0
        last = ceil(duration / period - 1e-9) if np.isfinite(duration) else None
        while last is None or k <= last:
            due = start + k * period
            clock.sleep_until(due)
            goal = target(min(k * period, duration))
            if goal is None:
                return
            self.cycle(goal, due, phase)
            late = (clock.now() - start) / period
            following = max(k + 1, ceil(late - _LATE))
            self.log.skipped += following - k - 1
            k = following

    def cycle(self, goal: Array, due: float, phase: Phase) -> None:
        """Write one goal to all servos, read all of them, look for faults."""
        driver, log = self.driver, self.log
        begun = driver.clock.now()
        goal = self._limit(goal, begun)
        counts = self._counts(goal)
        driver.sync_write(self.rig.ids, "goal_position", counts)
        self.goal, self._last = goal, begun
        rest = due + self.period - driver.clock.now()
        replies = driver.read_block(self.ready.block, retries=1 if rest > 2 * self._cost else 0)
        rows = self.ready.block.counts(replies)
        log.due.append(due)
        log.begun.append(begun)
        log.ended.append(driver.clock.now())
        log.phase.append(phase)
        log.goal.append(goal)
        log.feedback.append(np.array(rows, dtype=float))
        self._judge(rows, counts, phase)
        if driver.clock.now() >= self._health_due and due + self.period - driver.clock.now() > self._cost:
            self._look_at_health(phase)

    def _limit(self, goal: Array, now: float) -> Array:
        """Software limits: inside of the range, and no further per cycle than the speed allows."""
        elapsed = min(max(now - self._last, self.period), PATIENCE * self.period)
        step = self._speed * (_STEP_MARGIN * elapsed) + POSITION
        wanted = goal
        goal = np.minimum(np.maximum(goal, self._low), self._high)
        goal = np.minimum(np.maximum(goal, self.goal - step), self.goal + step)
        changed = goal != wanted
        if changed.any():
            if np.isnan(wanted).any():
                id = self.rig.ids[int(np.argmax(np.isnan(wanted)))]
                raise RigFault("stream", f"the goal of {self.rig.label(id)} is not a number", servo=id)
            self.log.clamped += int(np.max(np.abs(goal - wanted)) > POSITION)
        return goal

    def _judge(self, rows: Rows, sent: list[int], phase: Phase) -> None:
        """RigFault for a servo that is lost, in error, without torque, tripped, stale or far behind.

        In counts and without numpy, which would cost more than the SDK for a handful of servos.
        """
        silent, stale, behind, following = self._silent, self._stale, self._behind, self._following
        bad, lost = -1, False
        for i, (x, _, _, error, watchdog, torque, goal) in enumerate(rows):
            if x != x:  # not heard: nor is it known whether it has its goal
                silent[i] += 1
                stale[i] += 1
                if silent[i] >= PATIENCE and bad < 0:
                    bad = i
                continue
            silent[i] = 0
            self._x[i] = x
            if goal == sent[i]:
                stale[i] = 0
            else:
                stale[i] += 1
                lost = True
            behind[i] = behind[i] + 1 if abs(x - sent[i]) > following else 0
            wrong = error or torque != 1 or watchdog < 0
            if (wrong or stale[i] >= PATIENCE or behind[i] >= LAGGING) and bad < 0:
                bad = i
        self.log.lost_goals += lost
        self.log.oldest_goal = max(self.log.oldest_goal, *stale)
        if bad >= 0:
            raise self._fault(bad, rows[bad], sent[bad], phase)

    def _fault(self, i: int, row: tuple[float, ...], sent: int, phase: Phase) -> RigFault:
        id = self.rig.ids[i]
        label = self.rig.label(id)
        x, _, _, error, watchdog, torque, _ = row
        if self._silent[i]:
            text = f"{label} has not answered for {self._silent[i]} cycles: is its cable in?"
        elif error:
            text = f"{label} reports a hardware error: {error_names(int(error))}; it needs a reboot"
        elif watchdog < 0:
            text = f"the bus watchdog of {label} tripped: it heard nothing for {self.rig.watchdog:g} s"
        elif torque != 1:
            text = f"{label} lost its torque: did its supply break down, or did somebody switch it off?"
        elif self._stale[i] >= PATIENCE:
            text = f"{label} has not taken a goal for {self._stale[i]} cycles"
        else:
            gap = abs(x - sent) * POSITION
            text = f"{label} is {gap:.3f} rad behind its goal: is something in its way?"
        return RigFault(phase, text, servo=id)

    def _look_at_health(self, phase: Phase) -> None:
        """Voltage and temperature, about once a second, in the spare time of a cycle."""
        self._health_due = self.driver.clock.now() + HEALTH_PERIOD
        values = self._health.decode(self.driver.read_block(self._health, retries=0))
        heard = values[~np.isnan(values[:, 0])]
        if len(heard):
            self.log.lowest_voltage = min(self.log.lowest_voltage, float(heard[:, 0].min()))
            self.log.hottest = max(self.log.hottest, float(heard[:, 1].max()))
        hot = np.nan_to_num(values[:, 1], nan=-np.inf) >= self._too_hot
        if hot.any():
            i = int(np.argmax(hot))
            id = self.rig.ids[i]
            raise RigFault(
                phase,
                f"{self.rig.label(id)} has {values[i, 1]:.0f} degC, near the {self._too_hot[i] + _HOT:.0f} "
                "at which it lets go: let it cool down",
                servo=id,
            )
