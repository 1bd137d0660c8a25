"""Teleoperation: a limp rig, moved by hand, moves the model and, if there is one, another rig."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...sim.recording import Recording
from ..connect import connect
from ..driver import Driver
from ..errors import BusError, SourceFault
from ..mapping import joint_bounds, make_mapping
from ..rig import Rig, RigError, Stop, load_rig
from ..virtual import VirtualBus
from .contract import FEEDBACK, scan
from .loop import PATIENCE, Log
from .record import MirrorReport, make_report
from .session import Outcome, Session

Array = NDArray[np.float64]
_FEEDBACK = ("present_position",)


class Leader:
    """A rig without torque whose joints are read. RigFault when it is not as described, or holds torque."""

    def __init__(self, rig: Rig, driver: Driver) -> None:
        self.rig, self.driver, self.mapping = rig, driver, make_mapping(rig)
        scan(driver, rig, None)  # refuses torque: a rig that holds itself would have to be dropped
        for id in rig.ids:
            driver.return_delay[id] = driver.read(id, "return_delay_time")
        self._block = driver.block(rig.ids, _FEEDBACK)
        self._silent = np.zeros(len(rig.ids), dtype=int)
        self._servo = np.full(len(rig.ids), np.nan)
        for _ in range(PATIENCE):
            self.read()
        self.begin = driver.clock.now()

    def at(self, t: float) -> Array:
        """Joint values (nj,), `t` seconds after the leader was made."""
        self.driver.clock.sleep_until(self.begin + t)
        return self.read()

    def read(self) -> Array:
        """Joint values (nj,) now; the last known of a servo that is silent for a moment.

        Raises SourceFault for one that stays silent, or a cable that is out.
        """
        try:
            replies = self.driver.read_block(self._block, retries=1)
        except BusError as e:
            raise SourceFault(f"leader: {e}") from e
        angle = self._block.decode(replies)[:, 0]
        heard = ~np.isnan(angle)
        self._silent = np.where(heard, 0, self._silent + 1)
        self._servo = np.where(heard, angle, self._servo)
        if (self._silent >= PATIENCE).any():
            id = self.rig.ids[int(np.argmax(self._silent))]
            raise SourceFault(f"leader: {self.rig.label(id)} does not answer any more")
        return self.mapping.joint(self._servo)


@dataclass(frozen=True)
class TeleopReport:
    """Result: joints of the leader over time, t (n,) [s], q (n, nj); its Recording when the rig has a model;
    the follower's report when there is one."""

    status: str
    message: str
    joints: tuple[str, ...]
    t: Array
    q: Array
    recording: Recording | None
    follower: MirrorReport | None


def teleoperate(
    leader: Rig | str | Path,
    follower: Rig | str | Path | None = None,
    *,
    duration: float = np.inf,
    stop: Stop = "hold",
    leader_port: str | None = None,
    follower_port: str | None = None,
    leader_bus: VirtualBus | None = None,
    follower_bus: VirtualBus | None = None,
    paced: bool = False,
    each: Callable[[float, Array], None] | None = None,
) -> TeleopReport:
    """Follow a limp rig until `duration` [s] or Ctrl-C.

    Joints of the follower get the values of the leader's joints of the same name, within the follower's
    limits and speeds; others stay. ``each`` is told time and joint values of the leader each cycle.
    Raises RigError when the rigs share no joint, RigFault when the leader is not as described.
    """
    leader = load_rig(leader) if isinstance(leader, str | Path) else leader
    follower = load_rig(follower) if isinstance(follower, str | Path) else follower
    driver, _ = connect(leader, port=leader_port, bus=leader_bus, paced=paced)
    times: list[float] = []
    rows: list[Array] = []

    def read(t: float) -> Array:
        q = hand.at(t)
        times.append(t)
        rows.append(q)
        if each:
            each(t, q)
        return q

    try:
        hand = Leader(leader, driver)
        if follower is None:
            status, message = _watch(leader, read, duration)
            report = None
        else:
            report = _lead(leader, follower, hand, read, duration, stop, follower_port, follower_bus, paced)
            status, message = report.status, report.message
    finally:
        driver.close()
    t, q = np.array(times), np.array(rows).reshape(len(rows), -1)
    recording = _recording(leader, driver, t, q) if leader.model and len(t) > 1 else None
    t.setflags(write=False)
    q.setflags(write=False)
    return TeleopReport(status, message, hand.mapping.joints, t, q, recording, report)


def _watch(rig: Rig, read: Callable[[float], Array], duration: float) -> tuple[str, str]:
    """Read the leader alone at its rate."""
    k = 0
    try:
        while k / rig.rate <= duration:
            read(k / rig.rate)
            k += 1
    except KeyboardInterrupt:
        return "interrupted", "interrupted by a person"
    except SourceFault as e:
        return "fault", str(e)
    return "done", ""


def _lead(
    leader: Rig,
    follower: Rig,
    hand: Leader,
    read: Callable[[float], Array],
    duration: float,
    stop: Stop,
    port: str | None,
    bus: VirtualBus | None,
    paced: bool,
) -> MirrorReport:
    mapping = make_mapping(follower)
    pairs = [(mapping.joints.index(j), i) for i, j in enumerate(hand.mapping.joints) if j in mapping.joints]
    if not pairs:
        raise RigError(
            f"the rigs share no joint; leader: {', '.join(hand.mapping.joints)}; "
            f"follower: {', '.join(mapping.joints)}"
        )
    to, of = (list(x) for x in zip(*pairs, strict=True))
    model = follower.load_model() if follower.model else None
    bounds = joint_bounds(follower, model)
    driver, note = connect(follower, port=port, bus=bus, paced=paced)
    session = Session(follower, driver, stop=stop, model=model)
    goal = np.zeros(len(mapping.joints))

    def first(present: Array) -> Array:
        goal[:] = mapping.joint(present)
        return follow(hand.read())

    def follow(q: Array) -> Array:
        goal[to] = np.clip(q[of], bounds.low[to], bounds.high[to])
        return mapping.servo(goal)

    def target(t: float) -> Array:
        return follow(read(t))

    try:
        outcome = session.run(first, target, duration)
    finally:
        driver.close()
    return make_report(outcome, follower, driver, mapping, notes=(note,), model=model)


def _recording(rig: Rig, driver: Driver, t: Array, q: Array) -> Recording | None:
    """The leader's motion as a Recording of its model."""
    mapping = make_mapping(rig)
    s = mapping.servo(q)
    speed = np.gradient(s, t, axis=0)
    log = Log(due=list(t), begun=list(t), ended=list(t), phase=["stream"] * len(t), goal=list(s))
    rest = np.zeros((s.shape[1], len(FEEDBACK) - 2))
    # In SI already: no servo block was prepared for an outcome without `ready`.
    log.feedback = [np.column_stack([a, b, rest]) for a, b in zip(s, speed, strict=True)]
    outcome = Outcome(stop="limp: it never had torque", log=log)
    return make_report(outcome, rig, driver, mapping, model=rig.load_model()).recording
