"""Measured numbers and their bars."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """One measured number and the bar it must reach."""

    name: str
    value: float
    unit: str
    bar: str
    holds: bool


def at_most(name: str, value: float, bar: float, unit: str) -> Figure:
    return Figure(name, float(value), unit, f"<= {bar:g}", bool(value <= bar))


def at_least(name: str, value: float, bar: float, unit: str) -> Figure:
    return Figure(name, float(value), unit, f">= {bar:g}", bool(value >= bar))


def info(name: str, value: float, unit: str) -> Figure:
    return Figure(name, float(value), unit, "", True)
