"""Where and by how much a keyed motion is impossible for a machine."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...models import dof_names
from ...sim.clip import Clip, FreeTrack, Motion, Track
from ...sim.curves import Curve
from .contact import Phase, missing
from .ends import AtRest, astray, jumps, resting
from .machine import Machine

Array = NDArray[np.float64]
MISSING = "missing force"
_JUMPS = ("position jump", "speed jump")


@dataclass(frozen=True)
class Violation:
    """The worst of one kind at one joint: ``value`` against ``limit`` [SI units] at ``t`` [s]; ``share`` is
    the part of the limit in use, above 1 if it is crossed, which it is from ``start`` to ``stop`` [s], maybe
    with pauses. For positions value is how far the joint is from the nearer end of its range (beyond: > 0),
    for a ``missing force`` what a freedom without a drive would need; a ``position jump`` or ``speed jump``
    has no limit: no machine does it, its share is infinite.
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
        if self.kind in _JUMPS:
            unit = "rad or m" if self.kind == "position jump" else "rad/s or m/s"
            return f"{self.who}: {self.kind} of {self.value:.4g} {unit} at {self.t:.3f} s"
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


class Trace(NamedTuple):
    """Rows of motion along pieces of a clip, the last of each from the left: t (n,) [s], q, v, a, and
    ``jerk`` (n, nv), infinite where accelerations jump, or None."""

    t: Array
    motion: Motion
    jerk: Array | None


