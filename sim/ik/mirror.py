# ruff: noqa: D102  (overridden methods are documented by Goal)
"""The goal that a frame is the mirror image of another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import rotations
from ..errors import ModelError
from .goals import Goal, Rows, Unit, seen_from, unit, vector
from .pose import Configurations

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Mirror(Goal):
    """`at` is the mirror image of `of` in the plane through `point` along `normal`.

    With `relative_to`, the plane is fixed in that frame, so that a limb mirrors another on a turned trunk.
    `what`: its origin ("position"), how it is turned ("orientation"), or both ("pose"). The image of a frame
    has left-handed axes; its `flip` axis, in axes of the frame, is turned around to make them right-handed:
    R_at = S R_of S_flip with S_n = 1 - 2 n n^T. Default `flip`: the normal, for frames whose axes are those
    of the plane's frame where limbs hang at rest.
    """

    at: str
    of: str
    normal: ArrayLike = (0.0, 1.0, 0.0)
    point: ArrayLike = (0.0, 0.0, 0.0)
    relative_to: str | None = None
    what: Literal["position", "orientation", "pose"] = "position"
    flip: ArrayLike | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "normal", unit("normal", self.normal))
        object.__setattr__(self, "point", vector("point", self.point))
        object.__setattr__(self, "flip", self.normal if self.flip is None else unit("flip", self.flip))
        if self.what not in ("position", "orientation", "pose"):
            raise ModelError(f"a mirror is of the position, the orientation or the pose, not {self.what!r}")

    def frames(self) -> tuple[str, ...]:
        return (self.at, self.of) if self.relative_to is None else (self.at, self.of, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        place: tuple[Unit, ...] = ("m",) * 3
        turn: tuple[Unit, ...] = ("rad",) * 3
        return {"position": place, "orientation": turn, "pose": place + turn}[self.what]

    def rows(self, c: Configurations) -> Rows:
        f, g = (seen_from(c, at, self.relative_to) for at in (self.at, self.of))
        S, point = _reflection(np.asarray(self.normal)), np.asarray(self.point)
        place = Rows(f.p - (g.p - point) @ S - point, f.Jv - S @ g.Jv)
        if self.what == "position":
            return place
        image = S @ g.R @ _reflection(np.asarray(self.flip))
        back = image.transpose(0, 2, 1)
        phi = rotations.log(rotations.from_matrix(back @ f.R))
        # a mirrored turn goes the other way around the mirrored axis: S [w] S = [-S w]
        turn = Rows(phi, rotations.inverse_right_jacobian(-phi) @ (back @ (f.Jw + S @ g.Jw)))
        if self.what == "orientation":
            return turn
        return Rows(np.concatenate([place.r, turn.r], axis=1), np.concatenate([place.J, turn.J], axis=1))


def _reflection(n: Array) -> Array:
    """1 - 2 n n^T: mirror in the plane along the unit vector n."""
    return np.asarray(np.eye(3) - 2 * np.outer(n, n))
