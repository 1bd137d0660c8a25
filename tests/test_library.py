"""Finding and loading models: names, files, URDF, and what is said when something is wrong."""

import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import mujoco
import pytest
from oracles.shapes import tetrahedron
from pantograph import models

ROBOTS = models.data_robots()
needs_data = pytest.mark.skipif(
    not ROBOTS, reason="no data folder: neither PANTOGRAPH_DATA nor ../shared/data"
)

BALL = '<body name="ball"><geom size=".1"/><joint name="j"/></body>'


def mjcf(inside: str) -> str:
    return f"<mujoco>\n{inside}\n</mujoco>"


def world(inside: str) -> str:
    return mjcf(f"<worldbody>\n{inside}\n</worldbody>")


# name: (text of the file, pieces that the message must hold in this order)
BROKEN = {
    "empty": ("", ["broken.xml", "empty", "<mujoco>"]),
    "blank": (" \n\n", ["broken.xml", "empty"]),
    "not XML": ("hello world", ["broken.xml", "not XML", "'hello world'", "<mujoco>"]),
    "unclosed tag": (
        "<mujoco>\n<worldbody>\n<body>\n</worldbody></mujoco>",
        ["broken.xml:4", "mismatched tag"],
    ),
    "cut off": ('<mujoco>\n<worldbody><body name="a"><geom si', ["broken.xml:2", "not well-formed"]),
    "other XML": ("<html><body/></html>", ["broken.xml", "<html>", "<mujoco>", "<robot>"]),
    "binary": (b"solid\x80\xff\x00", ["broken.xml", "not a text file", "UTF-8"]),
    "UTF-16": (mjcf("").encode("utf-16"), ["broken.xml", "UTF-8"]),
    "unknown element": (
        world('<bodyy name="x"/>'),
        ["broken.xml:3", "<bodyy> in <worldbody>", "did you mean 'body'", "geom"],
    ),
    "removed element": (
        world('<body><composite type="cable"/></body>'),
        ["broken.xml:3", "<composite> in <body>"],
    ),
    "unknown section": (
        mjcf("<worldbdy/>"),
        ["broken.xml:2", "<worldbdy> in <mujoco>", "did you mean 'worldbody'"],
    ),
    "unknown attribute": (
        world('<body nam="x"/>'),
        ["broken.xml:3", "'nam'", '<body nam="x"/>', "'name'", "quat"],
    ),
    "unknown keyword": (
        world(BALL.replace("<joint", '<joint type="hing"')),
        ["broken.xml:3", "'hing'", "hing"],
    ),
    "words for numbers": (world('<body pos="a b c"/>'), ["broken.xml:3", "'pos'", "numbers"]),
    "too few numbers": (world('<body pos="0 0"/>'), ["broken.xml:3", "'pos'", "enough", "exactly"]),
    "too many numbers": (world('<body pos="0 0 0 0"/>'), ["broken.xml:3", "'pos'", "too much", "exactly"]),
    "NaN": (
        world(BALL.replace("<body", '<body pos="nan 0 0"')),
        ["broken.xml", "finite", ":3: pos='nan 0 0'"],
    ),
    "NaN mass": (
        world(BALL.replace("<geom", '<geom mass="NaN"')),
        ["broken.xml", "finite", ":3: mass='NaN'"],
    ),
    "infinity": (world(BALL.replace("<body", '<body pos="0 -inf 0"')), ["finite", ":3: pos='0 -inf 0'"]),
    "NaN limit": (world(BALL.replace("<joint", '<joint range="0 nan"')), ["finite", ":3: range='0 nan'"]),
    "massless": (
        world('<body name="arm"><joint/></body>'),
        ["broken.xml:3", "mass", "'arm'", "give it a geom with mass"],
    ),
    "negative mass": (
        world(BALL.replace("<geom", '<geom mass="-1"')),
        ["broken.xml:3", "negative", "positive"],
    ),
    "impossible inertia": (
        world('<body name="arm"><joint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 9"/></body>'),
        ["broken.xml:3", "A + B >= C", "'arm'", "balanceinertia"],
    ),
    "duplicate body": (
        world(f"{BALL}\n{BALL}"),
        ["broken.xml:4", "repeated name 'ball'", "lines 3, 4", "unique"],
    ),
    "duplicate joint": (
        world(f"{BALL}\n{BALL.replace('ball', 'cube')}"),
        ["broken.xml:4", "repeated name 'j' in joint", "lines 3, 4"],
    ),
    "unknown joint": (
        mjcf(f'<worldbody>{BALL}</worldbody>\n<actuator><motor joint="knee"/></actuator>'),
        ["broken.xml:3", "'knee'", "define it"],
    ),
    "unknown material": (
        world(BALL.replace("<geom", '<geom material="gold"')),
        ["broken.xml:3", "'gold'", "define it"],
    ),
    "unknown mesh": (
        world('<geom type="mesh" mesh="m"/>'),
        ["broken.xml:3", "mesh 'm' not found", "define it"],
    ),
    "box without size": (
        world('<body><geom type="box" size=".1"/></body>'),
        ["broken.xml:3", "size", "positive"],
    ),
    "limits upside down": (
        world(BALL.replace("<joint", '<joint limited="true" range="1 -1"')),
        ["broken.xml:3", "range[0]", "'j'", "lower bound first"],
    ),
    "nested free joint": (
        world('<body><body name="arm"><geom size=".1"/><freejoint/></body></body>'),
        ["broken.xml:3", "'arm'", "<worldbody>"],
    ),
    "zero quaternion": (world('<body quat="0 0 0 0"/>'), ["broken.xml:3", "zero quaternion", "1 0 0 0"]),
    "keyframe too long": (
        mjcf(f'<worldbody>{BALL}</worldbody><keyframe><key name="up" qpos="0 0"/></keyframe>'),
        ["broken.xml", "'up'", "expected 1, got 2"],
    ),
    "missing mesh": (
        mjcf('<compiler meshdir="parts"/>\n<asset><mesh name="m" file="whel.stl"/></asset>'),
        [
            "broken.xml:3",
            "mesh 'whel.stl' is missing",
            "did you mean 'wheel.stl'",
            "looked for",
            "parts/whel.stl",
            "wheel.stl",
        ],
    ),
    "missing mesh folder": (
        mjcf('<compiler meshdir="prts"/>\n<asset><mesh name="m" file="wheel.stl"/></asset>'),
        ["broken.xml:3", "mesh 'wheel.stl' is missing", "prts", "no such folder", "holds", "lonely.obj"],
    ),
    "damaged mesh": (
        mjcf('<asset><mesh name="m" file="lonely.obj"/></asset>'),
        ["broken.xml", "lonely.obj"],
    ),
    "missing picture": (
        mjcf('<asset><texture name="t" type="2d" file="sky.png"/></asset>'),
        ["broken.xml:2", "picture 'sky.png' is missing", "looked for", "no .png"],
    ),
    "missing include": (
        mjcf('\n<include file="arm.xml"/>'),
        ["broken.xml:3", "'arm.xml' is missing", "part.xml"],
    ),
    "circular include": (mjcf('<include file="broken.xml"/>'), ["broken.xml:2", "already included", "once"]),
    "mistake in an include": (
        mjcf('<include file="part.xml"/>'),
        ["part.xml:3", "'colour'", '<geom size=".1" colour="red"/>'],
    ),
}


