"""Keyed motion made possible: check it against a machine, retime it, or fit it under full dynamics."""

from .check import Report, Violation, check
from .contact import Phase
from .fitted import Certificate, Fitted
from .machine import Machine, machine
from .prove import Proof, prove
from .spacetime import fit
from .timing import Retimed, Stop, retime

__all__ = [
    "Certificate",
    "Fitted",
    "Machine",
    "Phase",
    "Proof",
    "Report",
    "Retimed",
    "Stop",
    "Violation",
    "check",
    "fit",
    "machine",
    "prove",
    "retime",
]
