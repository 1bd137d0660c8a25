"""A straight-line program: the part of a graph that some outputs need, in the order of execution."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from .graph import (
    ABS,
    ADD,
    ATAN2,
    CONST,
    COS,
    HOLD,
    INPUT,
    INV,
    LANE,
    LESS,
    MAX,
    MIN,
    MUL,
    NEG,
    OP_NAMES,
    ROUND,
    SIN,
    SQRT,
    SUB,
    VECTOR,
    Node,
    Scalar,
    reachable,
)

_FREE = (CONST, INPUT)
_NUMPY = {
    ADD: np.add,
    SUB: np.subtract,
    MUL: np.multiply,
    NEG: np.negative,
    INV: np.reciprocal,
    SQRT: np.sqrt,
    SIN: np.sin,
    COS: np.cos,
    MIN: np.minimum,
    MAX: np.maximum,
    ABS: np.abs,
    ROUND: np.rint,
    ATAN2: np.arctan2,
}


@dataclass(frozen=True)
class Tape:
    """Program of (op, a, b) rows; a, b are rows, or a constant, or an input's (argument, index).

    A vector's a are the rows side by side, a lane's b is its number.

    `inputs` and `outputs` give the size of every argument by name, in the order of the compiled call;
    `results` gives for every output the rows of its scalars. `limbs` are sets of limbs built alike, each limb
    a list of its inputs (argument, index).
    """

    rows: tuple[tuple[int, Any, Any], ...]
    inputs: dict[str, int]
    outputs: dict[str, int]
    results: tuple[tuple[int, ...], ...]
    limbs: tuple[tuple[tuple[tuple[int, int], ...], ...], ...] = ()

    @staticmethod
    def build(
        inputs: Mapping[str, int],
        outputs: Mapping[str, Sequence[Scalar]],
        limbs: Sequence[Sequence[Sequence[tuple[str, int]]]] = (),
    ) -> Tape:
        """Tape of the named `outputs`; `inputs` gives names and sizes of the arguments of their graph.

        `limbs` are sets of limbs, each a list of its inputs (name, index), in the same order in each limb.
        """
        argument = {name: k for k, name in enumerate(inputs)}
        rows: list[tuple[int, Any, Any]] = []
        place: dict[int, int] = {}
        for node in reachable([x for xs in outputs.values() for x in xs]):
            if node.op == HOLD:
                place[node.id] = place[node.a.id]
                continue
            place[node.id] = len(rows)
            if node.op == CONST:
                rows.append((CONST, node.value, None))
            elif node.op == INPUT:
                name, index = node.value
                rows.append((INPUT, argument[name], index))
            elif node.op == VECTOR:
                rows.append((VECTOR, tuple(place[x.id] for x in node.value), None))
            elif node.op == LANE:
                rows.append((LANE, place[node.a.id], node.value))
            else:
                rows.append((node.op, place[node.a.id], None if node.b is None else place[node.b.id]))
        constants: dict[float, int] = {}

        def result(x: Scalar) -> int:
            if isinstance(x, Node):
                return place[x.id]
            if x not in constants:
                constants[x] = len(rows)
                rows.append((CONST, float(x), None))
            return constants[x]

        results = tuple(tuple(result(x) for x in xs) for xs in outputs.values())
        sizes = {name: len(xs) for name, xs in outputs.items()}
        alike = tuple(
            tuple(tuple((argument[name], i) for name, i in limb if name in argument) for limb in each)
            for each in limbs
        )
        return Tape(tuple(rows), dict(inputs), sizes, results, alike)

    def operands(self, row: int) -> tuple[int, ...]:
        """Rows that a row is computed from."""
        op, a, b = self.rows[row]
        if op in _FREE:
            return ()
        if op == VECTOR:
            return tuple(a)
        return (a,) if b is None or op == LANE else (a, b)

    @cached_property
    def widths(self) -> tuple[int, ...]:
        """Values that stand side by side in each row."""
        out: list[int] = []
        for row, (op, a, _) in enumerate(self.rows):
            if op == VECTOR:
                out.append(len(a))
            else:
                out.append(1 if op == LANE else max((out[x] for x in self.operands(row)), default=1))
        return tuple(out)

    @cached_property
    def counts(self) -> dict[str, int]:
        """Number of operations of each kind."""
        return dict(Counter(OP_NAMES[op] for op, _, _ in self.rows if op not in _FREE))

    @cached_property
    def targets(self) -> dict[int, list[tuple[int, int]]]:
        """Where each row is an output: (output, index)."""
        out: dict[int, list[tuple[int, int]]] = {}
        for k, rows in enumerate(self.results):
            for j, row in enumerate(rows):
                out.setdefault(row, []).append((k, j))
        return out

    @cached_property
    def cost(self) -> int:
        """Operations in units of an addition (a sine-cosine pair 25, a division or root 8)."""
        weight = {"sin": 13, "cos": 13, "inv": 8, "sqrt": 8, "atan2": 30}
        return sum(n * weight.get(op, 1) for op, n in self.counts.items())

    def evaluate(self, *arguments: np.ndarray) -> list[np.ndarray]:
        """The outputs by NumPy, broadcasting over leading axes: slow, for checks."""
        lead = np.broadcast_shapes(*(np.shape(x)[:-1] for x in arguments))
        values: list[Any] = []
        for row, (op, a, b) in enumerate(self.rows):
            if op == CONST:
                values.append(a)
            elif op == INPUT:
                values.append(np.asarray(arguments[a])[..., b])
            elif op == VECTOR:
                values.append(np.stack([np.broadcast_to(values[i], lead) for i in a], axis=-1))
            elif op == LANE:
                values.append(values[a][..., b])
            else:
                wide = self.widths[row] > 1
                terms = [
                    np.asarray(values[i])[..., None] if wide and self.widths[i] == 1 else values[i]
                    for i in self.operands(row)
                ]
                values.append(np.where(np.less(*terms), 1.0, 0.0) if op == LESS else _NUMPY[op](*terms))
        return [
            np.stack([np.broadcast_to(values[i], lead) for i in rows], axis=-1)
            if rows
            else np.zeros((*lead, 0))
            for rows in self.results
        ]

    def casadi(self, name: str = "f") -> Any:
        """The same program as a `casadi.Function`, for optimisers that speak CasADi."""
        import casadi as ca

        unary = {
            NEG: lambda x: -x,
            INV: lambda x: 1 / x,
            SQRT: ca.sqrt,
            SIN: ca.sin,
            COS: ca.cos,
            ABS: ca.fabs,
        }
        binary = {MIN: ca.fmin, MAX: ca.fmax, LESS: ca.lt, ATAN2: ca.atan2}
        binary |= {ADD: lambda x, y: x + y, SUB: lambda x, y: x - y, MUL: lambda x, y: x * y}
        arguments = [ca.SX.sym(n, size) for n, size in self.inputs.items()]
        values: list[Any] = []
        for op, a, b in self.rows:
            if op == CONST:
                values.append(ca.SX(a))
            elif op == INPUT:
                values.append(arguments[a][b])
            elif op == VECTOR:
                values.append(ca.vertcat(*[values[i] for i in a]))
            elif op == LANE:
                values.append(values[a][b])
            else:
                values.append(unary[op](values[a]) if b is None else binary[op](values[a], values[b]))
        outs = [ca.vertcat(*[values[i] for i in rows]) if rows else ca.SX(0, 1) for rows in self.results]
        options = {"allow_duplicate_io_names": True}  # an argument and a result may both be called p
        return ca.Function(name, arguments, outs, list(self.inputs), list(self.outputs), options)
