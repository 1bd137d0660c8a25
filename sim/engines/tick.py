"""A controller's tick in the smooth engine's machine code: the law, and the actuators that deliver it."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from ..compile import jit
from ..compile.cache import Cache, default_folder, key_of, source
from ..compile.graph import Graph, Node, Scalar, clip
from ..compile.program import Bound, Program, map_source, obtain
from ..compile.tape import Tape
from ..control import Sampled
from ..dynamics.fingerprint import code_fingerprint
from ..dynamics.laws import LawSizes
from ..dynamics.layout import Layout
from ..formula import Formula
from .interface import Array, Controls, Held

WORTH = 1000
"""Ticks of a run from which on compiling them pays: what Python needs for fewer, a compiler needs too."""

_CHUNK = 1024  # ticks whose rows are evaluated at once


class Tick:
    """What `Sampled` does at a tick, as a compiled law of a layout whose controls end with forces.

    A row holds q and v of the keyed joints at the tick, and what the law's formula needs.
    """

    def __init__(self, controls: Sampled, formula: Formula) -> None:
        self.controls, self.formula = controls, formula
        a = controls.actuators
        parts = (a.index, a.dof, a.qpos, a.gear, a.gain, a.bias, a.low, a.high, controls.tracked)
        self.key = key_of(source(__file__), formula.key, *(np.ascontiguousarray(x).tobytes() for x in parts))

    def sizes(self, layout: Layout) -> LawSizes:
        """See `CompiledLaw`."""
        keyed = len(layout.q_keyed) + len(layout.v_keyed)
        return LawSizes(keyed + self.formula.width, len(self.formula.gains), len(self.memory))

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

    def tape(self, layout: Layout) -> Tape:
        """See `CompiledLaw`."""
        graph, sizes = Graph(), {"q": layout.nq, "v": layout.nv, "act": layout.na}
        sizes |= dict(zip("rgm", self.sizes(layout), strict=True))
        at = {name: graph.inputs(name, size) for name, size in sizes.items()}
        nqk, nvk, row = len(layout.q_keyed), len(layout.v_keyed), at["r"]
        q = _whole([*layout.q_free, *layout.q_keyed], [*at["q"], *row[:nqk]])
        v = _whole([*layout.v_free, *layout.v_keyed], [*at["v"], *row[nqk : nqk + nvk]])
        tau, memory = self.formula.express(q, v, row[nqk + nvk :], at["g"], at["m"])
        ctrl, qfrc = self._delivered(q, v, tau)
        u = [ctrl.get(i, 0.0) for i in layout.u_held] + [qfrc[i] for i in layout.v_free]
        return Tape.build(sizes, {"u": u, "m": memory})

    def _delivered(
        self, q: Sequence[Scalar], v: Sequence[Scalar], tau: Sequence[Scalar]
    ) -> tuple[dict[int, Scalar], list[Scalar]]:
        """Controls by actuator and joint forces, as `Sampled.sample`."""
        a, ctrl = self.controls.actuators, dict[int, Scalar]()
        forces: list[Scalar] = [x if on else 0.0 for x, on in zip(tau, self.controls.tracked, strict=True)]
        each = (x.tolist() for x in (a.index, a.dof, a.qpos, a.gear, a.gain, a.bias, a.low, a.high))
        for i, dof, qpos, gear, gain, bias, low, high in zip(*each, strict=True):
            length, rate = gear * q[qpos], gear * v[dof]
            force = forces[dof] / gear - bias[0] - bias[1] * length - bias[2] * rate
            ctrl[i] = clip(force / gain[0] if gain[0] else 0.0, low, high)
        driven = set(a.dof.tolist())
        return ctrl, [0.0 if dof in driven else x for dof, x in enumerate(forces)]


class SampledTick:
    """`Sampled` by machine code, for engines whose loop is not: `Controls` of the whole model."""

    def __init__(self, tick: Tick) -> None:
        begun = time.perf_counter()
        self.tick, self.period = tick, tick.controls.period
        layout = Layout(tick.controls.clip.model, forces=True)
        sizes = repr((layout.blocks, layout.na, layout.nu))
        key = key_of(tick.key, sizes, code_fingerprint(), repr((jit.llvm_version(), jit.host())))
        code = obtain("tick", 1, Cache(default_folder()), key, lambda: map_source(tick.tape(layout), 1))
        self._bound = Bound(Program(code, 1))
        ins, outs = self._bound.inputs, self._bound.outputs
        ins["g"][:], ins["m"][:] = tick.formula.gains, tick.memory
        self._q, self._v, self._r, self._m = (ins[name] for name in "qvrm")
        self._u, self._after, self._own = outs["u"], outs["m"], len(layout.u_held)
        self._first, self._rows, self._sound = -1, np.zeros((0, 0)), True
        self.stats = {"build_s": time.perf_counter() - begun, "build_cached": code.build.cached}

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


def _whole(places: Sequence[int], nodes: Sequence[Node]) -> list[Scalar]:
    """The nodes in the model's order."""
    return [node for _, node in sorted(zip(places, nodes, strict=True), key=lambda pair: pair[0])]
