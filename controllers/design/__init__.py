"""Gains and what they are worth: linearisation, Riccati equations, margins, responses, pictures."""

from .analysis import (
    Margins,
    Mode,
    StepInfo,
    closed_loop,
    growth,
    loop_response,
    margins,
    modes,
    root_locus,
    step_info,
    step_response,
)
from .linear import LinearSystem, held, held_matrices, linearise, linearise_contact, linearise_path
from .reach import controllability, detectability, observability, stabilisability
from .riccati import Regulator, along, dlqr, finite_horizon, lqr

__all__ = [
    "LinearSystem",
    "Margins",
    "Mode",
    "Regulator",
    "StepInfo",
    "along",
    "closed_loop",
    "controllability",
    "detectability",
    "dlqr",
    "finite_horizon",
    "growth",
    "held",
    "held_matrices",
    "linearise",
    "linearise_contact",
    "linearise_path",
    "loop_response",
    "lqr",
    "margins",
    "modes",
    "observability",
    "root_locus",
    "stabilisability",
    "step_info",
    "step_response",
]
