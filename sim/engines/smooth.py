"""The smooth engine behind the common interface: compiled equations of motion, limits as located impacts."""

from __future__ import annotations

from collections.abc import Callable

import mujoco
import numpy as np

from ..errors import EngineError
from .interface import Array, Controls, Problem, Segment
from .limits import limits_of

RESTITUTION = 0.0  # a joint that meets its limit stops there; servo arms do not bounce


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

    width = width_of(problem)
    found = [f"otherwise than MuJoCo: {line}" for line in of_model(problem.model, friction_width=width)]
    if limits_of(problem).each:
        found.append(f"a joint that meets its limit stops there (restitution {RESTITUTION:g})")
    return found


def width_of(problem: Problem) -> float | None:
    """The `friction_width` of a problem: what it was planned with, whatever its step is now."""
    if problem.friction_width is not None:
        return problem.friction_width
    return friction_width(problem.model, mobility(problem), problem.step)


def friction_width(model: mujoco.MjModel, mobility: Array, step: float) -> float | None:
    """Speed [rad/s, m/s] below which dry friction is smoothed; None without friction.

    At least 0.01, and wide enough that the smoothed force is not stiff for the step: the rate
    friction / (inertia width) stays below 1/step.
    """
    off = int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS) | int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    if model.opt.disableflags & off or not model.dof_frictionloss.any():
        return None
    return max(0.01, float(np.max(model.dof_frictionloss * mobility)) * step)


def mobility(problem: Problem) -> Array:
    """Diagonal (nv,) of the inverse inertia matrix at the initial state [1/kg, 1/(kg m^2)]."""
    m = problem.model
    data = mujoco.MjData(m)
    data.qpos[:] = problem.state0.q
    mujoco.mj_forward(m, data)
    inverse = np.eye(m.nv)
    mujoco.mj_solveM(m, data, inverse, np.eye(m.nv))
    return np.diag(inverse).copy()


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
        from ..integrate import TABLEAUS
        from .smooth_adaptive import AdaptiveRun
        from .smooth_fixed import FixedRun

        if problem.integrator not in TABLEAUS:
            listing = ", ".join(sorted(TABLEAUS))
            raise EngineError(
                f"the smooth engine has no integrator {problem.integrator!r}; it has: {listing}"
            )
        kind = FixedRun if problem.tolerance is None else AdaptiveRun
        return kind(problem, t_span, controls, TABLEAUS[problem.integrator]).segment(progress)
