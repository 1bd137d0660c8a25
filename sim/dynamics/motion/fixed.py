"""Integration in steps of one length, compiled whole."""

from __future__ import annotations

import time
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...compile.program import address, in_parallel
from ...compile.rollout import fixed_steps
from ...errors import EngineError
from ...integrate.tableau import Tableau
from ..laws import CompiledLaw, is_law
from .loops import PARALLEL_OPERATIONS, Loop, compiled_loop, finish
from .path import Path
from .rows import (
    NOTHING,
    Controls,
    Prescribed,
    PythonLaw,
    Start,
    control_rows,
    parameter_rows,
    prescribed_rows,
)

if TYPE_CHECKING:
    from ..smooth import Smooth

Array = NDArray[np.float64]

_KINDS = "qqqqdPPqqPqPPqPqqPqP"  # of the arguments of `fixed_steps`


def fixed_loop(smooth: Smooth, lanes: int, law: CompiledLaw | None, method: Tableau) -> Loop:
    """The compiled integration in fixed steps."""
    return compiled_loop(smooth, "fixed", lanes, law, method, fixed_steps, _KINDS)


def fixed(
    smooth: Smooth,
    start: Start,
    *,
    method: Tableau,
    step: float,
    steps: int,
    controls: Controls,
    hold: int,
    every: int,
    w: Prescribed,
    p: ArrayLike | None,
    t0: float,
) -> Path:
    """See `Smooth.rollout`."""
    if callable(controls) and not is_law(controls):
        return _called_back(
            smooth, start, controls, method=method, step=step, steps=steps, hold=hold, every=every,
            w=w, p=p, t0=t0,
        )  # fmt: skip
    nx, nu, count = smooth.layout.nx, smooth.layout.nu, len(start.x)
    periods = steps // hold
    law, rows, gains = control_rows(smooth, controls, periods, count)
    table = prescribed_rows(smooth, w, lambda: stage_times(method, t0, step, steps), count)
    parameters = parameter_rows(smooth, p, count)
    lanes = 1 if count == 1 else smooth.lanes
    loop = fixed_loop(smooth, lanes, law, method)
    path = np.empty((count, steps // every + 1, nx))
    applied = np.empty((count, periods, nu)) if law is not None else NOTHING.array
    at_start, at_path, at_applied = address(start.x), address(path), address(applied)

    def call(first: int, size: int) -> None:
        loop.run(
            size, periods, hold, every, step, at_start + 8 * first * nx,
            rows.at(first), rows.per_state, rows.per_row, gains.at(first), gains.per_state,
            at_applied + 8 * first * periods * nu, 0, 0,
            table.at(first), table.per_state, table.per_row, parameters.at(first), parameters.per_state,
            at_path + 8 * first * path.shape[1] * nx,
        )  # fmt: skip

    evaluations = steps * loop.stages
    begin = time.perf_counter()
    if count == 1:
        call(0, 1)
    else:
        work = count * evaluations * loop.operations
        in_parallel(call, count, lanes, smooth.threads if work > PARALLEL_OPERATIONS else 1)
    seconds = time.perf_counter() - begin
    shown = applied if law is not None else rows.shown(count)
    t = _record_times(t0, step * every, path.shape[1])
    return finish(smooth, start, t, path, shown, np.array([evaluations]), seconds, steps=np.array([steps]))


def stage_times(method: Tableau, t0: float, step: float, steps: int) -> Array:
    """Times of all stages of all steps [s], shape (steps * stages,)."""
    return np.asarray(((t0 + step * np.arange(steps))[:, None] + step * method.c).ravel())


@lru_cache(maxsize=64)
def _record_times(t0: float, step: float, count: int) -> Array:
    t: Array = t0 + step * np.arange(count, dtype=float)
    t.flags.writeable = False
    return t


def _called_back(
    smooth: Smooth,
    start: Start,
    law: PythonLaw,
    *,
    steps: int,
    hold: int,
    every: int,
    step: float,
    t0: float,
    w: Prescribed,
    **rest: Any,
) -> Path:
    """With a Python function as the controller, called at the start of every period."""
    if hold % every:
        raise EngineError(
            f"with a Python controller the records ({every} steps) must fit its period ({hold} steps)"
        )
    lay, x = smooth.layout, start.x
    pieces, applied, seconds = [x[:, None]], [], 0.0
    for period in range(steps // hold):
        now = t0 + step * hold * period
        q, v = x[:, : lay.nq], x[:, lay.nq : lay.nq + lay.nv]
        u = np.asarray(law(now, q[0], v[0]) if start.single else law(now, q, v), dtype=float)
        u = np.broadcast_to(u, (len(x), lay.nu))
        part = fixed(
            smooth, Start(x, False), controls=u[:, None], steps=hold, hold=hold, every=every,
            step=step, t0=now, w=w, **rest,
        )  # fmt: skip
        pieces.append(part.x[:, 1:])
        applied.append(u)
        seconds += part.seconds
        x = np.ascontiguousarray(part.x[:, -1])
    path = np.concatenate(pieces, axis=1)
    stages = fixed_loop(smooth, 1 if len(x) == 1 else smooth.lanes, None, rest["method"]).stages
    t = _record_times(t0, step * every, path.shape[1])
    return finish(
        smooth, start, t, path, np.stack(applied, axis=1), np.array([steps * stages]), seconds,
        steps=np.array([steps]),
    )  # fmt: skip
