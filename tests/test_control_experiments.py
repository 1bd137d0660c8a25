"""Experiments measure what they say, repeat, and are the same on any number of processes."""

import csv
import dataclasses
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import mujoco
import numpy as np
import pytest
from pantograph.controllers import tables
from pantograph.controllers import trial as trials
from pantograph.controllers.cli import control
from pantograph.controllers.experiments import Row, Spread, Variant, compare, disturbances, figure, learning
from pantograph.controllers.experiments import comparison as compared
from pantograph.controllers.gains import force_limits
from pantograph.controllers.judged import judged
from pantograph.controllers.nominal import Nominal
from pantograph.controllers.trial import Disturbance, disturbed, run_trial
from pantograph.sim import PantographError, Scene, make_plan, run
from pantograph.sim.cli.app import app
from pantograph.sim.scene.schema.scene import Initial
from typer.testing import CliRunner

PENDULUM = {
    "duration": 1.0,
    "rate": 500.0,
    "models": [{"file": "planar_2r"}],
    "roles": {"tracked": ["shoulder", "elbow"]},
    "actuators": {"*": "off"},
    "keys": [
        {"joint": "shoulder", "times": [0, 0.5], "values": [0, 1], "curve": "clamped"},
        {"joint": "elbow", "times": [0, 0.5], "values": [0.5, 0], "curve": "clamped"},
    ],
    "controller": {"law": "pd", "period": 0.002, "frequency": 3.0},
}
TIMES = ("build", "tick", "tick99", "longest", "code")


def without_times(figures):
    return {k: v for k, v in dataclasses.asdict(figures).items() if k not in TIMES}


def test_figures_are_those_of_the_recorded_run():
    plan = make_plan(Scene(**PENDULUM))
    trial = run_trial(plan, "pd", {"frequency": 3.0}, Disturbance())
    r = run(plan)
    error = plan.problem.clip.evaluate(r.tick_t).q - r.q[:-1]
    f = trial.figures
    assert f.rms == pytest.approx(np.sqrt(np.mean(error**2)), rel=1e-9)
    assert f.worst == pytest.approx(np.abs(error).max(), rel=1e-9)
    assert f.effort == pytest.approx(np.sqrt(np.mean(np.sum(r.tick_qfrc**2, axis=1))), rel=1e-9)
    power = np.abs(r.tick_qfrc * r.v[:-1]).sum(axis=1)
    assert f.work == pytest.approx(power.sum() * 0.002, rel=1e-9)
    assert f.saturated == 0.0
    assert 0 < f.tick <= f.tick99 < 0.1


@pytest.mark.parametrize("curve", ["clamped", "step"])
def test_settling_and_overshoot_are_of_the_motion_after_the_keys_rest(curve):
    """By their definitions, from the samples; also for keys that jump."""
    keys = [k | {"curve": curve} for k in PENDULUM["keys"]]
    plan = make_plan(Scene(**PENDULUM | {"keys": keys}))
    words = ({"frequency": 1.0, "damping": 0.3}, {"frequency": 8.0, "damping": 0.8})
    slow, fast = (run_trial(plan, "pd", w, Disturbance()) for w in words)
    for trial in (slow, fast):
        rest = trial.t >= 0.5 - 1e-9
        q = np.array([1.0, 0.0]) - np.where(rest[:, None], trial.error, np.nan)
        band = 0.02 * np.array([1.0, 0.5])  # of what the keys ask of shoulder and elbow
        inside = (np.abs(trial.error) <= band).all(axis=1)[rest]
        t, expected = trial.t[rest], np.inf
        if inside[-1]:
            outside = np.flatnonzero(~inside)
            expected = t[outside[-1] + 1] - t[0] if len(outside) else 0.0
        assert trial.figures.settling == pytest.approx(expected, abs=1e-9)
        beyond = np.nanmax((q - [1.0, 0.0]) * [1.0, -1.0] / (band / 0.02))
        assert trial.figures.overshoot == pytest.approx(max(beyond, 0.0), rel=1e-9, abs=1e-12)
    assert slow.figures.settling == np.inf
    assert 0.0 < fast.figures.settling < 0.5
    assert slow.figures.overshoot > 0.01


def test_a_joint_at_rest_is_judged_by_what_the_others_do():
    """It is shaken by them; 2 % of its own error would call it settled only where that has died out."""
    still = PENDULUM["keys"][1] | {"times": [0], "values": [0.5]}
    plan = make_plan(Scene(**PENDULUM | {"keys": [PENDULUM["keys"][0], still]}))
    trial = run_trial(plan, "pd", {"frequency": 8.0}, Disturbance())
    late = trial.t >= 0.5 - 1e-9
    outside = np.flatnonzero((np.abs(trial.error[late]) > 0.02).any(axis=1))
    expected = trial.t[late][outside[-1] + 1] - 0.5 if len(outside) else 0.0
    assert trial.figures.settling == pytest.approx(expected, abs=1e-9)
    own = np.abs(trial.error[:, 1]).max()
    assert 0.0 < own < 0.1
    assert np.abs(trial.error[late, 1]).max() > 0.02 * own


