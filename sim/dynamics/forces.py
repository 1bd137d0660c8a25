"""Forces beside inertia and gravity: actuators, springs, dampers, dry friction, tendons linear in the joints.

All follow MuJoCo's definitions (its documentation, chapter Computation, sections Actuation and Passive
forces); dry friction, a constraint there, is a force here: -f v / sqrt(v^2 + w^2) with a stated width w.
"""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from ..compile.graph import Scalar, absolute, clip, maximum, minimum, nearest, sqrt
from .fields import Fields
from .rigid import spatial
from .rigid.tree import BALL, FREE, HINGE, SLIDE

_DISABLE = mujoco.mjtDisableBit
_DYN, _GAIN, _BIAS, _TRN = mujoco.mjtDyn, mujoco.mjtGain, mujoco.mjtBias, mujoco.mjtTrn


def disabled(model: mujoco.MjModel, flag: str) -> bool:
    """Whether the model switches `flag` (as in mjDSBL_flag) off."""
    return bool(model.opt.disableflags & getattr(_DISABLE, f"mjDSBL_{flag}"))


def damper(coefficients: Sequence[Scalar], rate: Scalar) -> Scalar:
    """rate (c0 + c1 |rate| + c2 rate^2 + ...): MuJoCo's dampers of higher order are odd."""
    total: Scalar = 0.0
    power: Scalar = rate
    for c in coefficients:
        total = total + c * power
        power = power * absolute(rate)
    return total


def spring(coefficients: Sequence[Scalar], stretch: Scalar) -> Scalar:
    """stretch (c0 + c1 stretch + c2 stretch^2 + ...): MuJoCo's springs of higher order need not be odd."""
    total: Scalar = 0.0
    power: Scalar = stretch
    for c in coefficients:
        total = total + c * power
        power = power * stretch
    return total


def passive_forces(
    fields: Fields, q: Sequence[Scalar], v: Sequence[Scalar], friction_width: float | None
) -> list[Scalar]:
    """Generalized forces of springs, dampers and dry friction, in the model's order of freedoms."""
    model = fields.model
    out: list[Scalar] = [0.0] * model.nv
    for joint in range(model.njnt):
        if model.jnt_type[joint] in (HINGE, SLIDE) and not disabled(model, "SPRING"):
            qadr, dof = int(model.jnt_qposadr[joint]), int(model.jnt_dofadr[joint])
            stretch = q[qadr] - fields.scalar("qpos_spring", qadr)
            out[dof] = out[dof] - spring(fields.polynomial("jnt_stiffness", joint), stretch)
        elif not disabled(model, "SPRING"):
            _spring_of_rotation(fields, joint, q, out)
    for dof in range(model.nv):
        if not disabled(model, "DAMPER"):
            out[dof] = out[dof] - damper(fields.polynomial("dof_damping", dof), v[dof])
            for share, coefficients in _dampers_of_actuators(fields, int(model.dof_jntid[dof])):
                out[dof] = out[dof] - share * damper(coefficients, v[dof])
        friction = fields.scalar("dof_frictionloss", dof)
        if friction_width is not None and (hasattr(friction, "op") or friction != 0.0):
            speed = sqrt(v[dof] * v[dof] + friction_width**2)
            out[dof] = out[dof] - friction * v[dof] / speed
    for tendon in range(model.ntendon):
        _tendon_forces(fields, tendon, q, v, out)
    return out


def _dampers_of_actuators(fields: Fields, joint: int) -> list[tuple[Scalar, list[Scalar]]]:
    """Dampers given at the actuators of a joint: gear^2, and coefficients for the joint's own speed."""
    out = []
    for actuator in fields.actuators_on(joint):
        coefficients = fields.polynomial("actuator_damping", actuator)
        if coefficients:
            out.append((fields.squared_gear(actuator), coefficients))
    return out


def _stretches(fields: Fields, joint: int, q: Sequence[Scalar]) -> list[Scalar]:
    """How far a ball or free joint is from its spring's rest: p - p_rest (free), then log(q_rest^-1 q)."""
    model = fields.model
    at, out = int(model.jnt_qposadr[joint]), []
    if model.jnt_type[joint] == FREE:
        out = [q[at + k] - fields.scalar("qpos_spring", at + k) for k in range(3)]
        at += 3
    rest = [float(x) for x in model.qpos_spring[at : at + 4]]
    conjugate = [rest[0], -rest[1], -rest[2], -rest[3]]
    return out + spatial.rotation_vector(spatial.quaternion_product(conjugate, q[at : at + 4]))


