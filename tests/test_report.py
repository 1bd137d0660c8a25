"""Reports: errors against a reference that knows its own, files, and sentences that follow from the rows."""

import csv
import json
import sys
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from oracles import pendulum
from oracles.mujoco_motion import motion
from pantograph.models import load_model
from pantograph.sim import Scene, run
from pantograph.sim.errors import EngineError, RecordingError
from pantograph.sim.hard_cases import HARD_CASES
from pantograph.sim.plan import make_plan
from pantograph.sim.report import Report, Yardstick, report
from pantograph.sim.scene.load import load_scene
from pantograph.sim.scene_work import scene_case, scene_references, scene_runners
from pantograph.sim.work_precision import Case, Row, trajectory_error
from pantograph.sim.work_runners import runners, smooth_or_none, smooth_reference

PENDULUM = """<mujoco><worldbody><body><joint axis="0 -1 0"/>
<inertial pos="0 0 -1" mass="1" diaginertia="1e-14 1e-14 1e-14"/></body></worldbody></mujoco>"""
BOX = """<mujoco><worldbody><geom type="plane" size="1 1 1"/><body pos="0 0 0.3"><freejoint/>
<geom type="box" size="0.1 0.1 0.1"/></body></worldbody></mujoco>"""


def swing(frames: int = 20) -> Case:
    model = mujoco.MjModel.from_xml_string(PENDULUM)
    return Case("swing", model, np.array([2.0]), np.array([0.0]), 2.0, frames=frames)


@pytest.fixture(scope="module")
def swing_report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    return report(swing(), folder, engines=("smooth", "mujoco", "scipy"), budget_s=0.04), folder


def test_reference_is_right_within_its_own_uncertainty():
    case = swing()
    reference = smooth_reference(case, smooth_or_none(case.model)[0])
    exact = pendulum.swing(case.times, 2.0)
    assert np.abs(reference.motion.q[:, 0] - exact[:, 0]).max() < 10 * reference.uncertainty + 1e-13
    assert 0 < reference.uncertainty < 1e-11


def test_errors_are_those_of_the_closed_form():
    case = swing()
    exact = pendulum.swing(case.times, 2.0)[:, 0]
    reference = smooth_reference(case, smooth_or_none(case.model)[0])
    seen = set()
    for runner in runners(case, smooth_or_none(case.model)[0], ("smooth", "mujoco", "scipy")):
        setting = list(runner.settings())[3]
        motion = runner.run(setting)
        true = np.abs(motion.q[:, 0] - exact).max()
        assert trajectory_error(case, motion, reference.motion) == pytest.approx(true, rel=1e-3, abs=1e-12)
        assert motion.evaluations > 0
        seen.add((runner.engine, runner.method, runner.knob))
    assert {engine for engine, _, _ in seen} == {"smooth", "mujoco", "scipy"} and len(seen) == 21


def test_files(swing_report):
    result, folder = swing_report
    content = json.loads((folder / "report.json").read_text())
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(content["rows"]) == len(result.rows) > 60
    assert float(rows[5]["cpu_s"]) == result.rows[5].cpu_s
    assert content["references"][0]["uncertainty"] == result.uncertainty("smooth")
    assert (folder / "report.png").read_bytes()[:4] == b"\x89PNG"
    text = (folder / "report.txt").read_text()
    assert result.yardsticks[0].source in text and result.recommendation() in text


def test_errors_fall_with_the_setting(swing_report):
    result, _ = swing_report
    for method, order in (("rk4", 4), ("dopri5", 5)):
        rows = [r for r in result.rows if (r.engine, r.method, r.knob) == ("smooth", method, "step")]
        usable = [r for r in rows if 1e-10 < r.error < 1e-3]
        fit = np.polyfit(np.log([r.setting for r in usable]), np.log([r.error for r in usable]), 1)
        assert fit[0] == pytest.approx(order, abs=0.5)
    adaptive = [
        r for r in result.rows if r.knob == "tolerance" and r.engine == "smooth" and r.method == "dop853"
    ]
    assert adaptive[-1].error < 1e-6 * adaptive[0].error


def row(
    engine: str, error: float, cpu: float, *, knob: str = "step", setting: float = 1e-3, n: int = 10
) -> Row:
    return Row(engine, "dopri5", knob, setting, error, cpu, 0.0, n)


