"""What a scene tells a law, in SI: angles of hinges may be in degrees there."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np

from ...models import joint_names
from ..kinds import HINGE
from .schema import Scene

ANGLES = (
    "goal", "room", "speed", "backlash", "noise", "push", "play", "top_speed", "stiction",
)  # fmt: skip


def law_words(scene: Scene, model: mujoco.MjModel, words: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Parameters of a law in SI, from ``words`` in the scene's units (default: its own controller's).

    Where the scene's angles are degrees, positions, speeds and accelerations of hinges (:data:`ANGLES`) are,
    one number or one a joint by name, and nothing else: gains and weights are always of radians, other joints
    always of radians and metres. What is no number stays as it is, for the law to complain about.
    """
    if words is None:
        words = scene.controller.parameters if scene.controller else {}
    if scene.angle == "radian":
        return dict(words)
    return {word: in_si(model, value) if word in ANGLES else value for word, value in words.items()}


def in_si(model: mujoco.MjModel, value: Any) -> Any:
    """A value of angles in degrees, or of each joint by its name, in SI; what is no hinge's stays."""
    if isinstance(value, Mapping):
        return {name: _one(model, str(name), each) for name, each in value.items()}
    return _one(model, "", value)


def _one(model: mujoco.MjModel, name: str, value: Any) -> Any:
    """A value of the joint ``name``, or of all; by freedoms (nv,) where these differ."""
    if not isinstance(value, int | float) or isinstance(value, bool):
        return value
    hinge = np.asarray(model.jnt_type == HINGE)
    if name:
        hinge = hinge[[n == name for n in joint_names(model)]]
    if not hinge.any():
        return value
    rad = float(np.deg2rad(value))
    return rad if hinge.all() else np.where(hinge[model.dof_jntid], rad, value)
