"""Control tables against the `.model` files of the dynamixel-sdk wheel, and laws of the conversions."""

from importlib.resources import files
from math import pi

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pantograph.hardware.errors import RegisterError
from pantograph.hardware.registers import Register, control_table, model_names
from pantograph.hardware.tables.wheel import DISAGREEMENTS

MODELS = model_names()
ALIASES = {
    "indirect_address_write": "indirect_address_1",
    "indirect_data_write": "indirect_data_1",
}
ROWS = [r for m in MODELS for r in control_table(m).registers]


def alias(name: str, model: str) -> str:
    """Row that a name of the wheel stands for: `read` is entry 7 of the small models, 29 of the others."""
    second = "7" if control_table(model).size == 228 else "29"
    return ALIASES.get(name, name.replace("_read", f"_{second}") if name.startswith("indirect") else name)


def wheel(model: str) -> tuple[dict[str, tuple[int, int]], dict[str, tuple[float, str, str]], int]:
    """Rows (address, size), units (value, unit, sign) and zero position of a model in the SDK's wheel."""
    folder = files("dynamixel_easy_sdk") / "control_table"
    listing = (folder / "dynamixel.model").read_text().split()
    number = str(control_table(model).number)
    text = (folder / listing[listing.index(number) + 1]).read_text()
    rows, units, zero, part = {}, {}, 0, ""
    for line in text.splitlines():
        cells = line.strip().split("\t")
        if line.startswith("["):
            part = line
        elif part == "[control table]" and cells[0].isdigit():
            name = cells[2].lower().replace("(shadow)", "").replace(" ", "_")
            rows[alias(name, model)] = (int(cells[0]), int(cells[1]))
        elif part == "[unit info]" and len(cells) == 4 and cells[1] != "value":
            units[cells[0].lower().replace(" ", "_")] = (float(cells[1]), cells[2], cells[3])
        elif cells[0] == "value_of_zero_radian_position":
            zero = int(cells[1])
    return rows, units, zero


def differences(model: str) -> set[tuple[str, str, str]]:
    """(Register, field, wheel's value) wherever the wheel says something else than the row."""
    table = control_table(model)
    rows, units, _ = wheel(model)
    found = set()
    for name, (address, size) in rows.items():
        assert name in table, f"{model}: the wheel has {name}, the table not"
        if table[name].address != address:
            found.add((name, "address", str(address)))
        assert table[name].size == size
    for r in table.registers:
        if r.name not in rows and not r.name.startswith("indirect_"):
            found.add((r.name, "row", "absent"))
    for name, (value, unit, sign) in units.items():
        assert table[name].signed == (sign == "signed")
        if (table[name].scale, table[name].unit) != (value, unit):
            found.add((name, "unit", f"{value} {unit}"))
    return found


@pytest.mark.parametrize("model", MODELS)
def test_rows_match_the_sdk_except_where_listed(model):
    listed = {
        (name, d.field, d.wheel)
        for d in DISAGREEMENTS
        if model.startswith(d.models) and d.decided == "manual"
        for name in d.registers
        if name in control_table(model) or d.field == "row"
    }
    assert differences(model) == listed
    assert wheel(model)[2] == control_table(model)["present_position"].zero


@pytest.mark.parametrize("entry", DISAGREEMENTS, ids=lambda d: f"{d.models[0]}-{d.registers[0]}")
def test_every_listed_disagreement_is_real(entry):
    """An entry decided for the wheel carries its value, one for the manual differs from the wheel."""
    for model in (m for m in MODELS if m.startswith(entry.models)):
        for name in entry.registers:
            if name not in control_table(model):
                continue
            seen = any(d[0] == name and d[1] == entry.field for d in differences(model))
            assert seen == (entry.decided == "manual"), (model, name)


def test_velocity_unit_rounds_to_the_manuals():
    rpm = control_table("xm430-w350")["goal_velocity"].scale * 60 / (2 * pi)
    assert round(rpm, 3) == 0.229


