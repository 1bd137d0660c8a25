"""Integration of smooth motion: methods as data, one front door, events and error estimates."""

from .events import Event
from .problems import ODE, MujocoProblem, Problem, mujoco_problem
from .solution import Occurrence, Solution, Stats, Status
from .solve import solve
from .tableau import Dense, Tableau
from .tableaus import TABLEAUS

__all__ = [
    "ODE",
    "TABLEAUS",
    "Dense",
    "Event",
    "MujocoProblem",
    "Occurrence",
    "Problem",
    "Solution",
    "Stats",
    "Status",
    "Tableau",
    "mujoco_problem",
    "solve",
]
