"""What users can find: laws and their words, sweeps as they mean them, scripts without a guard."""

import json
import subprocess
import sys

import numpy as np
import pytest
from pantograph.controllers import cli, tables
from pantograph.controllers.experiments import _disturbances, compare
from pantograph.controllers.listing import laws
from pantograph.controllers.trial import Disturbance, _disturbed
from pantograph.sim import PantographError, Scene, make_plan
from pantograph.sim.cli.app import app
from pantograph.sim.compose import LAWS, known_words
from typer.testing import CliRunner

SWINGING = {
    "duration": 0.1,
    "models": [{"file": "pendulum"}],
    "roles": {"tracked": ["hinge"]},
    "keys": [{"joint": "hinge", "times": [0, 0.1], "values": [0, 0.1]}],
    "controller": {"law": "pd", "period": 0.005},
}


def test_every_law_and_word_is_listed():
    entries = {entry.name: entry for entry in laws()}
    assert set(entries) == {*LAWS, "ilc", "sensors and drives"}
    around = [word.name for word in entries["sensors and drives"].words]
    for name in LAWS:
        own = [word.name for word in entries[name].words]
        assert sorted([*own, *around]) == sorted(known_words(name))
        assert entries[name].about
    units = {word.name: word.unit for word in entries["sensors and drives"].words}
    assert (units["delay"], units["corner"], units["top_speed"]) == ("s", "Hz", "rad/s, m/s")
    assert {word.name: word.unit for word in entries["pd"].words}["frequency"] == "Hz"


def test_the_command_lists_laws_without_a_scene():
    result = CliRunner().invoke(app, ["control", "--laws"])
    assert result.exit_code == 0
    for word in ("computed-torque", "backlash", "horizon", "repeats", "rad/s", "degrees for hinges"):
        assert word in result.output


def test_the_schema_of_scenes_names_the_laws():
    schema = json.loads(CliRunner().invoke(app, ["schema"]).output)
    assert set(schema["$defs"]["ControllerItem"]["properties"]["law"]["enum"]) == set(LAWS)


def test_values_of_a_parameter_given_apart_belong_together():
    texts = ["delay=0.004", "frequency=2", "delay=0.01,0.004"]
    assert cli._swept(texts) == {"delay": [0.004, 0.01], "frequency": [2.0]}


def test_the_period_can_be_swept(tmp_path):
    result = compare(Scene(**SWINGING), ["pd"], sweep={"period": [0.002, 0.01]}, processes=1)
    assert [len(result.trials[row.variant.name].t) for row in result.rows] == [50, 10]
    assert [row["period"] for row in tables.summary(result)] == [0.002, 0.01]
    for row in tables.summary(result):
        assert row["tick99_of_period"] == pytest.approx(row["tick99"] / row["period"])
        assert row["tick"] <= row["tick99"] <= row["longest"]
    with pytest.raises(PantographError, match="period must be a positive"):
        compare(Scene(**SWINGING), ["pd"], sweep={"period": [0.0]}, processes=1)


def test_joints_can_rub_otherwise_than_the_law_believes():
    problem = make_plan(Scene(**SWINGING | {"models": [{"file": "arm6"}], "keys": [], "roles": {}})).problem
    rubs = np.linspace(0.5, 1.5, 6)
    rough, m = _disturbed(problem, Disturbance(friction=tuple(rubs))).model, problem.model
    assert m.dof_damping.any() or m.dof_frictionloss.any()
    np.testing.assert_allclose(rough.dof_damping, rubs * m.dof_damping)
    np.testing.assert_allclose(rough.dof_frictionloss, rubs * m.dof_frictionloss)
    np.testing.assert_array_equal(rough.body_mass, m.body_mass)
    drawn = _disturbances(make_plan(Scene(**SWINGING)), 60, 0.1, 0.2, 5, friction=0.5)
    same = _disturbances(make_plan(Scene(**SWINGING)), 1, 0.1, 0.2, 5)
    rubs = np.array([d.friction for d in drawn])
    assert 0.45 < np.abs(rubs - 1).max() <= 0.5
    assert (drawn[0].mass, drawn[0].start) == (same[0].mass, same[0].start)
    assert same[0].friction == ()


def test_a_script_without_a_guard_is_told_and_still_gets_its_answer(tmp_path):
    script = tmp_path / "plain.py"
    script.write_text(
        "from pantograph.sim import Scene\n"
        "from pantograph.controllers.experiments import compare\n"
        f"result = compare(Scene(**{SWINGING!r}), ['pd'], trials=2, processes=2)\n"
        "print('rows', len(result.rows[0].disturbed))\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, timeout=120)
    assert done.returncode == 0
    assert done.stdout == "rows 2\n"
    assert 'put what it does under if __name__ == "__main__"' in done.stderr
