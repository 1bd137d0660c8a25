"""The least change that meets limits: a small dense quadratic program, solved in its dual.

min |z|^2 + sum_r s_r^2 / give_r  with  low - s <= M z <= high + s; rows without give are hard. Every such
program with a positive definite cost can be brought to this form by a change of variables. The dual
active-set method starts from z = 0, adds the most violated row and drops those that stop pushing
(D. Goldfarb, A. Idnani, Mathematical Programming 27, 1983); what held before makes a warm start.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...sim.errors import PantographError

Array = NDArray[np.float64]


class Held(NamedTuple):
    """Rows (k,) that hold a solution back, and which way they push (k,): -1 at ``high``, 1 at ``low``."""

    rows: NDArray[np.intp]
    signs: Array


NOTHING = Held(np.zeros(0, dtype=np.intp), np.zeros(0))


def least_change(
    M: Array, low: Array, high: Array, give: Array, before: Held = NOTHING, *, tolerance: float = 1e-10
) -> tuple[Array, Held, int]:
    """z (n,), what holds it back, and how many rows were added or dropped on the way.

    M (r, n); ``low`` <= ``high`` (r,), infinite where there is no limit; ``give`` (r,) >= 0: softness of a
    row; ``before``: a guess of what will hold. Violations up to ``tolerance`` relative to the row count as
    none. Raises PantographError when hard rows contradict each other.
    """
    size = np.sqrt(np.einsum("ij,ij->i", M, M) + give) + 1e-300
    held, push = _warm(M, low, high, give, before)
    for steps in range(20 * len(M) + 1):
        z = M[held.rows].T @ (held.signs * push)
        bend = np.zeros(len(M))
        bend[held.rows] = give[held.rows] * held.signs * push
        at = M @ z + bend
        over, under = (at - high) / size, (low - at) / size
        over[held.rows] = under[held.rows] = -np.inf
        worst_over, worst_under = int(np.argmax(over)), int(np.argmax(under))
        row, sign = (worst_over, -1.0) if over[worst_over] >= under[worst_under] else (worst_under, 1.0)
        bound = high[row] if sign < 0 else low[row]
        wrong = sign * (bound - at[row])
        if wrong <= tolerance * (size[row] + abs(bound)):
            return z, held, steps
        held, push = _add(M, give, held, push, row, sign, wrong)
    raise PantographError("limits of the prediction cannot be met together within the steps allowed")


def _add(
    M: Array, give: Array, held: Held, push: Array, row: int, sign: float, wrong: float
) -> tuple[Held, Array]:
    """The rows that hold, with ``row`` among them, whose limit is violated by ``wrong`` without it."""
    pushed = 0.0
    while True:
        N = held.signs[:, None] * M[held.rows]
        normal = sign * M[row]
        gram = N @ N.T + np.diag(give[held.rows])
        cross = N @ normal
        back = np.linalg.solve(gram, cross) if len(cross) else cross
        own = normal @ normal + give[row]
        curve = own - cross @ back
        full = wrong / curve if curve > 1e-12 * own else np.inf
        with np.errstate(divide="ignore"):
            drop = np.where(back > 0.0, push / np.where(back > 0.0, back, 1.0), np.inf)
        first = int(np.argmin(drop)) if len(drop) else -1
        step = min(full, drop[first] if len(drop) else np.inf)
        if not np.isfinite(step):
            raise PantographError("limits of the prediction contradict each other")
        push, pushed = push - step * back, pushed + step
        if step == full:
            return Held(np.append(held.rows, row), np.append(held.signs, sign)), np.append(push, pushed)
        wrong -= step * curve
        held = Held(np.delete(held.rows, first), np.delete(held.signs, first))
        push = np.delete(push, first)


def _warm(M: Array, low: Array, high: Array, give: Array, held: Held) -> tuple[Held, Array]:
    """Of the rows that held before, those that push the right way together, and how much."""
    finite = np.isfinite(np.where(held.signs < 0.0, high[held.rows], low[held.rows]))
    held = Held(held.rows[finite], held.signs[finite])
    while len(held.rows):
        N = held.signs[:, None] * M[held.rows]
        gram = N @ N.T + np.diag(give[held.rows])
        bound = held.signs * np.where(held.signs < 0.0, high[held.rows], low[held.rows])
        try:
            push = np.asarray(np.linalg.solve(gram, bound), dtype=np.float64)
        except np.linalg.LinAlgError:
            break
        if np.abs(gram @ push - bound).max() > 1e-9 * (1.0 + np.abs(bound).max()):
            break
        if (push >= 0.0).all():
            return held, push
        held = Held(held.rows[push > 0.0], held.signs[push > 0.0])
    return NOTHING, np.zeros(0)
