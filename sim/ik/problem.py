"""Goals and the model's equalities as one system of residual rows over a batch of configurations."""

from __future__ import annotations

import time
from collections.abc import Sequence
from copy import copy
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models.naming import joint_names, lookup, name_of
from ..errors import ModelError, unknown
from .chains.machine import Prepared, charge, numbers, prepared, structure, words
from .chains.rows import is_known
from .goals import BAND, Goal, Rows
from .loops import Closure, closures
from .pose import Kinematics
from .space import Space

Array = NDArray[np.float64]


class Group(NamedTuple):
    """Rows of one goal or one loop of the model in the whole system."""

    label: str
    goal: Goal | None
    rows: slice


class Problem:
    """Residuals of hard and wished rows of `goals` on `model`.

    Attributes:
        groups: where each goal's rows are; loops of the model come last.
        judged (m,): rows that must vanish: of hard goals (of all goals when none is hard) and of loops.
        tolerance (m,): of every row.
        moved (nv,): freedoms that may change.
        wished: goals beside these that are met as well as these allow, if any.
        code: whether machine code is used: from the first (True), never (False), or when it pays (None).
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        goals: Sequence[Goal],
        space: Space,
        *,
        joints: Sequence[str] | None = None,
        kinematics: Kinematics | None = None,
        code: bool | None = None,
    ):
        self.code = code
        self.wished: Problem | None = None
        if not goals:
            raise ModelError("inverse kinematics needs at least one goal")
        self.model, self.space, self.goals = model, space, tuple(goals)
        self.kinematics = kinematics or Kinematics(model)
        wanted = np.zeros(model.nv, dtype=bool)
        for goal in goals:
            wanted |= goal.moved(self.kinematics)
        self.loops = _touched(closures(model, self.kinematics), wanted)
        self.moved = wanted & _allowed(model, joints)
        self._layout()

    def _layout(self) -> None:
        self._name: str | None = None
        self._prepared: Prepared | None = None
        self._looked = False
        hard = [g.weight is None for g in self.goals]
        strict = hard if any(hard) else [True] * len(hard)
        scale = length_of(self.model, self.kinematics, self.goals)
        groups, judged, tolerance, weight, band, metres = [], [], [], [], [], []
        at = 0
        for goal, judge in zip(self.goals, strict, strict=True):
            t = goal.tolerances(self.model)
            is_metres = np.array([u == "m" for u in goal.units(self.model)], dtype=bool)
            units = np.where(is_metres, 1.0 / scale, 1.0)
            groups.append(Group(goal.label, goal, slice(at, at + len(t))))
            metres.append(is_metres)
            at += len(t)
            judged.append(np.full(len(t), judge) & np.isfinite(t))
            tolerance.append(t)
            weight.append(units * (1.0 if goal.weight is None else np.sqrt(goal.weight)))
            band.append(np.where(t > BAND, 0.99 * t, 0.0))
        for loop in self.loops:
            m = len(loop.tolerance)
            metres.append(loop.metres)
            groups.append(Group(loop.label, None, slice(at, at + m)))
            at += m
            judged.append(np.ones(m, dtype=bool))
            tolerance.append(loop.tolerance)
            weight.append(np.where(loop.metres, 1.0 / scale, 1.0))
            band.append(np.zeros(m))
        self.groups, self.m = tuple(groups), at
        self.judged, self.tolerance = np.concatenate(judged), np.concatenate(tolerance)
        self.weight, self.band = np.concatenate(weight), np.concatenate(band)
        self.metres, self.scale = np.concatenate(metres).astype(bool), scale

    @property
    def name(self) -> str:
        """What machine code for this problem goes by; empty where there can be none."""
        if self._name is None:
            self._name = structure(self) or ""
        return self._name

    def prepared(self, *, build: bool = False) -> Prepared | None:
        """Machine code for this problem, if there is any by now; with `build`, made where it pays."""
        if self._prepared is None and self.code is not False and self.name and (build or not self._looked):
            at_once = self.code is True
            self._prepared = prepared(self, self.name, build=build or at_once, at_once=at_once)
            self._looked = True
        return self._prepared

    def beside(self, q: Array) -> Rows:
        """`raw` of the wishes beside these goals."""
        assert self.wished is not None
        quick = self.prepared()
        if quick is None or not quick.machine.layout.along:
            return self.wished.raw(q)
        r, J = quick.machine.rows(q, quick.a)
        return Rows(r[:, self.m :], J[:, self.m :])

    def raw(self, q: Array) -> Rows:
        """Residuals (n, m) [m or rad] and Jacobian (n, m, nv), without weights."""
        quick = self.prepared()
        if quick is not None:
            r, J = quick.machine.rows(q, quick.a)
            return Rows(r[:, : self.m], J[:, : self.m])
        begin = time.perf_counter()
        c = self.kinematics.at(q)
        parts = [g.rows(c) for g in self.goals] + [loop.rows(c) for loop in self.loops]
        J = np.concatenate([p.J for p in parts], axis=1)
        J[:, :, ~self.moved] = 0.0
        rows = Rows(np.concatenate([p.r for p in parts], axis=1), J)
        charge(self.name, 2 * (time.perf_counter() - begin))  # linear algebra costs as much again
        return rows

    def weighted(self, rows: Rows) -> Rows:
        """Rows as the solver sees them: bands taken off, free rows zero, metres over the model's length."""
        inside = np.clip(rows.r, -self.band, self.band)
        w = np.where(np.isfinite(self.tolerance), self.weight, 0.0)
        live = w * ((rows.r != inside) | (self.band == 0))
        return Rows(np.where(live > 0, rows.r - inside, 0.0) * w, rows.J * live[:, :, None])

    def met(self, r: Array) -> NDArray[np.bool_]:
        """Which configurations (n,) meet everything that is judged."""
        fine = (np.abs(r) <= self.tolerance) | ~self.judged
        return np.asarray(fine.all(axis=1) & np.isfinite(r).all(axis=1))

    def rank(self, start: Array) -> int:
        """How many independent rows there are but at singular configurations; the rest stands as `start`."""
        q = self.space.random(np.random.default_rng(0), 8, start, self.moved)
        return int(np.linalg.matrix_rank(self.weighted(self.raw(q)).J, tol=1e-9).max())

    def only(self, goals: Sequence[Goal]) -> Problem:
        """The same model and freedoms with other goals."""
        out = Problem(self.model, goals, self.space, kinematics=self.kinematics, code=self.code)
        out.moved &= self.moved
        return out

    def closures(self) -> Problem:
        """The model's equalities alone."""
        out = copy(self)
        out.goals, out.wished = (), None
        out._layout()
        return out

    def aimed(self, goals: Sequence[Goal]) -> Problem:
        """The same problem with goals that differ from these in what they aim at alone."""
        out = copy(self)
        out.goals, out._prepared, out._looked = tuple(goals), None, False
        out.kinematics = self.kinematics.alone()
        pairs = zip(self.groups, goals, strict=False)  # loops come last
        changed = tuple(Group(goal.label, goal, group.rows) for group, goal in pairs)
        out.groups = changed + self.groups[len(changed) :]
        return out

    def without_limits(self) -> Problem:
        """The same goals without joint limits."""
        space = Space(self.model, limits=False)
        out = Problem(self.model, self.goals, space, kinematics=self.kinematics, code=self.code)
        out.moved &= self.moved
        return out


