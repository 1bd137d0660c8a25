"""Velocity profiles of the servo: closed-form, piecewise constant acceleration from here to the goal.

Source: e-manual, Profile Acceleration (108) and Profile Velocity (112), "What is the Profile": step,
    rectangular, triangular and trapezoidal, with velocity override (a new goal starts from the velocity of
    the running profile). Units are the caller's, any length and second; Pantograph uses rad.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, sqrt

STEP, RECTANGULAR, TRIANGULAR, TRAPEZOIDAL = 0x00, 0x10, 0x20, 0x30  # bits 5:4 of moving_status


@dataclass(frozen=True, slots=True)
class Segment:
    """Constant acceleration from (x, v) for `duration` seconds."""

    duration: float
    x: float
    v: float
    a: float


@dataclass(frozen=True, slots=True)
class Profile:
    """A trajectory that ends at rest (position) or at a constant velocity.

    Args:
        segments: In order of time.
        goal: Position after the last segment.
        final_velocity: Velocity after the last segment; zero for a position profile.
        kind: Bits 5:4 of the moving_status register.
    """

    segments: tuple[Segment, ...]
    goal: float
    final_velocity: float
    kind: int

    @property
    def duration(self) -> float:
        """Seconds from the first segment to the last."""
        return sum(s.duration for s in self.segments)

    def at(self, t: float) -> tuple[float, float]:
        """Position and velocity, `t` seconds after the start."""
        for s in self.segments:
            if t < s.duration:
                return s.x + t * (s.v + 0.5 * s.a * t), s.v + s.a * t
            t -= s.duration
        return self.goal + self.final_velocity * t, self.final_velocity


def step(goal: float) -> Profile:
    """Profile velocity 0: the goal at once."""
    return Profile((), goal, 0.0, STEP)


def trapezoid(x: float, v: float, goal: float, *, speed: float = inf, acceleration: float = inf) -> Profile:
    """Fastest motion from (x, v) to rest at the goal within a speed and an acceleration, both positive.

    An infinite speed is a step, an infinite acceleration a rectangular profile. A start too fast, or in the
    wrong direction, brakes first.
    """
    if speed == inf:
        return step(goal)
    if acceleration == inf:
        distance = goal - x
        segment = Segment(abs(distance) / speed, x, speed if distance > 0 else -speed, 0.0)
        return Profile((segment,) if distance else (), goal, 0.0, RECTANGULAR)
    brake = v * abs(v) / (2 * acceleration)  # way to rest from v
    sign = 1.0 if goal - x - brake >= 0 else -1.0
    # In the direction of the motion, with u = sign * v: accelerate to the peak, cruise, brake.
    way, u = sign * (goal - x), sign * v
    peak = sqrt(max(acceleration * way + 0.5 * u * u, 0.0))
    kind = TRIANGULAR if peak <= speed else TRAPEZOIDAL
    peak = min(peak, speed)
    change = acceleration if peak >= u else -acceleration
    up = abs(peak - u) / acceleration
    down = peak / acceleration
    cruise_way = way - 0.5 * (u + peak) * up - 0.5 * peak * down
    cruise = max(cruise_way, 0.0) / peak if peak > 0 else 0.0
    return Profile(
        _chain(x, v, ((up, sign * change), (cruise, 0.0), (down, -sign * acceleration))), goal, 0.0, kind
    )


def timed(x: float, v: float, goal: float, *, duration: float, ramp: float) -> Profile:
    """Time-based profile: arrive after `duration` seconds, of which `ramp` to speed up and to slow down.

    The ramp is at most half of the duration (manual). From rest the peak speed is way / (duration - ramp);
    from a velocity v the first ramp leads from v to the peak.
    """
    if duration <= 0:
        return step(goal)
    ramp = min(ramp, duration / 2)
    if ramp == 0:
        segment = Segment(duration, x, (goal - x) / duration, 0.0)
        return Profile((segment,), goal, 0.0, RECTANGULAR)
    peak = (goal - x - 0.5 * v * ramp) / (duration - ramp)
    parts = ((ramp, (peak - v) / ramp), (duration - 2 * ramp, 0.0), (ramp, -peak / ramp))
    return Profile(_chain(x, v, parts), goal, 0.0, TRIANGULAR if 2 * ramp >= duration else TRAPEZOIDAL)


def ramp_to(
    x: float, v: float, target: float, *, acceleration: float = inf, duration: float = 0.0
) -> Profile:
    """Velocity mode: change to the target velocity with an acceleration, or within a duration if given."""
    if duration > 0:
        acceleration = abs(target - v) / duration or inf
    if acceleration == inf or target == v:
        return Profile((), x, target, STEP)
    time = abs(target - v) / acceleration
    segment = Segment(time, x, v, acceleration if target > v else -acceleration)
    return Profile((segment,), x + 0.5 * (v + target) * time, target, TRAPEZOIDAL)


def _chain(x: float, v: float, parts: tuple[tuple[float, float], ...]) -> tuple[Segment, ...]:
    """Segments of (duration, acceleration), joined in position and velocity."""
    segments = []
    for duration, a in parts:
        if duration > 0:
            segments.append(Segment(duration, x, v, a))
            x += duration * (v + 0.5 * a * duration)
            v += a * duration
    return tuple(segments)
