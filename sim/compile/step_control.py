"""Runge-Kutta stages and the control of their steps as IR; every lane keeps its own clock.

Proportional-integral control as in `sim.integrate.control`: h 0.9 err^(-0.7/k) err_before^(0.4/k)
(Gustafsson; Hairer & Wanner II, IV.2).
"""

from __future__ import annotations

from typing import Any

from .llvm import Emitter
from .rollout import Shape, combine

SAFETY, SHRINK, GROW = 0.9, 0.2, 8.0
OK, TOO_MANY_STEPS, STEP_TOO_SMALL, GUARDED = 0.0, 1.0, 2.0, 4.0
STATISTICS = ("steps", "rejected", "evaluations", "status", "next_step", "time")


def log2(e: Emitter, x: str) -> str:
    """Binary logarithm of positive normal x to five digits: enough to choose a step."""
    whole = e.bits(x)
    exponent = e.i("sub", e.i("lshr", whole, e.iconst(52)), e.iconst(1023))
    mantissa = e.i("or", e.i("and", whole, e.iconst(0x000FFFFFFFFFFFFF)), e.iconst(0x3FF0000000000000))
    m, one = e.value(mantissa), e.const(1.0)
    s = e.f("fdiv", e.f("fsub", m, one), e.f("fadd", m, one))
    series = e.polynomial((1 / 7, 1 / 5, 1 / 3, 1.0), e.f("fmul", s, s))
    fraction = e.f("fmul", e.f("fmul", s, series), e.const(2.8853900817779268))
    return e.f("fadd", fraction, e.emit(f"sitofp {e.I} {exponent} to {e.V}"))


def exp2(e: Emitter, y: str) -> str:
    """2^y to five digits."""
    r = e.call("rint", y)
    f = e.f("fmul", e.f("fsub", y, r), e.const(0.6931471805599453))
    fraction = e.polynomial((1 / 120, 1 / 24, 1 / 6, 1 / 2, 1.0, 1.0), f)
    biased = e.i("add", e.emit(f"fptosi {e.V} {r} to {e.I}"), e.iconst(1023))
    return e.f("fmul", fraction, e.value(e.i("shl", biased, e.iconst(52))))


