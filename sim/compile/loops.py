"""Loops around kernels, emitted as IR: maps over batches and whole integrations.

States come and go as rows of ordinary arrays; inside, `lanes` states stand side by side. A block that reaches
past the end of a batch repeats the last state, whose results are then equal and written twice.
"""

from __future__ import annotations

from .llvm import Emitter
from .tape import Tape


class _Lanes:
    """Row numbers of the states in the lanes of one block, and transfers between rows and lanes."""

    def __init__(self, e: Emitter, block: str, count: str):
        self.e = e
        last = e.emit(f"sub nsw i64 {count}, 1")
        self.rows = []
        for lane in range(e.lanes):
            row = e.emit(f"add nsw i64 {block}, {lane}")
            inside = e.emit(f"icmp slt i64 {row}, {count}")
            self.rows.append(e.emit(f"select i1 {inside}, i64 {row}, i64 {last}"))

    def pointers(self, base: str, stride: str) -> list[str]:
        """Address of every lane's row."""
        out = []
        for row in self.rows:
            offset = self.e.emit(f"mul nsw i64 {row}, {stride}")
            out.append(self.e.element(base, offset, "double"))
        return out

    def gather(self, pointers: list[str], buffer: str, size: int) -> None:
        """Rows into lanes."""
        e = self.e
        if not size:
            return
        with e.loop(size) as i:
            self.gather_one(pointers, i, buffer, i)

    def gather_one(self, pointers: list[str], i: str, buffer: str, k: str) -> None:
        """Entry `i` of every row into scalar `k` of `buffer`."""
        e = self.e
        target = e.element(buffer, k)
        for lane, pointer in enumerate(pointers):
            x = e.emit(f"load double, ptr {e.element(pointer, i, 'double')}, align 8")
            e.do(f"store double {x}, ptr {e.element(target, lane, 'double')}, align 8")

    def scatter(self, buffer: str, pointers: list[str], size: int) -> None:
        """Lanes into rows."""
        e = self.e
        if not size:
            return
        with e.loop(size) as i:
            source = e.element(buffer, i)
            for lane, pointer in enumerate(pointers):
                x = e.emit(f"load double, ptr {e.element(source, lane, 'double')}, align 8")
                e.do(f"store double {x}, ptr {e.element(pointer, i, 'double')}, align 8")


def buffer(e: Emitter, size: int) -> str:
    """Stack memory for `size` values in all lanes."""
    return e.emit(f"alloca [{max(size, 1)} x {e.V}], align 64")


def map_function(name: str, kernel: str, tape: Tape, lanes: int) -> str:
    """`void name(i64 n, (ptr rows, i64 stride) per input, ptr rows per output)`: the kernel over a batch.

    A stride of 0 gives every state the same row; outputs are contiguous.
    """
    e = Emitter(lanes)
    ins, outs = list(tape.inputs.values()), list(tape.outputs.values())
    buffers = [buffer(e, size) for size in ins], [buffer(e, size) for size in outs]
    with e.loop("%n", lanes) as block:
        at = _Lanes(e, block, "%n")
        for k, size in enumerate(ins):
            at.gather(at.pointers(f"%in{k}", f"%s{k}"), buffers[0][k], size)
        pointers = ", ".join(f"ptr {b}" for b in [*buffers[0], *buffers[1]])
        e.do(f"call void @{kernel}({pointers})")
        for k, size in enumerate(outs):
            at.scatter(buffers[1][k], at.pointers(f"%out{k}", str(size)), size)
    arguments = ["i64 %n", *(f"ptr %in{k}, i64 %s{k}" for k in range(len(ins)))]
    arguments += [f"ptr %out{k}" for k in range(len(outs))]
    body = "\n".join(e.lines)
    return f"define void @{name}({', '.join(arguments)}) nounwind {{\n{body}\n  ret void\n}}\n"
