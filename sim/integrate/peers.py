"""Solvers that we did not write, behind the same front door: SciPy's and torchdiffeq's."""

import time
from collections.abc import Callable, Sequence
from types import MappingProxyType
from typing import Any

import numpy as np
import scipy

from ..errors import EngineError, unknown
from .control import fixed_grid, tolerances
from .events import Event
from .problems import Problem
from .solution import Occurrence, Solution, Stats, Status
from .steps import Counted
from .tableau import Array

TORCH_FIXED = ("euler", "midpoint", "rk4", "explicit_adams", "implicit_adams")
PEERS = MappingProxyType(
    {
        "scipy": ("RK45", "RK23", "DOP853", "Radau", "BDF", "LSODA"),
        "torch": ("dopri5", "dopri8", "bosh3", "fehlberg2", "adaptive_heun", *TORCH_FIXED),
    }
)
"""Foreign solvers by the prefix of their method's name."""


def solve_by_peer(
    problem: Problem,
    span: tuple[float, float],
    y0: Array,
    method: str,
    *,
    step: float | None,
    rtol: float | None,
    atol: float | Array | None,
    times: Array | None,
    events: Sequence[Event],
    dense: bool,
) -> Solution:
    """`solve` by a foreign solver; neither knows manifolds, so that its output is projected afterwards.

    Raises:
        EngineError: an unknown method, an argument the solver has no counterpart for, or torch is missing.
    """
    peer, _, name = method.partition(":")
    if name not in PEERS[peer]:
        raise EngineError(unknown(f"{peer} method", name, PEERS[peer], where=peer))
    if peer == "scipy":
        if step is not None:
            raise EngineError(f"{method} chooses its own steps: give rtol and atol instead of step={step}")
        return _scipy(problem, span, y0, name, tolerances(rtol, atol), times, events, dense)
    for given, what in ((events, "events"), (dense, "dense=True")):
        if given:
            raise EngineError(f"{method} cannot do {what}: use one of Pantograph's own methods or SciPy's")
    if (name in TORCH_FIXED) != (step is not None):
        wanted = "step=0.001 (seconds)" if name in TORCH_FIXED else "rtol and atol"
        raise EngineError(f"{method} needs {wanted}; it got step={step}, rtol={rtol}, atol={atol}")
    if step is not None and (rtol is not None or atol is not None):
        raise EngineError(f"{method} takes fixed steps: leave out rtol={rtol}, atol={atol}")
    return _torch(problem, span, y0, name, step, None if step is not None else tolerances(rtol, atol), times)


def _scipy(
    problem: Problem,
    span: tuple[float, float],
    y0: Array,
    name: str,
    tolerance: tuple[float, Array],
    times: Array | None,
    events: Sequence[Event],
    dense: bool,
) -> Solution:
    if any(event.jump is not None for event in events):
        raise EngineError("SciPy's solvers cannot jump at events: use one of Pantograph's own methods")
    f = Counted(problem.f)
    began = time.perf_counter()
    rtol, atol = tolerance
    result = scipy.integrate.solve_ivp(
        f, span, y0, method=name, rtol=rtol, atol=atol, dense_output=times is not None or dense,
        events=[_scipy_event(event) for event in events],
    )  # fmt: skip
    ends = result.t
    t = ends
    if times is not None:
        sign = np.sign(span[1] - span[0])
        t = times[sign * times <= sign * ends[-1]]
    y = (result.y if times is None else result.sol(t) if len(t) else np.empty((len(y0), 0))).T
    happened = [
        Occurrence(i, event.name or f"event {i}", float(when), state, state)
        for i, event in enumerate(events)
        for when, state in zip(result.t_events[i], result.y_events[i], strict=True)
    ]
    happened.sort(key=lambda o: abs(o.t - span[0]))
    sol = result.sol
    return Solution(
        t=np.array(t),
        y=_projected(problem, y),
        status={0: Status.FINISHED, 1: Status.EVENT}.get(result.status, Status.SOLVER),
        stats=Stats(f.calls, len(ends) - 1, None, time.perf_counter() - began),
        events=tuple(happened),
        message=str(result.message),
        interpolant=(lambda x: _projected(problem, sol(np.atleast_1d(x)).T)) if dense else None,
    )


def _scipy_event(event: Event) -> Callable[[float, Array], float]:
    def g(t: float, y: Array) -> float:
        return event.g(t, y)

    marked: Any = g  # SciPy reads attributes of the function
    marked.terminal, marked.direction = event.terminal, event.direction
    return g


def _torch(
    problem: Problem,
    span: tuple[float, float],
    y0: Array,
    name: str,
    step: float | None,
    tolerance: tuple[float, Array] | None,
    times: Array | None,
) -> Solution:
    try:
        import torch
        from torchdiffeq import odeint
    except ImportError as missing:
        raise EngineError(
            f"method torch:{name} needs torchdiffeq: pip install 'pantograph-sim[torch]' ({missing})"
        ) from missing
    f = Counted(problem.f)

    def rate(t: "torch.Tensor", y: "torch.Tensor") -> "torch.Tensor":
        return torch.from_numpy(f(float(t), y.numpy()))

    if step is not None:
        grid = fixed_grid(span, step)
        options = {"grid_constructor": lambda *_: torch.from_numpy(grid), "interp": "cubic"}
        asked = grid if times is None else times
        arguments: dict[str, Any] = {"options": options}
    else:
        asked = np.array(span) if times is None else times
        rtol, atol = tolerance or (1e-6, np.array(1e-6))
        arguments = {"rtol": rtol, "atol": torch.from_numpy(np.broadcast_to(atol, y0.shape).copy())}
    # odeint wants strictly monotone times that begin at the start and reach the end of its grid.
    t, inverse = np.unique(np.concatenate([[span[0]], asked, [span[1]]]), return_inverse=True)
    if span[1] < span[0]:
        t, inverse = t[::-1].copy(), len(t) - 1 - inverse
    began = time.perf_counter()
    with torch.no_grad():
        y = odeint(rate, torch.from_numpy(y0), torch.from_numpy(t), method=name, **arguments).numpy()
    wall = time.perf_counter() - began
    y = _projected(problem, y[inverse[1:-1]])
    finite = np.isfinite(y).all(axis=1)
    kept = len(y) if finite.all() else int(np.argmin(finite))
    ok = kept == len(y)
    return Solution(
        t=asked[:kept].copy(),
        y=y[:kept],
        status=Status.FINISHED if ok else Status.DIVERGED,
        stats=Stats(f.calls, None if step is None else len(grid) - 1, None, wall),
        events=(),
        message=f"reached t = {span[1]:.9g} s"
        if ok
        else f"the state is not finite at t = {asked[kept]:.9g} s",
    )


def _projected(problem: Problem, y: Array) -> Array:
    return np.array([problem.project(row) for row in y]).reshape(len(y), problem.ndim)
