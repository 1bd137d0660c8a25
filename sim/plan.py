"""What a scene needs to be computed, worked out in one place, with reasons and with what would be cheaper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from ..models import name_of
from .checks import keys_beyond_limits
from .compose import make_law
from .engines.contact import INTEGRATORS
from .engines.interface import Drive, Problem, Role
from .engines.smooth import adaptive_methods, width_of
from .engines.smooth import methods as smooth_methods
from .engines.touch import can_touch
from .errors import SceneError, unknown
from .kinds import SLIDE
from .scene.build import Setup, resolve
from .scene.live import samples
from .scene.mistakes import Mistake, SceneMistakes, report
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

    ``period`` [s] is the controller's, None without one. ``left_out`` and ``cheaper`` are sentences;
    ``goals`` says of every goal by name whether it is baked or live.
    """

    setup: Setup
    engine: Choice
    integrator: Choice
    step: Choice
    problem: Problem
    period: float | None
    left_out: tuple[str, ...]
    cheaper: tuple[str, ...]
    goals: tuple[tuple[str, Choice], ...] = ()

    def joints(self, role: Role) -> tuple[str, ...]:
        """Names of the joints in a role."""
        m = self.problem.model
        return tuple(name_of(m, "joint", int(j)) for j in np.flatnonzero(self.problem.roles == role))

    def actuators(self, drive: Drive) -> tuple[str, ...]:
        """Names of the actuators with a drive."""
        m = self.problem.model
        return tuple(name_of(m, "actuator", int(i)) for i in np.flatnonzero(self.problem.drives == drive))


def make_plan(scene: Scene | str | Path) -> Plan:
    """Work out what a scene, or the scene in a file, needs. Raises SceneError with every mistake of it."""
    if isinstance(scene, str | Path):
        from .scene.load import read  # which needs the plan to know all mistakes

        return read(scene)[1]
    plan, mistakes = try_plan(scene)
    if plan is None:
        raise report(mistakes, scene._file, scene._lines)
    return plan


def try_plan(scene: Scene) -> tuple[Plan | None, list[Mistake]]:
    """The plan of a well-formed scene, or all its mistakes: those that need its models to be seen, and those
    of its plan."""
    setup, mistakes = resolve(scene)
    if setup is None:
        return None, mistakes + _solver(scene)
    try:
        return plan_setup(setup), []
    except SceneMistakes as e:
        return None, list(e.mistakes)


def plan_setup(setup: Setup) -> Plan:
    """Plan of a scene that is resolved already. Raises SceneError for what no engine can do."""
    scene, model = setup.scene, setup.model
    mistakes = _solver(scene) + _misfits(setup)
    if mistakes:
        raise report(mistakes, scene._file, scene._lines)
    touch = can_touch(model)
    engine = _engine(setup, touch)
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
        tolerance=scene.solver.tolerance,
        live=setup.live,
    )
    # held while error estimates and reports change the step: another width is another friction
    problem = replace(problem, friction_width=width_of(problem))
    if mistakes := _law(problem, scene):
        raise report(mistakes, scene._file, scene._lines)
    return Plan(
        setup,
        engine,
        integrator,
        step,
        problem,
        period,
        tuple(_left_out(setup, engine.what) + _other_physics(problem, engine.what)),
        tuple(_cheaper(setup, engine.what, integrator.what, touch)),
        tuple(_goals(setup, period)),
    )


def _goals(setup: Setup, period: float | None) -> list[tuple[str, Choice]]:
    """How each goal of the scene is solved."""
    out = []
    for name, how, why in setup.goals.choices:
        if how == "live":
            every = "tick by tick before the run, for nothing is left to physics"
            if setup.live is not None and period:
                every = f"every {period * samples(period):g} s"
            how = f"live, {every}; {', '.join(_most(setup))}"
        out.append((name, Choice(how, why)))
    return out


