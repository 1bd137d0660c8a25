"""A law's memory as states of the linear loop: what it becomes, and what it does to the forces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class LinearLaw(NamedTuple):
    """u = -K x + C m, m+ = G x + M m for n states x, k numbers m of the memory and their ``names``."""

    K: Array
    C: Array
    G: Array
    M: Array
    names: tuple[str, ...]


def linear_law(
    law: Callable[[Array, Any], tuple[Array, Any]],
    memory: Any,
    n: int,
    step: float,
    freedoms: Sequence[str] = (),
) -> LinearLaw:
    """Derivatives of ``law`` (x (n,), memory) -> (u, memory) about x = 0 and ``memory``, by centred
    differences of ``step``.

    Of the memory those numbers are kept that x moves, and that move u; ``freedoms`` name entries of arrays
    with one a freedom.
    """
    m = numbers(memory)
    k = len(m)

    def out(d: Array) -> tuple[Array, Array]:
        u, after = law(d[:n], with_numbers(memory, m + d[n:]))
        return u, numbers(after)[:k] if k else np.zeros(0)

    columns = []
    for unit in step * np.eye(n + k):
        pairs = zip(out(unit), out(-unit), strict=True)
        columns.append([(plus - minus) / (2.0 * step) for plus, minus in pairs])
    by_u, by_m = (np.column_stack([column[i] for column in columns]) for i in (0, 1))
    C, G, M = by_u[:, n:], by_m[:, :n], by_m[:, n:]
    moved, seen = (G != 0.0).any(axis=1), (C != 0.0).any(axis=0)
    for _ in range(k):
        moved, seen = moved | (M != 0.0) @ moved, seen | (M != 0.0).T @ seen
    kept = np.flatnonzero(moved & seen)
    names = names_of_numbers(memory, freedoms)
    return LinearLaw(-by_u[:, :n], C[:, kept], G[kept], M[np.ix_(kept, kept)], tuple(names[i] for i in kept))


def numbers(memory: Any) -> Array:
    """All floating-point numbers of a memory made of tuples and arrays, in order."""
    if isinstance(memory, tuple):
        return np.concatenate([np.zeros(0), *map(numbers, memory)])
    if isinstance(memory, float):
        return np.array([memory])
    return memory.ravel() if _counts(memory) else np.zeros(0)


def with_numbers(memory: Any, values: Array) -> Any:
    """``memory`` with other numbers in it."""
    if isinstance(memory, tuple):
        parts, at = [], 0
        for part in memory:
            size = len(numbers(part))
            parts.append(with_numbers(part, values[at : at + size]))
            at += size
        return type(memory)(*parts) if hasattr(memory, "_fields") else tuple(parts)
    if isinstance(memory, float):
        return float(values[0])
    return values.reshape(memory.shape) if _counts(memory) else memory


def names_of_numbers(memory: Any, freedoms: Sequence[str], path: str = "") -> list[str]:
    """What the numbers of a memory are called: fields, and freedoms or places in arrays."""
    if isinstance(memory, tuple):
        fields = getattr(memory, "_fields", range(len(memory)))
        return [
            name
            for field, part in zip(fields, memory, strict=True)
            for name in names_of_numbers(part, freedoms, f"{path} {field}".strip())
        ]
    if isinstance(memory, float):
        return [path]
    if not _counts(memory):
        return []
    labels = freedoms if len(freedoms) == memory.size else range(memory.size)
    return [f"{path} {label}" for label in labels]


def _counts(x: Any) -> bool:
    return isinstance(x, np.ndarray) and x.dtype == np.float64
