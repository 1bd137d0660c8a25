"""Keyed motion made possible: check it against a machine, retime it, or fit it under full dynamics."""

from .check import Report, Violation, check
from .machine import Machine, machine
from .retime import Retimed, retime

__all__ = ["Machine", "Report", "Retimed", "Violation", "check", "machine", "retime"]
