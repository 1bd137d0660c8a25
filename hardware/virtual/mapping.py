"""Between registers and drive: what the registers ask of it, and what they report of it."""

from __future__ import annotations

from math import inf, pi

from ..tables.rows import ACCELERATION, CENTRE, POSITION, PWM, VELOCITY
from .drive import POSITION_MODES, Drive, Settings, position_gains, velocity_gains
from .memory import Memory

IN_POSITION = 20  # counts: the threshold that the SDK's examples call arrived
FOLLOWING_ERROR = pi / 18  # rad; the manual gives no value
MOVING, ARRIVED, ONGOING, BEHIND = 0x01, 0x01, 0x02, 0x08


def counts(angle: float) -> int:
    """Position count of a reported angle [rad]."""
    return round(angle / POSITION) + CENTRE


def settings(memory: Memory, *, reverse: bool) -> Settings:
    """Registers as settings of the drive, in SI. A change of the reverse mode is the servo's business."""
    get, table = memory.get, memory.table
    timed = bool(get("drive_mode") & 4)
    speed, acceleration = get("profile_velocity"), get("profile_acceleration")
    if not timed:  # manual: Velocity Limit bounds Profile Velocity too
        speed = min(speed, get("velocity_limit"))
    return Settings(
        mode=get("operating_mode"),
        torque=bool(get("torque_enable")),
        reverse=reverse,
        time_based=timed,
        position_gains=position_gains(get("position_p_gain"), get("position_i_gain"), get("position_d_gain")),
        velocity_gains=velocity_gains(get("velocity_p_gain"), get("velocity_i_gain")),
        pwm_goal=get("goal_pwm") * PWM,
        current_goal=get("goal_current") * table["goal_current"].scale if table.has_current else inf,
        velocity_goal=get("goal_velocity") * VELOCITY,
        position_goal=(get("goal_position") - CENTRE) * POSITION,
        profile_velocity=speed * 1e-3 if timed else speed * VELOCITY,
        profile_acceleration=acceleration * 1e-3 if timed else acceleration * ACCELERATION,
    )


def report(memory: Memory, drive: Drive, time: float) -> None:
    """Bring the read-only registers up to date."""
    put, table = memory.put, memory.table
    target, target_velocity = drive.target
    put("realtime_tick", round(time * 1000) % 32_768)
    put("present_position", counts(drive.position))
    put("present_velocity", round(drive.velocity / VELOCITY))
    put("position_trajectory", counts(target))
    put("velocity_trajectory", round(target_velocity / VELOCITY))
    put("present_pwm", round(drive.pwm / PWM))
    put("present_input_voltage", round(drive.voltage * 10))
    put("present_temperature", round(drive.temperature))
    if table.has_current:
        put("present_current", round(drive.current / table["present_current"].scale))
    else:
        put("present_load", round(1000 * drive.current / drive.motor.stall_current))
    _report_moving(memory, drive)


def _report_moving(memory: Memory, drive: Drive) -> None:
    s = drive.settings
    following = s.torque and s.mode in POSITION_MODES
    ongoing = following and drive.elapsed < drive.trajectory.duration
    moves = abs(drive.velocity) > memory.get("moving_threshold") * VELOCITY
    memory.put("moving", MOVING if ongoing or moves else 0)
    value = 0
    if following:
        value = drive.trajectory.kind | (ONGOING if ongoing else 0)
        value |= ARRIVED if abs(memory.get("goal_position") - counts(drive.position)) <= IN_POSITION else 0
        value |= BEHIND if abs(drive.target[0] - drive.position) > FOLLOWING_ERROR else 0
    memory.put("moving_status", value)
