"""A control law's formula as a compiled law: its forces delivered through actuators, or as joint forces."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..compile import jit
from ..compile.cache import Cache, default_folder, key_of
from ..compile.graph import Graph, Node, Scalar, clip, less
from ..compile.program import Bound, Program, map_source, obtain
from ..compile.tape import Tape
from .fingerprint import code_fingerprint
from .laws import LawSizes
from .layout import Layout

if TYPE_CHECKING:
    from ..control import JointActuators
    from ..formula import Formula


class Delivered:
    """``formula`` with a memory of so many numbers, for freedoms ``tracked`` (nv,), through ``actuators``.

    A compiled law of layouts whose controls end with forces. A row holds q and v of the keyed joints, and
    what the formula needs.
    """

    def __init__(
        self, formula: Formula, memory: int, tracked: NDArray[np.bool_], actuators: JointActuators
    ) -> None:
        self.formula, self.tracked, self.actuators, self._memory = formula, tracked, actuators, memory
        a = actuators
        parts = (a.index, a.dof, a.qpos, a.gear, a.gain, a.bias, a.low, a.high, a.up, a.down, tracked)
        self.key = key_of(formula.key, *(np.ascontiguousarray(x).tobytes() for x in parts))

    def sizes(self, layout: Layout) -> LawSizes:
        """See `CompiledLaw`."""
        keyed = len(layout.q_keyed) + len(layout.v_keyed)
        return LawSizes(keyed + self.formula.width, len(self.formula.gains), self._memory)

    def tape(self, layout: Layout) -> Tape:
        """See `CompiledLaw`."""
        graph, sizes = Graph(), {"q": layout.nq, "v": layout.nv, "act": layout.na}
        sizes |= dict(zip("rgm", self.sizes(layout), strict=True))
        at = {name: graph.inputs(name, size) for name, size in sizes.items()}
        nqk, nvk, row = len(layout.q_keyed), len(layout.v_keyed), at["r"]
        q = _whole([*layout.q_free, *layout.q_keyed], [*at["q"], *row[:nqk]])
        v = _whole([*layout.v_free, *layout.v_keyed], [*at["v"], *row[nqk : nqk + nvk]])
        tau, memory = self.formula.express(q, v, row[nqk + nvk :], at["g"], at["m"])
        ctrl, qfrc = self._forces(q, v, tau)
        u = [ctrl.get(i, 0.0) for i in layout.u_held] + [qfrc[i] for i in layout.v_free]
        return Tape.build(sizes, {"u": u, "m": memory})

    def _forces(
        self, q: Sequence[Scalar], v: Sequence[Scalar], tau: Sequence[Scalar]
    ) -> tuple[dict[int, Scalar], list[Scalar]]:
        """Controls by actuator, and joint forces of freedoms without one; see `JointActuators.ctrl_for`."""
        a, ctrl = self.actuators, dict[int, Scalar]()
        forces: list[Scalar] = [x if on else 0.0 for x, on in zip(tau, self.tracked, strict=True)]
        parts = (a.index, a.dof, a.qpos, a.gear, a.gain, a.bias, a.low, a.high, a.up, a.down)
        each = (x.tolist() for x in parts)
        for i, dof, qpos, gear, gain, bias, low, high, up, down in zip(*each, strict=True):
            length, rate, asked = gear * q[qpos], gear * v[dof], forces[dof]
            part = up if up == down else up + (down - up) * less(asked, 0.0)
            force = asked * part / gear - bias[0] - bias[1] * length - bias[2] * rate
            ctrl[i] = clip(force / gain[0] if gain[0] else 0.0, low, high)
        driven = set(a.dof.tolist())
        return ctrl, [0.0 if dof in driven else x for dof, x in enumerate(forces)]

    def bound(self, model: mujoco.MjModel) -> Bound:
        """One tick of the whole ``model`` by itself: (q, v, act, r, g, m) -> u, m."""
        layout = Layout(model, forces=True)
        sizes = repr((layout.blocks, layout.na, layout.nu))
        key = key_of(self.key, sizes, code_fingerprint(), repr((jit.llvm_version(), jit.host())))
        code = obtain("tick", 1, Cache(default_folder()), key, lambda: map_source(self.tape(layout), 1))
        return Bound(Program(code, 1))


def _whole(places: Sequence[int], nodes: Sequence[Node]) -> list[Scalar]:
    """The nodes in the model's order."""
    return [node for _, node in sorted(zip(places, nodes, strict=True), key=lambda pair: pair[0])]
