"""The nearest possible motion, under full dynamics: direct collocation, on grids that are refined."""

from .collocate import fit

__all__ = ["fit"]
