"""Whole integrations of a smooth model: compiled loops, their arguments and their results."""

from __future__ import annotations

import ctypes
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compile.adaptive import STATISTICS, adaptive_steps
from ..compile.cache import key_of
from ..compile.llvm import declarations, kernel
from ..compile.loops import declare
from ..compile.program import Code, address, facts_of, in_parallel, obtain
from ..compile.rollout import Shape, fixed_steps, live_stages
from ..errors import EngineError
from ..integrate.tableau import Tableau
from .laws import LinearFeedback

if TYPE_CHECKING:
    from .smooth import Smooth

Array = NDArray[np.float64]
PythonLaw: TypeAlias = Callable[[float, Array, Array], ArrayLike]
Controls: TypeAlias = "ArrayLike | LinearFeedback | PythonLaw | None"
Prescribed: TypeAlias = "ArrayLike | Callable[[Array], ArrayLike] | None"

_POINTER, _COUNT = ctypes.c_void_p, ctypes.c_int64
_FIXED = [_COUNT] * 4 + [ctypes.c_double, _POINTER]
_FIXED += [_POINTER, _COUNT, _COUNT, _POINTER, _COUNT, _POINTER]
_FIXED += [_POINTER, _COUNT, _COUNT, _POINTER, _COUNT, _POINTER]
_ADAPTIVE = [_COUNT] * 2 + [ctypes.c_double] * 4 + [_POINTER, ctypes.c_double, _POINTER, _POINTER]
_ADAPTIVE += [_POINTER, _COUNT, _COUNT, _POINTER, _COUNT, _POINTER]
_ADAPTIVE += [_POINTER, _COUNT, _POINTER, _COUNT, _COUNT, _POINTER, _POINTER, _POINTER]
_PARALLEL_OPERATIONS = 400_000
STATUS = ("success", "too many steps", "step too small", "not finite")


@dataclass(frozen=True, eq=False)
class Path:
    """Motion of one state or a batch.

    Attributes:
        t: times of the records [s], shape (records,).
        x: states (q, v, act), shape (records, nx), or (batch, records, nx).
        u: controls applied, shape ([batch,] periods, nu); one row if they did not change.
        status: how each motion ended, an index of STATUS; 0 is success. After a failure records are NaN.
        evaluations: of dx/dt, for each state.
        rejected: steps done again, for each state (fixed steps: none).
        seconds: wall time of the integration itself.
    """

    t: Array
    x: Array
    u: Array
    status: NDArray[np.int64]
    evaluations: NDArray[np.int64]
    rejected: NDArray[np.int64]
    seconds: float
    nq: int
    nv: int

    @property
    def success(self) -> bool:
        """Whether every motion reached its end."""
        return not np.any(self.status)

    @property
    def q(self) -> Array:
        """Coordinates, shape (..., records, nq)."""
        return self.x[..., : self.nq]

    @property
    def v(self) -> Array:
        """Velocities, shape (..., records, nv)."""
        return self.x[..., self.nq : self.nq + self.nv]

    @property
    def act(self) -> Array:
        """Activations, shape (..., records, na)."""
        return self.x[..., self.nq + self.nv :]


def _method_key(method: Tableau) -> str:
    dense = method.dense
    arrays = [method.A, method.b, method.b_error, method.b_error_low, dense.A, dense.P]
    return key_of(
        *(b"" if x is None else x.tobytes() for x in arrays), repr((method.error_exponent, method.fsal))
    )


def shape_of(smooth: Smooth, law: LinearFeedback | None) -> Shape:
    """Sizes of a model's integrations."""
    lay = smooth.layout
    nr, ng = (None, 0) if law is None else (lay.nq + lay.nv + lay.nu, int(law.pattern().sum()))
    size = len(smooth.parameters)
    return Shape(lay.nq, lay.nv, lay.na, lay.nu, lay.nw, size, tuple(lay.quaternions), nr, ng)


@dataclass(frozen=True)
class Loop:
    """A compiled integration: its code and the function to call."""

    code: Code
    run: Any


def compiled_loop(
    smooth: Smooth,
    name: str,
    lanes: int,
    law: LinearFeedback | None,
    method: Tableau,
    emit: Callable[..., str],
    kinds: list[Any],
) -> Loop:
    """The integration that `emit` writes, around the model's rate and a law."""
    pattern = b"" if law is None else law.pattern().tobytes()
    known = (name, lanes, method, pattern)
    found: Loop | None = smooth.loops.get(known)
    if found is not None:
        return found

    def make() -> tuple[str, str, dict[str, Any]]:
        rate = smooth.tape("rate")
        head = declarations(lanes) + "\n"
        kernels, loops = head + kernel("rate", rate, lanes), head + declare("rate", rate)
        if law is not None:
            tape = law.tape(smooth.layout)
            kernels += kernel("law", tape, lanes)
            loops += declare("law", tape)
        loops += emit(name, method, shape_of(smooth, law), lanes)
        return kernels, loops, facts_of(rate) | {"formulation": smooth.formulation}

    key = key_of(smooth.key, name, str(lanes), _method_key(method), pattern)
    code = obtain(f"{name}:{method.name}", lanes, smooth.cache, key, make)
    loop = smooth.loops[known] = Loop(code, code.loaded.function(name, *kinds))
    return loop


