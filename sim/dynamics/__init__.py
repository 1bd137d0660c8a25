"""Smooth dynamics: the equations of motion of a MuJoCo model, written once and turned into machine code."""

from .autograd import TorchDynamics, differentiable
from .laws import LinearFeedback, joint_pd
from .machine import Stats
from .motion.path import STATUS, Path
from .motion.stepper import Stepper
from .sensitivity import Derivatives, StepDerivatives
from .smooth import Inputs, Smooth, compile_model
from .support import differences, unsupported

__all__ = [
    "STATUS",
    "Derivatives",
    "Inputs",
    "LinearFeedback",
    "Path",
    "Smooth",
    "Stats",
    "StepDerivatives",
    "Stepper",
    "TorchDynamics",
    "compile_model",
    "differences",
    "differentiable",
    "joint_pd",
    "unsupported",
]
