"""Retiming with bounded jerk of a whole clip: stretch by stretch, from stop to stop, pauses kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ...sim.clip import Clip, FreeTrack, Motion
from ...sim.errors import PantographError
from .charts import Charts
from .check import shares
from .machine import Machine
from .smooth_timing import even_nodes, fastest, motion, path, stretches

Array = NDArray[np.float64]
_ROUNDS = 3


class Grid(Protocol):
    """What is known of the path: times s (n + 1,), pieces that stand still, and rows of limits."""

    s: Array
    still: NDArray[np.bool_]

    def rows(self, at: Motion) -> tuple[Array, Array, Array, Array]:
        """a, b, c, e (n, rows) of a u + b x + e sqrt(x) <= c."""


class _Stretch(NamedTuple):
    """Times of the clip, speeds of its path at both ends or None for a pause."""

    nodes: Array
    ends: tuple[float, float] | None


def smooth(
    clip: Clip, machine: Machine, grid: Grid, x: Array, *, keep: bool, at_rest: bool, points: int
) -> tuple[Callable[[float], tuple[Array, Clip]], Array]:
    """A function from a slowdown to times and clip of the fastest timing, and the old times of those.

    ``x`` (n + 1,) is the squared rate of the timing without a limit on jerk. Pieces on which a limit is
    exceeded are halved, up to twice. Raises PantographError for free joints, and where no timing is found.
    """
    for name, track in clip.tracks.items():
        if isinstance(track, FreeTrack):
            raise PantographError(f"joint {name!r} is free: no machine moves it along keys")
    parts = stretches(clip, grid.s, grid.still)
    total = sum(b - a for a, b, moves in parts if moves)
    rates = np.sqrt(x[[0, -1]]) * np.linalg.norm(clip.evaluate([clip.start, clip.end], left=False).v, axis=1)
    rates[1] = np.sqrt(x[-1]) * np.linalg.norm(clip.evaluate(clip.end, left=True).v)
    rows = []
    for a, b, moves in parts:
        if not moves:
            rows.append(_Stretch(np.array([a, b]), None))
            continue
        first = 0.0 if at_rest or a > clip.start else float(rates[0])
        last = 0.0 if at_rest or b < clip.end else float(rates[1])
        rows.append(
            _Stretch(even_nodes(clip, a, b, max(24, round(points / 8 * (b - a) / total))), (first, last))
        )
    for _ in range(_ROUNDS):
        s, t, now = _stitched(clip, machine, grid, rows, keep)
        at = _quintics(clip, t, now)
        coarse = s[:-1][_by_piece(machine, *at(1.0)) > 1.005]
        if not len(coarse):
            break
        rows = [row if row.ends is None else row._replace(nodes=_halved(row.nodes, coarse)) for row in rows]
    return at, s


def _stitched(
    clip: Clip, machine: Machine, grid: Grid, rows: list[_Stretch], keep: bool
) -> tuple[Array, Array, Motion]:
    """Old times, new times and motion at the nodes of all stretches, one after the other."""
    times, nodes, moves = [np.zeros(1)], [rows[0].nodes[:1]], list[Motion]()
    for row in rows:
        if row.ends is None:
            t = row.nodes - row.nodes[0]
            now = Motion(clip.evaluate(row.nodes).q, *np.zeros((2, 2, clip.model.nv)))
        else:
            along = path(clip, row.nodes)
            timing = fastest(along, machine, grid.rows, ends=row.ends, keep=keep)
            t, now = timing.t, motion(along, clip, timing)
        moves.append(Motion(*(part[1 if moves else 0 :] for part in now)))
        times.append(times[-1][-1] + t[1:])
        nodes.append(row.nodes[1:])
    joined = Motion(*(np.concatenate(part) for part in zip(*moves, strict=True)))
    return np.concatenate(nodes), np.concatenate(times), joined


def _quintics(clip: Clip, t: Array, now: Motion) -> Callable[[float], tuple[Array, Clip]]:
    """Times and the clip through motion at times t (n,), by how much it is slowed."""
    charts = Charts(clip.model)

    def at(slow: float) -> tuple[Array, Clip]:
        a = now.a / slow**2
        new = charts.clip(t * slow, now.q, now.v / slow, a[:-1], a[1:], clip)
        return t * slow, Clip(clip.model, {name: new.tracks[name] for name in clip.tracks}, clip.q0)

    return at


def _by_piece(machine: Machine, t: Array, clip: Clip) -> Array:
    """Largest share (n,) of a limit in use on each piece between times t (n + 1,)."""
    fine = np.interp(np.arange(10 * (len(t) - 1)) / 10.0, np.arange(len(t)), t)
    out = np.zeros(len(t) - 1)
    for use in shares(fine, clip.evaluate(fine), machine, keyed=clip.dofs):
        if use.kind != "position":
            out = np.maximum(out, use.share.reshape(len(out), 10).max(axis=1))
    return out


def _halved(nodes: Array, coarse: Array) -> Array:
    """Nodes with middles in the pieces that begin at times ``coarse``."""
    cut = np.isin(nodes[:-1], coarse)
    return np.union1d(nodes, 0.5 * (nodes[1:] + nodes[:-1])[cut])
