import json
import os
import re
import signal
import subprocess
import sys
import time
import tomllib
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from gl import needs_gl
from pantograph.sim import Scene, load, load_scene, make_plan, run
from pantograph.sim.cli.app import run_app
from test_servo_faults import RIG

SCENES = Path(__file__).parents[1] / "models" / "scenes"
SWING = 'duration = 0.3\ntitle = "swing"\n[[models]]\nfile = "pendulum"\n[initial.position]\nhinge = 1\n'
EXPLODING = """\
duration = 5.0
[[models]]
file = "spring.xml"
[initial.position]
x = 1
[solver]
engine = "contact"
integrator = "euler"
step = 0.1
"""
SPRING = """<mujoco><worldbody><body><joint name="x" type="slide" stiffness="1e6"/>
  <geom size="0.1" mass="1"/></body></worldbody></mujoco>"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "swing.toml").write_text(SWING)
    (tmp_path / "exploding.toml").write_text(EXPLODING)
    (tmp_path / "spring.xml").write_text(SPRING)
    return tmp_path


@pytest.fixture
def pantograph(folder, monkeypatch, capsys):
    """The command in this process: its exit code, standard output and standard error."""

    def command(*words):
        monkeypatch.setattr(sys, "argv", ["pantograph", *map(str, words)])
        code = 0
        try:
            run_app()
        except SystemExit as e:
            code = e.code or 0
        out, err = capsys.readouterr()
        return code, out, err

    return command


def test_run_saves_a_recording_and_prints_a_summary(pantograph, folder):
    code, out, err = pantograph("run", "swing.toml", "--error")
    assert (code, err) == (0, "")
    r = load(folder / "out" / "swing.npz")
    assert r.error is not None
    for words in (
        "swing",
        f"{r.stats['engine']}, {r.stats['integrator']}, step {r.stats['step']:.6g} s",
        f"0.3 s in {len(r.t)} samples (done)",
        "times real time",
        f"evaluations │ {r.stats['evaluations']}",
        f"{r.energy[0]:.6g} J at first",
        f"{r.error.angle.max():.3g} rad",
        "recording: out/swing.npz",
    ):
        assert words in re.sub(" +", " ", out), words


def test_bare_names_of_films_and_plots_land_in_the_output_folder(pantograph, folder):
    code, out, _ = pantograph("run", "swing.toml", "--plot", "p.png", "--out", "there")
    assert code == 0
    assert (folder / "there" / "p.png").is_file()
    assert (folder / "there" / "swing.npz").is_file()
    assert "plot: there/p.png" in out
    pantograph("run", "swing.toml", "--plot", folder / "here.svg")
    assert (folder / "here.svg").is_file()


def test_mistakes_of_a_scene_are_told_on_stderr_with_exit_code_2(pantograph, folder):
    (folder / "bad.toml").write_text(SWING + "[solver]\nstep = -1\nspeed = 3\n")
    for command in ("run", "plan"):
        code, out, err = pantograph(command, "bad.toml")
        assert (code, out) == (2, "")
        assert "error: bad.toml: 2 mistakes\n  line 8, solver.step: must be" in err
        assert "line 9, solver.speed: no word 'speed'" in err
    assert not (folder / "out").exists()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("run", "no.toml"), "no scene file no.toml; . has: exploding.toml, swing.toml"),
        (("run", "."), "is a folder; give the scene file in it"),
        (("run",), "Missing argument"),
        (("run", "swing.toml", "--speed", "3"), "No such option"),
        (("fly",), "No such command"),
        (("plot", "no.npz", "p.png"), "no recording no.npz"),
        (("film", "swing.toml", "f.mp4"), "is not a recording"),
        (("models", "pendulm"), "did you mean 'pendulum'?"),
        (("new", "swing.toml"), "swing.toml exists already; choose another name"),
        (("new", "swing.toml/new.toml"), "cannot write swing.toml/new.toml"),
    ],
)
def test_wrong_input_has_exit_code_2_and_its_message_on_stderr(pantograph, words, says):
    code, out, err = pantograph(*words)
    assert (code, out) == (2, "")
    assert says in err
    assert "Traceback" not in err


def test_a_diverged_run_has_exit_code_1_and_is_saved(pantograph, folder):
    code, out, err = pantograph("run", "exploding.toml", "--plot", "p.png")
    assert code == 1
    assert re.match(r"diverged: diverged at t = .* joint 'x'", err)
    r = load(folder / "out" / "exploding.npz")
    assert r.status == "diverged"
    assert "(diverged)" in out
    assert (folder / "out" / "p.png").is_file()


def test_a_run_interrupted_at_once_is_saved_and_drawn_as_far_as_it_went(pantograph, folder, monkeypatch):
    module = sys.modules[run.__module__]

    def stop(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(module, "run", lambda plan, **_: run(plan, progress=stop))
    (folder / "swing.toml").write_text(SWING + '[solver]\nengine = "contact"\n')
    code, _, err = pantograph("run", "swing.toml", "--plot", "p.png")
    assert code == 130
    assert err.startswith("interrupted: interrupted at t = ")
    kept = load(folder / "out" / "swing.npz")
    assert kept.status == "interrupted"
    assert 0 < kept.t[-1] < 0.3
    assert (folder / "out" / "p.png").is_file()


def test_a_run_whose_controller_fails_is_saved_and_told(pantograph, folder, monkeypatch):
    from pantograph.controllers.pd import PD

    def law(self, t, q, v, target, memory):
        return (np.zeros(len(v)), memory) if t < 0.1 else 1 / 0

    monkeypatch.setattr(PD, "__call__", law)
    keys = (
        '[roles]\ntracked = ["hinge"]\n[[keys]]\njoint = "hinge"\ntimes = [0]\nvalues = [0]\n[controller]\n'
    )
    (folder / "broken.toml").write_text(SWING + keys + '[solver]\nengine = "contact"\n')
    code, out, err = pantograph("run", "broken.toml", "--error")
    assert code == 1
    assert re.match(
        r"failed: failed at t = 0\.1 s: ZeroDivisionError: division by zero \(.*test_cli\.py, line", err
    )
    assert "Traceback" not in err
    kept = load(folder / "out" / "broken.npz")
    assert (kept.status, kept.t[-1]) == ("failed", pytest.approx(0.1))
    assert "0.1 s in" in out


def test_notes_of_what_was_crossed_are_printed(pantograph, folder):
    text = SWING + '[physics]\ncontacts = "none"\n[[props]]\nname = "ball"\nshape = "sphere"\nsize = [0.1]\n'
    (folder / "fall.toml").write_text(text)
    code, out, _ = pantograph("run", "fall.toml")
    assert code == 0
    assert "note: world and ball overlap by" in out


def test_plan_explains_without_running(pantograph, folder):
    code, out, err = pantograph("plan", "swing.toml")
    assert (code, err) == (0, "")
    plan = make_plan("swing.toml")
    assert re.search(r"passive joints *│ hinge", out)
    said = re.sub(r"[│\s]+", " ", out)  # a narrow terminal breaks the lines of the table
    for choice in (plan.engine, plan.integrator, plan.step):
        assert f"{choice.what}: {choice.why}" in said
    for line in (*plan.left_out, *plan.cheaper):
        assert line in said
    assert not (folder / "out").exists()


def test_plots_of_a_recording(pantograph, folder):
    pantograph("run", "swing.toml")
    code, out, _ = pantograph("plot", "out/swing.npz", "p.svg", "--joint", "hinge")
    assert (code, out) == (0, "plot: p.svg\n")
    assert "hinge" in (folder / "p.svg").read_text()
    code, _, err = pantograph("plot", "out/swing.npz", "p.svg", "--joint", "knee")
    assert code == 2
    assert "no hinge or slide joint 'knee'" in err


@needs_gl
def test_films_of_a_recording(pantograph, folder):
    pantograph("run", "swing.toml")
    code, out, err = pantograph("film", "out/swing.npz", "f.png", "--at", "0.1", "--size", "64x48")
    assert (code, err) == (0, "")
    assert out == "film: f.png\n"  # nothing of a built-in model is left out
    assert (folder / "f.png").read_bytes().startswith(b"\x89PNG")
    for size in ("64", "64x", "axb", "0x9", "-1x9", "64x48x3"):
        code, _, err = pantograph("film", "out/swing.npz", "f.png", "--at", "0.1", f"--size={size}")
        assert code == 2
        assert "a size is WIDTHxHEIGHT, as 640x480" in err
    code, _, err = pantograph("film", "out/swing.npz", "f.png", "--at", "7")
    assert code == 2
    assert "no picture at t = 7 s: the recording ends at 0.3 s" in err
    code, _, err = pantograph("film", "out/swing.npz", "f.mp4", "--camera", "top")
    assert code == 2
    assert "no camera 'top'" in err


def test_ctrl_c_in_a_film_says_what_is_kept(pantograph, folder, monkeypatch):
    """Typer makes a silent exit of Ctrl-C; a film keeps its first frames."""
    from pantograph.sim import film

    pantograph("run", "swing.toml")

    def frames(*args, **kwargs):
        yield np.zeros((48, 64, 3), dtype=np.uint8)
        raise KeyboardInterrupt

    shoot = import_module("pantograph.sim.shoot")  # the front door gives the function
    monkeypatch.setattr(shoot, "film", lambda m, t, q, path, **_: film.write(path, frames(), fps=30.0))
    code, out, err = pantograph("film", "out/swing.npz", "f.mp4")
    assert (code, out) == (130, "")
    assert err == "interrupted; the film so far is f.mp4\n"
    assert (folder / "f.mp4").is_file()
    monkeypatch.setattr(shoot, "film", lambda *args, **_: (_ for _ in ()).throw(KeyboardInterrupt))
    code, _, err = pantograph("run", "swing.toml", "--film", "g.mp4")
    assert (code, err) == (130, "interrupted\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--out", "file"), "cannot write into file: File exists; name another folder"),
        (("--out", "file/deeper"), "cannot write into file/deeper: Not a directory"),
        (("--film", "x.avi"), "cannot write '.avi' files"),
        (("--mirror", "nope"), "no rig file nope"),
        (("--mirror", "wx250s"), "no joint 'waist'"),
    ],
)
def test_what_would_spoil_the_end_is_found_before_the_work(pantograph, folder, monkeypatch, words, said):
    module = sys.modules[run.__module__]
    monkeypatch.setattr(module, "run", lambda *args, **_: pytest.fail("simulated"))
    (folder / "file").touch()
    code, _, err = pantograph("run", "swing.toml", *words)
    assert code == 2
    assert said in err


def test_a_new_scene_runs(pantograph, folder):
    code, out, _ = pantograph("new", "deep/wave.toml")
    assert code == 0
    assert "next: pantograph run deep/wave.toml" in out
    scene = load_scene("deep/wave.toml")
    text = (folder / "deep" / "wave.toml").read_text()
    shorter = text.replace("duration = 4.0", "duration = 0.2")
    assert shorter != text
    (folder / "short.toml").write_text(shorter)
    code, _, err = pantograph("run", "short.toml")
    assert (code, err) == (0, "")
    assert scene.duration == 4.0
    # what is commented out is right, too
    every = re.sub(r"^# (\[.*|\w+ = .*)$", r"\1", text, flags=re.MULTILINE)
    every = re.sub('^name = "left".*\n', "", every, flags=re.MULTILINE)
    assert every != text
    (folder / "every.toml").write_text(every)
    assert load_scene("every.toml").forces


def test_models_are_listed_and_described(pantograph):
    code, out, _ = pantograph("models")
    assert code == 0
    assert re.search(r"arm6 *│ 6 *│ 6 *│ 6", out)
    code, out, _ = pantograph("models", "cart_pole")
    assert code == 0
    assert re.search(r"slide *│ slide *│ -1.000 to 1.000 m", out)
    assert re.search(r"hinge *│ hinge *│ free", out)
    assert "actuator: slide" in out


def test_the_schema_knows_every_word(pantograph):
    code, out, _ = pantograph("schema")
    assert code == 0
    schema = json.loads(out)
    assert set(schema["properties"]) == set(Scene.model_fields)
    assert schema["required"] == ["duration"]
    assert schema["additionalProperties"] is False
    keys = schema["$defs"]["KeysItem"]
    assert keys["properties"]["curve"]["enum"] == ["step", "linear", "auto", "natural", "clamped"]
    assert set(keys["required"]) == {"times", "values"}


@pytest.mark.parametrize("path", sorted(SCENES.glob("*.toml")), ids=lambda p: p.stem)
def test_example_scenes_are_right(path):
    from pantograph.models import data_robots, names

    robots = {m["file"] for m in tomllib.loads(path.read_text())["models"] if "file" in m} - set(names())
    if missing := robots - set(data_robots()):
        pytest.skip(f"needs {', '.join(missing)} in the data folder: PANTOGRAPH_DATA")
    assert make_plan(path).problem.steps > 0


def test_help_is_help(pantograph):
    code, out, _ = pantograph("--help")
    assert code == 0
    for command in ("run", "plan", "film", "plot", "new", "models", "schema"):
        assert command in out
        assert "Example: pantograph" in pantograph(command, "--help")[1]


def start(folder, *words, module=True):
    """The command as a process of its own, in ``folder``."""
    program = (
        [sys.executable, "-m", "pantograph.sim"]
        if module
        else [str(Path(sys.executable).with_name("pantograph"))]
    )
    return subprocess.Popen(
        [*program, *words],
        cwd=folder,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "COLUMNS": "200"},
        start_new_session=True,
    )


@pytest.mark.parametrize("engine", ["contact", "auto"])
def test_ctrl_c_keeps_what_was_recorded(folder, engine):
    text = SWING.replace("duration = 0.3", "duration = 1e5\nrate = 1")
    (folder / "long.toml").write_text(text + f'[solver]\nengine = "{engine}"\n')
    for patience in (3, 10, 20):  # the program needs its time to start
        process = start(folder, "run", "long.toml")
        time.sleep(patience)
        assert process.poll() is None
        process.send_signal(signal.SIGINT)
        try:
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
        r = load(folder / "out" / "long.npz") if (folder / "out" / "long.npz").exists() else None
        if r is not None and len(r.t) > 1:
            break
    assert process.returncode == 130, (out, err)
    assert "interrupted at t = " in err
    assert "Traceback" not in err
    assert r.status == "interrupted"
    assert 0 < r.t[-1] < 1e5
    assert len(r.t) == len(r.q) == len(r.a)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="this system has no /dev/full")
@pytest.mark.parametrize("words", [("schema",), ("models",)])
def test_a_full_disk_is_told_in_a_line(folder, words):
    with Path("/dev/full").open("w") as full:
        process = subprocess.run(
            [sys.executable, "-m", "pantograph.sim", *words],
            stdout=full,
            stderr=subprocess.PIPE,
            text=True,
        )
    assert (process.returncode, process.stderr) == (1, "error: No space left on device\n")


def test_a_folder_that_cannot_be_made_is_told_in_a_line(pantograph, folder):
    (folder / "file").write_text("")
    for words in (("run", "swing.toml"), ("report", "swing.toml")):
        code, _, err = pantograph(*words, "--out", "file/there")
        assert code in (1, 2)
        assert "Not a directory" in err
        assert err.count("\n") == 1


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ({"PYOPENGL_PLATFORM": "glx"}, "PYOPENGL_PLATFORM is 'glx', which needs a window"),
        ({}, "films need PyAV, which does not load (no libavcodec)"),
    ],
)
def test_a_film_that_cannot_be_made_is_told_before_the_run(folder, setting, says):
    if not setting:
        (folder / "av").mkdir()
        (folder / "av" / "__init__.py").write_text("raise ImportError('no libavcodec')\n")
        setting = {"PYTHONPATH": os.pathsep.join([str(folder), os.environ.get("PYTHONPATH", "")])}
    process = subprocess.run(
        [sys.executable, "-m", "pantograph.sim", "run", "swing.toml", "--film", "swing.mp4"],
        env={**os.environ, **setting},
        capture_output=True,
        text=True,
    )
    assert process.returncode == 2
    assert process.stderr.startswith(f"error: {says}")
    assert "Traceback" not in process.stderr
    assert not list((folder / "out").glob("*.npz"))


INTERRUPTING = """\
import importlib, os, signal, sys
os.kill(os.getpid(), signal.SIGINT)
sys.path.remove({folder!r})
del sys.modules[{name!r}]
sys.modules[{name!r}] = importlib.import_module({name!r})
"""


@pytest.mark.parametrize(
    ("library", "words"),
    [
        ("mujoco", ("models",)),
        ("typer", ("servo", "--help")),
        ("rich", ("run", "swing.toml")),
        ("llvmlite", ("run", "swing.toml")),
        ("matplotlib", ("report", "swing.toml")),
        ("dynamixel_sdk", ("servo", "jog", "rig.toml", "elbow", "1")),
    ],
)
def test_ctrl_c_while_a_library_loads_is_one_line(folder, library, words):
    (folder / "rig.toml").write_text(RIG)
    (folder / "first").mkdir()
    interrupting = INTERRUPTING.format(folder=str(folder / "first"), name=library)
    (folder / "first" / f"{library}.py").write_text(interrupting)
    path = os.pathsep.join([str(folder / "first"), *filter(None, [os.environ.get("PYTHONPATH")])])
    process = subprocess.run(
        [sys.executable, "-m", "pantograph.sim", *words],
        env={**os.environ, "PYTHONPATH": path},
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert (process.returncode, process.stderr) == (130, "interrupted\n"), process.stdout


def test_a_users_own_modules_do_not_break_the_command(folder):
    for name in ("models", "sim", "controllers", "hardware", "scene", "run", "plan"):
        (folder / f"{name}.py").write_text("raise RuntimeError('the wrong module')\n")
    for module in (True, False):
        if not module and not Path(sys.executable).with_name("pantograph").exists():
            continue
        process = start(folder, "run", "swing.toml", module=module)
        out, err = process.communicate(timeout=60)
        assert (process.returncode, err) == (0, "")
        assert "recording: out/swing.npz" in out


def test_a_setting_of_mujoco_that_cannot_work_is_named(folder):
    """MuJoCo loads PyOpenGL for MUJOCO_GL = osmesa; without the library that fails with words of its own."""
    (folder / "OpenGL").mkdir()
    (folder / "OpenGL" / "__init__.py").write_text("raise AttributeError('no glGetError')\n")
    environment = {**os.environ, "MUJOCO_GL": "osmesa", "PYTHONPATH": str(folder)}
    environment["PYTHONPATH"] += os.pathsep + os.environ.get("PYTHONPATH", "")
    process = subprocess.run(
        [sys.executable, "-c", "from pantograph.sim import run"],
        env=environment,
        capture_output=True,
        text=True,
    )
    says = "MuJoCo does not load with MUJOCO_GL = 'osmesa' (no glGetError): unset it"
    assert says in process.stderr
    process = subprocess.run(
        [sys.executable, "-m", "pantograph.sim", "models"], env=environment, capture_output=True, text=True
    )
    assert process.returncode == 2
    assert process.stderr.startswith("error: " + says)


def test_the_models_of_the_data_folder_are_listed(pantograph, folder, monkeypatch):
    robot = folder / "data" / "robots" / "mine"
    robot.mkdir(parents=True)
    (robot / "my_robot.xml").write_text(SPRING)
    monkeypatch.setenv("PANTOGRAPH_DATA", str(folder / "data"))
    assert "robots of the data folder: my_robot\n" in pantograph("models")[1]
    monkeypatch.setenv("PANTOGRAPH_DATA", str(folder))
    assert "robots of the data folder" not in pantograph("models")[1]