def test_a_start_off_the_keys_is_a_way_to_go_and_nothing_to_do_is_no_settling():
    keys = [k | {"times": [0], "values": [0.3]} for k in PENDULUM["keys"]]
    data = PENDULUM | {"keys": keys, "initial": {"position": {"shoulder": 0.7}}}
    trial = run_trial(make_plan(Scene(**data)), "pd", {"frequency": 5.0}, Disturbance())
    outside = np.flatnonzero((np.abs(trial.error) > 0.02 * 0.4).any(axis=1))
    assert trial.figures.settling == pytest.approx(trial.t[outside[-1] + 1], abs=1e-9)
    still = run_trial(make_plan(Scene(**PENDULUM | {"keys": keys})), "pd", {}, Disturbance())
    assert np.isnan(still.figures.settling)
    assert still.figures.overshoot == 0.0


def test_what_never_rests_does_not_settle():
    trial = run_trial(make_plan(Scene(**PENDULUM | {"duration": 0.4})), "pd", {}, Disturbance())
    assert np.isnan(trial.figures.settling)
    assert trial.figures.overshoot == 0.0


def test_a_drive_at_its_limit_counts_as_saturated():
    data = PENDULUM | {"actuators": {"*": "controller"}, "physics": {"gravity": False}}
    plan = make_plan(Scene(**data))
    low, high = force_limits(plan.problem.model)
    for kp, least, most in ((1e7, 0.9, 1.0), (1.0, 0.0, 0.0), (4 * high.max(), 0.02, 0.9)):
        trial = run_trial(plan, "pd", {"kp": kp, "kd": 0.0}, Disturbance())
        at_limit = ((trial.tau <= low) | (trial.tau >= high)).any(axis=1)
        assert trial.figures.saturated == at_limit.mean()
        assert least <= trial.figures.saturated <= most


def test_what_reality_leaves_of_a_drive_counts_as_saturated():
    """A drive of half its force, and one that is too quick for its motor, are at their limits sooner."""
    data = PENDULUM | {"actuators": {"*": "controller"}, "physics": {"gravity": False}}
    plan = make_plan(Scene(**data))
    words = {"frequency": 1.0}
    free = run_trial(plan, "pd", words, Disturbance())
    most = np.abs(free.tau).max()
    assert free.figures.saturated == 0.0
    share = 0.5 * most / force_limits(plan.problem.model)[1].max()
    cut = run_trial(plan, "pd", words | {"saturation": share}, Disturbance())
    limit = share * force_limits(plan.problem.model)[1]
    assert cut.figures.saturated == (np.abs(cut.tau) >= limit - 1e-12).any(axis=1).mean() > 0.0
    slow = run_trial(plan, "pd", words | {"top_speed": 0.5}, Disturbance())
    assert slow.figures.saturated > 0.05


def test_what_a_law_builds_first_is_no_tick(monkeypatch):
    """Much work for the first call of a law, none for later ones."""
    plan, calls = make_plan(Scene(**PENDULUM)), []

    class Slow:
        def start(self):
            return None

        def __call__(self, t, q, v, target, memory):
            if not calls:
                begun = time.thread_time()
                while time.thread_time() < begun + 0.3:
                    pass
            calls.append(t)
            return np.zeros(2), None

    monkeypatch.setattr(trials, "make_law", lambda *arguments: Slow())
    figures = run_trial(plan, "pd", {}, Disturbance()).figures
    assert figures.build >= 0.3
    assert figures.tick99 < 0.1
    assert len(calls) == 501


