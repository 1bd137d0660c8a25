"""The smooth engine: a model's equations of motion as machine code.

    smooth = compile_model(model)
    a = smooth.forward(q, v, u)                       # one state or a batch
    path = smooth.rollout(q0, v0, u, step=1e-3, steps=1000)

Nothing is compiled before it is asked for; what was compiled once is found on disk the next time.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from pathlib import Path as FilePath
from typing import TypedDict, Unpack

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compile.cache import Cache, default_folder
from ..errors import EngineError
from ..integrate.control import length_of_time, tolerances
from ..integrate.tableau import Tableau
from ..integrate.tableaus import DOPRI5, RK4, tableau_of
from .fields import Parameter, parameter_index
from .laws import is_law
from .layout import Keyed, Layout, keyed_joints
from .machine import Machine
from .motion.adaptive import Spans, adaptive
from .motion.fixed import fixed
from .motion.path import Path
from .motion.prescribed import constant
from .motion.rows import Controls, Prescribed, PythonLaw, initial_states
from .problem import SmoothProblem
from .sensitivity import Derivatives, StepDerivatives, step_derivatives
from .support import unsupported

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

    Limits of joints and tendons are no part of these equations, nor is dry friction without a width:
    `Smooth.differences` names what is left out. Runs of scenes locate joint limits and choose a width.

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


class Smooth(Machine):
    """Compiled dynamics of one model; made by `compile_model`. Safe to use from several threads.

    The state is q (nq), v (nv) and act (na) over the joints that are not keyed; `w` is the prescribed motion
    (q, v, a) of the keyed ones (and what else `Layout` says), `u` the controls (nu), `p` the parameters.
    Every function takes one state (1-D arrays) or a batch (2-D, leading axis); an argument given once (1-D)
    serves a whole batch.
    """

    @cached_property
    def no_motion(self) -> Spans:
        """That nothing is prescribed."""
        return Spans(self.layout, constant(np.zeros(0), 0.0, 1.0))

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
        method: str | Tableau = RK4,
        hold: int | None = None,
        every: int = 1,
        act0: ArrayLike | None = None,
        w: Prescribed = None,
        p: ArrayLike | None = None,
        t0: float = 0.0,
    ) -> Path:
        """Integrate in `steps` steps of `step` seconds by an explicit Runge-Kutta `method`, compiled whole.

        Joints go through their limits here: a run of a scene stops them (see `differences`).

        `controls` are an array, (nu,), (periods, nu) or (batch, periods, nu); a law, as `LinearFeedback`; or
        a function (t, q, v) -> u, called from Python at the start of each period. They are held over `hold`
        steps (default: 1, or the whole span for a single row). Every `every` steps the state is recorded.
        `w` prescribes the keyed joints: a row (nw,), or a function of times (n,) -> (n, nw), evaluated at the
        stages' times. `method` is a name of `TABLEAUS` or a tableau. Raises EngineError for shapes that do
        not fit, a method that does not exist, and steps that are none.
        """
        tableau, step = tableau_of(method, where="rollout"), length_of_time("step", step)
        if steps < 1:
            raise EngineError(f"steps={steps} are none: give a positive number of steps")
        if hold is None:
            sampled = is_law(controls) or callable(controls)
            one_row = not sampled and (controls is None or np.ndim(controls) == 1)  # type: ignore[arg-type]
            hold = steps if one_row else 1
        if hold < 1 or every < 1 or steps % hold or steps % every:
            name, value = ("hold", hold) if hold < 1 or steps % hold else ("every", every)
            raise EngineError(f"{name} is {value} steps, which must divide the {steps} steps of the run")
        start = initial_states(self, q0, v0, act0)
        return fixed(
            self, start, method=tableau, step=step, steps=steps, controls=controls, hold=hold,
            every=every, w=w, p=p, t0=t0,
        )  # fmt: skip

    def integrate(
        self,
        q0: ArrayLike,
        v0: ArrayLike,
        t_eval: ArrayLike,
        controls: Controls = None,
        *,
        method: str | Tableau = DOPRI5,
        rtol: float | None = None,
        atol: float | Array | None = None,
        hold: float | None = None,
        act0: ArrayLike | None = None,
        w: Prescribed = None,
        breaks: ArrayLike = (),
        p: ArrayLike | None = None,
        first_step: float | None = None,
        max_steps: int = 1_000_000,
    ) -> Path:
        """Integrate from t_eval[0] to t_eval[-1] with steps that follow the tolerances, compiled whole.

        Joints go through their limits here: a run of a scene stops them (see `differences`). A missing one
        of `rtol` and `atol` equals the other; both are 1e-6 by default. `method` is a name of `TABLEAUS` or a
        tableau. The states at `t_eval` [s] (ascending) come from the method's continuous extension.
        `controls` as for `rollout`, held over `hold` seconds (None: the whole span; a function needs a
        number). `w` prescribes
        the keyed joints: a row (nw,), or a function of times (n,) -> (n, nw), which is taken over as
        polynomials; no step crosses its `breaks` [s], where it or a derivative jumps (found where they are
        not given), and prescribed velocities that jump pull the others along. A batch shares them. Events of
        one's own are found by `sim.integrate.solve(smooth.problem(u), ..., events=...)`. Raises EngineError
        for shapes that do not fit, for tolerances and times that are none, and for a method that does not
        exist or does not estimate its error.
        """
        tableau, (relative, absolute) = tableau_of(method, where="integrate"), tolerances(rtol, atol)
        times = np.ascontiguousarray(t_eval, dtype=np.float64)
        ascending = times.ndim == 1 and len(times) > 1 and (times[1:] > times[:-1]).all()
        if not (ascending and math.isfinite(times[0]) and math.isfinite(times[-1])):
            raise EngineError("t_eval must hold two or more ascending, finite times")
        for name, value in (("hold", hold), ("first_step", first_step)):
            if value is not None:
                length_of_time(name, value)
        start = initial_states(self, q0, v0, act0)
        return adaptive(
            self, start, times, method=tableau, rtol=relative, atol=absolute, controls=controls, hold=hold,
            w=w, breaks=breaks, p=p, first_step=first_step, max_steps=max_steps,
        )  # fmt: skip

    def step_derivatives(
        self,
        q: ArrayLike,
        v: ArrayLike,
        u: ArrayLike | None = None,
        *,
        step: float,
        method: str | Tableau = RK4,
        act: ArrayLike | None = None,
        w: Prescribed = None,
        p: ArrayLike | None = None,
        t0: float = 0.0,
    ) -> StepDerivatives:
        """Exact derivatives of one step of `method` by state (tangent space), control and parameters.

        One state (1-D arrays) or a batch; `w` prescribes the keyed joints as for `rollout`, from `t0` on.
        """
        tableau, step = tableau_of(method, where="step_derivatives"), length_of_time("step", step)
        start = initial_states(self, q, v, act)
        return step_derivatives(self, start, u, step=step, method=tableau, w=w, p=p, t0=t0)

    def problem(
        self, controls: ArrayLike | PythonLaw | None = None, *, w: Prescribed = None
    ) -> SmoothProblem:
        """dx/dt as a problem for `sim.integrate.solve`, controls constant or a function (t, q, v) -> u."""
        return SmoothProblem(self, controls, w)


def _matrix(flat: Array, rows: int) -> Array:
    columns = flat.shape[-1] // rows if rows else 0
    return flat.reshape(*flat.shape[:-1], rows, columns)
