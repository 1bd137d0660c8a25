"""What a scene needs to be computed, worked out in one place, with reasons and with what would be cheaper."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from ..models import name_of
from .engines.contact import INTEGRATORS
from .engines.interface import Drive, Problem, Role
from .errors import SceneError
from .scene.build import Setup, build
from .scene.mistakes import Mistake, report
from .scene.schema import Scene

_DEFAULT_PERIOD = 0.002  # s; period of the controller of tracked joints when the scene names none


@dataclass(frozen=True)
class Choice:
    """One decision: what, and why."""

    what: str
    why: str


@dataclass(frozen=True)
class Plan:
    """How a scene is computed.

    ``period`` [s] is the controller's, None without one. ``left_out`` and ``cheaper`` are sentences.
    """

    setup: Setup
    engine: Choice
    integrator: Choice
    step: Choice
    problem: Problem
    period: float | None
    left_out: tuple[str, ...]
    cheaper: tuple[str, ...]

    def joints(self, role: Role) -> tuple[str, ...]:
        """Names of the joints in a role."""
        m = self.problem.model
        return tuple(name_of(m, "joint", int(j)) for j in np.flatnonzero(self.problem.roles == role))

    def actuators(self, drive: Drive) -> tuple[str, ...]:
        """Names of the actuators with a drive."""
        m = self.problem.model
        return tuple(name_of(m, "actuator", int(i)) for i in np.flatnonzero(self.problem.drives == drive))


def make_plan(scene: Scene) -> Plan:
    """Work out what a scene needs. Raises SceneError with every mistake of the scene."""
    return plan_setup(build(scene))


def plan_setup(setup: Setup) -> Plan:
    """Plan of a scene that is resolved already."""
    scene, model = setup.scene, setup.model
    engine = _engine(setup)
    touch = can_touch(model)
    period = _period(setup)
    h, step = _step(setup, engine.what, period)
    integrator = _integrator(setup, engine.what, touch, h)
    problem = Problem(
        model=model,
        state0=setup.state0,
        duration=scene.duration,
        roles=setup.roles,
        clip=setup.clip,
        integrator=integrator.what,
        step=h,
        sample_every=max(1, round(1.0 / (scene.rate * h))),
        drives=setup.drives,
        servo=setup.servo,
        wrenches=setup.wrenches,
    )
    return Plan(
        setup,
        engine,
        integrator,
        step,
        problem,
        period,
        tuple(_left_out(setup, engine.what)),
        tuple(_cheaper(setup, engine.what, integrator.what, touch)),
    )


def _fail(setup: Setup, path: tuple[str | int, ...], message: str) -> SceneError:
    return report([Mistake(path, message)], setup.scene._file, setup.scene._lines)


def _engine(setup: Setup) -> Choice:
    asked = setup.scene.solver.engine
    free = [name_of(setup.model, "joint", int(j)) for j in np.flatnonzero(setup.roles != Role.KEYED)]
    if asked == "kinematic" and free:
        shown = ", ".join(free[:8]) + (", ..." if len(free) > 8 else "")
        raise _fail(
            setup,
            ("solver", "engine"),
            f'the kinematic engine needs keys on every joint; without keys: {shown}. Use engine = "auto"',
        )
    if asked == "smooth":
        raise _fail(
            setup, ("solver", "engine"), "this version has no smooth engine; it has: kinematic, contact"
        )
    if asked != "auto":
        return Choice(asked, "the scene asks for it")
    if not free:
        return Choice("kinematic", "every joint is keyed, so no dynamics is needed")
    count = "one joint moves" if len(free) == 1 else f"{len(free)} joints move"
    return Choice("contact", f"{count} by physics")


def _period(setup: Setup) -> float | None:
    """The controller's period when something needs a controller."""
    tracked = setup.roles == Role.TRACKED
    by_servo = {int(setup.model.actuator_trnid[i, 0]) for i in np.flatnonzero(setup.drives == Drive.KEYS)}
    needed = [j for j in np.flatnonzero(tracked) if int(j) not in by_servo]
    if not needed and not (setup.drives == Drive.CONTROLLER).any():
        return None
    return setup.scene.controller.period if setup.scene.controller else _DEFAULT_PERIOD


def _step(setup: Setup, engine: str, period: float | None) -> tuple[float, Choice]:
    asked, model = setup.scene.solver.step, setup.model
    if engine == "kinematic":
        n = max(1, round(setup.scene.duration * setup.scene.rate))
        h = setup.scene.duration / n
        return h, Choice(f"{h:.6g} s", f"keys are only looked up, {setup.scene.rate:g} times a second")
    if asked != "auto":
        if period is not None:
            ratio = period / asked
            if round(ratio) < 1 or abs(ratio - round(ratio)) > 1e-6:
                raise _fail(
                    setup,
                    ("controller", "period"),
                    f"the controller's period {period:g} s is no whole multiple of the step {asked:g} s; "
                    f"try {period / max(1, np.floor(ratio)):.6g} s or {period / np.ceil(ratio):.6g} s",
                )
        return asked, Choice(f"{asked:g} s", "the scene asks for it")
    h = float(model.opt.timestep)
    if period is None:
        return h, Choice(f"{h:g} s", "the model file says so")
    fitted = period / np.ceil(period / h - 1e-9)
    why = "the model file says so" if abs(fitted - h) < 1e-12 else f"the model's {h:g} s fitted to the period"
    return float(fitted), Choice(f"{fitted:.6g} s", f"{why}; {round(period / fitted)} a controller period")


