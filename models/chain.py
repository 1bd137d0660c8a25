"""Chains of n equal links: ropes, scarves, tails, and the hanging chain of the textbooks."""

from typing import Literal

import mujoco
import numpy as np

from .errors import ModelError

# MuJoCo refuses a body without inertia (below 1e-15). This much, relative to m l^2, shifts the frequencies of
# a chain of point masses by the same relative amount; the twist of a ball link feels nothing else.
_POINT_INERTIA = 1e-9
_LEAST_INERTIA = 2e-15  # [kg m^2]


def chain(
    n: int,
    *,
    length: float = 1.0,
    mass: float = 1.0,
    joint: Literal["ball", "hinge"] = "ball",
    radius: float | None = None,
    damping: float = 0.0,
    fixed: bool = True,
    point_masses: bool = False,
    contacts: bool = False,
) -> mujoco.MjSpec:
    """Chain of n equal links hanging straight down from the origin.

    Bodies are `link_1` to `link_n` from the top, joints `joint_1` to `joint_n`, the lower end is the
    site `tip`. Hinges turn about -y, so that a positive angle swings the chain towards +x.

    Args:
        n: number of links.
        length: of the whole chain [m].
        mass: of the whole chain [kg].
        joint: between links; a hinge chain moves in the x-z plane.
        radius: of the drawn links [m]; by default a twelfth of a link, at most 0.03 m.
        damping: of every joint [N m s/rad].
        fixed: the upper end hangs from the world; otherwise the first link is free (joint `root`).
        point_masses: each link is a massless rod with mass/n at its lower end; otherwise a uniform capsule.
        contacts: links touch the floor and loose things (never each other).

    Raises:
        ModelError: a number that makes no chain.
    """
    _check(n, length, mass, joint, radius, damping)
    link = length / n
    thickness = min(link / 12, 0.03) if radius is None else radius
    spec = mujoco.MjSpec()
    spec.modelname = "chain"
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
    parent = spec.worldbody
    for i in range(1, n + 1):
        body = parent.add_body(name=f"link_{i}", pos=[0, 0, 0 if i == 1 else -link])
        if i == 1 and not fixed:
            body.add_freejoint(name="root")
        elif joint == "ball":
            body.add_joint(name=f"joint_{i}", type=mujoco.mjtJoint.mjJNT_BALL, damping=damping)
        else:
            body.add_joint(
                name=f"joint_{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, -1, 0], damping=damping
            )
        rod = body.add_geom(
            name=f"link_{i}",
            type=mujoco.mjtGeom.mjGEOM_CAPSULE,
            fromto=[0, 0, 0, 0, 0, -link],
            size=[thickness, 0, 0],
            mass=mass / n,
            contype=0,
            conaffinity=int(contacts),
            rgba=[0.89, 0.42, 0.32, 1] if i % 2 else [0.94, 0.72, 0.32, 1],
        )
        if point_masses:
            rod.mass = 0
            body.explicitinertial = True
            body.mass = mass / n
            body.ipos = [0, 0, -link]
            body.inertia = [max(_POINT_INERTIA * mass / n * link**2, _LEAST_INERTIA)] * 3
            body.add_geom(
                name=f"bead_{i}",
                type=mujoco.mjtGeom.mjGEOM_SPHERE,
                pos=[0, 0, -link],
                size=[2 * thickness, 0, 0],
                mass=0,
                contype=0,
                conaffinity=int(contacts),
                rgba=[0.25, 0.29, 0.35, 1],
            )
        parent = body
    parent.add_site(name="tip", pos=[0, 0, -link], size=[thickness, 0, 0], group=4)
    return spec


def _check(n: int, length: float, mass: float, joint: str, radius: float | None, damping: float) -> None:
    mistakes = []
    if n != int(n) or n < 1:
        mistakes.append(f"n = {n}: a chain has a whole number of links, at least 1")
    for name, value in (("length", length), ("mass", mass), ("radius", radius)):
        if value is not None and not (np.isfinite(value) and value > 0):
            mistakes.append(f"{name} = {value}: must be positive and finite")
    if not (np.isfinite(damping) and damping >= 0):
        mistakes.append(f"damping = {damping}: must be finite and not negative")
    if joint not in ("ball", "hinge"):
        mistakes.append(f"joint = {joint!r}: must be 'ball' or 'hinge'")
    if mistakes:
        raise ModelError("no such chain: " + "; ".join(mistakes))