@pytest.fixture
def folder(tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "wheel.stl").write_bytes(tetrahedron())
    (tmp_path / "lonely.obj").write_text("not a mesh\n")
    (tmp_path / "part.xml").write_text(
        '<mujoco>\n<worldbody>\n<geom size=".1" colour="red"/>\n</worldbody>\n</mujoco>'
    )
    (tmp_path / "ghost.xml").write_text(
        '<mujoco><worldbody>\n<body name="ghost"><joint/></body></worldbody></mujoco>'
    )
    return tmp_path


@pytest.mark.parametrize("case", BROKEN)
def test_broken_file_says_where_what_and_the_fix(folder, case):
    content, pieces = BROKEN[case]
    path = folder / "broken.xml"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    for load in (models.load_model, models.load_spec):
        with pytest.raises(models.ModelError) as caught:
            load(path)
        assert re.search(".*".join(map(re.escape, pieces)), str(caught.value), re.DOTALL), str(caught.value)


def test_comments_are_no_mistakes_and_bounds_may_be_infinite(tmp_path):
    hinge = BALL.replace("<joint", '<joint range="-inf inf"')
    (tmp_path / "fine.xml").write_text(world(f'<!-- pos="nan 0 0"\n -->{hinge}'))
    assert models.load_model(tmp_path / "fine.xml").njnt == 1


