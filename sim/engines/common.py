"""What engines with a loop of their own share."""

from __future__ import annotations

import math
import traceback
from typing import TypedDict

import mujoco
import numpy as np

from ...models import name_of
from ..errors import EngineError, PantographError
from .interface import Array, Controls, Held, Segment, State

HUGE = 1e10  # MuJoCo's own bound (mjMAXVAL) for a state that makes sense


class Broken(EngineError):
    """An error in the middle of a run; ``segment`` is what was computed until then."""

    def __init__(self, segment: Segment) -> None:
        super().__init__(segment.message)
        self.segment = segment


def place_of(error: Exception) -> str:
    """What an error says; for one that is not ours, also its kind and where it was raised."""
    if isinstance(error, PantographError):
        return str(error)
    frame = traceback.extract_tb(error.__traceback__)[-1]
    return f"{type(error).__name__}: {error} ({frame.filename}, line {frame.lineno}, in {frame.name})"


def steps_per_tick(controls: Controls | None, step: float) -> int:
    """Whole steps in a controller's period; 0 without one. Raises EngineError when they do not fit."""
    if controls is None:
        return 0
    steps = round(controls.period / step)
    if abs(steps * step - controls.period) > 1e-9 * controls.period:
        raise EngineError(
            f"the controller's period {controls.period:g} s is no whole multiple of the step {step:g} s"
        )
    return steps


def fastest_joint(model: mujoco.MjModel, q: Array, v: Array) -> str | None:
    """Name of the fastest joint when the state makes no sense any more, else None."""
    values = q.tolist() + v.tolist()  # few: quicker than NumPy
    if min(values, default=0.0) > -HUGE and max(values, default=0.0) < HUGE and not math.isnan(sum(values)):
        return None
    speed = np.where(np.isfinite(v), np.abs(v), np.inf)
    if np.isfinite(q).all() and np.all(speed <= HUGE):
        return None
    return joint_of_largest(model, speed)


def joint_of_largest(model: mujoco.MjModel, speed: Array) -> str:
    """Name of the joint whose freedom has the largest of ``speed`` (nv,)."""
    return name_of(model, "joint", int(model.dof_jntid[int(np.argmax(speed))]))


def rows(values: list[Array], width: int) -> Array:
    """Arrays (width,) as rows, also when there are none."""
    return np.array(values, dtype=float).reshape(len(values), width)


class Recorded(TypedDict):
    """The arrays of a Segment."""

    t: Array
    q: Array
    v: Array
    act: Array
    tick_t: Array
    tick_ctrl: Array
    tick_qfrc: Array


def recorded(
    model: mujoco.MjModel, samples: list[tuple[float, State]], ticks: list[tuple[float, Held]]
) -> Recorded:
    """The arrays of a Segment from its samples and the controller's ticks."""
    return {
        "t": np.array([t for t, _ in samples]),
        "q": rows([s.q for _, s in samples], model.nq),
        "v": rows([s.v for _, s in samples], model.nv),
        "act": rows([s.act for _, s in samples], model.na),
        "tick_t": np.array([t for t, _ in ticks]),
        "tick_ctrl": rows([u.ctrl for _, u in ticks], model.nu),
        "tick_qfrc": rows([u.qfrc for _, u in ticks], model.nv),
    }