class Asked(NamedTuple):
    """A question: goals that are judged, and wishes beside them (also `judged.wished`)."""

    judged: Problem
    wished: Problem | None


_EARLIER: dict[object, Asked] = {}
_MOST_EARLIER = 32


def asked(
    model: mujoco.MjModel, goals: Sequence[Goal], joints: Sequence[str] | None, code: bool | None = None
) -> Asked:
    """The question of `solve`.

    What follows from the model and from the names in the goals is taken over from an earlier question that
    differed in targets alone, as along a track or live.
    """
    if not all(is_known(goal) for goal in goals):
        return _asked(model, goals, joints, code)
    limits = model.jnt_range.tobytes()
    given = [(words(g), g.weight, g.tolerance) for g in goals]
    key = repr((id(model), given, joints, code)), limits, *numbers(model)
    earlier = _EARLIER.get(key)
    if earlier is None:
        earlier = _asked(model, goals, joints, code)
        _ = earlier.judged.name  # once for all
        while len(_EARLIER) >= _MOST_EARLIER:
            _EARLIER.pop(next(iter(_EARLIER)), None)
        _EARLIER[key] = earlier  # holds the model, so that its id stays its own
    if earlier.wished is None:
        return Asked(earlier.judged.aimed(goals), None)
    judged = earlier.judged.aimed([g for g in goals if g.weight is None])
    judged.wished = wished = earlier.wished.aimed([g for g in goals if g.weight is not None])
    return Asked(judged, wished)


