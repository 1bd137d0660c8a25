"""Arguments of integrations as rows that compiled loops read: states, controls, gains, parameters."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, NamedTuple, TypeAlias, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...compile.program import address
from ...errors import EngineError
from ..laws import GivenLaw, is_law

if TYPE_CHECKING:
    from ..smooth import Smooth

Array = NDArray[np.float64]
PythonLaw: TypeAlias = Callable[[float, Array, Array], ArrayLike]
Controls: TypeAlias = "ArrayLike | GivenLaw | PythonLaw | None"
Prescribed: TypeAlias = "ArrayLike | Callable[[Array], ArrayLike] | None"

NO_MOTION = "keyed joints need their prescribed motion: pass w=(q, v, a) of the keyed joints"


class Start(NamedTuple):
    """A batch of initial states as rows, and whether it was asked for as one state."""

    x: Array
    single: bool


def initial_states(smooth: Smooth, q0: ArrayLike, v0: ArrayLike, act0: ArrayLike | None) -> Start:
    """Rows (q, v, act); what is given once serves the whole batch."""
    lay = smooth.layout
    q, v = np.asarray(q0, dtype=float), np.asarray(v0, dtype=float)
    if act0 is None and q.shape == (lay.nq,) and v.shape == (lay.nv,):
        x = np.zeros((1, lay.nx))
        x[0, : lay.nq], x[0, lay.nq : lay.nq + lay.nv] = q, v
        return Start(x, True)
    parts = []
    for name, value, size in (("q0", q, lay.nq), ("v0", v, lay.nv), ("act0", act0, lay.na)):
        if value is None and not size:
            continue
        array = np.zeros(size) if value is None else np.asarray(value, dtype=float)
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise EngineError(f"{name} has shape {array.shape}; expected ({size},) or (batch, {size})")
        parts.append(array)
    counts = {len(part) for part in parts if part.ndim == 2}
    if not counts:
        return Start(np.concatenate(parts)[None], True)
    if len(counts) > 1:
        raise EngineError(f"q0, v0, act0 are batches of different lengths: {sorted(counts)}")
    count = counts.pop()
    rows = [np.broadcast_to(part, (count, part.shape[-1])) for part in parts]
    return Start(np.ascontiguousarray(np.concatenate(rows, axis=1)), False)


class Rows:
    """Rows of an array for a compiled loop: address, and strides in doubles between states and rows."""

    __slots__ = ("array", "per_row", "per_state", "place", "table")

    def __init__(self, array: Array, per_state: int = 0, per_row: int = 0):
        self.array, self.per_state, self.per_row, self.place = array, per_state, per_row, address(array)
        self.table = array[(None,) * (3 - array.ndim)]

    def at(self, state: int) -> int:
        """Address of the rows of a state."""
        return self.place + 8 * state * self.per_state

    def shown(self, count: int) -> Array:
        """The rows as a result of `count` states."""
        return self.table if count == 1 else np.broadcast_to(self.table, (count, *self.table.shape[1:]))


NOTHING = Rows(np.zeros(0))


def rows_of(name: str, value: ArrayLike, width: int, rows: int, count: int) -> Rows:
    """`value` of shape (width,), (rows, width) or (count, rows, width) as strided rows."""
    array = np.ascontiguousarray(value, dtype=float)
    shapes = ((width,), (rows, width), (count, rows, width))
    if array.shape not in shapes:
        listing = ", ".join(map(str, shapes))
        raise EngineError(f"{name} has shape {array.shape}; expected one of {listing}")
    return Rows(array, rows * width if array.ndim == 3 else 0, 0 if array.ndim == 1 else width)


def per_state(name: str, value: ArrayLike, width: int, count: int) -> Rows:
    """`value` of shape (width,) or (count, width)."""
    array = np.ascontiguousarray(value, dtype=float)
    if array.shape not in ((width,), (count, width)):
        raise EngineError(f"{name} has shape {array.shape}; expected ({width},) or ({count}, {width})")
    return Rows(array, width if array.ndim == 2 else 0)


def control_rows(
    smooth: Smooth, controls: Controls, periods: int, count: int
) -> tuple[GivenLaw | None, Rows, Rows]:
    """The compiled law if there is one, its rows (or the controls themselves), and its gains."""
    if controls is None:
        return None, smooth.still, NOTHING
    lay = smooth.layout
    if is_law(controls):
        home = smooth.model.qpos0[lay.q_free]
        references = controls.references(lay, home, periods)
        gains = controls.gains()
        rows = rows_of("references", references, references.shape[-1], periods, count)
        return controls, rows, per_state("K", gains, gains.shape[-1], count)
    held = cast("ArrayLike", controls)
    return None, rows_of("controls", held, lay.nu, periods, count), NOTHING


def parameter_rows(smooth: Smooth, p: ArrayLike | None, count: int) -> Rows:
    """The parameters, the model's own by default."""
    return smooth.own_parameters if p is None else per_state("p", p, len(smooth.parameters), count)


def prescribed_rows(smooth: Smooth, w: Prescribed, times: Callable[[], Array], count: int) -> Rows:
    """Rows of the prescribed motion at `times`."""
    size = smooth.layout.nw
    if w is None:
        if size:
            raise EngineError(NO_MOTION)
        return NOTHING
    at = times()
    return rows_of("w", w(at) if callable(w) else w, size, len(at), count)