@dataclass(frozen=True)
class Start:
    """A batch of initial states as rows, and whether it was asked for as one state."""

    x: Array
    single: bool


def initial_states(smooth: Smooth, q0: ArrayLike, v0: ArrayLike, act0: ArrayLike | None) -> Start:
    """Rows (q, v, act); what is given once serves the whole batch."""
    lay = smooth.layout
    parts = []
    for name, value, size in (("q0", q0, lay.nq), ("v0", v0, lay.nv), ("act0", act0, lay.na)):
        array = np.zeros(size) if value is None else np.asarray(value, dtype=float)
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise EngineError(f"{name} has shape {array.shape}; expected ({size},) or (batch, {size})")
        parts.append(array)
    if all(p.ndim == 1 for p in parts):
        return Start(np.concatenate(parts)[None], True)
    counts = {len(p) for p in parts if p.ndim == 2}
    if len(counts) > 1:
        raise EngineError(f"q0, v0, act0 are batches of different lengths: {sorted(counts)}")
    count = counts.pop()
    rows = [np.broadcast_to(p, (count, p.shape[-1])) for p in parts]
    return Start(np.ascontiguousarray(np.concatenate(rows, axis=1)), False)


@dataclass(frozen=True)
class Rows:
    """Rows of an array for a compiled loop: strides in doubles from state to state and from row to row."""

    array: Array
    per_state: int
    per_row: int


def rows_of(name: str, value: ArrayLike, width: int, rows: int, count: int) -> Rows:
    """`value` of shape (width,), (rows, width) or (count, rows, width) as strided rows."""
    array = np.ascontiguousarray(value, dtype=float)
    shapes = ((width,), (rows, width), (count, rows, width))
    if array.shape not in shapes:
        listing = ", ".join(map(str, shapes))
        raise EngineError(f"{name} has shape {array.shape}; expected one of {listing}")
    return Rows(array, rows * width if array.ndim == 3 else 0, 0 if array.ndim == 1 else width)


def per_state(name: str, value: ArrayLike, width: int, count: int) -> Rows:
    """`value` of shape (width,) or (count, width)."""
    array = np.ascontiguousarray(value, dtype=float)
    if array.shape not in ((width,), (count, width)):
        raise EngineError(f"{name} has shape {array.shape}; expected ({width},) or ({count}, {width})")
    return Rows(array, width if array.ndim == 2 else 0, 0)


