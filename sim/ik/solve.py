"""Inverse kinematics once: a configuration that meets goals, or a verdict why there is none."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import ModelError
from .chains.closed_form import ClosedForm, closed_form
from .goals import Goal
from .numeric.descend import tighten
from .numeric.nearest import brought, settle_nearest
from .numeric.search import AT_LIMIT, Search
from .numeric.settle import Settled, Wish, settle, settle_near, worth
from .preferences import FAINT, Preference, chosen, closest, preference, wishes
from .problem import Problem, asked, unwound
from .proofs.diagnose import diagnose, excluded
from .space import Space
from .verdict import Residual, Solution, Verdict

Array = NDArray[np.float64]


def solve(
    model: mujoco.MjModel,
    goals: Goal | Sequence[Goal],
    *,
    q0: ArrayLike | None = None,
    joints: Sequence[str] | None = None,
    prefer: Preference | None = None,
    obstacles: Sequence[tuple[str, str]] = (),
    restarts: int = 200,
    seed: int = 0,
    all: bool = False,
    compiled: bool | None = None,
) -> Solution:
    """Configuration of `model` that meets `goals`, always within joint limits, with a verdict.

    Questions that differ in targets, weights or limits alone share one piece of machine code, compiled
    when NumPy has taken as long as that would, and kept on disk; the answers are the same to rounding
    (bit for bit with `compiled`).

    Args:
        model: constant; its active connect, weld and joint equalities that the goals touch hold, too.
        goals: hard ones (no weight) are met exactly or judged; weighted ones as well as those allow. When all
            have weights they are judged together and the answer is their compromise.
        q0: where to start (nq,), and what "near" means; default the model's qpos0.
        joints: names of the joints that may move; default all that the goals depend on.
        prefer: what decides between answers: "near" q0, "middle" of the ranges, "manipulability", or "clear"
            of `obstacles`; default near, or clear where there are obstacles.
        obstacles: pairs of geoms to keep apart as far as the goals allow.
        restarts: random starts at most, besides q0 and mid-range; 0 for none.
        seed: of the random starts, not negative.
        all: list distinct solutions, and whether these are all (`Solution.complete`).
        compiled: True for machine code from the first question on, False for NumPy alone: the same question
            then has the same answer bit for bit. Default: machine code when it pays.

    Raises ModelError for goals or names that do not fit the model.
    """
    begin = time.perf_counter()
    goals = (goals,) if isinstance(goals, Goal) else tuple(goals)
    _check(goals, restarts, seed)
    judged, wished = asked(model, goals, joints, compiled)
    start = judged.space.check(model.qpos0 if q0 is None else q0)
    kind = chosen(prefer, obstacles)
    prefers = preference(kind, judged, start, obstacles)
    wish: Wish = prefers if wished is None else wishes(wished, prefers)
    near = kind == "near"
    search = Search(judged, start, restarts=restarts, seed=(seed,), hopeless=lambda: excluded(judged, start))
    form = closed_form(judged, start)
    found = search.solutions(np.zeros((0, judged.space.nq)) if form is None else form.q)
    complete = all and len(found) > 0 and _listed(judged, form, found)
    if len(found) and not complete and (all or not near or not search.direct):  # the best may lie elsewhere
        found = np.concatenate([found, search.more(restarts if all else 40)])
    found = found if len(found) else search.spread()
    if not len(found):
        nearest = brought(search)
        reason = diagnose(judged, search, nearest)
        found = reason.found
    if len(found):
        best = _settled(judged, found, wish, start, every=all, near=near)
        words = _solved_words(judged, best) + (_listed_words(judged, best, complete) if all else "")
        verdict = Verdict("solved", True, words + closest(model, obstacles, best[0]))
        answer = _Answer(best[0], verdict, best if all else best[:1], complete)
    else:
        q = unwound(judged, settle_nearest(judged, nearest, wish)[None], start)[0]
        answer = _Answer(q, reason.verdict, found, all and reason.verdict.proved, reason.q_free)
    return _solution(judged, goals, answer, search, begin)


class _Answer(NamedTuple):
    """What goes into a `Solution`: see there."""

    q: Array
    verdict: Verdict
    solutions: Array
    complete: bool
    free: Array | None = None


def _check(goals: Sequence[Goal], restarts: int, seed: int) -> None:
    for goal in goals:
        if not isinstance(goal, Goal):
            raise ModelError(f"a goal is a Position, a Pose, ... of pantograph.sim.ik, not {goal!r:.100}")
    for name, number in (("restarts", restarts), ("seed", seed)):
        if not isinstance(number, (int, np.integer)) or number < 0:
            raise ModelError(f"{name} must be a whole number, not negative, not {number!r}")


def _listed(problem: Problem, form: ClosedForm | None, found: Array) -> bool:
    """Whether solutions `found` (k, nq) are all: a complete closed form has no other inside limits."""
    if form is None or not form.complete or (problem.band > 0).any():
        return False
    q = problem.space.clip(form.q[problem.space.excess(form.q).max(axis=1, initial=0.0) <= AT_LIMIT])
    here = len(distinct(problem.space, q[problem.met(problem.raw(q).r)]))
    return here == len(distinct(problem.space, found))


def _listed_words(problem: Problem, found: Array, complete: bool) -> str:
    """How many solutions there are."""
    count = f"{len(found)} solution{'s' * (len(found) > 1)}"
    if complete:
        return f"; {count}, all there are but for whole turns, by a closed form"
    free = int(problem.moved.sum()) - problem.rank(found[0])
    if free > 0:
        left = "1 freedom is" if free == 1 else f"{free} freedoms are"
        return f"; {left} left, {count} of a continuum where restarts ended"
    return f"; {count} found, not proved to be all"


def _settled(judged: Problem, found: Array, wish: Wish, start: Array, *, every: bool, near: bool) -> Array:
    """Distinct solutions (k, nq) that serve the wish best, best first."""
    found, faint = unwound(judged, found, start), 1.0 if judged.wished is None else FAINT
    picked = found
    if len(found) > (1 if every else 5):
        value = worth(judged, found, start, faint) if near else np.sum(wish(found).r ** 2, axis=1)
        picked = found[np.argsort(value, kind="stable")[: None if every else 5]]
    ends: list[Settled]
    if near:
        ends = settle_near(judged, picked, start, wish, faint=faint)
    else:
        ends = [settle(judged, q, wish) for q in picked]
    ends.sort(key=lambda end: end.value)
    q = np.array([tighten(judged, end.q) for end in (ends if every else ends[:1])])
    return distinct(judged.space, unwound(judged, q, start))


def distinct(space: Space, q: Array, *, apart: float = 1e-3) -> Array:
    """Rows of q (n, nq) that differ by more than `apart` in some freedom, whole turns not counted."""
    kept: list[Array] = []
    for x in q:
        if kept:
            d = space.difference(np.tile(x, (len(kept), 1)), np.array(kept))
            d[:, space.hinges] -= 2 * np.pi * np.round(d[:, space.hinges] / (2 * np.pi))
            if np.abs(d).max(axis=1, initial=0.0).min() <= apart:
                continue
        kept.append(x)
    return np.array(kept)


def _solved_words(problem: Problem, q: Array) -> str:
    r = problem.raw(q[:1]).r[0]
    metres = problem.metres
    parts = []
    if (metres & problem.judged).any():
        parts.append(f"{np.abs(r[metres & problem.judged]).max():.1e} m")
    if (~metres & problem.judged).any():
        parts.append(f"{np.abs(r[~metres & problem.judged]).max():.1e} rad")
    return "largest residual " + ", ".join(parts) if parts else "nothing to meet"


def residuals(problem: Problem, q: Array) -> tuple[Residual, ...]:
    """Residuals of every goal and loop at q (nq,)."""
    return _residuals(problem, problem.raw(q[None]).r)


def _residuals(problem: Problem, r: Array) -> tuple[Residual, ...]:
    out = []
    for group in problem.groups:
        part, tolerance = r[:, group.rows], problem.tolerance[group.rows]
        if group.goal is not None:
            position, rotation = group.goal.errors(part, problem.model)
        else:
            metres = problem.metres[group.rows]
            position, rotation = (np.linalg.norm(part[:, m], axis=1) for m in (metres, ~metres))
        met = bool((np.abs(part[0]) <= tolerance).all())
        out.append(Residual(group.label, float(position[0]), float(rotation[0]), met))
    return tuple(out)


def _all_residuals(judged: Problem, goals: Sequence[Goal], q: Array) -> tuple[Residual, ...]:
    """Residuals in the order of the goals, then of loops."""
    hard = residuals(judged, q)
    if judged.wished is None:
        return hard
    first, soft = iter(hard), iter(_residuals(judged.wished, judged.beside(q[None]).r))
    return (*(next(first if g.weight is None else soft) for g in goals), *first)


def _solution(
    judged: Problem, goals: Sequence[Goal], answer: _Answer, search: Search, begin: float
) -> Solution:
    q, solutions = np.array(answer.q), np.array(answer.solutions)
    free = None if answer.free is None else np.array(answer.free)
    for array in (q, solutions, *(() if free is None else (free,))):
        array.setflags(write=False)
    verdict = replace(answer.verdict, restarts=search.used)
    return Solution(
        q, _all_residuals(judged, goals, q), verdict, solutions, answer.complete, free,
        search.iterations, search.used, time.perf_counter() - begin,
    )  # fmt: skip
