"""Whole integrations as compiled loops: explicit Runge-Kutta methods with fixed steps, controls held.

The state x lives in lanes; `rate` is the kernel (x, u, w, p) -> dx/dt. Quaternions follow their own ODE and
are scaled back to unit length after every step, which keeps the order of the method.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from .llvm import Emitter
from .loops import Block, function, shifted

Array = NDArray[np.float64]


class Method(Protocol):
    """What is needed of a tableau (see `sim.integrate.tableau.Tableau`)."""

    @property
    def A(self) -> Array: ...  # noqa: D102

    @property
    def b(self) -> Array: ...  # noqa: D102


@dataclass(frozen=True)
class Shape:
    """Sizes of what a compiled integration handles.

    `quaternions` are first entries in x; `nr`, `ng`, `nm` the sizes of a control law's rows, gains and memory
    (nr None: the rows are the controls themselves).
    """

    nq: int
    nv: int
    na: int
    nu: int
    nw: int
    np: int
    quaternions: tuple[int, ...]
    nr: int | None = None
    ng: int = 0
    nm: int = 0

    @property
    def nx(self) -> int:
        """Size of the state (q, v, act)."""
        return self.nq + self.nv + self.na

    def split(self, e: Emitter, x: str) -> str:
        """Call arguments q, v, act of a state at `x`."""
        v, act = e.element(x, self.nq), e.element(x, self.nq + self.nv)
        return f"ptr {x}, ptr {v}, ptr {act}"


def combine(e: Emitter, out: str, x: str, h: str, terms: list[tuple[float, str]], size: int) -> None:
    """out = x + h sum_j weight_j k_j, over `size` scalars; the newest k comes last, one operation before the
    result, since everything waits for it.
    """
    scaled = [(e.f("fmul", h, e.const(weight)), k) for weight, k in terms]
    for i in e.over(size):
        total = e.load(x, i)
        for weight, k in scaled:
            total = e.f("fadd", total, e.f("fmul", weight, e.load(k, i)))
        e.store(total, out, i)


def advance(e: Emitter, out: str, x: str, h: str, terms: list[tuple[float, str]], size: int) -> None:
    """What `combine` does, rounded to x's precision only once: for the state that steps hand on."""
    for i in e.over(size):
        total = ""
        for weight, k in terms:
            part = e.f("fmul", e.load(k, i), e.const(weight))
            total = part if not total else e.f("fadd", total, part)
        e.store(e.f("fadd", e.load(x, i), e.f("fmul", total, h)), out, i)


def normalize(e: Emitter, x: str, quaternions: tuple[int, ...]) -> None:
    """Unit length for the quaternions in `x`."""
    for first in quaternions:
        parts = [e.load(x, first + k) for k in range(4)]
        square = e.f("fmul", parts[0], parts[0])
        for part in parts[1:]:
            square = e.f("fadd", square, e.f("fmul", part, part))
        scale = e.f("fdiv", e.const(1.0), e.call("sqrt", square))
        for k, part in enumerate(parts):
            e.store(e.f("fmul", part, scale), x, first + k)


def live_stages(A: Array, b: Array) -> list[int]:
    """Stages that a step of fixed length needs."""
    needed = {i for i in range(len(b)) if b[i] != 0.0}
    for i in reversed(range(len(b))):
        if i in needed:
            needed |= {j for j in range(i) if A[i, j] != 0.0}
    return sorted(needed)


CONTROL_ARGUMENTS = [
    "ptr noalias %r",
    "i64 %r_state",
    "i64 %r_period",
    "ptr noalias %g",
    "i64 %g_state",
    "ptr noalias %applied",
    "ptr noalias %m",
    "i64 %m_state",
]


