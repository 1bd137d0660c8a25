"""Virtual servos of a rig, on bare gears or carrying the robot that the rig embodies."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from .mapping import Mapping, indices, joint_bounds, make_bounds, make_mapping
from .registers import control_table
from .rig import Rig
from .virtual import MOTORS, NO_FAULTS, FaultPlan, Plant, Quirks, Timing, VirtualBus, VirtualServo, joints

Array = NDArray[np.float64]


def rest_pose(rig: Rig) -> Array:
    """Joint values (nj,) as near to zero as soft limits and servos allow."""
    mapping, servos, bounds = make_mapping(rig), make_bounds(rig), joint_bounds(rig)
    q = np.clip(0.0, bounds.low, bounds.high)
    return mapping.joint(np.clip(mapping.servo(q), servos.low, servos.high))


def virtual_bus(
    rig: Rig,
    *,
    pose: Array | None = None,
    model: mujoco.MjModel | None = None,
    faults: FaultPlan = NO_FAULTS,
    timing: Timing | None = None,
    firmware: int | None = None,
    quirks: Quirks | None = None,
) -> VirtualBus:
    """Virtual servos standing at joint values `pose` (nj,), torque off, as after power-on.

    With a `model` they carry it: gravity, inertia, friction, contacts. Else each turns its bare gear.
    """
    q = rest_pose(rig) if pose is None else np.asarray(pose, dtype=float)
    mapping = make_mapping(rig)
    s = mapping.servo(q)
    plants: Sequence[Plant | None] = [None] * len(rig.servos)
    if model is not None:
        robot = Robot(rig, mapping, model, q)
        plants = joints(robot.step, [float(x) for x in s], [0.0] * len(s))
    servos = [
        VirtualServo(
            item.model,
            item.id,
            baud=rig.baud,
            position=float(angle),
            plant=plant,
            firmware=firmware,
            quirks=quirks or Quirks(),
        )
        for item, angle, plant in zip(rig.servos, s, plants, strict=True)
    ]
    return VirtualBus(servos, timing=timing or Timing(), faults=faults)


class Robot:
    """A robot whose joints are moved by torques of servos; friction is the model's.

    Rotor inertia is the model's or, where that is less, what the virtual motors have, seen through the
    transmission at its steepest: back-EMF on less inertia would be too stiff for the servo's period of 1 ms.
    """

    def __init__(self, rig: Rig, mapping: Mapping, model: mujoco.MjModel, pose: Array) -> None:
        self.mapping = mapping
        self.model = model.__copy__()
        self.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ACTUATION)
        self.data = mujoco.MjData(self.model)
        self._qpos, self._dofs = indices(rig, mapping, model)
        bounds = joint_bounds(rig, model)
        path = np.linspace(np.clip(bounds.low, -np.pi, np.pi), np.clip(bounds.high, -np.pi, np.pi), 65)
        servo_v = np.abs([mapping.rates(path, row, np.zeros_like(path))[0] for row in np.eye(len(pose))])
        rotors = np.array([MOTORS[control_table(s.model).model].inertia for s in rig.servos])
        reflected = (servo_v.max(axis=1) ** 2) @ rotors  # J_q = sum (ds/dq)^2 J
        armature = self.model.dof_armature
        armature[self._dofs] = np.maximum(np.ravel(armature[self._dofs]), reflected).reshape(
            armature[self._dofs].shape
        )
        self.data.qpos[self._qpos] = pose
        for e in range(model.neq):  # the other finger of a gripper starts where its equality has it
            if model.eq_type[e] == mujoco.mjtEq.mjEQ_JOINT and model.eq_obj2id[e] >= 0:
                y, x = (model.jnt_qposadr[j] for j in (model.eq_obj1id[e], model.eq_obj2id[e]))
                slope = model.eq_data[e, 1]
                if y in self._qpos and x not in self._qpos and slope:
                    self.data.qpos[x] = self.data.qpos[y] / slope
                elif x in self._qpos and y not in self._qpos:
                    self.data.qpos[y] = np.polyval(model.eq_data[e, 4::-1], self.data.qpos[x])
        mujoco.mj_forward(self.model, self.data)

    def step(self, dt: float, torques: Sequence[float]) -> tuple[Sequence[float], Sequence[float]]:
        """Servo angles and velocities (ns,) after `dt` seconds under servo torques (ns,) [N m]."""
        q = self.data.qpos[self._qpos]
        if dt > 0:
            self.data.qfrc_applied[self._dofs] = self.mapping.joint_force(q, np.array(torques))
            self.model.opt.timestep = dt
            mujoco.mj_step(self.model, self.data)
            q = self.data.qpos[self._qpos]
        v = self.data.qvel[self._dofs]
        servo_v, _ = self.mapping.rates(q, v, np.zeros_like(v))
        return self.mapping.servo(q).tolist(), servo_v.tolist()
