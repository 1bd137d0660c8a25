"""The linear loop that a law of a scene makes about its keys: the mechanism, and the gains of the law."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim.compose import make_law
from ...sim.control import Target
from ...sim.engines.interface import Role
from ...sim.errors import PantographError
from ...sim.plan import Plan
from ..nominal import Nominal, moved
from ..preview import aimed
from ..reality import LOOP_WORDS
from .linear import LinearSystem, held, linearise

Array = NDArray[np.float64]


def loop_of(
    plan: Plan, law: str, words: Mapping[str, Any], *, t: float = 0.0, step: float = 1e-6
) -> tuple[LinearSystem, Array]:
    """The sampled mechanism of a plan about its keys at time ``t`` [s], and the gains K (m, n) of ``law``.

    K is minus the derivative of the law's first forces by the state, by centred differences of ``step``
    [rad, m, and per second]; memory (integrals, plans) is as at the start, and what sensors and drives do is
    left out. Joints without keys are at the law's ``goal`` or where they start. Raises PantographError when
    the scene has nothing to control.
    """
    problem, period = plan.problem, plan.period
    if period is None:
        raise PantographError("this scene has nothing to control: give joints the role 'tracked'")
    m, own = problem.model, {word: value for word, value in words.items() if word not in LOOP_WORDS}
    tracked, keyed = problem.dofs(Role.TRACKED), problem.dofs(Role.KEYED)
    clip, _ = aimed(problem.clip, own.get("goal") or {}, "goal")
    target = Target(*clip.evaluate(t))
    made = make_law(law, problem, own, period)
    need = Nominal(m).inverse(*target)
    chosen = (target.q, target.v, need)
    mechanism = linearise(m, *chosen, inputs=tracked, keyed=keyed, a_keyed=target.a)

    def forces(dq: Array, dv: Array) -> Array:
        tau, _ = made(t, moved(m, target.q, dq), target.v + dv, target, made.start())
        return tau[tracked]

    none, columns = np.zeros(m.nv), []
    for of_speed in (False, True):
        for unit in step * np.eye(m.nv)[~keyed]:
            plus, minus = ((none, s * unit) if of_speed else (s * unit, none) for s in (1.0, -1.0))
            columns.append((forces(*minus) - forces(*plus)) / (2.0 * step))
    return held(mechanism, period), np.column_stack(columns)