def _integrator(setup: Setup, engine: str, touch: bool, h: float) -> Choice:
    asked = setup.scene.solver.integrator
    if engine == "kinematic":
        return Choice("none", "nothing is integrated")
    if setup.scene.solver.tolerance is not None:
        raise _fail(
            setup, ("solver", "tolerance"), "no integrator of the contact engine is adaptive; use 'step'"
        )
    if asked != "auto":
        if asked not in INTEGRATORS:
            listing = ", ".join(sorted(INTEGRATORS))
            message = f"the contact engine has no integrator {asked!r}; it has: {listing}"
            raise _fail(setup, ("solver", "integrator"), message)
        return Choice(asked, "the scene asks for it")
    fastest = fastest_rate(setup)
    if fastest * h > 1.0:
        return Choice("discrete", f"servos or springs at {fastest:.3g} rad/s are stiff for a step of {h:g} s")
    if touch:
        return Choice("rk4", "nothing is stiff; order 4 between contacts, 1 where they begin and end")
    return Choice("rk4", "the motion is smooth: order 4")


def fastest_rate(setup: Setup) -> float:
    """Largest natural frequency [rad/s] or damping rate [1/s] of springs and servos, joint by joint."""
    m = setup.model
    data = mujoco.MjData(m)
    data.qpos[:] = setup.state0.q
    mujoco.mj_forward(m, data)
    inverse = np.eye(m.nv)
    mujoco.mj_solveM(m, data, inverse, np.eye(m.nv))
    mobility = np.diag(inverse)
    stiffness, damping = np.zeros(m.nv), np.array(m.dof_damping, dtype=float).reshape(m.nv, -1)[:, 0]
    for j in range(m.njnt):
        stiffness[m.jnt_dofadr[j]] += float(np.ravel(m.jnt_stiffness[j])[0])
    for i in range(m.nu):
        if m.actuator_trntype[i] == mujoco.mjtTrn.mjTRN_JOINT:
            dof = m.jnt_dofadr[m.actuator_trnid[i, 0]]
            gear = m.actuator_gear[i, 0]
            stiffness[dof] += max(0.0, -m.actuator_biasprm[i, 1]) * gear**2
            damping[dof] += max(0.0, -m.actuator_biasprm[i, 2]) * gear**2
    moving = setup.roles[m.dof_jntid] != Role.KEYED
    rates = np.maximum(np.sqrt(stiffness * mobility), damping * mobility)
    return float(np.max(rates[moving], initial=0.0))


def can_touch(model: mujoco.MjModel) -> bool:
    """Whether any two geoms of the model could make a contact."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    if model.npair:
        return True
    excluded = {int(s) for s in model.exclude_signature}
    active = np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    weld, parent = model.body_weldid, model.body_parentid
    for i, g1 in enumerate(active):
        for g2 in active[i + 1 :]:
            if not (
                model.geom_contype[g1] & model.geom_conaffinity[g2]
                or model.geom_contype[g2] & model.geom_conaffinity[g1]
            ):
                continue
            b1, b2 = sorted((int(model.geom_bodyid[g1]), int(model.geom_bodyid[g2])))
            w1, w2 = int(weld[b1]), int(weld[b2])
            if w1 == w2 or (b1 << 16) + b2 in excluded:
                continue
            # MuJoCo lets parent and child pass through each other, except for the world
            if w1 and w2 and (weld[parent[w1]] == w2 or weld[parent[w2]] == w1):
                continue
            return True
    return False


def _left_out(setup: Setup, engine: str) -> list[str]:
    scene, out = setup.scene, []
    physics = scene.physics
    if physics.contacts == "none":
        out.append('contacts: physics.contacts = "none"; recorded frames are checked for overlaps')
    elif physics.contacts != "model":
        out.append("contacts of other pairs than named; recorded frames are checked for overlaps")
    if not physics.limits:
        out.append("joint limits: physics.limits = false; recorded frames are checked for crossings")
    if not physics.friction:
        out.append("dry friction: physics.friction = false")
    if physics.gravity is False:
        out.append("gravity: physics.gravity = false")
    if engine == "kinematic":
        out.append(
            "all dynamics: nothing but keys moves; recorded frames are checked for overlaps and limits"
        )
    elif (setup.roles == Role.KEYED).any():
        out.append("what pushes keyed joints: they cannot yield; the force their drive needs is recorded")
    idle = [name_of(setup.model, "actuator", int(i)) for i in np.flatnonzero(setup.drives == Drive.OFF)]
    if idle:
        out.append(f"actuators that nothing drives: {', '.join(idle)}")
    return out


def _cheaper(setup: Setup, engine: str, integrator: str, touch: bool) -> list[str]:
    out = []
    if engine == "contact" and touch:
        out.append(
            'if contacts do not matter, physics.contacts = "none" saves their detection and solution, '
            "and lets RK4 reach order 4"
        )
    if engine == "contact" and touch and integrator == "rk4":
        out.append("integrator = \"discrete\" needs one evaluation a step instead of four, at order 1")
    if engine == "contact" and setup.scene.solver.step != "auto":
        h, own = float(setup.scene.solver.step), float(setup.model.opt.timestep)
        if h < own:
            out.append(f"the model's own step, {own:g} s, would cost {own / h:.3g} times less")
    return out
