"""MuJoCo's joint types as plain integers: its enums do not compare equal from both sides with array items."""

import mujoco

FREE = int(mujoco.mjtJoint.mjJNT_FREE)
BALL = int(mujoco.mjtJoint.mjJNT_BALL)
SLIDE = int(mujoco.mjtJoint.mjJNT_SLIDE)
HINGE = int(mujoco.mjtJoint.mjJNT_HINGE)
SCALAR = (SLIDE, HINGE)
