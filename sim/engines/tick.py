"""A controller's tick in machine code: within the smooth engine's steps, by itself for other engines."""

from __future__ import annotations

import time

import numpy as np

from ..control import Sampled
from ..dynamics.delivered import Delivered
from ..formula import Formula
from .interface import Array, Controls, Held

WORTH = 1000
"""Ticks of a run from which on compiling them pays: what Python needs for fewer, a compiler needs too."""

_CHUNK = 1024  # ticks whose rows are evaluated at once


class Tick(Delivered):
    """What ``controls`` do at a tick, as a compiled law; their memory stays with them."""

    def __init__(self, controls: Sampled, formula: Formula) -> None:
        memory = len(formula.pack(controls.memory))
        super().__init__(formula, memory, controls.tracked, controls.actuators)
        self.controls = controls

    @property
    def memory(self) -> Array:
        """The law's memory as numbers."""
        return self.formula.pack(self.controls.memory)

    def remember(self, t: float, memory: Array) -> None:
        """Go on with ``memory`` after a tick at time ``t`` [s]."""
        self.controls.memory = self.formula.unpack(t, memory)

    def rows(self, first: int, keyed: tuple[Array, Array]) -> Array:
        """Rows (n, width) of the ticks from ``first`` on, at which keyed joints are at q and v, (n, ...)."""
        return np.hstack([*keyed, self.controls.rows(first, len(keyed[0]))])


class SampledTick:
    """A tick as `Controls` of the whole model, for engines whose loop is not ours.

    ``stats`` tell what its code took.
    """

    def __init__(self, tick: Tick) -> None:
        begun = time.perf_counter()
        self.tick, self.period = tick, tick.controls.period
        model = tick.controls.clip.model
        self._bound, self._own = tick.bound(model), model.nu
        ins, outs = self._bound.inputs, self._bound.outputs
        ins["g"][:], ins["m"][:] = tick.formula.gains, tick.memory
        self._q, self._v, self._r, self._m = (ins[name] for name in "qvrm")
        self._u, self._after = outs["u"], outs["m"]
        self._first, self._rows, self._sound = -1, np.zeros((0, 0)), True
        self.stats = {"build_s": time.perf_counter() - begun, "build_cached": self._bound.build.cached}

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        """See `Controls`."""
        first = k - k % _CHUNK
        if first != self._first:
            self._first, self._rows = first, self.tick.controls.rows(first, _CHUNK)
            self._sound = bool(np.isfinite(self._rows).all())
        if not self._sound:
            self.tick.remember(t - self.period, self._m)
            held = self.tick.controls.sample(k, t, q, v)  # where it is told what is wrong
            self._m[:] = self.tick.memory
            return held
        self._q[:], self._v[:], self._r[:] = q, v, self._rows[k - first]
        self._bound()
        self._m[:] = self._after
        u = self._u.copy()
        return Held(u[: self._own], u[self._own :])


def tick_of(controls: Controls | None, seconds: float) -> Tick | None:
    """The tick of controls that can be compiled, where a run of so many ``seconds`` is worth it, or None."""
    if not isinstance(controls, Sampled) or seconds < WORTH * controls.period or controls.formula is None:
        return None
    return Tick(controls, controls.formula)


def sampled_quickly(controls: Controls | None, seconds: float) -> Controls | None:
    """``controls``, by machine code where that is worth it in a run of so many ``seconds``."""
    tick = tick_of(controls, seconds)
    return controls if tick is None else SampledTick(tick)