def _stiff(stiffness: Scalar) -> bool:
    return hasattr(stiffness, "op") or stiffness != 0.0


def _spring_of_rotation(fields: Fields, joint: int, q: Sequence[Scalar], out: list[Scalar]) -> None:
    stiffness, dof = fields.scalar("jnt_stiffness", joint), int(fields.model.jnt_dofadr[joint])
    if _stiff(stiffness):
        for k, stretch in enumerate(_stretches(fields, joint, q)):
            out[dof + k] = out[dof + k] - stiffness * stretch


def rotation_spring_energy(fields: Fields, joint: int, q: Sequence[Scalar]) -> Scalar:
    """Energy of the spring of a ball or free joint."""
    stiffness = fields.scalar("jnt_stiffness", joint)
    if not _stiff(stiffness):
        return 0.0
    stretch = _stretches(fields, joint, q)
    return 0.5 * stiffness * spatial.dot(stretch, stretch)


def tendon_coefficients(model: mujoco.MjModel, tendon: int) -> dict[int, float]:
    """Joint -> coefficient of a tendon that is linear in the joints."""
    first = model.tendon_adr[tendon]
    rows = range(first, first + model.tendon_num[tendon])
    return {int(model.wrap_objid[k]): float(model.wrap_prm[k]) for k in rows}


def tendon_length(model: mujoco.MjModel, tendon: int, q: Sequence[Scalar]) -> Scalar:
    """Length of a tendon that is linear in the joints."""
    terms = tendon_coefficients(model, tendon).items()
    return sum((c * q[int(model.jnt_qposadr[j])] for j, c in terms), 0.0)


def tendon_velocity(model: mujoco.MjModel, tendon: int, v: Sequence[Scalar]) -> Scalar:
    """Rate of `tendon_length`."""
    terms = tendon_coefficients(model, tendon).items()
    return sum((c * v[int(model.jnt_dofadr[j])] for j, c in terms), 0.0)


def tendon_stretch(fields: Fields, tendon: int, q: Sequence[Scalar]) -> Scalar:
    """Length beyond the tendon's slack interval, signed."""
    low, high = (float(x) for x in fields.model.tendon_lengthspring[tendon])
    length = tendon_length(fields.model, tendon, q)
    if low == high:
        return length - low
    return maximum(length - high, 0.0) + minimum(length - low, 0.0)


def _tendon_forces(
    fields: Fields, tendon: int, q: Sequence[Scalar], v: Sequence[Scalar], out: list[Scalar]
) -> None:
    model = fields.model
    force: Scalar = 0.0
    stiffness, damping = (
        fields.polynomial("tendon_stiffness", tendon),
        fields.polynomial("tendon_damping", tendon),
    )
    if stiffness and not disabled(model, "SPRING"):
        force = force - spring(stiffness, tendon_stretch(fields, tendon, q))
    if not disabled(model, "DAMPER"):
        speed = tendon_velocity(model, tendon, v)
        force = force - damper(damping, speed)
        pulling = np.flatnonzero(
            (model.actuator_trntype == int(_TRN.mjTRN_TENDON)) & (model.actuator_trnid[:, 0] == tendon)
        )
        for actuator in pulling.tolist():
            coefficients = fields.polynomial("actuator_damping", actuator)
            force = force - fields.squared_gear(actuator) * damper(coefficients, speed)
    for joint, coefficient in tendon_coefficients(model, tendon).items():
        dof = int(model.jnt_dofadr[joint])
        out[dof] = out[dof] + coefficient * force


def _transmission(
    fields: Fields, actuator: int, q: Sequence[Scalar], v: Sequence[Scalar]
) -> tuple[Scalar, Scalar, dict[int, Scalar]]:
    """Length, velocity and moment (by freedom) of an actuator."""
    model = fields.model
    target = int(model.actuator_trnid[actuator, 0])
    out = int(model.actuator_outadr[actuator])
    if model.actuator_trntype[actuator] == int(_TRN.mjTRN_TENDON):
        gear = fields.scalar("actuator_gear", out)
        moment = {int(model.jnt_dofadr[j]): gear * c for j, c in tendon_coefficients(model, target).items()}
        return gear * tendon_length(model, target, q), gear * tendon_velocity(model, target, v), moment
    dof, kind = int(model.jnt_dofadr[target]), int(model.jnt_type[target])
    if kind in (HINGE, SLIDE):
        gear = fields.scalar("actuator_gear", out)
        return gear * q[int(model.jnt_qposadr[target])], gear * v[dof], {dof: gear}
    size = {FREE: 6, BALL: 3}[kind]
    gears = fields.vector("actuator_gear", out, size)
    velocity: Scalar = sum((g * v[dof + k] for k, g in enumerate(gears)), 0.0)
    length: Scalar = 0.0
    if kind == BALL:
        at = int(model.jnt_qposadr[target])
        length = spatial.dot(gears, spatial.rotation_vector(q[at : at + 4]))
    return length, velocity, {dof + k: g for k, g in enumerate(gears)}


