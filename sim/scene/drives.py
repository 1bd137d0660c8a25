"""What drives each actuator of a scene: keys, the controller, or nothing."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ..clip import Clip
from ..control import is_position_servo, why_not_controllable
from ..curves import Curve
from ..engines.interface import Array, Drive, Role
from ..kinds import SCALAR
from .goals import Goals
from .mistakes import Mistake
from .motion import Curves
from .names import Names
from .schema import Scene


def drives_of(
    scene: Scene,
    model: mujoco.MjModel,
    roles: NDArray[np.int8],
    found: Curves,
    goals: Goals,
    clip: Clip | None = None,
) -> tuple[NDArray[np.int8], dict[int, Callable[[Array], Array]], list[Mistake]]:
    """What drives each actuator, as the scene says or as its joint's role suggests; the controls of those
    that follow keys, when ``clip`` has them; mistakes. What is off is silenced in ``model``."""
    actuators, mistakes = Names(model, "actuator"), []
    drives = np.array(
        [_suggested(scene, model, roles, found, goals, i) for i in range(model.nu)], dtype=np.int8
    )
    said: dict[int, str] = {}
    for pattern, word in scene.actuators.items():
        ids = actuators.match(pattern)
        if not ids:
            mistakes.append(Mistake(("actuators", pattern), actuators.missing(pattern)))
        for i in ids:
            drives[i] = Drive[word.upper()]
            said[i] = pattern
    servo: dict[int, Callable[[Array], Array]] = {}
    for i in range(model.nu):
        path = ("actuators", said[i]) if i in said else ("actuators",)
        name = name_of(model, "actuator", i)
        if drives[i] == Drive.OFF:
            model.actuator_gainprm[i] = 0.0
            model.actuator_biasprm[i] = 0.0
        elif drives[i] == Drive.CONTROLLER:
            if reason := why_not_controllable(model, i):
                mistakes.append(Mistake(path, f"no controller can drive actuator {name!r}: {reason}"))
        elif _on_joint(model, i) and int(model.actuator_trnid[i, 0]) in goals.live_joints:
            message = (
                f"actuator {name!r} drives a joint that follows a live goal: 'controller' drives it, not keys"
            )
            mistakes.append(Mistake(path, message))
        elif i in found.actuators:
            curve = found.actuators[i]
            servo[i] = lambda t, curve=curve: curve(t).q[:, 0]  # type: ignore[misc]
        elif is_position_servo(model, i) and _on_joint(model, i):
            if clip is not None:
                servo[i] = _servo_along_keys(model, clip, i)
        else:
            message = f"actuator {name!r} is driven by keys but has none: add [[keys]] actuator = {name!r}"
            mistakes.append(Mistake(path, message, needs=("keys",)))
    return drives, servo, mistakes


def _suggested(
    scene: Scene, model: mujoco.MjModel, roles: NDArray[np.int8], found: Curves, goals: Goals, i: int
) -> Drive:
    if i in found.actuators:
        return Drive.KEYS
    if not _on_joint(model, i):
        return Drive.OFF
    if roles[model.actuator_trnid[i, 0]] != Role.TRACKED:
        return Drive.OFF
    servo = is_position_servo(model, i)
    if why_not_controllable(model, i):
        return Drive.KEYS if servo else Drive.OFF
    live = int(model.actuator_trnid[i, 0]) in goals.live_joints
    return Drive.KEYS if servo and scene.controller is None and not live else Drive.CONTROLLER


def _on_joint(model: mujoco.MjModel, i: int) -> bool:
    joint = int(model.actuator_trnid[i, 0])
    on = model.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT
    return bool(on) and int(model.jnt_type[joint]) in SCALAR


def _servo_along_keys(model: mujoco.MjModel, clip: Clip, i: int) -> Callable[[Array], Array]:
    """Control of a position servo that follows its joint's keys: ctrl = gear q."""
    joint, gear = int(model.actuator_trnid[i, 0]), float(model.actuator_gear[i, 0])
    track, rest = clip.tracks.get(name_of(model, "joint", joint)), float(clip.q0[model.jnt_qposadr[joint]])
    if not isinstance(track, Curve):
        return lambda t: np.full(np.shape(t), gear * rest)
    return lambda t: np.asarray(gear * track(t).q[:, 0])
