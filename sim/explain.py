"""What a plan tells a person: what is left out, what differs from MuJoCo, what would be cheaper."""

from __future__ import annotations

import numpy as np

from ..models import name_of
from .checks import keys_beyond_limits
from .engines.interface import Drive, Problem, Role
from .kinds import SLIDE
from .needs import Needs
from .scene.build import Setup
from .scene.live import samples


def left_out(needs: Needs, engine: str) -> list[str]:
    """What of the models and the scene takes no part."""
    setup = needs.setup
    scene, out = setup.scene, _switched_off(setup)
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
    if beyond := keys_beyond_limits(setup):
        out.append(f"keys that joint limits do not let through: {'; '.join(beyond)}")
    if scene.controller is not None and needs.period is None:
        out.append("the controller: no joint is tracked by it and no actuator driven by it")
    idle = [name_of(setup.model, "actuator", int(i)) for i in np.flatnonzero(setup.drives == Drive.OFF)]
    if idle:
        out.append(f"actuators that nothing drives: {', '.join(idle)}")
    return out


def _switched_off(setup: Setup) -> list[str]:
    """Physics that the scene leaves out."""
    physics, out = setup.scene.physics, []
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
    return out


def other_physics(problem: Problem, engine: str) -> list[str]:
    """Where the engine's physics, not its accuracy, differs from MuJoCo's."""
    if engine != "smooth":
        return []
    from .engines.limits import limits_of
    from .engines.smooth import differences

    out = [f"otherwise than MuJoCo: {line}" for line in differences(problem)]
    for limit in limits_of(problem).each:
        beyond = -limit.gap(problem.state0.q)
        if beyond > 1e-9:
            name = name_of(problem.model, "joint", limit.joint)
            unit = "m" if problem.model.jnt_type[limit.joint] == SLIDE else "rad"
            out.append(f"joint {name!r} starts {beyond:.3g} {unit} beyond its limit: it is put on it at once")
    return out


def cheaper(needs: Needs, engine: str, integrator: str) -> list[str]:
    """What would make the run cost less."""
    setup, out = needs.setup, []
    if engine == "contact" and needs.touch:
        others = needs.why_not_smooth(touch=False)
        gain = f"but keeps the contact engine: {others[0]}" if others else "and lets the smooth engine run"
        out.append(f'physics.contacts = "none", if contacts do not matter, saves their solution {gain}')
        if integrator == "rk4":
            out.append('integrator = "discrete" needs one evaluation a step instead of four, at order 1')
    if engine == "contact" and setup.scene.solver.step != "auto":
        h, own = float(setup.scene.solver.step), float(setup.model.opt.timestep)
        if h < own:
            out.append(f"the model's own step, {own:g} s, would cost {own / h:.3g} times less")
    return out


def solved(setup: Setup, period: float | None) -> list[tuple[str, str, str]]:
    """How each goal of the scene is solved: its name, how, why."""
    out = []
    for name, how, why in setup.goals.choices:
        if how == "live":
            every = "tick by tick before the run, for nothing is left to physics"
            if setup.live is not None and period:
                every = f"every {period * samples(period):g} s"
            how = f"live, {every}; {', '.join(_most(setup))}"
        out.append((name, how, why))
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
