# ruff: noqa: D102  (overridden methods are documented by Goal)
"""What animators ask for on top of goals: poles, soft reach, spread spines, FK/IK blends."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models.naming import lookup
from .. import rotations
from ..errors import ModelError
from ..kinds import BALL, SCALAR, SLIDE
from .goals import Goal, Rows, Unit, number, vector
from .pose import Configurations, Kinematics
from .space import Space

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Pole(Goal):
    """A limb bends towards a point: `mid` lies on the side of the line from `root` to `tip` where `pole` is.

    Residual [m]: the part of mid - root across the line, less its length along that of pole - root; it fades
    out as the limb straightens, where no side is left. Usually a wish, with a weight.
    """

    root: str
    mid: str
    tip: str
    pole: ArrayLike

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "pole", vector("pole", self.pole))

    def frames(self) -> tuple[str, ...]:
        return (self.root, self.mid, self.tip)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",) * 3

    def rows(self, c: Configurations) -> Rows:
        root, mid, tip = (c.frame(name) for name in self.frames())
        A, dA = _unit(tip.p - root.p, tip.Jv - root.Jv)
        m, dm = _across(mid.p - root.p, mid.Jv - root.Jv, A, dA)
        w, dw = _across(np.asarray(self.pole) - root.p, -root.Jv, A, dA)
        w, dw = _unit(w, dw)
        u, _ = _unit(m, dm)
        long = np.linalg.norm(m, axis=1)
        J = dm - w[:, :, None] * (u[:, None, :] @ dm) - long[:, None, None] * dw
        return Rows(m - long[:, None] * w, J)


def _unit(x: Array, dx: Array) -> tuple[Array, Array]:
    """Unit vectors (n, 3) and their derivatives (n, 3, nv); zero stays zero."""
    long = np.maximum(np.linalg.norm(x, axis=1), 1e-9)
    u = x / long[:, None]
    return u, (dx - u[:, :, None] * (u[:, None, :] @ dx)) / long[:, None, None]


def _across(x: Array, dx: Array, A: Array, dA: Array) -> tuple[Array, Array]:
    """Part of x across the unit vectors A, with its derivative."""
    along = np.sum(x * A, axis=1)
    dalong = A[:, None, :] @ dx + x[:, None, :] @ dA
    return x - along[:, None] * A, dx - A[:, :, None] * dalong - along[:, None, None] * dA


@dataclass(frozen=True, eq=False)
class Spread(Goal):
    """Joints of one kind share a turn: each stands at its share of the whole, as the vertebrae of a spine.

    `shares`: one for every joint, any positive numbers; default all alike. Usually a wish, with a weight.
    """

    joints: tuple[str, ...]
    shares: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        super().__post_init__()
        shares = [number(f"a share of {self.label}", x) for x in self.shares]
        if len(self.joints) < 2 or len(shares) not in (0, len(self.joints)) or min(shares, default=1.0) <= 0:
            raise ModelError(f"{self.label}: needs two joints or more and a positive share for each")

    @property
    def label(self) -> str:
        return self.name or "spread " + " ".join(self.joints)

    def frames(self) -> tuple[str, ...]:
        return ()

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        kinds = {int(model.jnt_type[lookup(model, "joint", name)]) for name in self.joints}
        if len(kinds) > 1 or kinds - {BALL, *SCALAR}:
            raise ModelError(f"{self.label}: only hinges, only slides or only balls have shares of a whole")
        unit: Unit = "m" if kinds == {SLIDE} else "rad"
        return (unit,) * ((len(self.joints) - 1) * (3 if kinds == {BALL} else 1))

    def moved(self, kinematics: Kinematics) -> NDArray[np.bool_]:
        model = kinematics.model
        ids = [lookup(model, "joint", name) for name in self.joints]
        return np.isin(model.dof_jntid, ids)

    def rows(self, c: Configurations) -> Rows:
        shares = np.array(self.shares or (1.0,) * len(self.joints), dtype=float)
        shares = shares / shares.sum()
        parts = [_coordinate(c.model, name, c.q) for name in self.joints]
        scaled = [(r / s, J / s) for (r, J), s in zip(parts, shares, strict=True)]
        r = [b[0] - a[0] for a, b in pairwise(scaled)]
        J = [b[1] - a[1] for a, b in pairwise(scaled)]
        return Rows(np.concatenate(r, axis=1), np.concatenate(J, axis=1))


def _coordinate(model: mujoco.MjModel, name: str, q: Array) -> tuple[Array, Array]:
    """Coordinate (n, 1), or rotation vector (n, 3) of a ball, and its Jacobian."""
    j = lookup(model, "joint", name)
    kind, at, v = int(model.jnt_type[j]), int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
    J = np.zeros((len(q), 3 if kind == BALL else 1, model.nv))
    if kind == BALL:
        phi = rotations.log(q[:, at : at + 4])
        J[:, :, v : v + 3] = rotations.inverse_right_jacobian(phi)
        return phi, J
    J[:, 0, v] = 1.0
    return q[:, at : at + 1] - model.qpos0[at], J


def soften(root: ArrayLike, target: ArrayLike, reach: float, softness: float) -> Array:
    """A target drawn in so that a limb of length `reach` from `root` never snaps straight (Nicholas 2010).

    Within reach - softness nothing changes; beyond, the distance approaches `reach` exponentially, C1.
    """
    if not 0 < softness < reach:
        raise ModelError(f"softness must be positive and below the reach {reach:g} m, not {softness:g}")
    root, target = np.asarray(root, dtype=float), np.asarray(target, dtype=float)
    away = target - root
    far = float(np.linalg.norm(away))
    easy = reach - softness
    if far <= easy:
        return target.copy()
    return np.asarray(root + away / far * (easy + softness * (1.0 - np.exp(-(far - easy) / softness))))


def blend(
    model: mujoco.MjModel,
    q_fk: ArrayLike,
    q_ik: ArrayLike,
    share: ArrayLike,
    *,
    joints: Sequence[str] | None = None,
) -> Array:
    """From a keyed motion (k, nq) to a solved one: `share` (k,) or a number, 0 for FK, 1 for IK.

    Every joint goes along its shortest way, so that limits that both keep are kept. `joints` limits the blend
    to a limb; the others stay keyed.
    """
    space = Space(model)
    fk, ik = np.atleast_2d(np.asarray(q_fk, dtype=float)), np.atleast_2d(np.asarray(q_ik, dtype=float))
    if fk.shape != ik.shape or fk.shape[1] != model.nq or np.size(share) not in (1, len(fk)):
        raise ModelError(
            f"a blend needs two motions of {model.nq} columns (nq) and one length, and a share for each row; "
            f"these have shapes {fk.shape}, {ik.shape} and {np.shape(share)}"
        )
    d = space.difference(ik, fk) * np.broadcast_to(np.asarray(share, dtype=float), (len(fk),))[:, None]
    if joints is not None:
        ids = [lookup(model, "joint", name) for name in joints]
        d = d * np.isin(model.dof_jntid, ids)
    out = space.step(fk, d)
    return out if np.ndim(q_fk) == 2 else out[0]
