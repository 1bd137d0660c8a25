"""The smooth engine behind the common interface: compiled equations of motion, limits as located impacts."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from ..errors import EngineError
from .interface import Controls, Problem, Role, Segment
from .limits import in_words
from .stiffness import friction_width

NARROWED = 2e-5, 1e-3
"""Step [s] and least width [rad/s, m/s] by which friction is smoothed in runs to a tolerance: so small a step
is needed only where something sticks, and compiled code makes it in a microsecond or few."""


def methods() -> dict[str, int]:
    """Names of the methods, and their orders."""
    from ..integrate import TABLEAUS

    return {name: tableau.order for name, tableau in TABLEAUS.items()}


def adaptive_methods() -> tuple[str, ...]:
    """Names of the methods that can follow a tolerance."""
    from ..integrate import TABLEAUS

    return tuple(name for name, tableau in TABLEAUS.items() if tableau.adaptive)


def differences(problem: Problem) -> list[str]:
    """Physics that this engine models otherwise than MuJoCo, as sentences; no matter of step or order."""
    from ..dynamics.support import differences as of_model

    return of_model(
        problem.model,
        friction_width=width_of(problem),
        keyed=np.flatnonzero(problem.roles == Role.KEYED).tolist(),
        at_limits=in_words(problem.restitution),
    )


def width_of(problem: Problem) -> float | None:
    """The `friction_width` of a problem: what it was planned with, whatever its step is now."""
    if problem.friction_width is not None:
        return problem.friction_width
    step, least = (problem.step, 0.01) if problem.tolerance is None else NARROWED
    return friction_width(problem.model, problem.state0.q, ~problem.dofs(Role.KEYED), step, least)


class SmoothEngine:
    """Runge-Kutta integration of a scene's own machine code."""

    name = "smooth"

    def order(self, integrator: str) -> int:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        return methods()[integrator]

    def run(
        self,
        problem: Problem,
        t_span: tuple[float, float],
        controls: Controls | None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Segment:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        from ..dynamics.support import unlocated
        from ..integrate import TABLEAUS
        from .smooth_adaptive import AdaptiveRun
        from .smooth_fixed import FixedRun

        if problem.integrator not in TABLEAUS:
            listing = ", ".join(sorted(TABLEAUS))
            raise EngineError(
                f"the smooth engine has no integrator {problem.integrator!r}; it has: {listing}"
            )
        if limits := unlocated(problem.model, keyed=np.flatnonzero(problem.roles == Role.KEYED).tolist()):
            raise EngineError(
                f"the smooth engine cannot locate: {'; '.join(limits)}; use the contact engine, or leave "
                "limits out (mjDSBL_LIMIT in the model, physics.limits = false in a scene)"
            )
        if not 0.0 <= problem.restitution <= 1.0:
            raise EngineError(f"restitution must lie in [0, 1], not {problem.restitution:g}")
        kind = FixedRun if problem.tolerance is None else AdaptiveRun
        return kind(problem, t_span, controls, TABLEAUS[problem.integrator]).segment(progress)
