"""Solvers that we did not write on whole scenes: keyed joints, servos, forces and sampled controllers.

SciPy's and torchdiffeq's solvers get the smooth engine's equations of motion and nothing else of it: between
two ticks of a controller, or two moments at which keys bend, they start anew.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from .compose import make_controls
from .engines.compiled import Compiled
from .engines.interface import Controls, Held, Problem
from .engines.limits import limits_of
from .engines.smooth import SmoothEngine, width_of
from .engines.timed import Timed
from .integrate import TABLEAUS, Solution, solve
from .plan import Plan
from .work_precision import TOLERANCES, Array, Case, Motion

CLOSE = 1e-9
"""Moments that lie nearer to each other than this part of the duration are one."""


def problem_at(plan: Plan, case: Case, step: float | None = None) -> Problem:
    """The scene's problem with frames at those of `case`, in steps of `step` [s]."""
    # what friction is smoothed over follows from the step, also where it is no step
    step = step or (plan.period or case.duration / case.frames) / 2**6
    every = round(case.duration / case.frames / step)
    return replace(plan.problem, step=step, sample_every=every, duration=case.duration)


def why_not_foreign(plan: Plan, case: Case) -> str:
    """Why no foreign solver can run a scene of the smooth engine; empty when they can."""
    problem = problem_at(plan, case)
    if Timed(problem).jumps(0.0, problem.duration, 1):
        return "keyed velocities jump, which pulls the other joints along at once"
    if limits_of(problem).each:
        controls = make_controls(plan.setup.scene, problem, plan.period)
        met = [
            e for e in SmoothEngine().run(problem, (0.0, case.duration), controls).events if e.kind == "limit"
        ]
        if met:
            return f"joint {met[0].what!r} meets its limit at {met[0].t:.3g} s, where they cannot stop it"
    return ""


@dataclass(frozen=True, eq=False)
class SceneForeign:
    """A foreign solver on a scene, by tolerance: `name` is "scipy:..." or "torch:..." (see `Runner`)."""

    plan: Plan
    case: Case
    name: str
    knob: str = "tolerance"
    order: int = 1

    @property
    def engine(self) -> str:
        """The solver's library."""
        return self.name.partition(":")[0]

    @property
    def method(self) -> str:
        """The solver's name there."""
        return self.name.partition(":")[2]

    def settings(self) -> Iterable[float]:
        """Tolerances that such solvers accept."""
        return TOLERANCES[:-2:2]

    @cached_property
    def _problem(self) -> Problem:
        return problem_at(self.plan, self.case)

    @cached_property
    def _compiled(self) -> Compiled:
        problem = self._problem
        width = width_of(problem)
        return Compiled(problem, Timed(problem), 0.0, TABLEAUS["rk4"], width=width, resting=())

    def run(self, setting: float) -> Motion:
        """The motion of the scene to that tolerance; NaN from where the solver gives up."""
        case, c, state = self.case, self._compiled, self._problem.state0
        controls = make_controls(self.plan.setup.scene, self._problem, self.plan.period)
        held = Held(np.zeros(case.model.nu), np.zeros(case.model.nv))
        x, evaluations = c.gather(*state), 0
        q, v = (np.full((len(case.times), width), np.nan) for width in (case.model.nq, case.model.nv))
        q[0], v[0] = state.q, state.v
        knots, ticks = self._knots(controls)
        for (a, b), tick in zip(pairwise(knots), ticks, strict=True):
            if controls is not None and tick >= 0:
                held = controls.sample(int(tick), a, *c.spread(x, self._motion(a, b, a)[0])[:2])
            frames = np.flatnonzero((case.times > a) & (case.times <= b))
            found = self._piece(setting, (a, b), x, held, np.unique([*case.times[frames], b]))
            evaluations += found.stats.evaluations
            for frame, row in zip(frames, found.y, strict=False):
                q[frame], v[frame], _ = c.spread(row, c.at(case.times[frame : frame + 1])[0])
            if found.t[-1:] != [b] or not np.isfinite(found.y).all():
                break
            x = found.y[-1]
        return Motion(q, v, evaluations)

    def _piece(self, setting: float, span: tuple[float, float], x: Array, held: Held, t: Array) -> Solution:
        """The compiled state at times `t` between two knots, under held inputs."""
        c = self._compiled
        problem = c.smooth.problem(c.held(held), w=(lambda t: self._motion(*span, t)) if c.nw else None)
        atol = setting * self.case.scale
        return solve(problem, span, x, method=self.name, rtol=setting, atol=atol, t_eval=t)

    def _knots(self, controls: Controls | None) -> tuple[Array, NDArray[np.intp]]:
        """Where solvers start anew, the ends included, and the controller's tick there (-1: none)."""
        end = self.case.duration
        period = controls.period if controls is not None else end
        count = round(end / period) if controls is not None else 0
        ticks = period * np.arange(count)
        others = np.concatenate([[0.0], self._compiled.timed.breaks(0.0, end), [end]])
        near = np.abs(others[:, None] - ticks[None]).min(axis=1, initial=np.inf) <= CLOSE * end
        knots = np.unique(np.concatenate([ticks, others[~near]]))
        place = {float(t): k for k, t in enumerate(ticks)}
        return knots, np.array([place.get(float(t), -1) for t in knots[:-1]], dtype=np.intp)

    def _motion(self, a: float, b: float, t: Array | float) -> Array:
        """Prescribed rows (n, nw) between two knots: at the second as just before it."""
        return self._compiled.at(np.clip(np.atleast_1d(t), a, np.nextafter(b, a)))
