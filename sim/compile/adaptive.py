"""Whole integrations with steps that follow a tolerance, emitted as IR.

Output at requested times by the method's continuous extension; see `step_control` for the steps.
"""

from __future__ import annotations

from typing import Any

from .llvm import Emitter
from .loops import Block, function
from .pieces import pieces_function, repeat_while
from .rollout import CONTROL_ARGUMENTS, Control, Shape, advance, combine, normalize
from .step_control import GROW, GUARDED, OK, STATISTICS, Stepping


def any_lane(e: Emitter, condition: str) -> str:
    """Whether a condition holds in some lane."""
    if e.lanes == 1:
        return condition
    packed = e.emit(f"bitcast {e.B} {condition} to i{e.lanes}")
    return e.emit(f"icmp ne i{e.lanes} {packed}, 0")


class _Integrator(Stepping):
    """Writes the body of one adaptive integration."""

    def __init__(self, method: Any, shape: Shape, lanes: int, guards: int, rateless: int, pulling: range):
        super().__init__(method, shape, lanes)
        e = self.e
        self.guards, self.pulling = guards, pulling
        self.rateless = range(guards - rateless, guards)
        self.G, self.G_rate, self.GN, self.GN_rate = (e.slot(guards) for _ in range(4))
        self.index, self.row = e.slot(lanes, "i64"), e.slot(lanes, "i64")

    def guard(self, at: str, values: str, rates: str) -> None:
        """The functions that the integration must not pass zero of, and their rates."""
        e = self.e
        e.do(
            f"call void @guard({self.shape.split(e, at)}, ptr {self.U}, ptr {self.W}, ptr {self.P}, "
            f"ptr %offsets, ptr {values}, ptr {rates})"
        )

    def differences(self, h: str) -> None:
        """Rates at both ends of a step of the guards that come without, by differences along the slopes."""
        e, beside, unused = self.e, self.e.slot(self.guards), self.e.slot(self.guards)
        ends = (
            (self.X, self.K[0], self.get("t"), 1e-4, self.G, self.G_rate),
            (self.XN, self.K[self.last], self.get("t_new"), -1e-4, self.GN, self.GN_rate),
        )
        for x, slope, t, share, values, rates in ends:
            d = e.f("fmul", h, e.const(share))
            combine(e, self.Y, x, d, [(1.0, slope)], self.shape.nx)
            self.prescribe(e.f("fadd", t, d))
            self.guard(self.Y, beside, unused)
            for i in self.rateless:
                change = e.f("fsub", e.load(beside, i), e.load(values, i))
                e.store(e.f("fdiv", change, d), rates, i)

    def hold_back(self, h: str, accept: str) -> str:
        """The lanes that accept without those where a guard is below zero at the step's end, or may have
        been in between: it fell at the start and rises at the end, near enough to zero."""
        e = self.e
        self.guard(self.XN, self.GN, self.GN_rate)
        if self.rateless:
            self.differences(h)
        stop = e.compare("one", e.const(0.0), e.const(0.0))
        for i in range(self.guards):
            before, after = e.load(self.G, i), e.load(self.GN, i)
            fall, rise = e.load(self.G_rate, i), e.load(self.GN_rate, i)
            lower = e.select(e.compare("olt", before, after), before, after)
            turned = e.emit(
                f"and {e.B} {e.compare('olt', fall, e.const(0.0))}, {e.compare('ogt', rise, e.const(0.0))}"
            )
            near = e.compare("olt", lower, e.f("fmul", h, e.f("fsub", rise, fall)))
            dipped = e.emit(f"and {e.B} {turned}, {near}")
            for suspect in (e.compare("olt", after, e.const(0.0)), dipped):
                stop = e.emit(f"or {e.B} {stop}, {suspect}")
        stop = e.emit(f"and {e.B} {stop}, {accept}")
        self.set("status", e.select(stop, e.const(GUARDED), self.get("status")))
        self.set("want", e.select(stop, h, self.get("want")))
        accept = e.emit(f"xor {e.B} {accept}, {stop}")
        for new, old in ((self.GN, self.G), (self.GN_rate, self.G_rate)):
            for i in range(self.guards):
                e.store(e.select(accept, e.load(new, i), e.load(old, i)), old, i)
        return accept

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
                self.stage(self.stages + k, self.method.dense.A[k], float(self.method.dense.c[k]), h)
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
        # what a step ends with is written by the next one: values may jump in between
        within = e.emit(f"fcmp olt double {time}, {reached}")
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

    def output_end(self) -> None:
        """States at requested times that are where the lanes have come to."""
        e = self.e
        flags = e.slot(e.lanes, "i64")
        # as if a step of any length began here, and the next number were its end
        self.set("h", e.const(1.0))
        ulp = e.f("fadd", e.f("fmul", e.call("fabs", self.get("t")), e.const(2.0**-52)), e.const(5e-324))
        self.set("t_new", e.f("fadd", self.get("t"), ulp))
        with e.loop(e.lanes) as lane:
            e.do(f"store i64 1, ptr {e.element(flags, lane, 'i64')}, align 8")
            with repeat_while(e) as going:
                time, waiting = self.next_time(lane, flags)
                going(waiting)
                self.write(lane, time)

    def jump(self, number: str) -> None:
        """Velocities that prescribed joints take up at once pull the others along: dv = -M_pp^-1 M_pk dv_k,
        the difference of the accelerations with dv_k and with nothing prescribed."""
        e, s = self.e, self.e.sharing(1)
        self.prescribe(self.get("t"))
        row = s.emit(f"mul nsw i64 {number}, {len(self.pulling)}")
        for slope, pulled in ((self.K[0], True), (self.K[1], False)):
            for k, at in enumerate(self.pulling):
                entry = s.element("%jumps", s.emit(f"add nsw i64 {row}, {k}"), "double")
                value = e.splat(s.emit(f"load double, ptr {entry}, align 8")) if pulled else e.const(0.0)
                e.store(value, self.W, at)
            self.evaluate(self.X, slope)
        sound = e.compare("oeq", self.get("status"), e.const(OK))
        for i in range(self.shape.nq, self.shape.nq + self.shape.nv):
            change = e.f("fsub", e.load(self.K[0], i), e.load(self.K[1], i))
            e.store(e.f("fadd", e.load(self.X, i), e.select(sound, change, e.const(0.0))), self.X, i)

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
        self.rate(self.X, self.K[0], self.get("t"))
        if self.guards:
            self.guard(self.X, self.G, self.G_rate)
        sound = e.compare("oeq", self.get("status"), e.const(OK))
        one_more = e.f("fadd", self.get("evaluations"), e.const(1.0))
        self.set("evaluations", e.select(sound, one_more, self.get("evaluations")))
        with repeat_while(e) as going:
            active = self.active(end)
            going(any_lane(e, active))
            h = self.length(end, active)
            self.set("h", h)
            for i in range(1, self.stages):
                self.stage(i, method.A[i], float(method.c[i]), h)
            terms = [(float(b), k) for b, k in zip(method.b, self.K, strict=False) if b != 0.0]
            advance(e, self.XN, self.X, h, terms, self.shape.nx)
            normalize(e, self.XN, self.shape.quaternions)
            accept = self.judge(h, active)
            if not method.fsal:
                self.rate(self.XN, self.K[self.last], self.get("t_new"))
            if self.guards:
                accept = self.hold_back(h, accept)
            self.output(h, accept)
            self.advance(accept)

    def of_span(self, span: str, k: int) -> str:
        """Entry `k` of what is known of a span."""
        e = self.e
        at = e.emit(f"add nsw i64 {e.emit(f'mul nsw i64 {span}, 4')}, {k}")
        return e.emit(f"load i64, ptr {e.element('%of_span', at, 'i64')}, align 8")

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
                e.do(f"store i64 0, ptr {e.element(self.piece, lane, 'i64')}, align 8")
            self.set("t", e.splat("%t0"))
            for name, value in (("before", 0.0), ("grow", GROW), *((s, 0.0) for s in STATISTICS[:4])):
                self.set(name, e.const(value))
            sampled = e.slot(1, "i64")
            e.put(sampled, -1)
            with e.loop("%spans") as span:
                period, self.first_piece, self.last_piece, jump = (self.of_span(span, k) for k in range(4))
                with e.when(e.emit(f"icmp ne i64 {period}, {e.get(sampled)}")):
                    control.hold(period, self.X)
                    e.put(sampled, period)
                if self.pulling:
                    with e.when(e.emit(f"icmp sge i64 {jump}, 0")):
                        self.jump(jump)
                edge = e.emit(f"load double, ptr {e.element('%edges', span, 'double')}, align 8")
                self.period(e.splat(edge))
            self.output_end()
            block.scatter(self.X, block.pointers("%x1", shape.nx), shape.nx)
            for k, name in enumerate((*STATISTICS[:4], "want", "t")):
                pointers = [e.element(x, k, "double") for x in block.pointers("%stats", len(STATISTICS))]
                block.scatter(self.mem[name], pointers, 1)


