# ruff: noqa: D102  (overridden methods are documented by Goal)
"""Goals of inverse kinematics: what is wanted of frames, joints and the centre of mass.

A goal gives residual rows, each in metres or radians, and their Jacobian by the tangent of q. Without a
weight it is hard: it is met within its tolerance or the verdict is negative. With a weight it is a wish, met
as well as the hard goals allow. Frames are named by text: `tip` is a site, `body:hand` a body.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from functools import cached_property
from typing import Literal, NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .. import rotations
from ..errors import ModelError
from .pose import Configurations, Kinematics, Moving

Array = NDArray[np.float64]
Unit = Literal["m", "rad"]
TOLERANCE = 1e-6
BAND = 1e-4  # a larger tolerance is room that the answer may use


class Rows(NamedTuple):
    """Residuals r (n, m) and Jacobian J (n, m, nv)."""

    r: Array
    J: Array


@dataclass(frozen=True, eq=False, kw_only=True)
class Goal(ABC):
    """Base of all goals.

    `weight`: None for a hard goal. `name`: what reports call it. `tolerance`: of every row, or one per row
    [m or rad]; above 1e-4 a band that the answer may lie anywhere in, `inf` leaves a row free.
    """

    weight: float | None = None
    name: str = ""
    tolerance: float | tuple[float, ...] = TOLERANCE

    def __post_init__(self) -> None:
        for text in self.frames():
            if not isinstance(text, str):
                raise ModelError(f"a frame is named by text, as 'tip' or 'body:hand', not by {text!r:.100}")
        if self.weight is not None and number(f"weight of goal {self.label!r}", self.weight) <= 0:
            raise ModelError(f"weight of goal {self.label!r} must be positive, or None for a hard goal")
        try:
            positive = bool((np.asarray(self.tolerance, dtype=float) > 0).all())
        except (TypeError, ValueError):
            positive = False
        if not positive:
            raise ModelError(f"tolerance of goal {self.label!r} must be positive, not {self.tolerance!r}")

    @property
    def label(self) -> str:
        """Name, or kind and frame."""
        return self.name or " ".join([type(self).__name__.lower(), *self.frames()])

    @abstractmethod
    def frames(self) -> tuple[str, ...]:
        """Frames that the goal looks at."""

    @abstractmethod
    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        """Unit of every row on `model`."""

    @abstractmethod
    def rows(self, c: Configurations) -> Rows:
        """Residuals and Jacobian over a batch."""

    def moved(self, kinematics: Kinematics) -> NDArray[np.bool_]:
        """Freedoms (nv,) that can change the goal."""
        mask = np.zeros(kinematics.model.nv, dtype=bool)
        for text in self.frames():
            mask[kinematics.frame(text).dofs] = True
        return mask

    def tolerances(self, model: mujoco.MjModel) -> Array:
        """Tolerance of every row (m,)."""
        m = len(self.units(model))
        t = np.asarray(self.tolerance, dtype=float)
        if t.ndim and t.shape != (m,):
            raise ModelError(
                f"goal {self.label!r} has {m} rows: one tolerance or {m}, not of shape {t.shape}"
            )
        return np.broadcast_to(t, (m,))

    def errors(self, r: Array, model: mujoco.MjModel) -> tuple[Array, Array]:
        """Size of residuals (n, m): (n,) in metres and (n,) in radians, free rows left out."""
        kept = np.isfinite(self.tolerances(model))
        metres = np.array([u == "m" for u in self.units(model)], dtype=bool)
        return _norm(r[:, metres & kept]), _norm(r[:, ~metres & kept])


def _norm(x: Array) -> Array:
    return np.asarray(np.linalg.norm(x, axis=1)) if x.shape[1] else np.zeros(len(x))


def vector(name: str, x: ArrayLike, n: int = 3) -> Array:
    """`x` as n finite floats; ModelError with `name` otherwise."""
    try:
        out = np.array(x, dtype=float)
    except (TypeError, ValueError):
        out = np.full(n, np.nan)
    if out.shape != (n,) or not np.isfinite(out).all():
        raise ModelError(f"{name} must be {n} finite numbers, not {x!r:.100}")
    return out


def number(name: str, x: object) -> float:
    """`x` as a finite float; ModelError with `name` otherwise."""
    if not isinstance(x, (int, float, np.integer, np.floating)) or not np.isfinite(x):
        raise ModelError(f"{name} must be a finite number, not {x!r:.100}")
    return float(x)


def unit(name: str, x: ArrayLike, n: int = 3) -> Array:
    """`x` at length one; ModelError with `name` for what gives no direction."""
    out = vector(name, x, n)
    length = np.linalg.norm(out)
    if length < 1e-12:
        raise ModelError(f"{name} is zero: it gives no direction")
    return np.asarray(out / length)


def seen_from(c: Configurations, at: str, base: str | None) -> Moving:
    """Frame `at` in the frame `base` (None: the world), with Jacobians of that relative pose."""
    f = c.frame(at)
    if base is None:
        return f
    b = c.frame(base)
    back = b.R.transpose(0, 2, 1)
    arm = f.p - b.p
    Jv = f.Jv - b.Jv + rotations.skew(arm) @ b.Jw  # the base's turning sweeps the arm: - w x arm
    return Moving(back @ f.R, (back @ arm[..., None])[..., 0], back @ (f.Jw - b.Jw), back @ Jv)


@dataclass(frozen=True, eq=False)
class Position(Goal):
    """The origin of `at` is at `target` (3,) [m], in world axes or those of `relative_to`."""

    at: str
    target: ArrayLike
    relative_to: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "target", vector("target", self.target))

    def frames(self) -> tuple[str, ...]:
        return (self.at,) if self.relative_to is None else (self.at, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",) * 3

    def rows(self, c: Configurations) -> Rows:
        f = seen_from(c, self.at, self.relative_to)
        return Rows(f.p - np.asarray(self.target), f.Jv)


@dataclass(frozen=True, eq=False)
class Orientation(Goal):
    """`at` is turned as `quat` (4,) wxyz, in the world or in `relative_to`.

    Residual: the rotation vector from target to frame in the target's axes [rad]; its tolerance is per axis.
    """

    at: str
    quat: ArrayLike
    relative_to: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "quat", unit("quat", self.quat, 4))

    @cached_property
    def back(self) -> Array:
        """R_T^T (3, 3) of the target."""
        return np.asarray(rotations.to_matrix(self.quat).T)

    def frames(self) -> tuple[str, ...]:
        return (self.at,) if self.relative_to is None else (self.at, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("rad",) * 3

    def rows(self, c: Configurations) -> Rows:
        return _turn_rows(seen_from(c, self.at, self.relative_to), self.back)


def _turn_rows(f: Moving, back: Array) -> Rows:
    """log(R_T^T R) in the target's axes, `back` = R_T^T; its derivative is J_left^-1 R_T^T w."""
    phi = rotations.log(rotations.from_matrix(back @ f.R))
    return Rows(phi, rotations.inverse_right_jacobian(-phi) @ (back @ f.Jw))


