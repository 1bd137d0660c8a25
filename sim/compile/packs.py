"""Equal computations of equal limbs, found in a tape, to be done side by side in one vector.

The limbs of a robot (the legs of a quadruped, two arms) have the same equations with other numbers and, where
they mirror each other, with other signs. Where the same operation is applied to values that already stand
side by side, its results stand side by side as well, up to a sign in each lane; constants may differ from
limb to limb, and what all limbs share is given to each. (A form of superword-level parallelism: Larsen and
Amarasinghe, PLDI 2000, here led by the robot's structure.)
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

from .graph import ABS, ADD, ATAN2, CONST, COS, INPUT, LANE, LESS, MAX, MIN, MUL, NEG, SQRT, SUB, VECTOR
from .tape import Tape

Rows = tuple[int, ...]  # one row of the tape for each limb
Signs = tuple[int, ...]
_COMMUTE = (ADD, SUB, MUL, MIN, MAX)  # a difference is a sum with a sign
_SIGNED = (SQRT, MIN, MAX, LESS, ATAN2)  # operations that need their operands' own signs


class Source(NamedTuple):
    """Operands of a pack, limb by limb; where they are a pack, its number and how many limbs it is turned."""

    rows: Rows
    pack: int | None = None
    turn: int = 0


@dataclass(frozen=True)
class Pack:
    """Rows with the same operation in every limb.

    The row of limb l is `signs[l]` times what stands in lane l. Sums are a + flips * b of what stands in the
    operands' lanes; ADD stands for differences as well.
    """

    rows: Rows
    op: int
    signs: Signs
    sources: tuple[Source, ...] = ()
    flips: Signs = ()


class _Term(NamedTuple):
    row: int
    sign: int


class _Finder:
    """Packs among the rows of a tape for one set of limbs."""

    def __init__(self, tape: Tape, limbs: int, taken: set[int], shapes: list[int], packs: list[Pack]):
        self.tape, self.limbs, self.taken, self.shapes, self.packs = tape, limbs, taken, shapes, packs
        self.place: dict[int, tuple[int, int]] = {}  # pack and limb of a row

    def operands(self, row: int) -> list[_Term]:
        """Operands in an order that does not depend on the limb."""
        op, a, b = self.tape.rows[row]
        terms = [self._unsigned(a, 1)]
        if b is not None:
            terms.append(self._unsigned(b, -1 if op == SUB else 1))
        return sorted(terms, key=self._tag) if op in _COMMUTE else terms

    def _unsigned(self, row: int, sign: int) -> _Term:
        """A row with its minus signs taken off."""
        while self.tape.rows[row][0] == NEG:
            row, sign = self.tape.rows[row][1], -sign
        return _Term(row, sign)

    def _tag(self, term: _Term) -> tuple[int, int]:
        if term.row in self.place:
            return 0, self.place[term.row][0]
        return 1, self.shapes[term.row]

    def _source(self, rows: Rows) -> tuple[Source, list[int]]:
        """Where operands stand and the signs that they have there."""
        if rows[0] in self.place:
            number, turn = self.place[rows[0]]
            pack = self.packs[number]
            if pack.rows[turn:] + pack.rows[:turn] == rows:
                return Source(rows, number, turn), [*pack.signs[turn:], *pack.signs[:turn]]
        return Source(rows), [1] * len(rows)

    def form(self, rows: Rows) -> None:
        """A pack of `rows`, and of what lies beneath them and differs by constants alone."""
        op = self.tape.rows[rows[0]][0]
        sources: list[Source] = []
        of: list[list[int]] = []  # signs of every operand in every limb
        if op != INPUT:
            for terms in zip(*(self.operands(row) for row in rows), strict=True):
                operands = tuple(term.row for term in terms)
                self._form_beneath(operands)
                source, signs = self._source(operands)
                sources.append(source)
                of.append([term.sign * sign for term, sign in zip(terms, signs, strict=True)])
        if op in _SIGNED and any(-1 in signs for signs in of):
            return
        flips: list[int] = []
        if op in (INPUT, COS, ABS, *_SIGNED):
            signs = [1] * len(rows)
        elif len(of) == 1:
            signs = of[0]
        else:
            relative = [x * y for x, y in zip(*of, strict=True)]
            signs, flips = (relative, []) if op == MUL else (of[0], relative)
        for limb, row in enumerate(rows):
            self.place[row] = len(self.packs), limb
        self.taken.update(rows)
        kind = ADD if op == SUB else op
        self.packs.append(Pack(rows, kind, tuple(signs), tuple(sources), tuple(flips)))

    def _form_beneath(self, rows: Rows) -> None:
        if len(set(rows)) < len(rows) or self.taken.intersection(rows):
            return
        if self.tape.rows[rows[0]][0] not in (CONST, INPUT) and len({self.shapes[i] for i in rows}) == 1:
            self.form(rows)

    def key(self, row: int) -> tuple[int, tuple[int, ...]] | None:
        """Limb to which a row belongs and what is computed there; None if no operand is packed.

        What limb l takes from limb l + 1 is the same for every l, counted around.
        """
        terms = self.operands(row)
        limb = next((self.place[term.row][1] for term in terms if term.row in self.place), None)
        if limb is None:
            return None
        op = self.tape.rows[row][0]
        key = [ADD if op == SUB else op]
        for term in terms:
            turn = (self.place[term.row][1] - limb) % self.limbs if term.row in self.place else 0
            key += [*self._tag(term), turn]
        return limb, tuple(key)

    def extend(self, level: Sequence[int]) -> None:
        """Pack the rows of one depth whose operands are packed."""
        found: dict[tuple[int, ...], list[list[int]]] = {}
        for row in level:
            if (
                row in self.taken
                or self.tape.rows[row][0] in (NEG, VECTOR, LANE)
                or self.tape.widths[row] > 1
            ):
                continue
            known = self.key(row)
            if known is not None:
                limb, key = known
                found.setdefault(key, [[] for _ in range(self.limbs)])[limb].append(row)
        for by_limb in found.values():
            if len({len(rows) for rows in by_limb}) == 1:
                for rows in zip(*by_limb, strict=True):
                    if not self.taken.intersection(rows):
                        self.form(rows)


def find_packs(tape: Tape) -> list[Pack]:
    """Packs of `tape` for its limbs (`Tape.limbs`), operands before what needs them."""
    shapes = _shapes(tape)
    levels: dict[int, list[int]] = defaultdict(list)
    for row, depth in enumerate(_depths(tape)):
        levels[depth].append(row)
    leaves = {(a, b): i for i, (op, a, b) in enumerate(tape.rows) if op == INPUT}
    packs: list[Pack] = []
    taken: set[int] = set()
    for limbs in tape.limbs:
        finder = _Finder(tape, len(limbs), taken, shapes, packs)
        for inputs in zip(*limbs, strict=True):
            rows = tuple(leaves[x] for x in inputs if x in leaves)
            if len(rows) == len(limbs):
                finder.form(rows)
        for depth in sorted(levels)[1:]:
            finder.extend(levels[depth])
    return packs


def _depths(tape: Tape) -> list[int]:
    """Operations before each row, minus signs not counted."""
    out: list[int] = []
    for row, (op, a, _) in enumerate(tape.rows):
        beneath = (out[x] for x in tape.operands(row))
        out.append(out[a] if op == NEG else 1 + max(beneath, default=-1))
    return out


def _shapes(tape: Tape) -> list[int]:
    """A number for each row: equal where the same is computed up to constants and signs."""
    known: dict[tuple[int, ...], int] = {}
    out: list[int] = []
    for row, (op, a, b) in enumerate(tape.rows):
        if op == NEG:
            out.append(out[a])
            continue
        if op in (VECTOR, LANE):
            key: tuple[int, ...] = (op, row)
        elif op == CONST:
            key = (op,)
        elif op == INPUT:
            key = (op, a, b)
        else:
            operands = [out[a]] if b is None else [out[a], out[b]]
            key = (ADD if op == SUB else op, *(sorted(operands) if op in _COMMUTE else operands))
        out.append(known.setdefault(key, len(known)))
    return out
