"""Joint motion as uniform quadratic B-splines, whose limits hold at every time, not at samples only.

The velocity of such a curve runs straight from one difference of its control points, (c_k+1 - c_k) / dt, to
the next, so that it never leaves their hull; its acceleration around t_k is (c_k+1 - 2 c_k + c_k-1) / dt^2
(de Boor, A Practical Guide to Splines, ch. X): bounds on differences bound the curve. At t_k the curve is at
(c_k-1 + 6 c_k + c_k+1) / 8. On rotations this holds up to the curvature of the way within one step.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import mujoco
import numpy as np
import scipy
from numpy.typing import NDArray

from ...models.naming import name_of
from ..clip import Clip, FreeTrack, Track
from ..curves import PolynomialCurve, keyed
from ..kinds import BALL, FREE
from ..rotation_curves import RotationCurve, keyed_rotation, through
from .space import Space

Array = NDArray[np.float64]


def on_curve(space: Space, c: Array) -> Array:
    """Where the spline of control points c (k, nq) is at their times (k, nq); the ends are the points."""
    q = c.copy()
    if len(c) > 2:
        back, ahead = space.difference(c[:-2], c[1:-1]), space.difference(c[2:], c[1:-1])
        q[1:-1] = space.step(c[1:-1], (back + ahead) / 8)
    return q


def spline_clip(model: mujoco.MjModel, t: Array, c: Array, joints: Sequence[int]) -> Clip:
    """The splines of control points c (k, nq) at evenly spaced times t (k,), of `joints` by id."""
    space, dt = Space(model, limits=False), float(t[1] - t[0])
    step = space.difference(c[1:], c[:-1])
    middle = space.step(c[:-1], 0.5 * step)
    times = np.concatenate([t[:1], t[:-1] + 0.5 * dt, t[-1:]])
    q, v = np.concatenate([c[:1], middle, c[-1:]]), np.concatenate([step[:1], step, step[-1:]]) / dt
    return curve_clip(model, times, q, v, joints)


def curve_clip(model: mujoco.MjModel, t: Array, q: Array, v: Array, joints: Sequence[int]) -> Clip:
    """C1 cubics through q (k, nq) with velocities v (k, nv) at times t (k,), of `joints` by id."""

    def numbers(at: slice, dof: slice) -> PolynomialCurve:
        pieces = scipy.interpolate.CubicHermiteSpline(t, q[:, at], v[:, dof]).c
        return PolynomialCurve(t, q[:, at], t, "hold", "hold", pieces)

    def turns(at: slice, dof: slice) -> RotationCurve:
        return through(t, q[:, at], v[:, dof])

    return _clip(model, q[0], joints, numbers, turns)


def smooth_clip(model: mujoco.MjModel, t: Array, q: Array, joints: Sequence[int]) -> Clip:
    """Natural cubic splines through q (k, nq) at times t (k,), of `joints` by id: smoothest, unbounded."""

    def numbers(at: slice, dof: slice) -> PolynomialCurve:
        return keyed(t, q[:, at], kind="natural")

    def turns(at: slice, dof: slice) -> RotationCurve:
        return keyed_rotation(t, q[:, at], kind="natural")

    return _clip(model, q[0], joints, numbers, turns)


def _clip(
    model: mujoco.MjModel,
    q0: Array,
    joints: Sequence[int],
    numbers: Callable[[slice, slice], PolynomialCurve],
    turns: Callable[[slice, slice], RotationCurve],
) -> Clip:
    """A clip whose tracks come from columns of q and v: `numbers` of coordinates, `turns` of rotations."""
    tracks = dict[str, Track]()
    for j in joints:
        q, v = int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])
        kind, name = int(model.jnt_type[j]), name_of(model, "joint", j)
        if kind == FREE:
            place = numbers(slice(q, q + 3), slice(v, v + 3))
            tracks[name] = FreeTrack(place, turns(slice(q + 3, q + 7), slice(v + 3, v + 6)))
        elif kind == BALL:
            tracks[name] = turns(slice(q, q + 4), slice(v, v + 3))
        else:
            tracks[name] = numbers(slice(q, q + 1), slice(v, v + 1))
    return Clip(model, tracks, q0)
