"""The linear loop that a law of a scene makes: the mechanism, the gains of the law, and its memory."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, cast

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import dof_names, name_of
from ...sim.compose import make_engine, make_law
from ...sim.control import Law, Sampled, Target
from ...sim.engines.interface import Problem, Role
from ...sim.errors import PantographError
from ...sim.plan import Plan
from ...sim.scene.angles import law_words
from ..nominal import Nominal, moved
from ..preview import aimed
from ..reality import LOOP_WORDS, LoopMemory
from .linear import LinearSystem, held, linearise, linearise_contact
from .memory import LinearLaw, linear_law, numbers

if TYPE_CHECKING:
    from ..swing_up import SwingUp

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
_MOST = 2000  # numbers of a memory that become states


class LinearLoop(NamedTuple):
    """The sampled mechanism with the law's memory as further states, the gains K (m, n) of both, in words
    about what they are and what is left out, and the mechanism alone."""

    system: LinearSystem
    K: Array
    says: str
    mechanism: LinearSystem


class _Point(NamedTuple):
    """Where a loop is linearised: time [s], state q, v, target, and the law's memory there."""

    t: float
    q: Array
    v: Array
    target: Target
    memory: Any


def loop_of(
    plan: Plan, law: str, words: Mapping[str, Any], *, t: float = 0.0, step: float = 1e-6
) -> LinearLoop:
    """The loop of ``law`` with parameters ``words`` in the units of its scene at time ``t`` [s], by
    derivatives of the engine that the plan chose.

    On the smooth engine they are exact, about the keys, with the law's memory as after its first sample;
    joints without keys are at the law's ``goal`` or where they start. On the contact engine they are
    differences, contacts and limits included, about the state that a run under the law has at ``t``. K is
    minus the derivative of the law's forces by state and memory, by centred differences of ``step`` [rad, m,
    and per second]. Delays and velocity filters are part of the memory; what else sensors and drives do is
    left out. Of a swing-up the loop is that of its catch about the goal. Raises PantographError when the
    scene has nothing to control, for times outside it, for a run that does not reach ``t``, and for laws that
    plan anew at every sample: derivatives at one do not tell what they do.
    """
    problem, period = plan.problem, plan.period
    if period is None:
        raise PantographError("this scene has nothing to control: give joints the role 'tracked'")
    if not 0.0 <= t <= problem.duration:
        raise PantographError(f"time {t:g} s is outside the scene, which lasts {problem.duration:g} s")
    m = problem.model
    known = law_words(plan.setup.scene, m, words)
    own = {word: value for word, value in known.items() if word not in _left(words)}
    if law == "nmpc":
        raise PantographError(
            "law 'nmpc' has no linear loop: it plans anew at every sample. Where no limit is near it does "
            "about what LQR with the same weights and goal does: gains --law lqr shows that loop"
        )
    made = make_law(law, problem, own, period)
    if law == "swing-up":
        return _caught(problem, {w: x for w, x in own.items() if w not in LOOP_WORDS}, known, period)
    tracked, keyed = problem.dofs(Role.TRACKED), problem.dofs(Role.KEYED)
    if plan.engine.what == "contact":
        at = _run_to(plan, made, t)
        tau, _ = made(at.t, at.q, at.v, at.target, at.memory)
        pushed, a = np.where(tracked, tau, 0.0), at.target.a
        mechanism = linearise_contact(m, at.q, at.v, pushed, inputs=tracked, keyed=keyed, a_keyed=a)
        says = f"about the run at t = {at.t:g} s, by differences of the contact engine; {_touching(m, at.q)}"
    else:
        at = _on_keys(problem, made, own, t, period)
        need = Nominal(m).inverse(*at.target)
        mechanism = linearise(m, at.q, at.v, need, inputs=tracked, keyed=keyed, a_keyed=at.target.a)
        says = f"about the keys at t = {t:g} s, by exact derivatives{_left_out(problem)}"
    if (many := len(numbers(at.memory))) > _MOST:
        raise PantographError(
            f"law {law!r} keeps {many} numbers from sample to sample: too many for states of a linear loop"
        )
    left = _left(words)
    says += f"; left out of the loop: {', '.join(left)}" if left else ""
    found = _linear(made, at, m, tracked, keyed, step)
    alone = held(mechanism, period)
    return LinearLoop(_with_memory(alone, found), np.hstack([found.K, -found.C]), says, alone)