def test_limits_that_mujoco_would_drop_are_told(tmp_path):
    servo = '<actuator><position name="servo" joint="j" ctrlrange="2 1"/></actuator>'
    hinge = BALL.replace("<joint", '<joint range="1 -1"')
    (tmp_path / "loose.xml").write_text(mjcf(f"<worldbody>{hinge}</worldbody>{servo}"))
    with pytest.warns(models.ModelWarning) as caught:
        models.load_model(tmp_path / "loose.xml")
    told = [str(warning.message) for warning in caught]
    assert [
        "joint 'j' has no limit: its range" in told[0],
        "actuator 'servo' has no limit: its ctrlrange 2 1" in told[1],
    ] == [True, True]


def test_unknown_name_lists_what_exists_and_where_it_looked(tmp_path):
    with pytest.raises(models.ModelError) as caught:
        models.find("quadrupd", base=tmp_path)
    message = str(caught.value)
    assert "did you mean 'quadruped'" in message
    assert ", ".join(models.names()) in message
    assert str(tmp_path / "quadrupd") in message


def test_missing_file_lists_the_folder(folder):
    with pytest.raises(models.ModelError) as caught:
        models.find(folder / "prt.xml")
    for piece in (str(folder / "prt.xml"), "did you mean 'part.xml'", "holds ghost.xml, part.xml"):
        assert piece in str(caught.value)


def test_folder_instead_of_file(folder):
    with pytest.raises(models.ModelError, match=r"is a folder.*part\.xml"):
        models.find(folder)


@pytest.mark.parametrize(
    ("name", "says"),
    [("robot.txt", r"\.xml.*\.urdf.*'\.txt'"), ("robot", r"without"), ("robot.xacro", "expand")],
)
def test_wrong_ending(tmp_path, name, says):
    (tmp_path / name).write_text(mjcf(""))
    with pytest.raises(models.ModelError, match=says):
        models.load_model(tmp_path / name)


def test_unreadable_file(tmp_path, monkeypatch):
    path = tmp_path / "secret.xml"
    path.write_text(mjcf(""))

    def refuse(*_, **__):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "read_text", refuse)  # root may read everything, so that a mode would not do
    with pytest.raises(models.ModelError, match=r"secret\.xml.*Permission denied"):
        models.load_model(path)


def test_file_beside_base_goes_before_the_working_folder_and_the_names(tmp_path, monkeypatch):
    here, there = tmp_path / "here", tmp_path / "there"
    for place, name in ((here, "from_cwd"), (there, "from_base")):
        place.mkdir()
        (place / "pendulum.xml").write_text(world(BALL.replace('"j"', f'"{name}"')))
    (here / "arm6").mkdir()
    monkeypatch.chdir(here)
    assert models.joint_names(models.load_model("pendulum.xml", base=there)) == ("from_base",)
    assert models.joint_names(models.load_model("pendulum.xml")) == ("from_cwd",)
    assert models.joint_names(models.load_model("pendulum")) == ("hinge",)
    assert models.find("arm6").is_file(), "a folder of that name does not hide the built-in model"


def test_data_folder_of_the_environment(tmp_path, monkeypatch):
    robot = tmp_path / "robots" / "acme_roller"
    robot.mkdir(parents=True)
    (robot / "roller.xml").write_text(world(BALL))
    (robot / "scene.xml").write_text(mjcf('<include file="roller.xml"/>'))
    monkeypatch.setenv("PANTOGRAPH_DATA", str(tmp_path))
    assert list(models.data_robots()) == ["roller"]
    assert models.load_model("roller").njnt == 1
    monkeypatch.setenv("PANTOGRAPH_DATA", str(tmp_path / "nowhere"))
    with pytest.raises(models.ModelError, match=r"PANTOGRAPH_DATA is .*nowhere"):
        models.find("roller")


@needs_data
@pytest.mark.parametrize("name", ROBOTS)
def test_robots_of_the_data_folder_load(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model = models.load_model(name)
    assert model.njnt > 0
    assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, "floor") < 0 or name == "humanoid", (
        "without its scene"
    )


