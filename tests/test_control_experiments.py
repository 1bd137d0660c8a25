"""Experiments measure what they say, repeat, and are the same on any number of processes."""

import csv
import dataclasses

import numpy as np
import pytest
from pantograph.controllers.experiments import compare, figure, write_csv
from pantograph.controllers.trial import Disturbance, run_trial
from pantograph.sim import PantographError, Scene, make_plan, run

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
TIMES = ("tick", "tick99")


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


def test_settling_and_overshoot_are_of_the_motion_after_the_keys_rest():
    plan = make_plan(Scene(**PENDULUM))
    slow, fast = (run_trial(plan, "pd", {"frequency": w, "damping": 0.3}, Disturbance()) for w in (1.5, 6.0))
    for trial in (slow, fast):
        after = trial.t >= 0.5 - 1e-9
        error, f = np.abs(trial.error[after]) / [1.0, 0.5], trial.figures
        inside = trial.t[after] - 0.5 >= f.settling - 1e-9
        if not np.isnan(f.settling):
            assert (error[inside] <= 0.02 * 1.3).all()
    assert fast.figures.settling < 0.5
    assert np.isnan(slow.figures.settling) or slow.figures.settling > fast.figures.settling
    assert slow.figures.overshoot > 0.01


def test_a_drive_at_its_limit_counts_as_saturated():
    data = PENDULUM | {"actuators": {"*": "controller"}, "physics": {"gravity": False}}
    plan = make_plan(Scene(**data))
    asked = run_trial(plan, "pd", {"kp": 1e7, "kd": 0.0}, Disturbance()).figures
    calm = run_trial(plan, "pd", {"kp": 1.0, "kd": 0.0}, Disturbance()).figures
    assert asked.saturated > 0.9
    assert calm.saturated == 0.0


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


def test_sweeps_tables_and_pictures(tmp_path):
    seen = []
    result = compare(
        Scene(**PENDULUM),
        ["pd", "computed-torque"],
        sweep={"frequency": [2.0, 8.0]},
        trials=1,
        processes=1,
        progress=lambda done, total: seen.append((done, total)),
    )
    assert seen == [(k + 1, 8) for k in range(8)]
    assert [r.variant.name for r in result.rows][:2] == ["pd frequency=2.0", "pd frequency=8.0"]
    assert result.rows[1].nominal.rms < 0.2 * result.rows[0].nominal.rms
    with write_csv(result, tmp_path / "a" / "t.csv").open() as f:
        rows = list(csv.DictReader(f))
    assert len(rows) == 8
    assert float(rows[2]["rms"]) == result.rows[1].nominal.rms
    assert rows[2]["parameters"] == "frequency=8.0"
    figure(result).savefig(tmp_path / "p.png")
    assert (tmp_path / "p.png").stat().st_size > 10_000


def test_sensors_of_the_scene_are_for_all_laws_and_its_gains_for_its_own():
    data = PENDULUM | {"controller": PENDULUM["controller"] | {"encoder": 512.0, "observer": "filter"}}
    result = compare(Scene(**data), ["pd", "lqr"], processes=1)
    pd, lqr = (row.variant.words for row in result.rows)
    assert pd == {"frequency": 3.0, "encoder": 512.0, "observer": "filter"}
    assert lqr == {"encoder": 512.0, "observer": "filter"}
    exact = compare(Scene(**PENDULUM), ["lqr"], processes=1)
    assert result.rows[1].nominal.rms > 3 * exact.rows[0].nominal.rms


def test_a_scene_without_anything_to_control_is_refused():
    scene = Scene(duration=1.0, models=[{"file": "pendulum"}])
    with pytest.raises(PantographError, match="nothing to control"):
        compare(scene, ["pd"])
    with pytest.raises(PantographError, match="no parameter 'frequenzy'"):
        compare(Scene(**PENDULUM), ["pd"], sweep={"frequenzy": [1.0]})
