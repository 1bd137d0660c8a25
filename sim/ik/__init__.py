"""Inverse kinematics with a verdict."""

from .goals import (
    CenterOfMass,
    Distance,
    Goal,
    JointValue,
    LookAt,
    Mirror,
    Orientation,
    PointOnLine,
    PointOnPlane,
    Pose,
    Position,
    Posture,
)
from .raced import ChainSolver
from .solve import solve
from .verdict import Residual, Solution, Verdict

__all__ = [
    "CenterOfMass",
    "ChainSolver",
    "Distance",
    "Goal",
    "JointValue",
    "LookAt",
    "Mirror",
    "Orientation",
    "PointOnLine",
    "PointOnPlane",
    "Pose",
    "Position",
    "Posture",
    "Residual",
    "Solution",
    "Verdict",
    "solve",
]
