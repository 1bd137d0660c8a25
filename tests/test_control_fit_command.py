"""The command `pantograph fit`: what it writes, what it judges by, what it says."""

import re
import tomllib
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from pantograph.controllers.fit import check, fit, machine, prove, retime
from pantograph.controllers.fit.keys import as_keys
from pantograph.controllers.fit.task import task_of
from pantograph.controllers.nominal import difference
from pantograph.models import load_model
from pantograph.sim import PantographError, Scene, load, make_plan, parse_scene
from pantograph.sim.cli.template import TEMPLATE
from pantograph.sim.clip import Clip, FreeTrack
from pantograph.sim.curves import keyed
from pantograph.sim.rotation_curves import keyed_rotation
from pantograph.sim.rotations import exp, multiply, normalize
from pantograph.sim.scene.load import load_scene
from pantograph.sim.scene.motion import curves
from pantograph.sim.scene.schema import KeysItem
from typer.testing import CliRunner

FLOAT = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><body><freejoint name="root"/><geom size=".1"/><body pos=".3 0 0">
    <joint name="ball" type="ball"/><geom size=".1"/><body pos=".3 0 0"><joint name="hinge"/>
    <geom size=".1"/></body></body></body></worldbody></mujoco>"""
)


def command():
    import typer
    from pantograph.controllers.fit_command import fit as made

    app = typer.Typer()
    app.command()(made)
    return app


LATE = """duration = 2.0
[[models]]
file = "planar_2r"
[[keys]]
joint = "shoulder"
times = [0.5, 1.5]
values = [-1.0, 0.5]
[[keys]]
joint = "elbow"
times = [0.5, 1.5]
values = [0.5, 1.5]
[fit]
hard = [1.5]
velocity = 2
"""


@pytest.mark.parametrize("how", ["fit", "retime", "nearest"])
def test_a_wait_before_the_first_key_stays(how, tmp_path):
    """The motion begins at 0.5 s, is recorded to its end, and its keys are those of a scene."""
    scene = tmp_path / "late.toml"
    scene.write_text(LATE)
    words = [str(scene), "--how", how, "--out", str(tmp_path), "--keys", "new.toml"]
    words += ["--jerk", "400"] if how == "nearest" else []
    done = CliRunner().invoke(command(), words)
    assert done.exit_code == 0, done.output
    recording = load(tmp_path / "late.fit.npz")
    waits = recording.t < 0.5
    np.testing.assert_allclose(recording.q[waits], np.tile([-1.0, 0.5], (waits.sum(), 1)), atol=1e-9)
    np.testing.assert_allclose(recording.q[-1], [0.5, 1.5], atol=1e-7)
    assert recording.t[-1] >= 1.5 - (how == "retime")
    assert np.abs(recording.v).max() <= 2.0 * (1 + 1e-3)
    begun = LATE.split("[[keys]]")[0]
    again = parse_scene(begun.replace("2.0", "4.0") + (tmp_path / "new.toml").read_text())
    keyed_again = make_plan(again).problem.clip
    np.testing.assert_allclose(keyed_again.evaluate(recording.t).q, recording.q, atol=2e-4)
    assert np.isfinite(recording.a).all()


def test_keys_are_those_of_turns_too():
    """Ball and free joints, hinges in degrees: read again they are the same motion."""
    rng = np.random.default_rng(2)
    turns = [normalize(rng.normal(size=4)) for _ in range(2)]
    turns[1] = multiply(turns[0], exp(rng.normal(size=3)))
    tracks = {
        "root": FreeTrack(keyed([0, 1], rng.normal(size=(2, 3))), keyed_rotation([0, 1], turns)),
        "ball": keyed_rotation([0, 1], turns[::-1], kind="clamped"),
        "hinge": keyed([0.2, 0.5, 1], [0.0, 2.0, -1.0]),
    }
    clip = Clip(FLOAT, tracks)
    found = as_keys(clip, degree=True)
    items = [KeysItem(**item) for item in tomllib.loads(found.text)["keys"]]
    scene = Scene(duration=1.0, angle="degree", models=[{"file": "arm6"}], keys=items)
    again, mistakes = curves(scene, FLOAT)
    assert not mistakes
    fine = np.linspace(0.0, 1.0, 997)
    names = {FLOAT.joint(j).name: track for j, track in again.tracks.items()}
    rows = zip(clip.evaluate(fine).q, Clip(FLOAT, names).evaluate(fine).q, strict=True)
    error = max(np.abs(difference(FLOAT, *row)).max() for row in rows)
    assert error <= 1.01 * found.error <= 1.01e-4


def test_a_scene_from_new_is_fitted_with_its_own_controller(tmp_path):
    """A loose ball that nothing keys is no part of the fit; the law of the proof is the scene's."""
    text = TEMPLATE.split("[[cameras]]")[0].replace("duration = 4.0 ", "duration = 1.0 ")
    text = re.sub(r"times = \[.*\]", "times = [0, 1]", text)
    text = re.sub(r"values = \[(-?\d+), (-?\d+).*\]", r"values = [\1, \2]", text)
    scene = tmp_path / "wave.toml"
    scene.write_text(text)
    words = [str(scene), "--how", "fit", "--force", "150", "--velocity", "6", "--out", str(tmp_path)]
    done = CliRunner().invoke(command(), words)
    assert done.exit_code == 0, done.output
    assert "the scene's pd in the loop" in done.output
    recording = load(tmp_path / "wave.fit.npz")
    assert not recording.v[:, -6:].any()  # the ball's