class Control:
    """Controls of a block: rows of an array, or a compiled law of the state, held over a period.

    A law's memory has one row more than there are periods: the first is what it begins with, each sample
    writes the next.
    """

    def __init__(self, e: Emitter, shape: Shape, block: Block, U: str):
        self.e, self.shape, self.block, self.U = e, shape, block, U
        self.rows = block.pointers("%r", "%r_state")
        self.R = e.slot(shape.nr or 0)
        self.G, self.M, self.MN = e.slot(shape.ng), e.slot(shape.nm), e.slot(shape.nm)
        if shape.nr is not None:
            block.gather(block.pointers("%g", "%g_state"), self.G, shape.ng)
            block.gather(block.pointers("%m", "%m_state"), self.M, shape.nm)

    def hold(self, period: str, X: str) -> None:
        """Set the controls of `period` from the state at its start."""
        e, shape = self.e, self.shape
        offset = e.emit(f"mul nsw i64 {period}, %r_period")
        rows = shifted(e, self.rows, offset)
        if shape.nr is None:
            self.block.gather(rows, self.U, shape.nu)
            return
        self.block.gather(rows, self.R, shape.nr)
        e.do(
            f"call void @law({shape.split(e, X)}, ptr {self.R}, ptr {self.G}, ptr {self.M}, "
            f"ptr {self.U}, ptr {self.MN})"
        )
        per_state = e.emit(f"mul nsw i64 %periods, {shape.nu}")
        out = self.block.pointers("%applied", per_state)
        at = e.emit(f"mul nsw i64 {period}, {shape.nu}")
        self.block.scatter(self.U, shifted(e, out, at), shape.nu)
        if shape.nm:
            for i in e.over(shape.nm):
                e.store(e.load(self.MN, i), self.M, i)
            following = e.emit(f"mul nsw i64 {e.emit(f'add nsw i64 {period}, 1')}, {shape.nm}")
            kept = shifted(e, self.block.pointers("%m", "%m_state"), following)
            self.block.scatter(self.M, kept, shape.nm)


def fixed_steps(name: str, method: Method, shape: Shape, lanes: int) -> str:
    """Integration in fixed steps, as IR.

    `void name(i64 n, i64 periods, i64 steps, i64 every, double h, x0, controls..., w, w_state, w_row, p,
    p_state, path)`: `periods` control periods of `steps` steps; every `every` steps the state is recorded,
    the initial one included. `w` has a row for each stage of each step.
    """
    e = Emitter(lanes)
    X, Y, U, W, P = (e.slot(size) for size in (shape.nx, shape.nx, shape.nu, shape.nw, shape.np))
    used = live_stages(method.A, method.b)
    K = {i: e.slot(shape.nx) for i in used}
    h = e.splat("%h")
    stages = len(method.b)
    total = e.emit("mul nsw i64 %periods, %steps")
    records = e.emit(f"add nsw i64 {e.emit(f'sdiv i64 {total}, %every')}, 1")
    per_state = e.emit(f"mul nsw i64 {records}, {shape.nx}")
    left, row, out = (
        e.slot(1, "i64") for _ in range(3)
    )  # steps to the next record, row of w, place of the record
    with e.loop("%n", lanes) as first:
        block = Block(e, first, "%n")
        control = Control(e, shape, block, U)
        block.gather(block.pointers("%x0", shape.nx), X, shape.nx)
        block.gather(block.pointers("%p", "%p_state"), P, shape.np)
        w_rows = block.pointers("%w", "%w_state")
        path = block.pointers("%path", per_state)
        block.scatter(X, path, shape.nx)
        e.put(left, "%every")
        e.put(row, 0)
        e.put(out, shape.nx)
        with e.loop("%periods") as period:
            control.hold(period, X)
            with e.loop("%steps"):
                for i in used:
                    terms = [(float(method.A[i, j]), K[j]) for j in used if j < i and method.A[i, j] != 0.0]
                    at = Y if terms else X
                    if terms:
                        combine(e, Y, X, h, terms, shape.nx)
                    if shape.nw:
                        number = e.emit(f"add nsw i64 {e.get(row)}, {i}")
                        offset = e.emit(f"mul nsw i64 {number}, %w_row")
                        block.gather(shifted(e, w_rows, offset), W, shape.nw)
                    e.do(f"call void @rate({shape.split(e, at)}, ptr {U}, ptr {W}, ptr {P}, ptr {K[i]})")
                advance(e, X, X, h, [(float(method.b[i]), K[i]) for i in used if method.b[i]], shape.nx)
                normalize(e, X, shape.quaternions)
                e.put(row, e.emit(f"add nsw i64 {e.get(row)}, {stages}"))
                e.put(left, e.emit(f"sub nsw i64 {e.get(left)}, 1"))
                with e.when(e.emit(f"icmp eq i64 {e.get(left)}, 0")):
                    offset = e.get(out)
                    block.scatter(X, shifted(e, path, offset), shape.nx)
                    e.put(out, e.emit(f"add nsw i64 {offset}, {shape.nx}"))
                    e.put(left, "%every")
    arguments = ["i64 %n", "i64 %periods", "i64 %steps", "i64 %every", "double %h", "ptr noalias %x0"]
    arguments += CONTROL_ARGUMENTS
    arguments += [
        "ptr noalias %w",
        "i64 %w_state",
        "i64 %w_row",
        "ptr noalias %p",
        "i64 %p_state",
        "ptr noalias %path",
    ]
    return function(name, arguments, e)
