"""What inputs reach and outputs show: controllability and what is lost without it, by names of joints.

The staircase form splits off what no input reaches (P. Van Dooren, IEEE Trans. Automatic Control 26, 1981).
It needs no poles: repeated ones are no matter.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from .analysis import Mode, mode_of
from .linear import LinearSystem

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]
_RANK = 1e-9  # singular values below this fraction of the largest count as zero
_SPLIT = 30.0  # times the root of rounding errors: poles nearer than that are one that rounding splits
_PART = 1e-6  # joints that move less than this part of the one that moves most take no part
_FREEDOMS = ("x", "y", "z", "rx", "ry", "rz")  # of joints with several, as `dof_names` calls them


def unsteerable_modes(
    A: Array,
    B: Array,
    *,
    discrete: bool = False,
    period: float | None = None,
    states: tuple[str, ...] = (),
    inputs: tuple[str, ...] = (),
) -> tuple[Mode, ...]:
    """Modes that no input moves. With names of ``states`` each says which take part.

    What moves in such a mode is settled up to what inputs reach: of all motions the one is named in which the
    joints that ``inputs`` are called after move least; without these names, the one that needs least of them.
    """
    sampled = discrete or period is not None
    W = _beyond(A, B, sampled)
    driven = np.array([name.removesuffix(" rate") in inputs for name in states], dtype=bool)

    def motion(Q: Complex, T: Complex) -> Complex:
        return _motion(A, B, W, Q, T, driven if driven.any() else None)

    return _modes(W.T @ A @ W, motion, sampled, period, states)


def hidden_modes(
    A: Array,
    C: Array,
    *,
    discrete: bool = False,
    period: float | None = None,
    states: tuple[str, ...] = (),
) -> tuple[Mode, ...]:
    """Modes that no output C x shows: what the dual system's inputs do not reach."""
    sampled = discrete or period is not None
    W = _beyond(A.T, C.T, sampled)
    return _modes(W.T @ A @ W, lambda Q, _: W @ Q, sampled, period, states)


def _beyond(A: Array, B: Array, sampled: bool) -> Array:
    """Orthonormal rows' combinations W (n, k) that no input moves: W'A = (W'A W) W', W'B = 0."""
    A = A - np.eye(len(A)) if sampled else A  # reaches as much, and short periods hide nothing
    scale = max(float(np.linalg.norm(A, 2)), 1e-300)
    A, W = A / scale, np.eye(len(A))
    left = B / max(float(np.linalg.norm(B, 2)), 1e-300)
    while len(A):
        u, sizes, _ = np.linalg.svd(left)
        reached = int((sizes > _RANK).sum())
        if not reached:
            break
        A, W = u.T @ A @ u, (W @ u)[:, reached:]
        left, A = A[reached:, :reached], A[reached:, reached:]
    return W


def _modes(
    A: Array,
    motion: Callable[[Complex, Complex], Complex],
    sampled: bool,
    period: float | None,
    states: tuple[str, ...],
) -> tuple[Mode, ...]:
    """Modes of ``A``, equal poles as one; ``motion`` gives what moves in an invariant subspace A Q = Q T."""
    poles, out = np.asarray(linalg.eigvals(A), dtype=complex) if len(A) else np.zeros(0, dtype=complex), []
    size = float(np.linalg.norm(A - np.eye(len(A)) if sampled else A, 2)) if len(A) else 0.0
    near = _SPLIT * np.sqrt(np.finfo(float).eps * max(size, 1e-9))
    left = sorted(poles, key=lambda p: (round(abs(p) / near), p.real, p.imag))
    while left:
        group = [left[0]]
        for pole in group:  # which grows: neighbours of neighbours are the same
            close = [p for p in left if p not in group and abs(p - pole) <= near]
            group += close
        members = [p for p in left if p in group]
        left = [p for p in left if p not in group]
        mean, rest = complex(np.mean(members)), 1.0 if sampled else 0.0
        mean = complex(mean.real) if abs(mean.imag) <= near else mean
        mode = mode_of(rest if abs(mean - rest) <= near else mean, discrete=sampled, period=period)
        if states:
            inside = set(members)
            T, Q, kept = linalg.schur(
                A.astype(complex),
                output="complex",
                sort=lambda p, c=inside: min(abs(p - o) for o in c) <= near,
            )
            mode = replace(mode, of=_named(motion(Q[:, :kept], T[:kept, :kept]), states))
        out += [mode] * len(members)
    return tuple(out)