def test_a_heavier_machine_has_more_inertia_everywhere():
    problem = make_plan(Scene(**PENDULUM | {"models": [{"file": "arm6"}], "keys": [], "roles": {}})).problem
    q = problem.state0.q + 0.3
    heavy = disturbed(problem, Disturbance(mass=(1.3,) * problem.model.nbody))
    rotors = np.diag(problem.model.dof_armature)
    M, more = (Nominal(p.model).mass_matrix(q) - rotors for p in (problem, heavy))
    np.testing.assert_allclose(more, 1.3 * M, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(
        Nominal(heavy.model).weight(q), 1.3 * Nominal(problem.model).weight(q), rtol=1e-9, atol=1e-12
    )


def test_disturbances_are_as_large_as_asked():
    plan = make_plan(Scene(**PENDULUM | {"actuators": {"*": "controller"}}))
    drawn = disturbances(plan, Spread(60, seed=5))
    mass, push = np.array([d.mass for d in drawn]), np.array([d.push for d in drawn])
    assert 0.09 < np.abs(mass - 1).max() <= 0.1
    part = np.abs(push) / force_limits(plan.problem.model)[1]
    assert (part.max(axis=0) <= 0.2).all()
    assert (part.max(axis=0) > 0.18).all()
    assert all(d.stop - d.start == pytest.approx(0.1) and 0.1 <= d.start <= 0.7 for d in drawn)
    assert len({d.say for d in drawn}) == 60


def test_a_run_that_diverges_is_counted():
    good = run_trial(make_plan(Scene(**PENDULUM)), "pd", {}, Disturbance()).figures
    lost = run_trial(
        make_plan(Scene(**PENDULUM)), "pd", {"kp": 1e9, "kd": 1e7, "delay": 0.02}, Disturbance()
    ).figures
    assert lost.status != "done"
    assert "at t = 0." in lost.message
    assert lost.rms == lost.settling == np.inf
    row = Row(Variant("pd", {}, "pd"), good, (good, lost), 0.002)
    assert row.failed == 1
    assert row.robust == np.inf


def test_the_law_believes_the_machine_that_was_modelled():
    """With a heavier machine the computed torque lacks force; told the truth it would not."""
    plan = make_plan(Scene(**PENDULUM))
    m = plan.problem.model
    heavy = Disturbance(mass=(1.1,) * m.nbody)
    exact, ignorant = (run_trial(plan, "computed-torque", {}, d).figures for d in (Disturbance(), heavy))
    assert ignorant.rms > 100 * exact.rms
    pushed = run_trial(plan, "computed-torque", {}, Disturbance(push=(5.0, 0.0), start=0.2, stop=0.3))
    before = pushed.t < 0.2
    assert np.abs(pushed.error[before]).max() < 1e-4 < np.abs(pushed.error[~before]).max()


def test_the_same_seed_gives_the_same_figures_on_any_number_of_processes():
    one, two = (
        compare(Scene(**PENDULUM), ["pd", "computed-torque"], trials=2, seed=3, processes=n) for n in (1, 2)
    )
    other = compare(Scene(**PENDULUM), ["pd"], trials=2, seed=4, processes=1)
    for a, b in zip(one.rows, two.rows, strict=True):
        assert [without_times(f) for f in a.disturbed] == [without_times(f) for f in b.disturbed]
        assert without_times(a.nominal) == without_times(b.nominal)
        assert a.robust == max(a.nominal.rms, *(f.rms for f in a.disturbed))
    assert other.rows[0].disturbed[0].rms != one.rows[0].disturbed[0].rms
    assert other.rows[0].nominal.rms == one.rows[0].nominal.rms


@pytest.fixture(scope="module")
def swept():
    seen = []
    result = compare(
        Scene(**PENDULUM),
        ["pd", "lqr"],
        sweep={"frequency": [2.0, 8.0], "force": [1.0]},
        trials=1,
        processes=1,
        progress=lambda done, total: seen.append((done, total)),
    )
    return result, seen


def test_a_sweep_varies_what_each_law_has(swept):
    result, seen = swept
    assert seen == [(k + 1, 6) for k in range(6)]
    assert [r.variant.name for r in result.rows] == ["pd frequency=2", "pd frequency=8", "lqr force=1"]
    assert result.rows[1].nominal.rms < 0.2 * result.rows[0].nominal.rms
    direct = run_trial(make_plan(Scene(**PENDULUM)), "pd", {"frequency": 8.0}, Disturbance())
    assert without_times(direct.figures) == without_times(result.rows[1].nominal)
    assert result.trials["pd frequency=8"].error.shape == direct.error.shape
    one, two = (
        compare(Scene(**PENDULUM), ["pd"], sweep={"frequency": [2.0, 8.0]}, processes=n) for n in (1, 2)
    )
    for a, b in zip(one.rows, two.rows, strict=True):
        assert without_times(a.nominal) == without_times(b.nominal)
        np.testing.assert_array_equal(one.trials[a.variant.name].error, two.trials[b.variant.name].error)


def test_tables_hold_every_variant_and_every_run(swept, tmp_path):
    result, _ = swept
    with tables.save(tables.runs(result), tmp_path / "a" / "t.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert len(rows) == 6
    assert [row["disturbance"][:2] for row in rows] == ["as", "#0"] * 3
    assert float(rows[2]["rms"]) == result.rows[1].nominal.rms
    assert float(rows[3]["rms"]) == result.rows[1].disturbed[0].rms
    assert [row["frequency"] for row in rows] == ["2.0"] * 2 + ["8.0"] * 2 + [""] * 2
    with tables.save(tables.summary(result), tmp_path / "s.csv").open() as f:
        rows = list(csv.DictReader(f))
    wanted = "law rms worst effort saturated settling overshoot worst_rms failed tick tick99 tick99_of_period"
    assert set(wanted.split()) <= set(rows[0])
    for row, mine in zip(rows, result.rows, strict=True):
        assert float(row["worst_rms"]) == mine.robust
        assert float(row["tick99_of_period"]) == pytest.approx(mine.nominal.tick99 / 0.002)
    with pytest.raises(PantographError, match="no kind of table 'xls'"):
        tables.save(tables.runs(result), tmp_path / "t.xls")


def test_tables_as_parquet(swept, tmp_path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed")
    rows = tables.runs(swept[0])
    read = parquet.read_table(tables.save(rows, tmp_path / "t.parquet")).to_pylist()
    assert [row["rms"] for row in read] == [row["rms"] for row in rows]
    assert [row["frequency"] for row in read] == [2.0] * 2 + [8.0] * 2 + [None] * 2


def test_parquet_without_its_library_says_what_to_install(swept, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with pytest.raises(PantographError, match=r"pantograph-sim\[parquet\]"):
        tables.save(tables.runs(swept[0]), tmp_path / "t.parquet")


def test_the_picture_shows_every_law(swept, tmp_path):
    """Errors, and what each drive gave, signed, with its limits."""
    result, _ = swept
    chart = figure(result)
    errors, *forces, robust = chart.axes
    assert [text.get_text() for text in chart.legends[0].get_texts()] == [
        row.variant.name for row in result.rows
    ]
    assert [ax.get_title() for ax in forces] == ["force of shoulder", "force of elbow"]
    for i, row in enumerate(result.rows):
        trial = result.trials[row.variant.name]
        size = np.linalg.norm(trial.error, axis=1)
        np.testing.assert_allclose(errors.lines[i].get_ydata(), np.maximum(size, 1e-15))
        for k, ax in enumerate(forces):
            np.testing.assert_array_equal(ax.lines[i].get_ydata(), trial.tau[:, k])
    dots = [float(y) for line in robust.lines for y in line.get_ydata()]
    assert dots == [x for row in result.rows for x in (row.disturbed[0].rms, row.nominal.rms)]
    chart.savefig(tmp_path / "p.png")


def test_sensors_of_the_scene_are_for_all_laws_and_its_gains_for_those_that_know_them():
    data = PENDULUM | {"controller": PENDULUM["controller"] | {"encoder": 512.0, "observer": "filter"}}
    result = compare(Scene(**data), ["pd", "pid", "lqr"], processes=1)
    pd, pid, lqr = (row.variant.words for row in result.rows)
    assert pd == pid == {"frequency": 3.0, "encoder": 512.0, "observer": "filter"}
    assert lqr == {"encoder": 512.0, "observer": "filter"}
    exact = compare(Scene(**PENDULUM), ["lqr"], processes=1)
    assert result.rows[2].nominal.rms > 3 * exact.rows[0].nominal.rms


def balancing(**controller):
    """A pole that starts off its goal, on a cart whose keys rest."""
    return Scene(
        duration=2.0,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        keys=[{"joint": "slide", "times": [0], "values": [0]}],
        initial={"position": {"hinge": 0.1}},
        controller={"law": "lqr", "period": 0.01, "goal": {"hinge": 0.0}} | controller,
    )


def test_what_the_scene_tells_its_law_is_for_all_laws_that_know_it():
    words = {"position": 100.0, "final": 3.0}
    result = compare(balancing(**words), ["pd", "lqr", "mpc"], processes=1)
    told = {row.variant.law: row.variant.words for row in result.rows}
    goal = {"goal": {"hinge": 0.0}}
    assert told == {"pd": {}, "lqr": goal | words, "mpc": goal | {"position": 100.0}}
    assert all(np.abs(result.trials[law].error[-1]).max() < 0.05 for law in ("lqr", "mpc"))


def test_a_goal_counts_under_every_law():
    """A law that lets the pole fall is no better for keeping the cart."""
    result = compare(balancing(), ["pd", "lqr"], processes=1)
    pd, lqr = (row.nominal for row in result.rows)
    assert (pd.where, result.uncounted) == ("hinge", ())
    assert pd.worst > 3.0
    assert pd.settling == np.inf > lqr.settling > 0.0
    assert pd.overshoot < 0.1 < lqr.overshoot
    trial = result.trials["pd"]
    assert trial.joints == ("slide", "hinge")
    assert np.abs(trial.error[:, 1]).max() <= np.pi  # it turns right round
    assert pd.rms == pytest.approx(np.sqrt(np.mean(trial.error**2)))
    free = balancing().model_copy(update={"controller": None})
    assert compare(free, ["pd"], processes=1).uncounted == ("hinge",)


@pytest.mark.parametrize("words", [{}, {"goal": {"elbow": 0.0}}, {"delay": 0.01}])
def test_a_swing_up_is_judged_by_its_own_goal_and_not_by_the_keys_that_it_leaves(words):
    """Hanging down is no success, of no law; and where it turned round is home."""
    keys = [{"joint": "elbow", "times": [0, 1.0], "values": [0, 0.5]}]
    own = {"law": "swing-up", "period": 0.01, "foresight": 0.0} | words
    scene = Scene(
        duration=1.0, models=[{"file": "acrobot"}], roles={"tracked": ["elbow"]}, keys=keys, controller=own
    )
    result = compare(scene, ["swing-up", "pd"], processes=1)
    assert result.uncounted == ()
    for trial in result.trials.values():
        assert trial.joints == ("shoulder", "elbow")
        np.testing.assert_allclose(np.abs(trial.error[0]), [np.pi, 0.0], atol=1e-9)
    assert result.rows[1].nominal.settling == np.inf


def test_a_slide_that_has_nothing_to_do_is_judged_by_what_the_hinge_does():
    """By itself, at an arm as long as the model: it settles later than the hinge, and swings beyond."""
    problem = make_plan(balancing()).problem
    aims, extent = judged(problem, {"hinge": 0.0}), problem.model.stat.extent
    t = np.arange(100) * 0.01
    error = np.column_stack([np.where(t < 0.5, 0.03, 0.019) * 0.1 * extent, np.where(t < 0.2, -0.1, 0.0)])
    error[0, 0] = 0.0
    q, v = aims.targets(np.zeros((100, 2)), np.zeros((100, 2)))
    settling, overshoot = aims.arrival(t, error, q, v)
    assert settling == pytest.approx(0.5)
    assert overshoot == 0.0
    error[60:, 0] *= 1.1
    assert aims.arrival(t, error, q, v)[0] == np.inf


def test_a_slide_beside_a_hinge_settles_at_an_arm_as_long_as_the_model():
    plan = make_plan(balancing())
    trial = run_trial(plan, "lqr", {"goal": {"hinge": 0.0}}, Disturbance())
    band = 0.02 * 0.1 * np.array([plan.problem.model.stat.extent, 1.0])
    outside = np.flatnonzero((np.abs(trial.error) > band).any(axis=1))
    assert trial.figures.settling == pytest.approx(trial.t[outside[-1] + 1])
    beyond = -trial.error[:, 1].min() / 0.1, np.abs(trial.error[:, 0]).max() / (band[0] / 0.02)
    assert trial.figures.overshoot <= max(beyond)


DRIVEN = """<mujoco><worldbody>
  <body><joint name="lift" type="slide" axis="0 0 1" actuatorfrcrange="-40 30"/>
    <geom size=".1" mass="2"/>
    <body><joint name="turn" axis="0 1 0" armature=".05"/><geom size=".05" pos="0 0 -.4" mass=".5"/>
      <body pos="0 0 -.4"><joint name="bend" axis="0 1 0"/><geom size=".05" pos="0 0 -.3" mass=".3"/></body>
    </body></body></worldbody>
  <actuator><motor joint="lift" gear="3" ctrlrange="-20 20"/>
    <position joint="turn" gear="2" kp="30" kv="1" ctrlrange="-1.5 1.5"/>
    <general joint="bend" gainprm="4" biastype="affine" biasprm=".1 -2 -.3" forcerange="-1 .7"/></actuator>
</mujoco>"""


def test_forces_are_what_drives_give(tmp_path):
    """As MuJoCo says of the same controls, of motors and servos and a law that asks for more; what is cut
    counts, and what is not does not."""
    (tmp_path / "driven.xml").write_text(DRIVEN)
    joints = ["lift", "turn", "bend"]
    for kp, least, most in ((300.0, 0.5, 1.0), (8.0, 0.05, 0.95), (0.5, 0.0, 0.0)):
        scene = Scene(
            duration=0.2,
            rate=500.0,
            models=[{"file": str(tmp_path / "driven.xml")}],
            roles={"tracked": joints},
            actuators={"*": "controller"},
            physics={"gravity": False},
            keys=[{"joint": j, "times": [0], "values": [0.6]} for j in joints],
            initial={"position": dict.fromkeys(joints, 0.3)},
            controller={"law": "pd", "period": 0.002, "kp": kp, "kd": 1.0},
        )
        plan, r = make_plan(scene), run(scene)
        trial, d = run_trial(plan, "pd", {"kp": kp, "kd": 1.0}, Disturbance()), mujoco.MjData(r.model)
        assert trial.inputs == tuple(joints)
        asked = kp * (0.6 - r.q[:-1]) - r.v[:-1]
        cut = np.zeros(len(trial.t), dtype=bool)
        for k in range(len(trial.t)):
            d.qpos[:], d.qvel[:], d.ctrl[:] = r.q[k], r.v[k], r.tick_ctrl[k]
            mujoco.mj_forward(plan.problem.model, d)
            np.testing.assert_allclose(trial.tau[k], d.qfrc_actuator, rtol=1e-6, atol=1e-6)
            cut[k] = np.abs(asked[k] - d.qfrc_actuator).max() > 1e-6
        assert trial.figures.saturated == pytest.approx(cut.mean(), abs=0.02)
        assert least <= trial.figures.saturated <= most
        assert trial.figures.effort == pytest.approx(np.sqrt(np.mean(np.sum(trial.tau**2, axis=1))))
    far = scene.model_copy(update={"initial": Initial(position={"turn": 0.9, "lift": 0.6, "bend": 0.6})})
    held = run_trial(make_plan(far), "pd", {"kp": 0.5, "kd": 0.0}, Disturbance())
    cut = ~np.isclose(0.5 * held.error, held.tau, atol=1e-9)  # a servo cannot be told where it stands
    assert held.figures.saturated == cut.any(axis=1).mean()
    assert cut[:, 1].mean() > 0.2


def test_a_law_that_cannot_be_made_is_named_with_what_it_cannot_steer_and_the_others_are_measured():
    """A roll axis that nothing drives: no force of the other joints turns it."""
    others = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch"]
    scene = Scene(
        duration=0.1,
        models=[{"file": "arm6"}],
        roles={"tracked": others},
        actuators={"*": "off"},
        keys=[{"joint": j, "times": [0], "values": [0.3]} for j in others],
        physics={"friction": False, "contacts": "none", "gravity": False},
        controller={"law": "pd"},
    )
    seen = []
    result = compare(
        scene, ["pd", "lqr"], trials=1, processes=1, progress=lambda done, total: seen.append((done, total))
    )
    assert [row.variant.name for row in result.rows] == list(result.trials) == ["pd"]
    assert len(result.rows[0].disturbed) == 1
    message = r"law 'lqr': no regulator exists: no input can steer tool_roll; track, key or damp"
    assert re.match(message, result.unfit["lqr"])
    assert seen == [(1, 4), (3, 4), (4, 4)]
    with pytest.raises(PantographError, match=message):
        compare(scene, ["lqr"], processes=1)


def test_periods_that_do_not_fit_the_step_leave_the_others(tmp_path):
    data = PENDULUM | {"solver": {"step": 0.001}, "duration": 0.1}
    result = compare(Scene(**data), ["pd"], sweep={"period": [0.0025, 0.002]}, processes=1)
    assert [row.period for row in result.rows] == [0.002]
    assert "no whole multiple of the step" in result.unfit["pd period=0.0025"]


@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"mass": -1.0}, "mass must be a number >= 0"),
        ({"mass": 5}, "mass must be below 1, .* less than nothing"),
        ({"mass": 1.0}, "mass must be below 1"),
        ({"friction": 2.0}, "friction must be at most 1"),
        ({"push": np.nan}, "push must be a number"),
        ({"start": np.inf}, "start must be a number"),
        ({"start": -0.1}, "start must be a number >= 0"),
        ({"trials": -1}, "trials must be a whole number >= 0"),
        ({"trials": 1.5}, "trials must be a whole number"),
        ({"seed": -1}, "seed must be a whole number >= 0"),
        ({"processes": 0}, "processes must be a whole number >= 1"),
        ({"sweep": {"frequency": []}}, "a sweep of 'frequency' is a list of values"),
        ({"sweep": {"frequency": "25"}}, "a sweep of 'frequency' is a list of values"),
        ({"sweep": {"period": [-0.1]}}, "period must be a positive"),
        ({"laws": "pd"}, "laws to compare are a list of names"),
        ({"laws": []}, "laws to compare are a list of names"),
        ({"laws": ["pd", "lqr", "pd"]}, "law 'pd' is named twice"),
        ({"laws": ["pdd"]}, "no law 'pdd'"),
    ],
)
def test_what_makes_no_sense_is_refused_before_the_work(options, says, monkeypatch):
    monkeypatch.setattr(compared, "run_trial", None)
    laws = options.get("laws", ["pd"])
    with pytest.raises(PantographError, match=says):
        compare(Scene(**PENDULUM), laws, **{k: x for k, x in options.items() if k != "laws"})


