"""How possible a fitted motion is between the points that it was computed at."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....sim.clip import Clip
from ..check import MISSING, follow, forces, shares
from ..contact import Phase, places
from ..machine import Machine

Array = NDArray[np.float64]
_FINER = 10


class Finding(NamedTuple):
    """On each piece (pieces,): largest share of a limit in use, largest missing force relative to the largest
    at all; how far resting sites stray at most [m]; and that ``largest`` force [N m, N]."""

    limits: Array
    dynamics: Array
    contact: float
    largest: float


def examine(
    machine: Machine, clip: Clip, t: Array, force: Array, sites: Sequence[str], phases: Sequence[Phase]
) -> Finding:
    """Judge a clip on a grid ten times finer than its nodes ``t`` (n,), ends of pieces from both sides.

    ``force`` (3, n - 1, 3 sites) are contact forces at the beginning, middle and end of each piece, parabolas
    in between.
    """
    pieces, part = len(t) - 1, np.linspace(0.0, 1.0, _FINER + 1)
    trace = follow(clip, t, _FINER, jerk=machine.asks_jerk)
    motion = trace.motion
    need = forces(motion, machine)
    largest = max(float(np.abs(need).max()), 1e-12)
    share, stray = np.zeros(pieces), 0.0
    if sites:
        weights = np.stack([(1 - part) * (1 - 2 * part), 4 * part * (1 - part), part * (2 * part - 1)])
        pushed = np.einsum("kp,kis->ips", weights, force)
        p, J = places(machine.model, sites, motion.q)
        need = need - np.einsum("is,isj->ij", pushed.reshape(len(need), -1), J)
        stray = _strays(p.reshape(pieces, len(part), -1), t, sites, phases)
        share = _slips(pushed, t, sites, phases, machine)
    loose = ~machine.driven & clip.dofs  # what is not fitted has no track
    missing = np.abs(need[:, loose]).max(axis=1, initial=0.0) / largest
    for used in (row.share for row in shares(trace, machine, need=need) if row.kind != MISSING):
        share = np.maximum(share, used.reshape(pieces, -1).max(axis=1))
    return Finding(share, missing.reshape(pieces, -1).max(axis=1), stray, largest)


def _strays(p: Array, t: Array, sites: Sequence[str], phases: Sequence[Phase]) -> float:
    """How far (m) sites get from where they rest first, or from the ground."""
    worst, middle = 0.0, 0.5 * (t[1:] + t[:-1])
    for phase in phases:
        on = phase.holds(middle)
        for site in phase.sites:
            k = 3 * sites.index(site)
            rows = p[on, :, k : k + 3].reshape(-1, 3)
            worst = max(worst, float(np.linalg.norm(rows - rows[0], axis=1).max()))
            if phase.ground is not None:
                worst = max(worst, float(np.abs(rows[:, 2] - phase.ground).max()))
    return worst


def _slips(pushed: Array, t: Array, sites: Sequence[str], phases: Sequence[Phase], machine: Machine) -> Array:
    """Share (pieces,) of friction in use: 1 and what is beyond it as a part of the weight."""
    middle, out = 0.5 * (t[1:] + t[:-1]), np.zeros(len(t) - 1)
    weight = max(9.81 * float(machine.model.body_mass.sum()), 1e-9)
    for phase in phases:
        on = phase.holds(middle)
        for k in (3 * sites.index(s) for s in phase.sites):
            x, y, z = (pushed[on, :, k + j] for j in range(3))
            beyond = np.abs(x) + np.abs(y) - phase.friction * z
            out[on] = np.maximum(out[on], 1.0 + beyond.max(axis=1) / weight)
    return out
