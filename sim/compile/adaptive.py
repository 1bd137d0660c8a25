"""Whole integrations with steps that follow a tolerance, emitted as IR; every lane keeps its own clock.

Control of the steps as in `sim.integrate.control`, proportional-integral: h 0.9 err^(-0.7/k)
err_before^(0.4/k) (Gustafsson; Hairer & Wanner II, IV.2); output at requested times by the method's
continuous extension.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from .llvm import Emitter
from .loops import Block, function
from .rollout import CONTROL_ARGUMENTS, Control, Shape, advance, combine, normalize, splat

SAFETY, SHRINK, GROW = 0.9, 0.2, 8.0
OK, TOO_MANY_STEPS, STEP_TOO_SMALL = 0.0, 1.0, 2.0
STATISTICS = ("steps", "rejected", "evaluations", "status", "next_step")


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


def any_lane(e: Emitter, condition: str) -> str:
    """Whether a condition holds in some lane."""
    if e.lanes == 1:
        return condition
    packed = e.emit(f"bitcast {e.B} {condition} to i{e.lanes}")
    return e.emit(f"icmp ne i{e.lanes} {packed}, 0")


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


class _Integrator:
    """Writes the body of one adaptive integration."""

    def __init__(self, method: Any, shape: Shape, lanes: int):
        self.e = e = Emitter(lanes)
        self.method, self.shape = method, shape
        self.stages, self.extra = len(method.b), len(method.dense.c)
        nx = shape.nx
        self.X, self.Y, self.XN = e.slot(nx), e.slot(nx), e.slot(nx)
        self.U, self.W, self.P = e.slot(shape.nu), e.slot(shape.nw), e.slot(shape.np)
        self.K = [e.slot(nx) for _ in range(self.stages + self.extra)]
        # clocks and controls of the lanes, in memory
        names = ("t", "t_new", "h", "want", "before", "grow", *STATISTICS[:4])
        self.mem = {name: e.slot(1) for name in names}
        self.index, self.row = e.slot(lanes, "i64"), e.slot(lanes, "i64")
        # the step ends in stage `last`, whose slope the next step begins with
        self.last = self.stages - 1 if method.fsal else self.stages

    def get(self, name: str) -> str:
        return self.e.load(self.mem[name], 0)

    def set(self, name: str, value: str) -> None:
        self.e.store(value, self.mem[name], 0)

    def rate(self, at: str, out: str) -> None:
        e = self.e
        e.do(
            f"call void @rate({self.shape.split(e, at)}, ptr {self.U}, ptr {self.W}, ptr {self.P}, ptr {out})"
        )

    def stage(self, i: int, row: Any, h: str) -> None:
        """Slope of stage `i` from the ones before it."""
        terms = [(float(a), self.K[j]) for j, a in enumerate(row[:i]) if a != 0.0]
        combine(self.e, self.Y, self.X, h, terms, self.shape.nx)
        self.rate(self.Y, self.K[i])

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
            atol = splat(e, e.emit(f"load double, ptr {e.element('%atol', i, 'double')}, align 8"))
            scale = e.f("fadd", atol, e.f("fmul", splat(e, "%rtol"), size))
            unit = e.f("fdiv", e.f("fmul", estimate, h), scale)
            e.store(e.f("fadd", e.load(total, 0), e.f("fmul", unit, unit)), total, 0)
        return e.load(total, 0)

    def error_norm(self, h: str) -> str:
        """Root mean square error in units of the tolerance."""
        e, count = self.e, self.e.const(1.0 / self.shape.nx)
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
        many = e.compare("oge", done, splat(e, "%max_steps"))
        status = e.select(many, e.const(TOO_MANY_STEPS), self.get("status"))
        self.set("status", e.select(tiny, e.const(STEP_TOO_SMALL), status))

    def output(self, h: str, accept: str) -> None:
        """States at the requested times inside the accepted steps."""
        e = self.e
        flags = e.slot(e.lanes, "i64")
        wide = e.emit(f"zext {e.B} {accept} to {e.I}")
        e.do(f"store {e.I} {wide}, ptr {flags}, align {e.align}")
        due = e.slot(1, "i64")
        e.put(due, 0)
        with e.loop(e.lanes) as lane:
            _, waiting = self.next_time(lane, flags)
            with e.when(waiting):
                e.put(due, 1)
        with e.when(e.emit(f"icmp ne i64 {e.get(due)}, 0")):
            first = 0 if self.method.fsal else 1
            for k in range(first, self.extra):
                self.stage(self.stages + k, self.method.dense.A[k], h)
            more = e.f("fadd", self.get("evaluations"), e.const(float(self.extra - first)))
            self.set("evaluations", e.select(accept, more, self.get("evaluations")))
            with e.loop(e.lanes) as lane, repeat_while(e) as going:
                time, waiting = self.next_time(lane, flags)
                going(waiting)
                self.write(lane, time)

    def next_time(self, lane: str, flags: str) -> tuple[str, str]:
        """The next requested time of a lane, and whether the step just accepted reaches it."""
        e = self.e
        index = e.emit(f"load i64, ptr {e.element(self.index, lane, 'i64')}, align 8")
        more = e.emit(f"icmp slt i64 {index}, %count")
        safe = e.emit(f"select i1 {more}, i64 {index}, i64 0")
        time = e.emit(f"load double, ptr {e.element('%t_eval', safe, 'double')}, align 8")
        reached = e.emit(f"load double, ptr {e.element(self.mem['t_new'], lane, 'double')}, align 8")
        within = e.emit(f"fcmp ole double {time}, {reached}")
        flag = e.emit(f"load i64, ptr {e.element(flags, lane, 'i64')}, align 8")
        accepted = e.emit(f"icmp ne i64 {flag}, 0")
        both = e.emit(f"and i1 {more}, {within}")
        return time, e.emit(f"and i1 {both}, {accepted}")

    def write(self, lane: str, time: str) -> None:
        """One state of one lane: y + h theta sum_i P_i(2 theta - 1) k_i (see `tableau.Dense`)."""
        e, s, nx = self.e, self.e.sharing(1), self.shape.nx
        t = s.emit(f"load double, ptr {s.element(self.mem['t'], lane, 'double')}, align 8")
        h = s.emit(f"load double, ptr {s.element(self.mem['h'], lane, 'double')}, align 8")
        theta = s.f("fdiv", s.f("fsub", time, t), h)
        x = s.f("fsub", s.f("fadd", theta, theta), s.const(1.0))
        weights = []
        for j, row in enumerate(self.method.dense.P):
            if row.any():
                weights.append((j, s.f("fmul", s.polynomial([float(c) for c in row[::-1]], x), theta)))
        index = s.emit(f"load i64, ptr {s.element(self.index, lane, 'i64')}, align 8")
        row = s.emit(f"load i64, ptr {s.element(self.row, lane, 'i64')}, align 8")
        place = s.emit(f"add nsw i64 {s.emit(f'mul nsw i64 {row}, %count')}, {index}")
        target = s.element("%path", s.emit(f"mul nsw i64 {place}, {nx}"), "double")
        with s.loop(nx) as i:
            entry = s.emit(f"add nsw i64 {s.emit(f'mul nsw i64 {i}, {e.lanes}')}, {lane}")
            total = s.const(0.0)
            for j, weight in weights:
                slope = s.emit(f"load double, ptr {s.element(self.K[j], entry, 'double')}, align 8")
                total = s.f("fadd", total, s.f("fmul", weight, slope))
            start = s.emit(f"load double, ptr {s.element(self.X, entry, 'double')}, align 8")
            s.store(s.f("fadd", start, s.f("fmul", h, total)), target, i)
        normalize(s, target, self.shape.quaternions)
        following = s.emit(f"add nsw i64 {index}, 1")
        s.do(f"store i64 {following}, ptr {s.element(self.index, lane, 'i64')}, align 8")

    def advance(self, accept: str) -> None:
        """Take over the new state and slope in the lanes that accept."""
        e = self.e
        for new, old in ((self.XN, self.X), (self.K[self.last], self.K[0])):
            for i in e.over(self.shape.nx):
                e.store(e.select(accept, e.load(new, i), e.load(old, i)), old, i)
        self.set("t", e.select(accept, self.get("t_new"), self.get("t")))

    def active(self, end: str) -> str:
        """Lanes that have not reached `end` and have not given up."""
        e = self.e
        going = e.compare("olt", self.get("t"), end)
        sound = e.compare("oeq", self.get("status"), e.const(OK))
        return e.emit(f"and {e.B} {going}, {sound}")

    def period(self, end: str) -> None:
        """Steps up to `end`."""
        e, method = self.e, self.method
        self.rate(self.X, self.K[0])
        sound = e.compare("oeq", self.get("status"), e.const(OK))
        one_more = e.f("fadd", self.get("evaluations"), e.const(1.0))
        self.set("evaluations", e.select(sound, one_more, self.get("evaluations")))
        with repeat_while(e) as going:
            active = self.active(end)
            going(any_lane(e, active))
            h = self.length(end, active)
            self.set("h", h)
            for i in range(1, self.stages):
                self.stage(i, method.A[i], h)
            terms = [(float(b), k) for b, k in zip(method.b, self.K, strict=False) if b != 0.0]
            advance(e, self.XN, self.X, h, terms, self.shape.nx)
            normalize(e, self.XN, self.shape.quaternions)
            accept = self.judge(h, active)
            if not method.fsal:
                self.rate(self.XN, self.K[self.last])
            self.output(h, accept)
            self.advance(accept)

    def batch(self) -> None:
        """All blocks of the batch."""
        e, shape = self.e, self.shape
        with e.loop("%n", e.lanes) as first:
            block = Block(e, first, "%n")
            control = Control(e, shape, block, self.U)
            block.gather(block.pointers("%x0", shape.nx), self.X, shape.nx)
            block.gather(block.pointers("%p", "%p_state"), self.P, shape.np)
            block.gather(block.pointers("%h0", 1), self.mem["want"], 1)
            for lane, row in enumerate(block.rows):
                e.do(f"store i64 {row}, ptr {e.element(self.row, lane, 'i64')}, align 8")
                e.do(f"store i64 %first_eval, ptr {e.element(self.index, lane, 'i64')}, align 8")
            self.set("t", splat(e, "%t0"))
            for name, value in (("before", 0.0), ("grow", GROW), *((s, 0.0) for s in STATISTICS[:4])):
                self.set(name, e.const(value))
            with e.loop("%periods") as period:
                control.hold(period, self.X)
                after = e.emit(f"add nsw i64 {period}, 1")
                final = e.emit(f"icmp eq i64 {after}, %periods")
                number = e.emit(f"sitofp i64 {after} to double")
                edge = e.emit(f"fadd double %t0, {e.emit(f'fmul double {number}, %hold')}")
                self.period(splat(e, e.emit(f"select i1 {final}, double %t1, double {edge}")))
            block.scatter(self.X, block.pointers("%x1", shape.nx), shape.nx)
            for k, name in enumerate((*STATISTICS[:4], "want")):
                pointers = [e.element(x, k, "double") for x in block.pointers("%stats", len(STATISTICS))]
                block.scatter(self.mem[name], pointers, 1)


def adaptive_steps(name: str, method: Any, shape: Shape, lanes: int) -> str:
    """Integration to a tolerance, as IR.

    `void name(n, periods, t0, t1, hold, rtol, atol, max_steps, x0, h0, controls..., p, p_state, t_eval,
    count, first_eval, path, x1, stats)`: control periods of `hold` seconds; `path` receives the states at
    t_eval from index `first_eval` on, `x1` the final states, `stats` the STATISTICS of every state.
    """
    writer = _Integrator(method, shape, lanes)
    writer.batch()
    arguments = ["i64 %n", "i64 %periods", "double %t0", "double %t1", "double %hold", "double %rtol"]
    arguments += ["ptr noalias %atol", "double %max_steps", "ptr noalias %x0", "ptr noalias %h0"]
    arguments += CONTROL_ARGUMENTS
    arguments += ["ptr noalias %p", "i64 %p_state", "ptr noalias %t_eval", "i64 %count", "i64 %first_eval"]
    arguments += ["ptr noalias %path", "ptr noalias %x1", "ptr noalias %stats"]
    return function(name, arguments, writer.e)
