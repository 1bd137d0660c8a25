"""Arms of the inverse-kinematics benchmark, from published parameters, as MuJoCo models with a site `tip`."""

import mujoco
import numpy as np

# Panda: Craig's (modified) DH parameters and limits as Franka Emika publishes them for FCI, "Robot and
# interface specifications": a, d [m], alpha [rad] before each joint, then limits [rad]; flange 0.107 m.
PANDA = [
    (0.0, 0.333, 0.0, -2.8973, 2.8973),
    (0.0, 0.0, -np.pi / 2, -1.7628, 1.7628),
    (0.0, 0.316, np.pi / 2, -2.8973, 2.8973),
    (0.0825, 0.0, np.pi / 2, -3.0718, -0.0698),
    (-0.0825, 0.384, -np.pi / 2, -2.8973, 2.8973),
    (0.0, 0.0, np.pi / 2, -0.0175, 3.7525),
    (0.088, 0.0, np.pi / 2, -2.8973, 2.8973),
]
# UR5: standard DH of Universal Robots' support article "DH parameters for calculations of kinematics and
# dynamics" (a, d, alpha after each joint), limits +-2 pi.
UR5 = [
    (0.0, 0.089159, np.pi / 2),
    (-0.425, 0.0, 0.0),
    (-0.39225, 0.0, 0.0),
    (0.0, 0.10915, np.pi / 2),
    (0.0, 0.09465, -np.pi / 2),
    (0.0, 0.0823, 0.0),
]


def panda() -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    for i, (a, d, alpha, low, high) in enumerate(PANDA):  # Rot_x(alpha) Trans_x(a) Rot_z(q) Trans_z(d)
        quat = [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
        pos = [a, -d * np.sin(alpha), d * np.cos(alpha)]
        body = _link(body, f"link{i + 1}", pos, quat, (low, high))
    body.add_site(name="tip", pos=[0, 0, 0.107])
    return spec.compile()


def ur5() -> mujoco.MjModel:
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body, pos, quat = spec.worldbody, [0, 0, 0], [1, 0, 0, 0]
    for i, (a, d, alpha) in enumerate(UR5):  # Rot_z(q) Trans_z(d) Trans_x(a) Rot_x(alpha)
        body = _link(body, f"link{i + 1}", pos, quat, (-2 * np.pi, 2 * np.pi))
        pos, quat = [a, 0, d], [np.cos(alpha / 2), np.sin(alpha / 2), 0, 0]
    body.add_site(name="tip", pos=pos, quat=quat)
    return spec.compile()


def _link(parent, name, pos, quat, limits):
    body = parent.add_body(name=name, pos=pos, quat=quat)
    body.add_joint(
        name=f"joint_{name[4:]}", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 0, 1], range=limits, limited=True
    )
    body.add_geom(size=[0.03, 0, 0], mass=1.0, contype=0, conaffinity=0)
    return body


def chain_spec(frame, model):
    """The chain of a frame (`pantograph.sim.kinematics`) alone: hinges with their limits, and `tip`."""
    spec = mujoco.MjSpec()
    spec.compiler.degree = False
    body = spec.worldbody
    for i, joint in enumerate(frame.joints):
        limits = model.jnt_range[model.dof_jntid[joint.v]] - joint.rest
        body = _link(body, f"link{i + 1}", joint.X[:3, 3], _quat(joint.X), limits)
    body.add_site(name="tip", pos=frame.X_end[:3, 3], quat=_quat(frame.X_end))
    return spec


def bare(frame, model):
    return chain_spec(frame, model).compile()


def _quat(X):
    quat = np.empty(4)
    mujoco.mju_mat2Quat(quat, np.ascontiguousarray(X[:3, :3]).ravel())
    return quat
