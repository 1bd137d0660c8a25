"""Inverse kinematics with a verdict: poses from goals, once, along time, and live.

>>> from pantograph.models import load_model
>>> from pantograph.sim.ik import Position, solve
>>> print(solve(load_model("planar_2r"), Position("tip", [2.5, 0, 1])).verdict.kind)
out of reach
"""

from .animate import Pole, Spread, blend, soften
from .chains.solver import ChainSolver
from .goals import Distance, Goal, LookAt, Orientation, PointOnLine, PointOnPlane, Pose, Position
from .lock import Locked, Slide, lock
from .loops import Loops, Projection
from .mirror import Mirror
from .solve import solve
from .stream import Follower, Tick
from .track import Motion, follow
from .verdict import Residual, Solution, Verdict
from .wholes import CenterOfMass, JointValue, Posture

__all__ = [
    "CenterOfMass",
    "ChainSolver",
    "Distance",
    "Follower",
    "Goal",
    "JointValue",
    "Locked",
    "LookAt",
    "Loops",
    "Mirror",
    "Motion",
    "Orientation",
    "PointOnLine",
    "PointOnPlane",
    "Pole",
    "Pose",
    "Position",
    "Posture",
    "Projection",
    "Residual",
    "Slide",
    "Solution",
    "Spread",
    "Tick",
    "Verdict",
    "blend",
    "follow",
    "lock",
    "soften",
    "solve",
]
