"""How wrong is a run? Its own discretisation error, estimated from a second run at half the step."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np

from .engines.interface import Array, Controls, Engine, Problem, Segment
from .errors import EngineError
from .kinds import BALL, FREE, HINGE
from .recording import ErrorEstimate

_TIGHTEST = 1e-12  # tolerance that leaves room for a hundred times tighter run


def estimate_error(
    engine: Engine, problem: Problem, segment: Segment, controls: Controls | None
) -> ErrorEstimate:
    """Error of ``segment`` by extrapolation: |x_h - x_h/2| 2^p / (2^p - 1) (Hairer, Norsett, Wanner,
    Solving Ordinary Differential Equations I, II.4), p the order.

    ``controls`` are those of the run, unused: the run at half the step is controlled anew, at the same
    period. The run's own samples played back would tell nothing of what feedback makes of errors.
    Contacts and limits break the order p: from the first event of either run on, p = 1 is assumed, and
    ``trusted_until`` says when that begins. Infinite where the run at half the step has diverged.
    Raises KeyboardInterrupt when it was interrupted.
    """
    if problem.tolerance is not None:
        return _estimate_adaptive(engine, problem, segment, controls)
    half = dataclasses.replace(problem, step=problem.step / 2, sample_every=2 * problem.sample_every)
    span = (float(segment.t[0]), float(segment.t[-1]))
    finer = engine.run(half, span, controls)
    if finer.status == "interrupted":
        raise KeyboardInterrupt
    n = min(len(finer.t), len(segment.t))
    angle, length = np.full((2, len(segment.t)), np.inf)
    angle[:n], length[:n] = difference(problem.model, segment.q[:n], finer.q[:n])
    order = engine.order(problem.integrator)
    events = (*segment.events, *finer.events)
    first = min((e.t for e in events if e.kind in ("contact", "limit")), default=np.inf)
    p = np.where(segment.t < first, order, 1)
    factor = 2.0**p / (2.0**p - 1.0)
    return ErrorEstimate(
        angle=angle * factor,
        length=length * factor,
        order=order,
        trusted_until=float(first),
        wall_s=float(finer.stats["wall_s"]),
        evaluations=int(finer.stats["evaluations"]),
    )


def _estimate_adaptive(
    engine: Engine, problem: Problem, segment: Segment, controls: Controls | None
) -> ErrorEstimate:
    """Difference to a run at a hundredth of the tolerance, whose own error is small beside it.

    No order is assumed, and limits are located to rounding in both runs: it is trusted to the end
    (``trusted_until`` is infinite), also where the two meet other limits, which it shows as a large error.
    """
    assert problem.tolerance is not None
    if problem.tolerance < _TIGHTEST:
        raise EngineError(
            f"below a tolerance of {_TIGHTEST:g} rounding leaves nothing tighter to compare with"
        )
    tighter = dataclasses.replace(problem, tolerance=problem.tolerance / 100)
    finer = engine.run(tighter, (float(segment.t[0]), float(segment.t[-1])), controls)
    if finer.status == "interrupted":
        raise KeyboardInterrupt
    n = min(len(finer.t), len(segment.t))
    angle, length = np.full((2, len(segment.t)), np.inf)
    angle[:n], length[:n] = difference(problem.model, segment.q[:n], finer.q[:n])
    return ErrorEstimate(
        angle=angle,
        length=length,
        order=engine.order(problem.integrator),
        trusted_until=np.inf,
        wall_s=float(finer.stats["wall_s"]),
        evaluations=int(finer.stats["evaluations"]),
    )


def difference(model: mujoco.MjModel, q1: Array, q2: Array) -> tuple[Array, Array]:
    """Largest difference of rotations (n,) [rad] and of translations (n,) [m] between q1 and q2 (n, nq)."""
    n = len(q1)
    angle, length = np.zeros(n), np.zeros(n)
    dq = np.zeros((n, model.nv))
    for i in range(n):
        mujoco.mj_differentiatePos(model, dq[i], 1.0, q1[i], q2[i])
    for j in range(model.njnt):
        dof, kind = model.jnt_dofadr[j], model.jnt_type[j]
        if kind == FREE:
            length = np.maximum(length, np.linalg.norm(dq[:, dof : dof + 3], axis=1))
            angle = np.maximum(angle, np.linalg.norm(dq[:, dof + 3 : dof + 6], axis=1))
        elif kind == BALL:
            angle = np.maximum(angle, np.linalg.norm(dq[:, dof : dof + 3], axis=1))
        elif kind == HINGE:
            angle = np.maximum(angle, np.abs(dq[:, dof]))
        else:
            length = np.maximum(length, np.abs(dq[:, dof]))
    return angle, length
