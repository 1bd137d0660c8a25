"""Damped least squares, restarts, self-motions and quadratic programmes."""
