"""Calibration by hand: which servo moves which joint, in which direction, where zero is, how far it goes.

A person moves the limp rig; nothing is typed. What a step needs is asked through `Person`, so that the
command line and a test play the same part.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import degrees, pi
from typing import Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import lookup
from .driver import Driver, Found
from .errors import HardwareError

Array = NDArray[np.float64]
MOVED = 0.15  # rad that a servo must turn to count as moved by hand
MARGIN = 0.02  # rad that soft limits stay inside of the range that was shown
_TURN = 2 * pi


class Person(Protocol):
    """Who stands at the rig."""

    def ready(self, request: str) -> bool:
        """Ask for something; told the request until it is done. Called again and again: True when done."""
        ...

    def show(self, names: Sequence[str], position: Array, low: Array, high: Array) -> None:
        """See where the servos are [rad] and how far they have been."""
        ...


@dataclass(frozen=True)
class Calibrated:
    """What was found for a joint: servos with directions and zeros [rad], and its range."""

    joint: str
    servos: tuple[tuple[int, int, float], ...]  # (ID, direction, zero)
    range: tuple[float, float]


def calibrate(
    driver: Driver, found: Sequence[Found], joints: Sequence[str], person: Person
) -> list[Calibrated]:
    """Walk a person through it; HardwareError when torque is on or a joint moved no servo, or a taken one.

    Joints that the person skips (moves nothing) are left out when servos are used up.
    """
    ids = [f.id for f in found]
    for id in ids:
        if driver.read_raw(id, "torque_enable"):
            raise HardwareError(
                f"{driver.label(id)} holds torque; support the rig, then 'pantograph servo stop --limp'"
            )
        driver.return_delay[id] = driver.read(id, "return_delay_time")
    zero, _, _ = _watch(driver, ids, person, "bring every joint to zero, as the model shows it")
    taken: dict[int, tuple[str, int]] = {}
    servos: dict[str, tuple[tuple[int, int, float], ...]] = {}
    for joint in joints:
        if len(taken) == len(ids):
            break
        request = f"turn joint {joint!r} towards its positive side, about a hand's width, and leave it there"
        before, _, _ = _watch(driver, ids, person, None)
        after, _, _ = _watch(driver, ids, person, request)
        turn = after - before
        moved = [i for i in range(len(ids)) if abs(turn[i]) > MOVED and ids[i] not in taken]
        if not moved:
            raise HardwareError(
                f"no servo turned when joint {joint!r} should have moved; the free ones turned at most "
                f"{max((abs(turn[i]) for i in range(len(ids)) if ids[i] not in taken), default=0.0):.3f} rad"
            )
        for i in moved:
            taken[ids[i]] = (joint, 1 if turn[i] > 0 else -1)
        servos[joint] = tuple((ids[i], taken[ids[i]][1], float(zero[i])) for i in moved)
    _, low, high = _watch(driver, ids, person, "move every joint from one end of its range to the other")
    out = []
    for joint, parts in servos.items():
        spans = []
        for id, direction, at in parts:
            i = ids.index(id)
            ends = sorted((direction * (low[i] - at), direction * (high[i] - at)))
            spans.append(ends)
        low_end, high_end = max(s[0] for s in spans), min(s[1] for s in spans)
        out.append(Calibrated(joint, parts, (float(low_end), float(high_end))))
    return out


def _watch(
    driver: Driver, ids: Sequence[int], person: Person, request: str | None
) -> tuple[Array, Array, Array]:
    """Positions (n,) at the end, least and greatest while the person works [rad]."""
    block = driver.block(list(ids), ["present_position"])
    low, high = np.full(len(ids), np.inf), np.full(len(ids), -np.inf)
    names = [driver.label(i) for i in ids]
    position = np.full(len(ids), np.nan)
    while True:
        done = request is None or person.ready(request)
        now = block.decode(driver.read_block(block))[:, 0]
        position = np.where(np.isnan(now), position, now)
        low, high = np.fmin(low, position), np.fmax(high, position)
        if done:
            if np.isnan(position).any():
                id = ids[int(np.argmax(np.isnan(position)))]
                raise HardwareError(f"{driver.label(id)} does not answer")
            return position, low, high
        person.show(names, position, low, high)


def rig_text(
    name: str,
    model_name: str,
    model: mujoco.MjModel,
    found: Sequence[Found],
    calibrated: Sequence[Calibrated],
    *,
    port: str,
    baud: int,
) -> str:
    """The rig file, ready to be written. A sliding joint gets a straight line between its ends."""
    model_of = {f.id: f.model for f in found}
    lines = [
        f'name = "{name}"',
        f'model = "{model_name}"',
        'angle = "degree"',
        f'port = "{port}"',
        f"baud = {baud}",
        "rate = 50.0",
        "watchdog = 0.2       # s without a word from the host, then every servo stops",
        "ramp_velocity = 0.5  # rad/s",
        "",
        "servos = [",
    ]
    label = {}
    for c in calibrated:
        for k, (id, _, _) in enumerate(c.servos):
            label[id] = c.joint if k == 0 else f"{c.joint}_{k + 1}"
            label[id] = "".join(ch if ch.isalnum() or ch in "._-" else "_" for ch in label[id])
            lines.append(f'    {{ name = "{label[id]}", id = {id}, model = "{model_of[id]}" }},')
    lines.append("]")
    for c in calibrated:
        lines += ["", "[[joints]]", f'joint = "{c.joint}"']
        drives = [
            f'servo = "{label[id]}", direction = {direction}, zero = {degrees(zero):.2f}'
            for id, direction, zero in c.servos
        ]
        if len(drives) == 1:
            lines += drives[0].split(", ")
        else:
            lines.append("servos = [" + ", ".join(f"{{ {d} }}" for d in drives) + "]")
        lines += _range_lines(model, c)
    return "\n".join(lines) + "\n"


def _range_lines(model: mujoco.MjModel, c: Calibrated) -> list[str]:
    index = lookup(model, "joint", c.joint)
    low, high = c.range[0] + MARGIN, c.range[1] - MARGIN
    if model.jnt_type[index] == mujoco.mjtJoint.mjJNT_SLIDE:
        ends = [float(x) for x in model.jnt_range[index]]
        return [
            "# a straight line between the ends; for a parallel gripper measure points, or use 'crank'",
            f"points = [[{ends[0]:.5f}, {degrees(c.range[0]):.2f}], "
            f"[{ends[1]:.5f}, {degrees(c.range[1]):.2f}]]",
        ]
    if model.jnt_limited[index]:
        low, high = max(low, float(model.jnt_range[index][0])), min(high, float(model.jnt_range[index][1]))
    out = [f"range = [{degrees(low):.2f}, {degrees(high):.2f}]"]
    if high - low >= _TURN:
        out.insert(0, "# more than a turn: a servo in position mode has one turn; check the zero pose")
    return out