def _most(setup: Setup) -> list[str]:
    """Limits of the joints that follow live goals, turning and sliding ones."""
    m, goals, out = setup.model, setup.goals, []
    for unit, slides in (("rad", False), ("m", True)):
        mask = np.isin(m.dof_jntid, [j for j in goals.live_joints if (m.jnt_type[j] == SLIDE) == slides])
        if mask.any():
            v, a = float(goals.velocity[mask].max()), float(goals.acceleration[mask].max())
            out.append(f"joints up to {v:.3g} {unit}/s and {a:.3g} {unit}/s^2")
    return out


def _solver(scene: Scene) -> list[Mistake]:
    """Choices of the solver that no engine offers."""
    solver, mistakes = scene.solver, []
    if solver.integrator not in ("auto", *INTEGRATORS, *smooth_methods()):
        known = sorted({"auto", *INTEGRATORS, *smooth_methods()})
        message = unknown("integrator", solver.integrator, known, where="this Pantograph")
        mistakes.append(Mistake(("solver", "integrator"), message))
    elif solver.engine == "contact" and solver.integrator not in ("auto", *INTEGRATORS):
        message = unknown("integrator", solver.integrator, ("auto", *INTEGRATORS), where="the contact engine")
        mistakes.append(Mistake(("solver", "integrator"), message))
    if solver.tolerance is not None and solver.step != "auto":
        message = "give a tolerance (adaptive steps) or a step (fixed), not both"
        mistakes.append(Mistake(("solver", "tolerance"), message))
    elif solver.tolerance is not None and solver.integrator not in ("auto", *adaptive_methods()):
        adaptive = ", ".join(adaptive_methods())
        message = f"{solver.integrator!r} has fixed steps and follows no tolerance; adaptive are: {adaptive}"
        mistakes.append(Mistake(("solver", "tolerance"), message))
    if solver.step != "auto" and solver.step > scene.duration:
        message = f"a step of {solver.step:g} s is longer than the scene, {scene.duration:g} s"
        mistakes.append(Mistake(("solver", "step"), message))
    return mistakes


def _misfits(setup: Setup) -> list[Mistake]:
    """Choices of the solver and the controller that do not fit the joints or each other."""
    scene, mistakes = setup.scene, []
    engine, step, period = scene.solver.engine, scene.solver.step, _period(setup)
    free = _moved_by_physics(setup)
    if engine == "kinematic" and free:
        shown = ", ".join(free[:8]) + (", ..." if len(free) > 8 else "")
        message = f'needs keys on every joint; without keys: {shown}. Use engine = "auto"'
        message = f"the kinematic engine {message}"
        mistakes.append(Mistake(("solver", "engine"), message, needs=("keys", "roles")))
    contact_only = scene.solver.integrator in INTEGRATORS and scene.solver.integrator not in smooth_methods()
    smooth_only = scene.solver.integrator in smooth_methods() and scene.solver.integrator not in INTEGRATORS
    if free and engine != "kinematic":
        reasons = why_not_smooth(setup, can_touch(setup.model))
        if engine == "smooth" and contact_only:
            message = unknown(
                "integrator", scene.solver.integrator, smooth_methods(), where="the smooth engine"
            )
            mistakes.append(Mistake(("solver", "integrator"), message))
        elif engine == "smooth" and reasons:
            message = f"the smooth engine cannot run this scene: {'; '.join(reasons)}"
            mistakes.append(Mistake(("solver", "engine"), message, needs=("physics",)))
        elif smooth_only and reasons:
            message = (
                f"{scene.solver.integrator!r} belongs to the smooth engine, which cannot run this scene: "
            )
            mistakes.append(Mistake(("solver", "integrator"), message + "; ".join(reasons)))
        if scene.solver.tolerance is not None and (engine == "contact" or reasons):
            why = "the contact engine, which runs this scene, steps at a fixed rate"
            why += f", and not the smooth one, since {reasons[0]}" if engine != "contact" else ""
            mistakes.append(Mistake(("solver", "tolerance"), f"{why}; use 'step'"))
    if step != "auto" and period is not None and free and not _whole(period / step):
        tries = sorted({period / max(1, np.floor(period / step)), period / np.ceil(period / step)})
        message = (
            f"the controller's period {period:g} s is no whole multiple of the step {step:g} s; "
            f"try a step of {' or '.join(f'{h:.6g} s' for h in tries)}"
        )
        mistakes.append(Mistake(("controller", "period"), message))
    return mistakes


