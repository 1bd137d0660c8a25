"""Retiming of a whole clip by the length of its path: stretch by stretch, from stop to stop, pauses kept."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ....sim.clip import Clip
from ..charts import Charts
from ..check import by_piece
from ..machine import Machine
from .bounded import Timed, fastest, motion
from .grid import Grid
from .path import Corner, Measure, corners, even_nodes, measure, path, reversals, slowest, stretches

Array = NDArray[np.float64]
_ROUNDS, _NEAR = 6, 1.002  # of cutting pieces, until limits hold to this between nodes
_MOST = 4  # times as many pieces as at first


class Smooth(NamedTuple):
    """``at`` a slowdown, times and clip of the fastest timing; the old times ``s`` of those, and corners."""

    at: Callable[[float], tuple[Array, Clip]]
    s: Array
    corners: list[Corner]


class _Stretch(NamedTuple):
    """Times of the clip, speeds of its path at both ends, and how it is measured; None for a pause."""

    nodes: Array
    ends: tuple[float, float]
    by: Measure | None


class _Nodes(NamedTuple):
    """Old and new times (n + 1,), q and v there, accelerations (n, nv) at both ends of the pieces."""

    s: Array
    t: Array
    q: Array
    v: Array
    a0: Array
    a1: Array


def smooth(
    clip: Clip, machine: Machine, grid: Grid, x: Array, *, keep: bool, ends: tuple[bool, bool], points: int
) -> Smooth:
    """The fastest timing, with bounded jerk or without.

    ``x`` (n + 1,) is the squared rate of the timing without a limit on jerk. Pieces on which a limit is
    exceeded are halved. Raises PantographError where no timing is found.
    """
    pauses = grid.pauses()
    found = corners(clip, np.isfinite(machine.jerk) & clip.dofs, pauses, keep=keep)
    # a program of many variables, or two passes
    points = points // 8 if np.isfinite(machine.jerk[clip.dofs]).any() else points
    rows = _stretches(clip, machine, found, pauses, x, ends, points)
    back = [c.s for c in found if c.back]
    most = _MOST * sum(len(row.nodes) for row in rows)
    known: list[Timed | None] = [None] * len(rows)
    for _ in range(_ROUNDS):
        known = [_timed(clip, machine, grid, *pair, back, keep) for pair in zip(rows, known, strict=True)]
        now = _stitched(clip, machine, rows, known)
        at = _quintics(clip, now)
        long = np.diff(now.t) > 1e-4 * now.t[-1]
        coarse = now.s[:-1][(by_piece(machine, *at(1.0)) > _NEAR) & long]
        if not len(coarse) or len(now.s) + len(coarse) > most:
            break
        rows = [row if row.by is None else row._replace(nodes=_halved(row.nodes, coarse)) for row in rows]
    return Smooth(at, now.s, found)


def _stretches(
    clip: Clip,
    machine: Machine,
    found: list[Corner],
    pauses: list[tuple[float, float]],
    x: Array,
    rests: tuple[bool, bool],
    points: int,
) -> list[_Stretch]:
    parts, turns = stretches(clip, found, pauses), reversals(clip, machine.rubs)
    slow = slowest(clip)
    total = sum(b - a for a, b, moves in parts if moves)
    ends = clip.evaluate(clip.start).v, clip.evaluate(clip.end, left=True).v
    first, last = (float(np.sqrt(x[k]) * np.linalg.norm(ends[k])) for k in (0, -1))
    rows = []
    for a, b, moves in parts:
        if not moves:
            rows.append(_Stretch(np.array([a, b]), (0.0, 0.0), None))
            continue
        speeds = (
            0.0 if rests[0] or a > clip.start else first,
            0.0 if rests[1] or b < clip.end else last,
        )
        many = max(24, round(points * (b - a) / total))
        by = measure(clip, a, b, found, slow)
        by = by._replace(edges=np.union1d(by.edges, turns[(turns > a) & (turns < b)]))
        rows.append(_Stretch(even_nodes(clip, by, many), speeds, by))
    return rows


def _timed(
    clip: Clip,
    machine: Machine,
    grid: Grid,
    row: _Stretch,
    known: Timed | None,
    back: list[float],
    keep: bool,
) -> Timed | None:
    """The timing of a stretch, from the one ``known`` over fewer nodes; None for a pause."""
    if row.by is None or (known is not None and len(known.along.s) == len(row.nodes)):
        return known
    along = path(clip, row.by, row.nodes, back)
    if np.isfinite(machine.jerk[clip.dofs]).any():
        return fastest(along, machine, grid.rows, known, ends=row.ends, keep=keep)
    mine = Grid(clip, machine, row.nodes, along)
    x = mine.fastest(keep, (row.ends[0] == 0.0, row.ends[1] == 0.0))
    r, u = np.sqrt(x), 0.5 * np.diff(x) / mine.h
    dt = 2.0 * mine.h / np.maximum(r[1:] + r[:-1], 1e-300)
    return Timed(along, np.append(0.0, np.cumsum(dt)), r, u, u)


def _stitched(clip: Clip, machine: Machine, rows: list[_Stretch], known: list[Timed | None]) -> _Nodes:
    """Motion at the nodes of all stretches, one after the other."""
    jerky, nv = np.isfinite(machine.jerk), clip.model.nv
    s, t, q, v = [rows[0].nodes[:1]], [np.zeros(1)], list[Array](), list[Array]()
    a0, a1 = list[Array](), list[Array]()
    for row, timing in zip(rows, known, strict=True):
        if timing is None:
            new, here = row.nodes - row.nodes[0], clip.evaluate(row.nodes).q
            part = (here, np.zeros((2, nv)), np.zeros((1, nv)), np.zeros((1, nv)))
        else:
            new, part = timing.t, motion(clip, timing, jerky)
        first = 1 if q else 0
        s.append(row.nodes[1:])
        t.append(t[-1][-1] + new[1:])
        q.append(part[0][first:])
        v.append(part[1][first:])
        a0.append(part[2])
        a1.append(part[3])
    return _Nodes(*(np.concatenate(x) for x in (s, t, q, v, a0, a1)))


def _quintics(clip: Clip, now: _Nodes) -> Callable[[float], tuple[Array, Clip]]:
    """Times and the clip through motion at nodes, by how much it is slowed."""
    charts = Charts(clip.model)

    def at(slow: float) -> tuple[Array, Clip]:
        t, square = clip.start + now.t * slow, slow**2
        new = charts.clip(t, now.q, now.v / slow, now.a0 / square, now.a1 / square, clip)
        return t, Clip(clip.model, {name: new.tracks[name] for name in clip.tracks}, clip.q0)

    return at


def _halved(nodes: Array, coarse: Array) -> Array:
    """Nodes with middles in the pieces that begin at times ``coarse``."""
    cut = np.isin(nodes[:-1], coarse)
    return np.union1d(nodes, 0.5 * (nodes[1:] + nodes[:-1])[cut])