def _asked(
    model: mujoco.MjModel, goals: Sequence[Goal], joints: Sequence[str] | None, code: bool | None
) -> Asked:
    problem = Problem(model, goals, Space(model), joints=joints, code=code)
    hard = [g for g in goals if g.weight is None]
    soft = [g for g in goals if g.weight is not None]
    if not hard or not soft:
        return Asked(problem, None)
    judged, wished = problem.only(hard), problem.only(soft)
    judged.moved, wished.moved = problem.moved, problem.moved
    wished.loops, judged.loops = [], problem.loops
    judged.wished = wished
    judged._layout()
    wished._layout()
    return Asked(judged, wished)


def length_of(model: mujoco.MjModel, kinematics: Kinematics, goals: Sequence[Goal]) -> float:
    """Length that makes metres and radians alike: half the longest stretched chain of the goals [m]."""
    longest = 0.0
    for goal in goals:
        for text in goal.frames():
            f = kinematics.frame(text)
            offsets = [j.X[:3, 3] for j in f.joints[1:]] + [f.X_end[:3, 3]]
            longest = max(longest, sum(float(np.linalg.norm(p)) for p in offsets))
    return 0.5 * longest if longest > 1e-6 else max(0.5 * float(model.stat.extent), 1e-3)


def _touched(loops: list[Closure], moved: NDArray[np.bool_]) -> list[Closure]:
    """Loops that share freedoms with `moved`, which grows by theirs, until no further loop does."""
    rest, out = list(loops), []
    while near := [loop for loop in rest if (loop.moved & moved).any()]:
        for loop in near:
            moved |= loop.moved
            rest.remove(loop)
            out.append(loop)
    return out


def _allowed(model: mujoco.MjModel, joints: Sequence[str] | None) -> NDArray[np.bool_]:
    if joints is None:
        return np.ones(model.nv, dtype=bool)
    mask = np.zeros(model.nv, dtype=bool)
    for name in (joints,) if isinstance(joints, str) else joints:
        if name not in joint_names(model):
            raise ModelError(unknown("joint", name, joint_names(model)))
        mask |= model.dof_jntid == lookup(model, "joint", name)
    return mask


def freedom_names(model: mujoco.MjModel, mask: NDArray[np.bool_]) -> tuple[str, ...]:
    """Names of the joints of the freedoms in `mask` (nv,)."""
    return tuple(
        dict.fromkeys(name_of(model, "joint", int(model.dof_jntid[v])) for v in np.flatnonzero(mask))
    )


def unwound(problem: Problem, q: Array, to: Array) -> Array:
    """`q` (n, nq) with whole turns of hinges undone towards `to`, where that changes no residual."""
    near = problem.space.nearest_turns(q, to)
    if np.array_equal(near, q):
        return near
    change = np.abs(problem.raw(near).r - problem.raw(q).r).max(axis=1, initial=0.0)
    return np.where((change < 1e-9)[:, None], near, q)
