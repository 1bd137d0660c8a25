"""Keys that the machine can do as they are: the nearest possible motion, without a search for one."""

from __future__ import annotations

import time

import numpy as np
from numpy.typing import NDArray

from ....sim.clip import Clip
from ..check import check, forces, knots
from ..ends import AtRest, moving
from ..fitted import Certificate, Fitted
from ..machine import Machine
from .certify import examine

Array = NDArray[np.float64]


def kept(clip: Clip, machine: Machine, nodes: Array, at_rest: AtRest, tolerance: float) -> Fitted | None:
    """The motion of the keys as a fitted one, certified at ``nodes`` (n,) and its own; None where it is not
    possible, or where a joint with neither keys nor a drive moves along with it."""
    inside = moving(machine, clip, ())
    if (inside & ~machine.driven & ~clip.dofs).any():
        return None
    begun = time.perf_counter()
    if not check(clip, machine, at_rest=at_rest).possible:
        return None
    t = np.union1d(nodes, knots(clip))
    t = t[np.append(True, np.diff(t) > 1e-9)]
    finding = examine(machine, clip, t, np.zeros((3, len(t) - 1, 0)), (), ())
    by_piece = np.maximum(np.maximum(finding.limits - 1.0, 0.0), finding.dynamics) / tolerance
    if by_piece.max() > 1.0:
        return None
    certificate = Certificate(
        limits=float(finding.limits.max(initial=0.0)),
        dynamics=float(finding.dynamics.max(initial=0.0)),
        largest=finding.largest,
        contact=0.0,
        tolerance=tolerance,
        holds=True,
        solver=0.0,
        status="the keys as they are",
        iterations=0,
        seconds=time.perf_counter() - begun,
        pieces=len(t) - 1,
        by_piece=by_piece,
    )
    none = np.zeros((len(t), 0))
    tau = np.where(machine.driven, forces(clip.evaluate(t, left=True), machine), 0.0)
    return Fitted(clip, t, tau, none, none[1:], (), (), 0.0, certificate)
