"""Nodes of a fit: where things change, and closer together where its motion does not hold between them."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ....sim.clip import Clip
from ..contact import Phase
from ..machine import Machine

Array = NDArray[np.float64]
_FINE = 32  # points a piece at which friction is looked at
_LEAST = 1e-5  # s: no piece is cut into shorter ones
_GROWTH = 0.15  # of pieces, by the way from where they are short


def grid(clip: Clip, hard: Sequence[float], phases: Sequence[Phase], step: float) -> Array:
    """Times at most ``step`` [s] apart, each hard key and each begin and end of a contact among them."""
    corners = [clip.start, clip.end, *hard, *(t for p in phases for t in (p.start, p.stop))]
    edges = np.unique(np.clip(corners, clip.start, clip.end))
    edges = edges[np.append(True, np.diff(edges) > 1e-9)]
    pieces = [np.linspace(a, b, int(np.ceil((b - a) / step - 1e-9)) + 1)[:-1] for a, b in pairwise(edges)]
    return np.append(np.concatenate(pieces), edges[-1])


def refined(nodes: Array, missed: Array, clip: Clip, machine: Machine, allowed: float) -> Array:
    """Nodes (n + 1,) with the pieces cut that miss something, ``missed`` (n,) in tolerances, into as many as
    errors of third order ask for, and close together where dry friction turns that nothing drives.

    ``allowed`` is the missing force [N m, N] of one tolerance.
    """
    # half of what is allowed, so that its share of the next round's changes fits in
    cuts = np.clip(np.ceil(np.cbrt(2.0 * missed)), 1, 4)
    t, each = _friction(nodes, clip, machine, 0.5 * allowed)
    h = np.diff(nodes)
    if cuts.max() == 1 and (each > h[:, None]).all():
        cuts[:] = 2  # contacts stray: an error of the whole
    each = np.minimum(_graded(t.ravel(), each.ravel()).reshape(t.shape), (h / cuts)[:, None])
    out = []
    for k, (a, b) in enumerate(pairwise(nodes)):
        many = np.append(0.0, np.cumsum(0.5 * (1.0 / each[k, 1:] + 1.0 / each[k, :-1]) * np.diff(t[k])))
        pieces = min(int(np.ceil(many[-1] - 0.3)), max(int((b - a) / _LEAST), 1))
        out.append(np.interp(np.arange(pieces) * (many[-1] / pieces), many, t[k]))
    return np.append(np.concatenate(out), nodes[-1])


def _graded(t: Array, each: Array) -> Array:
    """Lengths (n,) of pieces at times t (n,) that grow by at most a part of the way: what turns may shift."""
    each = each.copy()
    for order in (1, -1):
        row, way = each[::order], np.abs(np.diff(t))[::order] * _GROWTH
        row[:] = np.minimum.accumulate(row - np.append(0.0, np.cumsum(way))) + np.append(0.0, np.cumsum(way))
    return each


def _friction(nodes: Array, clip: Clip, machine: Machine, allowed: float) -> tuple[Array, Array]:
    """Times (n, points) on pieces, and how long [s] pieces may be there for dry friction without a drive.

    By v = w s it is f g(s), g = s / sqrt(1 + s^2), |g'''| <= 3 (1 + 4 s^2) / (1 + s^2)^3.5; a parabola
    through both ends and the middle of a piece h is off by h^3 / (72 sqrt(3)) of a third derivative.
    """
    t = nodes[:-1, None] + np.diff(nodes)[:, None] * np.linspace(0.0, 1.0, _FINE + 1)
    third = np.zeros(t.shape)
    at = clip.evaluate(t.ravel(), left=True)
    for dof in np.flatnonzero(~machine.driven & (machine.friction > 0)):
        v, a = (x[:, dof].reshape(t.shape) / machine.width for x in (at.v, at.a))
        turns = v[:, 1:] * v[:, :-1] < 0
        v[:, 1:][turns] = v[:, :-1][turns] = 0.0
        bend = 3.0 * (1.0 + 4.0 * v**2) / (1.0 + v**2) ** 3.5
        third = np.maximum(third, machine.friction[dof] * np.abs(a) ** 3 * bend)
    return t, np.cbrt(72.0 * np.sqrt(3.0) * allowed / np.maximum(third, 1e-300))
