"""Rows that the X-series and MX(2.0) control tables have in common.

Read from the ROBOTIS e-manual, https://emanual.robotis.com/docs/en/dxl/x/ (and mx/), one page a model,
cited in `models.py`. What differs between models is filled in there.
"""

from math import pi
from typing import Any

from ..registers import IndirectBlock, Register

POSITION = 2 * pi / 4096  # rad per count: 4096 counts a turn
CENTRE = 2048  # count of zero radian in the SDK's .model files
VELOCITY = 0.0239691227  # rad/s per count; the manual rounds it to 0.229 rev/min
ACCELERATION = 214.577 * 2 * pi / 3600  # rad/s^2 per count: 214.577 rev/min^2
PWM = 1 / 885  # ratio of the supply voltage: 885 is 100 %

MILLI, MICRO = 1e-3, 1e-6


def _row(
    address: int,
    size: int,
    name: str,
    access: str = "RW",
    default: int | None = 0,
    low: int | None = None,
    high: int | None = None,
    *,
    unit: str = "",
    scale: float = 1.0,
    signed: bool = False,
    bound: tuple[str, str] | None = None,
    zero: int = 0,
) -> Register:
    assert access in ("R", "RW")
    return Register(
        name,
        address,
        size,
        signed,
        unit,
        scale,
        "R" if access == "R" else "RW",
        default,
        low,
        high,
        bound,
        zero,
    )


def _rad(address: int, name: str, access: str, **more: Any) -> Register:
    return _row(address, 4, name, access, unit="rad", scale=POSITION, zero=CENTRE, **more)


def _speed(address: int, name: str, access: str, **more: Any) -> Register:
    return _row(address, 4, name, access, unit="rad/s", scale=VELOCITY, **more)


COMMON: tuple[Register, ...] = (
    _row(0, 2, "model_number", "R", None),
    _row(2, 4, "model_information", "R", None),
    _row(6, 1, "firmware_version", "R", None),
    _row(7, 1, "id", "RW", 1, 0, 252),
    _row(8, 1, "baud_rate", "RW", 1, 0, 7),
    _row(9, 1, "return_delay_time", "RW", 250, 0, 254, unit="s", scale=2 * MICRO),
    _row(10, 1, "drive_mode", "RW", 0, 0, 13),
    _row(11, 1, "operating_mode", "RW", 3, 0, 16),
    _row(12, 1, "secondary_id", "RW", 255, 0, 255),
    _row(13, 1, "protocol_type", "RW", 2, 1, 2),
    _row(20, 4, "homing_offset", "RW", 0, -1_044_479, 1_044_479, unit="rad", scale=POSITION, signed=True),
    _speed(24, "moving_threshold", "RW", default=10, low=0, high=1023),
    _row(31, 1, "temperature_limit", "RW", None, 0, 100, unit="degC"),
    _row(32, 2, "max_voltage_limit", "RW", None, unit="V", scale=0.1),
    _row(34, 2, "min_voltage_limit", "RW", None, unit="V", scale=0.1),
    _row(36, 2, "pwm_limit", "RW", 885, 0, 885, scale=PWM),
    _speed(44, "velocity_limit", "RW", default=None, low=0, high=1023),
    _rad(48, "max_position_limit", "RW", default=4095, low=0, high=4095),
    _rad(52, "min_position_limit", "RW", default=0, low=0, high=4095),
    _row(63, 1, "shutdown", "RW", 52, 0, 255),
    _row(64, 1, "torque_enable", "RW", 0, 0, 1),
    _row(65, 1, "led", "RW", 0, 0, 1),
    _row(68, 1, "status_return_level", "RW", 2, 0, 2),
    _row(69, 1, "registered_instruction", "R", 0),
    _row(70, 1, "hardware_error_status", "R", 0),
    _row(76, 2, "velocity_i_gain", "RW", None, 0, 16_383),
    _row(78, 2, "velocity_p_gain", "RW", None, 0, 16_383),
    _row(80, 2, "position_d_gain", "RW", None, 0, 16_383),
    _row(82, 2, "position_i_gain", "RW", None, 0, 16_383),
    _row(84, 2, "position_p_gain", "RW", None, 0, 16_383),
    _row(88, 2, "feedforward_2nd_gain", "RW", 0, 0, 16_383),
    _row(90, 2, "feedforward_1st_gain", "RW", 0, 0, 16_383),
    _row(98, 1, "bus_watchdog", "RW", 0, 0, 127, unit="s", scale=20 * MILLI, signed=True),  # -1: tripped
    _row(100, 2, "goal_pwm", "RW", None, scale=PWM, signed=True, bound=("-pwm_limit", "pwm_limit")),
    _speed(
        104, "goal_velocity", "RW", default=None, signed=True, bound=("-velocity_limit", "velocity_limit")
    ),
    _row(108, 4, "profile_acceleration", "RW", 0, 0, 32_767, unit="rad/s^2", scale=ACCELERATION),
    _speed(112, "profile_velocity", "RW", default=0, low=0, high=32_767),
    _rad(
        116,
        "goal_position",
        "RW",
        default=None,
        signed=True,
        bound=("min_position_limit", "max_position_limit"),
    ),
    _row(120, 2, "realtime_tick", "R", None, 0, 32_767, unit="s", scale=MILLI),
    _row(122, 1, "moving", "R", 0),
    _row(123, 1, "moving_status", "R", 0),
    _row(124, 2, "present_pwm", "R", None, scale=PWM, signed=True),
    _speed(128, "present_velocity", "R", default=None, signed=True),
    _rad(132, "present_position", "R", default=None, signed=True),
    _speed(136, "velocity_trajectory", "R", default=None, signed=True),
    _rad(140, "position_trajectory", "R", default=None, signed=True),
    _row(144, 2, "present_input_voltage", "R", None, unit="V", scale=0.1),
    _row(146, 1, "present_temperature", "R", None, unit="degC"),
)

