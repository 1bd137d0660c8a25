"""A tape as LLVM IR: functions over one state or over lanes of states.

For one state the equal limbs of a robot share instructions (`packs`), and so do the sines of its angles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .graph import (
    ABS,
    ADD,
    ATAN2,
    CONST,
    COS,
    INPUT,
    INV,
    LANE,
    LESS,
    MAX,
    MIN,
    MUL,
    NEG,
    ROUND,
    SIN,
    SQRT,
    SUB,
    VECTOR,
)
from .llvm import Emitter
from .packs import Pack, Source, find_packs
from .tape import Tape

INLINE_COST = 200  # operations up to which a kernel is inlined into its loops
CHUNK = 3000  # steps in one function: compile time grows faster than length
_BINARY = {ADD: "fadd", SUB: "fsub", MUL: "fmul"}
_LEAVES = (CONST, INPUT)


def kernel(name: str, tape: Tape, lanes: int) -> str:
    """IR of `tape` as `void name(ptr inputs..., ptr outputs...)`; scalar k of an argument fills lanes k.

    A long tape is cut into functions that hand values on through memory.
    """
    arguments = [f"ptr noalias nocapture readonly %in{k}" for k in range(len(tape.inputs))]
    arguments += [f"ptr noalias nocapture %out{k}" for k in range(len(tape.outputs))]
    schedule = Schedule(tape, find_packs(tape) if lanes == 1 else [])
    if len(schedule.chunks) == 1:
        e = Emitter(lanes)
        _Writer(e, schedule).write(0)
        return _function(name, arguments, e)
    texts, outer = [], Emitter(lanes)
    work = outer.emit(f"alloca [{max(schedule.words, 1)} x {outer.V}], align 64")
    passed = ", ".join("ptr " + argument.split()[-1] for argument in arguments)
    for k in range(len(schedule.chunks)):
        e = Emitter(lanes)
        _Writer(e, schedule).write(k)
        texts.append(_function(f"{name}.{k}", [*arguments, "ptr noalias nocapture %work"], e))
        outer.do(f"call void @{name}.{k}({passed}, ptr {work})")
    return "".join([*texts, _function(name, arguments, outer)])


def _function(name: str, arguments: list[str], e: Emitter) -> str:
    body = "\n".join(e.lines)
    return f"define void @{name}({', '.join(arguments)}) nounwind {{\n{body}\n  ret void\n}}\n"


class Schedule:
    """Steps of a tape in the order of execution, each the first row of a pack or a row by itself.

    Attributes:
        home: pack of every packed row.
        chunks: steps of every function.
        slots: places in memory for the steps whose values cross from function to function.
        words: size of that memory.
    """

    def __init__(self, tape: Tape, packs: list[Pack]):
        self.tape, self.packs = tape, packs
        self.home = {row: pack for pack in packs for row in pack.rows}
        order = self._order() if packs else [i for i, row in enumerate(tape.rows) if row[0] not in _LEAVES]
        chunk_of = self._chunk_of(order)
        self.chunks: list[list[int]] = [[] for _ in range(max(chunk_of.values(), default=0) + 1)]
        for step in order:
            self.chunks[chunk_of[step]].append(step)
        self.slots, self.words = self._slots(chunk_of)

    def step(self, row: int) -> int:
        """The step at which a row is computed."""
        return self.home[row].rows[0] if row in self.home else row

    def needs(self, step: int) -> Iterable[int]:
        """Steps before this one."""
        if step in self.home:
            rows: Iterable[int] = (row for source in self.home[step].sources for row in source.rows)
        else:
            rows = self.tape.operands(step)
        for row in rows:
            if self.tape.rows[row][0] not in _LEAVES:
                yield self.step(row)

    def _order(self) -> list[int]:
        """Depth first, in the order of the tape where packs leave a choice."""
        order: list[int] = []
        done: set[int] = set()
        for row, (op, _, _) in enumerate(self.tape.rows):
            stack = [] if op in _LEAVES else [self.step(row)]
            while stack:
                step = stack[-1]
                missing = [] if step in done else [s for s in self.needs(step) if s not in done]
                if missing:
                    stack += reversed(missing)
                    continue
                stack.pop()
                if step not in done:
                    done.add(step)
                    order.append(step)
        return order

    def _chunk_of(self, order: list[int]) -> dict[int, int]:
        """Function of every step; both of a sine-cosine pair belong where the first one is."""
        count = len(order) // CHUNK if len(order) > CHUNK * 4 // 3 else 0
        chunk_of: dict[int, int] = {}
        pair: dict[int, int] = {}
        for place, step in enumerate(order):
            chunk_of[step] = min(place // CHUNK, count)
            op, a, _ = self.tape.rows[step]
            if op in (SIN, COS):
                chunk_of[step] = pair.setdefault(a, chunk_of[step])
        return chunk_of

    def _slots(self, chunk_of: dict[int, int]) -> tuple[dict[int, int], int]:
        last: dict[int, int] = {}
        for step, chunk in chunk_of.items():
            for needed in self.needs(step):
                if chunk_of[needed] != chunk:
                    last[needed] = max(last.get(needed, 0), chunk)
        slots: dict[int, int] = {}
        free: dict[int, list[int]] = {}
        ends: dict[int, list[int]] = {}
        words = 0
        for step in sorted(last, key=chunk_of.__getitem__):
            for chunk in [c for c in ends if c < chunk_of[step]]:
                for done in ends.pop(chunk):
                    free.setdefault(self._width(done), []).append(slots[done])
            width = self._width(step)
            if free.get(width):
                slots[step] = free[width].pop()
            else:
                slots[step] = words
                words += width
            ends.setdefault(last[step], []).append(step)
        return slots, words

    def _width(self, step: int) -> int:
        return len(self.home[step].rows) if step in self.home else self.tape.widths[step]


class _Writer:
    """Instructions of one chunk; values from other chunks come through their slots in %work."""

    def __init__(self, e: Emitter, schedule: Schedule):
        self.e, self.tape, self.schedule = e, schedule.tape, schedule
        self.values: dict[int, str] = {}
        self.vectors: dict[int, str] = {}  # by the first row of a pack
        self.pairs: dict[object, tuple[str, str]] = {}
        # neighbours loaded as one vector would wait for the stores of its parts to drain
        self.apart = e.lanes == 1 and self.tape.cost > INLINE_COST

    def write(self, chunk: int) -> None:
        """All instructions of a chunk."""
        steps = self.schedule.chunks[chunk]
        angles = (self.tape.rows[i][1] for i in steps if self._is_sine(i))
        joints = list(dict.fromkeys(a for a in angles if self.tape.rows[a][0] == INPUT))
        for step in steps:
            pack = self.schedule.home.get(step)
            if pack is None:
                self._write_row(step, joints)
            else:
                self._write_pack(pack)
            for row in (step,) if pack is None else pack.rows:
                for k, j in self.tape.targets.get(row, ()):
                    self.e.store(self.value(row), f"%out{k}", j)
        if chunk == 0:
            for row, places in self.tape.targets.items():
                if self.tape.rows[row][0] in _LEAVES:
                    for k, j in places:
                        self.e.store(self.value(row), f"%out{k}", j)

    def _is_sine(self, step: int) -> bool:
        return self.tape.rows[step][0] in (SIN, COS) and step not in self.schedule.home

    def _write_row(self, row: int, joints: list[int]) -> None:
        op, a, b = self.tape.rows[row]
        width = self.tape.widths[row]
        e = self.e if width == 1 else self.e.sharing(width)
        if op == LANE:
            self.values[row] = self.e.sharing(self.tape.widths[a]).lane(self.value(a), b)
        elif op == VECTOR:
            self.values[row] = self._side_by_side(e, a)
        elif op in (SIN, COS):
            if a not in self.pairs:
                angles = joints if a in joints else [a]
                self.pairs.update(zip(angles, e.side_by_side([self._leaf(i) for i in angles]), strict=True))
            self.values[row] = self.pairs[a][op == COS]
        else:
            self.values[row] = _operation(e, op, *(self._filled(e, x) for x in self.tape.operands(row)))
        if row in self.schedule.slots:
            self._keep(e, self.values[row], row)

    def _filled(self, e: Emitter, row: int) -> str:
        """The register of a row; of a scalar's one that has it in all lanes of `e`."""
        if self.tape.widths[row] == e.lanes or self.e.lanes == e.lanes:
            return self.value(row)
        op, a, _ = self.tape.rows[row]
        return e.const(a) if op == CONST else e.splat(self.value(row))

    def _side_by_side(self, wide: Emitter, rows: Sequence[int]) -> str:
        if all(self.tape.rows[row][0] == CONST for row in rows):
            return wide.consts([self.tape.rows[row][1] for row in rows])
        return wide.gathered([self.value(row) for row in rows])

    def _keep(self, e: Emitter, x: str, step: int) -> None:
        at = self.e.element("%work", self.schedule.slots[step])
        e.do(f"store {e.V} {x}, ptr {at}, align 8")

    def _kept(self, e: Emitter, step: int) -> str:
        at = self.e.element("%work", self.schedule.slots[step])
        return e.emit(f"load {e.V}, ptr {at}, align 8")

    def _write_pack(self, pack: Pack) -> None:
        wide = self.e.sharing(len(pack.rows))
        operands = [self._operand(wide, source) for source in pack.sources]
        if pack.op in (SIN, COS):
            rows = pack.sources[0].rows
            if rows not in self.pairs:
                self.pairs[rows] = wide.sincos(operands[0])
            vector = self.pairs[rows][pack.op == COS]
        elif pack.op == ADD:
            vector = _signed_sum(wide, operands[0], operands[1], pack.flips)
        else:
            vector = _operation(wide, pack.op, operands[0], operands[1] if len(operands) > 1 else None)
        self.vectors[pack.rows[0]] = vector
        if pack.rows[0] in self.schedule.slots:
            self._keep(wide, vector, pack.rows[0])

    def value(self, row: int) -> str:
        """The register of a row."""
        if row not in self.values:
            e = self.e
            op, a, b = self.tape.rows[row]
            if op == CONST:
                self.values[row] = e.const(a)
            elif op == INPUT:
                self.values[row] = e.load(f"%in{a}", b)
            elif row in self.schedule.home:
                self.values[row] = self._lane(self.schedule.home[row], row)
            else:
                width = self.tape.widths[row]
                self.values[row] = self._kept(e if width == 1 else e.sharing(width), row)
        return self.values[row]

    def _lane(self, pack: Pack, row: int) -> str:
        lane, first = pack.rows.index(row), pack.rows[0]
        if first in self.vectors:
            x = self.e.sharing(len(pack.rows)).lane(self.vectors[first], lane)
        else:
            x = self.e.load("%work", self.schedule.slots[first] + lane)
        return x if pack.signs[lane] > 0 else self.e.emit(f"fneg double {x}")

    def _leaf(self, row: int) -> str:
        op, argument, index = self.tape.rows[row]
        if op != INPUT or not self.apart:
            return self.value(row)
        return self.e.emit(f"load volatile double, ptr {self.e.element(f'%in{argument}', index)}, align 8")

    def _operand(self, wide: Emitter, source: Source) -> str:
        if source.pack is not None:
            vector = self._vector(wide, self.schedule.packs[source.pack])
            return wide.turned(vector, source.turn) if source.turn else vector
        if len(set(source.rows)) == 1:
            return wide.splat(self.value(source.rows[0]))
        if all(self.tape.rows[row][0] == CONST for row in source.rows):
            return wide.consts([self.tape.rows[row][1] for row in source.rows])
        return wide.gathered([self._leaf(row) for row in source.rows])

    def _vector(self, wide: Emitter, pack: Pack) -> str:
        first = pack.rows[0]
        if first not in self.vectors:
            if pack.op == INPUT:
                self.vectors[first] = wide.gathered([self._leaf(row) for row in pack.rows])
            else:
                self.vectors[first] = self._kept(wide, first)
        return self.vectors[first]


def _signed_sum(wide: Emitter, a: str, b: str, signs: Sequence[int]) -> str:
    if len(set(signs)) == 1:
        return wide.f("fadd" if signs[0] > 0 else "fsub", a, b)
    return wide.f("fadd", a, wide.f("fmul", b, wide.consts(signs)))


def _operation(e: Emitter, op: int, a: str, b: str | None = None) -> str:
    if op in _BINARY:
        assert b is not None
        return e.f(_BINARY[op], a, b)
    if op == NEG:
        return e.emit(f"fneg {e.V} {a}")
    if op == INV:
        return e.f("fdiv", e.const(1.0), a)
    if op == SQRT:
        return e.call("sqrt", a)
    if op in (ABS, ROUND):
        return e.call("fabs" if op == ABS else "rint", a)
    assert b is not None
    if op == LESS:
        return e.select(e.compare("olt", a, b), e.const(1.0), e.const(0.0))
    if op in (MIN, MAX):
        return e.select(e.compare("olt" if op == MIN else "ogt", a, b), a, b)
    if op == ATAN2:
        return e.atan2(a, b)
    raise ValueError(f"no instruction for operation {op}")
