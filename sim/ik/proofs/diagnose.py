"""Why goals were not met: bounds and closed forms, then searches with parts of the question left out."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..chains.closed_form import closed_form
from ..goals import Goal, Orientation, Pose, Position, Rows
from ..numeric.descend import Descent, descend
from ..numeric.nearest import brought, settle_least
from ..numeric.search import Search
from ..numeric.settle import settle
from ..problem import Problem, freedom_names, unwound
from ..verdict import Verdict
from ..wholes import CenterOfMass
from .gaps import NO_GAP, Gap, closed_form_outside, goal_gap, pair_gap, pairs, rooms, subdivision

Array = NDArray[np.float64]
_SAME = 1e-6  # [m, rad] between two bounds of a distance that is known


class Diagnosis(NamedTuple):
    """A negative verdict, with a solution outside the limits (nq,) if these are the reason.

    `found` (k, nq): what the searches for reasons came upon after all.
    """

    verdict: Verdict
    q_free: Array | None
    found: Array


def diagnose(problem: Problem, search: Search, nearest: Descent) -> Diagnosis:
    """Verdict on a problem that no start solved; `nearest` is the best pose found."""
    goals = problem.goals
    if nearest.met[0]:  # a slow end, as at a singular boundary, got there after all
        return _after_all(nearest)
    if (open_loop := _open(problem, search)) is not None:
        return open_loop
    unlimited = problem.without_limits()
    gaps = {goal: goal_gap(unlimited, goal, search.start) for goal in goals}
    blocked = [g for g in goals if _exceeds(problem, gaps[g], g)]
    if blocked:
        return _out_of_reach(problem, search, nearest, blocked[0], gaps[blocked[0]])
    for a, b in pairs(goals):
        gap = pair_gap(unlimited, a, b, search.start)
        if _exceeds(problem, gap, a, b):
            return _conflict(problem, search, nearest, (a, b), gap)
    free = _without_limits(problem, search, nearest)
    if free is not None:
        return _held(problem, search, nearest, free)
    if len(goals) == 1:
        return _out_of_reach(problem, search, nearest, goals[0], NO_GAP)
    return _together(problem, search, nearest)


def _open(problem: Problem, search: Search) -> Diagnosis | None:
    """The verdict that the model's own equalities cannot hold; None where they can."""
    if not problem.loops:
        return None
    loops = problem.closures()
    part = search.part(loops, 100, 6)
    if len(part.solutions(search.best.q[:6])):
        return None
    end = brought(part)
    search.iterations += part.iterations
    r, metres = end.r[0], loops.metres
    position, rotation = float(np.linalg.norm(r[metres])), float(np.linalg.norm(r[~metres]))
    names = tuple(group.label for group in loops.groups)
    left = _words(position, rotation)
    reason = f"{' and '.join(names)} of the model cannot hold within the limits: {left} remain"
    return _negative(problem, Verdict("out of reach", False, reason, position, rotation, goals=names))


def excluded(problem: Problem, q: Array) -> bool:
    """Whether lengths and limits prove, without any search, that the goals cannot be met."""
    goals = problem.goals
    return any(_exceeds(problem, goal_gap(problem, g, q), g) for g in goals) or any(
        _exceeds(problem, pair_gap(problem, a, b, q), a, b) for a, b in pairs(goals)
    )


def _exceeds(problem: Problem, gap: Gap, *goals: Goal) -> bool:
    """Whether a proved gap is larger than the goals' tolerances allow."""
    position = rotation = 0.0
    for goal in goals:
        if not isinstance(goal, CenterOfMass):  # gaps of these leave free rows out
            free = ~np.isfinite(goal.tolerances(problem.model))
            metres = np.array([u == "m" for u in goal.units(problem.model)], dtype=bool)
            position += np.inf if (free & metres).any() else 0.0
            rotation += np.inf if (free & ~metres).any() else 0.0
        near, straight = rooms(problem, goal)
        position, rotation = position + near, rotation + straight
    return gap.position > position or gap.rotation > rotation


