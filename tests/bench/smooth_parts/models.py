"""Models of the smooth engine's benchmark: stripped to joints and inertias, the same for every engine."""

import os
from pathlib import Path

import mujoco
import numpy as np

ROOT = Path(__file__).resolve().parents[3]
MJCF = ROOT / "models" / "mjcf"
DATA = Path(os.environ.get("PANTOGRAPH_DATA", ROOT.parent / "shared" / "data"))
ROBOTS = {
    "wx250s": "trossen_wx250s/wx250s.xml",
    "dynamixel_2r": "dynamixel_2r/dynamixel_2r.xml",
    "open_manipulator_x": "robotis_open_manipulator_x/open_manipulator_x.xml",
    "humanoid": "humanoid/humanoid.xml",
}
FIVE = ("double_pendulum", "ur5", "panda", "quadruped", "humanoid")  # of the measured speeds
OTHERS = ("wx250s", "dynamixel_2r", "open_manipulator_x", "chain of 40 hinges", "chain of ball joints")
KINDS = {0: "free", 1: "ball", 2: "slide", 3: "hinge"}

# Kinematics: Universal Robots' "DH parameters for calculations of kinematics and dynamics" (standard DH:
# a, d, alpha after each joint), masses and centres of mass from the same article; moments of inertia as in
# the ROS description of the UR5: mass, centre of mass, principal moments, in the DH frame after the joint.
UR5 = [
    (0.0, 0.089159, np.pi / 2, 3.7, (0, -0.02561, 0.00193), (0.010267, 0.010267, 0.00666)),
    (-0.425, 0.0, 0.0, 8.393, (0.2125, 0, 0.11336), (0.0151074, 0.22689, 0.22689)),
    (-0.39225, 0.0, 0.0, 2.275, (0.15, 0, 0.0265), (0.004095, 0.049443, 0.049443)),
    (0.0, 0.10915, np.pi / 2, 1.219, (0, -0.0018, 0.01634), (0.1112, 0.1112, 0.21942)),
    (0.0, 0.09465, -np.pi / 2, 1.219, (0, 0.0018, 0.01634), (0.1112, 0.1112, 0.21942)),
    (0.0, 0.0823, 0.0, 0.1879, (0, 0, -0.001159), (0.0171364, 0.0171364, 0.033822)),
]
# Kinematics: Craig's DH of Franka Emika's interface specification (a, d, alpha before each joint); dynamics:
# Gaz et al., "Dynamic Identification of the Franka Emika Panda Robot ...", IEEE RA-L 4 (2019) 4147: mass,
# centre of mass, then xx yy zz xy xz yz about it.
PANDA = [
    (0, 0.333, 0, 4.970684, (0.003875, 0.002081, -0.04762),
     (0.70337, 0.70661, 0.0091170, -0.00013900, 0.0067720, 0.019169)),
    (0, 0, -np.pi / 2, 0.646926, (-0.003141, -0.02872, 0.003495),
     (0.0079620, 0.028110, 0.025995, -0.003925, 0.010254, 0.000704)),
    (0, 0.316, np.pi / 2, 3.228604, (0.027518, 0.039252, -0.066502),
     (0.037242, 0.036155, 0.010830, -0.004761, -0.011396, -0.012805)),
    (0.0825, 0, np.pi / 2, 3.587895, (-0.05317, 0.104419, 0.027454),
     (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (-0.0825, 0.384, -np.pi / 2, 1.225946, (-0.011953, 0.041065, -0.038437),
     (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    (0, 0, np.pi / 2, 1.666555, (0.060149, -0.014117, -0.010517),
     (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    (0.088, 0, np.pi / 2, 0.735522, (0.010517, -0.004252, 0.061597),
     (0.012516, 0.010027, 0.004815, -0.000428, -0.001196, -0.000741)),
]  # fmt: skip


def _numbers(values):
    return " ".join(repr(float(x)) for x in values)


def ur5():
    xml, pose = [], 'pos="0 0 0"'
    for a, d, alpha, mass, com, moments in UR5:  # Rot_z(q) Trans_z(d) Trans_x(a) Rot_x(alpha)
        turn = np.array([[1, 0, 0], [0, np.cos(alpha), -np.sin(alpha)], [0, np.sin(alpha), np.cos(alpha)]])
        place = turn @ com + [a, 0, d]
        quat = [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
        xml.append(
            f'<body {pose}><joint axis="0 0 1"/><inertial pos="{_numbers(place)}" quat="{_numbers(quat)}" '
            f'mass="{mass}" diaginertia="{_numbers(moments)}"/>'
        )
        pose = f'pos="{_numbers([a, 0, d])}" quat="{_numbers(quat)}"'
    return _arm(xml)


def panda():
    xml = []
    for a, d, alpha, mass, com, moments in PANDA:  # Rot_x(alpha) Trans_x(a) Rot_z(q) Trans_z(d)
        pos, quat = [a, -d * np.sin(alpha), d * np.cos(alpha)], [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
        xml.append(
            f'<body pos="{_numbers(pos)}" quat="{_numbers(quat)}"><joint axis="0 0 1"/>'
            f'<inertial pos="{_numbers(com)}" mass="{mass}" fullinertia="{_numbers(moments)}"/>'
        )
    return _arm(xml)


def _arm(bodies):
    text = "".join(bodies) + "</body>" * len(bodies)
    return mujoco.MjModel.from_xml_string(
        f'<mujoco><compiler angle="radian" balanceinertia="true"/><worldbody>{text}</worldbody></mujoco>'
    )


def chain(n, kind):
    joint = {"hinge": '<joint axis="{} {} 0"/>', "ball": '<joint type="ball"/>'}[kind]
    body = "".join(
        f'<body pos="0 0 {-0.1 if i else 0}">{joint.format(i % 2, 1 - i % 2)}'
        '<geom type="capsule" size=".01" fromto="0 0 0 0 0 -.1"/>'
        for i in range(n)
    )
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}{'</body>' * n}</worldbody></mujoco>")


def names():
    """All models that the engines must agree on: ours, real robots, chains."""
    ours = [path.stem for path in sorted(MJCF.glob("*.xml"))]
    return [*ours, *ROBOTS, "ur5", "panda", "chain of 40 hinges", "chain of ball joints"]


def load(name):
    """A model by name; None when its data is not here."""
    if name in ("ur5", "panda"):
        return {"ur5": ur5, "panda": panda}[name]()
    if name.startswith("chain"):
        return chain(40, "hinge") if name == "chain of 40 hinges" else chain(12, "ball")
    if name == "3 ball joints":
        return chain(3, "ball")
    path = DATA / "robots" / ROBOTS[name] if name in ROBOTS else MJCF / f"{name}.xml"
    return mujoco.MjModel.from_xml_path(str(path)) if path.exists() else None


def unconstrained(model):
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_CONSTRAINT | mujoco.mjtDisableBit.mjDSBL_CONTACT
    )
    return model


def stripped(model):
    """Joints, inertias and gravity of a model, nothing else; contacts and constraints off."""
    children = {b: [] for b in range(model.nbody)}
    for b in range(1, model.nbody):
        children[model.body_parentid[b]].append(b)

    def body(b):
        joints = ""
        for j in range(model.body_jntadr[b], model.body_jntadr[b] + model.body_jntnum[b]):
            kind = KINDS[int(model.jnt_type[j])]
            at = (
                ""
                if kind == "free"
                else f'pos="{_numbers(model.jnt_pos[j])}" axis="{_numbers(model.jnt_axis[j])}"'
            )
            joints += f'<joint type="{kind}" {at}/>'
        matter = ""
        if model.body_mass[b] > 0:
            matter = (
                f'<inertial pos="{_numbers(model.body_ipos[b])}" quat="{_numbers(model.body_iquat[b])}" '
                f'mass="{float(model.body_mass[b])!r}" diaginertia="{_numbers(model.body_inertia[b])}"/>'
            )
        inner = "".join(body(c) for c in children[b])
        place = f'pos="{_numbers(model.body_pos[b])}" quat="{_numbers(model.body_quat[b])}"'
        return f"<body {place}>{joints}{matter}{inner}</body>"

    text = "".join(body(b) for b in children[0])
    return unconstrained(
        mujoco.MjModel.from_xml_string(
            '<mujoco><compiler angle="radian" balanceinertia="true"/>'
            f'<option gravity="{_numbers(model.opt.gravity)}"/>'
            f"<worldbody>{text}</worldbody></mujoco>"
        )
    )


def states(model, count, seed=0, spread=2.0):
    """Random q on the manifold, about `spread` [rad, m] from the reference, v, act and u."""
    rng = np.random.default_rng(seed)
    q = np.tile(model.qpos0, (count, 1))
    for row in q:
        mujoco.mj_integratePos(model, row, spread * rng.normal(size=model.nv), 1.0)
    return (
        q,
        rng.normal(size=(count, model.nv)),
        rng.normal(size=(count, model.na)),
        rng.normal(size=(count, model.nu)),
    )


def bent(model):
    """A start away from the reference: joints by 0.5 to 1.5 rad, base turned as far."""
    q = model.qpos0.copy()
    mujoco.mj_integratePos(model, q, np.linspace(0.5, 1.5, model.nv), 1.0)
    return q