def _law(problem: Problem, scene: Scene) -> list[Mistake]:
    """What the controller's law finds wrong in its parameters."""
    if scene.controller is None:
        return []
    try:
        make_law(scene.controller.law, problem, scene.controller.parameters, scene.controller.period)
    except SceneError as e:
        return [Mistake(("controller",), str(e))]
    return []


def _moved_by_physics(setup: Setup) -> list[str]:
    return [name_of(setup.model, "joint", int(j)) for j in np.flatnonzero(setup.roles != Role.KEYED)]


def _whole(ratio: float) -> bool:
    return round(ratio) >= 1 and abs(ratio - round(ratio)) <= 1e-6


def why_not_smooth(setup: Setup, touch: bool) -> list[str]:
    """Why the smooth engine cannot run a scene; empty when it can."""
    from .dynamics.support import unsupported

    m = setup.model
    reasons = []
    if touch:
        reasons.append('bodies can touch (physics.contacts = "none" leaves that out)')
    if m.tendon_limited.any() and setup.scene.physics.limits:
        reasons.append("tendons have limits (physics.limits = false leaves them out)")
    balls = (m.jnt_type == mujoco.mjtJoint.mjJNT_BALL) & (m.jnt_limited != 0) & (setup.roles != Role.KEYED)
    if balls.any() and setup.scene.physics.limits:
        reasons.append("ball joints have limits (physics.limits = false leaves them out)")
    fastest, step = fastest_rate(setup), setup.scene.solver.step
    h = float(m.opt.timestep) if step == "auto" else step
    if fastest * h > 1.0 and setup.scene.solver.tolerance is None:
        reasons.append(
            f"servos or springs at {fastest:.3g} rad/s are stiff for an explicit method at a step of {h:g} s"
        )
    return reasons + unsupported(m, keyed=np.flatnonzero(setup.roles == Role.KEYED).tolist())


def _engine(setup: Setup, touch: bool) -> Choice:
    if setup.scene.solver.engine != "auto":
        return Choice(setup.scene.solver.engine, "the scene asks for it")
    free = _moved_by_physics(setup)
    if not free:
        return Choice("kinematic", "every joint is keyed, so no dynamics is needed")
    count = "one joint moves" if len(free) == 1 else f"{len(free)} joints move"
    reasons = why_not_smooth(setup, touch)
    integrator = setup.scene.solver.integrator
    if integrator not in ("auto", *smooth_methods()):
        reasons.insert(0, f"the smooth engine has no integrator {integrator!r}")
    if not reasons:
        return Choice("smooth", f"{count} by physics and nothing can touch: its equations are compiled")
    return Choice("contact", f"{count} by physics; not the smooth engine, since {reasons[0]}")


def _period(setup: Setup) -> float | None:
    """The controller's period when something needs a controller."""
    tracked = setup.roles == Role.TRACKED
    by_servo = {int(setup.model.actuator_trnid[i, 0]) for i in np.flatnonzero(setup.drives == Drive.KEYS)}
    needed = [j for j in np.flatnonzero(tracked) if int(j) not in by_servo]
    if not needed and not (setup.drives == Drive.CONTROLLER).any():
        return None
    return setup.scene.controller.period if setup.scene.controller else _DEFAULT_PERIOD