def adaptive_steps(
    name: str,
    method: Any,
    shape: Shape,
    lanes: int,
    *,
    guards: int = 0,
    rateless: int = 0,
    pulling: range = range(0),
) -> str:
    """Integration to a tolerance, as IR.

    `void name(n, periods, spans, edges, of_span, t0, rtol, atol, max_steps, x0, h0, controls..., p, p_state,
    knots, coefficients, terms, jumps, offsets, t_eval, count, first_eval, path, x1, stats)`: no step crosses
    the end of a span, `edges`; `of_span` says for each span its control period, the first and last piece of
    the prescribed motion (see `pieces_function`), and which of `jumps` its start is, or -1: changes of the
    prescribed velocities, whose accelerations are the entries `pulling` of w. `path` receives the states at
    t_eval from index `first_eval` on, `x1` the final states, `stats` the STATISTICS of every state. With
    `guards`, the kernel `guard` (q, v, act, u, w, p, offsets) -> values and rates: a state stops before the
    step that may take a value below zero, with status GUARDED and that step's length as the next one's; the
    last `rateless` guards come without rates.
    """
    writer = _Integrator(method, shape, lanes, guards, rateless, pulling)
    writer.batch()
    arguments = ["i64 %n", "i64 %periods", "i64 %spans", "ptr noalias %edges", "ptr noalias %of_span"]
    arguments += ["double %t0", "double %rtol"]
    arguments += ["ptr noalias %atol", "double %max_steps", "ptr noalias %x0", "ptr noalias %h0"]
    arguments += CONTROL_ARGUMENTS
    arguments += ["ptr noalias %p", "i64 %p_state", "ptr noalias %knots", "ptr noalias %coefficients"]
    arguments += ["i64 %terms", "ptr noalias %jumps", "ptr noalias %offsets", "ptr noalias %t_eval"]
    arguments += [
        "i64 %count",
        "i64 %first_eval",
        "ptr noalias %path",
        "ptr noalias %x1",
        "ptr noalias %stats",
    ]
    motion = pieces_function("prescribed", shape.nw, lanes) if shape.nw else ""
    return motion + function(name, arguments, writer.e)