LOAD: tuple[Register, ...] = (_row(126, 2, "present_load", "R", None, scale=1e-3, signed=True),)
"""Models without a current sensor: estimated load, ratio of the greatest torque."""

STARTUP = _row(60, 1, "startup_configuration", "RW", 0, 0, 3)
BACKUP_READY = _row(147, 1, "backup_ready", "R", None, 0, 1)

ACCELERATION_LIMIT = _row(
    40, 4, "acceleration_limit", "RW", 32_767, 0, 32_767, unit="rad/s^2", scale=ACCELERATION
)

EXTERNAL_PORTS: tuple[Register, ...] = tuple(
    _row(55 + i, 1, f"external_port_mode_{i}", "RW", 3, 0, 3) for i in (1, 2, 3)
) + tuple(_row(150 + 2 * i, 2, f"external_port_data_{i}", "RW", None) for i in (1, 2, 3))


def current_rows(unit: float) -> tuple[Register, ...]:
    """Rows of a model with a current sensor; `unit` in ampere per count."""
    return (
        _row(38, 2, "current_limit", "RW", None, 0, None, unit="A", scale=unit),
        _row(
            102,
            2,
            "goal_current",
            "RW",
            None,
            unit="A",
            scale=unit,
            signed=True,
            bound=("-current_limit", "current_limit"),
        ),
        _row(126, 2, "present_current", "R", None, unit="A", scale=unit, signed=True),
    )


def pwm_slope(unit: float, default: int) -> Register:
    """Slope of the PWM output; `unit` in volt per second per count (manual: mV/ms)."""
    return _row(62, 1, "pwm_slope", "RW", default, 1, 255, unit="V/s", scale=unit)


def indirect_rows(block: IndirectBlock, low: int, high: int) -> tuple[Register, ...]:
    """Indirect Address n (2 bytes, pointing at a RAM byte in [low, high]) and Indirect Data n (1 byte)."""
    numbers = range(block.count)
    addresses = tuple(
        _row(block.address + 2 * i, 2, f"indirect_address_{block.first + i}", "RW", block.data + i, low, high)
        for i in numbers
    )
    data = tuple(
        _row(block.data + i, 1, f"indirect_data_{block.first + i}", "RW", 0, 0, 255) for i in numbers
    )
    return addresses + data
