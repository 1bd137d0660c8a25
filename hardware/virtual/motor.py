"""The motor behind the registers: a DC motor with first-order current, and the mechanics it drives.

Winding (output side of the gear): tau_e di/dt = (u - ke * speed) / R - i, torque = kt * i. Stall torque,
stall current and no-load speed come from the specification table of the manual page; what the manual does
not state is an assumption, named as such below.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from math import exp, pi
from types import MappingProxyType
from typing import Protocol

RPM = 2 * pi / 60


@dataclass(frozen=True)
class Motor:
    """Constants of a motor and its gear, seen at the output shaft.

    Args:
        voltage: Supply at which the next three hold [V].
        stall_torque: [N*m]
        stall_current: [A]
        no_load_speed: [rad/s]
        friction: Coulomb friction as a part of the stall torque (assumed; the manual states none).
        mechanical_time: Time constant J * speed / torque of the unloaded motor [s] (assumed).
        electrical_time: L / R [s] (assumed).
        heating: Temperature rise at stall after infinite time [K] (assumed).
        thermal_time: [s] (assumed).
        line_resistance: Of the supply and its cable [ohm] (assumed).
    """

    voltage: float
    stall_torque: float
    stall_current: float
    no_load_speed: float
    friction: float = 0.03
    mechanical_time: float = 0.02
    electrical_time: float = 1e-3
    heating: float = 80.0
    thermal_time: float = 200.0
    line_resistance: float = 0.1

    @cached_property
    def resistance(self) -> float:
        """Winding and driver [ohm]."""
        return self.voltage / self.stall_current

    @cached_property
    def coulomb(self) -> float:
        """Coulomb friction at the output [N*m]."""
        return self.friction * self.stall_torque

    @cached_property
    def kt(self) -> float:
        """Torque constant [N*m/A]: the stall torque is what friction leaves over."""
        return self.stall_torque * (1 + self.friction) / self.stall_current

    @cached_property
    def ke(self) -> float:
        """Back-EMF constant [V*s/rad]: at the no-load speed the current carries the friction alone."""
        return (self.voltage - self.resistance * self.coulomb / self.kt) / self.no_load_speed

    @cached_property
    def inertia(self) -> float:
        """Rotor and gear at the output shaft [kg*m^2]."""
        return self.mechanical_time * self.stall_torque / self.no_load_speed

    def current(self, i: float, u: float, speed: float, dt: float) -> float:
        """Current after `dt` [A] with voltage u [V] on the winding: exact for constant u and speed."""
        steady = (u - self.ke * speed) / self.resistance
        return steady + (i - steady) * exp(-dt / self.electrical_time)


def _motor(voltage: float, torque: float, current: float, rpm: float) -> Motor:
    return Motor(voltage, torque, current, rpm * RPM)


MOTORS: Mapping[str, Motor] = MappingProxyType(
    {
        "xl330-m077": _motor(5.0, 0.215, 1.47, 383),
        "xl330-m288": _motor(5.0, 0.52, 1.47, 103),
        "xc330-m181": _motor(5.0, 0.60, 1.80, 129),
        "xc330-m288": _motor(5.0, 0.93, 1.80, 81),
        "xc330-t181": _motor(11.1, 0.76, 0.80, 104),
        "xc330-t288": _motor(11.1, 0.92, 0.80, 65),
        "xl430-w250": _motor(11.1, 1.4, 1.3, 57),
        "xc430-w150": _motor(12.0, 1.6, 1.4, 106),
        "xc430-w240": _motor(12.0, 1.9, 1.4, 70),
        "xm430-w210": _motor(12.0, 3.0, 2.3, 77),
        "xm430-w350": _motor(12.0, 4.1, 2.3, 46),
        "xm540-w150": _motor(12.0, 7.3, 4.4, 53),
        "xm540-w270": _motor(12.0, 10.6, 4.4, 30),
        "xh430-w210": _motor(12.0, 2.5, 1.3, 50),
        "xh430-w350": _motor(12.0, 3.4, 1.3, 30),
        "xh430-v210": _motor(24.0, 2.6, 0.7, 52),
        "xh430-v350": _motor(24.0, 3.3, 0.7, 31),
        "mx-28": _motor(12.0, 2.5, 1.4, 55),
        "mx-64": _motor(12.0, 6.0, 4.1, 63),
        "mx-106": _motor(12.0, 8.4, 5.2, 45),
    }
)
"""Specification tables of the manual pages, at the recommended voltage."""


class Plant(Protocol):
    """What the output shaft drives: a gear with a load, or a joint of a running simulation."""

    def step(self, dt: float, torque: float) -> tuple[float, float]:
        """Position [rad] and velocity [rad/s] of the shaft after `dt` seconds under the motor's torque [N*m].

        Friction and inertia of the gear belong to the plant.
        """


class Gear:
    """The servo alone with an inertia on its horn: Coulomb friction, optional backlash and outer torque.

    Args:
        inertia: Gear and load [kg*m^2].
        coulomb: Coulomb friction [N*m].
        position, velocity: At the start [rad, rad/s].
        backlash: Play of the gear [rad]: the shaft stays until the gear has crossed the play.
        load: Outer torque [N*m] as a function of the shaft's position and velocity.
        stop: Hard stops [rad]; the shaft ends there at rest.
    """

    def __init__(
        self,
        inertia: float,
        coulomb: float = 0.0,
        *,
        position: float = 0.0,
        velocity: float = 0.0,
        backlash: float = 0.0,
        load: Callable[[float, float], float] | None = None,
        stop: tuple[float, float] | None = None,
    ) -> None:
        self.inertia, self.coulomb, self.backlash = inertia, coulomb, backlash
        self.load, self.stop = load, stop
        self.gear = self.position = position
        self.velocity = velocity

    def step(self, dt: float, torque: float) -> tuple[float, float]:
        """Semi-implicit Euler; friction takes at most the momentum there is, so that the shaft can rest."""
        if self.load is not None:
            torque += self.load(self.position, self.velocity)
        v = self.velocity + dt * torque / self.inertia
        friction = dt * self.coulomb / self.inertia
        v = 0.0 if abs(v) <= friction else (v - friction if v > 0 else v + friction)
        gear = self.gear + dt * v
        if self.stop is not None and not self.stop[0] <= gear <= self.stop[1]:
            gear, v = min(max(gear, self.stop[0]), self.stop[1]), 0.0
        self.gear, self.velocity = gear, v
        if self.backlash:
            half = self.backlash / 2
            self.position = min(max(self.position, gear - half), gear + half)
        else:
            self.position = gear
        return self.position, v


class _Joint:
    """One joint of a group that advances as a whole."""

    def __init__(self, group: _Group, index: int) -> None:
        self._group, self._index = group, index

    def step(self, dt: float, torque: float) -> tuple[float, float]:
        return self._group.step(self._index, dt, torque)


class _Group:
    def __init__(self, step: GroupStep, state: tuple[Sequence[float], Sequence[float]]) -> None:
        self._step, (self._q, self._v) = step, state
        self._torques = [0.0] * len(self._q)
        self._ready: set[int] = set()

    def step(self, index: int, dt: float, torque: float) -> tuple[float, float]:
        self._torques[index] = torque
        self._ready.add(index)
        if len(self._ready) == len(self._torques):
            self._ready.clear()
            self._q, self._v = self._step(dt, self._torques)
        return float(self._q[index]), float(self._v[index])


GroupStep = Callable[[float, Sequence[float]], tuple[Sequence[float], Sequence[float]]]


def joints(step: GroupStep, position: Sequence[float], velocity: Sequence[float]) -> list[Plant]:
    """Plants for servos that drive the joints of one simulation, which advances when all torques are in.

    Args:
        step: (dt [s], torques [N*m]) -> positions [rad] and velocities [rad/s], one for each joint.
        position, velocity: State at the start.

    Every servo must be on one bus, which advances them in turn; a joint sees the others' motion one control
    period (1 ms) late.
    """
    group = _Group(step, (position, velocity))
    return [_Joint(group, i) for i in range(len(position))]