def control_rows(
    smooth: Smooth, controls: Controls, periods: int, count: int
) -> tuple[LinearFeedback | None, Rows, Rows]:
    """The compiled law if there is one, its rows (or the controls themselves), and its gains."""
    lay = smooth.layout
    if isinstance(controls, LinearFeedback):
        home = smooth.model.qpos0[lay.q_free]
        references = controls.references(lay, home, periods)
        gains = controls.gains()
        rows = rows_of("references", references, references.shape[-1], periods, count)
        return controls, rows, per_state("K", gains, gains.shape[-1], count)
    if callable(controls):
        raise EngineError("a Python function as the controller works with rollout only")
    value = np.zeros(lay.nu) if controls is None else controls
    return None, rows_of("controls", value, lay.nu, periods, count), Rows(np.zeros(0), 0, 0)


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
    """Integration in fixed steps; see `Smooth.rollout`."""
    if callable(controls) and not isinstance(controls, LinearFeedback):
        return _called_back(
            smooth,
            start,
            controls,
            method=method,
            step=step,
            steps=steps,
            hold=hold,
            every=every,
            w=w,
            p=p,
            t0=t0,
        )
    lay, count = smooth.layout, len(start.x)
    periods = steps // hold
    law, rows, gains = control_rows(smooth, controls, periods, count)
    times = t0 + step * np.arange(steps)
    table = _prescribed_rows(smooth, w, (times[:, None] + step * method.c).ravel(), count)
    parameters = per_state("p", smooth.parameter_values if p is None else p, len(smooth.parameters), count)
    lanes = 1 if count == 1 else smooth.lanes
    loop = compiled_loop(smooth, "fixed", lanes, law, method, fixed_steps, _FIXED)
    path = np.empty((count, steps // every + 1, lay.nx))
    applied = np.empty((count, periods if law is not None else 0, lay.nu))

    def call(first: int, size: int) -> None:
        def at(rows: Rows) -> int:
            return address(rows.array) + 8 * first * rows.per_state

        loop.run(
            size, periods, hold, every, step, address(start.x) + 8 * first * lay.nx,
            at(rows), rows.per_state, rows.per_row, at(gains), gains.per_state,
            address(applied) + 8 * first * periods * lay.nu,
            at(table), table.per_state, table.per_row, at(parameters), parameters.per_state,
            address(path) + 8 * first * path[0].size,
        )  # fmt: skip

    evaluations = steps * len(live_stages(method.A, method.b))
    work = count * evaluations * loop.code.facts["operations"]
    begin = time.perf_counter()
    in_parallel(call, count, lanes, smooth.threads if work > _PARALLEL_OPERATIONS else 1)
    seconds = time.perf_counter() - begin
    shown = applied if law is not None else _shown(rows, count)
    t = np.asarray(t0 + step * every * np.arange(path.shape[1]), dtype=np.float64)
    return finish(smooth, start, t, path, shown, np.full(count, evaluations), seconds)


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
    p: ArrayLike | None,
    first_step: float | None,
    max_steps: int,
) -> Path:
    """Integration to a tolerance; see `Smooth.integrate`."""
    lay, count = smooth.layout, len(start.x)
    t0, t1 = float(t_eval[0]), float(t_eval[-1])
    periods = 1 if hold is None else max(1, math.ceil((t1 - t0) / hold - 1e-9))
    law, rows, gains = control_rows(smooth, controls, periods, count)
    parameters = per_state("p", smooth.parameter_values if p is None else p, len(smooth.parameters), count)
    tolerance = np.full(lay.nx, atol, dtype=float)
    lanes = 1 if count == 1 else smooth.lanes
    loop = compiled_loop(smooth, "adaptive", lanes, law, method, adaptive_steps, _ADAPTIVE)
    path = np.full((count, len(t_eval), lay.nx), np.nan)
    path[:, 0] = start.x
    last, stats = np.empty_like(start.x), np.zeros((count, len(STATISTICS)))
    h0 = np.full(count, first_step or min(t1 - t0, hold or np.inf) * 1e-3)
    applied = np.empty((count, periods if law is not None else 0, lay.nu))

    def call(first: int, size: int) -> None:
        def at(rows: Rows) -> int:
            return address(rows.array) + 8 * first * rows.per_state

        loop.run(
            size, periods, t0, t1, hold or t1 - t0, rtol, address(tolerance), float(max_steps),
            address(start.x) + 8 * first * lay.nx, address(h0) + 8 * first,
            at(rows), rows.per_state, rows.per_row, at(gains), gains.per_state,
            address(applied) + 8 * first * periods * lay.nu, at(parameters), parameters.per_state,
            address(t_eval), len(t_eval), 1,
            address(path) + 8 * first * path[0].size, address(last) + 8 * first * lay.nx,
            address(stats) + 8 * first * len(STATISTICS),
        )  # fmt: skip

    begin = time.perf_counter()
    in_parallel(call, count, lanes, smooth.threads if count > lanes else 1)
    seconds = time.perf_counter() - begin
    shown = applied if law is not None else _shown(rows, count)
    _, rejected, evaluations, status = stats.astype(np.int64).T[:4]
    return finish(smooth, start, t_eval, path, shown, evaluations, seconds, rejected=rejected, status=status)


def _shown(rows: Rows, count: int) -> Array:
    table = rows.array if rows.array.ndim > 1 else rows.array[None]
    return (
        table[None] if count == 1 and table.ndim == 2 else np.broadcast_to(table, (count, *table.shape[-2:]))
    )


def finish(
    smooth: Smooth,
    start: Start,
    t: Array,
    path: Array,
    u: Array,
    evaluations: NDArray[np.int64],
    seconds: float,
    *,
    rejected: NDArray[np.int64] | None = None,
    status: NDArray[np.int64] | None = None,
) -> Path:
    """The result as it was asked for: a batch or one state."""
    rejected = np.zeros(len(path), np.int64) if rejected is None else rejected
    status = np.zeros(len(path), np.int64) if status is None else status
    if not np.isfinite(path[:, -1]).all():
        status = np.where((status == 0) & ~np.isfinite(path[:, -1]).all(axis=1), len(STATUS) - 1, status)
    if start.single:
        path, u, status, evaluations, rejected = path[0], u[0], status[0], evaluations[0], rejected[0]
    t = t.view()
    for array in (t, path, u):
        array.setflags(write=False)
    return Path(t, path, u, status, evaluations, rejected, seconds, smooth.layout.nq, smooth.layout.nv)


def _prescribed_rows(smooth: Smooth, w: Prescribed, times: Array, count: int) -> Rows:
    """Rows of the prescribed motion at `times`."""
    size = smooth.layout.nw
    if w is None:
        if size:
            raise EngineError(
                "keyed joints need their prescribed motion: pass w=(q, v, a) of the keyed joints"
            )
        return Rows(np.zeros(0), 0, 0)
    value = w(times) if callable(w) else w
    return rows_of("w", value, size, len(times), count)


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
    """Integration with a Python function as the controller, called at the start of every period."""
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
            smooth,
            Start(x, False),
            controls=u[:, None],
            steps=hold,
            hold=hold,
            every=every,
            step=step,
            t0=now,
            w=w,
            **rest,
        )
        pieces.append(part.x[:, 1:])
        applied.append(u)
        seconds += part.seconds
        x = np.ascontiguousarray(part.x[:, -1])
    path = np.concatenate(pieces, axis=1)
    stages = len(live_stages(rest["method"].A, rest["method"].b))
    t = np.asarray(t0 + step * every * np.arange(path.shape[1]), dtype=np.float64)
    return finish(smooth, start, t, path, np.stack(applied, axis=1), np.full(len(x), steps * stages), seconds)