def _caught(problem: Problem, own: dict[str, Any], words: Mapping[str, Any], period: float) -> LinearLoop:
    """The loop of a swing-up's catch, an LQR about the goal, without sensors and drives."""
    made = cast("SwingUp", make_law("swing-up", problem, own, period))
    (catch, _), tracked = made.shaping.catch, problem.dofs(Role.TRACKED)
    alone = held(linearise(problem.model, made.shaping.goal, inputs=tracked), period)
    says = "about the goal, where the catch holds the machine, by exact derivatives"
    left = [word for word in words if word in LOOP_WORDS]
    says += _left_out(problem) + (f"; left out of the loop: {', '.join(left)}" if left else "")
    return LinearLoop(alone, catch.regulator.K, says, alone)


def _on_keys(problem: Problem, law: Law, own: Mapping[str, Any], t: float, period: float) -> _Point:
    clip, _ = aimed(problem.clip, own.get("goal") or {}, "goal")
    memory = law.start()
    target = Target(*clip.evaluate(t))
    for k in range(len(memory.queue) + 1 if isinstance(memory, LoopMemory) else 1, 0, -1):
        before = Target(*clip.evaluate(max(0.0, t - k * period)))
        _, memory = law(t - k * period, before.q, before.v, before, memory)
    return _Point(t, target.q, target.v, target, memory)


def _run_to(plan: Plan, law: Law, t: float) -> _Point:
    """The state of a run under the law at ``t``, on the grid of its period."""
    problem, period = plan.problem, plan.period
    assert period is not None
    ticks = round(t / period)
    target = Target(*problem.clip.evaluate(ticks * period))
    if not ticks:
        return _Point(0.0, problem.state0.q, problem.state0.v, target, law.start())
    controls = Sampled(law, problem, period)
    segment = make_engine(plan.engine.what).run(problem, (0.0, ticks * period), controls)
    if segment.status != "done":
        raise PantographError(f"the run to t = {t:g} s under this law ended early: {segment.message}")
    return _Point(ticks * period, segment.q[-1], segment.v[-1], target, controls.memory)


def _left(words: Mapping[str, Any]) -> tuple[str, ...]:
    """Words of sensors and drives that are no part of the linear loop."""
    kept = {"delay", "predict"} | (
        {"observer", "corner"} if words.get("observer") in ("none", "filter") else set()
    )
    return tuple(word for word in words if word in LOOP_WORDS and word not in kept)


def _linear(law: Law, at: _Point, m: mujoco.MjModel, tracked: Mask, keyed: Mask, step: float) -> LinearLaw:
    free, n = ~keyed, int((~keyed).sum())

    def forces(x: Array, memory: Any) -> tuple[Array, Any]:
        dq, dv = np.zeros(m.nv), np.zeros(m.nv)
        dq[free], dv[free] = x[:n], x[n:]
        tau, after = law(at.t, moved(m, at.q, dq), at.v + dv, at.target, memory)
        return tau[tracked], after

    return linear_law(forces, at.memory, 2 * n, step, dof_names(m))


def _with_memory(mechanism: LinearSystem, law: LinearLaw) -> LinearSystem:
    """x+ = A x + B u beside m+ = G x + M m."""
    (n, inputs), k = mechanism.B.shape, len(law.names)
    A = np.block([[mechanism.A, np.zeros((n, k))], [law.G, law.M]])
    B = np.vstack([mechanism.B, np.zeros((k, inputs))])
    return LinearSystem(A, B, (*mechanism.states, *law.names), mechanism.inputs, mechanism.period)


def _touching(m: mujoco.MjModel, q: Array) -> str:
    """Pairs of bodies that touch at q, in words."""
    data = mujoco.MjData(m)
    data.qpos[:] = q
    mujoco.mj_forward(m, data)
    pairs = {
        tuple(sorted(name_of(m, "body", int(m.geom_bodyid[g])) for g in data.contact.geom[i]))
        for i in range(data.ncon)
        if data.contact.dist[i] <= 0.0
    }
    return (
        f"touching: {', '.join(' and '.join(pair) for pair in sorted(pairs))}" if pairs else "nothing touches"
    )


def _left_out(problem: Problem) -> str:
    """What of the scene's physics the exact derivatives do not have, in words."""
    m = problem.model
    off = int(m.opt.disableflags)
    parts = {
        "joint limits": m.jnt_limited.any() and not off & int(mujoco.mjtDisableBit.mjDSBL_LIMIT),
        "dry friction": m.dof_frictionloss.any() and not off & int(mujoco.mjtDisableBit.mjDSBL_FRICTIONLOSS),
    }
    names = " and ".join(name for name, there in parts.items() if there)
    return f"; {names} left out" if names else ""
