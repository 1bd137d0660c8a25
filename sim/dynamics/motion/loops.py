"""Compiled integrations of a smooth model: found on disk or built, and how they are called and end."""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...compile.cache import key_of
from ...compile.kernels import kernel
from ...compile.llvm import declarations
from ...compile.loops import declare
from ...compile.program import Code, facts_of, obtain
from ...compile.rollout import Shape, live_stages
from ...integrate.tableau import Tableau
from ..laws import CompiledLaw
from .guards import Guards
from .path import STATUS, Path
from .rows import Start

if TYPE_CHECKING:
    from ..smooth import Smooth

Array = NDArray[np.float64]

_NONE = np.zeros(1, np.int64)
PARALLEL_OPERATIONS = 400_000
"""Work below which one thread is quicker."""


class Loop:
    """A compiled integration, called with its arguments packed into one block.

    Attributes:
        code: with the facts of the model's rate.
        stages: evaluations of a step of fixed length.
    """

    def __init__(self, code: Code, name: str, kinds: str, method: Tableau):
        import ctypes

        self.code = code
        self.stages = len(live_stages(method.A, method.b))
        self.operations: int = code.facts["operations"]
        self._pack = struct.Struct("=" + kinds).pack
        self._run: Any = code.loaded.function(f"{name}.packed", ctypes.c_char_p)

    def run(self, *arguments: float) -> None:
        """Integrate; addresses are given as integers."""
        self._run(self._pack(*arguments))


def packed(name: str, kinds: str) -> str:
    """IR of `name.packed(ptr)`, which calls `name` with arguments of `kinds` (as in `struct`) from memory.

    One pointer instead of two dozen arguments: passing each costs ctypes 0.1 us.
    """
    types = {"q": "i64", "d": "double", "P": "ptr"}
    lines, passed = [], []
    for k, kind in enumerate(kinds):
        lines.append(f"  %p{k} = getelementptr inbounds i64, ptr %arguments, i64 {k}")
        lines.append(f"  %a{k} = load {types[kind]}, ptr %p{k}, align 1")
        passed.append(f"{types[kind]} %a{k}")
    lines.append(f"  call void @{name}({', '.join(passed)})")
    body = "\n".join(lines)
    return f"define void @{name}.packed(ptr %arguments) nounwind {{\n{body}\n  ret void\n}}\n"


def compiled_loop(
    smooth: Smooth,
    name: str,
    lanes: int,
    law: CompiledLaw | None,
    method: Tableau,
    emit: Callable[..., str],
    kinds: str,
    *,
    guards: Guards | None = None,
    **options: Any,
) -> Loop:
    """The integration that `emit` writes with `options`, around the model's rate, a law and guards."""
    controlled = "" if law is None else law.key
    known = (name, lanes, method, controlled, guards and guards.key)
    found: Loop | None = smooth.loops.get(known)
    if found is not None:
        return found

    def make() -> tuple[str, str, dict[str, Any]]:
        rate = smooth.tape("rate")
        parts = {"rate": rate}
        if law is not None:
            parts["law"] = law.tape(smooth.layout)
        if guards is not None:
            parts["guard"] = guards.tape(smooth)
            options.update(guards=guards.count, rateless=len(guards.rests))
        kernels = loops = declarations(lanes) + "\n"
        for part, tape in parts.items():
            kernels += kernel(part, tape, lanes)
            loops += declare(part, tape)
        loops += emit(name, method, shape_of(smooth, law), lanes, **options) + packed(name, kinds)
        return kernels, loops, facts_of(rate) | {"formulation": smooth.formulation}

    key = key_of(smooth.key, name, str(lanes), _method_key(method), controlled, guards.key if guards else "")
    code = obtain(f"{name}:{method.name}", lanes, smooth.cache, key, make)
    loop = smooth.loops[known] = Loop(code, name, kinds.replace("P", "q"), method)
    return loop


def _method_key(method: Tableau) -> str:
    dense = method.dense
    arrays = [method.A, method.b, method.b_error, method.b_error_low, dense.A, dense.P]
    return key_of(
        *(b"" if x is None else x.tobytes() for x in arrays), repr((method.error_exponent, method.fsal))
    )


def shape_of(smooth: Smooth, law: CompiledLaw | None) -> Shape:
    """Sizes of a model's integrations."""
    lay = smooth.layout
    sizes = (None, 0, 0) if law is None else law.sizes(lay)
    size = len(smooth.parameters)
    return Shape(lay.nq, lay.nv, lay.na, lay.nu, lay.nw, size, tuple(lay.quaternions), *sizes)


def finish(
    smooth: Smooth,
    start: Start,
    t: Array,
    path: Array,
    u: Array,
    evaluations: NDArray[np.int64],
    seconds: float,
    *,
    steps: NDArray[np.int64],
    reached: Array | None = None,
    rejected: NDArray[np.int64] | None = None,
    status: NDArray[np.int64] | None = None,
) -> Path:
    """The result as it was asked for: a batch or one state; fixed steps reached their last finite record."""
    rejected, status = _NONE if rejected is None else rejected, _NONE if status is None else status
    came = t[-1:] if reached is None else reached
    # one number is infinite or none if any is, or if the sum of very large ones is
    total = path[0, -1].dot(smooth.ones) if len(path) == 1 else np.add.reduce(path[:, -1], None)
    if not math.isfinite(total):
        finite = np.isfinite(path[:, -1]).all(axis=1)
        lost = ~finite & ((status == 0) | ~np.isfinite(path[:, 0]).all(axis=1))
        status = np.where(lost, STATUS.index("not finite"), status)
        if reached is None:
            came = t[np.maximum(np.isfinite(path).all(axis=2).sum(axis=1) - 1, 0)]
    path.setflags(write=False)
    u.setflags(write=False)
    nq, nv = smooth.layout.nq, smooth.layout.nv
    if start.single:
        return Path(
            t, path[0], u[0], status[0], evaluations[0], rejected[0], steps[0], came[0], seconds, nq, nv
        )
    n = len(path)
    status, evaluations, rejected, steps = (
        np.broadcast_to(x, n) for x in (status, evaluations, rejected, steps)
    )
    came = np.broadcast_to(came, n)
    return Path(t, path, u, status, evaluations, rejected, steps, came, seconds, nq, nv)
