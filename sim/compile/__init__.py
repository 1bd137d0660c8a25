"""From expression graphs to machine code in process: graph, derivatives, tape, LLVM, loops, disk cache."""
