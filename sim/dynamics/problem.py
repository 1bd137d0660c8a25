"""A smooth model as an initial value problem of `sim.integrate`: for its events and foreign solvers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import EngineError
from ..integrate.handed import Followed
from ..integrate.solution import Status
from ..integrate.tableau import Tableau

if TYPE_CHECKING:
    from .smooth import Smooth

Array = NDArray[np.float64]

_STATUS = (Status.FINISHED, Status.TOO_MANY_STEPS, Status.STEP_TOO_SMALL, Status.DIVERGED)
"""Of `motion.path.STATUS`."""


class SmoothProblem:
    """dx/dt of a smooth model, x = (q, v, act), quaternions as an ODE in R^4 (see `sim.integrate.problems`).

    It owns its buffers, so that one thread at a time may evaluate it.
    """

    def __init__(self, smooth: Smooth, controls: Any = None, w: Any = None):
        lay = smooth.layout
        if lay.nw and w is None:
            raise EngineError(
                "keyed joints need their prescribed motion: pass w=(q, v, a) of the keyed joints"
            )
        self.ndim, self._layout, self._smooth = lay.nx, lay, smooth
        self._bound = smooth.bind("rate")
        self._inputs = self._bound.inputs
        self._inputs["p"][:] = smooth.parameter_values
        self._controls: Callable[[float, Array, Array], ArrayLike] | None = None
        if callable(controls):
            self._controls = controls
        elif controls is not None:
            self._inputs["u"][:] = controls
        self._w = w if callable(w) else None
        if w is not None and self._w is None:
            self._inputs["w"][:] = w
        self._quaternions = [slice(at, at + 4) for at in lay.quaternions]

    def f(self, t: float, y: Array, /) -> Array:
        """dx/dt, shape (nx,)."""
        lay, inputs = self._layout, self._inputs
        inputs["q"][:] = y[: lay.nq]
        inputs["v"][:] = y[lay.nq : lay.nq + lay.nv]
        inputs["act"][:] = y[lay.nq + lay.nv :]
        if self._controls is not None:
            inputs["u"][:] = self._controls(t, inputs["q"], inputs["v"])
        if self._w is not None:
            inputs["w"][:] = np.asarray(self._w(np.array([t])))[0]
        self._bound()
        return self._bound.outputs["dx"].copy()

    def march(
        self, method: Tableau, t: float, y: Array, step: float, steps: int, /
    ) -> tuple[Array, int] | None:
        """See `sim.integrate.handed.CompiledProblem`."""
        if self._controls is not None:
            return None
        q, v, act = self._parts(y)
        path = self._smooth.rollout(
            q, v, self._inputs["u"].copy(), step=step, steps=steps, method=method, act0=act, w=self._motion(),
            t0=t,
        )  # fmt: skip
        return path.x, int(path.evaluations)

    def follow(
        self, method: Tableau, times: Array, y: Array, rtol: float, atol: Array, h: float, most: int, /
    ) -> Followed | None:
        """See `sim.integrate.handed.CompiledProblem`; prescribed motion that moves is not for it."""
        if self._controls is not None or self._w is not None:
            return None
        q, v, act = self._parts(y)
        path = self._smooth.integrate(
            q, v, times, self._inputs["u"].copy(), method=method, rtol=rtol, atol=atol, act0=act,
            w=self._motion(), first_step=h, max_steps=most,
        )  # fmt: skip
        numbers = (int(x) for x in (path.evaluations, path.steps, path.rejected))
        return Followed(path.x, float(path.reached), _STATUS[path.status], *numbers)

    def _parts(self, y: Array) -> tuple[Array, Array, Array]:
        lay = self._layout
        return y[: lay.nq], y[lay.nq : lay.nq + lay.nv], y[lay.nq + lay.nv :]

    def _motion(self) -> Any:
        """The prescribed motion as integrations take it."""
        return self._w if self._w is not None else self._inputs["w"].copy() if self._layout.nw else None

    def project(self, y: Array, /) -> Array:
        """The state with all quaternions normalised."""
        if not self._quaternions:
            return y
        y = y.copy()
        for part in self._quaternions:
            y[part] /= np.linalg.norm(y[part])
        return y
