"""What differs between the servo models: factory values, ranges and units, each with its manual page.

Values were read from the sources of the ROBOTIS e-manual (github.com/ROBOTIS-GIT/emanual, docs/en/dxl/),
which are the pages cited. `velocity=None`: no version of the page with the present velocity limit was at
hand (older ones state higher limits, from before the limits were revised), so the default is left open.
Startup Configuration and Backup Ready are rows where a page lists them; the page of xl330-m077 at hand is
older than those of its family and was completed from them.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache
from types import MappingProxyType

from ..registers import BAUD_RATES, ControlTable, IndirectBlock, Register
from . import rows

MANUAL = "https://emanual.robotis.com/docs/en/dxl/"


@dataclass(frozen=True)
class Model:
    """Factory values of one model; voltages in 0.1 V, velocities in counts, gains as raw counts."""

    number: int
    page: str
    temperature: int
    voltage: tuple[int, int]  # least and greatest, both default and range
    velocity: int | None  # None: no source
    velocity_gains: tuple[int, int]  # I, P
    position_gains: tuple[int, int, int]  # D, I, P
    current: tuple[int, float] | None = None  # limit in counts, ampere per count
    shutdown: int = 52
    pwm_slope: tuple[int, float] | None = None
    velocity_range: int = 1023
    lowest_voltage: int | None = None  # least value that the voltage limits accept, when not voltage[0]
    small: bool = False  # the 330 body: fewer indirect registers, no 4.5 Mbit/s
    mx: bool = False
    external_ports: bool = False
    recent: bool = False  # page lists startup configuration and backup ready


def _x330(number: int, page: str, **values: object) -> Model:
    common: dict[str, object] = {"temperature": 70, "velocity_range": 2047, "small": True, "recent": True}
    return Model(number, f"x/{page}/", **(common | values))  # type: ignore[arg-type]


def _x(number: int, page: str, **values: object) -> Model:
    common: dict[str, object] = {
        "temperature": 80,
        "voltage": (95, 160),
        "velocity_gains": (1920, 100),
        "position_gains": (0, 0, 800),
    }
    folder = "mx" if values.get("mx") else "x"
    return Model(number, f"{folder}/{page}/", **(common | values))  # type: ignore[arg-type]


_M, _T = 1.977, 3.955  # V/s per count of the PWM slope: 5 V and 12 V models
_mA = 1e-3

MODELS: Mapping[str, Model] = MappingProxyType(
    {
        "xl330-m077": _x330(
            1190, "xl330-m077", voltage=(35, 70), lowest_voltage=31, velocity=1620, velocity_gains=(400, 40),
            position_gains=(0, 400, 400), current=(1750, _mA), shutdown=53, pwm_slope=(140, _M),
        ),
        "xl330-m288": _x330(
            1200, "xl330-m288", voltage=(35, 70), lowest_voltage=31, velocity=445, velocity_gains=(1600, 180),
            position_gains=(0, 0, 400), current=(1750, _mA), shutdown=53, pwm_slope=(140, _M),
        ),
        "xc330-t181": _x330(
            1210, "xc330-t181", voltage=(55, 140), velocity=510, velocity_gains=(1200, 40),
            position_gains=(0, 0, 900), current=(910, _mA), pwm_slope=(255, _T),
        ),
        "xc330-t288": _x330(
            1220, "xc330-t288", voltage=(55, 140), velocity=320, velocity_gains=(1200, 40),
            position_gains=(0, 0, 900), current=(910, _mA), pwm_slope=(255, _T),
        ),
        "xc330-m181": _x330(
            1230, "xc330-m181", voltage=(35, 70), lowest_voltage=31, velocity=545, velocity_gains=(1400, 100),
            position_gains=(500, 0, 1200), current=(2352, _mA), pwm_slope=(140, _M),
        ),
        "xc330-m288": _x330(
            1240, "xc330-m288", voltage=(35, 70), lowest_voltage=31, velocity=350, velocity_gains=(1600, 50),
            position_gains=(500, 0, 1100), current=(2352, _mA), pwm_slope=(140, _M),
        ),
        "xl430-w250": _x(
            1060, "xl430-w250", temperature=72, voltage=(60, 140), velocity=265, velocity_gains=(1000, 100),
            position_gains=(4000, 0, 640), recent=True,
        ),
        "xc430-w150": _x(1070, "xc430-w150", voltage=(60, 160), velocity=460, position_gains=(0, 0, 460)),
        "xc430-w240": _x(1080, "xc430-w240", voltage=(60, 160), velocity=306, position_gains=(0, 0, 700)),
        "xm430-w350": _x(1020, "xm430-w350", velocity=200, current=(1193, 2.69 * _mA)),
        "xm430-w210": _x(1030, "xm430-w210", velocity=330, current=(1193, 2.69 * _mA)),
        "xm540-w270": _x(1120, "xm540-w270", velocity=128, current=(2047, 2.69 * _mA), external_ports=True),
        "xm540-w150": _x(1130, "xm540-w150", velocity=230, current=(2047, 2.69 * _mA), external_ports=True),
        "xh430-w350": _x(
            1000, "xh430-w350", velocity=130, position_gains=(0, 0, 900), current=(648, 2.69 * _mA)
        ),
        "xh430-w210": _x(
            1010, "xh430-w210", velocity=210, position_gains=(0, 0, 900), current=(648, 2.69 * _mA)
        ),
        "xh430-v350": _x(1040, "xh430-v350", voltage=(110, 300), velocity=135, current=(689, 1.34 * _mA)),
        "xh430-v210": _x(1050, "xh430-v210", voltage=(110, 300), velocity=None, current=(689, 1.34 * _mA)),
        "mx-28": _x(30, "mx-28-2", velocity=230, position_gains=(0, 0, 850), mx=True),
        "mx-64": _x(
            311, "mx-64-2", velocity=None, position_gains=(0, 0, 850), current=(1941, 3.36 * _mA), mx=True
        ),
        "mx-106": _x(
            321, "mx-106-2", velocity=None, position_gains=(0, 0, 850), current=(2047, 3.36 * _mA), mx=True
        ),
    }
)  # fmt: skip

_SMALL_INDIRECT = (IndirectBlock(1, 168, 208, 20),)
_LARGE_INDIRECT = (IndirectBlock(1, 168, 224, 28), IndirectBlock(29, 578, 634, 28))

_WITH_CURRENT, _WITHOUT_CURRENT = frozenset({0, 1, 3, 4, 5, 16}), frozenset({1, 3, 4, 16})


def _particular(model: Model) -> dict[str, dict[str, int | None]]:
    """Fields of common rows that this model fills in or changes."""
    low, high = model.voltage
    least = model.lowest_voltage or low
    d_gain, i_gain, p_gain = model.position_gains
    changes: dict[str, dict[str, int | None]] = {
        "model_number": {"default": model.number},
        "temperature_limit": {"default": model.temperature},
        "max_voltage_limit": {"default": high, "minimum": least, "maximum": high},
        "min_voltage_limit": {"default": low, "minimum": least, "maximum": high},
        "velocity_limit": {"default": model.velocity, "maximum": model.velocity_range},
        "shutdown": {"default": model.shutdown},
        "velocity_i_gain": {"default": model.velocity_gains[0]},
        "velocity_p_gain": {"default": model.velocity_gains[1]},
        "position_d_gain": {"default": d_gain},
        "position_i_gain": {"default": i_gain},
        "position_p_gain": {"default": p_gain},
    }
    if model.small:
        changes["baud_rate"] = {"maximum": 6}
        changes["protocol_type"] = {"minimum": 2, "maximum": 22}
    if model.mx:
        changes["drive_mode"] = {"maximum": 7}
    if model.current:
        changes["current_limit"] = {"default": model.current[0], "maximum": model.current[0]}
    return changes


@cache
def build(name: str) -> ControlTable:
    """Control table of a model, its rows in order of address."""
    model = MODELS[name]
    indirect = _SMALL_INDIRECT if model.small else _LARGE_INDIRECT
    last = max(block.data + block.count - 1 for block in indirect)
    parts: list[Register] = list(rows.COMMON)
    parts += rows.current_rows(model.current[1]) if model.current else rows.LOAD
    if model.pwm_slope:
        parts.append(rows.pwm_slope(model.pwm_slope[1], model.pwm_slope[0]))
    if model.mx:
        parts.append(rows.ACCELERATION_LIMIT)
    if model.recent:
        parts += [rows.STARTUP, rows.BACKUP_READY]
    if model.external_ports:
        parts += rows.EXTERNAL_PORTS
    for block in indirect:
        parts += rows.indirect_rows(block, 64, last)
    changes = _particular(model)
    table = [replace(r, **changes.get(r.name, {})) for r in parts]  # type: ignore[arg-type]
    table.sort(key=lambda r: r.address)
    top = 6 if model.small else 7
    return ControlTable(
        model=name,
        number=model.number,
        page=MANUAL + model.page,
        registers=tuple(table),
        bauds=MappingProxyType({k: v for k, v in BAUD_RATES.items() if k <= top}),
        modes=_WITH_CURRENT if model.current else _WITHOUT_CURRENT,
        indirect=indirect,
        fast_read_firmware=None if model.mx else (46 if model.small else 45),
        unsourced=frozenset({"velocity_limit"} if model.velocity is None else ()),
    )
