"""LLVM IR text to machine code in this process, and back from object files."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import cache
from typing import Any


@cache
def host() -> tuple[str, str, str]:
    """Target triple, processor name and features of this machine."""
    import llvmlite.binding as llvm

    features: str = llvm.get_host_cpu_features().flatten()
    return llvm.get_process_triple(), llvm.get_host_cpu_name(), features


@cache
def _initialize() -> None:
    import llvmlite.binding as llvm

    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()


def preferred_lanes() -> int:
    """States computed side by side on this processor: one vector register of doubles."""
    features = host()[2].split(",")
    if "+avx512f" in features:
        return 8
    return 4 if "+avx" in features else 2


def fused() -> bool:
    """Whether this processor multiplies and adds in one operation with one rounding."""
    return "+fma" in host()[2].split(",")


def llvm_version() -> str:
    """LLVM's version with llvmlite's."""
    import llvmlite
    import llvmlite.binding as llvm

    return f"{'.'.join(map(str, llvm.llvm_version_info))}/{llvmlite.__version__}"


def target_machine(level: int) -> Any:
    """Code generator for this processor at optimization `level` (0-3)."""
    import llvmlite.binding as llvm

    _initialize()
    triple, cpu, features = host()
    # full-width registers where the processor has them
    features += ",-prefer-256-bit"
    return llvm.Target.from_triple(triple).create_target_machine(
        cpu=cpu, features=features, opt=level, jit=True
    )


def compile_ir(kernels: str, loops: str, *, inline: bool) -> bytes:
    """Object code of straight-line `kernels` and the `loops` that call them.

    The optimizer runs over the loops, and over the kernels where they are small enough to `inline`: a long
    tape has nothing left to optimize, so that it goes to code generation as it is. Its loops then
    take a small part of the time: level 1 costs a fifth of level 2 and gives rollouts of the same speed.
    """
    import llvmlite.binding as llvm

    module, body = llvm.parse_assembly(loops), llvm.parse_assembly(kernels)
    if inline:
        _link_inlined(module, body)
    tuning = llvm.create_pipeline_tuning_options(speed_level=2 if inline else 1)
    tuning.slp_vectorization = tuning.loop_vectorization = False
    machine = target_machine(2 if inline else 1)
    builder = llvm.create_pass_builder(machine, tuning)
    builder.getModulePassManager().run(module, builder)
    if not inline:
        module.link_in(body)
    code: bytes = machine.emit_object(module)
    return code


def _link_inlined(module: Any, body: Any) -> None:
    """Each call of a kernel becomes the kernel itself, so that states stay in registers between calls."""
    names = [function.name for function in body.functions if not function.is_declaration]
    module.link_in(body)
    for name in names:
        function = module.get_function(name)
        function.linkage = "internal"
        function.add_function_attribute("alwaysinline")


@dataclass(frozen=True)
class Loaded:
    """Machine code in memory; lives as long as this object or a function taken from it."""

    engine: Any

    def function(self, name: str, *argtypes: Any) -> Any:
        """A function of the module as a ctypes callable that releases the interpreter lock."""
        function: Any = ctypes.CFUNCTYPE(None, *argtypes)(self.engine.get_function_address(name))
        function.engine = self.engine  # the code must outlive whoever can call it
        return function


def load(code: bytes) -> Loaded:
    """Object code ready to run."""
    import llvmlite.binding as llvm

    _initialize()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(""), target_machine(1))
    engine.add_object_file(llvm.ObjectFileRef.from_data(code))
    engine.finalize_object()
    return Loaded(engine)
