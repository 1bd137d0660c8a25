"""What the smooth engine cannot do, named; and where its physics differs from MuJoCo's on purpose."""

from __future__ import annotations

from collections.abc import Collection

import mujoco
import numpy as np

from .forces import active, disabled
from .rigid.tree import BALL, FREE, HINGE, SLIDE

_OBJ = mujoco.mjtObj
_DYN, _GAIN, _BIAS, _TRN, _WRAP = (
    mujoco.mjtDyn,
    mujoco.mjtGain,
    mujoco.mjtBias,
    mujoco.mjtTrn,
    mujoco.mjtWrap,
)


def _name(model: mujoco.MjModel, kind: mujoco.mjtObj, index: int) -> str:
    word = kind.name.removeprefix("mjOBJ_").lower()
    name = mujoco.mj_id2name(model, kind, index)
    return f"{word} {name!r}" if name else f"{word} {index}"


def unsupported(model: mujoco.MjModel, *, keyed: Collection[int] = ()) -> list[str]:
    """Everything in `model` that the smooth engine cannot do, one line each; empty when it can do all.

    `keyed` are the joints (by id) whose motion is prescribed. Contacts are not judged here.
    """
    found = []
    if not disabled(model, "EQUALITY") and not disabled(model, "CONSTRAINT"):
        active0 = np.flatnonzero(model.eq_active0)
        found += [f"{_name(model, _OBJ.mjOBJ_EQUALITY, int(i))}: closed loops and couplings" for i in active0]
    if model.nflex:
        found.append(f"{model.nflex} deformable (flex) bodies")
    if model.nplugin:
        found.append(f"{model.nplugin} plugins")
    if model.nplastic:
        found.append("springs that yield (springyield)")
    if model.nmocap:
        found.append("mocap bodies: key their joints instead")
    found += _fluid(model)
    for joint in range(model.njnt):
        found += [f"{_name(model, _OBJ.mjOBJ_JOINT, joint)}: {why}" for why in _joint(model, joint, keyed)]
    for tendon in range(model.ntendon):
        found += [f"{_name(model, _OBJ.mjOBJ_TENDON, tendon)}: {why}" for why in _tendon(model, tendon)]
    for actuator in range(model.nactuator):
        if active(model, actuator):
            label = _name(model, _OBJ.mjOBJ_ACTUATOR, actuator)
            found += [f"{label}: {why}" for why in _actuator(model, actuator)]
    return found


def _fluid(model: mujoco.MjModel) -> list[str]:
    if model.opt.viscosity == 0.0 and model.opt.density == 0.0:
        return []
    ellipsoid = np.flatnonzero(model.geom_fluid[:, 0] > 0)
    return [f"{_name(model, _OBJ.mjOBJ_GEOM, int(g))}: the ellipsoid fluid model" for g in ellipsoid]


def _joint(model: mujoco.MjModel, joint: int, keyed: Collection[int]) -> list[str]:
    kind, dof = model.jnt_type[joint], int(model.jnt_dofadr[joint])
    found = []
    if kind in (FREE, BALL) and joint not in keyed:
        if model.jnt_stiffnesspoly[joint].any():
            found.append("a nonlinear spring on a ball or free joint")
        if kind == FREE and np.ptp(model.dof_armature[dof : dof + 3]) != 0.0:
            found.append("armature that differs between the axes of a free joint")
    if model.jnt_actgravcomp[joint] and model.jnt_actfrclimited[joint]:
        found.append("gravity compensation within actuator force limits (actuatorgravcomp)")
    return found


def _tendon(model: mujoco.MjModel, tendon: int) -> list[str]:
    first = model.tendon_adr[tendon]
    found = []
    if (model.wrap_type[first : first + model.tendon_num[tendon]] != int(_WRAP.mjWRAP_JOINT)).any():
        found.append("a path through sites or around geoms (only tendons linear in joints are supported)")
    if model.tendon_armature[tendon]:
        found.append("tendon armature")
    if model.tendon_actfrclimited[tendon]:
        found.append("a limit on the total actuator force of a tendon")
    if model.tendon_frictionloss[tendon] and not disabled(model, "FRICTIONLOSS"):
        found.append("dry friction of a tendon")
    on = (model.actuator_trntype == int(_TRN.mjTRN_TENDON)) & (model.actuator_trnid[:, 0] == tendon)
    if model.actuator_armature[on].any():
        found.append("armature given at its actuator")
    return found


