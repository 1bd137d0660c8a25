"""What a scene needs to be computed, worked out in one place, with reasons and with what would be cheaper."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import mujoco
import numpy as np

from ..models import name_of
from .compose import make_law
from .engines.contact import INTEGRATORS
from .engines.interface import Drive, Problem, Role
from .engines.smooth import adaptive_methods, width_of
from .engines.smooth import methods as smooth_methods
from .errors import SceneError, unknown
from .explain import cautions, cheaper, left_out, other_physics, solved
from .needs import Needs
from .scene.angles import law_words
from .scene.build import Setup, resolve
from .scene.mistakes import Mistake, SceneMistakes, report
from .scene.schema import Scene


@dataclass(frozen=True)
class Choice:
    """One decision: what, and why."""

    what: str
    why: str


@dataclass(frozen=True)
class Plan:
    """How a scene is computed.

    ``period`` [s] is the controller's, None without one. ``left_out`` and ``cheaper`` are sentences, and so
    are ``notes``, on what the controller does otherwise than one may think;
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
    notes: tuple[str, ...] = ()

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
    scene = setup.scene
    needs = Needs(setup)
    mistakes = _solver(scene) + _misfits(needs)
    if mistakes:
        raise report(mistakes, scene._file, scene._lines)
    engine = _engine(needs)
    h, step = _step(setup, engine.what, needs.period)
    if engine.what == "contact" and (mistakes := _activations(setup, h)):
        raise report(mistakes, scene._file, scene._lines)
    integrator = _integrator(needs, engine.what, h)
    problem = Problem(
        model=setup.model,
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
        restitution=scene.physics.restitution,
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
        needs.period,
        tuple(left_out(needs, engine.what) + other_physics(problem, engine.what)),
        tuple(cheaper(needs, engine.what, integrator.what)),
        tuple((name, Choice(how, why)) for name, how, why in solved(setup, needs.period)),
        tuple(_notes(setup)) if needs.period is not None else (),
    )


def _notes(setup: Setup) -> list[str]:
    """What a person should know of the controller before they trust the run."""
    item = setup.scene.controller
    return cautions(setup, item.law if item else "pd", law_words(setup.scene, setup.model))


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


def _misfits(needs: Needs) -> list[Mistake]:
    """Choices of the solver and the controller that do not fit the joints or each other."""
    scene, free, mistakes = needs.setup.scene, needs.moved, []
    engine, step, period = scene.solver.engine, scene.solver.step, needs.period
    if engine == "kinematic" and free:
        shown = ", ".join(free[:8]) + (", ..." if len(free) > 8 else "")
        message = (
            f'the kinematic engine needs keys on every joint; without keys: {shown}. Use engine = "auto"'
        )
        mistakes.append(Mistake(("solver", "engine"), message, needs=("keys", "roles")))
    elif free:
        mistakes += _engines(scene, needs.why_not_smooth())
    if step != "auto" and period is not None and free and not _whole(period / step):
        tries = sorted({period / max(1, np.floor(period / step)), period / np.ceil(period / step)})
        message = (
            f"the controller's period {period:g} s is no whole multiple of the step {step:g} s; "
            f"try a step of {' or '.join(f'{h:.6g} s' for h in tries)}"
        )
        mistakes.append(Mistake(("controller", "period"), message))
    return mistakes