def _step(setup: Setup, engine: str, period: float | None) -> tuple[float, Choice]:
    duration = setup.scene.duration
    if engine == "kinematic":
        n = max(1, round(duration * setup.scene.rate))
        h = duration / n
        return h, Choice(f"{h:.6g} s", f"keys are only looked up, {setup.scene.rate:g} times a second")
    own = float(setup.model.opt.timestep)
    if setup.scene.solver.step != "auto":
        h, why = setup.scene.solver.step, "the scene asks for it"
    elif period is not None:
        h = float(period / np.ceil(period / min(own, duration) - 1e-9))
        why = "the model file says so" if _same(h, own) else f"the model's {own:g} s fitted to the period"
        n = round(period / h)
        why += f"; {n} step{'s' * (n > 1)} a controller period"
    else:
        h = float(duration / np.ceil(duration / own - 1e-6))
        why = "the model file says so" if _same(h, own) else f"the model's {own:g} s fitted to the duration"
    if not _whole(duration / h):
        why += f"; the run ends after whole steps, at {round(duration / h) * h:.6g} s"
    h = own if _same(h, own) else h
    if setup.scene.solver.tolerance is not None:
        why = "the tolerance decides; keys that bend, samples of the controller and limits end steps"
        return h, Choice("of any length", f"{why}; records lie on a grid of {h:.6g} s")
    return h, Choice(f"{h:.6g} s", why)


def _same(h1: float, h2: float) -> bool:
    return abs(h1 - h2) <= 1e-6 * h2


def _integrator(setup: Setup, engine: str, touch: bool, h: float) -> Choice:
    asked = setup.scene.solver.integrator
    if engine == "kinematic":
        return Choice("none", "nothing is integrated")
    if asked != "auto":
        return Choice(asked, "the scene asks for it")
    if setup.scene.solver.tolerance is not None:
        return Choice("dopri5", f"adaptive, to a relative tolerance of {setup.scene.solver.tolerance:g}")
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
    rates = np.maximum(np.sqrt(np.maximum(stiffness * mobility, 0.0)), damping * mobility)
    return float(np.max(rates[moving], initial=0.0))


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
    if setup.overruled:
        first = scene.models[0].name
        out.append(f"options of further models: {', '.join(setup.overruled)} are those of {first!r}")
    for name, kept in setup.floors.items():
        of, by = (float(setup.model.geom(n).friction[0]) for n in (name, kept))
        other = "" if of == by else f" (friction {by:g} instead of {of:g})"
        out.append(f"floor {name!r}: {kept!r} is the same plane and stands for it{other}")
    if engine == "kinematic":
        out.append(
            "all dynamics: nothing but keys moves; recorded frames are checked for overlaps and limits"
        )
    elif (setup.roles == Role.KEYED).any():
        out.append("what pushes keyed joints: they cannot yield; the force their drive needs is recorded")
    unmoved = [n for n in setup.clip.tracks if setup.roles[setup.model.joint(n).id] == Role.PASSIVE]
    if unmoved:
        out.append(f"keys of passive joints, but for where these start: {', '.join(unmoved)}")
    beyond = keys_beyond_limits(setup)
    if beyond:
        out.append(f"keys that joint limits do not let through: {'; '.join(beyond)}")
    idle = [name_of(setup.model, "actuator", int(i)) for i in np.flatnonzero(setup.drives == Drive.OFF)]
    if scene.controller is not None and _period(setup) is None:
        out.append("the controller: no joint is tracked by it and no actuator driven by it")
    if idle:
        out.append(f"actuators that nothing drives: {', '.join(idle)}")
    return out


def _other_physics(problem: Problem, engine: str) -> list[str]:
    """Where the engine's physics, not its accuracy, differs from MuJoCo's."""
    if engine != "smooth":
        return []
    from .engines.smooth import differences

    return differences(problem)


def _cheaper(setup: Setup, engine: str, integrator: str, touch: bool) -> list[str]:
    out = []
    if engine == "contact" and touch:
        others = why_not_smooth(setup, touch=False)
        gain = f"but keeps the contact engine: {others[0]}" if others else "and lets the smooth engine run"
        out.append(f'physics.contacts = "none", if contacts do not matter, saves their solution {gain}')
    if engine == "contact" and touch and integrator == "rk4":
        out.append('integrator = "discrete" needs one evaluation a step instead of four, at order 1')
    if engine == "contact" and setup.scene.solver.step != "auto":
        h, own = float(setup.scene.solver.step), float(setup.model.opt.timestep)
        if h < own:
            out.append(f"the model's own step, {own:g} s, would cost {own / h:.3g} times less")
    return out
