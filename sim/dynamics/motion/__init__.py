"""Motions of a compiled model over time: arguments, compiled loops, results."""
