# ruff: noqa: D102  (overridden methods are documented by Goal)
"""Goals of joints and of the configuration as a whole: joint values, postures, the centre of mass."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models.naming import lookup
from .. import rotations
from ..errors import ModelError
from ..kinds import FREE, SCALAR, SLIDE
from .goals import Goal, Rows, Unit, number, vector
from .pose import Configurations, Kinematics

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CenterOfMass(Goal):
    """The centre of mass of everything that moves is at `target` (3,) [m]; tolerances free an axis by inf."""

    target: ArrayLike

    def __post_init__(self) -> None:
        object.__setattr__(self, "target", vector("target", self.target))
        super().__post_init__()

    @property
    def label(self) -> str:
        return self.name or "centre of mass"

    def frames(self) -> tuple[str, ...]:
        return ()

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",) * 3

    def moved(self, kinematics: Kinematics) -> NDArray[np.bool_]:
        mask = np.zeros(kinematics.model.nv, dtype=bool)
        for _, f in kinematics.masses():
            mask[f.dofs] = True
        return mask

    def rows(self, c: Configurations) -> Rows:
        p, J = c.center_of_mass()
        return Rows(p - np.asarray(self.target), J)


@dataclass(frozen=True, eq=False)
class JointValue(Goal):
    """The hinge or slide `joint` stands at `value` [rad or m]."""

    joint: str
    value: float

    def __post_init__(self) -> None:
        super().__post_init__()
        number(f"the value of joint {self.joint!r}", self.value)

    @property
    def label(self) -> str:
        return self.name or f"joint {self.joint}"

    def frames(self) -> tuple[str, ...]:
        return ()

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return (freedom_units(model)[scalar_joint(model, self.joint)[1]],)

    def moved(self, kinematics: Kinematics) -> NDArray[np.bool_]:
        mask = np.zeros(kinematics.model.nv, dtype=bool)
        mask[scalar_joint(kinematics.model, self.joint)[1]] = True
        return mask

    def rows(self, c: Configurations) -> Rows:
        q, v = scalar_joint(c.model, self.joint)
        J = np.zeros((len(c.q), 1, c.model.nv))
        J[:, 0, v] = 1.0
        return Rows(c.q[:, q : q + 1] - self.value, J)


def freedom_units(model: mujoco.MjModel) -> tuple[Unit, ...]:
    """Unit of every freedom (nv): metres of slides and of the places of free joints, else radians."""
    out: list[Unit] = ["rad"] * int(model.nv)
    for kind, v in zip(model.jnt_type, model.jnt_dofadr, strict=True):
        if int(kind) in (SLIDE, FREE):
            n = 1 if int(kind) == SLIDE else 3
            out[v : v + n] = ["m"] * n
    return tuple(out)


def scalar_joint(model: mujoco.MjModel, name: str) -> tuple[int, int]:
    """Addresses in q and v of a hinge or slide; ModelError for other joints."""
    j = lookup(model, "joint", name)
    if int(model.jnt_type[j]) not in SCALAR:
        raise ModelError(f"joint {name!r} is no hinge or slide: it has no single value")
    return int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])


@dataclass(frozen=True, eq=False)
class Posture(Goal):
    """The whole configuration is `q` (nq,); nearly always a wish, so give it a weight."""

    q: ArrayLike

    def __post_init__(self) -> None:
        super().__post_init__()
        q = np.array(self.q, dtype=float)
        if q.ndim != 1 or not np.isfinite(q).all():
            raise ModelError(f"a posture is one row of finite numbers, not {self.q!r:.200}")
        object.__setattr__(self, "q", q)

    @property
    def label(self) -> str:
        return self.name or "posture"

    def frames(self) -> tuple[str, ...]:
        return ()

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return freedom_units(model)

    def moved(self, kinematics: Kinematics) -> NDArray[np.bool_]:
        if len(np.asarray(self.q)) != kinematics.model.nq:
            n, nq = len(np.asarray(self.q)), kinematics.model.nq
            raise ModelError(f"a posture of this model is {nq} numbers (nq), not {n}")
        return np.ones(kinematics.model.nv, dtype=bool)

    def rows(self, c: Configurations) -> Rows:
        space = c.kinematics.space
        d = space.difference(c.q, np.asarray(self.q, dtype=float)[None])
        J = np.tile(np.eye(c.model.nv), (len(d), 1, 1))
        v = space.turns
        J[:, v[:, :, None], v[:, None, :]] = rotations.inverse_right_jacobian(d[:, v])
        return Rows(d, J)
