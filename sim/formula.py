"""Control laws as expressions, which an engine puts into its machine code: its loop then needs no Python."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from .compile.graph import Scalar

if TYPE_CHECKING:
    from .control import Target
    from .engines.interface import Array

Symbols: TypeAlias = Sequence[Scalar]
Expressed: TypeAlias = tuple[list[Scalar], Symbols]
"""Forces tau (nv), of which those of tracked freedoms count, and the new memory."""


def _nothing(memory: Any) -> Array:
    return np.zeros(0)


def _forgets(t: float, packed: Array) -> None:
    return None


@dataclass(frozen=True, eq=False)
class Formula:
    """A law as an expression: the forces that the law itself gives, to rounding, at ticks of its period.

    Attributes:
        key: tells different expressions apart; gains, rows and memory are arguments and no part of it.
        gains: numbers that stay (ng,).
        width: of a row.
        rows: numbers of the ticks ``first``, ``first + 1``, ... with these targets: (n, width).
        express: of q (nq), v (nv), a row, gains and memory: forces and the new memory.
        pack: the law's memory as numbers.
        unpack: its memory at time t [s], that of the last tick, from numbers.
    """

    key: str
    gains: Array
    width: int
    rows: Callable[[int, Target], Array]
    express: Callable[[Symbols, Symbols, Symbols, Symbols, Symbols], Expressed]
    pack: Callable[[Any], Array] = _nothing
    unpack: Callable[[float, Array], Any] = _forgets
