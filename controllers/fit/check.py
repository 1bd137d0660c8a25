"""Where and by how much a keyed motion is impossible for a machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from ...sim.clip import Clip, Motion
from ...sim.kinds import BALL, FREE
from .contact import Phase, missing
from .machine import Machine

Array = NDArray[np.float64]
MISSING = "missing force"


@dataclass(frozen=True)
class Violation:
    """The worst of one kind at one joint: ``value`` against ``limit`` [SI units] at ``t`` [s]; ``share`` is
    the part of the limit in use, above 1 if it is crossed, which it is from ``start`` to ``stop`` [s], maybe
    with pauses. For positions value is how far the joint is from the nearer end of its range (beyond: > 0),
    for a ``missing force`` what a freedom without a drive would need.
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
        ends = f"from {self.start:.3f} to {self.stop:.3f} s"
        if self.kind == MISSING:
            return (
                f"{self.who}: nothing drives it, {self.value:.4g} N or N m missing at {self.t:.3f} s, {ends}"
            )
        if self.kind == "position":
            return f"{self.who}: {self.value:.4g} rad or m beyond its range at {self.t:.3f} s, {ends}"
        return (
            f"{self.who}: {self.kind} {self.value:.4g} at {self.t:.3f} s, limit {self.limit:.4g} "
            f"({self.share:.0%}), {ends}"
        )


class Use(NamedTuple):
    """One limit along a motion: values (n,), the limit, and the share (n,) of it in use."""

    kind: str
    who: str
    value: Array
    limit: Array | float
    share: Array


@dataclass(frozen=True, eq=False)
class Report:
    """All crossed limits, worst first; ``worst``: the largest share of any limit in use; the grid's times;
    ``uses``: the same of every limit that the machine has, crossed or not."""

    violations: tuple[Violation, ...]
    worst: float
    t: Array
    uses: tuple[Violation, ...] = ()

    @property
    def possible(self) -> bool:
        """Whether the machine can do the motion, to a millionth of each limit."""
        return self.worst <= 1.0 + 1e-6


