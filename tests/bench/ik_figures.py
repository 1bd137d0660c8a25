"""Figures of the inverse-kinematics benchmark: measured numbers and their bars."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured number and the bar it must reach (None: told, not judged)."""

    name: str
    value: float
    unit: str
    bar: str
    holds: bool | None


def at_most(name, value, bar, unit):
    return Figure(name, float(value), unit, f"<= {bar:g}", bool(value <= bar))


def at_least(name, value, bar, unit):
    return Figure(name, float(value), unit, f">= {bar:g}", bool(value >= bar))


def told(name, value, unit):
    return Figure(name, float(value), unit, "", None)