def check(
    clip: Clip,
    machine: Machine,
    *,
    phases: Sequence[Phase] = (),
    points: int = 2000,
    at_rest: AtRest = None,
) -> Report:
    """Compare a clip with a machine at ``points`` times and more, and on both sides of every break.

    Freedoms with keys but without a drive need forces that nothing gives, unless the contacts of ``phases``
    do: what is missing is a violation as well. So are jumps of places and speeds, as at the corners of linear
    keys and at ends that are to be ``at_rest`` (:func:`~.ends.resting`), and joints without keys that start
    outside of their ranges.
    """
    part = 5
    grid = np.linspace(clip.start, clip.end, max(points // part, 1) + 1)
    nodes = np.union1d(grid, knots(clip))
    nodes = nodes[np.append(True, np.diff(nodes) > 1e-12 * max(1.0, abs(nodes[-1])))]
    nodes = nodes if len(nodes) > 1 else np.repeat(nodes, 2)
    trace = follow(clip, nodes, part, jerk=machine.asks_jerk)
    need = forces(trace.motion, machine)
    loose = np.flatnonzero(~machine.driven & clip.dofs)
    need, _ = missing(machine.model, phases, trace.t, trace.motion.q, need, loose)
    found = report(trace, machine, keyed=clip.dofs, need=need)
    return _with(found, _never(clip, machine, phases, resting(clip, at_rest)))


def _never(clip: Clip, machine: Machine, phases: Sequence[Phase], ends: tuple[bool, bool]) -> list[Violation]:
    """What no machine does, and no timing helps: jumps, and joints without keys out of range."""
    names, out = dof_names(machine.model), []
    for jump in jumps(clip, ends):
        kind = _JUMPS[jump.of_speed]
        out.append(Violation(kind, names[jump.dof], jump.t, jump.size, 0.0, np.inf, jump.t, jump.t))
    beyond = astray(machine, clip, phases)
    for dof in np.flatnonzero(beyond):
        share = 1.0 + float(beyond[dof]) / max(float(machine.high[dof] - machine.low[dof]), 1e-12)
        row = (names[dof], clip.start, float(beyond[dof]), 0.0, share, clip.start, clip.end)
        out.append(Violation("position", *row))
    return out


def _with(found: Report, more: list[Violation]) -> Report:
    if not more:
        return found
    every = sorted((*found.uses, *more), key=lambda v: -v.share)
    over = sorted((*found.violations, *more), key=lambda v: -v.share)
    return Report(tuple(over), every[0].share, found.t, tuple(every))


def follow(clip: Clip, nodes: Array, parts: int = 10, *, jerk: bool = True) -> Trace:
    """Motion at ``parts`` + 1 points on each piece between times ``nodes`` (n + 1,) of a clip.

    Knots of the clip are to be among the nodes: jerk follows from accelerations at four points of a piece
    each, which is exact where these are cubics.
    """
    part = np.linspace(0.0, 1.0, parts + 1)
    h = np.diff(nodes)
    fine = nodes[:-1, None] + h[:, None] * part
    fine[:, -1] = nodes[1:]
    right, left = clip.evaluate(fine[:, :-1]), clip.evaluate(fine[:, -1:], left=True)
    q, v, a = (np.concatenate(pair, axis=1) for pair in zip(right, left, strict=True))
    rows = Motion(*(x.reshape(-1, x.shape[-1]) for x in (q, v, a)))
    size = np.abs(_jerk(clip, nodes, v, a)).reshape(rows.a.shape) if jerk else None
    return Trace(fine.ravel(), rows, size)


def _jerk(clip: Clip, nodes: Array, v: Array, a: Array) -> Array:
    """Jerk (n, parts + 1, nv) on pieces between nodes (n + 1,) from velocities and accelerations."""
    h, parts = np.diff(nodes), a.shape[1] - 1
    jerk = np.einsum("ij,pjd->pid", _slopes(parts), a) / np.maximum(h, 1e-300)[:, None, None]
    real = 1e-9 * (1.0 + np.abs(a).max(initial=0.0))
    jumps = np.abs(a[1:, 0] - a[:-1, -1]) > real
    # only a break is one: elsewhere it is the rounding of short pieces
    jumps &= np.isin(nodes[1:-1], nodes[1:-1][_near(nodes[1:-1], clip.breaks_between(clip.start, clip.end))])[
        :, None
    ]
    jerk[1:, 0][jumps] = jerk[:-1, -1][jumps] = np.inf
    still = 1e-9 * (1.0 + np.abs(v).max(initial=0.0))
    for at in ((0, 0), (-1, -1)):  # out of rest, and into it
        jerk[at][(np.abs(v[at]) <= still) & (np.abs(a[at]) > real)] = np.inf
    return np.asarray(jerk)


def _near(t: Array, breaks: Array) -> NDArray[np.bool_]:
    """Which of ascending times t (n,) are breaks, up to rounding."""
    if not len(breaks):
        return np.zeros(len(t), dtype=bool)
    k = np.clip(np.searchsorted(breaks, t), 1, len(breaks) - 1) if len(breaks) > 1 else np.zeros(len(t), int)
    gap = np.minimum(np.abs(t - breaks[k]), np.abs(t - breaks[np.maximum(k - 1, 0)]))
    return np.asarray(gap <= 1e-12 * max(1.0, float(np.abs(breaks).max())))


def _slopes(parts: int) -> Array:
    """Weights (parts + 1, parts + 1) of values at even points of [0, 1] in the slopes there of the cubics
    through the nearest four (all, where there are fewer)."""
    x, out = np.linspace(0.0, 1.0, parts + 1), np.zeros((parts + 1, parts + 1))
    many = min(4, parts + 1)
    for i in range(parts + 1):
        k = min(max(i - 1, 0), parts + 1 - many)
        powers = np.vander(x[k : k + many] - x[i], increasing=True)
        out[i, k : k + many] = np.linalg.inv(powers)[1]
    return out


def knots(clip: Clip) -> Array:
    """Times of a clip where any derivative may jump, those of the first turn of loops."""
    inner = [curve.knots for track in clip.tracks.values() for curve in curves_of(track)]
    every = np.concatenate([*inner, clip.breaks_between(clip.start, clip.end), [clip.start, clip.end]])
    return np.unique(every[(every >= clip.start) & (every <= clip.end)])


def curves_of(track: Track) -> tuple[Curve, ...]:
    """The curves of a track: two where a free joint has both keyed."""
    if isinstance(track, FreeTrack):
        return tuple(c for c in (track.position, track.rotation) if c is not None)
    return (track,)


def report(
    trace: Trace, machine: Machine, *, keyed: NDArray[np.bool_] | None = None, need: Array | None = None
) -> Report:
    """Compare rows of motion with a machine; see :func:`shares`."""
    every = [_worst(trace.t, use) for use in shares(trace, machine, keyed=keyed, need=need)]
    every.sort(key=lambda v: -v.share)
    found = tuple(v for v in every if v.share > 1.0 + 1e-9)
    return Report(found, every[0].share if every else 0.0, trace.t, tuple(every))


def _worst(t: Array, use: Use) -> Violation:
    k = int(np.argmax(use.share))
    limit = float(np.broadcast_to(use.limit, use.share.shape)[k])
    over = np.flatnonzero(use.share > 1.0 + 1e-9)
    ends = (float(t[over[0]]), float(t[over[-1]])) if len(over) else (float(t[k]), float(t[k]))
    return Violation(use.kind, use.who, float(t[k]), float(use.value[k]), limit, float(use.share[k]), *ends)


def shares(
    trace: Trace,
    machine: Machine,
    *,
    keyed: NDArray[np.bool_] | None = None,
    need: Array | None = None,
) -> list[Use]:
    """Every limit of a machine along rows of motion; ``need`` (n, nv) are the joint forces, less contacts.

    Only positions of the freedoms ``keyed`` (nv,), and forces missing there, are judged (default: all).
    """
    out: list[Use] = []
    m, motion = machine.model, trace.motion
    if need is None and machine.asks_forces:
        need = forces(motion, machine)
    keyed = np.ones(m.nv, dtype=bool) if keyed is None else keyed
    for dof, who in enumerate(dof_names(m)):
        low, high = machine.low[dof], machine.high[dof]
        if np.isfinite(high - low) and keyed[dof]:
            q = motion.q[:, m.jnt_qposadr[m.dof_jntid[dof]]]
            beyond = np.maximum(low - q, q - high)
            out.append(Use("position", who, beyond, 0.0, 1.0 + beyond / max(high - low, 1e-12)))
        rates = (
            ("velocity", motion.v, machine.velocity),
            ("acceleration", motion.a, machine.acceleration),
            ("jerk", trace.jerk, machine.jerk),
        )
        for kind, values, limits in rates:
            if np.isfinite(limits[dof]) and values is not None:
                size = np.abs(values[:, dof])
                out.append(Use(kind, who, size, float(limits[dof]), size / limits[dof]))
        if need is not None:
            out += _pushes(who, dof, need, motion.v[:, dof], machine, keyed[dof])
    if need is not None and np.isfinite(machine.current):
        draw = np.abs(np.where(machine.driven, need, 0.0)) @ machine.ampere
        out.append(Use("current", "battery", draw, machine.current, draw / machine.current))
    return out


def _pushes(who: str, dof: int, need: Array, v: Array, machine: Machine, keyed: bool) -> list[Use]:
    """What a freedom's force asks of its drive, or of nothing."""
    if machine.driven[dof]:
        return _force(who, dof, need[:, dof], v, machine)
    if not keyed:
        return []
    most = max(float(np.abs(need).max(initial=0.0)), 1e-12)
    size = np.abs(need[:, dof])
    over = np.where(size > 1e-9 * most, size / most, 0.0)
    return [Use(MISSING, who, size, 0.0, np.where(over > 0, 1.0 + over, 0.0))]


def by_piece(machine: Machine, t: Array, clip: Clip) -> Array:
    """Largest share (n,) of a limit in use on each piece between times t (n + 1,)."""
    out = np.zeros(len(t) - 1)
    for use in shares(follow(clip, t, jerk=machine.asks_jerk), machine, keyed=clip.dofs):
        if use.kind != "position":
            out = np.maximum(out, use.share.reshape(len(out), -1).max(axis=1))
    return out


def forces(motion: Motion, machine: Machine) -> Array:
    """Joint forces (n, nv) that rows of motion need, with what overcomes dry friction.

    Friction opposes motion, and where a freedom rests it bears what it can. Where nothing drives a freedom
    it is the one smoothed below the machine's ``width``: no force of a drive is there to make up for a jump.
    """
    tau, f = rigid(motion, machine), machine.friction
    if not f.any():
        return tau
    v = motion.v
    rests = np.abs(v) <= 1e-9 * (1.0 + np.abs(v).max(initial=0.0))
    sliding = np.where(machine.driven, np.sign(v), v / np.sqrt(v**2 + machine.width**2))
    return np.asarray(tau + np.where(rests, -np.clip(tau, -f, f), f * sliding))


def rigid(motion: Motion, machine: Machine) -> Array:
    """Joint forces (n, nv) that rows of motion need but for dry friction."""
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
