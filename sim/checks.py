"""After a run: what was left out of the physics, did it matter in the recorded frames?"""

from __future__ import annotations

import mujoco
import numpy as np

from ..models import name_of
from .engines.interface import Array, Role
from .engines.prescribe import prescribed_bodies
from .kinds import HINGE, SCALAR
from .scene.build import Setup

_LOOKS = 500  # at keyed motion
_DEEP = 1e-3  # m; shallower overlaps are within the softness of contacts


def check_frames(setup: Setup, t: Array, q: Array) -> list[str]:
    """Sentences about overlaps and crossed limits that the run did not prevent; empty when there are none."""
    if not len(t):
        return []
    return _limits(setup, t, q) + _overlaps(setup, t, q)


def keys_beyond_limits(setup: Setup) -> list[str]:
    """Joints whose controller is asked for places that their limits do not let through."""
    m, out = setup.model, []
    keyed = [m.joint(name).id for name in setup.clip.tracks]
    tracked = [j for j in keyed if setup.roles[j] == Role.TRACKED and int(m.jnt_type[j]) in SCALAR]
    q = setup.clip.evaluate(np.linspace(0.0, setup.scene.duration, _LOOKS))[0]
    for j in tracked:
        if not (setup.scene.physics.limits and m.jnt_limited[j]):
            continue
        low, high = m.jnt_range[j]
        x = q[:, m.jnt_qposadr[j]]
        worst = x[int(np.argmax(np.maximum(low - x, x - high)))]
        if not low - 1e-9 <= worst <= high + 1e-9:
            unit = "rad" if m.jnt_type[j] == HINGE else "m"
            out.append(f"{name_of(m, 'joint', j)} {worst:.3g} {unit} outside [{low:.4g}, {high:.4g}]")
    return out


def _limits(setup: Setup, t: Array, q: Array) -> list[str]:
    m, out = setup.as_filed, []
    for j in range(m.njnt):
        scalar = int(m.jnt_type[j]) in SCALAR
        enforced = setup.scene.physics.limits and setup.roles[j] != Role.KEYED
        if not (scalar and m.jnt_limited[j]) or enforced:
            continue
        low, high = m.jnt_range[j]
        x = q[:, m.jnt_qposadr[j]]
        beyond = np.maximum(low - x, x - high)
        worst = int(np.argmax(beyond))
        if beyond[worst] > 1e-9:
            unit = "rad" if m.jnt_type[j] == HINGE else "m"
            out.append(
                f"joint {name_of(m, 'joint', j)!r} leaves its range [{low:.4g}, {high:.4g}] {unit} by "
                f"{beyond[worst]:.3g} {unit} at t = {t[worst]:.3g} s (limit not simulated)"
            )
    return out


def _overlaps(setup: Setup, t: Array, q: Array) -> list[str]:
    m, contacts = setup.as_filed, setup.scene.physics.contacts
    prescribed = prescribed_bodies(m, np.asarray(setup.roles[m.dof_jntid] == Role.KEYED))
    moving_prescribed = prescribed & (np.asarray(m.body_weldid) != 0)
    if contacts == "model" and not moving_prescribed.any():
        return []
    simulated = _simulated_pairs(setup)
    data = mujoco.MjData(m)
    worst: dict[tuple[int, int], tuple[float, float]] = {}
    for i in range(len(t)):
        data.qpos[:] = q[i]
        mujoco.mj_kinematics(m, data)
        mujoco.mj_comPos(m, data)
        mujoco.mj_collision(m, data)
        for c in range(data.ncon):
            contact = data.contact[c]
            g1, g2 = int(contact.geom[0]), int(contact.geom[1])
            b1, b2 = sorted((int(m.geom_bodyid[g1]), int(m.geom_bodyid[g2])))
            left_out = (
                (prescribed[b1] and prescribed[b2])
                if contacts == "model"
                else (min(g1, g2), max(g1, g2)) not in simulated
            )
            if left_out and contact.dist < min(-_DEEP, worst.get((b1, b2), (0.0, 0.0))[0]):
                worst[b1, b2] = (float(contact.dist), float(t[i]))
    return [
        f"{name_of(m, 'body', b1)} and {name_of(m, 'body', b2)} overlap by {_length(-depth)} "
        f"at t = {when:.3g} s (contact not simulated)"
        for (b1, b2), (depth, when) in sorted(worst.items(), key=lambda item: item[1][0])
    ]


def _length(x: float) -> str:
    return f"{x:.3g} m" if x >= 1.0 else f"{1e3 * x:.3g} mm"


def _simulated_pairs(setup: Setup) -> set[tuple[int, int]]:
    m = setup.model
    if setup.scene.physics.contacts == "none":
        return set()
    return {
        (min(int(a), int(b)), max(int(a), int(b))) for a, b in zip(m.pair_geom1, m.pair_geom2, strict=True)
    }
