"""The smooth engine: a model's equations of motion as machine code.

    smooth = compile_model(model)
    a = smooth.forward(q, v, u)                       # one state or a batch
    path = smooth.rollout(q0, v0, u, step=1e-3, steps=1000)

Nothing is compiled before it is asked for; what was compiled once is found on disk the next time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as FilePath
from typing import Any, TypedDict, Unpack

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compile import jit
from ..compile.cache import Cache, default_folder, key_of
from ..compile.program import Bound, Build, Program, map_source, obtain, workers
from ..errors import EngineError, unknown
from ..integrate.tableau import Tableau
from ..integrate.tableaus import DOPRI5, RK4
from .adaptive import adaptive
from .fields import Parameter, parameter_index
from .fingerprint import code_fingerprint, model_fingerprint
from .fixed import fixed
from .functions import FUNCTIONS, cheaper_formulation
from .laws import LinearFeedback
from .layout import Keyed, Layout, keyed_joints
from .loops import PARALLEL_OPERATIONS, Loop
from .path import Path
from .problem import SmoothProblem
from .rows import NO_MOTION, Controls, Prescribed, PythonLaw, Rows, initial_states
from .sensitivity import Derivatives, StepDerivatives, step_derivatives
from .support import differences, unsupported
from .symbolic import Equations

Array = NDArray[np.float64]


class Inputs(TypedDict, total=False):
    """What most functions take beside q, v and u, zero (p: the model's own values) where it is not given.

    `act` activations (na,); `tau` additional generalized forces on the state's freedoms (nv,); `w` the
    prescribed motion (nw,), needed with keyed joints; `p` parameters. A batch has a leading axis.
    """

    act: ArrayLike | None
    tau: ArrayLike | None
    w: ArrayLike | None
    p: ArrayLike | None


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


def compile_model(
    model: mujoco.MjModel,
    *,
    keyed: Keyed = (),
    parameters: Sequence[Parameter] = (),
    friction_width: float | None = None,
    timed: Sequence[int] = (),
    wrenches: Sequence[tuple[int, bool]] = (),
    forces: bool = False,
    lanes: int | None = None,
    threads: int | None = None,
    cache: FilePath | bool | None = True,
) -> Smooth:
    """The smooth engine for `model`.

    `keyed` names the joints whose motion is prescribed (names, ids, or a bool mask over freedoms);
    `parameters` model entries that become inputs `p`, as (field, name or row[, column]), e.g.
    ("body_mass", "forearm"), ("body_pos", "hand", 2), ("actuator_gainprm", "elbow", 0); `friction_width`
    [rad/s or m/s] smooths dry friction (None leaves it out); the controls of the `timed` actuators (ids) move
    from `u` to the end of `w`, where the `wrenches` on bodies follow (see `Layout`); with `forces`, `u` ends
    with generalized forces on the state's freedoms; `lanes` fixes the states computed side by side in a batch
    (default: what the processor is best at); `threads` limits those used for batches; `cache` is the folder
    of compiled code (True: the user's, None or False: none).

    Raises EngineError naming everything in the model that the engine cannot do.
    """
    joints = keyed_joints(model, keyed)
    problems = unsupported(model, keyed=joints)
    if problems:
        raise EngineError("the smooth engine cannot do:\n  " + "\n  ".join(problems))
    for parameter in parameters:
        parameter_index(model, parameter)
    if friction_width is not None and not friction_width > 0:
        raise EngineError(f"friction_width must be positive, not {friction_width}")
    folder = default_folder() if cache is True else (cache or None)
    layout = Layout(model, joints, timed=tuple(timed), wrenches=tuple(wrenches), forces=forces)
    return Smooth(model, layout, tuple(parameters), friction_width, lanes, threads, Cache(folder))


class Smooth:
    """Compiled dynamics of one model; made by `compile_model`. Safe to use from several threads.

    The state is q (nq), v (nv) and act (na) over the joints that are not keyed; `w` is the prescribed motion
    (q, v, a) of the keyed ones (and what else `Layout` says), `u` the controls (nu), `p` the parameters.
    Every function takes one state (1-D arrays) or a batch (2-D, leading axis); an argument given once (1-D)
    serves a whole batch.
    """

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
        self.differences = tuple(differences(model, friction_width=friction_width))
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
        self.still, self.own_parameters = Rows(np.zeros(layout.nu)), Rows(self.parameter_values)
        sizes = {"q": layout.nq, "v": layout.nv, "act": layout.na, "u": layout.nu, "tau": layout.nv}
        sizes |= {"a": layout.nv, "w": layout.nw, "p": len(parameters), "bar": max(layout.nx, layout.nv)}
        self._sizes = sizes

    @cached_property
    def key(self) -> str:
        """Hash over everything that compiled code of this model depends on."""
        lay = self.layout
        roles = repr((lay.keyed, lay.timed, lay.wrenches, lay.forces, self.parameters, self.friction_width))
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

    def tape(self, name: str) -> Any:
        """The program of one of FUNCTIONS before compilation (`.casadi()` gives it to optimisers)."""
        return FUNCTIONS[name](self.equations, self.formulation)

    def program(self, name: str, lanes: int) -> Program:
        """The compiled function `name` of FUNCTIONS in `lanes`."""
        found = self._programs.get((name, lanes))
        if found is None:

            def make() -> tuple[str, str, dict[str, Any]]:
                kernels, loops, facts = map_source(self.tape(name), lanes)
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

    def forward(
        self, q: ArrayLike, v: ArrayLike, u: ArrayLike | None = None, **inputs: Unpack[Inputs]
    ) -> Array:
        """Accelerations [rad/s^2, m/s^2] under controls `u` (see `Inputs` for the rest)."""
        return self.evaluate("forward", q=q, v=v, u=u, **inputs)["a"]

    def inverse(
        self,
        q: ArrayLike,
        v: ArrayLike,
        a: ArrayLike,
        *,
        w: ArrayLike | None = None,
        p: ArrayLike | None = None,
    ) -> Array:
        """Forces on all the model's freedoms, beside passive ones, that produce the acceleration `a`."""
        return self.evaluate("inverse", q=q, v=v, a=a, w=w, p=p)["tau"]

    def drive(
        self, q: ArrayLike, v: ArrayLike, u: ArrayLike | None = None, **inputs: Unpack[Inputs]
    ) -> Array:
        """Forces that the drives of the keyed freedoms give beside their actuators and passive forces."""
        return self.evaluate("drive", q=q, v=v, u=u, **inputs)["drive"]

    def mass_matrix(self, q: ArrayLike, *, w: ArrayLike | None = None, p: ArrayLike | None = None) -> Array:
        """Inertia matrix, shape (..., nv, nv)."""
        return _matrix(self.evaluate("mass_matrix", q=q, w=w, p=p)["M"], self.layout.nv)

    def energy(
        self, q: ArrayLike, v: ArrayLike, *, w: ArrayLike | None = None, p: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Kinetic and potential energy [J] (gravity, joint and tendon springs)."""
        out = self.evaluate("energy", q=q, v=v, w=w, p=p)
        return out["kinetic"][..., 0], out["potential"][..., 0]

    def momentum(
        self, q: ArrayLike, v: ArrayLike, *, w: ArrayLike | None = None, p: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Linear momentum [kg m/s] and angular momentum about the world's origin [kg m^2/s]."""
        out = self.evaluate("momentum", q=q, v=v, w=w, p=p)
        return out["linear"], out["angular"]

    def poses(
        self, q: ArrayLike, *, sites: bool = False, w: ArrayLike | None = None, p: ArrayLike | None = None
    ) -> tuple[Array, Array]:
        """Positions (..., n, 3) [m] and rotation matrices (..., n, 3, 3) of all bodies, or of all sites."""
        out = self.evaluate("sites" if sites else "poses", q=q, w=w, p=p)
        lead = out["p"].shape[:-1]
        return out["p"].reshape(*lead, -1, 3), out["R"].reshape(*lead, -1, 3, 3)

    def derivatives(
        self, q: ArrayLike, v: ArrayLike, u: ArrayLike | None = None, **inputs: Unpack[Inputs]
    ) -> Derivatives:
        """Exact derivatives of `forward` by q (tangent space), v, tau."""
        out, n = self.evaluate("derivatives", q=q, v=v, u=u, **inputs), self.layout.nv
        return Derivatives(out["a"], *(_matrix(out[key], n) for key in ("dq", "dv", "dtau")))

    def control_derivatives(
        self, q: ArrayLike, v: ArrayLike, u: ArrayLike | None = None, **inputs: Unpack[Inputs]
    ) -> dict[str, Array]:
        """Exact derivatives of `forward` by "act", "u" and "p", shapes (..., nv, n)."""
        out = self.evaluate("control_derivatives", q=q, v=v, u=u, **inputs)
        return {key: _matrix(out["d" + key], self.layout.nv) for key in ("act", "u", "p")}

    def vjp(
        self, bar: ArrayLike, q: ArrayLike, v: ArrayLike, u: ArrayLike | None = None, **inputs: Unpack[Inputs]
    ) -> dict[str, Array]:
        """bar^T times the derivatives of `forward` by "q" (tangent space), "v", "act", "u", "tau", "p"."""
        wide = np.asarray(bar, dtype=float)
        spare = max(self.layout.nx, self.layout.nv) - wide.shape[-1]
        wide = np.concatenate([wide, np.zeros((*wide.shape[:-1], spare))], axis=-1)
        return self.evaluate("vjp", q=q, v=v, u=u, bar=wide, **inputs)

    def rollout(
        self,
        q0: ArrayLike,
        v0: ArrayLike,
        controls: Controls = None,
        *,
        step: float,
        steps: int,
        method: Tableau = RK4,
        hold: int | None = None,
        every: int = 1,
        act0: ArrayLike | None = None,
        w: Prescribed = None,
        p: ArrayLike | None = None,
        t0: float = 0.0,
    ) -> Path:
        """Integrate in `steps` steps of `step` seconds by an explicit Runge-Kutta `method`, compiled whole.

        `controls` are an array, (nu,), (periods, nu) or (batch, periods, nu); a `LinearFeedback`; or a
        function (t, q, v) -> u, called from Python at the start of each period. They are held over `hold`
        steps (default: 1, or the whole span for a single row). Every `every` steps the state is recorded.
        `w` prescribes the keyed joints: a row (nw,), or a function of times (n,) -> (n, nw), evaluated at the
        stages' times. Raises EngineError for shapes that do not fit.
        """
        if hold is None:
            sampled = isinstance(controls, LinearFeedback) or callable(controls)
            one_row = not sampled and (controls is None or np.ndim(controls) == 1)  # type: ignore[arg-type]
            hold = steps if one_row else 1
        for name, value in (("hold", hold), ("every", every)):
            if value < 1 or steps % value:
                raise EngineError(f"{name} is {value} steps, which must divide the {steps} steps of the run")
        start = initial_states(self, q0, v0, act0)
        return fixed(
            self, start, method=method, step=float(step), steps=steps, controls=controls, hold=hold,
            every=every, w=w, p=p, t0=t0,
        )  # fmt: skip

    def integrate(
        self,
        q0: ArrayLike,
        v0: ArrayLike,
        t_eval: ArrayLike,
        controls: Controls = None,
        *,
        method: Tableau = DOPRI5,
        rtol: float = 1e-6,
        atol: float | Array = 1e-6,
        hold: float | None = None,
        act0: ArrayLike | None = None,
        w: Prescribed = None,
        breaks: ArrayLike = (),
        p: ArrayLike | None = None,
        first_step: float | None = None,
        max_steps: int = 1_000_000,
    ) -> Path:
        """Integrate from t_eval[0] to t_eval[-1] with steps that follow the tolerances, compiled whole.

        The states at `t_eval` [s] (ascending) come from the method's continuous extension. `controls` as for
        `rollout`, held over `hold` seconds (None: the whole span), without functions. `w` prescribes the
        keyed joints: a row (nw,), or a function of times (n,) -> (n, nw), which is taken over as polynomials;
        no step crosses its `breaks` [s], where it or a derivative jumps (found where they are not given), and
        prescribed velocities that jump pull the others along. A batch shares them. Raises EngineError for
        shapes that do not fit and for a method without an error estimate.
        """
        times = np.ascontiguousarray(t_eval, dtype=np.float64)
        if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0).all():
            raise EngineError("t_eval must hold two or more ascending times")
        start = initial_states(self, q0, v0, act0)
        return adaptive(
            self, start, times, method=method, rtol=float(rtol), atol=atol, controls=controls, hold=hold, w=w,
            breaks=breaks, p=p, first_step=first_step, max_steps=max_steps,
        )  # fmt: skip

    def step_derivatives(
        self,
        q: ArrayLike,
        v: ArrayLike,
        u: ArrayLike | None = None,
        *,
        step: float,
        method: Tableau = RK4,
        act: ArrayLike | None = None,
        w: Prescribed = None,
        p: ArrayLike | None = None,
        t0: float = 0.0,
    ) -> StepDerivatives:
        """Exact derivatives of one step of `method` by state (tangent space), control and parameters.

        One state (1-D arrays) or a batch; `w` prescribes the keyed joints as for `rollout`, from `t0` on.
        """
        start = initial_states(self, q, v, act)
        return step_derivatives(self, start, u, step=step, method=method, w=w, p=p, t0=t0)

    def problem(
        self, controls: ArrayLike | PythonLaw | None = None, *, w: Prescribed = None
    ) -> SmoothProblem:
        """dx/dt as a problem for `sim.integrate.solve`, controls constant or a function (t, q, v) -> u."""
        return SmoothProblem(self, controls, w)


def _matrix(flat: Array, rows: int) -> Array:
    columns = flat.shape[-1] // rows if rows else 0
    return flat.reshape(*flat.shape[:-1], rows, columns)