def _without_limits(problem: Problem, search: Search, nearest: Descent) -> Array | None:
    """A solution (nq,) that leaves the limits as little as was found; None without any."""
    free = problem.without_limits()
    form = closed_form(free, search.start)
    first = [search.best.q, nearest.q] + ([] if form is None else [form.q])
    looking = search.part(free, max(24, search.restarts // 2), 1)
    found = looking.solutions(np.concatenate(first))
    search.iterations += looking.iterations
    if not len(found):
        return None
    found = unwound(free, found, problem.space.middle(search.start, problem.moved))
    excess = problem.space.excess(found)
    order = np.argsort(np.sum(excess**2, axis=1))[:3]

    def beyond(q: Array) -> Rows:
        r = problem.space.excess(q)
        x = np.zeros_like(r)
        x[:, problem.space.scalar_v] = q[:, problem.space.scalar_q]
        sign = np.where(x > problem.space.high, 1.0, -1.0) * (r > 0)
        return Rows(r, sign[:, :, None] * np.eye(problem.space.nv))

    ends = [settle(free, found[i], beyond) for i in order]
    return min(ends, key=lambda end: end.value).q


def _held(problem: Problem, search: Search, nearest: Descent, free: Array) -> Diagnosis:
    """Limits are the reason, unless the solution found without them is inside after all."""
    inside = descend(problem, problem.space.clip(free[None]))
    if inside.met[0]:
        return _after_all(inside)
    excess = problem.space.excess(free[None])[0]
    joints = dict.fromkeys(freedom_names(problem.model, excess > 1e-09), 0.0)
    for v in np.flatnonzero(excess > 1e-9):
        name = freedom_names(problem.model, np.arange(problem.space.nv) == v)[0]
        joints[name] = max(joints[name], float(excess[v]))
    proved = _proved_held(problem, search)
    position, rotation = _sizes(problem, nearest.r)
    held = _held_goals(problem, search)
    gaps = [goal_gap(problem, goal, search.start) for goal in problem.goals]
    gap = Gap(float(np.hypot.reduce([g.position for g in gaps])),
              float(np.hypot.reduce([g.rotation for g in gaps])), "")  # fmt: skip
    names = " and ".join(f"{name} (by {far:.4g})" for name, far in joints.items())
    left = _remaining(position, rotation, gap)
    reason = f"without limits they are met, with {names} outside; inside, {left} remain"
    verdict = Verdict(
        "held by limits", proved, reason, position, rotation, 0.0, joints, tuple(g.label for g in held)
    )
    return _negative(problem, verdict, free)


def _held_goals(problem: Problem, search: Search) -> tuple[Goal, ...]:
    """Goals that limits exclude alone, or a smallest set that they exclude together."""
    goals = problem.goals
    if len(goals) == 1:
        return goals
    return tuple(g for g in goals if not _meets(problem.only([g]), search)) or _core(problem, search)


def _proved_held(problem: Problem, search: Search) -> bool:
    """Whether the ranges of the joints prove that nothing inside them meets the goals."""
    if excluded(problem, search.start):
        return True
    if closed_form_outside(problem, closed_form(problem, search.start)) is not None:
        return True
    return subdivision(problem, search.start)


def _sizes(problem: Problem, r: Array) -> tuple[float, float]:
    """Residuals (1, m) of judged goals in metres and radians."""
    position = rotation = 0.0
    for group in problem.groups:
        if group.goal is not None:
            p, w = group.goal.errors(r[:, group.rows], problem.model)
            position, rotation = float(np.hypot(position, p[0])), float(np.hypot(rotation, w[0]))
    return position, rotation


def _words(position: float, rotation: float) -> str:
    parts = [f"{position:.6g} m"] * (position > 1e-9) + [f"{rotation:.6g} rad"] * (rotation > 1e-9)
    return " and ".join(parts) or "nothing"


def _remaining(position: float, rotation: float, gap: Gap) -> str:
    """How far in words: a nearest pose that was found bounds it from above, a proved gap from below."""
    sure = position - gap.position < _SAME and rotation - gap.rotation < _SAME
    return ("" if sure else "at most ") + _words(position, rotation)


def _out_of_reach(problem: Problem, search: Search, nearest: Descent, goal: Goal, gap: Gap) -> Diagnosis:
    """One goal that cannot be met even without limits."""
    alone = problem.only([goal])
    position, rotation = _apart(alone, search, nearest if len(problem.goals) == 1 else None)
    proved = gap != NO_GAP
    by = gap.by
    if not proved:
        form = closed_form(alone, search.start)
        outside = closed_form_outside(alone.without_limits(), form)
        proved, by = outside is not None and not len(outside), form.structure if form is not None else ""
    if not proved and subdivision(alone, search.start):
        proved, by = True, "subdivision of its joints' ranges"
    sure = search.agreed() >= 2 or proved
    reason = f"{goal.label} cannot be met; {_remaining(position, rotation, gap)} remain"
    if isinstance(goal, Pose) and position > 1e-9 and rotation > 1e-9 and not gap.position:
        reason = (
            f"{goal.label}: position and orientation are met only apart: at most {position:.6g} m remain "
            f"when turned right, {rotation:.6g} rad when placed right"
        )
    if proved:
        reason += f", by {by}"
    kind = "out of reach" if sure else "not found"
    verdict = Verdict(kind, proved, reason, position, rotation, gap.position, None, (goal.label,))  # type: ignore[arg-type]
    return _negative(problem, verdict)


def _after_all(end: Descent) -> Diagnosis:
    return Diagnosis(Verdict("solved", True, ""), None, end.q[:1])


def _negative(problem: Problem, verdict: Verdict, free: Array | None = None) -> Diagnosis:
    return Diagnosis(verdict, free, np.zeros((0, problem.space.nq)))


def _apart(problem: Problem, search: Search, nearest: Descent | None) -> tuple[float, float]:
    """How far position and rotation of one goal stay away (see `Verdict`)."""
    goal = problem.goals[0]
    end = nearest or _closest(problem, search)
    if not isinstance(goal, Pose):
        return _sizes(problem, end.r)
    t = goal.tolerances(problem.model)
    place = problem.only([Position(goal.at, goal.position, goal.relative_to, tolerance=tuple(t[:3]))])
    turn = problem.only([Orientation(goal.at, goal.quat, goal.relative_to, tolerance=tuple(t[3:]))])
    placed, turned = _closest(place, search), _closest(turn, search)
    if not placed.met[0] or not turned.met[0]:
        first = place if not placed.met[0] else turn
        here = placed if not placed.met[0] else turned
        position, rotation = _sizes(first, here.r)
        if not placed.met[0] and not turned.met[0]:
            rotation = _sizes(turn, turned.r)[1]
        return position, rotation
    position = _least(turn, place, search, end)
    rotation = _least(place, turn, search, end)
    return position, rotation


def _closest(problem: Problem, search: Search) -> Descent:
    """Nearest pose of a part of the question."""
    part = search.part(problem, 60, 2)
    found = part.solutions(search.best.q[:6])
    search.iterations += part.iterations
    if len(found):
        return descend(problem, found[:1])
    return brought(part)


def _least(held: Problem, wanted: Problem, search: Search, end: Descent) -> float:
    """Least residual of `wanted` while `held` is met, from several starts: a number in its own unit."""
    starts = np.concatenate([end.q, search.best.q[:6]])
    feasible = descend(held, starts)
    more = [feasible.q[feasible.met], search.part(held, 24, 3).more(24)]
    q = np.concatenate(more)
    if not len(q):
        return 0.0

    def wish(x: Array) -> Rows:
        return wanted.weighted(wanted.raw(x))

    value = np.sum(wish(q).r ** 2, axis=1)
    ends = [settle_least(held, q[i], wish) for i in np.argsort(value)[:3]]
    best = min(ends, key=lambda e: e.value)
    position, rotation = _sizes(wanted, wanted.raw(best.q[None]).r)
    return max(position, rotation)


def _conflict(
    problem: Problem, search: Search, nearest: Descent, goals: tuple[Goal, ...], gap: Gap
) -> Diagnosis:
    """Goals that can be met, if at all, only without each other."""
    proved = gap != NO_GAP
    position, rotation = _sizes(problem, nearest.r)
    names = tuple(g.label for g in goals)
    reason = (
        f"{' and '.join(names)} exclude each other; the best pose found leaves {_words(position, rotation)}"
    )
    if proved:
        reason += f", {_words(gap.position, gap.rotation)} in sum, proved by {gap.by}"
    else:
        part = problem.only(goals)
        proved = subdivision(part.without_limits(), search.start)
        reason += ", by subdivision of the joints' ranges" if proved else ""
    verdict = Verdict("conflict", proved, reason, position, rotation, gap.position, None, names)
    return _negative(problem, verdict)


def _together(problem: Problem, search: Search, nearest: Descent) -> Diagnosis:
    """Several goals, not met even without limits: one that fails alone, or a smallest set in conflict."""
    for goal in problem.goals:
        alone = problem.only([goal])
        if not _meets(alone, search):
            free = _without_limits(alone, search, nearest)
            part = search.part(alone, search.restarts, 4)
            found = part.solutions(search.best.q[:6])
            if len(found):
                continue
            end = brought(part)
            inner = (
                _out_of_reach(alone, part, end, goal, NO_GAP)
                if free is None
                else _held(alone, part, end, free)
            )
            search.iterations += part.iterations
            if not len(inner.found):
                return inner
    return _conflict(problem, search, nearest, _core(problem, search), NO_GAP)


def _core(problem: Problem, search: Search) -> tuple[Goal, ...]:
    """Deletion filter over goals that can be met alone: what is left cannot spare any goal."""
    core = list(problem.goals)
    for goal in problem.goals:
        rest = [g for g in core if g is not goal]
        if len(rest) > 1 and not _meets(problem.only(rest), search):
            core = rest
    return tuple(core)


def _meets(problem: Problem, search: Search) -> bool:
    if excluded(problem, search.start):
        return False
    part = search.part(problem, min(search.restarts, 100), 5)
    met = len(part.solutions(search.best.q[:6])) > 0
    search.iterations += part.iterations
    return met
