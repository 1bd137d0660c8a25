"""Names of the parts of a model, and the way back from a name to its index."""

from typing import Literal, get_args

import mujoco

from .errors import ModelError, unknown

Kind = Literal["body", "joint", "geom", "site", "actuator", "camera", "light", "tendon", "key"]

# MuJoCo's count of each kind is the field of MjModel named here.
_COUNT = {
    "body": "nbody",
    "joint": "njnt",
    "geom": "ngeom",
    "site": "nsite",
    "actuator": "nactuator",
    "camera": "ncam",
    "light": "nlight",
    "tendon": "ntendon",
    "key": "nkey",
}


def name_of(model: mujoco.MjModel, kind: Kind, index: int) -> str:
    """Name of one part; an unnamed one is called by kind and index, such as `joint3`.

    Raises:
        ModelError: no such kind, or `index` out of range.
    """
    count = _count(model, kind)
    if not 0 <= index < count:
        raise ModelError(f"no {kind} with index {index}; this model has {count}, counted from 0")
    given = mujoco.mj_id2name(model, _object(kind), index)
    if given:
        return str(given)
    name = f"{kind}{index}"
    while _id(model, kind, name) >= 0:  # somebody else bears that name
        name += "_"
    return name


def names_of(model: mujoco.MjModel, kind: Kind) -> tuple[str, ...]:
    """Names of all parts of one kind, in the model's order; unnamed ones as in `name_of`."""
    return tuple(name_of(model, kind, index) for index in range(_count(model, kind)))


def joint_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Names of all joints in the model's order."""
    return names_of(model, "joint")


def dof_names(model: mujoco.MjModel) -> tuple[str, ...]:
    """Names of all degrees of freedom (nv,): their joint's, with a letter where it has several."""
    letters = {
        int(mujoco.mjtJoint.mjJNT_FREE): (".x", ".y", ".z", ".rx", ".ry", ".rz"),
        int(mujoco.mjtJoint.mjJNT_BALL): (".rx", ".ry", ".rz"),
    }
    return tuple(
        name + letter
        for joint, name in enumerate(joint_names(model))
        for letter in letters.get(int(model.jnt_type[joint]), ("",))
    )


def lookup(model: mujoco.MjModel, kind: Kind, name: str) -> int:
    """Index of a named part; understands the display names that `name_of` gives to unnamed parts.

    Raises:
        ModelError: no such kind or name; the message lists what exists.
    """
    _count(model, kind)
    index = _id(model, kind, name)
    if index >= 0:
        return index
    names = names_of(model, kind)
    if name in names:
        return names.index(name)
    raise ModelError(unknown(kind, name, names))


def _count(model: mujoco.MjModel, kind: str) -> int:
    if kind not in _COUNT:
        raise ModelError(unknown("kind", kind, get_args(Kind), where="a model"))
    return int(getattr(model, _COUNT[kind]))


def _object(kind: str) -> mujoco.mjtObj:
    return getattr(mujoco.mjtObj, f"mjOBJ_{kind.upper()}")


def _id(model: mujoco.MjModel, kind: str, name: str) -> int:
    return int(mujoco.mj_name2id(model, _object(kind), name))
