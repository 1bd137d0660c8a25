"""Robots and scenes as data, and the way to load them."""

import os

try:
    import mujoco  # noqa: F401
except Exception as error:
    if "MUJOCO_GL" not in os.environ:
        raise
    raise ImportError(
        f"MuJoCo does not load with MUJOCO_GL = {os.environ['MUJOCO_GL']!r} ({error}): unset it, or install "
        "the library that it asks for; films of Pantograph do not depend on it"
    ) from error

from .chain import chain
from .diagnose import captured_warnings
from .errors import ModelError, ModelWarning, PantographError, unknown
from .library import data_robots, find, load_model, load_spec, names
from .naming import Kind, dof_names, joint_names, lookup, name_of, names_of

__all__ = [
    "Kind",
    "ModelError",
    "ModelWarning",
    "PantographError",
    "captured_warnings",
    "chain",
    "data_robots",
    "dof_names",
    "find",
    "joint_names",
    "load_model",
    "load_spec",
    "lookup",
    "name_of",
    "names",
    "names_of",
    "unknown",
]