def test_a_proof_that_fails_is_told_and_counts(tmp_path):
    """A law too weak to follow: the certificate holds, the proof does not, and the recording is there."""
    scene = tmp_path / "slack.toml"
    scene.write_text(
        LATE.replace("[fit]", '[roles]\ntracked = ["*"]\n[controller]\nlaw = "pd"\nfrequency = 0.2\n[fit]')
    )
    done = CliRunner().invoke(command(), [str(scene), "--how", "fit", "--out", str(tmp_path)])
    assert "certificate to 0.001 holds" in done.output
    assert "proof to 0.05 rad or m DOES NOT HOLD" in done.output
    assert done.exit_code == 1
    assert (tmp_path / "slack.fit.npz").exists()
    scene.write_text(scene.read_text() + "within = 3.0\n")
    assert CliRunner().invoke(command(), [str(scene), "--how", "fit", "--out", str(tmp_path)]).exit_code == 0


def test_friction_beyond_the_motor_is_found(tmp_path):
    """4 N m against 5 N m of dry friction: nothing moves, whatever is asked."""
    (tmp_path / "stuck.xml").write_text(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="j" axis="0 0 1" frictionloss="5"/>'
        '<geom size=".1" mass="1" pos=".5 0 0"/></body></worldbody>'
        '<actuator><motor joint="j" ctrlrange="-4 4"/></actuator></mujoco>'
    )
    scene = tmp_path / "stuck.toml"
    scene.write_text(
        'duration = 1.0\n[[models]]\nfile = "stuck.xml"\n[[keys]]\njoint = "j"\ntimes = [0, 1]\n'
        "values = [0, 1.0]\n"
    )
    done = CliRunner().invoke(command(), [str(scene), "--how", "check"])
    assert done.exit_code == 1
    assert re.search(r"j +force +6\.\d+ +4 ", done.output)
    for how in ("fit", "retime"):
        with pytest.raises(PantographError, match=r"friction"):
            CliRunner().invoke(command(), [str(scene), "--how", how], catch_exceptions=False)


def test_a_range_is_kept(tmp_path):
    """The scene's range of a joint and one given go before the model's."""
    scene = tmp_path / "late.toml"
    scene.write_text(LATE + "[fit.position]\nelbow = [-2.0, 1.2]\n")
    done = CliRunner().invoke(command(), [str(scene), "--how", "check"])
    assert re.search(r"elbow +position +0\.3 +range +beyond", done.output)
    words = [str(scene), "--how", "fit", "--out", str(tmp_path), "--position", "elbow=-2:1.4"]
    found = fit(
        task_of(load_scene(scene)).clip, task_of(load_scene(scene), position={"elbow": (-2, 1.4)}).machine
    )
    assert found.clip.evaluate(np.linspace(0.5, 1.5, 301)).q[:, 1].max() <= 1.4 * (1 + 1e-3)
    with pytest.raises(PantographError, match=r"0\.1 rad or m beyond the range of 'elbow'"):
        CliRunner().invoke(command(), words, catch_exceptions=False)
    with pytest.raises(PantographError, match="JOINT=low:high"):
        CliRunner().invoke(command(), [*words[:-1], "elbow=2"], catch_exceptions=False)