def active(model: mujoco.MjModel, actuator: int) -> bool:
    """Whether an actuator acts: neither actuation nor its group is switched off."""
    group = int(model.actuator_group[actuator])
    off = 0 <= group < 31 and bool(model.opt.disableactuator & (1 << group))
    return not off and not disabled(model, "ACTUATION")


def _affine(fields: Fields, name: str, actuator: int, length: Scalar, velocity: Scalar) -> Scalar:
    c = fields.vector(name, actuator)
    return c[0] + c[1] * length + c[2] * velocity


def actuator_forces(
    fields: Fields, q: Sequence[Scalar], v: Sequence[Scalar], act: Sequence[Scalar], ctrl: Sequence[Scalar]
) -> tuple[list[Scalar], list[Scalar]]:
    """Generalized forces of all actuators, and the rates of their activations."""
    model = fields.model
    out: list[Scalar] = [0.0] * model.nv
    rates: list[Scalar] = [0.0] * model.na
    for actuator in range(model.nactuator):
        if not active(model, actuator):
            continue
        signal, rate = _signal(fields, actuator, act, ctrl)
        if rate is not None:
            rates[int(model.actuator_actadr[actuator])] = rate
        length, velocity, moment = _transmission(fields, actuator, q, v)
        gain = fields.scalar("actuator_gainprm", actuator)
        if model.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_AFFINE):
            gain = _affine(fields, "actuator_gainprm", actuator, length, velocity)
        force = gain * signal
        if model.actuator_biastype[actuator] == int(_BIAS.mjBIAS_AFFINE):
            force = force + _affine(fields, "actuator_biasprm", actuator, length, velocity)
            force = force - gain * _whole_turns(model, actuator, signal - length)
        if model.actuator_forcelimited[actuator]:
            force = clip(force, *(float(x) for x in model.actuator_forcerange[actuator]))
        for dof, arm in moment.items():
            out[dof] = out[dof] + arm * force
    for joint in np.flatnonzero(model.jnt_actfrclimited):
        if model.jnt_type[joint] in (HINGE, SLIDE):
            dof = int(model.jnt_dofadr[joint])
            out[dof] = clip(out[dof], *(float(x) for x in model.jnt_actfrcrange[joint]))
    return out, rates


def _whole_turns(model: mujoco.MjModel, actuator: int, error: Scalar) -> Scalar:
    """What a position servo on a ball joint takes off its error so that it turns the shorter way."""
    gain, bias = float(model.actuator_gainprm[actuator, 0]), float(model.actuator_biasprm[actuator, 1])
    on_ball = model.actuator_trntype[actuator] == int(_TRN.mjTRN_JOINT)
    on_ball = on_ball and model.jnt_type[model.actuator_trnid[actuator, 0]] == BALL
    servo = model.actuator_gaintype[actuator] == int(_GAIN.mjGAIN_FIXED) and gain == -bias
    if not (on_ball and servo and gain):
        return 0.0
    turn = 2.0 * np.pi * float(np.linalg.norm(model.actuator_gear[model.actuator_outadr[actuator], :3]))
    return turn * nearest(error / turn) if turn else 0.0


def _signal(
    fields: Fields, actuator: int, act: Sequence[Scalar], ctrl: Sequence[Scalar]
) -> tuple[Scalar, Scalar | None]:
    """What an actuator's gain multiplies, and the rate of its activation if it has one."""
    model = fields.model
    at = int(model.actuator_ctrladr[actuator])
    value = ctrl[at]
    if model.actuator_ctrllimited[at] and not disabled(model, "CLAMPCTRL"):
        value = clip(value, *(float(x) for x in model.actuator_ctrlrange[at]))
    dynamics = model.actuator_dyntype[actuator]
    if dynamics == int(_DYN.mjDYN_NONE):
        return value, None
    state = act[int(model.actuator_actadr[actuator])]
    if dynamics == int(_DYN.mjDYN_INTEGRATOR):
        return state, value
    time_constant = max(float(model.actuator_dynprm[actuator, 0]), float(mujoco.mjMINVAL))
    return state, (value - state) * (1.0 / time_constant)
