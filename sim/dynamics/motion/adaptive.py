"""Integration in steps that follow a tolerance, compiled whole."""

from __future__ import annotations

import itertools
import math
import time
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...compile.adaptive import adaptive_steps
from ...compile.program import address, in_parallel
from ...compile.step_control import STATISTICS
from ...errors import EngineError
from ...integrate.tableau import Tableau
from ..laws import CompiledLaw, is_law
from ..layout import Layout
from .guards import Guards
from .loops import Loop, compiled_loop, finish
from .path import Path
from .prescribed import Pieces, constant, ends, pieces_of, scale_of_motion
from .rows import NO_MOTION, NOTHING, Controls, Prescribed, PythonLaw, Start, control_rows, parameter_rows

if TYPE_CHECKING:
    from ..smooth import Smooth

Array = NDArray[np.float64]

_KINDS = "qqqPPddPdPPPqqPqPPqPqPPqPPPqqPPP"  # of the arguments of `adaptive_steps`
_NEXT, _TIME = STATISTICS.index("next_step"), STATISTICS.index("time")
_ONE_SPAN = np.array([[0, 0, 0, -1]])
JUMP = 1e-9
"""A prescribed velocity that changes by less than this part of itself does not jump."""


def adaptive_loop(
    smooth: Smooth, lanes: int, law: CompiledLaw | None, method: Tableau, guards: Guards | None = None
) -> Loop:
    """The compiled integration to a tolerance."""
    if not method.adaptive:
        raise EngineError(f"{method.name} does not estimate its error: use rollout with a fixed step")
    lay = smooth.layout
    first = len(lay.q_keyed) + len(lay.v_keyed)
    return compiled_loop(
        smooth, "adaptive", lanes, law, method, adaptive_steps, _KINDS, guards=guards,
        pulling=range(first, first + len(lay.v_keyed)),
    )  # fmt: skip


def motion_of(
    smooth: Smooth, w: Prescribed, t0: float, t1: float, breaks: ArrayLike = (), knots: ArrayLike = ()
) -> Pieces:
    """The prescribed motion `w`, a row or a function of time, from t0 to t1; see `pieces_of`."""
    size = smooth.layout.nw
    if w is None:
        if size:
            raise EngineError(NO_MOTION)
        return constant(np.zeros(0), t0, t1)
    if callable(w):
        lay = smooth.layout
        scale = scale_of_motion(len(lay.q_keyed), len(lay.v_keyed))
        return pieces_of(w, size, t0, t1, breaks, knots, scale)
    value = np.asarray(w, dtype=float)
    if value.shape != (size,):
        raise EngineError(
            f"w has shape {value.shape}; steps that follow a tolerance take a row ({size},) or a function"
        )
    return constant(value, t0, t1)