@needs_data
@pytest.mark.filterwarnings("ignore:Attach conflict")
def test_robot_keeps_its_meshes_when_it_joins_another(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parent = mujoco.MjSpec()
    with models.captured_warnings():  # MuJoCo tells that the parent's options win
        parent.attach(models.load_spec("wx250s"), prefix="left_", frame=parent.worldbody.add_frame())
    assert parent.compile().nmesh == models.load_model("wx250s").nmesh


def test_lookup_names_and_indices_agree():
    model = mujoco.MjModel.from_xml_string(
        world(
            '<body><geom name="geom1" size="1"/><geom size="1"/><geom size="1"/>'
            '<joint/><joint name="j" axis="1 0 0"/></body>'
        )
    )
    assert models.names_of(model, "geom") == ("geom1", "geom1_", "geom2")
    assert models.joint_names(model) == ("joint0", "j")
    for kind in ("body", "joint", "geom"):
        for index, name in enumerate(models.names_of(model, kind)):
            assert models.lookup(model, kind, name) == index
    for index in (-1, 2):
        with pytest.raises(models.ModelError, match=r"index .* has 2"):
            models.name_of(model, "joint", index)
    with pytest.raises(models.ModelError, match="no joint ''"):
        models.lookup(model, "joint", "")
    with pytest.raises(models.ModelError, match=r"no kind 'bone'.*body, camera"):
        models.lookup(model, "bone", "j")


def test_a_servo_with_several_inputs_is_one_actuator():
    servos = '<actuator><pid name="servo" joint="j" kp="1"/><motor name="motor" joint="j"/></actuator>'
    model = mujoco.MjModel.from_xml_string(mjcf(f"<worldbody>{BALL}</worldbody>{servos}"))
    assert model.nu > model.nactuator
    assert models.names_of(model, "actuator") == ("servo", "motor")


@pytest.mark.parametrize(
    "kind", ["body", "joint", "geom", "site", "actuator", "camera", "light", "tendon", "key"]
)
def test_lookup_of_every_kind_lists_what_exists(kind):
    model = models.load_model("arm6")
    with pytest.raises(models.ModelError, match=f"no {kind} 'nonsense'.*this model has: ") as caught:
        models.lookup(model, kind, "nonsense")
    listed = str(caught.value).split(": ")[-1]
    assert listed == (", ".join(sorted(models.names_of(model, kind))) or "none")


def run_python(code: str, cwd: Path) -> subprocess.CompletedProcess:
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    return subprocess.run(
        [sys.executable, "-c", code], cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )


def test_own_models_py_does_not_shadow_ours(tmp_path):
    for name in ("models", "sim"):
        (tmp_path / f"{name}.py").write_text("raise RuntimeError('the wrong one')")
    done = run_python("from pantograph import models; print(models.load_model('arm6').nv)", tmp_path)
    assert (done.returncode, done.stdout.strip()) == (0, "6"), done.stderr


def test_what_mujoco_warns_becomes_a_warning_and_leaves_no_log_file(tmp_path):
    (tmp_path / "child.xml").write_text(mjcf(f'<option integrator="RK4"/><worldbody>{BALL}</worldbody>'))
    (tmp_path / "parent.xml").write_text(
        mjcf(
            '<asset><model name="child" file="child.xml"/></asset>'
            '<worldbody><attach model="child" body="ball" prefix="a_"/></worldbody>'
        )
    )
    code = (
        "import warnings\n"
        "from pantograph import models\n"
        "with warnings.catch_warnings(record=True) as caught:\n"
        "    warnings.simplefilter('always')\n"
        "    models.load_model('parent.xml')\n"
        "print([w.category.__name__ for w in caught], 'integrator' in str(caught[0].message))"
    )
    done = run_python(code, tmp_path)
    assert (done.returncode, done.stdout, done.stderr) == (0, "['ModelWarning'] True\n", "")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["child.xml", "parent.xml"]


def test_captured_warnings_restores_what_was_there():
    seen = []
    text = world(BALL.replace("<body", '<body pos="nan 0 0"'))
    before = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(seen.append)
    try:
        with models.captured_warnings() as messages:
            mujoco.MjModel.from_xml_string(text)
        mujoco.MjModel.from_xml_string(text)
    finally:
        mujoco.set_mju_user_warning(before)
    assert len(messages) == len(seen) == 1
