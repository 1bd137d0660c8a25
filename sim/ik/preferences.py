"""What to do with freedom that goals leave: preferences as rows to make small."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..errors import ModelError, unknown
from .collision import Clearance
from .goals import Rows
from .numeric.settle import Wish
from .problem import Problem
from .space import Space
from .wholes import Posture

Array = NDArray[np.float64]
Preference = Literal["near", "middle", "manipulability", "clear"]
PREFERENCES: tuple[Preference, ...] = ("near", "middle", "manipulability", "clear")
FAINT = 1e-4  # preferences beside wishes: rows this much smaller


def chosen(prefer: str | None, obstacles: Sequence[tuple[str, str]]) -> str:
    """The preference meant: what was asked for, or clear of obstacles where there are some, or near."""
    if prefer is None:
        return "clear" if obstacles else "near"
    if prefer not in PREFERENCES:
        raise ModelError(unknown("preference", prefer, PREFERENCES, where="inverse kinematics"))
    if obstacles and prefer != "clear":
        raise ModelError(f"obstacles are kept away from by the preference 'clear', not by {prefer!r}")
    return prefer


def closest(model: mujoco.MjModel, obstacles: Sequence[tuple[str, str]], q: Array) -> str:
    """How near the nearest pair of obstacles is at q (nq,), in words; empty without obstacles."""
    if not obstacles:
        return ""
    clearance = Clearance(model, obstacles)
    distance, (a, b) = min(
        (gap.distance, pair) for gap, pair in zip(clearance.gaps(q), obstacles, strict=True)
    )
    if distance >= clearance.reach:
        return f"; obstacles at least {clearance.reach:g} m away"
    how = f"overlap by {-distance:.3g} m" if distance < 0 else f"are {distance:.3g} m apart"
    return f"; {a} and {b} {how}"


def wishes(problem: Problem, prefer: Wish) -> Wish:
    """Rows of a problem of weighted goals, and faintly those of a preference."""

    def rows(q: Array) -> Rows:
        faint, w = prefer(q), problem.weighted(problem.raw(q))
        return Rows(
            np.concatenate([w.r, FAINT * faint.r], axis=1), np.concatenate([w.J, FAINT * faint.J], axis=1)
        )

    return rows


def preference(kind: str, problem: Problem, q0: Array, obstacles: Sequence[tuple[str, str]] = ()) -> Wish:
    """Rows of a preference: near `q0`, mid-range, well-conditioned, or clear of obstacles."""
    near = _near(problem, q0)
    if kind == "near":
        return near
    if kind == "middle":
        return _both(_middle(problem), near)
    if kind == "clear":
        return _both(Clearance(problem.model, obstacles).rows, near)
    return _both(_manipulability(problem), near)


def _both(first: Wish, faint: Wish) -> Wish:
    """A preference with `faint` deciding what it leaves open."""

    def rows(q: Array) -> Rows:
        a, b = first(q), faint(q)
        return Rows(np.concatenate([a.r, 1e-2 * b.r], axis=1), np.concatenate([a.J, 1e-2 * b.J], axis=1))

    return rows


def _near(problem: Problem, q0: Array) -> Wish:
    goal = Posture(q0, weight=1.0)

    def rows(q: Array) -> Rows:
        r, J = goal.rows(problem.kinematics.at(q))
        return Rows(r * problem.moved, J * problem.moved[:, None])

    return rows


def _middle(problem: Problem) -> Wish:
    space = problem.space
    ranged = np.flatnonzero(problem.moved & np.isfinite(space.low) & np.isfinite(space.high))
    ranged = ranged[space.high[ranged] > space.low[ranged]]
    half = 0.5 * (space.high - space.low)[ranged]
    middle = 0.5 * (space.high + space.low)[ranged]

    def rows(q: Array) -> Rows:
        J = np.zeros((len(q), len(ranged), space.nv))
        J[:, np.arange(len(ranged)), ranged] = 1.0 / half
        return Rows((q[:, space.q_of_v[ranged]] - middle) / half, J)

    return rows


def _manipulability(problem: Problem) -> Wish:
    """One row 1/w, w = sqrt(det J J^T) of the weighted goal rows (Yoshikawa 1985), by central differences.

    Directions that the chain never moves in, as out of a planar arm's plane, are left out of w.
    """
    h, columns = 1e-6, np.flatnonzero(problem.moved)
    space, free = problem.space, Space(problem.model, limits=False)
    rank = problem.rank(space.clip(problem.model.qpos0[None])[0])

    def inverse(q: Array) -> Array:
        J = problem.weighted(problem.raw(q)).J
        s = np.linalg.svd(J, compute_uv=False)
        return np.asarray(1.0 / np.maximum(np.prod(s[:, :rank], axis=1), 1e-9))

    def rows(q: Array) -> Rows:
        J = np.zeros((len(q), 1, problem.space.nv))
        for k, x in enumerate(q):
            d = np.zeros((2 * len(columns), problem.space.nv))
            d[np.arange(len(columns)), columns] = h
            d[len(columns) + np.arange(len(columns)), columns] = -h
            f = inverse(free.step(np.tile(x, (len(d), 1)), d))
            J[k, 0, columns] = (f[: len(columns)] - f[len(columns) :]) / (2 * h)
        return Rows(inverse(q)[:, None], J)

    return rows
