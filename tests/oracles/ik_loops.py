"""Closed loops of our own: a four-bar linkage with its closed form, and a Stewart platform."""

import mujoco
import numpy as np

GROUND, CRANK, COUPLER, ROCKER = 1.0, 0.3, 0.9, 0.7


def four_bar(lengths=(GROUND, CRANK, COUPLER, ROCKER)):
    """Planar four-bar in x-z: joints `crank`, `coupler` from one side, `rocker` from the other, a connect."""
    ground, crank, coupler, rocker = lengths
    return mujoco.MjModel.from_xml_string(f"""
    <mujoco><compiler angle="radian"/><worldbody>
      <body name="crank"><joint name="crank" axis="0 -1 0"/><geom size=".01" mass="1"/>
        <body name="coupler" pos="{crank} 0 0"><joint name="coupler" axis="0 -1 0"/>
          <geom size=".01" mass="1"/>
          <site name="pin" pos="{coupler} 0 0"/></body></body>
      <body name="rocker" pos="{ground} 0 0"><joint name="rocker" axis="0 -1 0"/><geom size=".01" mass="1"/>
        <site name="end" pos="{rocker} 0 0"/></body>
    </worldbody><equality><connect name="loop" site1="pin" site2="end"/></equality></mujoco>""")


def four_bar_angles(crank_angle, lengths=(GROUND, CRANK, COUPLER, ROCKER)):
    """Coupler (relative) and rocker angles of both assemblies (2, 2), by Freudenstein's circles."""
    ground, crank, coupler, rocker = lengths
    pin = crank * np.array([np.cos(crank_angle), np.sin(crank_angle)])
    across = np.array([ground, 0]) - pin
    d = np.hypot(*across)
    a = (coupler**2 - rocker**2 + d**2) / (2 * d)
    h = np.sqrt(coupler**2 - a**2)
    e = across / d
    out = []
    for sign in (1, -1):
        end = pin + a * e + sign * h * np.array([-e[1], e[0]])
        absolute = np.arctan2(*(end - pin)[::-1])
        out.append([absolute - crank_angle, np.arctan2(end[1], end[0] - ground)])
    return np.array(out)


def stewart(*, seed=0):
    """Six legs (two hinges, a slide) from a base ring to a free platform, each joined by a connect."""
    rng = np.random.default_rng(seed)
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    plate = spec.worldbody.add_body(name="plate", pos=[0, 0, 1])
    plate.add_freejoint(name="plate")
    plate.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=[0.3, 0.3, 0.02], mass=1, contype=0, conaffinity=0)
    plate.add_site(name="plate")
    anchors = []
    for i in range(6):
        low = 2 * np.pi * (i // 2) / 3 + (0.3 if i % 2 else -0.3) + 0.02 * rng.normal()
        high = 2 * np.pi * ((i + 1) // 2) / 3 - np.pi / 3 + (0.2 if i % 2 else -0.2)
        base = np.array([np.cos(low), np.sin(low), 0.0])
        top = 0.5 * np.array([np.cos(high), np.sin(high), 0.0])
        anchors.append((base, top))
        z = np.add(top, [0, 0, 1]) - base
        length = np.linalg.norm(z)
        quat = np.empty(4)
        mujoco.mju_quatZ2Vec(quat, z / length)
        leg = spec.worldbody.add_body(name=f"leg{i}", pos=base, quat=quat)
        leg.add_joint(name=f"a{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[1, 0, 0])
        leg.add_joint(name=f"b{i}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
        leg.add_geom(size=[0.02, 0, 0], mass=1, contype=0, conaffinity=0)
        rod = leg.add_body(name=f"rod{i}", pos=[0, 0, length])
        rod.add_joint(
            name=f"s{i}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=[0, 0, 1], range=[-0.5, 0.5], limited=True
        )
        rod.add_geom(size=[0.02, 0, 0], mass=1, contype=0, conaffinity=0)
        rod.add_site(name=f"foot{i}")
        plate.add_site(name=f"ball{i}", pos=top)
        spec.add_equality(name=f"c{i}", type=mujoco.mjtEq.mjEQ_CONNECT, objtype=mujoco.mjtObj.mjOBJ_SITE,
                          name1=f"foot{i}", name2=f"ball{i}")  # fmt: skip
    return spec.compile(), anchors


def leg_lengths(anchors, R, p):
    """Distances (6,) of a Stewart platform's joints for a pose of the plate: its inverse kinematics."""
    return np.array([np.linalg.norm(R @ top + p - base) for base, top in anchors])