def test_retiming_keeps_the_keyed_speeds_at_the_ends(tmp_path):
    """[fit] at_rest = false: it moves at the ends, at most as fast as keyed."""
    scene = tmp_path / "moving.toml"
    scene.write_text(
        LATE.replace("values = [0.5, 1.5]\n", 'values = [0.5, 1.5]\ncurve = "linear"\n') + "at_rest = false\n"
    )
    words = [str(scene), "--how", "retime", "--acceleration", "9", "--out", str(tmp_path)]
    speeds = []
    for _ in range(2):
        assert CliRunner().invoke(command(), words).exit_code == 0
        recording = load(tmp_path / "moving.fit.npz")
        speeds.append(np.abs(recording.v[recording.t >= 0.5][0]).max())
        scene.write_text(scene.read_text().replace("at_rest = false", "at_rest = true"))
    assert speeds[0] > 0.5
    assert speeds[1] == pytest.approx(0.0, abs=0.1)


def test_a_body_in_flight_that_nothing_steers_is_proved(tmp_path):
    """No regulator without end exists for it; the command ends with a proof and with the recording."""
    (tmp_path / "satellite.xml").write_text(
        '<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint name="root"/>'
        '<inertial pos="0 0 0" mass="3" diaginertia=".2 .25 .3"/><body><joint name="wheel" axis="0 0 1"/>'
        '<inertial pos="0 0 0" mass="1" diaginertia=".01 .01 .02"/></body></body></worldbody></mujoco>'
    )
    scene = tmp_path / "turn.toml"
    scene.write_text(
        'duration = 1.0\n[[models]]\nfile = "satellite.xml"\n'
        '[[keys]]\njoint = "wheel"\ntimes = [0, 1]\nvalues = [0, 2]\n[fit]\nhow = "fit"\nhard = [1.0]\n'
    )
    done = CliRunner().invoke(command(), [str(scene), "--out", str(tmp_path)])
    assert done.exit_code == 0, done.output
    assert "proof to 0.05 rad or m holds: simulated with LQR in the loop" in done.output
    turned = load(tmp_path / "turn.fit.npz").q[-1, 3:7]
    assert 2 * np.arctan2(turned[3], turned[0]) == pytest.approx(-2.0 * 0.02 / 0.32, abs=1e-6)


def test_a_proof_has_what_the_machine_gives_and_no_more():
    """A motor that gives nothing beyond half of the fitted speed: cut there, and left behind."""
    arm = load_model("planar_2r")
    clip = Clip(arm, {"shoulder": keyed([2.0, 3.0], [-1.0, 0.5]), "elbow": keyed([2.0, 3.0], [0.5, 1.5])})
    able = machine(arm, force={"shoulder": 150.0, "elbow": 60.0})
    found = fit(clip, able, hard=[3.0])
    proof = prove(found, able)
    assert proof.holds
    assert proof.worst < 1e-4
    assert proof.saturated == 0.0
    assert proof.t[-1] == pytest.approx(1.0)
    slow = 0.5 * float(np.abs(found.clip.evaluate(found.t).v[:, 0]).max())
    weak = prove(found, replace(able, top_speed=np.array([slow, np.inf])))
    assert not weak.holds
    assert 0.1 < weak.saturated < 1.0


SWING = """duration = 1.0
[[models]]
file = "planar_2r"
[[keys]]
joint = "shoulder"
times = [0, 0.4, 1.0]
values = [-1.0, 0.3, 0.0]
curve = "natural"
[[keys]]
joint = "elbow"
times = [0, 0.6, 1.0]
values = [0.5, 1.0, 0.7]
curve = "natural"
[fit]
velocity = 6
"""


@pytest.mark.parametrize("how", ["nearest", "fit"])
def test_a_motion_that_is_possible_comes_back_as_it_is(how, tmp_path):
    """It moves at both ends, which is no fault; asked to rest there it is one, which check names."""
    scene = tmp_path / "swing.toml"
    scene.write_text(SWING)
    words = [str(scene), "--how", how, "--out", str(tmp_path)]
    done = CliRunner().invoke(command(), words)
    assert done.exit_code == 0, done.output
    assert "as keyed: possible" in done.output
    recording, keys = load(tmp_path / "swing.fit.npz"), task_of(load_scene(scene)).clip
    wanted = keys.evaluate(recording.t, left=True)
    assert np.abs(wanted.v[[1, -2]]).max() > 1.0
    np.testing.assert_allclose(recording.q, wanted.q, atol=1e-12)
    np.testing.assert_allclose(recording.v[1:-1], wanted.v[1:-1], atol=1e-12)
    # held after its end, or asked to rest: the first speed jumps at the end, the second at both
    for text in (SWING.replace("duration = 1.0", "duration = 1.5"), SWING + "at_rest = true\n"):
        scene.write_text(text)
        done = CliRunner().invoke(command(), [str(scene), "--how", "check"])
        assert done.exit_code == 1
        assert "speed jump" in done.output
        assert "rests at its ends" in done.output