def _engines(scene: Scene, reasons: list[str]) -> list[Mistake]:
    """Choices that only one of the engines for physics knows; `reasons` speak against the smooth one."""
    solver, mistakes = scene.solver, []
    both = set(INTEGRATORS) & set(smooth_methods())
    smooth_only, contact_only = (
        solver.integrator in methods and solver.integrator not in both
        for methods in (smooth_methods(), INTEGRATORS)
    )
    no_smooth = f"the smooth engine, which cannot run this scene: {'; '.join(reasons)}"
    if solver.engine == "smooth" and contact_only:
        message = unknown("integrator", solver.integrator, smooth_methods(), where="the smooth engine")
        mistakes.append(Mistake(("solver", "integrator"), message))
    elif solver.engine == "smooth" and reasons:
        message = f"the smooth engine cannot run this scene: {'; '.join(reasons)}"
        mistakes.append(Mistake(("solver", "engine"), message, needs=("physics",)))
    elif smooth_only and reasons:
        message = f"{solver.integrator!r} belongs to {no_smooth}"
        mistakes.append(Mistake(("solver", "integrator"), message))
    by_contact = solver.engine == "contact" or contact_only
    if solver.tolerance is not None and (solver.engine == "contact" or reasons):
        why = "the contact engine, which runs this scene, steps at a fixed rate"
        why += "" if solver.engine == "contact" else f", and not the smooth one, since {reasons[0]}"
        mistakes.append(Mistake(("solver", "tolerance"), f"{why}; use 'step'"))
    if scene.physics.restitution and (by_contact or reasons) and scene.physics.limits:
        message = f"rebounds belong to {no_smooth}"
        if by_contact:
            message = "the contact engine, which the solver asks for, has soft limits as the model file says"
        mistakes.append(Mistake(("physics", "restitution"), f"{message}; leave it out", needs=("solver",)))
    return mistakes


def _activations(setup: Setup, h: float) -> list[Mistake]:
    """Activations too quick for MuJoCo, which filters them by Euler's method whatever the integrator."""
    m = setup.model
    filters = (m.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_FILTER)) & (setup.drives != Drive.OFF)
    constant = m.actuator_dynprm[:, 0]
    return [
        Mistake(
            ("solver", "step"),
            f"the activation of actuator {name_of(m, 'actuator', int(i))!r} has a time constant of "
            f"{constant[i]:g} s: the contact engine, which runs this scene, needs steps below "
            f"{2 * constant[i]:g} s for it, not {h:g} s (or dyntype = 'filterexact' in the model)",
        )
        for i in np.flatnonzero(filters & (2.0 * constant <= h))
    ]


def _law(problem: Problem, scene: Scene) -> list[Mistake]:
    """What the controller's law finds wrong in its parameters."""
    if scene.controller is None:
        return []
    try:
        words = law_words(scene, problem.model)
        make_law(scene.controller.law, problem, words, scene.controller.period)
    except SceneError as e:
        return [Mistake(("controller",), str(e))]
    return []


def _whole(ratio: float) -> bool:
    return round(ratio) >= 1 and abs(ratio - round(ratio)) <= 1e-6


def _engine(needs: Needs) -> Choice:
    solver, free = needs.setup.scene.solver, needs.moved
    if solver.engine != "auto":
        return Choice(solver.engine, "the scene asks for it")
    if not free:
        return Choice("kinematic", "every joint is keyed, so no dynamics is needed")
    count = "one joint moves" if len(free) == 1 else f"{len(free)} joints move"
    reasons = needs.why_not_smooth()
    if solver.integrator not in ("auto", *smooth_methods()):
        reasons.insert(0, f"the smooth engine has no integrator {solver.integrator!r}")
    if not reasons:
        return Choice("smooth", f"{count} by physics and nothing can touch: its equations are compiled")
    return Choice("contact", f"{count} by physics; not the smooth engine, since {reasons[0]}")


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


def _integrator(needs: Needs, engine: str, h: float) -> Choice:
    solver = needs.setup.scene.solver
    if engine == "kinematic":
        return Choice("none", "nothing is integrated")
    if solver.integrator != "auto":
        return Choice(solver.integrator, "the scene asks for it")
    if solver.tolerance is not None:
        return Choice("dopri5", f"adaptive, to a relative tolerance of {solver.tolerance:g}")
    if needs.is_stiff(h):
        return Choice("discrete", f"{needs.stiff} are stiff for a step of {h:g} s")
    if needs.touch:
        return Choice("rk4", "nothing is stiff; order 4 between contacts, 1 where they begin and end")
    return Choice("rk4", "the motion is smooth: order 4")