@pytest.mark.parametrize("model", MODELS)
def test_rows_do_not_overlap_and_defaults_fit(model):
    table = control_table(model)
    end = 0
    for r in table.registers:
        assert r.address >= end, r.name
        end = r.address + r.size
        low, high = r.span
        for value in (r.default, r.minimum, r.maximum):
            assert value is None or low <= value <= high, r.name
        if r.default is not None and r.minimum is not None and r.name != "secondary_id":
            assert r.minimum <= r.default, r.name
        if r.default is not None and r.maximum is not None:
            assert r.default <= r.maximum, r.name
        for name in r.bound or ():
            assert name.removeprefix("-") in table
    assert len({r.name for r in table.registers}) == len(table.registers)
    assert control_table(table.number) is table
    assert table.page.startswith("https://emanual.robotis.com/docs/en/dxl/")
    for block in table.indirect:
        for i in range(block.count):
            assert table[f"indirect_address_{block.first + i}"].default == block.data + i


def test_notes_of_three_models():
    """Factory values that the project's notes state independently."""
    expected = {
        "xl330-m288": (1200, 70, 70, 35, 1750, 445, 53, 0, 0, 400),
        "xl430-w250": (1060, 72, 140, 60, None, 265, 52, 4000, 0, 640),
        "xm430-w350": (1020, 80, 160, 95, 1193, 200, 52, 0, 0, 800),
    }
    names = (
        "model_number", "temperature_limit", "max_voltage_limit", "min_voltage_limit", "current_limit",
        "velocity_limit", "shutdown", "position_d_gain", "position_i_gain", "position_p_gain",
    )  # fmt: skip
    for model, values in expected.items():
        table = control_table(model)
        assert tuple(table[n].default if n in table else None for n in names) == values


def test_open_defaults_are_named():
    for model in MODELS:
        table = control_table(model)
        unsourced = {
            n for n in ("velocity_limit", "temperature_limit", "shutdown") if table[n].default is None
        }
        assert unsourced == table.unsourced


@given(st.sampled_from(ROWS), st.data())
def test_counts_survive_bytes_and_si(r: Register, data):
    low, high = r.span
    raw = data.draw(st.integers(low, high))
    assert r.decode(r.encode(raw)) == raw
    assert r.sign(int.from_bytes(r.encode(raw), "little")) == raw
    assert r.from_si(r.to_si(raw)) == raw


@given(st.sampled_from(ROWS), st.integers(1, 1 << 40))
def test_values_beyond_the_bytes_are_refused(r: Register, excess):
    low, high = r.span
    for raw in (low - excess, high + excess):
        with pytest.raises(RegisterError, match=r.name):
            r.encode(raw)
        with pytest.raises(RegisterError, match=r.name):
            r.from_si(r.to_si(raw))


def test_known_values_in_si():
    t = control_table("xm430-w350")
    assert t["present_position"].to_si(2048) == 0
    assert t["present_position"].to_si(2048 + 1024) == pytest.approx(pi / 2)
    assert t["goal_current"].to_si(100) == pytest.approx(0.269)
    assert t["profile_acceleration"].to_si(1) == pytest.approx(214.577 * 2 * pi / 3600)
    assert t["profile_velocity"].time_based().to_si(1500) == pytest.approx(1.5)
    assert t["return_delay_time"].to_si(250) == pytest.approx(500e-6)
    assert t["bus_watchdog"].to_si(5) == pytest.approx(0.1)
    assert t["present_input_voltage"].to_si(120) == pytest.approx(12.0)
    assert t["goal_pwm"].to_si(885) == pytest.approx(1.0)


def test_messages_name_the_register_and_what_exists():
    with pytest.raises(
        RegisterError, match=r"'goal_positon'.*did you mean 'goal_position'.*xl430-w250 has: .*led"
    ):
        control_table("xl430-w250")["goal_positon"]
    with pytest.raises(RegisterError, match="goal_current"):
        control_table("xl430-w250")["goal_current"]
    with pytest.raises(RegisterError, match=r"'xm430-350'.*did you mean 'xm430-w350'"):
        control_table("xm430-350")
    with pytest.raises(RegisterError, match=r"999.*1020 xm430-w350"):
        control_table(999)
    with pytest.raises(RegisterError, match="has 4 bytes, got 2"):
        control_table("xl430-w250")["goal_position"].decode(b"\0\0")
