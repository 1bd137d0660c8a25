"""Exact derivatives of expression graphs: forward columns (sparse) and reverse products."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence

from .graph import (
    ABS,
    ADD,
    ATAN2,
    CONST,
    COS,
    HOLD,
    INPUT,
    INV,
    LESS,
    MAX,
    MIN,
    MUL,
    NEG,
    ROUND,
    SIN,
    SQRT,
    SUB,
    Graph,
    Node,
    Scalar,
    cos,
    less,
    reachable,
    sin,
)


def partials(node: Node) -> tuple[tuple[Node, Scalar], ...]:
    """Operands of `node` with the derivative of `node` by each."""
    op, a, b = node.op, node.a, node.b
    if op in (CONST, INPUT, LESS, HOLD, ROUND):
        return ()
    assert a is not None
    if op == NEG:
        return ((a, -1.0),)
    if op == INV:
        return ((a, -(node * node)),)
    if op == SQRT:
        return ((a, 0.5 / node),)
    if op == SIN:
        return ((a, cos(a)),)
    if op == COS:
        return ((a, -sin(a)),)
    if op == ABS:
        return ((a, 1.0 - 2.0 * less(a, 0.0)),)
    assert b is not None
    if op == ADD:
        return ((a, 1.0), (b, 1.0))
    if op == SUB:
        return ((a, 1.0), (b, -1.0))
    if op == MUL:
        return ((a, b), (b, a)) if a is not b else ((a, 2.0 * a),)
    if op in (MIN, MAX):
        first = less(a, b) if op == MIN else less(b, a)
        return ((a, first), (b, 1.0 - first))
    if op == ATAN2:
        scale = 1.0 / (a * a + b * b)
        return ((a, b * scale), (b, -(a * scale)))
    raise ValueError(f"no derivative of operation {op}")


class _Partials:
    """Partials of the nodes behind some outputs, computed once per node."""

    def __init__(self, outputs: Sequence[Scalar]):
        self.order = reachable(outputs)
        self._known: dict[int, tuple[tuple[Node, Scalar], ...]] = {}

    def __getitem__(self, node: Node) -> tuple[tuple[Node, Scalar], ...]:
        found = self._known.get(node.id)
        if found is None:
            found = self._known[node.id] = partials(node)
        return found


def directional(outputs: Sequence[Scalar], seeds: Sequence[Mapping[Node, Scalar]]) -> list[list[Scalar]]:
    """Derivatives of `outputs` along each seed (tangents of input nodes): one list per seed."""
    table = _Partials(outputs)
    columns = []
    for seed in seeds:
        tangent: dict[int, Scalar] = {node.id: t for node, t in seed.items()}
        for node in table.order:
            if node.a is None or not (node.a.id in tangent or (node.b is not None and node.b.id in tangent)):
                continue
            total: Scalar = 0.0
            for operand, d in table[node]:
                t = tangent.get(operand.id)
                if t is not None:
                    total = total + d * t
            if isinstance(total, Node) or total != 0.0:
                tangent[node.id] = total
        columns.append([tangent.get(x.id, 0.0) if isinstance(x, Node) else 0.0 for x in outputs])
    return columns


def grouped(
    outputs: Sequence[Scalar], seeds: Sequence[Mapping[Node, Scalar]], widest: int
) -> list[list[int]]:
    """Neighbouring seeds whose columns are best computed side by side, up to `widest` at once.

    A vector costs what a scalar costs, wherever one of its columns is not zero: of all cuts into neighbours
    the one with the fewest operations (dynamic programming).
    """
    if widest == 1:
        return [[k] for k in range(len(seeds))]
    table, touched = _Partials(outputs), dict[int, int]()
    for k, seed in enumerate(seeds):
        for node in seed:
            touched[node.id] = touched.get(node.id, 0) | 1 << k
    for node in table.order:
        if node.a is not None:
            for operand, _ in table[node]:
                touched[node.id] = touched.get(node.id, 0) | touched.get(operand.id, 0)
    shapes = Counter(touched.values())
    best: list[tuple[int, int]] = [(0, 0)]
    for end in range(1, len(seeds) + 1):
        options = []
        for first in range(max(0, end - widest), end):
            among = (1 << end) - (1 << first)
            work = sum(times for mask, times in shapes.items() if mask & among)
            options.append((best[first][0] + work, first))
        best.append(min(options))
    groups, end = [], len(seeds)
    while end:
        first = best[end][1]
        groups.append(list(range(first, end)))
        end = first
    return groups[::-1]


def merged(graph: Graph, seeds: Sequence[Mapping[Node, Scalar]]) -> dict[Node, Scalar]:
    """Seeds side by side."""
    nodes = dict.fromkeys(node for seed in seeds for node in seed)
    return {node: graph.vector([seed.get(node, 0.0) for seed in seeds]) for node in nodes}


def gradient(outputs: Sequence[Scalar], adjoints: Sequence[Scalar], inputs: Sequence[Node]) -> list[Scalar]:
    """sum_k adjoints[k] d outputs[k] / d inputs, by reverse accumulation."""
    table = _Partials(outputs)
    adjoint: dict[int, Scalar] = {}
    for x, bar in zip(outputs, adjoints, strict=True):
        if isinstance(x, Node):
            adjoint[x.id] = adjoint.get(x.id, 0.0) + bar
    for node in reversed(table.order):
        bar = adjoint.get(node.id, 0.0)
        if not isinstance(bar, Node) and bar == 0.0:
            continue
        for operand, d in table[node]:
            adjoint[operand.id] = adjoint.get(operand.id, 0.0) + d * bar
    return [adjoint.get(x.id, 0.0) for x in inputs]