def check(clip: Clip, machine: Machine, *, phases: Sequence[Phase] = (), points: int = 2000) -> Report:
    """Compare a clip with a machine at ``points`` times and on both sides of every break.

    Freedoms with keys but without a drive need forces that nothing gives, unless the contacts of ``phases``
    do: what is missing is a violation as well.
    """
    t, motion = samples(clip, points)
    need = forces(motion, machine)
    need, _ = missing(machine.model, phases, t, motion.q, need, np.flatnonzero(~machine.driven & clip.dofs))
    return _report(t, shares(t, motion, machine, keyed=clip.dofs, need=need))


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

    Only positions of the freedoms ``keyed`` (nv,), and forces missing there, are judged (default: all).
    """
    return _report(t, shares(t, motion, machine, keyed=keyed))


def _report(t: Array, uses: Sequence[Use]) -> Report:
    every = [_worst(t, use) for use in uses]
    every.sort(key=lambda v: -v.share)
    found = tuple(v for v in every if v.share > 1.0 + 1e-9)
    return Report(found, every[0].share if every else 0.0, t, tuple(every))


def _worst(t: Array, use: Use) -> Violation:
    k = int(np.argmax(use.share))
    limit = float(np.broadcast_to(use.limit, use.share.shape)[k])
    over = np.flatnonzero(use.share > 1.0 + 1e-9)
    ends = (float(t[over[0]]), float(t[over[-1]])) if len(over) else (float(t[k]), float(t[k]))
    return Violation(use.kind, use.who, float(t[k]), float(use.value[k]), limit, float(use.share[k]), *ends)


def shares(
    t: Array,
    motion: Motion,
    machine: Machine,
    *,
    keyed: NDArray[np.bool_] | None = None,
    need: Array | None = None,
) -> list[Use]:
    """Every limit of a machine along rows of motion; ``need`` (n, nv) are the joint forces, less contacts."""
    out: list[Use] = []
    m = machine.model
    tau = forces(motion, machine) if need is None else need
    keyed = np.ones(m.nv, dtype=bool) if keyed is None else keyed
    most = max(float(np.abs(tau).max(initial=0.0)), 1e-12)
    for dof, who in enumerate(freedoms(m)):
        low, high = machine.low[dof], machine.high[dof]
        if np.isfinite(high - low) and keyed[dof]:
            q = motion.q[:, m.jnt_qposadr[m.dof_jntid[dof]]]
            beyond = np.maximum(low - q, q - high)
            out.append(Use("position", who, beyond, 0.0, 1.0 + beyond / max(high - low, 1e-12)))
        plain = (("velocity", motion.v, machine.velocity), ("acceleration", motion.a, machine.acceleration))
        for kind, values, limits in plain:
            if np.isfinite(limits[dof]):
                size = np.abs(values[:, dof])
                out.append(Use(kind, who, size, float(limits[dof]), size / limits[dof]))
        if np.isfinite(machine.jerk[dof]):
            jerk = _jerk(t, motion.v[:, dof], motion.a[:, dof])
            out.append(Use("jerk", who, jerk, float(machine.jerk[dof]), jerk / machine.jerk[dof]))
        if machine.driven[dof]:
            out += _force(who, dof, tau[:, dof], motion.v[:, dof], machine)
        elif keyed[dof]:
            size = np.abs(tau[:, dof])
            over = np.where(size > 1e-9 * most, size / most, 0.0)
            out.append(Use(MISSING, who, size, 0.0, np.where(over > 0, 1.0 + over, 0.0)))
    if np.isfinite(machine.current):
        draw = np.abs(np.where(machine.driven, tau, 0.0)) @ machine.ampere
        out.append(Use("current", "battery", draw, machine.current, draw / machine.current))
    return out


def _jerk(t: Array, v: Array, a: Array) -> Array:
    """Size (n,) of differences of accelerations; infinite where they jump, out of and into rest included."""
    gap, change, out = np.diff(t), np.abs(np.diff(a)), np.zeros(len(t))
    moves, real = gap > 1e-9, 1e-9 * (1.0 + np.abs(a).max())
    out[1:][moves] = change[moves] / gap[moves]
    out[1:][~moves & (change > real)] = np.inf
    for end in (0, -1):
        if abs(v[end]) <= 1e-9 * (1.0 + np.abs(v).max()) and abs(a[end]) > real:
            out[end] = np.inf
    return out


def freedoms(model: mujoco.MjModel) -> list[str]:
    """Names of all freedoms (nv,): their joint's, with a letter where it has several."""
    letters = {FREE: ("x", "y", "z", "rx", "ry", "rz"), BALL: ("rx", "ry", "rz")}
    out = []
    for joint in range(model.njnt):
        name, kind = name_of(model, "joint", joint), int(model.jnt_type[joint])
        out += [f"{name}.{x}" for x in letters[kind]] if kind in letters else [name]
    return out


def forces(motion: Motion, machine: Machine) -> Array:
    """Joint forces (n, nv) that rows of motion need."""
    if machine.nominal.compiled:
        return machine.nominal.smooth.inverse(motion.q, motion.v, motion.a)
    return np.array([machine.nominal.inverse(*row) for row in zip(*motion, strict=True)])


def _force(who: str, dof: int, tau: Array, v: Array, machine: Machine) -> list[Use]:
    low, high, top = machine.force_low[dof], machine.force_high[dof], machine.top_speed[dof]
    if not np.isfinite(high - low):
        return []
    limit = np.where(tau >= 0, high, -low)
    drawn = np.abs(tau) / np.maximum(limit, 1e-12)
    if not np.isfinite(top):
        return [Use("force", who, np.abs(tau), limit, drawn)]
    # what the motor still gives in the direction it moves: |tau| <= stall (1 - |v| / top)
    drawn = drawn + np.where(tau * v > 0, np.abs(v), 0.0) / top
    return [Use("force at speed", who, np.abs(tau), limit, drawn)]