def test_machines_as_wrong_as_can_be_still_are_machines():
    """No mass and no damping is negative, whatever the seed."""
    plan = make_plan(Scene(**PENDULUM))
    for by in disturbances(plan, Spread(200, mass=0.999, friction=1.0, seed=1)):
        made = disturbed(plan.problem, by).model
        assert (made.body_mass[plan.problem.model.body_mass > 0.0] > 0.0).all()
        assert (made.body_inertia >= 0.0).all()
        assert (made.dof_damping >= 0.0).all()
        assert (made.dof_frictionloss >= 0.0).all()


def test_equal_values_of_a_sweep_are_one_variant():
    result = compare(Scene(**PENDULUM), ["pd"], sweep={"frequency": [2, 2.0, 2.5]}, processes=1)
    assert [row.variant.name for row in result.rows] == ["pd frequency=2", "pd frequency=2.5"]


def test_starts_are_as_far_off_as_asked():
    """Positions and speeds of all joints but keyed ones, in the scene's units, within their ranges; masses
    and pushes are those of the same seed without."""
    data = PENDULUM | {"roles": {"tracked": ["shoulder"], "keyed": ["elbow"]}}
    for unit, angle in ((1.0, "radian"), (np.rad2deg(1.0), "degree")):
        plan = make_plan(Scene(**data | {"angle": angle}))
        drawn = disturbances(plan, Spread(60, start=0.1 * unit, seed=5))
        offset, speed = (np.array([getattr(d, word) for d in drawn]) for word in ("offset", "speed"))
        for off in (offset, speed):
            assert 0.09 < np.abs(off[:, 0]).max() <= 0.1 + 1e-12
            assert not off[:, 1].any()
        assert np.abs(np.corrcoef(offset[:, 0], speed[:, 0])[0, 1]) < 0.4
        same = disturbances(plan, Spread(60, seed=5))
        assert [(d.mass, d.push, d.start) for d in drawn] == [(d.mass, d.push, d.start) for d in same]
        assert same[0].offset == ()
    problem = plan.problem
    there = disturbed(problem, drawn[0]).state0
    np.testing.assert_allclose(there.q, problem.state0.q + offset[0])
    np.testing.assert_allclose(there.v, problem.state0.v + speed[0])
    pushed = disturbed(problem, Disturbance(offset=(0.1, 0.1), speed=(0.2, 0.2))).state0
    np.testing.assert_allclose(pushed.q - problem.state0.q, [0.1, 0.0])
    np.testing.assert_allclose(pushed.v - problem.state0.v, [0.2, 0.0])
    limited = make_plan(balancing()).problem
    high = limited.model.jnt_range[0, 1]
    far = disturbed(limited, Disturbance(offset=(99.0, 99.0))).state0.q
    np.testing.assert_allclose(far, [high, 99.1])
    trial = run_trial(make_plan(Scene(**PENDULUM)), "pd", {}, Disturbance(offset=(0.05, 0.0)))
    assert trial.error[0, 0] == pytest.approx(-0.05)


