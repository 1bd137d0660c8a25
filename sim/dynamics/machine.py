"""A model's functions as machine code, built when they are asked for."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compile import jit
from ..compile.cache import Cache, key_of
from ..compile.program import Bound, Build, Program, map_source, obtain, workers
from ..errors import EngineError, unknown
from .derivatives import JACOBIANS
from .fields import Parameter, parameter_index
from .fingerprint import code_fingerprint, model_fingerprint
from .functions import FUNCTIONS, cheaper_formulation
from .layout import Layout
from .motion.loops import PARALLEL_OPERATIONS, Loop
from .motion.rows import NO_MOTION, Rows
from .support import differences
from .symbolic import Equations

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Stats:
    """What an engine has built so far.

    Attributes:
        formulation: of the forward dynamics: "composite" (inertia matrix and factor) or "articulated".
        operations: scalar operations of one evaluation of the forward dynamics.
        lanes: states computed side by side in batches.
        builds: every program with seconds of its symbolic build, compilation and loading.
    """

    formulation: str
    operations: int
    lanes: int
    builds: tuple[Build, ...]

    @property
    def seconds(self) -> float:
        """Time spent on all programs."""
        return sum(b.symbolic_s + b.compile_s + b.load_s for b in self.builds)

    @property
    def cached(self) -> bool:
        """Whether every program was found on disk."""
        return bool(self.builds) and all(b.cached for b in self.builds)


class Machine:
    """Machine code of one model: its programs, by name and lanes. Safe to use from several threads."""

    def __init__(
        self,
        model: mujoco.MjModel,
        layout: Layout,
        parameters: tuple[Parameter, ...],
        friction_width: float | None,
        lanes: int | None,
        threads: int | None,
        cache: Cache,
    ):
        self.model = model
        self.layout = layout
        self.parameters, self.friction_width = parameters, friction_width
        self.lanes = lanes or jit.preferred_lanes()
        self.threads = threads or workers()
        self.differences = tuple(differences(model, friction_width=friction_width, keyed=layout.keyed))
        self.parameter_values = np.array(
            [
                np.atleast_2d(getattr(model, f).T).T[r, c]
                for f, r, c in (parameter_index(model, p) for p in parameters)
            ],
            dtype=float,
        )
        self.cache = cache
        self._programs: dict[tuple[str, int], Program] = {}
        self.loops: dict[tuple[Any, ...], Loop] = {}
        self.ones = np.ones(layout.nx)
        self.still, self.own_parameters = Rows(np.zeros(layout.nu)), Rows(self.parameter_values)
        sizes = {"q": layout.nq, "v": layout.nv, "act": layout.na, "u": layout.nu, "tau": layout.nv}
        sizes |= {"a": layout.nv, "w": layout.nw, "p": len(parameters), "bar": max(layout.nx, layout.nv)}
        self._sizes = sizes

    @cached_property
    def key(self) -> str:
        """Hash over everything that compiled code of this model depends on."""
        lay = self.layout
        entries = [
            parameter_index(self.model, p) for p in self.parameters
        ]  # names are not in the fingerprint
        roles = repr((lay.keyed, lay.timed, lay.wrenches, lay.forces, entries, self.friction_width))
        versions = repr((jit.llvm_version(), jit.host(), mujoco.mj_versionString()))
        return key_of(model_fingerprint(self.model), roles, versions, code_fingerprint())

    @cached_property
    def equations(self) -> Equations:
        """The symbolic model."""
        return Equations(
            self.model, self.layout, parameters=self.parameters, friction_width=self.friction_width
        )

    @cached_property
    def formulation(self) -> str:
        """The cheaper formulation of the forward dynamics."""
        return cheaper_formulation(self.equations)

    def tape(self, name: str, *, columns: int = 1) -> Any:
        """The program of one of FUNCTIONS or JACOBIANS before compilation; `.casadi()` is for optimisers.

        Up to `columns` of a Jacobian's columns are computed side by side.
        """
        if name in JACOBIANS:
            return JACOBIANS[name](self.equations, columns)
        return FUNCTIONS[name](self.equations, self.formulation)

    def program(self, name: str, lanes: int) -> Program:
        """The compiled function `name` of FUNCTIONS or JACOBIANS in `lanes`."""
        found = self._programs.get((name, lanes))
        if found is None:

            def make() -> tuple[str, str, dict[str, Any]]:
                columns = jit.preferred_lanes() if lanes == 1 else 1  # for more states the lanes are theirs
                kernels, loops, facts = map_source(self.tape(name, columns=columns), lanes)
                return kernels, loops, facts | {"formulation": self.formulation}

            code = obtain(name, lanes, self.cache, key_of(self.key, "map", name, str(lanes)), make)
            found = self._programs[name, lanes] = Program(code, lanes)
        return found

    def bind(self, name: str, count: int = 1) -> Bound:
        """Function `name` on arrays of its own, for the quickest calls on one state or `count` of them."""
        return Bound(self.program(name, 1 if count == 1 else self.lanes), count)

    @property
    def stats(self) -> Stats:
        """What was built so far."""
        programs = [*self._programs.values()]
        builds = tuple([p.build for p in programs] + [loop.code.build for loop in self.loops.values()])
        facts = [p.code.facts for p in programs if p.build.name == "forward"]
        facts = facts or [self.program("forward", 1).code.facts]
        return Stats(facts[0]["formulation"], facts[0]["operations"], self.lanes, builds)

    def _rows(self, name: str, value: ArrayLike | None, size: int) -> Array:
        if value is None:
            if name == "p":
                return self.parameter_values
            if name == "w" and size:
                raise EngineError(NO_MOTION)
            return np.zeros(size)
        array = np.ascontiguousarray(value, dtype=np.float64)
        if array.ndim not in (1, 2) or array.shape[-1] != size:
            raise EngineError(f"{name} has shape {array.shape}; expected ({size},) or (batch, {size})")
        return array

    def evaluate(self, name: str, **arguments: ArrayLike | None) -> dict[str, Array]:
        """Outputs of function `name` of FUNCTIONS by name, flat; a batch if any argument is one."""
        sizes = self._sizes
        for key in arguments:
            if key not in sizes:
                raise EngineError(unknown("argument", key, sizes, where=f"function {name!r}"))
        rows = {key: self._rows(key, value, sizes[key]) for key, value in arguments.items()}
        counts = {len(x) for x in rows.values() if x.ndim == 2}
        if len(counts) > 1:
            raise EngineError(f"batches of different lengths: {sorted(counts)}")
        count = counts.pop() if counts else 1
        single = all(x.ndim == 1 for x in rows.values())
        program = self.program(name, 1 if count == 1 else self.lanes)
        arrays = [rows[key] if key in rows else self._rows(key, None, sizes[key]) for key in program.inputs]
        work = count * program.build.operations
        outs = program(arrays, count, self.threads if work > PARALLEL_OPERATIONS else 1)
        return {key: out[0] if single else out for key, out in zip(program.outputs, outs, strict=True)}