def test_corners_and_jumps_are_no_motion(tmp_path):
    """Of a corner by 2 - (-3) rad/s, of a step by 0.5 rad: no machine does either, whatever its limits."""
    arm = load_model("planar_2r")
    line = Clip(arm, {"shoulder": keyed([0, 0.5, 1.0], [0.0, 1.0, -0.5], kind="linear")})
    found = check(line, machine(arm))
    (jump,) = [v for v in found.violations if v.kind == "speed jump"]
    assert not found.possible
    assert (jump.t, jump.value) == pytest.approx((0.5, 5.0))
    step = Clip(arm, {"shoulder": keyed([0, 0.5, 1.0], [0.0, 0.5, 0.5], kind="step")})
    (jump,) = [v for v in check(step, machine(arm)).violations if v.kind == "position jump"]
    assert (jump.t, jump.value) == pytest.approx((0.5, 0.5))
    ends = Clip(arm, {"shoulder": keyed([0.5, 1.0], [0.0, 1.0], kind="linear")})
    assert [v.t for v in check(ends, machine(arm)).violations if v.kind == "speed jump"] == [0.5]
    assert check(ends, machine(arm), at_rest=False).possible


def test_fits_at_an_end_that_moves_are_no_faster_than_keyed():
    """From 4 rad/s where 3 are allowed: it begins at 3 at most, and so does a retimed one."""
    arm = load_model("planar_2r")
    clip = Clip(
        arm,
        {n: keyed([0, 1.0], [0.0, far], kind="linear") for n, far in (("shoulder", 4.0), ("elbow", -1.0))},
    )
    able = machine(arm, velocity=3.0, force={"shoulder": 200.0, "elbow": 80.0})
    found = fit(clip, able)
    assert found.certificate.holds
    begins = found.clip.evaluate(0.0).v
    assert 1.0 < begins[0] <= 3.0 * (1 + 1e-3)
    assert -1.0 - 1e-6 <= begins[1] < 0.0
    with pytest.raises(PantographError, match=r"'shoulder' moves at 4 rad/s or m/s at 0 s, its limit is 3"):
        fit(clip, able, at_rest=False)


FINGERS = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="arm" axis="0 0 1"/>
<geom size=".1" mass="1" pos=".3 0 0"/><body pos=".5 0 0"><joint name="finger" type="slide" axis="0 1 0"
range="0.02 0.05"/><geom size=".02" mass=".1"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("how", ["check", "retime", "nearest", "fit"])
def test_joints_without_keys_that_start_out_of_range_are_named_at_once(how, tmp_path):
    (tmp_path / "hand.xml").write_text(FINGERS)
    scene = tmp_path / "hand.toml"
    text = 'duration = 1.0\n[[models]]\nfile = "hand.xml"\n[[keys]]\njoint = "arm"\ntimes = [0, 1]\n'
    scene.write_text(text + "values = [0, 1.0]\n")
    words = [str(scene), "--how", how, "--force", "50", "--out", str(tmp_path)]
    done = CliRunner().invoke(command(), words)
    assert done.exit_code == 1
    assert re.search(r"finger +position +0\.02 +range +beyond", done.output)
    said = (
        r"'finger' \(at 0, range 0\.02 to 0\.05 m\); give it a place within by \[initial\.position\], or keys"
    )
    assert re.search(said, done.output)
    if how != "check":
        assert isinstance(done.exception, PantographError)
    task = task_of(load_scene(scene))
    with pytest.raises(PantographError, match=said):
        fit(task.clip, task.machine)
    assert retime(task.clip, task.machine).clip.end > 0  # by itself it is about the path alone
    scene.write_text(scene.read_text() + "[initial.position]\nfinger = 0.03\n")
    assert CliRunner().invoke(command(), words).exit_code == 0