def test_machine_code_is_timed_where_engines_run_it():
    """Runs of a thousand ticks or more, of laws that are formulas."""
    short, long = (make_plan(Scene(**PENDULUM | {"duration": s})) for s in (1.0, 2.1))
    trial = {law: run_trial(long, law, {}, Disturbance()).figures for law in ("pd", "mpc")}
    assert 0.0 < trial["pd"].code < trial["pd"].tick
    assert np.isnan(trial["mpc"].code)
    assert np.isnan(run_trial(short, "pd", {}, Disturbance()).figures.code)


def test_a_scene_without_anything_to_control_is_refused():
    scene = Scene(duration=1.0, models=[{"file": "pendulum"}])
    with pytest.raises(PantographError, match="nothing to control"):
        compare(scene, ["pd"])
    with pytest.raises(PantographError, match="no parameter 'frequenzy'"):
        compare(Scene(**PENDULUM), ["pd"], sweep={"frequenzy": [1.0]})


def test_a_law_that_learns_stands_beside_others(tmp_path):
    """On the machine that was modelled, and on heavier ones that it learns anew before they are pushed."""
    own = {"law": "pd", "period": 0.002, "frequency": 3.0, "delay": 0.004}
    scene = Scene(**PENDULUM | {"controller": own})
    result = compare(scene, ["pd", "ilc"], sweep={"repeats": [5]}, trials=1, push=0.0, processes=1)
    pd, ilc = result.rows
    assert ilc.variant.words == {"frequency": 3.0, "delay": 0.004, "of": "pd", "repeats": 5}
    assert ilc.nominal.rms < 0.5 * pd.nominal.rms
    assert ilc.disturbed[0].rms < 0.5 * pd.disturbed[0].rms
    learned = result.trials["ilc repeats=5"].learned
    assert len(learned.errors) == 5
    assert learned.errors[0] == pytest.approx(pd.nominal.rms, rel=1e-9)
    assert ilc.nominal.rms == pytest.approx(min(learned.errors), rel=1e-9)
    line = learning(result).axes[0].lines[0]
    np.testing.assert_array_equal(line.get_ydata(), learned.errors)
    with pytest.raises(PantographError, match="no parameter 'repaets'"):
        compare(scene, ["ilc"], sweep={"repaets": [1]})


