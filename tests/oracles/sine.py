"""A curve that keys cannot draw: q = offset + amplitude sin(rate t + phase), with its exact derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from pantograph.sim.curves import Curve, Sample


@dataclass(frozen=True, eq=False)
class Sine(Curve):
    amplitude: float = 1.0
    rate: float = 1.0
    phase: float = 0.0
    offset: float = 0.0

    def _piece(self, i, s):
        raise AssertionError("a sine has no pieces")

    def __call__(self, t, *, left=False):
        x = np.asarray(t, dtype=float)[..., None]
        a, w, p = self.amplitude, self.rate, self.phase
        return Sample(
            self.offset + a * np.sin(w * x + p), a * w * np.cos(w * x + p), -a * w * w * np.sin(w * x + p)
        )


def sine(amplitude: float, rate: float, phase: float = 0.0, offset: float = 0.0) -> Sine:
    ends = np.array([0.0])
    return Sine(ends, np.zeros((1, 1)), ends, "hold", "hold", amplitude, rate, phase, offset)
