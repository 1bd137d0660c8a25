"""The control loops of a servo: from goals and gains to voltage, current and motion.

Source: e-manual, block diagrams of Operating Mode (11) and the gain registers (KpP = P/128, KpD = D/16, KpI
    = I/65536, KvP = P/128, KvI = I/65536, output in counts of PWM each millisecond). Feedforward gains are
    kept but have no effect. Positions are the servo's own: turned by the reverse mode, shifted by the
    homing offset.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import exp, inf, pi

from ..tables.rows import POSITION, PWM, VELOCITY
from . import profile
from .motor import Motor, Plant

CURRENT_MODE, VELOCITY_MODE, POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE, PWM_MODE = 0, 1, 3, 4, 5, 16
POSITION_MODES = (POSITION_MODE, EXTENDED_MODE, CURRENT_POSITION_MODE)
PERIOD = 1e-3  # s, of the control loop


@dataclass
class Settings:
    """What the registers ask of the drive, in SI; ratios of the supply for PWM."""

    mode: int = POSITION_MODE
    torque: bool = False
    reverse: bool = False
    time_based: bool = False
    position_gains: tuple[float, float, float] = (0.0, 0.0, 0.0)  # P [1/rad], I [1/(rad s)], D [s/rad]
    velocity_gains: tuple[float, float] = (0.0, 0.0)  # P [s/rad], I [1/rad]
    pwm_goal: float = 1.0
    current_goal: float = inf
    velocity_goal: float = 0.0
    position_goal: float = 0.0
    profile_velocity: float = 0.0  # rad/s, or s when time based
    profile_acceleration: float = 0.0  # rad/s^2, or s when time based


def position_gains(p: int, i: int, d: int) -> tuple[float, float, float]:
    """PWM ratio per rad, rad s and rad/s of the gain registers."""
    return p / 128 * PWM / POSITION, i / 65536 * PWM / POSITION / PERIOD, d / 16 * PWM / POSITION * PERIOD


def velocity_gains(p: int, i: int) -> tuple[float, float]:
    """PWM ratio per rad/s and per rad of the gain registers."""
    return p / 128 * PWM / VELOCITY, i / 65536 * PWM / VELOCITY / PERIOD


class Drive:
    """Motor, winding temperature and control loops of one servo, advanced in periods of 1 ms."""

    def __init__(self, motor: Motor, plant: Plant, *, supply: float, ambient: float) -> None:
        self.motor, self.plant = motor, plant
        self.supply, self.ambient = supply, ambient
        self.settings = Settings()
        self.shift = 0.0  # rad, from the shaft to the reported position
        self.shaft, self.shaft_velocity = plant.step(0.0, 0.0)
        self.current = self.pwm = 0.0
        self.voltage, self.temperature = supply, ambient
        self.halted = False  # the bus watchdog stopped the motion
        self.trajectory = profile.step(self.position)
        self.elapsed = 0.0  # s, on the trajectory
        self._integral = 0.0
        self._error = 0.0
        self._decay = exp(-PERIOD / motor.electrical_time)

    @property
    def _sign(self) -> float:
        return -1.0 if self.settings.reverse else 1.0

    @property
    def position(self) -> float:
        """Reported position [rad], unrounded."""
        return self._sign * self.shaft + self.shift

    @property
    def velocity(self) -> float:
        """Reported velocity [rad/s], unrounded."""
        return self._sign * self.shaft_velocity

    @property
    def target(self) -> tuple[float, float]:
        """Position and velocity of the trajectory."""
        return self.trajectory.at(self.elapsed)

    def place(self, position: float) -> None:
        """Report the present shaft angle as `position` [rad]."""
        self.shift = position - self._sign * self.shaft

    def hold(self) -> None:
        """Begin at the present position, at rest, without memory of earlier errors."""
        self._start(profile.step(self.position))
        self._integral = self._error = 0.0

    def halt(self) -> None:
        """Stop at once and ignore goals until `resume`."""
        self.halted = True
        self.hold()

    def resume(self) -> None:
        """Follow goals again, from rest at the present position."""
        self.halted = False
        self.hold()

    def plan(self) -> None:
        """Start the profile to the goal of the present mode from the motion of the running one."""
        s = self.settings
        x, v = self.target
        if s.mode == VELOCITY_MODE:
            if s.time_based:
                ramp = profile.ramp_to(x, v, s.velocity_goal, duration=s.profile_acceleration)
            else:
                ramp = profile.ramp_to(x, v, s.velocity_goal, acceleration=s.profile_acceleration or inf)
            self._start(ramp)
        elif s.mode in POSITION_MODES:
            if s.time_based:
                self._start(
                    profile.timed(
                        x, v, s.position_goal, duration=s.profile_velocity, ramp=s.profile_acceleration
                    )
                )
            else:
                speed, acceleration = s.profile_velocity or inf, s.profile_acceleration or inf
                self._start(profile.trapezoid(x, v, s.position_goal, speed=speed, acceleration=acceleration))

    def _start(self, trajectory: profile.Profile) -> None:
        self.trajectory, self.elapsed = trajectory, 0.0

    def step(self) -> None:
        """Advance one control period."""
        motor = self.motor
        self.elapsed += PERIOD
        velocity = self.velocity
        if self.settings.torque:
            self.pwm = self._control(velocity)
            steady = (self.pwm * self.voltage - motor.ke * velocity) / motor.resistance
            self.current = steady + (self.current - steady) * self._decay
        else:
            self.pwm = self.current = 0.0
        torque = self._sign * motor.kt * self.current
        self.shaft, self.shaft_velocity = self.plant.step(PERIOD, torque)

    def warm(self, dt: float) -> None:
        """Advance voltage and temperature, which are slow, by `dt` seconds."""
        motor = self.motor
        self.voltage = self.supply - motor.line_resistance * abs(self.pwm * self.current)
        rise = motor.heating * (self.current / motor.stall_current) ** 2
        share = -(exp(-dt / motor.thermal_time) - 1.0)
        self.temperature += (self.ambient + rise - self.temperature) * share

    def _control(self, velocity: float) -> float:
        """PWM ratio for this period."""
        s, motor = self.settings, self.motor
        if s.mode in POSITION_MODES:
            limit = abs(s.pwm_goal)
            x, _ = self.target
            error = x - self.position
            p, i, d = s.position_gains
            self._integral = _clamp(self._integral + i * error * PERIOD, limit)
            slope = (error - self._error) / PERIOD
            self._error = error
            pwm = _clamp(p * error + self._integral + d * slope, limit)
            return self._limit_current(pwm, velocity) if s.mode == CURRENT_POSITION_MODE else pwm
        if s.mode == VELOCITY_MODE:
            limit = abs(s.pwm_goal)
            error = self.target[1] - velocity
            p, i = s.velocity_gains
            self._integral = _clamp(self._integral + i * error * PERIOD, limit)
            return _clamp(p * error + self._integral, limit)
        if self.halted:
            return 0.0
        if s.mode == CURRENT_MODE:
            voltage = motor.resistance * s.current_goal + motor.ke * velocity
            return _clamp(voltage / self.voltage, abs(s.pwm_goal)) if self.voltage else 0.0
        return s.pwm_goal

    def _limit_current(self, pwm: float, velocity: float) -> float:
        """PWM at which the steady current stays within the goal current."""
        if not self.voltage:
            return 0.0
        emf, reach = self.motor.ke * velocity, self.motor.resistance * abs(self.settings.current_goal)
        return _clamp(min(max(pwm * self.voltage, emf - reach), emf + reach) / self.voltage, 1.0)


def _clamp(value: float, limit: float) -> float:
    return -limit if value < -limit else limit if value > limit else value


def within_one_turn(angle: float) -> float:
    """Same shaft angle in [-pi, pi): 0 to 4095 counts."""
    return (angle + pi) % (2 * pi) - pi