def test_limits_of_hinges_are_in_the_unit_of_the_scenes_angles(tmp_path):
    """One number and one a joint, of the scene and given; forces and slides stay as they are."""
    (tmp_path / "hand.xml").write_text(FINGERS)
    scene = tmp_path / "hand.toml"
    scene.write_text(
        'duration = 1.0\nangle = "degree"\n[[models]]\nfile = "hand.xml"\n[[keys]]\njoint = "arm"\n'
        "times = [0, 1]\nvalues = [0, 90]\n[fit]\nvelocity = 180\nacceleration = {arm = 90, finger = 2}\n"
        "force = 7\nposition = {arm = [-90, 180], finger = [-1, 1]}\n"
    )
    able = task_of(load_scene(scene), jerk={"": 360.0, "finger": 5.0}, top_speed={"arm": 720.0}).machine
    np.testing.assert_allclose(able.velocity, [np.pi, 180.0])
    np.testing.assert_allclose(able.acceleration, [np.pi / 2, 2.0])
    np.testing.assert_allclose(able.jerk, [2 * np.pi, 5.0])
    np.testing.assert_allclose(able.top_speed, [4 * np.pi, np.inf])
    np.testing.assert_allclose(able.force_high, [7.0, 7.0])
    np.testing.assert_allclose([able.low, able.high], [[-np.pi / 2, -1.0], [np.pi, 1.0]])


def test_the_law_of_a_proof_has_its_words_in_the_unit_of_the_scenes_angles(tmp_path):
    scene = tmp_path / "late.toml"
    text = LATE.replace("[fit]", '[roles]\ntracked = ["*"]\n[controller]\nlaw = "pd"\nbacklash = 90\n[fit]')
    scene.write_text('angle = "degree"\n' + text)
    assert task_of(load_scene(scene)).controller.parameters["backlash"] == pytest.approx(np.pi / 2)


def test_outputs_are_looked_at_before_the_work(tmp_path, monkeypatch):
    import pantograph.controllers.fit as solved

    scene = tmp_path / "late.toml"
    scene.write_text(LATE)
    (tmp_path / "afile").write_text("")
    monkeypatch.setattr(solved, "fit", None)  # not reached
    for more in (
        ["--keys", "afile/k.toml"],
        ["--out", "afile"],
        ["--film", "k.xyz"],
        ["--keys", str(tmp_path)],
    ):
        monkeypatch.chdir(tmp_path)
        with pytest.raises(PantographError, match=r"cannot write"):
            CliRunner().invoke(command(), [str(scene), "--how", "fit", *more], catch_exceptions=False)


def test_hard_times_are_times_of_keys(tmp_path):
    scene = tmp_path / "late.toml"
    scene.write_text(LATE)
    with pytest.raises(
        PantographError, match=r"no key to pass through at 0\.55 s; keys near it: 0\.5, 1\.5 s"
    ):
        task_of(load_scene(scene), hard=[0.55])


def test_drives_that_no_controller_can_use_are_named(tmp_path):
    """A motor with activation: its force has no limit here, unless one is given."""
    (tmp_path / "slow.xml").write_text(
        FINGERS.replace("0.02 0.05", "-1 1").replace(
            "</mujoco>",
            '<actuator><general joint="arm" name="slow" dyntype="filter" dynprm="0.1" ctrlrange="-1 1"/>'
            "</actuator></mujoco>",
        )
    )
    scene = tmp_path / "slow.toml"
    scene.write_text(
        'duration = 1.0\n[[models]]\nfile = "slow.xml"\n[[keys]]\njoint = "arm"\ntimes = [0, 1]\n'
        "values = [0, 1.0]\n"
    )
    said = "ideal forces without limit on tracked joint 'arm', instead of actuator 'slow'"
    assert said in CliRunner().invoke(command(), [str(scene)]).output
    assert said not in CliRunner().invoke(command(), [str(scene), "--force", "arm=3"]).output


def test_a_delay_as_long_as_the_motion_is_told(tmp_path):
    scene = tmp_path / "late.toml"
    text = LATE.replace("[fit]", '[roles]\ntracked = ["*"]\n[controller]\nlaw = "pd"\ndelay = 1.5\n[fit]')
    scene.write_text(text)
    done = CliRunner().invoke(command(), [str(scene), "--how", "fit", "--out", str(tmp_path)])
    assert "no force comes in time: the controller's delay of 1.5 s" in done.output
