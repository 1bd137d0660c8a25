"""What every engine is given and what it returns; the flow around it does not know which one runs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any, NamedTuple, Protocol

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..clip import Clip
from ..curves import Curve

Array = NDArray[np.float64]


class Role(IntEnum):
    """Who moves a joint."""

    PASSIVE = 0
    TRACKED = 1
    KEYED = 2


class Drive(IntEnum):
    """What becomes of an actuator of the model."""

    OFF = 0
    KEYS = 1
    CONTROLLER = 2


class State(NamedTuple):
    """State of a scene at a time: q (nq,), v (nv,), act (na,)."""

    q: Array
    v: Array
    act: Array


class Held(NamedTuple):
    """What a controller holds until its next sample: ctrl (nu,), and joint forces qfrc (nv,) in N or N m."""

    ctrl: Array
    qfrc: Array


class Controls(Protocol):
    """Inputs sampled at a fixed period and held in between."""

    period: float

    def sample(self, k: int, t: float, q: Array, v: Array) -> Held:
        """Inputs to hold from tick ``k`` at time ``t`` [s] and state q (nq,), v (nv,)."""
        ...


@dataclass(frozen=True)
class Wrench:
    """Force [N] and torque [N m] on a body at its centre of mass over time; ``stop`` is exclusive."""

    body: int
    force: Curve | None
    torque: Curve | None
    in_body_frame: bool = False
    start: float = -np.inf
    stop: float = np.inf


class Aims(Protocol):
    """Targets that are found while a run goes on, for joints that no keys move."""

    def at(self, t: float, q: Array, v: Array, target: tuple[Array, Array, Array]) -> tuple[Array, ...]:
        """``target`` (q (nq,), v (nv,), a (nv,)) with these joints where they belong at time ``t`` [s], seen
        from state q, v; called once a tick, in order."""
        ...


@dataclass(frozen=True)
class Problem:
    """A scene made ready for an engine.

    ``model`` has the scene's switches (contacts, limits, friction, gravity, idle actuators) applied.
    ``clip`` holds the motion of keyed and tracked joints; ``roles`` has one role a joint.
    ``servo`` maps an actuator driven by keys to its ctrl over time: t (n,) -> (n,).
    ``sample_every`` steps lie between two recorded samples. ``tolerance`` asks for adaptive steps.
    ``live`` makes, for a controller's period [s], the targets of tracked joints that follow goals live.
    ``friction_width`` [rad/s, m/s] smooths dry friction where an engine must; ``restitution`` is the part of
    its speed that a joint keeps at a limit, where an engine locates limits.
    """

    model: mujoco.MjModel
    state0: State
    duration: float
    roles: NDArray[np.int8]
    clip: Clip
    integrator: str
    step: float
    sample_every: int
    drives: NDArray[np.int8]
    servo: dict[int, Callable[[Array], Array]] = field(default_factory=dict)
    wrenches: tuple[Wrench, ...] = ()
    tolerance: float | None = None
    live: Callable[[float], Aims] | None = None
    friction_width: float | None = None
    restitution: float = 0.0

    @property
    def steps(self) -> int:
        """Physics steps in the whole duration."""
        return round(self.duration / self.step)

    def dofs(self, role: Role) -> NDArray[np.bool_]:
        """Mask (nv,) of the degrees of freedom of joints with this role."""
        joint_of_dof = self.model.dof_jntid
        return np.asarray(self.roles[joint_of_dof] == role, dtype=bool)


@dataclass(frozen=True)
class Event:
    """Something that happened at a time: kind is 'contact', 'contact end', 'limit', 'limit end'."""

    t: float
    kind: str
    what: str


@dataclass(frozen=True)
class Segment:
    """Motion that an engine computed, at its sample times.

    t (n,), q (n, nq), v (n, nv), act (n, na); ticks hold the controller's samples: tick_t (m,),
    tick_ctrl (m, nu), tick_qfrc (m, nv). ``status`` is 'done', 'diverged', 'interrupted' or 'failed';
    ``message`` says why a run stopped early. An engine with physics of its own adds the ``events`` that it
    located, accelerations ``a`` (n, nv), and ``drive`` (n, nv), what drives of keyed freedoms give.
    """

    t: Array
    q: Array
    v: Array
    act: Array
    tick_t: Array
    tick_ctrl: Array
    tick_qfrc: Array
    status: str
    message: str
    stats: dict[str, Any]
    events: tuple[Event, ...] = ()
    a: Array | None = None
    drive: Array | None = None


class Engine(Protocol):
    """Computes motion; its inner loop is its own."""

    name: str

    def order(self, integrator: str) -> int:
        """Order of one of its integrators."""
        ...

    def run(
        self,
        problem: Problem,
        t_span: tuple[float, float],
        controls: Controls | None,
        *,
        progress: Callable[[float], None] | None = None,
    ) -> Segment:
        """Motion over ``t_span`` [s] from ``problem.state0``; raises EngineError for what it cannot do.

        ``progress`` is told the simulated time [s] now and then. A KeyboardInterrupt ends the run with
        status 'interrupted' and what was computed so far.
        """
        ...
