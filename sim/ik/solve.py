"""Inverse kinematics once: a configuration that meets goals, or a verdict why there is none."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import replace

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from .chains.closed_form import candidates
from .goals import Goal
from .numeric.descend import Descent, sharpen, tighten
from .numeric.search import Search
from .numeric.settle import Settled, Wish, settle, settle_near, worth
from .preferences import FAINT, Preference, preference, wishes
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
    prefer: Preference = "near",
    obstacles: Sequence[tuple[str, str]] = (),
    restarts: int = 200,
    seed: int = 0,
    all: bool = False,
) -> Solution:
    """Configuration of `model` that meets `goals`, always within joint limits, with a verdict.

    Questions that differ in targets, weights or limits alone share one piece of machine code, compiled
    when NumPy has taken as long as that would, and kept on disk; the answers are the same to rounding.

    Args:
        model: constant; its active connect, weld and joint equalities that the goals touch hold, too.
        goals: hard ones (no weight) are met exactly or judged; weighted ones as well as those allow. When all
            have weights they are judged together and the answer is their compromise.
        q0: where to start (nq,), and what "near" means; default the model's qpos0.
        joints: names of the joints that may move; default all that the goals depend on.
        prefer: what decides between answers: "near" q0, "middle" of the ranges, "manipulability", or "clear"
            of `obstacles`.
        obstacles: pairs of geoms for "clear".
        restarts: random starts before giving up; `seed` makes them repeatable.
        all: list distinct solutions.

    Raises ModelError for goals or names that do not fit the model.
    """
    begin = time.perf_counter()
    goals = (goals,) if isinstance(goals, Goal) else tuple(goals)
    judged, wished = asked(model, goals, joints)
    start = judged.space.check(model.qpos0 if q0 is None else q0)
    prefers = preference(prefer, judged, start, obstacles)
    wish: Wish = prefers if wished is None else wishes(wished, prefers)
    search = Search(judged, start, restarts=restarts, seed=seed, hopeless=lambda: excluded(judged, start))
    found = search.solutions(candidates(judged, start))
    if len(found) and (all or prefer != "near"):  # what is best may lie far from the start
        found = np.concatenate([found, search.more(restarts if all else min(restarts, 40))])
    if len(found):
        best = _settled(judged, found, wish, start, every=all, near=prefer == "near")
        verdict = Verdict("solved", True, _solved_words(judged, best), restarts=search.used)
        return _solution(judged, goals, best[0], verdict, best if all else best[:1], None, search, begin)
    nearest = _nearest(judged, search.best)
    if nearest.met[0]:  # a slow end, as at a singular boundary, got there after all
        verdict = Verdict("solved", True, _solved_words(judged, nearest.q), restarts=search.used)
        return _solution(judged, goals, nearest.q[0], verdict, nearest.q, None, search, begin)
    diagnosis = diagnose(judged, search, nearest)
    if diagnosis.found is not None:
        best = _settled(judged, diagnosis.found[None], wish, start, every=False, near=prefer == "near")
        verdict = Verdict("solved", True, _solved_words(judged, best), restarts=search.used)
        return _solution(judged, goals, best[0], verdict, best, None, search, begin)
    q = diagnosis.nearest
    if wished is not None:
        q = nearest.q[0] if q is None else q
    answer = unwound(judged, nearest.q if q is None else q[None], start)[0]
    none = answer[:0].reshape(0, 0)
    return _solution(judged, goals, answer, diagnosis.verdict, none, diagnosis.q_free, search, begin)


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


def _nearest(judged: Problem, best: Descent) -> Descent:
    """The best of the nearest poses found, sharpened."""
    ends = [sharpen(judged, q) for q in best.q[:3]]
    return min(ends, key=lambda end: float(end.cost[0]))


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
            position, rotation = group.goal.errors(part)
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
    judged: Problem,
    goals: Sequence[Goal],
    q: Array,
    verdict: Verdict,
    solutions: Array,
    free: Array | None,
    search: Search,
    begin: float,
) -> Solution:
    arrays = [np.array(q), np.array(solutions)] + ([] if free is None else [np.array(free)])
    for array in arrays:
        array.setflags(write=False)
    seconds = time.perf_counter() - begin
    verdict = replace(verdict, restarts=search.used)
    return Solution(
        arrays[0], _all_residuals(judged, goals, q), verdict, arrays[1], None if free is None else arrays[2],
        search.iterations, search.used, seconds,
    )  # fmt: skip
