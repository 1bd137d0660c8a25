"""Searches side by side in SIMD lanes, whole in machine code: the first lane that meets the target ends it.

Lane 0 starts at the given seed, the others at rows of a table of random configurations. A lane that has not
come nearer for a while takes the next row; when no more may be taken it rests, and when all rest it is over.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...compile import jit
from ...compile.cache import Cache, default_folder, key_of
from ...compile.kernels import kernel
from ...compile.llvm import Emitter, declarations, double
from ...compile.loops import declare, function
from ...compile.program import address, facts_of, obtain
from .step import Chain, step_tape

Array = NDArray[np.float64]
_ROWS = 4096
_PATIENCE = 6.0  # iterations without progress that end a lane's attempt
_PROGRESS = 0.95
_ENDLESS = 2**62


class Raced(NamedTuple):
    """Configurations q (k, n), whether each meets its target, iterations of all lanes spent on it, and how
    many rows of the table were started from."""

    q: Array
    met: NDArray[np.bool_]
    iterations: NDArray[np.int64]
    starts: NDArray[np.int64]


def race_loop(chain: Chain, lanes: int) -> str:
    """IR of `void race(i64 k, seeds, targets, table, i64 rows, i64 limit, i64 most, q, counts)`.

    Over k targets; for each at most `limit` rows of the table, from its start again after its end, and `most`
    iterations. `counts` (2, k) gets that of iterations, negative when the target was not met, and of rows.
    """
    e = Emitter(lanes)
    n = chain.n
    Q, N, T, ERR = (e.slot(size) for size in (n, n, 14, 1))
    BEST, STALL = e.slot(1), e.slot(1)
    NEXT, COUNT, LIVE = (e.slot(1, "i64") for _ in range(3))
    few = e.emit(f"icmp slt i64 %limit, {lanes - 1}")
    first = e.emit(f"select i1 {few}, i64 %limit, i64 {lanes - 1}")
    with e.loop("%k") as at:
        seed = e.element("%seeds", e.emit(f"mul nsw i64 {at}, {n}"), "double")
        target = e.element("%targets", e.emit(f"mul nsw i64 {at}, 14"), "double")
        result = e.element("%q", e.emit(f"mul nsw i64 {at}, {n}"), "double")
        with e.loop(14) as i:
            x = e.emit(f"load double, ptr {e.element(target, i, 'double')}, align 8")
            e.store(e.splat(x), T, i)
        e.store(e.const(1e300), BEST, 0)
        e.store(e.const(0.0), STALL, 0)
        _fill(e, seed, Q, 0, n)
        for lane in range(1, lanes):
            has = e.emit(f"icmp slt i64 {lane - 1}, %limit")
            row = e.element("%table", (lane - 1) * n, "double")
            _fill(e, e.emit(f"select i1 {has}, ptr {row}, ptr {seed}"), Q, lane, n)
        with e.when(few), e.loop(lanes) as i, e.when(e.emit(f"icmp sgt i64 {i}, %limit")):
            _rest(e, i, BEST, STALL)
        e.do(f"store i64 {first}, ptr {NEXT}")
        e.do(f"store i64 {e.emit(f'add nsw i64 {first}, 1')}, ptr {LIVE}")
        _until_met(e, lanes, n, (Q, N, T, ERR, BEST, STALL, NEXT, COUNT, LIVE), result)
        for slot, index in ((COUNT, at), (NEXT, e.emit(f"add nsw i64 {at}, %k"))):
            e.do(f"store i64 {e.emit(f'load i64, ptr {slot}')}, ptr {e.element('%counts', index, 'i64')}")
    arguments = ["i64 %k", "ptr noalias %seeds", "ptr noalias %targets", "ptr noalias %table", "i64 %rows",
                 "i64 %limit", "i64 %most", "ptr noalias %q", "ptr noalias %counts"]  # fmt: skip
    return function("race", arguments, e)


def _fill(e: Emitter, row: str, Q: str, lane: int | str, n: int) -> None:
    """A row of n doubles into one lane of the buffer Q."""
    with e.loop(n) as i:
        x = e.emit(f"load double, ptr {e.element(row, i, 'double')}, align 8")
        e.do(f"store double {x}, ptr {e.element(e.element(Q, i), lane, 'double')}, align 8")


def _until_met(e: Emitter, lanes: int, n: int, buffers: tuple[str, ...], result: str) -> None:
    """The iterations of one target: step, look for a lane that met it, restart lanes that stall."""
    Q, N, T, ERR, BEST, STALL, NEXT, COUNT, LIVE = buffers
    name = e.fresh()[1:]
    e.do(f"br label %{name}.entry")
    e.lines.append(f"{name}.entry:")
    e.do(f"br label %{name}.body")
    e.lines.append(f"{name}.body:")
    i = f"%{name}.i"
    e.do(f"{i} = phi i64 [0, %{name}.entry], [%{name}.next, %{name}.again]")
    e.do(f"call void @f(ptr {Q}, ptr {T}, ptr {N}, ptr {ERR})")
    error = e.load(ERR, 0)
    met = e.compare("ole", error, e.const(1.0))
    bits = e.emit(f"bitcast {e.B} {met} to i{lanes}")
    e.do(f"%{name}.any = icmp ne i{lanes} {bits}, 0")
    e.do(f"br i1 %{name}.any, label %{name}.met, label %{name}.go")
    e.lines.append(f"{name}.go:")
    best, stall = e.load(BEST, 0), e.load(STALL, 0)
    nearer = e.compare("olt", error, e.f("fmul", best, e.const(_PROGRESS)))
    e.store(e.select(nearer, error, best), BEST, 0)
    stalled = e.select(nearer, e.const(0.0), e.f("fadd", stall, e.const(1.0)))
    e.store(stalled, STALL, 0)
    with e.loop(n) as k:
        e.store(e.load(N, k), Q, k)
    tired = e.compare("ogt", stalled, e.const(_PATIENCE))
    tired_bits = e.emit(f"bitcast {e.B} {tired} to i{lanes}")
    with e.when(e.emit(f"icmp ne i{lanes} {tired_bits}, 0")), e.loop(lanes) as lane:
        shift = e.emit(f"trunc i64 {lane} to i{lanes}")
        bit = e.emit(f"trunc i{lanes} {e.emit(f'lshr i{lanes} {tired_bits}, {shift}')} to i1")
        with e.when(bit):
            _restart(e, lane, n, Q, BEST, STALL, NEXT, LIVE)
    e.do(f"%{name}.next = add nsw i64 {i}, 1")
    e.do(f"%{name}.some = icmp sgt i64 {e.emit(f'load i64, ptr {LIVE}')}, 0")
    e.do(f"%{name}.few = icmp slt i64 %{name}.next, %most")
    e.do(f"%{name}.more = and i1 %{name}.some, %{name}.few")
    e.do(f"br i1 %{name}.more, label %{name}.again, label %{name}.failed")
    e.lines.append(f"{name}.again:")
    e.do(f"br label %{name}.body")
    e.lines.append(f"{name}.met:")
    first = e.emit(f"call i{lanes} @llvm.cttz.i{lanes}(i{lanes} {bits}, i1 false)")
    lane = e.emit(f"zext i{lanes} {first} to i64")
    with e.loop(n) as k:
        x = e.emit(f"load double, ptr {e.element(e.element(Q, k), lane, 'double')}, align 8")
        e.do(f"store double {x}, ptr {e.element(result, k, 'double')}, align 8")
    e.do(f"%{name}.spent = add nsw i64 {i}, 1")
    e.do(f"store i64 %{name}.spent, ptr {COUNT}")
    e.do(f"br label %{name}.end")
    e.lines.append(f"{name}.failed:")
    with e.loop(n) as k:
        x = e.emit(f"load double, ptr {e.element(e.element(Q, k), 0, 'double')}, align 8")
        e.do(f"store double {x}, ptr {e.element(result, k, 'double')}, align 8")
    e.do(f"store i64 {e.emit(f'sub nsw i64 0, %{name}.next')}, ptr {COUNT}")
    e.do(f"br label %{name}.end")
    e.lines.append(f"{name}.end:")


def _restart(e: Emitter, lane: str, n: int, Q: str, BEST: str, STALL: str, NEXT: str, LIVE: str) -> None:
    """The next row of the table into a lane, or rest for it."""
    at = e.emit(f"load i64, ptr {NEXT}")
    has = e.emit(f"icmp slt i64 {at}, %limit")
    with e.when(has):
        row = e.emit(f"srem i64 {at}, %rows")
        _fill(e, e.element("%table", e.emit(f"mul nsw i64 {row}, {n}"), "double"), Q, lane, n)
        e.do(f"store i64 {e.emit(f'add nsw i64 {at}, 1')}, ptr {NEXT}")
        e.do(f"store double {double(1e300)}, ptr {e.element(BEST, lane, 'double')}, align 8")
        e.do(f"store double {double(0.0)}, ptr {e.element(STALL, lane, 'double')}, align 8")
    with e.when(e.emit(f"xor i1 {has}, true")):
        _rest(e, lane, BEST, STALL)
        live = e.emit(f"load i64, ptr {LIVE}")
        e.do(f"store i64 {e.emit(f'sub nsw i64 {live}, 1')}, ptr {LIVE}")


def _rest(e: Emitter, lane: str | int, BEST: str, STALL: str) -> None:
    """A lane that never comes nearer than it was, and never tires of that."""
    for slot in (BEST, STALL):
        e.do(f"store double {double(-1e300)}, ptr {e.element(slot, lane, 'double')}, align 8")


@dataclass(frozen=True, eq=False)
class Racer:
    """Compiled search for one chain; made by `racer`.

    `table` (rows, n) are the random starts; `build` tells how the code came to be.
    """

    chain: Chain
    lanes: int
    table: Array
    build: Any
    call: Any

    def __call__(
        self,
        seeds: ArrayLike,
        R: ArrayLike,
        p: ArrayLike,
        *,
        tolerance: tuple[float, float],
        most: int = 4000,
        starts: Array | None = None,
    ) -> Raced:
        """Configurations (k, n) for targets R (k, 3, 3), p (k, 3), from `seeds` (k, n).

        `tolerance` of every component of position [m] and rotation [rad]; at most `most` iterations a target.
        `starts` (rows, n): all further starts that may be made; default those of `table`, again and again.
        """
        p = np.asarray(p, dtype=float).reshape(-1, 3)
        k = len(p)
        targets = np.empty((k, 14))
        targets[:, :9] = np.asarray(R, dtype=float).reshape(-1, 9)
        targets[:, 9:12], targets[:, 12:] = p, tolerance
        first = np.ascontiguousarray(np.broadcast_to(np.asarray(seeds, dtype=float), (k, self.chain.n)))
        table, limit = self.table, _ENDLESS
        if starts is not None:
            table = np.ascontiguousarray(starts, dtype=float)
            limit = len(table)
        q, counts = np.empty((k, self.chain.n)), np.empty((2, k), dtype=np.int64)
        self.call(
            k, address(first), address(targets), address(table), max(len(table), 1), limit, most, address(q),
            counts.__array_interface__["data"][0],
        )  # fmt: skip
        return Raced(q, counts[0] > 0, np.abs(counts[0]), counts[1])


@lru_cache(maxsize=1)
def _source() -> str:
    here = Path(__file__).parent
    files = [
        here / "race.py",
        here / "step.py",
        here / "algebra.py",
        *sorted((here.parents[1] / "compile").glob("*.py")),
    ]
    return key_of(*(file.read_bytes() for file in files))


def racer(chain: Chain, *, seed: int = 0, cache: bool = True, lanes: int | None = None) -> Racer:
    """The compiled search of a chain, from the disk cache where it was compiled before.

    Random starts are uniform within the limits; joints without limits turn fully, slides move by the chain's
    length.
    """
    lanes = jit.preferred_lanes() if lanes is None else lanes
    rng = np.random.default_rng(seed)
    low, high = _ranges(chain)
    table = np.ascontiguousarray(rng.uniform(low, high, (_ROWS, chain.n)))

    def make() -> tuple[str, str, dict[str, Any]]:
        tape = step_tape(chain)
        head = declarations(lanes) + "\n"
        count = f"declare i{lanes} @llvm.cttz.i{lanes}(i{lanes}, i1)\n"
        loops = head + count + declare("f", tape) + race_loop(chain, lanes)
        return head + kernel("f", tape, lanes), loops, facts_of(tape)

    key = key_of(chain.fingerprint(), _source(), str(lanes), repr((jit.host(), jit.llvm_version())))
    code = obtain("race", lanes, Cache(default_folder() if cache else None), key, make)
    p, i = ctypes.c_void_p, ctypes.c_int64
    return Racer(chain, lanes, table, code.build, code.loaded.function("race", i, p, p, p, i, i, i, p, p))


def _ranges(chain: Chain) -> tuple[Array, Array]:
    from ...kinds import HINGE

    half = np.array([np.pi if int(j.type) == HINGE else 2 * chain.scale for j in chain.frame.joints])
    rest = np.array([j.rest for j in chain.frame.joints])
    low, high = chain.limits.T
    return np.where(np.isfinite(low), low, rest - half), np.where(np.isfinite(high), high, rest + half)
