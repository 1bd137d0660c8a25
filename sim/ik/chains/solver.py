"""Problems of one pose of one chain, handed to the compiled search."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ... import rotations
from ...errors import ModelError
from ...kinds import HINGE
from ...kinematics import Frame
from ..goals import BAND, Orientation, Pose, Position
from ..pose import Kinematics, parse_frame
from ..problem import Problem
from ..proofs.reach import stood
from ..space import Space
from .race import Raced, Racer, racer
from .step import Chain, fits

Array = NDArray[np.float64]
_ORTHONORMAL = 1e-5
_MOST = 1000  # iterations a start, of which few take fifty


class Found(NamedTuple):
    """First solution of a compiled search, (1, nq) or (0, nq), how many starts and iterations it took."""

    q: Array
    starts: int
    iterations: int


def racer_of(problem: Problem, start: Array) -> Callable[[Array], Found] | None:
    """Compiled search for a problem of one Position, Orientation or Pose of a chain; None for others.

    Takes starts (k, nq), of which it makes as many as it needs.
    """
    if len(problem.goals) != 1 or problem.loops:
        return None
    goal = problem.goals[0]
    if not isinstance(goal, (Position, Orientation, Pose)) or goal.relative_to is not None:
        return None
    tolerance = goal.tolerances(problem.model)
    if (tolerance > BAND).any():
        return None
    frame = moving_part(problem.kinematics.frame(goal.at), problem.moved, start)
    if not fits(frame):
        return None
    chain = Chain(frame, _limits(problem.space, frame), *_rows_of(goal), problem.scale)
    compiled = _compiled(chain.fingerprint(), chain)
    R = np.eye(3) if isinstance(goal, Position) else rotations.to_matrix(goal.quat)
    p = np.zeros(3) if isinstance(goal, Orientation) else _position(goal)
    columns = [j.q for j in frame.joints]

    def run(starts: Array) -> Found:
        table = starts[:, columns]
        raced = compiled(table[0], R, p, tolerance=(1e-6, 1e-6), most=_MOST * len(starts), starts=table[1:])
        q = np.tile(start, (int(raced.met[0]), 1))
        q[:, columns] = raced.q[: len(q)]
        return Found(q, 1 + int(raced.starts[0]), int(raced.iterations[0]))

    return run


@lru_cache(maxsize=64)
def _cached(fingerprint: str, holder: _Holder) -> Racer:
    return racer(holder.chain)


class _Holder:
    """Carries a chain past the cache, which looks at the fingerprint alone."""

    def __init__(self, chain: Chain):
        self.chain = chain

    def __hash__(self) -> int:
        return 0

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Holder)


def _compiled(fingerprint: str, chain: Chain) -> Racer:
    return _cached(fingerprint, _Holder(chain))


def _rows_of(goal: Position | Orientation | Pose) -> tuple[bool, bool]:
    return not isinstance(goal, Orientation), not isinstance(goal, Position)


def _position(goal: Position | Pose) -> Array:
    return np.asarray(goal.target if isinstance(goal, Position) else goal.position, dtype=float)


def moving_part(f: Frame, moved: NDArray[np.bool_], start: Array) -> Frame:
    """The frame with only the joints that move; the others stand as in `start` (nq,)."""
    joints, X = [], np.eye(4)
    for joint in f.joints:
        if moved[joint.v]:
            joints.append(joint._replace(X=X @ joint.X))
            X = np.eye(4)
        else:
            X = stood(X, joint, start)
    return replace(f, joints=tuple(joints), X_end=X @ f.X_end)


def _limits(space: Space, frame: Frame) -> Array:
    return np.array([[space.low[j.v], space.high[j.v]] for j in frame.joints])


class ChainSolver:
    """Inverse kinematics of one frame of a fixed chain in microseconds, for live use; no verdict, no wishes.

    Starts besides the seed are the same for every question, so that answers repeat bit for bit.

    >>> arm = ChainSolver(model, "tip")
    >>> arm(R, p, seed=q[arm.columns]).met
    """

    def __init__(self, model: mujoco.MjModel, at: str, *, position: bool = True, rotation: bool = True):
        """Compile the chain of frame `at`; ModelError for joints other than hinges and slides."""
        kinematics, space = Kinematics(model), Space(model)
        frame = kinematics.frame(at)
        if not fits(frame):
            raise ModelError(
                f"the chain of {' '.join(parse_frame(at))!r} has no or other joints than hinges and slides"
            )
        offsets = [j.X[:3, 3] for j in frame.joints[1:]] + [frame.X_end[:3, 3]]
        scale = max(0.5 * sum(float(np.linalg.norm(x)) for x in offsets), 1e-3)
        self.chain = Chain(frame, _limits(space, frame), position, rotation, scale)
        self.columns = np.array([j.q for j in frame.joints])
        hinges = np.array([int(j.type) == HINGE for j in frame.joints])
        self._endless = hinges & ~np.isfinite(self.chain.limits).any(axis=1)
        self.racer = _compiled(self.chain.fingerprint(), self.chain)

    @property
    def middle(self) -> Array:
        """Mid-range configuration (n,); the reference where a joint has no limits."""
        rest = np.array([j.rest for j in self.chain.frame.joints])
        bounded = np.asarray(np.isfinite(self.chain.limits).all(axis=1))
        low, high = np.where(bounded[:, None], self.chain.limits, 0.0).T
        return np.where(bounded, 0.5 * (low + high), rest)

    def __call__(
        self,
        R: ArrayLike,
        p: ArrayLike,
        *,
        seed: ArrayLike | None = None,
        tolerance: float = 1e-6,
        most: int = 8000,
    ) -> Raced:
        """Joint values (k, n) for R (k, 3, 3), p (k, 3) [m]; `tolerance` of every component [m, rad].

        ModelError for an R that is no rotation within 1e-5, and for p or `seed` that are not finite.
        """
        R, p = np.asarray(R, dtype=float), np.asarray(p, dtype=float)
        start = np.asarray(self.middle if seed is None else seed, dtype=float)
        self._check(R, p, start)
        raced = self.racer(start, R, p, tolerance=(tolerance, tolerance), most=most)
        if not self._endless.any():
            return raced
        turns = 2 * np.pi * np.round((raced.q - start) / (2 * np.pi))
        return raced._replace(q=raced.q - turns * self._endless)

    def _check(self, R: Array, p: Array, seed: Array) -> None:
        for name, x, shape in (("R", R, (3, 3)), ("p", p, (3,)), ("seed", seed, (self.chain.n,))):
            if x.shape[-len(shape) :] != shape:
                raise ModelError(f"{name} must have the shape {shape} or (k, {str(shape)[1:]}, not {x.shape}")
        for name, x in (("p", p), ("seed", seed)):
            if not math.isfinite(x.sum()):
                raise ModelError(f"{name} must be finite numbers, not {x}")
        if self.chain.rotation and (far := _from_rotation(R)) is not None:
            raise ModelError(
                f"R must be a rotation (orthonormal, of determinant 1), not {R.reshape(-1, 3, 3)[far]}"
            )


def _from_rotation(R: Array) -> int | None:
    """Index of the first of R (k, 3, 3) that is further than 1e-5 from a rotation, or None."""
    rows = R.reshape(-1, 9)
    # numbers of one, arrays of many: live use asks for one at a time
    a, b, c, d, e, f, g, h, i = rows[0].tolist() if len(rows) == 1 else rows.T
    off = abs(a * a + b * b + c * c - 1) + abs(d * d + e * e + f * f - 1) + abs(a * d + b * e + c * f)
    off = off + abs(b * f - c * e - g) + abs(c * d - a * f - h) + abs(a * e - b * d - i)
    if len(rows) == 1:
        return None if off < _ORTHONORMAL else 0
    bad = np.flatnonzero(~(off < _ORTHONORMAL))
    return int(bad[0]) if len(bad) else None