def _motion(
    A: Array, B: Array, W: Array, Q: Complex, T: Complex, driven: NDArray[np.bool_] | None
) -> Complex:
    """V (n, k) with A V + B U = V T and W'V = Q in which the states ``driven`` (n,) move least, or, without
    these, inputs U do least; then everything else."""
    n, m = B.shape
    unit = B / max(float(np.linalg.norm(B, 2)), 1e-300) * max(float(np.linalg.norm(A, 2)), 1e-300)
    free, cost = np.zeros((len(W.T), m)), np.full(n + m, 1e-6)
    if driven is None:
        cost[n:] = 1.0
    else:
        cost[:n][driven], cost[n:] = 1.0, 0.0
    columns: list[Complex] = []
    for j in range(Q.shape[1]):
        rest = sum((T[i, j] * columns[i] for i in range(j)), np.zeros(n, dtype=complex))
        rows = np.block([[A - T[j, j] * np.eye(n), unit], [W.T, free]])
        u, sizes, right = np.linalg.svd(rows)
        # of full rank n by construction: the rows of W'(A - t) are combinations of those of W'
        x = right[:n].conj().T @ ((u[:, :n].conj().T @ np.concatenate([rest, Q[:, j]])) / sizes[:n])
        open_ways = right[n:].conj().T
        y = np.linalg.lstsq(cost[:, None] * open_ways, -cost * x, rcond=None)[0]
        columns.append((x + open_ways @ y)[:n])
    return np.column_stack(columns)


def _named(V: Complex, states: tuple[str, ...], most: int = 8) -> str:
    """The joints that move in V (n, k), positions and rates as one; of all its freedoms, a joint's name."""
    moves: dict[str, float] = {}
    for name, row in zip(states, V, strict=True):
        joint = name.removesuffix(" rate")
        moves[joint] = max(moves.get(joint, 0.0), float(np.linalg.norm(row)))
    top = max(moves.values())
    taking = [name for name, size in moves.items() if size > _PART * top]
    out: dict[str, None] = {}
    for name in taking:
        joint, dot, freedom = name.rpartition(".")
        whole = [n for n in moves if dot and freedom in _FREEDOMS and n.rpartition(".")[0] == joint]
        out[joint if whole and all(n in taking for n in whole) else name] = None
    names = list(out)
    return ", ".join(names if len(names) <= most else [*names[:most], f"{len(names) - most} more"])


@dataclass(frozen=True)
class Verdict:
    """Whether a property holds, the modes it fails for, and a sentence."""

    holds: bool
    modes: tuple[Mode, ...]
    says: str

    def __bool__(self) -> bool:
        return self.holds


def controllability(system: LinearSystem) -> Verdict:
    """Whether the inputs can move every mode."""
    by = ", ".join(system.inputs)
    return _verdict(
        "controllable", f" by {by}", _stuck(system), f"not controllable by {by}: they cannot move "
    )


def stabilisability(system: LinearSystem) -> Verdict:
    """Whether the inputs can move every mode that does not die out by itself."""
    stuck = _stuck(system)
    more = ": what no input moves dies out" if stuck else ""
    return _verdict("stabilisable", more, _lasting(stuck), "not stabilisable: no input moves ")


def observability(system: LinearSystem, C: ArrayLike) -> Verdict:
    """Whether outputs C x (o, n) show every mode."""
    unseen = hidden_modes(system.A, np.asarray(C, dtype=float), period=system.period, states=system.states)
    return _verdict("observable", "", unseen, "not observable: nothing measured shows ")


def detectability(system: LinearSystem, C: ArrayLike) -> Verdict:
    """Whether outputs C x (o, n) show every mode that does not die out by itself."""
    unseen = hidden_modes(system.A, np.asarray(C, dtype=float), period=system.period, states=system.states)
    more = ": what nothing shows dies out" if unseen else ""
    return _verdict("detectable", more, _lasting(unseen), "not detectable: nothing measured shows ")


def _stuck(system: LinearSystem) -> tuple[Mode, ...]:
    return unsteerable_modes(
        system.A, system.B, period=system.period, states=system.states, inputs=system.inputs
    )


def _lasting(modes: tuple[Mode, ...]) -> tuple[Mode, ...]:
    return tuple(m for m in modes if not m.stable)


def _verdict(word: str, more: str, failing: tuple[Mode, ...], otherwise: str) -> Verdict:
    if not failing:
        return Verdict(True, (), f"{word}{more}")
    groups: dict[str, dict[str, None]] = {}
    for mode in failing:
        if mode.pole.imag >= 0.0:  # one of each pair
            groups.setdefault(mode.of, {})[f"{mode.frequency:.3g}"] = None
    said = "; ".join(f"{of} ({', '.join(rates)} rad/s)" for of, rates in groups.items())
    return Verdict(False, failing, otherwise + said)