@dataclass(frozen=True, eq=False)
class Pose(Goal):
    """The frame `at` is at `position` (3,) [m] and turned as `quat` (4,) wxyz; six tolerances at most."""

    at: str
    position: ArrayLike
    quat: ArrayLike
    relative_to: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "position", vector("position", self.position))
        object.__setattr__(self, "quat", unit("quat", self.quat, 4))

    @cached_property
    def back(self) -> Array:
        """R_T^T (3, 3) of the target."""
        return np.asarray(rotations.to_matrix(self.quat).T)

    def frames(self) -> tuple[str, ...]:
        return (self.at,) if self.relative_to is None else (self.at, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",) * 3 + ("rad",) * 3

    def rows(self, c: Configurations) -> Rows:
        f = seen_from(c, self.at, self.relative_to)
        turn = _turn_rows(f, self.back)
        return Rows(
            np.concatenate([f.p - np.asarray(self.position), turn.r], axis=1),
            np.concatenate([f.Jv, turn.J], axis=1),
        )


@dataclass(frozen=True, eq=False)
class LookAt(Goal):
    """The local `axis` of `at` points to the point `target` (3,) [m] of the world, or of `relative_to`.

    Residual: difference of the unit vectors of axis and sight, 2 sin(angle / 2) long.
    """

    at: str
    target: ArrayLike
    axis: ArrayLike = (0.0, 0.0, 1.0)
    relative_to: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "target", vector("target", self.target))
        object.__setattr__(self, "axis", unit("axis", self.axis))

    def frames(self) -> tuple[str, ...]:
        return (self.at,) if self.relative_to is None else (self.at, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("rad",) * 3

    def rows(self, c: Configurations) -> Rows:
        f = c.frame(self.at)
        a = f.R @ np.asarray(self.axis)
        sight, J = np.asarray(self.target) - f.p, -f.Jv
        if self.relative_to is not None:
            b = c.frame(self.relative_to)
            arm = b.R @ np.asarray(self.target)
            sight, J = b.p + arm - f.p, b.Jv - rotations.skew(arm) @ b.Jw - f.Jv
        far = np.maximum(np.linalg.norm(sight, axis=1), 1e-9)[:, None]
        d = sight / far
        Jd = (J - d[:, :, None] * (d[:, None, :] @ J)) / far[:, :, None]
        return Rows(a - d, -rotations.skew(a) @ f.Jw - Jd)

    def errors(self, r: Array, model: mujoco.MjModel) -> tuple[Array, Array]:
        return np.zeros(len(r)), 2 * np.arcsin(np.minimum(1.0, 0.5 * _norm(r)))


@dataclass(frozen=True, eq=False)
class PointOnLine(Goal):
    """The origin of `at` lies on the line through `point` along `direction`, in axes of the world or those of
    `relative_to`."""

    at: str
    point: ArrayLike
    direction: ArrayLike
    relative_to: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "point", vector("point", self.point))
        object.__setattr__(self, "direction", unit("direction", self.direction))

    def frames(self) -> tuple[str, ...]:
        return (self.at,) if self.relative_to is None else (self.at, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",) * 2

    def rows(self, c: Configurations) -> Rows:
        f = seen_from(c, self.at, self.relative_to)
        across = np.linalg.svd(np.asarray(self.direction)[None])[2][1:]  # two unit vectors across the line
        return Rows((f.p - np.asarray(self.point)) @ across.T, across @ f.Jv)


@dataclass(frozen=True, eq=False)
class PointOnPlane(Goal):
    """The origin of `at` lies in the plane through `point` with `normal`, in axes of the world or those of
    `relative_to`."""

    at: str
    point: ArrayLike
    normal: ArrayLike
    relative_to: str | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        object.__setattr__(self, "point", vector("point", self.point))
        object.__setattr__(self, "normal", unit("normal", self.normal))

    def frames(self) -> tuple[str, ...]:
        return (self.at,) if self.relative_to is None else (self.at, self.relative_to)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",)

    def rows(self, c: Configurations) -> Rows:
        f, n = seen_from(c, self.at, self.relative_to), np.asarray(self.normal)
        return Rows((f.p - np.asarray(self.point)) @ n[:, None], n[None] @ f.Jv)


@dataclass(frozen=True, eq=False)
class Distance(Goal):
    """The origins of `at` and `to` (a frame, or a world point) are `distance` [m] apart."""

    at: str
    to: str | ArrayLike
    distance: float

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.to, str):
            object.__setattr__(self, "to", vector("to", self.to))
        if number("a distance", self.distance) < 0:
            raise ModelError(f"a distance is not negative, as {self.distance} is")

    def frames(self) -> tuple[str, ...]:
        return (self.at, self.to) if isinstance(self.to, str) else (self.at,)

    def units(self, model: mujoco.MjModel) -> tuple[Unit, ...]:
        return ("m",)

    def rows(self, c: Configurations) -> Rows:
        f = c.frame(self.at)
        p, J = f.p, f.Jv
        if isinstance(self.to, str):
            other = c.frame(self.to)
            p, J = p - other.p, J - other.Jv
        else:
            p = p - np.asarray(self.to)
        long = _norm(p)
        u = p / np.maximum(long, 1e-12)[:, None]
        return Rows(long[:, None] - self.distance, u[:, None, :] @ J)