def _actuator(model: mujoco.MjModel, actuator: int) -> list[str]:
    found = []
    transmission = model.actuator_trntype[actuator]
    if transmission not in (int(_TRN.mjTRN_JOINT), int(_TRN.mjTRN_TENDON)):
        found.append(f"transmission {_TRN(int(transmission)).name.removeprefix('mjTRN_').lower()}")
    dynamics = model.actuator_dyntype[actuator]
    if dynamics not in (
        int(_DYN.mjDYN_NONE),
        int(_DYN.mjDYN_INTEGRATOR),
        int(_DYN.mjDYN_FILTER),
        int(_DYN.mjDYN_FILTEREXACT),
    ):
        found.append(f"activation dynamics {_DYN(int(dynamics)).name.removeprefix('mjDYN_').lower()}")
    elif dynamics != int(_DYN.mjDYN_NONE) and (
        model.actuator_actlimited[actuator] or model.actuator_actearly[actuator]
    ):
        found.append("limited (actlimited) or early (actearly) activation")
    if model.actuator_gaintype[actuator] not in (int(_GAIN.mjGAIN_FIXED), int(_GAIN.mjGAIN_AFFINE)):
        found.append(
            f"gain {_GAIN(int(model.actuator_gaintype[actuator])).name.removeprefix('mjGAIN_').lower()}"
        )
    if model.actuator_biastype[actuator] not in (int(_BIAS.mjBIAS_NONE), int(_BIAS.mjBIAS_AFFINE)):
        found.append(
            f"bias {_BIAS(int(model.actuator_biastype[actuator])).name.removeprefix('mjBIAS_').lower()}"
        )
    if model.actuator_ctrlnum[actuator] != 1 or model.actuator_outnum[actuator] != 1:
        found.append("several inputs or outputs")
    if model.actuator_plugin[actuator] >= 0:
        found.append("a plugin")
    if model.actuator_delay[actuator] > 0:
        found.append("delay")
    return found


def limited_joints(model: mujoco.MjModel, *, keyed: Collection[int] = ()) -> list[int]:
    """Hinges and slides with limits that are part of the physics."""
    if disabled(model, "LIMIT") or disabled(model, "CONSTRAINT"):
        return []
    limited = (model.jnt_limited != 0) & np.isin(model.jnt_type, (HINGE, SLIDE))
    return [int(j) for j in np.flatnonzero(limited) if j not in keyed]


def unlocated(model: mujoco.MjModel, *, keyed: Collection[int] = ()) -> list[str]:
    """Limits that are part of the physics and that no run of the smooth engine can locate, one line each."""
    if disabled(model, "LIMIT") or disabled(model, "CONSTRAINT"):
        return []
    balls = np.flatnonzero((model.jnt_limited != 0) & (model.jnt_type == BALL))
    kinds = (
        (_OBJ.mjOBJ_JOINT, [j for j in balls if j not in keyed]),
        (_OBJ.mjOBJ_TENDON, _taut(model, keyed)),
    )
    found = []
    for kind, of in kinds:
        what = "a limit of a ball joint" if kind == _OBJ.mjOBJ_JOINT else "a limit of a tendon"
        found += [f"{_name(model, kind, int(i))}: {what}" for i in of]
    return found


def _taut(model: mujoco.MjModel, keyed: Collection[int]) -> list[int]:
    """Tendons with limits, those aside whose joints are all keyed."""
    out = []
    for tendon in np.flatnonzero(model.tendon_limited).tolist():
        path = slice(model.tendon_adr[tendon], model.tendon_adr[tendon] + model.tendon_num[tendon])
        along_joints = (model.wrap_type[path] == int(_WRAP.mjWRAP_JOINT)).all()
        if not (along_joints and all(int(j) in keyed for j in model.wrap_objid[path])):
            out.append(tendon)
    return out


def differences(
    model: mujoco.MjModel,
    *,
    friction_width: float | None,
    keyed: Collection[int] = (),
    at_limits: str | None = None,
) -> list[str]:
    """Physics of `model` that the smooth engine models otherwise than MuJoCo, one line each.

    `keyed` are the joints (by id) whose motion is prescribed. `at_limits` says what joint limits are to who
    locates them, as runs of a scene do; without, nothing looks at them.
    """
    found: list[str] = []
    if limited := limited_joints(model, keyed=keyed):
        of = "one joint" if len(limited) == 1 else f"{len(limited)} joints"
        found.append(f"limits of {of} are {at_limits or 'left out'}; MuJoCo's are soft constraints")
    if at_limits is None:
        found += [f"{line}, which is left out" for line in unlocated(model, keyed=keyed)]
    dry = [d for d in np.flatnonzero(model.dof_frictionloss) if int(model.dof_jntid[d]) not in keyed]
    if dry and not (disabled(model, "FRICTIONLOSS") or disabled(model, "CONSTRAINT")):
        on = "one freedom" if len(dry) == 1 else f"{len(dry)} freedoms"
        how = "left out"
        if friction_width is not None:
            # F v / sqrt(v^2 + w^2) = load gives v = w r / sqrt(1 - r^2), r = load / F
            how = f"smoothed below {friction_width:.3g} rad/s or m/s, and what it holds creeps at about that "
            how += "times load over friction, or faster near its limit"
        found.append(f"dry friction on {on} is {how}; MuJoCo models it as a soft constraint")
    return found