class Stepping:
    """Writes stages, errors and the choice of the next step into an integration."""

    def __init__(self, method: Any, shape: Shape, lanes: int):
        self.e = e = Emitter(lanes)
        self.method, self.shape = method, shape
        self.stages, self.extra = len(method.b), len(method.dense.c)
        nx = shape.nx
        self.X, self.Y, self.XN = e.slot(nx), e.slot(nx), e.slot(nx)
        self.U, self.W, self.P = e.slot(shape.nu), e.slot(shape.nw), e.slot(shape.np)
        self.K = [e.slot(nx) for _ in range(self.stages + self.extra)]
        self.T, self.piece = e.slot(1), e.slot(lanes, "i64")
        self.first_piece = self.last_piece = "0"
        # clocks and controls of the lanes, in memory
        names = ("t", "t_new", "h", "want", "before", "grow", *STATISTICS[:4])
        self.mem = {name: e.slot(1) for name in names}
        # the step ends in stage `last`, whose slope the next step begins with
        self.last = self.stages - 1 if method.fsal else self.stages

    def get(self, name: str) -> str:
        """A number of every lane by its name."""
        return self.e.load(self.mem[name], 0)

    def set(self, name: str, value: str) -> None:
        """Set it."""
        self.e.store(value, self.mem[name], 0)

    def prescribe(self, t: str) -> None:
        """The prescribed motion at time `t`."""
        if self.shape.nw:
            self.e.store(t, self.T, 0)
            self.e.do(
                f"call void @prescribed(ptr {self.T}, ptr {self.piece}, i64 {self.first_piece}, "
                f"i64 {self.last_piece}, ptr %knots, ptr %coefficients, i64 %terms, ptr {self.W})"
            )

    def rate(self, at: str, out: str, t: str) -> None:
        """dx/dt of a state at time `t`."""
        self.prescribe(t)
        self.evaluate(at, out)

    def evaluate(self, at: str, out: str) -> None:
        """dx/dt of a state under the motion prescribed last."""
        e = self.e
        e.do(
            f"call void @rate({self.shape.split(e, at)}, ptr {self.U}, ptr {self.W}, ptr {self.P}, ptr {out})"
        )

    def stage(self, i: int, row: Any, node: float, h: str) -> None:
        """Slope of stage `i` from the ones before it, at its `node`."""
        e = self.e
        terms = [(float(a), self.K[j]) for j, a in enumerate(row[:i]) if a != 0.0]
        combine(e, self.Y, self.X, h, terms, self.shape.nx)
        inside = e.f("fadd", self.get("t"), e.f("fmul", h, e.const(node)))
        self.rate(self.Y, self.K[i], self.get("t_new") if node == 1.0 else inside)

    def error(self, weights: Any, h: str) -> str:
        """Sum over components of (estimated error / tolerance)^2."""
        e, total = self.e, self.e.slot(1)
        e.store(e.const(0.0), total, 0)
        for i in e.over(self.shape.nx):
            estimate = e.const(0.0)
            for j, weight in enumerate(weights):
                if weight != 0.0:
                    part = e.f("fmul", e.load(self.K[j], i), e.const(float(weight)))
                    estimate = e.f("fadd", estimate, part)
            old, new = e.call("fabs", e.load(self.X, i)), e.call("fabs", e.load(self.XN, i))
            size = e.select(e.compare("ogt", old, new), old, new)
            atol = e.splat(e.emit(f"load double, ptr {e.element('%atol', i, 'double')}, align 8"))
            scale = e.f("fadd", atol, e.f("fmul", e.splat("%rtol"), size))
            unit = e.f("fdiv", e.f("fmul", estimate, h), scale)
            e.store(e.f("fadd", e.load(total, 0), e.f("fmul", unit, unit)), total, 0)
        return e.load(total, 0)

    def error_norm(self, h: str) -> str:
        """Root mean square error in units of the tolerance."""
        e, count = self.e, self.e.const(1.0 / max(1, self.shape.nx))
        high = e.f("fmul", self.error(self.method.b_error, h), count)
        if self.method.b_error_low is None:
            return e.call("sqrt", high)
        low = e.f("fmul", self.error(self.method.b_error_low, h), count)
        both = e.f("fadd", high, e.f("fmul", low, e.const(0.01)))
        some = e.compare("ogt", both, e.const(0.0))
        ratio = e.f("fdiv", high, e.call("sqrt", e.select(some, both, e.const(1.0))))
        nothing = e.compare("oeq", both, e.const(0.0))
        return e.select(nothing, e.const(0.0), ratio)

    def length(self, end: str, active: str) -> str:
        """Length of the next step: as wanted, stretched or halved at the end, nothing in lanes at rest."""
        e = self.e
        left, want = e.f("fsub", end, self.get("t")), self.get("want")
        far = e.compare("ogt", left, e.f("fmul", want, e.const(2.0)))
        near = e.compare("ole", left, e.f("fmul", want, e.const(1.01)))
        h = e.select(far, want, e.select(near, left, e.f("fmul", left, e.const(0.5))))
        self.set("t_new", e.select(near, end, e.f("fadd", self.get("t"), h)))
        return e.select(active, h, e.const(0.0))

    def judge(self, h: str, active: str) -> str:
        """Accept or reject the step, choose the next; returns the lanes that accept."""
        e, k = self.e, float(self.method.error_exponent)
        error = self.error_norm(h)
        finite = e.compare("olt", error, e.const(1e300))
        passed = e.compare("ole", error, e.const(1.0))
        accept = e.emit(f"and {e.B} {active}, {passed}")
        safe = e.select(finite, error, e.const(1.0))
        safe = e.select(e.compare("ogt", safe, e.const(1e-10)), safe, e.const(1e-10))
        size = log2(e, safe)
        part = e.f("fmul", size, e.const(-0.7 / k))
        rise = exp2(e, e.f("fadd", part, e.f("fmul", self.get("before"), e.const(0.4 / k))))
        up = self.limited(e.f("fmul", rise, e.const(SAFETY)), SHRINK, self.get("grow"))
        fall = exp2(e, e.f("fmul", size, e.const(-1.0 / k)))
        down = self.limited(e.f("fmul", fall, e.const(SAFETY)), SHRINK, e.const(SAFETY))
        down = e.select(finite, down, e.const(0.1))
        longer, want = e.f("fmul", h, up), self.get("want")
        # a step cut short by the end of a period says little about the next one's length
        cut = e.compare("olt", h, want)
        kept = e.select(e.compare("ogt", longer, want), longer, want)
        after = e.select(accept, e.select(cut, kept, longer), e.f("fmul", h, down))
        self.set("want", e.select(active, after, want))
        self.set("before", e.select(accept, size, self.get("before")))
        reject = e.emit(f"xor {e.B} {accept}, {active}")
        self.set("grow", e.select(reject, e.const(1.0), e.select(accept, e.const(GROW), self.get("grow"))))
        for name, lanes in (("steps", accept), ("rejected", reject)):
            self.set(name, e.select(lanes, e.f("fadd", self.get(name), e.const(1.0)), self.get(name)))
        spent = e.f("fadd", self.get("evaluations"), e.const(float(self.last)))
        self.set("evaluations", e.select(active, spent, self.get("evaluations")))
        self.give_up(reject)
        return accept

    def limited(self, x: str, low: float, high: str) -> str:
        """`x` between two bounds."""
        e = self.e
        x = e.select(e.compare("olt", x, e.const(low)), e.const(low), x)
        return e.select(e.compare("ogt", x, high), high, x)

    def give_up(self, reject: str) -> None:
        """Mark lanes whose steps became too small or too many."""
        e = self.e
        resolution = e.f("fmul", e.call("fabs", self.get("t")), e.const(10 * 2.0**-52))
        tiny = e.compare("ole", self.get("want"), e.f("fadd", resolution, e.const(1e-300)))
        tiny = e.emit(f"and {e.B} {tiny}, {reject}")
        done = e.f("fadd", self.get("steps"), self.get("rejected"))
        many = e.compare("oge", done, e.splat("%max_steps"))
        status = e.select(many, e.const(TOO_MANY_STEPS), self.get("status"))
        self.set("status", e.select(tiny, e.const(STEP_TOO_SMALL), status))
