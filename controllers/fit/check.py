"""Where and by how much a keyed motion is impossible for a machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ...sim.clip import Clip, Motion
from .machine import Machine

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Violation:
    """The worst of one kind at one joint: ``value`` against ``limit`` [SI units] at ``t`` [s]; ``share`` is
    the part of the limit in use, above 1 if it is crossed, which it is from ``start`` to ``stop`` [s], maybe
    with pauses. For positions value is how far the joint is from the nearer end of its range (beyond: > 0).
    """

    kind: str
    who: str
    t: float
    value: float
    limit: float
    share: float
    start: float
    stop: float

    def __str__(self) -> str:
        return (
            f"{self.who}: {self.kind} {self.value:.4g} at {self.t:.3f} s, limit {self.limit:.4g} "
            f"({self.share:.0%}), from {self.start:.3f} to {self.stop:.3f} s"
        )


@dataclass(frozen=True, eq=False)
class Report:
    """All crossed limits, worst first; ``worst``: the largest share of any limit in use; the grid's times."""

    violations: tuple[Violation, ...]
    worst: float
    t: Array

    @property
    def possible(self) -> bool:
        """Whether the machine can do the motion, to a millionth of each limit."""
        return self.worst <= 1.0 + 1e-6


def check(clip: Clip, machine: Machine, *, points: int = 2000) -> Report:
    """Compare a clip with a machine at ``points`` times and on both sides of every break."""
    t, motion = samples(clip, points)
    return check_motion(t, motion, machine, keyed=clip.dofs)


def samples(clip: Clip, points: int) -> tuple[Array, Motion]:
    """Times over the whole clip, breaks twice, and the motion there: from the left, then from the right."""
    grid = np.linspace(clip.start, clip.end, points)
    breaks = np.concatenate([clip.breaks_between(clip.start, clip.end), [clip.end]])
    right, left = clip.evaluate(np.union1d(grid, breaks[:-1])), clip.evaluate(breaks, left=True)
    t = np.concatenate([breaks, np.union1d(grid, breaks[:-1])])
    order = np.argsort(t, kind="stable")
    return t[order], Motion(*(np.concatenate([a, b])[order] for a, b in zip(left, right, strict=True)))


def check_motion(
    t: Array, motion: Motion, machine: Machine, *, keyed: NDArray[np.bool_] | None = None
) -> Report:
    """Compare rows of motion at ascending times t (n,) [s] with a machine; jerk by differences of rows.

    Only positions of the freedoms ``keyed`` (nv,) are judged (default: all).
    """
    found: list[Violation] = []
    worst = 0.0
    for kind, who, value, limit, share in shares(t, motion, machine, keyed):
        k = int(np.argmax(share))
        worst = max(worst, float(share[k]))
        over = np.flatnonzero(share > 1.0 + 1e-9)
        if len(over):
            ends = float(t[over[0]]), float(t[over[-1]])
            at = float(np.broadcast_to(limit, share.shape)[k])
            found.append(Violation(kind, who, float(t[k]), float(value[k]), at, float(share[k]), *ends))
    found.sort(key=lambda v: -v.share)
    return Report(tuple(found), worst, t)


def shares(
    t: Array, motion: Motion, machine: Machine, keyed: NDArray[np.bool_] | None = None
) -> list[tuple[str, str, Array, Array | float, Array]]:
    """Every limit of a machine along rows of motion: (kind, joint, value (n,), limit, share (n,))."""
    out: list[tuple[str, str, Array, Array | float, Array]] = []
    m = machine.model
    limited = np.isfinite(machine.force_high - machine.force_low).any() or np.isfinite(machine.current)
    tau = forces(motion, machine) if limited else np.zeros_like(motion.v)
    gap = np.diff(t)
    moves = gap > 1e-9
    for dof in range(m.nv):
        joint = int(m.dof_jntid[dof])
        who = name_of(m, "joint", joint)
        low, high = machine.low[dof], machine.high[dof]
        if np.isfinite(high - low) and (keyed is None or keyed[dof]):
            q = motion.q[:, m.jnt_qposadr[joint]]
            beyond = np.maximum(low - q, q - high)
            out.append(("position", who, beyond, 0.0, 1.0 + beyond / max(high - low, 1e-12)))
        plain = (("velocity", motion.v, machine.velocity), ("acceleration", motion.a, machine.acceleration))
        for kind, values, limits in plain:
            if np.isfinite(limits[dof]):
                size = np.abs(values[:, dof])
                out.append((kind, who, size, limits[dof], size / limits[dof]))
        if np.isfinite(machine.jerk[dof]):
            jerk = np.zeros(len(t))
            jerk[1:][moves] = np.abs(np.diff(motion.a[:, dof])[moves] / gap[moves])
            jumps = np.abs(np.diff(motion.a[:, dof])) > 1e-9 * (1.0 + np.abs(motion.a[:, dof]).max())
            jerk[1:][~moves & jumps] = np.inf
            out.append(("jerk", who, jerk, machine.jerk[dof], jerk / machine.jerk[dof]))
        if machine.driven[dof]:
            out += _force(who, dof, tau[:, dof], motion.v[:, dof], machine)
    if np.isfinite(machine.current):
        draw = np.abs(tau) @ machine.ampere
        out.append(("current", "battery", draw, machine.current, draw / machine.current))
    return out


def forces(motion: Motion, machine: Machine) -> Array:
    """Joint forces (n, nv) that rows of motion need."""
    if machine.nominal.compiled:
        return machine.nominal.smooth.inverse(motion.q, motion.v, motion.a)
    return np.array([machine.nominal.inverse(*row) for row in zip(*motion, strict=True)])


def _force(
    who: str, dof: int, tau: Array, v: Array, machine: Machine
) -> list[tuple[str, str, Array, Array | float, Array]]:
    low, high, top = machine.force_low[dof], machine.force_high[dof], machine.top_speed[dof]
    if not np.isfinite(high - low):
        return []
    limit = np.where(tau >= 0, high, -low)
    out: list[tuple[str, str, Array, Array | float, Array]] = []
    if np.isfinite(top):
        # what the motor still gives in the direction it moves: |tau| <= stall (1 - |v| / top)
        drawn = np.abs(tau) / np.maximum(limit, 1e-12) + np.where(tau * v > 0, np.abs(v), 0.0) / top
        out.append(("force at speed", who, np.abs(tau), limit, drawn))
    else:
        out.append(("force", who, np.abs(tau), limit, np.abs(tau) / np.maximum(limit, 1e-12)))
    return out