def test_the_command_prints_and_saves_all_of_it(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("arm.toml").write_text(
        """duration = 0.4
[[models]]
file = "planar_2r"
[roles]
tracked = ["shoulder", "elbow"]
[actuators]
"*" = "off"
[[keys]]
joint = "shoulder"
times = [0, 0.2]
values = [0, 0.3]
curve = "clamped"
"""
    )
    control(Path("arm.toml"), compare="pd,ilc", sweep=["repeats=3"], trials=1, processes=1, out=Path("o"))
    said = capsys.readouterr().out
    assert "RMS error of each repeat" in said
    assert "build ms" in said
    made = [
        "arm.control.csv",
        "arm.control.png",
        "arm.ilc-repeats=3.npz",
        "arm.learning.png",
        "arm.runs.csv",
    ]
    assert sorted(p.name for p in Path("o").iterdir()) == made
    with pytest.raises(PantographError, match="no law 'pdd'; there is: computed-torque, ilc, impedance"):
        control(Path("arm.toml"), compare="pdd")


ARM = """duration = 2.0
[[models]]
file = "planar_2r"
[roles]
tracked = ["shoulder", "elbow"]
[actuators]
"*" = "off"
"""


def test_outputs_that_cannot_be_written_are_refused_before_the_work(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(compared, "run_trial", None)
    Path("arm.toml").write_text(ARM)
    Path("afile").write_text("")
    Path("o/arm.runs.csv").mkdir(parents=True)
    Path("o/arm.control.png").mkdir()
    for options, says in (
        ({"out": Path("afile")}, "cannot write into afile"),
        ({"out": Path("afile/deeper")}, "cannot write into afile/deeper"),
        ({"out": Path("o")}, "cannot write o/arm.runs.csv: it is a folder"),
        ({"out": Path("o"), "table": "parquet"}, "cannot write o/arm.control.png|need pyarrow"),
        ({"table": "xls"}, "no kind of table 'xls'"),
    ):
        with pytest.raises(PantographError, match=says):
            control(Path("arm.toml"), compare="pd", **options)


def test_the_command_says_what_fits_not_and_ends_with_a_status(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("arm.toml").write_text(ARM.replace('"shoulder", ', "") + "[physics]\ngravity = false\n")
    one = ["control", "arm.toml", "--compare", "pd,swing-up", "--trials", "0", "--processes", "1"]
    result = CliRunner().invoke(app, one)
    assert (result.exit_code, "swing-up: cannot, because" in result.output) == (1, True)
    assert "pd is told" not in result.output
    assert "not counted: shoulder" in result.output
    assert Path("out/arm.control.png").exists()


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes on this system")
@pytest.mark.parametrize(("law", "seconds"), [("pd", 2), ("ilc", 2), ("pd", 20000)])
def test_ctrl_c_ends_a_comparison_at_once_with_what_is_done(law, seconds, tmp_path):
    """No traceback, no process left, also within a run that would take hours, and a table said to be
    partial, with what all laws have met."""
    (tmp_path / "arm.toml").write_text(ARM.replace("2.0", f"{seconds}.0"))
    say = "import sys; from pantograph.sim.cli import main; sys.argv[0] = 'pantograph'; main()"
    asked = ["control", "arm.toml", "--compare", f"computed-torque,{law}", "--trials", "5000"]
    begun = subprocess.Popen(
        [sys.executable, "-c", say, *asked],
        cwd=tmp_path, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
    )  # fmt: skip
    until = time.monotonic() + 60
    while (
        len(_group(begun.pid)) < (4 if seconds == 2 else 3)
        and begun.poll() is None
        and time.monotonic() < until
    ):
        time.sleep(0.05)  # itself, two others, and what cleans up after them
    time.sleep(3.0)
    os.killpg(begun.pid, signal.SIGINT)
    out, error = begun.communicate(timeout=60)
    assert begun.returncode == 130
    assert re.fullmatch(r"interrupted; \d+ of 10002 runs are done(; \S+){0,2}\n", error)
    assert "Traceback" not in out
    _gone(begun.pid)
    if "PARTIAL" in out:
        rows = list(csv.DictReader((tmp_path / "out/arm.control.partial.csv").open()))
        assert len({row["disturbed"] for row in rows}) == 1
    else:
        assert " 0 of" in error


def _gone(group):
    """No process of a group is left, or only for the moment that ending takes."""
    until = time.monotonic() + 10
    while _group(group) and time.monotonic() < until:
        time.sleep(0.05)
    assert not _group(group)


def _group(group):
    """Processes of a group that are alive."""
    found = subprocess.run(["ps", "-eo", "pgid=,stat="], capture_output=True, text=True).stdout.split("\n")
    rows = [line.split() for line in found if line.split()]
    return [row for row in rows if row[0] == str(group) and not row[1].startswith("Z")]


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="no groups of processes on this system")
def test_processes_end_with_the_one_that_started_them(tmp_path):
    (tmp_path / "arm.toml").write_text(ARM.replace("2.0", "20000.0"))
    say = "import sys; from pantograph.sim.cli import main; sys.argv[0] = 'pantograph'; main()"
    begun = subprocess.Popen(
        [sys.executable, "-c", say, "control", "arm.toml"], cwd=tmp_path, start_new_session=True
    )
    until = time.monotonic() + 60
    while len(_group(begun.pid)) < 3 and time.monotonic() < until:
        time.sleep(0.05)
    time.sleep(3.0)
    begun.kill()
    begun.wait()
    _gone(begun.pid)


def test_an_interrupted_comparison_keeps_what_all_laws_have_met(monkeypatch):
    real, seen = compared.run_trial, []

    def stopped(*arguments):
        seen.append(arguments)
        if len(seen) == 8:  # two as modelled, two pairs, and one of the third
            raise KeyboardInterrupt
        return real(*arguments)

    monkeypatch.setattr(compared, "run_trial", stopped)
    scene = Scene(**PENDULUM | {"duration": 0.1})
    result = compare(scene, ["pd", "lqr"], trials=5, processes=1)
    assert (result.status, result.done, result.asked) == ("interrupted", 6, 12)
    assert [len(row.disturbed) for row in result.rows] == [2, 2]
    assert len(result.disturbances) == 2
    assert len(tables.runs(result)) == 6
    seen[:] = range(6)
    result = compare(scene, ["pd", "lqr"], trials=5, processes=1)
    assert [row.variant.name for row in result.rows] == ["pd"]
    assert result.disturbances == ()


@pytest.mark.parametrize("law", ["pd", "ilc"])
def test_ctrl_c_within_a_run_is_no_result_of_it(law, monkeypatch):
    """Engines return what they have; a comparison must not take it for a run that failed."""
    calls = []

    class Struck:
        def start(self):
            return None

        def __call__(self, t, q, v, target, memory):
            calls.append(t)
            if len(calls) > 20:
                raise KeyboardInterrupt
            return np.zeros(2), None

    monkeypatch.setattr(trials, "make_law", lambda *arguments: Struck())
    with pytest.raises(KeyboardInterrupt):
        run_trial(make_plan(Scene(**PENDULUM)), law, {}, Disturbance())
