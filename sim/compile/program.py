"""A compiled function over batches of states: found on disk or built, called through bound pointers."""

from __future__ import annotations

import ctypes
import json
import os
import time
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .cache import Cache
from .jit import Loaded, compile_ir, load
from .kernels import INLINE_COST, kernel
from .llvm import declarations
from .loops import declare, map_function
from .tape import Tape

Array = NDArray[np.float64]


PIECES = 4  # of a batch for each thread: one that starts late or works slowly takes fewer
RECENT = 64  # programs kept in memory: loading one and letting it go costs 10 ms
_recent: dict[tuple[Path | None, str], Code] = {}
_lock = Lock()


@dataclass(frozen=True)
class Build:
    """How one program came to be: seconds of its parts, or that it was found on disk."""

    name: str
    lanes: int
    cached: bool
    operations: int
    symbolic_s: float
    compile_s: float
    load_s: float


@dataclass(frozen=True)
class Code:
    """Machine code with the facts that were stored beside it."""

    loaded: Loaded
    facts: dict[str, Any]
    build: Build


def obtain(
    name: str, lanes: int, cache: Cache, key: str, make: Callable[[], tuple[str, str, dict[str, Any]]]
) -> Code:
    """The code of `key` from disk, or by `make`, which gives kernels, loops (IR) and facts to keep.

    `facts` needs "operations" and "cost". What this process used last is still in memory.
    """
    begin = time.perf_counter()
    known = _recent.get((cache.folder, key))
    if known is not None:
        build = Build(name, lanes, True, known.build.operations, 0.0, 0.0, time.perf_counter() - begin)
        return Code(known.loaded, known.facts, build)
    code = _found_or_made(name, lanes, cache, key, make)
    if cache.folder is not None:
        with _lock:
            while len(_recent) >= RECENT:
                del _recent[next(iter(_recent))]
            _recent[cache.folder, key] = code
    return code


def _found_or_made(
    name: str, lanes: int, cache: Cache, key: str, make: Callable[[], tuple[str, str, dict[str, Any]]]
) -> Code:
    entry = cache.get(key)
    begin = time.perf_counter()
    if entry is not None:
        facts = json.loads(entry["facts"])
        loaded = load(entry["object"])
        seconds = time.perf_counter() - begin
        return Code(loaded, facts, Build(name, lanes, True, facts["operations"], 0.0, 0.0, seconds))
    kernels, loops, facts = make()
    built = time.perf_counter()
    code = compile_ir(kernels, loops, inline=facts["cost"] <= INLINE_COST)
    compiled = time.perf_counter()
    cache.put(key, {"facts": json.dumps(facts).encode(), "object": code})
    loaded = load(code)
    done = time.perf_counter()
    build = Build(name, lanes, False, facts["operations"], built - begin, compiled - built, done - compiled)
    return Code(loaded, facts, build)


def facts_of(tape: Tape) -> dict[str, Any]:
    """What a program needs to know about its tape after the tape is gone."""
    return {
        "inputs": tape.inputs,
        "outputs": tape.outputs,
        "operations": sum(tape.counts.values()),
        "counts": tape.counts,
        "cost": tape.cost,
    }


def map_source(tape: Tape, lanes: int) -> tuple[str, str, dict[str, Any]]:
    """Kernel, loop and facts of a function over batches."""
    head = declarations(lanes) + "\n"
    loops = head + declare("f", tape) + map_function("map", "f", tape, lanes)
    return head + kernel("f", tape, lanes), loops, facts_of(tape)


@cache
def workers() -> int:
    """Processors this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=workers(), thread_name_prefix="pantograph")


def in_parallel(call: Callable[[int, int], None], count: int, lanes: int, threads: int) -> None:
    """call(first, size) over `count` states in pieces of whole lanes, which `threads` take as they come."""
    blocks = -(-count // lanes)
    threads = min(threads, blocks)
    if threads <= 1:
        call(0, count)
        return
    pieces = min(blocks, PIECES * threads)
    edges = [min(count, (blocks * k // pieces) * lanes) for k in range(pieces)] + [count]
    left = deque(pairwise(edges))

    def work() -> None:
        while True:
            try:
                first, end = left.popleft()
            except IndexError:
                return
            call(first, end - first)

    jobs = [_pool().submit(work) for _ in range(threads - 1)]
    try:
        work()
    finally:
        left.clear()
        for job in jobs:
            job.result()


def address(array: NDArray[Any]) -> int:
    """Address of a contiguous array's data (0 of an empty one's)."""
    if not array.size:
        return 0
    try:
        # a quarter of what NumPy's own ways cost
        return ctypes.addressof(ctypes.c_double.from_buffer(array.data))
    except (TypeError, ValueError):  # read-only
        place: int = array.ctypes.data
        return place


class Program:
    """A function of named arrays, over a batch along the leading axis."""

    def __init__(self, code: Code, lanes: int):
        self.code, self.lanes, self.build = code, lanes, code.build
        self.inputs: dict[str, int] = code.facts["inputs"]
        self.outputs: dict[str, int] = code.facts["outputs"]
        kinds = [ctypes.c_int64] + [ctypes.c_void_p, ctypes.c_int64] * len(self.inputs)
        self.function = code.loaded.function("map", *kinds, *[ctypes.c_void_p] * len(self.outputs))

    def __call__(self, arrays: Sequence[Array], count: int, threads: int) -> list[Array]:
        """Outputs, shape (count, size) each; `arrays` are contiguous, (count, size) or (size,)."""
        strides = [size if x.ndim == 2 else 0 for x, size in zip(arrays, self.inputs.values(), strict=True)]
        outs = [np.empty((count, size)) for size in self.outputs.values()]
        places = [address(x) for x in arrays]
        targets = [address(x) for x in outs]
        sizes = list(self.outputs.values())

        def run(first: int, size: int) -> None:
            ins = [x for p, s in zip(places, strides, strict=True) for x in (p + 8 * first * s, s)]
            self.function(size, *ins, *(p + 8 * first * s for p, s in zip(targets, sizes, strict=True)))

        if count:
            in_parallel(run, count, self.lanes, threads)
        return outs


class Bound:
    """A program on arrays of its own: write the inputs, call, read the outputs; nothing is allocated.

    `inputs` and `outputs` are the arrays by name, shape (size,), or (count, size) for a batch; `build` tells
    how the program came to be.
    """

    def __init__(self, program: Program, count: int = 1):
        lead = () if count == 1 else (count,)
        self.inputs = {name: np.zeros((*lead, size)) for name, size in program.inputs.items()}
        self.outputs = {name: np.zeros((*lead, size)) for name, size in program.outputs.items()}
        arguments = [x for array in self.inputs.values() for x in (address(array), array.shape[-1])]
        arguments += [address(array) for array in self.outputs.values()]
        self.build = program.build
        self._program, self._function, self._arguments = program, program.function, (count, *arguments)

    def __call__(self) -> None:
        """Compute the outputs from the inputs, in this thread."""
        self._function(*self._arguments)
