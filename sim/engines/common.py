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


class Ticks:
    """A controller's samples of a run, added one by one or many at once."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._widths = model.nu, model.nv
        self._blocks: list[tuple[Array, Array, Array]] = []
        self._single: list[tuple[float, Held]] = []

    def add(self, t: float, held: Held) -> None:
        """One sample at time ``t`` [s]."""
        self._single.append((t, held))

    def extend(self, t: Array, ctrl: Array, qfrc: Array) -> None:
        """Samples at times t (n,): ctrl (n, nu), qfrc (n, nv)."""
        self._close()
        self._blocks.append((t, ctrl, qfrc))

    def forget_after(self, t: float) -> None:
        """Drop the samples later than ``t`` [s]."""
        times, ctrl, qfrc = self.arrays()
        early = times <= t
        self._blocks = [(times[early], ctrl[early], qfrc[early])]

    def arrays(self) -> tuple[Array, Array, Array]:
        """All times (n,), ctrl (n, nu) and qfrc (n, nv)."""
        self._close()
        if len(self._blocks) != 1:
            nothing = np.zeros(0), *(np.zeros((0, width)) for width in self._widths)
            t, ctrl, qfrc = (np.concatenate(x) for x in zip(nothing, *self._blocks, strict=True))
            self._blocks = [(t, ctrl, qfrc)]
        return self._blocks[0]

    def _close(self) -> None:
        if self._single:
            nu, nv = self._widths
            t = np.array([t for t, _ in self._single])
            held = [held for _, held in self._single]
            self._blocks.append((t, rows([x.ctrl for x in held], nu), rows([x.qfrc for x in held], nv)))
            self._single = []


def recorded(model: mujoco.MjModel, samples: list[tuple[float, State]], ticks: Ticks) -> Recorded:
    """The arrays of a Segment from its samples and the controller's ticks."""
    tick_t, tick_ctrl, tick_qfrc = ticks.arrays()
    return {
        "t": np.array([t for t, _ in samples]),
        "q": rows([s.q for _, s in samples], model.nq),
        "v": rows([s.v for _, s in samples], model.nv),
        "act": rows([s.act for _, s in samples], model.na),
        "tick_t": tick_t,
        "tick_ctrl": tick_ctrl,
        "tick_qfrc": tick_qfrc,
    }
