"""Numbers of a compiled model, some of them replaced by symbols: the parameters."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from ..compile.graph import Scalar
from ..errors import EngineError, unknown

# arrays of MjModel whose entries may become symbols, with the kind of object that owns a row
PARAMETER_FIELDS = {
    "body_mass": "body",
    "body_inertia": "body",
    "body_ipos": "body",
    "body_pos": "body",
    "dof_damping": "dof",
    "dof_armature": "dof",
    "dof_frictionloss": "dof",
    "jnt_stiffness": "joint",
    "qpos_spring": "qpos",
    "actuator_gainprm": "actuator",
    "actuator_biasprm": "actuator",
    "actuator_gear": "actuator",
    "actuator_armature": "actuator",
    "actuator_damping": "actuator",
    "tendon_stiffness": "tendon",
    "tendon_damping": "tendon",
}
_OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
}

_ON_JOINT = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))

Parameter = tuple[str, str | int] | tuple[str, str | int, int]  # (field, row or its owner's name[, column])


def parameter_index(model: mujoco.MjModel, parameter: Parameter) -> tuple[str, int, int]:
    """(field, row, column) of a parameter named by field and owner.

    Raises EngineError when the field cannot be a parameter or the owner does not exist.
    """
    field, owner = parameter[0], parameter[1]
    column = parameter[2] if len(parameter) > 2 else 0
    if field not in PARAMETER_FIELDS:
        raise EngineError(unknown("parameter field", field, PARAMETER_FIELDS, where="the smooth engine"))
    array = getattr(model, field)
    width = array.shape[1] if array.ndim == 2 else 1
    row = _row(model, field, owner)
    if not (0 <= row < array.shape[0] and 0 <= column < width):
        raise EngineError(f"parameter {parameter!r} lies outside {field}, which has shape {array.shape}")
    return field, row, column


def _row(model: mujoco.MjModel, field: str, owner: str | int) -> int:
    if isinstance(owner, int):
        return owner
    kind = PARAMETER_FIELDS[field]
    object_kind = "joint" if kind in ("dof", "qpos") else kind
    row: int = mujoco.mj_name2id(model, _OBJECTS[object_kind], owner)
    if row < 0:
        count = {
            "body": model.nbody,
            "joint": model.njnt,
            "actuator": model.nactuator,
            "tendon": model.ntendon,
        }
        names = [mujoco.mj_id2name(model, _OBJECTS[object_kind], i) or "" for i in range(count[object_kind])]
        raise EngineError(unknown(object_kind, owner, [n for n in names if n]))
    if kind == "dof":
        return int(model.jnt_dofadr[row])
    return int(model.jnt_qposadr[row]) if kind == "qpos" else row


class Fields:
    """Reads entries of `model`'s arrays as numbers, or as the symbols given in `symbols`."""

    def __init__(self, model: mujoco.MjModel, symbols: Mapping[tuple[str, int, int], Scalar] | None = None):
        self.model = model
        self.symbols = dict(symbols or {})

    def scalar(self, name: str, row: int, column: int = 0) -> Scalar:
        """One entry."""
        symbol = self.symbols.get((name, row, column)) if self.symbols else None
        if symbol is not None:
            return symbol
        array: Any = getattr(self.model, name)
        return float(array[row] if array.ndim == 1 else array[row, column])

    def armature(self, dof: int) -> Scalar:
        """Rotor inertia of a freedom: its own, and gear^2 times that of the actuators on its joint."""
        total = self.scalar("dof_armature", dof)
        for actuator in self.actuators_on(int(self.model.dof_jntid[dof])):
            inertia = self.scalar("actuator_armature", actuator)
            if hasattr(inertia, "op") or inertia != 0.0:
                total = total + self.squared_gear(actuator) * inertia
        return total

    def actuators_on(self, joint: int) -> list[int]:
        """Actuators that act on a joint."""
        kinds = self.model.actuator_trntype
        on = np.isin(kinds, _ON_JOINT) & (self.model.actuator_trnid[:, 0] == joint)
        return [int(i) for i in np.flatnonzero(on)]

    def squared_gear(self, actuator: int) -> Scalar:
        """Square of an actuator's gear ratio: of its first entry, for all freedoms, as in MuJoCo."""
        gear = self.scalar("actuator_gear", int(self.model.actuator_outadr[actuator]))
        return gear * gear

    def vector(self, name: str, row: int, size: int = 3) -> list[Scalar]:
        """The first `size` entries of a row."""
        return [self.scalar(name, row, k) for k in range(size)]

    def polynomial(self, name: str, row: int) -> list[Scalar]:
        """Linear coefficient of `name` followed by those of higher order (MuJoCo 4)."""
        higher: Sequence[float] = getattr(self.model, name + "poly")[row]
        coefficients = [self.scalar(name, row), *(float(c) for c in higher)]
        while coefficients and not hasattr(coefficients[-1], "op") and coefficients[-1] == 0.0:
            coefficients.pop()
        return coefficients