def test_a_brief_report_has_the_runs_that_no_other_beats():
    good = (row("smooth", 1e-4, 1.0, setting=0.1), row("smooth", 1e-7, 5.0, setting=0.2))
    beaten = (
        row("mujoco", 1e-7, 50.0, setting=0.3),
        row("mujoco", 1e-3, 2.0, setting=0.4),
        row("smooth", np.nan, 0.1, setting=0.5),
    )
    report = Report("x", beaten + good, (Yardstick("reference", 1e-8),))
    shown = [setting for setting in (0.1, 0.2, 0.3, 0.4, 0.5) if f"step {setting:g} s" in report.brief()]
    assert shown == [0.1, 0.2]
    assert "Of 5 runs those that no other beats" in report.brief()
    assert report.recommendation() in report.brief()
    assert all(f"step {setting:g} s" in str(report) for setting in (0.1, 0.2, 0.3, 0.4, 0.5))


def test_recommendation_takes_the_cheapest_that_is_good_enough():
    rows = (
        row("smooth", 1e-4, 1.0),
        row("smooth", 1e-7, 5.0),
        row("mujoco", 1e-7, 50.0),
        row("smooth", np.nan, 0.1),
    )
    lines = Report("x", rows, (Yardstick("reference", 1e-8),)).recommendation().splitlines()
    assert "in 1 s" in lines[0] and "50 times less" in lines[0]
    assert "in 5 s" in lines[1] and "10 times less" in lines[1]
    assert "not that sure" in lines[2], "an error below the reference's own says nothing"
    lines = Report("x", rows, (Yardstick("reference", 1e-12),)).recommendation().splitlines()
    assert "nothing reaches it" in lines[2]


def test_luck_below_the_reference_is_not_recommended():
    result = Report("x", (row("smooth", 1e-12, 1.0),), (Yardstick("reference", 1e-8),))
    assert result.cheapest(1e-6) is result.rows[0]
    assert result.cheapest(1e-9) is None and "not that sure" in result.recommendation()


def test_stiffness_is_said():
    rows = tuple(
        row("smooth", 1e-5, 1.0, knob="tolerance", setting=t, n=n) for t, n in ((1e-3, 900), (1e-6, 950))
    )
    assert "Stiff" in Report("x", rows, (Yardstick("reference", 0.0),)).recommendation()
    rows = tuple(
        row("smooth", 1e-5, 1.0, knob="tolerance", setting=t, n=n) for t, n in ((1e-3, 200), (1e-6, 950))
    )
    assert "Stiff" not in Report("x", rows, (Yardstick("reference", 0.0),)).recommendation()


def test_stiff_servo_is_called_stiff():
    """500 times longer than the decay: only stability limits the steps."""
    servo = next(case for case in HARD_CASES if case.name == "stiff servo")
    model = servo.case().model
    long = Case("servo at rest", model, np.array([1.0]), np.array([0.0]), 2.0)
    assert "Stiff" in report(long, engines=("smooth",), budget_s=0.05).recommendation()


def test_a_model_with_contacts_is_compared_among_mujocos_integrators():
    model = mujoco.MjModel.from_xml_string(BOX)
    data = mujoco.MjData(model)
    case = Case("box", model, data.qpos.copy(), data.qvel.copy(), 0.2, frames=5)
    result = report(case, engines=("smooth", "mujoco"), budget_s=0.002)
    assert {r.engine for r in result.rows} == {"mujoco"}
    assert any("may touch" in note for note in result.notes)
    assert result.uncertainty("mujoco") > 0


SCENE = """
format = 1
title = "Swings"
duration = 0.4
angle = "degree"

[[models]]
file = "double_pendulum"

[initial.position]
shoulder = 60

[physics]
contacts = "none"
"""
TRACKED = """
[roles]
tracked = ["shoulder"]

[[keys]]
joint = "shoulder"
times = [0, 0.4]
values = [60, 20]

[controller]
law = "pd"
period = 0.01
frequency = 4
"""


def test_estimates_need_no_reference_and_come_near_the_error(swing_report):
    result, _ = swing_report
    usable = [r for r in result.rows if r.engine in ("smooth", "mujoco") and 1e-8 < r.error < 1e-3]
    assert {r.knob for r in usable} == {"step", "tolerance"} and len(usable) > 40
    for r in usable:
        assert r.error / 3 < r.estimate < 3 * r.error, r


