"""Sensors, delays and drives around a law as an expression: what a loop does, where its law is one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..sim.compile.cache import key_of, source
from ..sim.compile.graph import Scalar, maximum, minimum, nearest
from ..sim.dynamics.layout import Layout
from ..sim.dynamics.tangent import difference
from ..sim.formula import Expressed, Formula, Symbols
from .observers import Estimate, VelocityFilter

if TYPE_CHECKING:
    from .reality import Loop, LoopMemory

Array = NDArray[np.float64]


class LoopFormula:
    """The formula of ``loop`` around a law with the formula ``inner``; its observer is a filter, or none.

    Memory: whether there was a sample before (0 or 1), the law's, middles of the encoders' plays, q and v of
    the velocity filter, forces on their way (oldest first), and those that the motors gave.
    """

    def __init__(self, loop: Loop, inner: Formula, period: float) -> None:
        self.loop, self.inner, self.period, m = loop, inner, period, loop.model
        self.nq, self.nv, self.blocks = m.nq, m.nv, Layout(m).blocks
        self.scalar, self.unit = loop.encoders()
        self.at, self.half = m.jnt_qposadr[self.scalar], 0.5 * loop.backlash[m.jnt_dofadr[self.scalar]]
        self.plays = bool(self.half.any())
        self.filter = loop.observer if isinstance(loop.observer, VelocityFilter) else None
        self.fade = float(np.exp(-period / self.filter.lag)) if self.filter else 0.0
        law = len(inner.pack(loop.law.start()))
        widths = [1, law, len(self.at), self.nq, self.nv, loop.late * self.nv, self.nv]
        ends = np.cumsum(widths).tolist()
        self.parts = [slice(end - width, end) for end, width in zip(ends, widths, strict=True)]

    def formula(self) -> Formula:
        """See :class:`~pantograph.sim.formula.Formula`."""
        numbers = [self.half, self.unit, self.loop.keyed, [self.fade, self.period, self.loop.late]]
        kept = [np.asarray(x, dtype=float).tobytes() for x in numbers]
        words = repr((self.blocks, self.filter is None))
        return Formula(
            key=key_of(source(__file__), self.inner.key, self.loop.drives.key, words, *kept),
            gains=self.inner.gains,
            width=self.nq + self.nv + self.inner.width,
            rows=lambda first, targets: np.hstack([targets.q, targets.v, self.inner.rows(first, targets)]),
            express=self.express,
            pack=self.pack,
            unpack=self.unpack,
        )

    def express(self, q: Symbols, v: Symbols, row: Symbols, gains: Symbols, m: Symbols) -> Expressed:
        """Forces that arrive now; see :meth:`Loop.__call__`."""
        loop, nq, nv = self.loop, self.nq, self.nv
        (later,), law, middles, q_seen, rate, queue, _ = (m[part] for part in self.parts)
        y, middles = self._measured(q, middles, later)
        y = [row[i] if keyed else x for i, (x, keyed) in enumerate(zip(y, loop.keyed_q, strict=True))]
        speed = v
        if self.filter is not None:
            now = [x / self.period for x in difference(self.blocks, q_seen, y)]
            rate = [b + later * (1.0 - self.fade) * (a - b) for a, b in zip(now, rate, strict=True)]
            q_seen, speed = y, rate
        speed = [
            row[nq + i] if keyed else x for i, (x, keyed) in enumerate(zip(speed, loop.keyed, strict=True))
        ]
        tau, law = self.inner.express(y, speed, row[nq + nv :], gains, law)
        queue = [*queue, *tau]
        given = [loop.drives.express(i, x, v[i]) for i, x in enumerate(queue[:nv])]
        return given, [1.0, *law, *middles, *q_seen, *rate, *queue[nv:], *given]

    def _measured(self, q: Symbols, middles: Symbols, later: Scalar) -> tuple[list[Scalar], list[Scalar]]:
        """What the encoders show, and the middles of their plays."""
        y, centres = list(q), list(middles)
        for k, (at, half, unit) in enumerate(zip(self.at, self.half, self.unit, strict=True)):
            if self.plays:
                centres[k] = y[at] + later * (
                    minimum(maximum(middles[k], y[at] - float(half)), y[at] + float(half)) - y[at]
                )
                y[at] = centres[k]
            if unit:
                y[at] = nearest(y[at] / float(unit)) * float(unit)
        return y, centres

    def pack(self, memory: LoopMemory) -> Array:
        """The memory as numbers."""
        seen: Estimate | None = memory.observer
        begun = memory.middles is not None or (seen is not None and not np.isnan(seen.t))
        middles = np.zeros(len(self.at)) if memory.middles is None else memory.middles
        q, v = (np.zeros(self.nq), np.zeros(self.nv)) if seen is None else (seen.q, seen.v)
        return np.concatenate(
            [[float(begun)], self.inner.pack(memory.law), middles, q, v, *memory.queue, memory.applied]
        )

    def unpack(self, t: float, m: Array) -> LoopMemory:
        """The memory of numbers, after a tick at ``t`` [s]."""
        from .reality import LoopMemory

        begun, law, middles, q, v, queue, applied = (m[part] for part in self.parts)
        return LoopMemory(
            law=self.inner.unpack(t, law),
            observer=Estimate(t if begun[0] else np.nan, q, v) if self.filter else None,
            queue=tuple(queue.reshape(self.loop.late, self.nv)),
            applied=applied,
            middles=middles if self.plays and begun[0] else None,
            rotors=None,
            cut=np.zeros(self.nv, dtype=bool),
        )
