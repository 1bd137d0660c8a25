"""A writer of LLVM IR text, over scalars or over short vectors (lanes) of states.

Sines, cosines and arctangents are our own polynomials (Cody & Waite reduction, Cephes coefficients), so that
all lanes are computed at once; products and sums may contract into fused operations, nothing else is relaxed.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from .jit import fused, preferred_lanes

_SIN = (
    1.58962301576546568060e-10,
    -2.50507477628578072866e-8,
    2.75573136213857245213e-6,
    -1.98412698295895385996e-4,
    8.33333333332211858878e-3,
    -1.66666666666666307295e-1,
)
_COS = (
    -1.13585365213876817300e-11,
    2.08757008419747316778e-9,
    -2.75573141792967388112e-7,
    2.48015872888517045348e-5,
    -1.38888888888730564116e-3,
    4.16666666666665929218e-2,
)
_ATAN_P = (
    -8.750608600031904122785e-1,
    -1.615753718733365076637e1,
    -7.500855792314704667340e1,
    -1.228866684490136173410e2,
    -6.485021904942025371773e1,
)
_ATAN_Q = (
    1.0,
    2.485846490142306297962e1,
    1.650270098316988542046e2,
    4.328810604912902668951e2,
    4.853903996359136964868e2,
    1.945506571482613964425e2,
)
_HALF_PI = (1.57079625129699707031e0, 7.54978941586159635336e-8, 5.39030285815811905290e-15)
_HALF_PI_FUSED = (1.5707963267948966, 6.123233995736766e-17)
_ROUND = 6755399441055744.0  # 1.5 * 2^52: adding it rounds to an integer
_MORE_BITS = 6.123233995736765886130e-17  # pi/2 beyond double precision


def double(x: float) -> str:
    """`x` as an exact IR literal."""
    return "0x" + struct.pack(">d", float(x)).hex().upper()


UNROLL = 16  # loops over at most so many scalars are written out


class Emitter:
    """Writes instructions on `lanes` doubles at once; values are names of IR registers or literals."""

    def __init__(self, lanes: int):
        self.lanes = lanes
        self.V = "double" if lanes == 1 else f"<{lanes} x double>"
        self.I = "i64" if lanes == 1 else f"<{lanes} x i64>"
        self.B = "i1" if lanes == 1 else f"<{lanes} x i1>"
        self.suffix = "f64" if lanes == 1 else f"v{lanes}f64"
        self.align = 8 * lanes
        self.lines: list[str] = []
        self._count = 0

    def fresh(self) -> str:
        """A new register name."""
        self._count += 1
        return f"%r{self._count}"

    def label(self, prefix: str) -> str:
        """A new name for blocks."""
        self._count += 1
        return f"{prefix}{self._count}"

    def sharing(self, lanes: int) -> Emitter:
        """Writer of instructions on so many lanes into the same function."""
        other = Emitter(lanes)
        other.lines, other.fresh, other.label = self.lines, self.fresh, self.label  # type: ignore[method-assign]
        return other

    def slot(self, count: int, type: str = "") -> str:
        """Memory for `count` values of `type` (default: in all lanes), allocated at the function's entry."""
        register = self.fresh()
        self.lines.insert(0, f"  {register} = alloca [{max(count, 1)} x {type or self.V}], align 64")
        return register

    def emit(self, text: str) -> str:
        """Append an instruction with a result; returns its register."""
        register = self.fresh()
        self.lines.append(f"  {register} = {text}")
        return register

    def do(self, text: str) -> None:
        """Append an instruction without a result."""
        self.lines.append("  " + text)

    def const(self, x: float) -> str:
        """A number in all lanes."""
        return double(x) if self.lanes == 1 else self.consts([x] * self.lanes)

    def consts(self, xs: Sequence[float]) -> str:
        """A number in each lane."""
        return f"<{', '.join(f'double {double(x)}' for x in xs)}>"

    def iconst(self, x: int) -> str:
        """An integer in all lanes."""
        return str(x) if self.lanes == 1 else f"<{', '.join([f'i64 {x}'] * self.lanes)}>"

    def f(self, op: str, a: str, b: str) -> str:
        """Floating-point `fadd`, `fsub`, `fmul` or `fdiv`."""
        return self.emit(f"{op} contract {self.V} {a}, {b}")

    def i(self, op: str, a: str, b: str) -> str:
        """Integer operation in lanes."""
        return self.emit(f"{op} {self.I} {a}, {b}")

    def call(self, name: str, *args: str) -> str:
        """Intrinsic on lanes, e.g. `sqrt`."""
        return self.emit(
            f"call {self.V} @llvm.{name}.{self.suffix}({', '.join(f'{self.V} {a}' for a in args)})"
        )

    def bits(self, x: str) -> str:
        """Doubles as integers."""
        return self.emit(f"bitcast {self.V} {x} to {self.I}")

    def value(self, x: str) -> str:
        """Integers as doubles."""
        return self.emit(f"bitcast {self.I} {x} to {self.V}")

    def compare(self, predicate: str, a: str, b: str) -> str:
        """Ordered comparison."""
        return self.emit(f"fcmp {predicate} {self.V} {a}, {b}")

    def select(self, condition: str, a: str, b: str) -> str:
        """`a` where `condition`, else `b`."""
        return self.emit(f"select {self.B} {condition}, {self.V} {a}, {self.V} {b}")

    def element(self, pointer: str, index: str | int, type: str = "") -> str:
        """Address of an element of `type` (default: one value in all lanes)."""
        return self.emit(f"getelementptr inbounds {type or self.V}, ptr {pointer}, i64 {index}")

    def load(self, pointer: str, index: str | int) -> str:
        """Value in all lanes."""
        return self.emit(f"load {self.V}, ptr {self.element(pointer, index)}, align {self.align}")

    def store(self, x: str, pointer: str, index: str | int) -> None:
        """Store a value in all lanes."""
        self.do(f"store {self.V} {x}, ptr {self.element(pointer, index)}, align {self.align}")

    @contextmanager
    def loop(self, count: str | int, step: int = 1) -> Iterator[str]:
        """Counted loop from 0 (skipped when empty); yields the counter."""
        name = self.label("L")
        self.do(f"br label %{name}.entry")
        self.lines.append(f"{name}.entry:")
        self.do(f"br label %{name}.head")
        self.lines.append(f"{name}.head:")
        counter = f"%{name}.i"
        self.do(f"{counter} = phi i64 [0, %{name}.entry], [%{name}.next, %{name}.latch]")
        self.do(f"%{name}.go = icmp slt i64 {counter}, {count}")
        self.do(f"br i1 %{name}.go, label %{name}.body, label %{name}.exit")
        self.lines.append(f"{name}.body:")
        yield counter
        self.do(f"br label %{name}.latch")
        self.lines.append(f"{name}.latch:")
        self.do(f"%{name}.next = add nsw i64 {counter}, {step}")
        self.do(f"br label %{name}.head")
        self.lines.append(f"{name}.exit:")

    def over(self, size: int) -> Iterator[str]:
        """Indices 0 ... size - 1: written out when few, so that arrays can live in registers, else a loop."""
        if size <= UNROLL:
            yield from map(str, range(size))
        else:
            with self.loop(size) as i:
                yield i

    def get(self, cell: str) -> str:
        """The integer in a cell."""
        return self.emit(f"load i64, ptr {cell}, align 8")

    def put(self, cell: str, value: str | int) -> None:
        """Set the integer in a cell."""
        self.do(f"store i64 {value}, ptr {cell}, align 8")

    @contextmanager
    def when(self, condition: str) -> Iterator[None]:
        """Instructions executed only if the i1 `condition` holds."""
        name = self.label("W")
        self.do(f"br i1 {condition}, label %{name}.then, label %{name}.end")
        self.lines.append(f"{name}.then:")
        yield
        self.do(f"br label %{name}.end")
        self.lines.append(f"{name}.end:")

    def polynomial(self, coefficients: Sequence[float], z: str) -> str:
        """Horner's scheme, highest power first."""
        p = self.const(coefficients[0])
        for c in coefficients[1:]:
            p = self.f("fadd", self.f("fmul", p, z), self.const(c))
        return p

    def pairwise(self, coefficients: Sequence[float], z: str, zz: str) -> str:
        """Estrin's scheme for six coefficients, highest power first: half the latency of Horner's."""
        c = [self.const(x) for x in coefficients]
        top, middle, low = (self.f("fadd", self.f("fmul", c[i], z), c[i + 1]) for i in (0, 2, 4))
        upper = self.f("fadd", self.f("fmul", top, zz), middle)
        return self.f("fadd", self.f("fmul", upper, zz), low)

    def sincos(self, x: str) -> tuple[str, str]:
        """Sine and cosine, within 1.2e-16 of the reduced argument's."""
        shifted = self.f("fadd", self.f("fmul", x, self.const(0.63661977236758134308)), self.const(_ROUND))
        quarter = self.bits(shifted)
        turns = self.emit(f"fsub {self.V} {shifted}, {self.const(_ROUND)}")
        r = x
        if fused():  # the first product is exact inside the operation, and so is the difference
            for part in _HALF_PI_FUSED:
                r = self.call("fma", turns, self.const(-part), r)
        else:
            for part in _HALF_PI:
                r = self.f("fsub", r, self.f("fmul", turns, self.const(part)))
        z = self.f("fmul", r, r)
        zz = self.f("fmul", z, z)
        sine = self.f("fadd", self.f("fmul", self.f("fmul", r, z), self.pairwise(_SIN, z, zz)), r)
        half = self.f("fmul", z, self.const(0.5))
        head = self.f("fsub", self.const(1.0), half)
        lost = self.f("fsub", self.f("fsub", self.const(1.0), head), half)  # rounding of the head
        tail = self.f("fadd", self.f("fmul", zz, self.pairwise(_COS, z, zz)), lost)
        cosine = self.f("fadd", head, tail)
        odd = self.i("and", quarter, self.iconst(1))
        swap = self.emit(f"icmp ne {self.I} {odd}, {self.iconst(0)}")
        sign_s = self.i("shl", self.i("and", quarter, self.iconst(2)), self.iconst(62))
        next_quarter = self.i("add", quarter, self.iconst(1))
        sign_c = self.i("shl", self.i("and", next_quarter, self.iconst(2)), self.iconst(62))
        s = self.bits(self.select(swap, cosine, sine))
        c = self.bits(self.select(swap, sine, cosine))
        return self.value(self.i("xor", s, sign_s)), self.value(self.i("xor", c, sign_c))

    def splat(self, scalar: str) -> str:
        """A scalar register in all lanes."""
        if self.lanes == 1:
            return scalar
        one = self.emit(f"insertelement {self.V} poison, double {scalar}, i64 0")
        zeros = f"<{self.lanes} x i32> zeroinitializer"
        return self.emit(f"shufflevector {self.V} {one}, {self.V} poison, {zeros}")

    def gathered(self, scalars: Sequence[str]) -> str:
        """Scalar registers in lanes."""
        vector = "poison"
        for lane, x in enumerate(scalars):
            vector = self.emit(f"insertelement {self.V} {vector}, double {x}, i64 {lane}")
        return vector

    def lane(self, vector: str, lane: int) -> str:
        """The scalar in one lane."""
        return self.emit(f"extractelement {self.V} {vector}, i64 {lane}")

    def turned(self, vector: str, by: int) -> str:
        """What stands in lane l + `by`, in lane l."""
        order = ", ".join(f"i32 {(lane + by) % self.lanes}" for lane in range(self.lanes))
        return self.emit(f"shufflevector {self.V} {vector}, {self.V} poison, <{self.lanes} x i32> <{order}>")

    def side_by_side(self, angles: list[str]) -> list[tuple[str, str]]:
        """Sines and cosines of many angles of one state, several in one vector."""
        if self.lanes > 1 or len(angles) == 1:
            return [self.sincos(x) for x in angles]
        out: list[tuple[str, str]] = []
        most = preferred_lanes()
        for first in range(0, len(angles), most):
            group = angles[first : first + most]
            wide = self.sharing(max(2, 1 << (len(group) - 1).bit_length()))
            sine, cosine = wide.sincos(wide.gathered(group))
            out += [(wide.lane(sine, lane), wide.lane(cosine, lane)) for lane in range(len(group))]
        return out

    def atan2(self, y: str, x: str) -> str:
        """Angle of the point (x, y)."""
        ax, ay = self.call("fabs", x), self.call("fabs", y)
        steep = self.compare("ogt", ay, ax)
        low, high = self.select(steep, ax, ay), self.select(steep, ay, ax)
        nonzero = self.compare("ogt", high, self.const(0.0))
        t = self.f("fdiv", low, self.select(nonzero, high, self.const(1.0)))
        far = self.compare("ogt", t, self.const(0.66))
        shifted = self.f("fdiv", self.f("fsub", t, self.const(1.0)), self.f("fadd", t, self.const(1.0)))
        r = self.select(far, shifted, t)
        z = self.f("fmul", r, r)
        ratio = self.f("fdiv", self.polynomial(_ATAN_P, z), self.polynomial(_ATAN_Q, z))
        angle = self.f("fadd", r, self.f("fmul", self.f("fmul", r, z), ratio))
        eighth = self.f("fadd", angle, self.const(0.5 * _MORE_BITS))
        angle = self.select(far, self.f("fadd", eighth, self.const(0.78539816339744830962)), angle)
        mirrored = self.f(
            "fadd", self.f("fsub", self.const(_MORE_BITS), angle), self.const(1.5707963267948966)
        )
        angle = self.select(steep, mirrored, angle)
        behind = self.f(
            "fadd", self.f("fsub", self.const(2.0 * _MORE_BITS), angle), self.const(3.141592653589793)
        )
        angle = self.select(self.compare("olt", x, self.const(0.0)), behind, angle)
        return self.call("copysign", angle, y)


DECLARED = {"sqrt": 1, "fabs": 1, "rint": 1, "copysign": 2, "fma": 3}


def declarations(lanes: int) -> str:
    """Intrinsics that kernels on `lanes` may call; scalar ones use vectors as well (`side_by_side`)."""
    writers = [Emitter(width) for width in (range(1, 9) if lanes == 1 else (lanes,))]
    return "\n".join(
        f"declare {e.V} @llvm.{name}.{e.suffix}({', '.join([e.V] * arity)})"
        for e in writers
        for name, arity in DECLARED.items()
    )