def test_what_is_recommended_does_what_it_says(tmp_path):
    """Run as a scene, against SciPy on MuJoCo's accelerations."""
    (tmp_path / "free.toml").write_text(SCENE)
    best = report(tmp_path / "free.toml", engines=("smooth",), budget_s=0.02)
    scene = load_scene(tmp_path / "free.toml").model_dump(exclude_unset=True)
    for target in (1e-3, 1e-6, 1e-9):
        row = best.cheapest(target)
        knob = {"step" if row.knob == "step" else "tolerance": row.setting, "integrator": row.method}
        # frames at whole steps, so that nothing but the recommended setting is at work
        words = {"rate": 1 / row.setting} if row.knob == "step" else {}
        recording = run(Scene(**{**scene, **words, "solver": {"engine": "smooth", **knob}}))
        truth = motion(recording.model, recording.q[0], recording.v[0], recording.t, rtol=1e-12)
        assert np.abs(recording.q - truth).max() < 1.05 * target + 1e-10


def test_a_scene_of_keys_alone_has_nothing_to_compare(tmp_path):
    keys = '[[keys]]\njoint = "{}"\ntimes = [0, 0.4]\nvalues = [60, 20]\n'
    (tmp_path / "keyed.toml").write_text(SCENE.replace("[initial.position]\nshoulder = 60\n", "")
                                         + keys.format("shoulder") + keys.format("elbow"))  # fmt: skip
    result = report(tmp_path / "keyed.toml", tmp_path / "out")
    assert not result.rows and "every joint is keyed" in result.brief()
    assert "nothing is integrated" in (tmp_path / "out" / "report.txt").read_text()
    assert json.loads((tmp_path / "out" / "report.json").read_text())["rows"] == []


