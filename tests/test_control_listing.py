"""What users can find: laws and their words, sweeps as they mean them, scripts without a guard."""

import inspect
import json
import subprocess
import sys

import numpy as np
import pytest
from pantograph.controllers import cli, tables
from pantograph.controllers.experiments import Spread, compare, disturbances
from pantograph.controllers.listing import laws
from pantograph.controllers.reality import Loop
from pantograph.controllers.trial import Disturbance, disturbed
from pantograph.sim import PantographError, Scene, make_plan
from pantograph.sim.cli.app import app
from pantograph.sim.compose import LAWS, known_words, make_law
from pantograph.sim.control import Target
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
    for word in (
        "computed-torque",
        "backlash",
        "horizon",
        "repeats",
        "rad/s",
        "degrees for hinges",
        "joints that are not named",
    ):
        assert word in result.output


def test_the_schema_of_scenes_names_the_laws():
    schema = json.loads(CliRunner().invoke(app, ["schema"]).output)
    assert set(schema["$defs"]["ControllerItem"]["properties"]["law"]["enum"]) == set(LAWS)


TWO = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".05" pos=".3 0 0" mass="2"/>
  <body pos=".3 0 0"><joint name="b" axis="0 1 0"/><geom size=".03" pos=".2 0 .1" mass="1"/></body></body>
  </worldbody><actuator><motor joint="a" ctrlrange="-9 9"/><motor joint="b" ctrlrange="-3 3"/></actuator>
</mujoco>"""
NEEDED = {"stiction": {"friction": 1.0}, "push": {"observer": "kalman"}}


@pytest.fixture
def two(tmp_path):
    """Two driven joints that are not alike."""
    (tmp_path / "two.xml").write_text(TWO)
    models = [{"file": str(tmp_path / "two.xml")}]
    keys = [{"joint": name, "times": [0, 0.5], "values": [0.1, 0.3]} for name in "ab"]
    roles = {"tracked": ["a", "b"]}
    return make_plan(Scene(duration=0.5, models=models, keys=keys, roles=roles)).problem


def answers(problem, law, words):
    """What a law makes of three states, and what its joints lose there."""
    made, out = make_law(law, problem, words), []
    memory = made.start()
    for k, v in enumerate(([0.0, 0.01], [0.3, -0.005], [0.004, 1.0])):
        t, v = 0.002 * k, np.array(v)
        tau, memory = made(t, np.array([0.2, -0.1 * k]), v, Target(*problem.clip.evaluate(t)), memory)
        out.append(tau if getattr(made, "lost", None) is None else tau + made.lost(v))
    return np.array(out)


@pytest.mark.parametrize(
    ("law", "word"), [("pd", "kp"), ("pd", "kd"), ("pid", "kp"), ("pid", "ki"), ("pid", "kd")]
)
def test_joints_that_are_not_named_keep_the_gain_that_the_law_gives_them(two, law, word):
    own = getattr(make_law(law, two, {}), word)
    np.testing.assert_allclose(getattr(make_law(law, two, {word: {"a": 7.0}}), word), [7.0, own[1]])
    np.testing.assert_allclose(getattr(make_law(law, two, {word: {"b": 7.0}}), word), [own[0], 7.0])
    np.testing.assert_allclose(getattr(make_law(law, two, {word: {"": 5.0, "b": 7.0}}), word), [5.0, 7.0])
    assert own.min() > 0
    assert own[0] != own[1]


@pytest.mark.parametrize("law", ["lqr", "mpc", "nmpc"])
def test_joints_that_are_not_named_keep_the_weight_of_their_force(two, law):
    """One over the square of what the drives give: 9 and 3 N m."""
    np.testing.assert_allclose(answers(two, law, {"force": {"a": 1 / 81}}), answers(two, law, {}))
    np.testing.assert_allclose(answers(two, law, {"force": {"b": 1 / 9}}), answers(two, law, {}))
    assert np.abs(answers(two, law, {"force": {"b": 1.0}}) - answers(two, law, {})).max() > 1e-3


def numbered():
    """Laws of several driven joints and their words that are one number for all of these, or one a joint,
    with their defaults."""
    for name, find in (*LAWS.items(), ("sensors and drives", lambda: Loop)):
        if name == "swing-up":
            continue
        for p in inspect.signature(find()).parameters.values():
            if p.kind == p.KEYWORD_ONLY and "Gain" in str(p.annotation) and isinstance(p.default, float):
                yield name, p.name, p.default


@pytest.mark.parametrize(("law", "word", "default"), list(numbered()))
def test_naming_a_joint_leaves_the_others_at_the_default(two, law, word, default):
    law, more = ("pd", NEEDED.get(word, {})) if law == "sensors and drives" else (law, {})
    same = [answers(two, law, {word: value, **more}) for value in (default, {"a": default}, {"b": default})]
    np.testing.assert_array_equal(same[1], same[0])
    np.testing.assert_array_equal(same[2], same[0])


def test_noise_of_joints_that_are_not_named_is_what_their_encoders_round_away(two):
    loop = [
        make_law("pd", two, {"observer": "kalman", "encoder": 1000, **more})
        for more in ({}, {"noise": {"a": 0.01}})
    ]
    own, named = (x.observer.noise for x in loop)
    np.testing.assert_array_equal(named, [0.01, own[1]])


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
    rough, m = disturbed(problem, Disturbance(friction=tuple(rubs))).model, problem.model
    assert m.dof_damping.any() or m.dof_frictionloss.any()
    np.testing.assert_allclose(rough.dof_damping, rubs * m.dof_damping)
    np.testing.assert_allclose(rough.dof_frictionloss, rubs * m.dof_frictionloss)
    np.testing.assert_array_equal(rough.body_mass, m.body_mass)
    drawn = disturbances(make_plan(Scene(**SWINGING)), Spread(60, friction=0.5, seed=5))
    same = disturbances(make_plan(Scene(**SWINGING)), Spread(1, seed=5))
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
