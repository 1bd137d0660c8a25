"""Poses, Jacobians and centre of mass that goals ask for, over a batch of configurations."""

from __future__ import annotations

from copy import copy
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models.naming import lookup, name_of
from ..errors import ModelError
from ..kinematics import Frame, FrameKind, frame
from .space import Space

Array = NDArray[np.float64]


class Moving(NamedTuple):
    """A frame over a batch: R_WF (n, 3, 3), p_WF (n, 3), and its angular and linear Jacobians (n, 3, nv)."""

    R: Array
    p: Array
    Jw: Array
    Jv: Array


class _Mount(NamedTuple):
    """A frame fixed in a body: R_BF (3, 3) and p_BF (3,)."""

    body: int
    R: Array
    p: Array


def parse_frame(text: str) -> tuple[FrameKind, str]:
    """Kind and name of a frame: `tip` is a site; `body:hand`, `geom:pad`, `camera:eye` say their kind."""
    kind, colon, name = text.partition(":")
    if colon and kind in ("body", "site", "geom", "camera"):
        return kind, name  # type: ignore[return-value]
    return "site", text


class Kinematics:
    """Frames of one model, found once."""

    def __init__(self, model: mujoco.MjModel):
        self.model = model
        self._frames: dict[str, Frame] = {}
        self._mounts: dict[str, _Mount] = {}
        self._mass: list[tuple[float, Frame]] | None = None

    @cached_property
    def _data(self) -> mujoco.MjData:
        return mujoco.MjData(self.model)

    @cached_property
    def space(self) -> Space:
        """Configurations of the model."""
        return Space(self.model)

    def alone(self) -> Kinematics:
        """The same frames, for somebody else."""
        out = copy(self)
        out.__dict__.pop("_data", None)
        return out

    def frame(self, text: str) -> Frame:
        """The frame of a text as in `parse_frame`; ModelError (lists what exists) for an unknown one."""
        if text not in self._frames:
            self._frames[text] = frame(self.model, *parse_frame(text))
        return self._frames[text]

    def anchored(self, body: int, p: ArrayLike, quat: ArrayLike | None = None) -> str:
        """Key of a frame fixed at `p`, `quat` in a body."""
        key = f"body {body} {np.asarray(p).tolist()} {None if quat is None else np.asarray(quat).tolist()}"
        if key not in self._frames:
            base = frame(self.model, "body", name_of(self.model, "body", body))
            R = np.empty(9)
            mujoco.mju_quat2Mat(R, np.array([1.0, 0, 0, 0] if quat is None else quat, dtype=float))
            X = np.eye(4)
            X[:3, :3], X[:3, 3] = R.reshape(3, 3), p
            self._frames[key] = replace(base, X_end=base.X_end @ X)
            self._mounts[key] = _Mount(body, X[:3, :3], X[:3, 3])
        return key

    def settle(self, q: Array) -> mujoco.MjData:
        """MuJoCo's kinematics at one configuration (nq,)."""
        self._data.qpos[:] = q
        mujoco.mj_kinematics(self.model, self._data)
        mujoco.mj_comPos(self.model, self._data)
        return self._data

    def one(self, text: str) -> Moving:
        """A frame at the configuration of the last `settle`: far quicker than a batch of one."""
        if text not in self._mounts:
            self._mounts[text] = self._mount(text)
        mount, data = self._mounts[text], self._data
        R_WB = data.xmat[mount.body].reshape(3, 3)
        p = data.xpos[mount.body] + R_WB @ mount.p
        Jv, Jw = np.zeros((3, self.model.nv)), np.zeros((3, self.model.nv))
        mujoco.mj_jac(self.model, data, Jv, Jw, p, mount.body)
        return Moving((R_WB @ mount.R)[None], p[None], Jw[None], Jv[None])

    def _mount(self, text: str) -> _Mount:
        self.frame(text)  # says what is wrong with a name
        kind, name = parse_frame(text)
        index, body = lookup(self.model, kind, name), self.body_of(text)
        if kind == "body":
            return _Mount(body, np.eye(3), np.zeros(3))
        prefix = {"site": "site", "geom": "geom", "camera": "cam"}[kind]
        R = np.empty(9)
        mujoco.mju_quat2Mat(R, getattr(self.model, f"{prefix}_quat")[index])
        return _Mount(body, R.reshape(3, 3), getattr(self.model, f"{prefix}_pos")[index].copy())

    def masses(self) -> list[tuple[float, Frame]]:
        """Mass and centre of every body that moves and weighs something."""
        if self._mass is None:
            self._mass = []
            for b in range(1, self.model.nbody):
                f = self._frames[self.anchored(b, self.model.body_ipos[b])]
                if self.model.body_mass[b] > 0 and f.joints:
                    self._mass.append((float(self.model.body_mass[b]), f))
            if not self._mass:
                raise ModelError("nothing that moves has mass in this model: a centre of mass means nothing")
        return self._mass

    def heavy(self) -> list[tuple[str, float]]:
        """Keys of the centres of the bodies of `masses`, and their masses."""
        self.masses()
        return [
            (self.anchored(b, self.model.body_ipos[b]), float(self.model.body_mass[b]))
            for b in range(1, self.model.nbody)
            if self.model.body_mass[b] > 0 and self._frames[self.anchored(b, self.model.body_ipos[b])].joints
        ]

    def body_of(self, text: str) -> int:
        """Body that carries a frame."""
        kind, name = parse_frame(text)
        index = lookup(self.model, kind, name)
        if kind == "body":
            return index
        field = {"site": "site", "geom": "geom", "camera": "cam"}[kind]
        return int(getattr(self.model, f"{field}_bodyid")[index])

    def at(self, q: Array) -> Configurations:
        """The batch q (n, nq)."""
        return Configurations(self, q)


class Configurations:
    """A batch of configurations; each frame is computed when first asked for."""

    def __init__(self, kinematics: Kinematics, q: Array):
        self.kinematics, self.model, self.q = kinematics, kinematics.model, q
        self._known: dict[str, Moving] = {}
        self._single = len(q) == 1
        if self._single:
            kinematics.settle(q[0])

    def frame(self, text: str) -> Moving:
        """A frame by its text (see `parse_frame`)."""
        if text not in self._known:
            single = self._single
            self._known[text] = (
                self.kinematics.one(text) if single else moving(self.kinematics.frame(text), self.q)
            )
        return self._known[text]

    def center_of_mass(self) -> tuple[Array, Array]:
        """Centre of mass of everything that moves (n, 3) and its Jacobian (n, 3, nv)."""
        if self._single:
            return self._one_center()
        total, p, J = 0.0, np.zeros((len(self.q), 3)), np.zeros((len(self.q), 3, self.model.nv))
        for mass, f in self.kinematics.masses():
            m = moving(f, self.q)
            total, p, J = total + mass, p + mass * m.p, J + mass * m.Jv
        return p / total, J / total

    def _one_center(self) -> tuple[Array, Array]:
        total, p, J = 0.0, np.zeros(3), np.zeros((3, self.model.nv))
        for text, mass in self.kinematics.heavy():
            m = self.frame(text)
            total, p, J = total + mass, p + mass * m.p[0], J + mass * m.Jv[0]
        return p[None] / total, J[None] / total


def moving(f: Frame, q: Array) -> Moving:
    """Pose and Jacobian of a frame."""
    X, J = f.pose(q), f.jacobian(q)
    return Moving(X[:, :3, :3], X[:, :3, 3], J[:, :3], J[:, 3:])