def test_a_folder_that_cannot_be_written_is_told_before_any_work(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(RecordingError, match="cannot write into"):
        report(swing(), tmp_path / "file" / "out", progress=lambda _: pytest.fail("worked in vain"))


def test_chaos_beyond_its_horizon_is_told():
    """Two references of a wild double pendulum part for good; no target is promised."""
    model = load_model("double_pendulum")
    case = Case("wild", model, np.array([3.0, 0.5]), np.array([0.0, 4.0]), 60.0)
    reference = smooth_reference(case, smooth_or_none(model)[0])
    assert reference.uncertainty > 1e-3 and 5 < reference.sure_until < 60
    early = replace(case, duration=0.8 * reference.sure_until)
    assert smooth_reference(early, smooth_or_none(model)[0]).sure_until == np.inf
    stick = Yardstick("x", reference.uncertainty, "", reference.sure_until)
    words = Report("wild", (row("smooth", 1e-4, 1.0),), (stick,)).recommendation()
    assert f"Beyond {reference.sure_until:.3g} s the reference is not sure" in words
    assert words.count("not that sure") == 3


def test_a_free_scene_is_a_case(tmp_path):
    (tmp_path / "free.toml").write_text(SCENE)
    result = report(tmp_path / "free.toml", tmp_path / "out", engines=("smooth",), budget_s=0.02)
    assert result.name == "Swings"
    assert any(r.knob == "tolerance" for r in result.rows)
    assert min(r.error for r in result.rows) < 1e-9


def test_a_scene_with_a_controller_runs_on_both_engines(tmp_path):
    """The engines hold the same samples: errors fall with the order, and the physics agree."""
    (tmp_path / "tracked.toml").write_text(SCENE + TRACKED)
    plan = make_plan(load_scene(tmp_path / "tracked.toml"))
    case = scene_case(plan)
    found, notes = scene_runners(plan, case)
    assert not notes and {runner.engine for runner in found} == {"smooth", "contact"}
    references = scene_references(("smooth", "contact"), plan, case, budget_s=0.2)
    for runner in found:
        if runner.method == "rk4":
            coarse, fine = list(runner.settings())[:2]
            assert coarse == 0.01, "the controller's period"
            motion = references[runner.engine].motion
            ratio = trajectory_error(case, runner.run(coarse), motion) / trajectory_error(
                case, runner.run(fine), motion
            )
            assert ratio > 10, "order 4"
    assert max(reference.uncertainty for reference in references.values()) < 1e-6
    assert trajectory_error(case, references["smooth"].motion, references["contact"].motion) < 1e-6


def test_report_on_a_scene_with_a_controller(tmp_path):
    (tmp_path / "tracked.toml").write_text(SCENE + TRACKED)
    result = report(tmp_path / "tracked.toml", budget_s=0.0)
    assert {r.engine for r in result.rows} == {"smooth", "contact", "scipy"}
    assert {y.engine for y in result.yardsticks} == {"smooth", "contact"}
    assert any("physics of the two engines" in note for note in result.notes)


KEYED = (
    SCENE.replace("[initial.position]\nshoulder = 60\n", "")
    + """
[[keys]]
joint = "shoulder"
times = [0, 0.25, 0.4]
values = [60, 20, 50]
curve = "{curve}"
"""
)


@pytest.mark.parametrize(
    "words", [SCENE + TRACKED, KEYED.format(curve="natural"), KEYED.format(curve="auto")]
)
@pytest.mark.parametrize("engine", ["scipy", "torch"])
def test_solvers_that_we_did_not_write_agree_on_scenes(tmp_path, words, engine):
    """On keyed motion that bends at its keys, and on the samples that a controller holds."""
    if engine == "torch":
        pytest.importorskip(
            "torchdiffeq", reason="torchdiffeq is not installed: pip install 'pantograph-sim[torch]'"
        )
    (tmp_path / "scene.toml").write_text(words)
    plan = make_plan(load_scene(tmp_path / "scene.toml"))
    case = scene_case(plan)
    found, notes = scene_runners(plan, case, (engine,))
    assert not notes and {runner.engine for runner in found} == {engine}
    reference = scene_references(("smooth",), plan, case, budget_s=0.2)["smooth"]
    for runner in found:
        coarse, fine = (trajectory_error(case, runner.run(tol), reference.motion) for tol in (1e-3, 1e-9))
        assert coarse < 0.1 and fine < 1e-6 and fine < coarse + 1e-9, (runner.name, coarse, fine)


def test_what_is_left_out_is_told(tmp_path):
    """Limits that are met and velocities that jump leave foreign solvers out, as contacts do."""
    (tmp_path / "jumps.toml").write_text(KEYED.format(curve="linear"))
    (tmp_path / "rail.toml").write_text(
        LIMITED.replace("120", "1.2").replace("2.0", "2.0\n[initial.velocity]\nslide = 5.0")
    )
    for name, why in (
        ("jumps", "no scipy: keyed velocities jump"),
        ("rail", "no scipy: joint 'slide' meets"),
    ):
        plan = make_plan(load_scene(tmp_path / f"{name}.toml"))
        found, notes = scene_runners(plan, scene_case(plan), ("smooth", "scipy"))
        assert {runner.engine for runner in found} == {"smooth"}
        assert len(notes) == 1 and why in notes[0], notes
    (tmp_path / "free.toml").write_text(LIMITED.replace("120", "0.1"))
    plan = make_plan(load_scene(tmp_path / "free.toml"))
    found, notes = scene_runners(plan, scene_case(plan), ("scipy",))
    assert found and not notes, "limits that no motion meets are none"
    box = report(mujoco.MjModel.from_xml_string(BOX), engines=("mujoco", "scipy"), budget_s=0.0, limit_s=0.5)
    assert any("no scipy: it solves the smooth engine's equations" in note for note in box.notes)


def test_engines_are_chosen(tmp_path):
    (tmp_path / "tracked.toml").write_text(SCENE + TRACKED)
    result = report(tmp_path / "tracked.toml", engines=("mujoco",), budget_s=0.0)
    assert {r.engine for r in result.rows} == {"contact"}
    only = report(tmp_path / "tracked.toml", engines=("scipy",), budget_s=0.0)
    assert {r.engine for r in only.rows} == {"scipy"} and only.cheapest(1e-3) is not None
    with pytest.raises(EngineError, match="did you mean 'torch'"):
        report(tmp_path / "tracked.toml", engines=("torhc",))


def test_missing_torch_is_said_before_any_work(monkeypatch):
    monkeypatch.setitem(sys.modules, "torchdiffeq", None)
    with pytest.raises(
        EngineError, match=r"engine 'torch' needs torchdiffeq: pip install 'pantograph-sim\[torch"
    ):
        report(swing(), engines=("torch",), progress=lambda _: pytest.fail("worked in vain"))


def test_time_that_runs_out_is_told():
    result = report(swing(), engines=("smooth", "mujoco"), limit_s=0.0)
    assert not result.rows and result.status == "done"
    assert any("no time was left for smooth euler" in note and "mujoco" in note for note in result.notes)


@pytest.mark.parametrize("settings", [0, 2])
def test_an_interrupted_report_keeps_what_it_measured(tmp_path, settings):
    """Whoever does not wait has the methods so far, and the settings so far of the one at work."""
    case = swing()
    smooth = smooth_or_none(case.model)[0]
    whole = runners(case, smooth, ("smooth",))
    told: list[str] = []

    class Impatient(type(whole[0])):
        def run(self, setting):
            if self.method == "rk4" and setting < 0.2 / 2**settings:
                raise KeyboardInterrupt
            return super().run(setting)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("pantograph.sim.work_runners.SmoothSteps", Impatient)
        result = report(case, tmp_path, engines=("smooth",), budget_s=0.01, progress=told.append)
    assert result.status == "interrupted"
    kept = [r for r in result.rows if r.method == "rk4"]
    assert [r.setting for r in kept] == [0.1, 0.05][:settings]
    assert np.isfinite([r.estimate for r in kept]).all()
    methods = {r.method for r in result.rows}
    assert "euler" in methods and "dop853" not in methods
    assert any("interrupted during or before smooth rk4" in note for note in result.notes)
    assert json.loads((tmp_path / "report.json").read_text())["status"] == "interrupted"
    assert f"(1 of {len(whole)})" in " ".join(told)


def test_interrupts_in_an_engine_reach_the_report(tmp_path, monkeypatch):
    """Engines end with the status 'interrupted'; that is no motion that diverged."""
    (tmp_path / "tracked.toml").write_text(SCENE + TRACKED)
    plan = make_plan(load_scene(tmp_path / "tracked.toml"))
    found, _ = scene_runners(plan, scene_case(plan), ("smooth", "mujoco"))

    def stop(*_):
        raise KeyboardInterrupt

    monkeypatch.setattr("pantograph.sim.compose.Sampled.sample", stop)
    for runner in (found[0], next(r for r in found if r.engine == "contact")):
        with pytest.raises(KeyboardInterrupt):
            runner.run(0.01)


def test_dear_runs_come_in_pairs():
    """One run says nothing of its error."""
    result = report(swing(), engines=("smooth",), budget_s=0.0)
    methods = {(r.method, r.knob) for r in result.rows}
    assert len(result.rows) == 2 * len(methods)
    assert all(np.isfinite(r.estimate) for r in result.rows)


LIMITED = """
duration = 120
[[models]]
file = "cart_pole"
[initial.position]
hinge = 2.0
[physics]
contacts = "none"
"""


def test_a_setting_at_which_an_engine_breaks_is_a_run_that_diverged(tmp_path):
    """Steps of a long scene's frames are no steps for its rail: neither the first to be tried, nor fatal."""
    (tmp_path / "long.toml").write_text(LIMITED)
    plan = make_plan(load_scene(tmp_path / "long.toml"))
    case = scene_case(plan)
    found, notes = scene_runners(plan, case)
    assert not notes and {runner.engine for runner in found} == {"smooth", "contact"}
    assert all(max(runner.settings()) <= 0.1 for runner in found)
    euler = next(runner for runner in found if (runner.engine, runner.method) == ("smooth", "euler"))
    assert not euler.run(2.4).finite


def test_unknown_engines_are_named():
    with pytest.raises(EngineError, match="did you mean 'mujoco'"):
        report(swing(), engines=("mujoko",))


@pytest.mark.parametrize(("title", "name"), [('title = "A swing"\n', "A swing"), ("", "plain")])
def test_a_report_bears_the_name_of_its_scene(tmp_path, title, name):
    path = tmp_path / "plain.toml"
    path.write_text(f'{title}duration = 0.1\n[[models]]\nfile = "pendulum"\n[initial.position]\nhinge = 1\n')
    found = report(path, budget_s=1e-4)
    assert found.name == name
    assert found.figure().get_suptitle() == name
