"""Problems along time: goals change from instant to instant, mostly in what they aim at alone."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from .chains.machine import charge, words
from .chains.rows import is_known
from .goals import Goal
from .pose import Kinematics
from .problem import Problem
from .space import Space


class Series:
    """Problems of one model: what follows from the names in goals is found once for all alike."""

    def __init__(self, model: mujoco.MjModel, space: Space, joints: Sequence[str] | None) -> None:
        self.model, self.space, self.joints = model, space, joints
        self.kinematics = Kinematics(model)
        self._first: Problem | None = None
        self._key: object = None

    def problem(self, goals: Sequence[Goal]) -> Problem:
        """The problem of an instant. Raises ModelError for goals or names that do not fit the model."""
        known = all(is_known(goal) for goal in goals)
        key = [(words(goal), goal.weight, goal.tolerance) for goal in goals]
        if self._first is None or not known or key != self._key:
            first = Problem(self.model, goals, self.space, joints=self.joints, kinematics=self.kinematics)
            _ = first.name  # once for all alike
            self._first, self._key = first, key
            return first
        return self._first.aimed(goals)

    def compile(self, goals: Sequence[Goal]) -> bool:
        """Whether there is machine code for goals like these; it is compiled if it was not."""
        problem = self.problem(goals)
        if problem.prepared() is None:
            charge(problem.name, np.inf)
            problem.prepared(build=True)
        return problem.prepared() is not None