class Spans:
    """Time between the moments that no step may cross: samples of the controller, breaks of the motion."""

    def __init__(self, lay: Layout, motion: Pieces):
        self.motion = motion
        self.breaks = self.times_of_jumps = motion.knots[:0]
        self.jumps = NOTHING.array
        if len(motion.knots) > 2:
            self._find(lay, motion)

    def _find(self, lay: Layout, motion: Pieces) -> None:
        """Breaks of the motion, and jumps of its velocities."""
        velocities = slice(len(lay.q_keyed), len(lay.q_keyed) + len(lay.v_keyed))
        after, before = (side[:, velocities] for side in ends(motion.coefficients))
        after, before = after[1:], before[:-1]
        change = after - before
        sudden = (np.abs(change) > JUMP * (1.0 + np.abs(before))).any(axis=1)
        self.jumps = np.ascontiguousarray(change[sudden])
        self.times_of_jumps = motion.knots[1:-1][sudden]
        breaks = np.union1d(motion.breaks, np.flatnonzero(sudden) + 1).astype(int)
        self.breaks = motion.knots[breaks]

    def between(
        self, t0: float, t1: float, hold: float | None = None, periods: int = 1, *, jump: bool = True
    ) -> tuple[Array, NDArray[np.int64]]:
        """Ends of the spans from t0 to t1, and of each its period, pieces and jump (see `adaptive_steps`).

        `jump` tells whether one at t0 is still to come.
        """
        if len(self.motion.knots) == 2:
            if hold is None:
                return np.array([t1]), _ONE_SPAN
            edges: Array = t0 + hold * np.arange(1.0, periods + 1)
            edges[-1] = t1
            known = np.zeros((periods, 4), np.int64)
            known[:, 0], known[:, 3] = np.arange(periods), -1
            return edges, known
        inner = self.breaks[(self.breaks > t0) & (self.breaks < t1)]
        fixed = np.append(inner, t1)
        if hold is not None:
            ticks = t0 + hold * np.arange(1, periods)
            near = np.abs(ticks[:, None] - fixed).min(axis=1) < 1e-12 * max(abs(t0), abs(t1))
            fixed = np.sort(np.concatenate([fixed, ticks[~near & (ticks < t1)]]))
        begin = np.append(t0, fixed[:-1])
        table = np.zeros((len(fixed), 4), np.int64)
        if hold is not None:
            table[:, 0] = np.clip((0.5 * (begin + fixed) - t0) // hold, 0, periods - 1)
        knots, last = self.motion.knots, len(self.motion.knots) - 2
        table[:, 1] = np.clip(np.searchsorted(knots, begin, "right") - 1, 0, last)
        table[:, 2] = np.clip(np.searchsorted(knots, fixed, "left") - 1, 0, last)
        table[:, 3] = self._jump_at(begin)
        if not jump:
            table[0, 3] = -1
        return np.ascontiguousarray(fixed), table

    def _jump_at(self, t: Array) -> NDArray[np.int64]:
        at = np.searchsorted(self.times_of_jumps, t)
        found = np.isin(t, self.times_of_jumps)
        return np.where(found, at, -1)


def adaptive(
    smooth: Smooth,
    start: Start,
    t_eval: Array,
    *,
    method: Tableau,
    rtol: float,
    atol: float | Array,
    controls: Controls,
    hold: float | None,
    w: Prescribed,
    breaks: ArrayLike,
    p: ArrayLike | None,
    first_step: float | None,
    max_steps: int,
) -> Path:
    """See `Smooth.integrate`."""
    t0, t1 = float(t_eval[0]), float(t_eval[-1])
    still = w is None and not smooth.layout.nw
    spans = smooth.no_motion if still else Spans(smooth.layout, motion_of(smooth, w, t0, t1, breaks))
    periods = 1 if hold is None else max(1, math.ceil((t1 - t0) / hold - 1e-9))
    h = np.full(len(start.x), first_step or min(t1 - t0, hold or math.inf) * 1e-3)
    if callable(controls) and not is_law(controls):
        return _called_back(
            smooth, start, t_eval, spans, h, controls, hold, periods,
            method=method, rtol=rtol, atol=atol, p=p, max_steps=max_steps,
        )  # fmt: skip
    return _compiled(
        smooth, start, t_eval, spans, h, controls, hold, periods, method, rtol, atol, p, max_steps
    )


def _compiled(
    smooth: Smooth,
    start: Start,
    t_eval: Array,
    spans: Spans,
    h: Array,
    controls: Controls,
    hold: float | None,
    periods: int,
    method: Tableau,
    rtol: float,
    atol: float | Array,
    p: ArrayLike | None,
    max_steps: int,
    *,
    goes_on: bool = False,
) -> Path:
    """All periods in one call; steps begin with `h` (count,), where one that `goes_on` finds the next."""
    nx, nu, count = smooth.layout.nx, smooth.layout.nu, len(start.x)
    t0, t1 = float(t_eval[0]), float(t_eval[-1])
    law, rows, gains = control_rows(smooth, controls, periods, count)
    parameters = parameter_rows(smooth, p, count)
    lanes = 1 if count == 1 else smooth.lanes
    loop = adaptive_loop(smooth, lanes, law, method)
    edges, of_span = spans.between(t0, t1, hold, periods)
    motion, tolerance = spans.motion, np.full(nx, atol, dtype=float)
    path = np.full((count, len(t_eval), nx), np.nan)
    last, stats = np.empty_like(start.x), np.zeros((count, len(STATISTICS)))
    applied = np.empty((count, periods, nu)) if law is not None else NOTHING.array
    shared = [
        address(a)
        for a in (edges, of_span, tolerance, motion.knots, motion.coefficients, spans.jumps, t_eval)
    ]
    own = [address(a) for a in (start.x, h, path, last, stats, applied)]

    def call(first: int, size: int) -> None:
        at_edges, at_spans, at_tolerance, at_knots, at_coefficients, at_jumps, at_times = shared
        strides = (nx, 1, len(t_eval) * nx, nx, len(STATISTICS), periods * nu)
        x0, h0, out, x1, facts, u = (at + 8 * first * stride for at, stride in zip(own, strides, strict=True))
        loop.run(
            size, periods, len(edges), at_edges, at_spans, t0, rtol, at_tolerance, float(max_steps), x0, h0,
            rows.at(first), rows.per_state, rows.per_row, gains.at(first), gains.per_state, u, 0, 0,
            parameters.at(first), parameters.per_state, at_knots, at_coefficients, motion.terms, at_jumps, 0,
            at_times, len(t_eval), 0, out, x1, facts,
        )  # fmt: skip

    begin = time.perf_counter()
    in_parallel(call, count, lanes, smooth.threads if count > lanes else 1)
    seconds = time.perf_counter() - begin
    shown = applied if law is not None else rows.shown(count)
    taken, rejected, evaluations, status = stats.astype(np.int64).T[:4]
    if goes_on:
        h[:] = stats[:, _NEXT]
    times = t_eval.view()
    times.flags.writeable = False
    return finish(
        smooth, start, times, path, shown, evaluations, seconds,
        steps=taken, reached=stats[:, _TIME], rejected=rejected, status=status,
    )  # fmt: skip


def _called_back(
    smooth: Smooth,
    start: Start,
    t_eval: Array,
    spans: Spans,
    h: Array,
    controls: PythonLaw,
    hold: float | None,
    periods: int,
    **rest: Any,
) -> Path:
    """With a Python function as the controller, called at the start of every period."""
    if hold is None:
        raise EngineError("how often is the function that controls called? Give its period, hold [s]")
    lay, x, count = smooth.layout, start.x, len(start.x)
    ends = np.append(t_eval[0] + hold * np.arange(periods), t_eval[-1])
    path, applied = np.full((count, len(t_eval), lay.nx), np.nan), np.full((count, periods, lay.nu), np.nan)
    status, evaluations, rejected, taken = np.zeros((4, count), np.int64)
    seconds, reached = 0.0, np.full(count, t_eval[0])
    for k, (begin, end) in enumerate(itertools.pairwise(ends.tolist())):
        q, v = x[:, : lay.nq], x[:, lay.nq : lay.nq + lay.nv]
        applied[:, k] = controls(begin, q[0], v[0]) if start.single else controls(begin, q, v)
        inside = (t_eval >= begin) & ((t_eval < end) | (k == periods - 1))
        times = np.unique(np.concatenate([[begin], t_eval[inside], [end]]))
        part = _compiled(
            smooth, Start(x, False), times, spans, h, applied[:, k : k + 1], None, 1, goes_on=True, **rest
        )
        path[:, inside] = part.x[:, np.isin(times, t_eval[inside])]
        evaluations, rejected = evaluations + part.evaluations, rejected + part.rejected
        taken, reached = taken + part.steps, np.where(status == 0, part.reached, reached)
        status = np.where(status == 0, part.status, status)
        seconds += part.seconds
        x = np.ascontiguousarray(part.x[:, -1])
        if status.all():
            break
    shown = t_eval.view()
    shown.flags.writeable = False
    return finish(
        smooth, start, shown, path, applied, evaluations, seconds,
        steps=taken, reached=reached, rejected=rejected, status=status,
    )  # fmt: skip
