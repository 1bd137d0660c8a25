"""Damped least squares of one problem's structure as a whole in machine code, many starts in SIMD lanes."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...compile import jit
from ...compile.cache import Cache, default_folder, key_of
from ...compile.kernels import kernel
from ...compile.llvm import Emitter, declarations
from ...compile.loops import Block, declare, function, map_function
from ...compile.program import address, facts_of, obtain
from ..goals import Goal, Rows
from .iteration import iteration_tape, rows_tape
from .layout import Layout, arguments, layout
from .rows import expressible

if TYPE_CHECKING:
    from ..problem import Problem

Array = NDArray[np.float64]
_STALL = 8  # iterations without progress that end an attempt
_PROGRESS = 0.99
_FIRST_DAMPING, _DOWN, _UP = 1e-2, 0.2, 6.0
_SHORT, _SOFT = 1e-10, 3e-8  # a step so short ends the way along goals, without and with wishes beside q0


class Ends(NamedTuple):
    """Where starts ended: q (n, nq), cost (n,), largest residual over tolerance (n,), iterations (n,)."""

    q: Array
    cost: Array
    worst: Array
    iterations: Array


class Settlings(NamedTuple):
    """Where ways along goals ended: q (n, nq), value (n,) of wishes, largest residual over tolerance (n,),
    last step (n,), iterations (n,)."""

    q: Array
    value: Array
    worst: Array
    step: Array
    iterations: Array


class _Lanes:
    """Buffers of one compiled loop over blocks of starts, and the call of the iteration in it."""

    def __init__(self, e: Emitter, at: Layout, names: tuple[str, ...]):
        self.e, self.nq, self.holds, self.steps = e, at.nq, at.holds, at.steps
        self.P, self.Q, self.N, self.A = e.slot(at.nq), e.slot(at.nq), e.slot(at.nq), e.slot(at.size)
        self.hold, self.held = e.slot(at.holds), e.slot(at.holds)
        self.before, self.step, self.past, self.now = (e.slot(k) for k in (at.steps, at.steps, 2, 2))
        names = (*names, "used", "cost", "worst", "value", "longest", "live", "count")
        self.cells = {name: e.slot(1) for name in names}
        with e.loop(at.size) as i:
            x = e.emit(f"load double, ptr {e.element('%a', i, 'double')}, align 8")
            e.store(e.splat(x), self.A, i)

    def start(self, block: Block, values: dict[str, float]) -> None:
        """Points from the rows of a block, and cells as at first."""
        e = self.e
        block.gather(block.pointers("%starts", self.nq), self.P, self.nq)
        with e.loop(self.nq) as i:
            e.store(e.load(self.P, i), self.Q, i)
        for buffer, size in ((self.hold, self.holds), (self.past, 2), (self.before, self.steps)):
            with e.loop(size) as i:
                e.store(e.const(0.0), buffer, i)
        for name, value in values.items():
            e.store(e.const(value), self.cells[name], 0)

    def end(self, block: Block, names: tuple[str, ...]) -> None:
        """Points and facts of a block."""
        block.scatter(self.Q, block.pointers("%q", self.nq), self.nq)
        facts = block.pointers("%facts", len(names))
        for k, name in enumerate(names):
            block.scatter(self.cells[name], [self.e.element(f, k, "double") for f in facts], 1)

    def iterate(self) -> None:
        """The step from P to N and what holds there."""
        cells = [self.cells[name] for name in ("cost", "worst", "value", "longest")]
        pointers = [self.P, self.cells["used"], self.hold, self.past, self.before, self.A, self.N,
                    *cells, self.held, self.now, self.step]  # fmt: skip
        self.e.do(f"call void @f({', '.join(f'ptr {x}' for x in pointers)})")

    def get(self, name: str) -> str:
        """Value of a cell in all lanes."""
        return self.e.load(self.cells[name], 0)

    def put(self, name: str, value: str) -> None:
        """Set a cell in all lanes."""
        self.e.store(value, self.cells[name], 0)

    def both(self, a: str, b: str, op: str = "and") -> str:
        """Conditions of all lanes together."""
        return self.e.emit(f"{op} {self.e.B} {a}, {b}")

    def some(self, condition: str) -> str:
        """Whether a condition holds in any lane."""
        bits = self.e.emit(f"bitcast {self.e.B} {condition} to i{self.e.lanes}")
        return self.e.emit(f"icmp ne i{self.e.lanes} {bits}, 0")

    @contextmanager
    def repeated(self) -> Iterator[None]:
        """A pass, again and again while a lane is live."""
        e, name = self.e, self.e.label("R")
        e.do(f"br label %{name}.pass")
        e.lines.append(f"{name}.pass:")
        yield
        more = self.some(e.compare("ogt", self.get("live"), e.const(0.0)))
        e.do(f"br i1 {more}, label %{name}.pass, label %{name}.end")
        e.lines.append(f"{name}.end:")


_ARGUMENTS = ["i64 %n", "ptr noalias %starts", "ptr noalias %a", "i64 %iterations", "i64 %first",
              "ptr noalias %q", "ptr noalias %facts"]  # fmt: skip


def descend_loop(at: Layout, lanes: int) -> str:
    """IR of `void descend(i64 n, starts, a, i64 iterations, i64 first, q, facts)`.

    Levenberg-Marquardt from each of n starts, as `numeric.descend` has it. A pass computes cost and step at a
    point P; a point that is not better gives way to the best one, Q, whose step is computed once more with
    more damping. With `first` a lane ends when it meets the goals, and so do all that have taken as many
    iterations. `facts` (n, 3): cost, worst, iterations.
    """
    e = Emitter(lanes)
    b = _Lanes(e, at, ("mu", "best", "far", "stall", "again", "cap"))
    b.put("cap", e.splat(e.emit("sitofp i64 %iterations to double")))
    with e.loop("%n", lanes) as i:
        block = Block(e, i, "%n")
        b.start(block, {"mu": _FIRST_DAMPING / _DOWN, "best": 1e300, "far": 1e300, "stall": 0.0,
                        "count": -1.0, "again": 0.0, "live": 1.0})  # fmt: skip
        with b.repeated():
            _descend_pass(e, b)
        b.end(block, ("best", "far", "count"))
    return function("descend", _ARGUMENTS, e)


def _descend_pass(e: Emitter, b: _Lanes) -> None:
    one, zero = e.const(1.0), e.const(0.0)
    b.put("used", e.f("fmul", b.get("mu"), e.const(_DOWN)))
    b.iterate()
    live, again = (e.compare("ogt", b.get(name), zero) for name in ("live", "again"))
    cost, best, count = b.get("cost"), b.get("best"), b.get("count")
    better = b.both(e.compare("olt", cost, best), live)
    take = b.both(b.both(better, again, "or"), live)
    nearer = e.compare("olt", cost, e.f("fmul", best, e.const(_PROGRESS)))
    best, far = e.select(better, cost, best), e.select(better, b.get("worst"), b.get("far"))
    b.put("best", best)
    b.put("far", far)
    raised = e.call("minnum", e.f("fmul", b.get("mu"), e.const(_UP / _DOWN)), e.const(1e12 / _DOWN))
    b.put("mu", e.select(take, e.call("maxnum", b.get("used"), e.const(1e-12)), raised))
    stall = b.get("stall")
    stall = e.select(again, stall, e.select(nearer, zero, e.f("fadd", stall, one)))
    b.put("stall", stall)
    count = e.select(again, count, e.select(live, e.f("fadd", count, one), count))
    b.put("count", count)
    with e.loop(b.nq) as i:
        q = e.select(better, e.load(b.P, i), e.load(b.Q, i))
        e.store(q, b.Q, i)
        e.store(e.select(take, e.load(b.N, i), q), b.P, i)
    b.put("again", e.select(take, zero, one))
    with e.when(e.emit("icmp ne i64 %first, 0")):  # no lane takes more iterations than the quickest to meet
        met = b.both(e.compare("ole", far, one), live)
        least = e.emit(f"call double @llvm.vector.reduce.fmin.{e.suffix}({e.V} "
                       f"{e.select(met, count, e.const(1e300))})")  # fmt: skip
        b.put("cap", e.call("minnum", e.splat(least), b.get("cap")))
    tight = b.both(e.compare("ole", far, e.const(1e-3)), e.compare("olt", best, e.const(1e-18)))
    over = b.both(tight, e.compare("olt", best, e.const(1e-26)), "or")
    over = b.both(over, e.compare("oge", stall, e.const(_STALL)), "or")
    over = b.both(over, e.compare("oge", count, b.get("cap")), "or")
    b.put("live", e.select(over, zero, b.get("live")))


def settle_loop(at: Layout, lanes: int) -> str:
    """IR of `void settle(i64 n, starts, a, i64 iterations, i64 first, q, facts)`.

    Steps along the goals from each of n starts until one is short. `facts` (n, 4): value, worst, longest
    entry of the last step, iterations.
    """
    e = Emitter(lanes)
    b = _Lanes(e, at, ())
    short = _SOFT if len(at.soft) else _SHORT
    zero, one = e.const(0.0), e.const(1.0)
    most = e.splat(e.emit("sitofp i64 %iterations to double"))
    with e.loop("%n", lanes) as i:
        block = Block(e, i, "%n")
        b.start(block, {"used": 0.0, "count": 0.0, "live": 1.0})
        with b.repeated():
            b.iterate()
            changed = e.emit(f"bitcast i{lanes} 0 to {e.B}")
            for k in range(at.holds):
                before, after = e.load(b.hold, k), e.load(b.held, k)
                changed = b.both(changed, e.compare("one", before, after), "or")
                e.store(after, b.hold, k)
            going = b.both(e.compare("ogt", b.get("longest"), e.const(short)), changed, "or")
            count = e.f("fadd", b.get("count"), b.get("live"))
            b.put("count", count)
            going = b.both(going, e.compare("olt", count, most))
            going = b.both(going, e.compare("ogt", b.get("live"), zero))
            for source, into, size in ((b.now, b.past, 2), (b.step, b.before, at.steps)):
                with e.loop(size) as j:
                    e.store(e.load(source, j), into, j)
            with e.loop(b.nq) as j:
                q = e.load(b.P, j)
                e.store(q, b.Q, j)
                e.store(e.select(going, e.load(b.N, j), q), b.P, j)
            b.put("live", e.select(going, one, zero))
        b.end(block, ("value", "worst", "longest", "count"))
    return function("settle", _ARGUMENTS, e)


class Machine:
    """Compiled rows and descents of one structure of problems."""

    def __init__(self, at: Layout, code: Any, lanes: int):
        facts = code.facts
        self.layout, self.lanes, self.build = at, lanes, code.build
        self.entries = np.array(facts["entries"], dtype=int).reshape(-1, 2).T
        self.m, self.nq, self.nv = facts["m"], facts["nq"], facts["nv"]  # rows, those of wishes with them
        p, i = ctypes.c_void_p, ctypes.c_int64
        self._descend = code.loaded.function("descend", i, p, p, i, i, p, p)
        self._settle: Any = code.loaded.function("settle", i, p, p, i, i, p, p) if at.along else None
        self._map = code.loaded.function("map", i, p, i, p, i, p, p)

    def arguments(self, problem: Problem, *, q0: Array | None = None, s: float = 1.0) -> Array:
        """What a problem of this structure aims at, for `rows` and `descend`; with q0 (nq,) for `settle`."""
        return arguments(problem, self.layout, q0=q0, s=s)

    def rows(self, q: Array, a: Array) -> Rows:
        """Residuals (n, m) and Jacobian (n, m, nv) at q (n, nq), of goals, loops and wishes."""
        q, n = np.ascontiguousarray(q), len(q)
        r, values = np.empty((n, self.m)), np.empty((n, self.entries.shape[1]))
        J = np.zeros((n, self.m, self.nv))
        if n:
            self._map(n, address(q), self.nq, address(a), 0, address(r), address(values))
            J[:, self.entries[0], self.entries[1]] = values
        return Rows(r, J)

    def descend(self, q: Array, a: Array, *, iterations: int, first: bool) -> Ends:
        """Levenberg-Marquardt from each row of q (n, nq), which is inside the limits."""
        q, n = np.ascontiguousarray(q), len(q)
        out, facts = np.empty((n, self.nq)), np.empty((n, 3))
        if n:
            self._descend(n, address(q), address(a), iterations, int(first), address(out), address(facts))
        return Ends(out, facts[:, 0], facts[:, 1], facts[:, 2])

    def settle(self, q: Array, a: Array, *, iterations: int = 150) -> Settlings:
        """The way along the goals to what is wished from each row of q (n, nq), as `numeric.settle` goes."""
        q, n = np.ascontiguousarray(q), len(q)
        out, facts = np.empty((n, self.nq)), np.empty((n, 4))
        if n:
            self._settle(n, address(q), address(a), iterations, 0, address(out), address(facts))
        return Settlings(out, *facts.T)


@lru_cache(maxsize=1)
def _source() -> str:
    here = Path(__file__).parent
    files = [here / f"{name}.py" for name in ("machine", "iteration", "layout", "rows", "seen", "algebra")]
    files += sorted((here.parents[1] / "compile").glob("*.py"))
    return key_of(*(file.read_bytes() for file in files))


def structure(problem: Problem) -> str | None:
    """Name of everything that the compiled code of a problem depends on; None when it cannot be compiled."""
    if not (expressible(problem) and (problem.wished is None or expressible(problem.wished))):
        return None
    wished = problem.wished
    rows = [problem.moved, np.isfinite(problem.tolerance), problem.band > 0]
    rows += [] if wished is None else [np.isfinite(wished.tolerance), wished.band > 0]
    goals = [words(g) for g in (*problem.goals, *(() if wished is None else wished.goals))]
    loops = [(loop.label, loop.a, loop.b) for loop in problem.loops]
    text = repr((len(problem.goals), goals, loops, problem.model.nq, problem.model.nv, _source()))
    return key_of(text, *numbers(problem.model), *(x.tobytes() for x in rows))


def numbers(model: mujoco.MjModel) -> list[bytes]:
    """Everything in a model that its kinematics, masses and equalities follow from."""
    arrays = [
        model.jnt_type, model.jnt_pos, model.jnt_axis, model.jnt_limited, model.jnt_bodyid,
        model.body_parentid, model.body_pos, model.body_quat, model.body_ipos, model.body_mass,
        model.body_mocapid, model.qpos0, model.site_bodyid, model.site_pos, model.site_quat,
        model.geom_bodyid, model.geom_pos, model.geom_quat, model.cam_bodyid, model.cam_pos, model.cam_quat,
        model.eq_type, model.eq_obj1id, model.eq_obj2id, model.eq_objtype, model.eq_data, model.eq_active0,
    ]  # fmt: skip
    return [model.names, *(x.tobytes() for x in arrays)]


def words(goal: Goal) -> list[str | tuple[str, ...]]:
    """A goal without its numbers: its kind, and the names it gives in order."""
    own = [getattr(goal, key) for key in goal.__dataclass_fields__ if key != "name"]
    names = [x for x in own if isinstance(x, str) or (isinstance(x, tuple) and x and isinstance(x[0], str))]
    return [type(goal).__name__, *("-" if x is None else str(np.shape(x)) for x in own), *names]


class _Absent(Exception):
    """Nothing on disk."""


def compiled(problem: Problem, name: str, *, cached: bool = False) -> Machine:
    """The machine of a problem whose structure has this name, from the disk cache where it is there.

    With `cached`, only from there: _Absent otherwise.
    """
    lanes = jit.preferred_lanes()
    at = layout(problem)

    def make() -> tuple[str, str, dict[str, Any]]:
        if cached:
            raise _Absent
        return _source_of(problem, at, lanes)

    key = key_of(name, str(lanes), repr((jit.host(), jit.llvm_version())))
    return Machine(at, obtain("descend", lanes, Cache(default_folder()), key, make), lanes)


def _source_of(problem: Problem, at: Layout, lanes: int) -> tuple[str, str, dict[str, Any]]:
    """Kernels, loops and facts."""
    rows, entries = rows_tape(problem, at)
    step = iteration_tape(problem, at)
    V, nq = f"<{lanes} x double>", problem.space.nq
    head = declarations(lanes) + "\n"
    more = "".join(f"declare {V} @llvm.{x}.v{lanes}f64({V}, {V})\n" for x in ("minnum", "maxnum"))
    more += f"declare double @llvm.vector.reduce.fmin.v{lanes}f64({V})\n"
    loops = head + more + declare("f", step) + declare("g", rows)
    loops += descend_loop(at, lanes) + map_function("map", "g", rows, lanes)
    loops += settle_loop(at, lanes) if at.along else ""
    facts = {"entries": entries, "m": rows.outputs["r"], "nq": nq, "nv": problem.space.nv}
    return head + kernel("f", step, lanes) + kernel("g", rows, lanes), loops, facts_of(step) | facts


class Prepared(NamedTuple):
    """A machine with what one problem aims at."""

    machine: Machine
    a: Array


@dataclass
class _Case:
    """One structure in this process: seconds spent on it without a machine, and the machine."""

    machine: Machine | None = None
    spent: float = 0.0


_CASES: dict[str, _Case] = {}
_MOST_CASES = 200


def prepared(problem: Problem, name: str, *, build: bool = False, at_once: bool = False) -> Prepared | None:
    """The machine of a problem, when it is worth having.

    A structure compiled before comes from the disk. With `build`, a new one is compiled once as many seconds
    were `charge`d to it in NumPy as compiling will take: whatever follows, this costs at most twice the best.
    With `at_once` it does not wait for that.
    """
    case = _CASES.get(name)
    if case is None:
        if len(_CASES) >= _MOST_CASES:
            del _CASES[next(iter(_CASES))]
        case = _CASES[name] = _Case()
        with suppress(_Absent):
            case.machine = compiled(problem, name, cached=True)
    if build and case.machine is None and (at_once or case.spent > _expected(problem)):
        case.machine = compiled(problem, name)
    return None if case.machine is None else Prepared(case.machine, case.machine.arguments(problem))


def charge(name: str, seconds: float) -> None:
    """Count what the absence of a machine cost."""
    if name in _CASES:
        _CASES[name].spent += seconds


def _expected(problem: Problem) -> float:
    """Seconds that compiling will take, from the size of the Jacobian (measured on a 2.5 GHz core)."""
    return 0.2 + 1.5e-3 * problem.m * int(problem.moved.sum())
