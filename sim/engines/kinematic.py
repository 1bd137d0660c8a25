"""The kinematic engine: every joint is keyed, so poses follow from the keys and nothing is integrated."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from ..errors import EngineError
from .interface import Controls, Problem, Role, Segment


class KinematicEngine:
    """Evaluates keys at the sample times."""

    name = "kinematic"

    def order(self, integrator: str) -> int:
        """Nothing is integrated."""
        return 0

    def run(
        self,
        problem: Problem,
        t_span: tuple[float, float],
        controls: Controls | None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Segment:
        """See :class:`~pantograph.sim.engines.interface.Engine`."""
        started = time.perf_counter()
        m = problem.model
        if not problem.dofs(Role.KEYED).all():
            free = [m.joint(j).name for j in np.flatnonzero(problem.roles != Role.KEYED)]
            raise EngineError(
                f"the kinematic engine moves keyed joints only; not keyed: {', '.join(free)}. "
                "Give them keys, or use engine = 'auto'"
            )
        steps = round((t_span[1] - t_span[0]) / problem.step)
        at = np.unique(np.append(np.arange(0, steps, problem.sample_every), steps))
        t = t_span[0] + at * problem.step
        motion = problem.clip.evaluate(t)
        if progress:
            progress(t_span[1])
        return Segment(
            t=t,
            q=motion.q.copy(),
            v=motion.v.copy(),
            act=np.tile(problem.state0.act, (len(t), 1)),
            tick_t=np.zeros(0),
            tick_ctrl=np.zeros((0, m.nu)),
            tick_qfrc=np.zeros((0, m.nv)),
            status="done",
            message="",
            stats={
                "engine": "kinematic",
                "integrator": "none",
                "step": problem.step,
                "steps": 0,
                "evaluations": 0,
                "wall_s": time.perf_counter() - started,
            },
        )
