"""Piecewise Chebyshev polynomials of time, evaluated by compiled code at the time of every lane."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .llvm import Emitter
from .loops import function


@contextmanager
def repeat_while(e: Emitter) -> Iterator[Any]:
    """A loop whose body begins by deciding to go on: `yield`s a function that takes the i1 condition."""
    name = e.label("R")
    e.do(f"br label %{name}.head")
    e.lines.append(f"{name}.head:")

    def going(condition: str) -> None:
        e.do(f"br i1 {condition}, label %{name}.body, label %{name}.exit")
        e.lines.append(f"{name}.body:")

    yield going
    e.do(f"br label %{name}.head")
    e.lines.append(f"{name}.exit:")


def pieces_function(name: str, width: int, lanes: int) -> str:
    """IR of `void name(t, piece, first, last, knots, coefficients, terms, w)`.

    For every lane: the piece in first ... last that its time `t` falls into, sought from `piece` on, which
    remembers it; and the `width` polynomials of that piece, `terms` coefficients each, by Clenshaw's scheme.
    Beyond the knots of these pieces the outermost ones go on.
    """
    e = Emitter(1)
    near, far, number = e.slot(1), e.slot(1), e.slot(1, "i64")
    with e.loop(lanes) as lane:
        t = _entry(e, "%t", lane)
        piece = e.element("%piece", lane, "i64")
        _clamp(e, piece)
        with repeat_while(e) as going:
            after = e.emit(f"add nsw i64 {e.get(piece)}, 1")
            more = e.emit(f"icmp sle i64 {after}, %last")
            passed = e.compare("oge", t, _entry(e, "%knots", after))
            going(e.emit(f"and i1 {more}, {passed}"))
            e.put(piece, after)
        with repeat_while(e) as going:
            here = e.get(piece)
            more = e.emit(f"icmp sgt i64 {here}, %first")
            early = e.compare("olt", t, _entry(e, "%knots", here))
            going(e.emit(f"and i1 {more}, {early}"))
            e.put(piece, e.emit(f"sub nsw i64 {here}, 1"))
        here = e.get(piece)
        low, high = _entry(e, "%knots", here), _entry(e, "%knots", e.emit(f"add nsw i64 {here}, 1"))
        twice = e.f("fadd", e.f("fsub", t, low), e.f("fsub", t, high))
        x = e.f("fdiv", twice, e.f("fsub", high, low))
        double_x = e.f("fadd", x, x)
        first = e.emit(f"mul nsw i64 {here}, {width}")
        with e.loop(width) as column:
            row = e.emit(f"mul nsw i64 {e.emit(f'add nsw i64 {first}, {column}')}, %terms")
            c = e.element("%coefficients", row)
            e.store(e.const(0.0), near, 0)
            e.store(e.const(0.0), far, 0)
            e.put(number, "%terms")
            with repeat_while(e) as going:
                k = e.emit(f"sub nsw i64 {e.get(number)}, 1")
                going(e.emit(f"icmp sgt i64 {k}, 0"))
                e.put(number, k)
                before = e.load(near, 0)
                value = e.f("fmul", double_x, before)
                value = e.f("fadd", e.f("fsub", value, e.load(far, 0)), e.load(c, k))
                e.store(before, far, 0)
                e.store(value, near, 0)
            value = e.f("fsub", e.f("fmul", x, e.load(near, 0)), e.load(far, 0))
            place = e.emit(f"add nsw i64 {e.emit(f'mul nsw i64 {column}, {lanes}')}, {lane}")
            e.store(e.f("fadd", value, e.load(c, 0)), "%w", place)
    arguments = ["ptr noalias %t", "ptr noalias %piece", "i64 %first", "i64 %last", "ptr noalias %knots"]
    arguments += ["ptr noalias %coefficients", "i64 %terms", "ptr noalias %w"]
    return function(name, arguments, e)


def _entry(e: Emitter, pointer: str, index: str) -> str:
    return e.emit(f"load double, ptr {e.element(pointer, index, 'double')}, align 8")


def _clamp(e: Emitter, piece: str) -> None:
    """A piece remembered from before, brought into first ... last."""
    for bound, wrong in (("%first", "slt"), ("%last", "sgt")):
        here = e.get(piece)
        outside = e.emit(f"icmp {wrong} i64 {here}, {bound}")
        e.put(piece, e.emit(f"select i1 {outside}, i64 {bound}, i64 {here}"))
