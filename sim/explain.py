"""What a plan tells a person: what is left out, what differs from MuJoCo, what would be cheaper."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from ..models import dof_names, name_of
from .checks import keys_beyond_limits
from .control import ON_JOINT, keyed_by_servo, why_not_controllable
from .engines.interface import Array, Drive, Problem, Role
from .kinds import FREE, SCALAR, SLIDE
from .needs import Needs
from .scene.build import Setup
from .scene.live import samples

_ABOUT_TARGETS = ("lqr", "mpc", "nmpc")  # laws that linearise about where joints belong
_BALANCED = 1e-4  # of the machine's whole weight at its whole length: less is rounding of a goal


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


def cautions(setup: Setup, law: str, words: Mapping[str, Any]) -> list[str]:
    """What a person should know of a law, told ``words`` in SI, before they trust what it does."""
    return ideal_drives(setup) + unheld(setup, law, words)


def ideal_drives(setup: Setup) -> list[str]:
    """Tracked joints that get ideal forces, without any limit, although actuators act on them: which, why,
    and what would give them their limits."""
    m, by_servo = setup.model, keyed_by_servo(setup.model, setup.drives)
    acts = _moments(m, setup.state0.q) != 0.0
    found: dict[str, tuple[list[str], list[str]]] = {}
    for joint in np.flatnonzero(setup.roles == Role.TRACKED):
        on = np.flatnonzero(acts[:, m.dof_jntid == joint].any(axis=1))
        if (setup.drives[on] == Drive.CONTROLLER).any() or joint in by_servo:
            continue
        for i in on:
            joints, actuators = found.setdefault(_why_not_driven(setup, int(i)), ([], []))
            joints.append(name_of(m, "joint", int(joint)))
            actuators.append(name_of(m, "actuator", int(i)))
    out = []
    for why, (joints, actuators) in found.items():
        tracked, beside = _listed("tracked joint", joints), _listed("actuator", actuators)
        out.append(f"ideal forces without limit on {tracked}, instead of {beside}: {why}")
    return out


def _why_not_driven(setup: Setup, i: int) -> str:
    """Why the controller does not drive an actuator of tracked joints, and the way out."""
    m, why = setup.model, why_not_controllable(setup.model, i)
    by = (
        "keys drive it"
        if setup.drives[i] == Drive.KEYS
        else "no controller drives it"
        if why
        else "it is off"
    )
    if not why:
        return f"{by}; 'controller' in [actuators] uses it"
    if int(m.actuator_trntype[i]) not in ON_JOINT:
        out = "motors on the joints have limits; or make the joints passive and key the actuator"
    elif int(m.jnt_type[m.actuator_trnid[i, 0]]) not in SCALAR:
        out = "hinges with a motor each have limits"
    else:
        out = "a plain motor in the model has limits; or make the joint passive and key the actuator"
    return f"{by}, since {why}; {out}"


def unheld(setup: Setup, law: str, words: Mapping[str, Any]) -> list[str]:
    """Joints that a law, told ``words`` in SI, keeps where no force holds them: it regulates about no
    equilibrium. Where the keys end counts, and how contacts and closed loops might help does not."""
    m = setup.model
    if law not in _ABOUT_TARGETS or m.neq or not (setup.roles == Role.TRACKED).any():
        return []
    goal, q = words.get("goal") or {}, setup.clip.evaluate(setup.clip.end).q
    for name, value in goal.items():
        q[m.jnt_qposadr[m.joint(name).id]] = value
    driven = (_moments(m, q)[setup.drives != Drive.OFF] != 0.0).any(axis=0)
    loose = (setup.roles[m.dof_jntid] == Role.PASSIVE) & ~driven
    need, arm = _held_by(m, q), np.where(m.jnt_type == SLIDE, 1.0, float(m.stat.extent))[m.dof_jntid]
    whole = float(m.body_mass.sum() * np.linalg.norm(m.opt.gravity)) * arm
    out, names = [], dof_names(m)
    for dof in np.flatnonzero(loose & (np.abs(need) > m.dof_frictionloss + _BALANCED * whole)):
        joint = int(m.dof_jntid[dof])
        slides = m.jnt_type[joint] == SLIDE or (m.jnt_type[joint] == FREE and dof < m.jnt_dofadr[joint] + 3)
        force = f"{abs(need[dof]):.3g} {'N' if slides else 'N m'}"
        place = _place(setup, joint, q, names[dof] in goal)
        out.append(
            f"law {law!r} regulates about {names[dof]!r}{place}, where it needs {force} but nothing drives "
            "it: it cannot rest there, and other joints leave their keys; 'goal' can name an equilibrium"
        )
    return out


def _place(setup: Setup, joint: int, q: Array, asked: bool) -> str:
    """Where a hinge or slide is at q, in the scene's units."""
    m = setup.model
    if int(m.jnt_type[joint]) not in SCALAR:
        return ""
    value = float(q[m.jnt_qposadr[joint]])
    if m.jnt_type[joint] == SLIDE:
        at = f" at {value:.4g} m"
    else:
        at = f" at {np.rad2deg(value):.4g} deg" if setup.scene.angle == "degree" else f" at {value:.4g} rad"
    return at if asked else f"{at}, as it starts"


def _held_by(model: mujoco.MjModel, q: Array) -> Array:
    """Joint forces (nv,) that keep still what is at ``q``, without contacts and limits."""
    data = mujoco.MjData(model)
    data.qpos[:] = q
    mujoco.mj_fwdPosition(model, data)
    mujoco.mj_fwdVelocity(model, data)
    return np.asarray(data.qfrc_bias - data.qfrc_passive)


def _moments(model: mujoco.MjModel, q: Array) -> Array:
    """What each actuator's force does to each freedom (nu, nv), the most of at ``q`` and a little beside it,
    where a tendon at its dead centre has a lever too."""
    data, out, beside = mujoco.MjData(model), np.zeros((model.nu, model.nv)), np.array(q, dtype=float)
    if not model.nu:
        return out
    mujoco.mj_integratePos(model, beside, 0.05 * np.cos(np.arange(model.nv)), 1.0)
    for at in (q, beside):
        data.qpos[:] = at
        mujoco.mj_fwdPosition(model, data)
        now = np.zeros((model.nu, model.nv))
        sparse = (data.actuator_moment, data.moment_rownnz, data.moment_rowadr, data.moment_colind)
        mujoco.mju_sparse2dense(now, *sparse)
        out = np.maximum(out, np.abs(now))
    return out


def _listed(what: str, names: Sequence[str], most: int = 8) -> str:
    names = list(dict.fromkeys(names))
    more = [f"and {len(names) - most} more"] if len(names) > most else []
    return f"{what}{'s' * (len(names) > 1)} {', '.join([*map(repr, names[:most]), *more])}"


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
