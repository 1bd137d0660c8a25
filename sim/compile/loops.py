"""Transfers between rows of arrays and lanes, and maps of kernels over batches, emitted as IR.

States come and go as rows of ordinary arrays; inside, `lanes` states stand side by side. A block that reaches
past the end of a batch repeats the last state, whose results are then equal and written twice.
"""

from __future__ import annotations

from .llvm import Emitter
from .tape import Tape


class Block:
    """Row numbers of the states in the lanes of one block, and transfers between rows and lanes."""

    def __init__(self, e: Emitter, first: str, count: str):
        self.e = e
        last = e.emit(f"sub nsw i64 {count}, 1")
        self.rows = []
        for lane in range(e.lanes):
            row = e.emit(f"add nsw i64 {first}, {lane}")
            inside = e.emit(f"icmp slt i64 {row}, {count}")
            self.rows.append(e.emit(f"select i1 {inside}, i64 {row}, i64 {last}"))

    def pointers(self, base: str, stride: str | int) -> list[str]:
        """Address of every lane's row in an array whose rows are `stride` doubles apart."""
        offsets = [self.e.emit(f"mul nsw i64 {row}, {stride}") for row in self.rows]
        return [self.e.element(base, offset, "double") for offset in offsets]

    def gather(self, pointers: list[str], into: str, size: int) -> None:
        """The first `size` entries of every lane's row into `into`."""
        e = self.e
        for i in e.over(size):
            x = "poison"
            for lane, pointer in enumerate(pointers):
                entry = e.emit(f"load double, ptr {e.element(pointer, i, 'double')}, align 8")
                x = entry if e.lanes == 1 else e.emit(f"insertelement {e.V} {x}, double {entry}, i64 {lane}")
            e.store(x, into, i)

    def scatter(self, source: str, pointers: list[str], size: int) -> None:
        """The first `size` scalars of `source` into every lane's row."""
        e = self.e
        for i in e.over(size):
            x = e.load(source, i)
            for lane, pointer in enumerate(pointers):
                entry = x if e.lanes == 1 else e.emit(f"extractelement {e.V} {x}, i64 {lane}")
                e.do(f"store double {entry}, ptr {e.element(pointer, i, 'double')}, align 8")


def shifted(e: Emitter, pointers: list[str], offset: str) -> list[str]:
    """Pointers moved by `offset` doubles."""
    return [e.element(pointer, offset, "double") for pointer in pointers]


def function(name: str, arguments: list[str], e: Emitter) -> str:
    """A function with the body written so far."""
    body = "\n".join(e.lines)
    return f"define void @{name}({', '.join(arguments)}) nounwind {{\n{body}\n  ret void\n}}\n"


def declare(name: str, tape: Tape) -> str:
    """Declaration of the kernel of `tape`."""
    return f"declare void @{name}({', '.join(['ptr'] * (len(tape.inputs) + len(tape.outputs)))}) nounwind\n"


def map_function(name: str, kernel: str, tape: Tape, lanes: int) -> str:
    """`void name(i64 n, (ptr rows, i64 stride) per input, ptr rows per output)`: the kernel over a batch.

    A stride of 0 gives every state the same row; outputs are contiguous.
    """
    e = Emitter(lanes)
    ins, outs = list(tape.inputs.values()), list(tape.outputs.values())
    buffers = [e.slot(size) for size in ins], [e.slot(size) for size in outs]
    with e.loop("%n", lanes) as first:
        block = Block(e, first, "%n")
        for k, size in enumerate(ins):
            block.gather(block.pointers(f"%in{k}", f"%s{k}"), buffers[0][k], size)
        pointers = ", ".join(f"ptr {b}" for b in [*buffers[0], *buffers[1]])
        e.do(f"call void @{kernel}({pointers})")
        for k, size in enumerate(outs):
            block.scatter(buffers[1][k], block.pointers(f"%out{k}", size), size)
    arguments = ["i64 %n", *(f"ptr noalias %in{k}, i64 %s{k}" for k in range(len(ins)))]
    arguments += [f"ptr noalias %out{k}" for k in range(len(outs))]
    return function(name, arguments, e)
