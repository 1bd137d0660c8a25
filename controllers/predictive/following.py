"""Plans followed in machine code: forces that keep to a plan with its gains, as far as motors give them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...sim.compile.cache import source
from ...sim.compile.graph import Graph, Scalar, maximum, minimum
from ...sim.compile.tape import Tape
from ...sim.dynamics.laws import LawSizes
from ...sim.dynamics.layout import Layout
from ...sim.dynamics.tangent import difference

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Following:
    """u = clip(u_ref + K (x - x_ref)), with gains K (periods, m, 2 nv) and references of their own in each
    period, on the joint forces of the freedoms ``inputs`` of a model whose controls end with these.

    ``rows`` ((batch,) periods, nq + nv + m + 2 m nv): (x_ref, u_ref, K) in each period. ``motors`` (3 m,):
    least and greatest forces at rest, and 1 / their top speeds.
    """

    inputs: tuple[int, ...]
    rows: Array
    motors: Array

    @property
    def key(self) -> str:
        """Which freedoms are driven."""
        return f"following {self.inputs} {source(__file__)}"

    def sizes(self, layout: Layout) -> LawSizes:
        """See :class:`~pantograph.sim.dynamics.laws.GivenLaw`."""
        m = len(self.inputs)
        return LawSizes(layout.nq + layout.nv + m * (1 + 2 * layout.nv), 3 * m, 0)

    def references(self, layout: Layout, home: Array, periods: int) -> Array:
        """The rows."""
        return self.rows

    def gains(self) -> Array:
        """What motors give."""
        return self.motors

    def tape(self, layout: Layout) -> Tape:
        """See :class:`~pantograph.sim.dynamics.laws.GivenLaw`."""
        graph, m, nq, nv = Graph(), len(self.inputs), layout.nq, layout.nv
        sizes = {"q": nq, "v": nv, "act": layout.na} | dict(zip("rgm", self.sizes(layout), strict=True))
        nodes = {name: graph.inputs(name, size) for name, size in sizes.items()}
        v, r, g = nodes["v"], nodes["r"], nodes["g"]
        away = difference(layout.blocks, r[:nq], nodes["q"])
        away += [now - planned for now, planned in zip(v, r[nq : nq + nv], strict=True)]
        wanted, K = r[nq + nv : nq + nv + m], r[nq + nv + m :]
        out: list[Scalar] = [0.0] * layout.nu
        for i, dof in enumerate(self.inputs):
            total: Scalar = wanted[i]
            for j, x in enumerate(away):
                total = total + K[2 * nv * i + j] * x
            rate = v[dof] * g[2 * m + i]
            low = g[i] * maximum(minimum(1.0 + rate, 1.0), 0.0)
            high = g[m + i] * maximum(minimum(1.0 - rate, 1.0), 0.0)
            out[layout.nu - nv + dof] = minimum(maximum(total, low), high)
        return Tape.build(sizes, {"u": out, "m": []})
