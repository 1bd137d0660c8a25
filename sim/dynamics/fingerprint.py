"""What compiled code depends on: another model or program never reads what this one stored."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import mujoco
import numpy as np

from ..compile.cache import key_of

_MODEL_PREFIXES = (
    "body_",
    "jnt_",
    "dof_",
    "actuator_",
    "tendon_",
    "wrap_",
    "qpos",
    "eq_",
    "site_",
    "geom_fluid",
)


def model_fingerprint(model: mujoco.MjModel) -> bytes:
    """Everything of a model that its smooth dynamics can depend on."""
    parts = []
    for name in dir(model):
        if name.startswith(_MODEL_PREFIXES):
            value = getattr(model, name)
            if isinstance(value, np.ndarray):
                parts.append(
                    name.encode() + str(value.shape).encode() + np.ascontiguousarray(value).tobytes()
                )
    option = model.opt
    numbers = [*option.gravity, *option.wind, option.density, option.viscosity, model.stat.extent]
    flags = [option.disableflags, option.disableactuator, option.enableflags]
    return b"\0".join(parts) + np.asarray(numbers).tobytes() + np.asarray(flags, np.int64).tobytes()


@cache
def code_fingerprint() -> str:
    """Hash of this engine's own source."""
    here = Path(__file__).parent
    files = sorted([*here.rglob("*.py"), *(here.parent / "compile").glob("*.py")])
    return key_of(*(file.read_bytes() for file in files))
