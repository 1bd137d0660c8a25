"""Scalar expression graph, hash-consed and folded as it grows.

Every expression is built once: equal operands give the same node, zeros and ones vanish, signs move
outward (so that additions absorb them) and divisions become shared reciprocals. Ordinary numbers stay
Python floats until they meet a node, so that formulas written with plain operators run on numbers, on
nodes, or on both.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from typing import Any, TypeAlias

CONST, INPUT, ADD, SUB, MUL, NEG, INV, SQRT, SIN, COS, MIN, MAX, ABS, LESS, ATAN2, HOLD, ROUND = range(17)
VECTOR, LANE = 17, 18
OP_NAMES = (
    *("const", "input", "add", "sub", "mul", "neg", "inv", "sqrt", "sin", "cos"),
    *("min", "max", "abs", "less", "atan2", "hold", "round"),
    *("vector", "lane"),
)
_COMMUTATIVE = frozenset((ADD, MUL, MIN, MAX))


class Node:
    """One value of a graph, or `lanes` of them side by side.

    `a`, `b` are operands, `value` a constant, an input's (argument, index), the nodes in a vector or the
    number of a lane. A scalar operand of a vector counts for every lane.
    """

    __slots__ = ("a", "b", "graph", "id", "lanes", "op", "value")
    a: Any
    b: Any
    lanes: int
    value: Any

    def __init__(self, graph: Graph, id: int, op: int, a: Node | None, b: Node | None, value: object):
        self.graph, self.id, self.op, self.a, self.b, self.value = graph, id, op, a, b, value
        self.lanes = max(1 if a is None else a.lanes, 1 if b is None else b.lanes)

    def __add__(self, other: Scalar) -> Scalar:
        if not isinstance(other, Node):
            return self if other == 0.0 else self.graph.add(self, self.graph.const(other))
        return self.graph.add(self, other)

    __radd__ = __add__

    def __neg__(self) -> Scalar:
        return self.graph.neg(self)

    def __sub__(self, other: Scalar) -> Scalar:
        if not isinstance(other, Node):
            return self if other == 0.0 else self.graph.sub(self, self.graph.const(other))
        return self.graph.sub(self, other)

    def __rsub__(self, other: float) -> Scalar:
        return self.graph.neg(self) if other == 0.0 else self.graph.sub(self.graph.const(other), self)

    def __mul__(self, other: Scalar) -> Scalar:
        if isinstance(other, Node):
            return self.graph.mul(self, other)
        if other == 0.0:
            return 0.0
        if other == 1.0:
            return self
        if other < 0.0:
            return -(self * -other)
        return self.graph.mul(self, self.graph.const(other))

    __rmul__ = __mul__

    def __truediv__(self, other: Scalar) -> Scalar:
        return self * (self.graph.inv(other) if isinstance(other, Node) else 1.0 / other)

    def __rtruediv__(self, other: float) -> Scalar:
        return self.graph.inv(self) * other

    def __float__(self) -> float:
        raise TypeError("a symbol has no value")

    def __repr__(self) -> str:
        return f"<{OP_NAMES[self.op]} {self.id}>"


Scalar: TypeAlias = Node | float


class Graph:
    """Owner of nodes in order of creation, which is a topological order."""

    def __init__(self) -> None:
        self.nodes: list[Node] = []
        self._known: dict[tuple[object, ...], Node] = {}

    def inputs(self, name: str, size: int) -> Sequence[Node]:
        """The `size` scalars of argument `name`."""
        return [self._leaf(INPUT, (name, i)) for i in range(size)]

    def const(self, value: float) -> Node:
        """Node of a number."""
        return self._leaf(CONST, float(value))

    def node(self, value: Scalar) -> Node:
        """`value` as a node."""
        return value if isinstance(value, Node) else self.const(value)

    def _leaf(self, op: int, value: object) -> Node:
        found = self._known.get((op, value))
        if found is None:
            found = Node(self, len(self.nodes), op, None, None, value)
            self.nodes.append(found)
            self._known[op, value] = found
        return found

    def _new(self, op: int, a: Node, b: Node | None = None) -> Node:
        if b is None:
            key: tuple[object, ...] = (op, a.id)
        else:
            if op in _COMMUTATIVE and b.id < a.id:
                a, b = b, a
            key = (op, a.id, b.id)
        found = self._known.get(key)
        if found is None:
            found = Node(self, len(self.nodes), op, a, b, None)
            self.nodes.append(found)
            self._known[key] = found
        return found

    def add(self, a: Node, b: Node) -> Scalar:
        """a + b."""
        if a.op == NEG:
            return self.neg(self._new(ADD, a.a, b.a)) if b.op == NEG else self.sub(b, a.a)
        if b.op == NEG:
            return self.sub(a, b.a)
        if a.op == CONST and b.op == CONST:
            return float(a.value + b.value)
        return self._new(ADD, a, b)

    def sub(self, a: Node, b: Node) -> Scalar:
        """a - b."""
        if a is b:
            return 0.0
        if b.op == NEG:
            return self.add(a, b.a)
        if a.op == NEG:
            return self.neg(self._new(ADD, a.a, b))
        if a.op == CONST and b.op == CONST:
            return float(a.value - b.value)
        mirrored = self._known.get((SUB, b.id, a.id))
        return self.neg(mirrored) if mirrored is not None else self._new(SUB, a, b)

    def mul(self, a: Node, b: Node) -> Scalar:
        """a b."""
        negative = (a.op == NEG) != (b.op == NEG)
        a, b = (a.a if a.op == NEG else a), (b.a if b.op == NEG else b)
        if b.op == CONST:
            a, b = b, a
        if a.op == CONST:
            if b.op == CONST:
                product: Scalar = float(a.value * b.value)
            elif b.op == MUL and b.a.op == CONST:
                product = b.b * (a.value * b.a.value)
            elif b.op == MUL and b.b.op == CONST:
                product = b.a * (a.value * b.b.value)
            else:
                product = self._new(MUL, a, b)
        else:
            product = self._new(MUL, a, b)
        return -product if negative else product

    def neg(self, a: Node) -> Scalar:
        """-a."""
        if a.op == NEG:
            return _inner(a)
        return -float(a.value) if a.op == CONST else self._new(NEG, a)

    def inv(self, a: Node) -> Scalar:
        """1 / a."""
        if a.op == NEG:
            return self.neg(self._new(INV, a.a))
        if a.op == INV:
            return _inner(a)
        return 1.0 / a.value if a.op == CONST else self._new(INV, a)

    def vector(self, values: Sequence[Scalar]) -> Scalar:
        """Numbers and scalar nodes side by side, in a power of two of lanes; nothing but zeros are a zero."""
        if not any(isinstance(x, Node) or x != 0.0 for x in values):
            return 0.0
        if len(values) == 1:
            return values[0]
        padding = (1 << (len(values) - 1).bit_length()) - len(values)
        nodes = tuple(self.node(x) for x in [*values, *[0.0] * padding])
        found = self._leaf(VECTOR, nodes)
        found.lanes = len(nodes)
        return found

    def lane(self, a: Scalar, lane: int) -> Scalar:
        """What stands in one lane of a vector; a scalar stands in all."""
        if not isinstance(a, Node) or a.lanes == 1:
            return a
        key = (LANE, a.id, lane)
        found = self._known.get(key)
        if found is None:
            found = Node(self, len(self.nodes), LANE, a, None, lane)
            found.lanes = 1
            self.nodes.append(found)
            self._known[key] = found
        return found

    def hold(self, a: Scalar) -> Scalar:
        """`a` as a value that derivatives do not look behind."""
        return self._new(HOLD, a) if isinstance(a, Node) else a

    def unary(self, op: int, a: Node) -> Scalar:
        """Square root, sine, cosine, absolute value or nearest integer."""
        if a.op == NEG:
            if op == SIN:
                return self.neg(self._new(SIN, a.a))
            if op in (COS, ABS):
                a = a.a
            if op == ROUND:
                return self.neg(self._new(ROUND, a.a))
        return self._new(op, a)

    def binary(self, op: int, a: Scalar, b: Scalar) -> Node:
        """Minimum, maximum, `a < b` as 1 or 0, or atan2(a, b), as a node."""
        return self._new(op, self.node(a), self.node(b))


def _inner(a: Node) -> Node:
    inner: Node = a.a
    return inner


def sqrt(x: Scalar) -> Scalar:
    """Square root."""
    return x.graph.unary(SQRT, x) if isinstance(x, Node) else math.sqrt(x)


def sin(x: Scalar) -> Scalar:
    """Sine."""
    return x.graph.unary(SIN, x) if isinstance(x, Node) else math.sin(x)


def cos(x: Scalar) -> Scalar:
    """Cosine."""
    return x.graph.unary(COS, x) if isinstance(x, Node) else math.cos(x)


def absolute(x: Scalar) -> Scalar:
    """Absolute value."""
    return x.graph.unary(ABS, x) if isinstance(x, Node) else abs(x)


def nearest(x: Scalar) -> Scalar:
    """Nearest integer (ties to even); its derivative is taken as zero."""
    return x.graph.unary(ROUND, x) if isinstance(x, Node) else float(round(x))


def _owner(*xs: Scalar) -> Graph | None:
    return next((x.graph for x in xs if isinstance(x, Node)), None)


def minimum(a: Scalar, b: Scalar) -> Scalar:
    """The smaller of two."""
    graph = _owner(a, b)
    return graph.binary(MIN, a, b) if graph else min(float(a), float(b))


def maximum(a: Scalar, b: Scalar) -> Scalar:
    """The larger of two."""
    graph = _owner(a, b)
    return graph.binary(MAX, a, b) if graph else max(float(a), float(b))


def less(a: Scalar, b: Scalar) -> Scalar:
    """1 where a < b, else 0; its derivative is taken as zero."""
    graph = _owner(a, b)
    return graph.binary(LESS, a, b) if graph else float(float(a) < float(b))


def atan2(y: Scalar, x: Scalar) -> Scalar:
    """Angle of the point (x, y)."""
    graph = _owner(y, x)
    return graph.binary(ATAN2, y, x) if graph else math.atan2(float(y), float(x))


def clip(x: Scalar, low: Scalar, high: Scalar) -> Scalar:
    """`x` limited to [low, high]; bounds that are infinite numbers cost nothing."""
    x = x if _infinite(low) else maximum(x, low)
    return x if _infinite(high) else minimum(x, high)


def _infinite(x: Scalar) -> bool:
    return not isinstance(x, Node) and math.isinf(x)


def reachable(outputs: Iterable[Scalar]) -> list[Node]:
    """The nodes that `outputs` need, in topological order."""
    needed: dict[int, Node] = {}
    stack = [x for x in outputs if isinstance(x, Node)]
    while stack:
        node = stack.pop()
        if node.id in needed:
            continue
        needed[node.id] = node
        if node.op == VECTOR:
            stack += node.value
        if node.a is not None:
            stack.append(node.a)
            if node.b is not None:
                stack.append(node.b)
    return [needed[i] for i in sorted(needed)]
