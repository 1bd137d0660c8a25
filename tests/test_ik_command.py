"""The command `pantograph ik`."""

import mujoco
import numpy as np
import pytest
import typer
from gl import needs_gl
from pantograph.models import load_model
from pantograph.sim.cli.ik import ik
from pantograph.sim.errors import PantographError
from typer.testing import CliRunner

ARM = ("left_shoulder_pitch", "left_shoulder_roll", "left_shoulder_yaw", "left_elbow")


def _run(*words):
    app = typer.Typer()
    app.command()(ik)
    result = CliRunner().invoke(app, [str(word) for word in words])
    if isinstance(result.exception, PantographError):
        raise result.exception
    return result.exit_code, " ".join(result.output.split())


def test_a_pose_is_printed_with_its_verdict():
    code, text = _run("planar_2r", "--to", "1.2,0,1.4", "--all")
    assert code == 0
    assert "solved" in text and "shoulder" in text and "elbow" in text and "position tip" in text


def test_a_negative_verdict_fails_and_tells_the_distance():
    code, text = _run("planar_2r", "--to", "2.5,0,2", "--site", "tip")
    assert code == 1
    assert "out of reach" in text and "0.7 m" in text and "proved" in text


def test_feet_can_be_held_and_joints_named_by_patterns():
    words = ("puppet", "--site", "left_hand", "--to", "0.4,0.2,0.9")
    code, text = _run(*words, "--hold", "left_foot", "--hold", "right_foot")
    assert code == 0 and "hold left_foot" in text and "root" in text and "left_ankle_pitch" in text
    code, text = _run("puppet", "--site", "left_hand", "--to", "0.15,0.35,1.0", "--joint", "left_*")
    assert code == 0 and "left_elbow" in text and "root" not in text and "waist" not in text


def test_named_geoms_are_kept_clear():
    """The forearm passes the belly; where it may, it keeps away."""
    model, words = load_model("puppet"), ("puppet", "--site", "left_hand", "--to", "0.2,0,0.65")
    words = (*words, *(word for name in ARM for word in ("--joint", name)))
    data, clear = mujoco.MjData(model), []
    for more in ((), ("--obstacle", "left_forearm_link,belly")):
        code, text = _run(*words, *more)
        assert code == 0
        for name in ARM:
            data.qpos[model.joint(name).qposadr[0]] = float(text.split(f"{name} ")[1].split()[1])
        mujoco.mj_kinematics(model, data)
        pair = (model.geom(name).id for name in ("left_forearm_link", "belly"))
        clear.append(mujoco.mj_geomDistance(model, data, *pair, 1.0, None))
        np.testing.assert_allclose(data.site("left_hand").xpos, [0.2, 0, 0.65], atol=1e-4)
    assert clear[0] < 0.0 and clear[1] > 0.03


def test_a_pose_that_overlaps_an_obstacle_is_told_and_fails(tmp_path):
    """A ball around the only two ways of a planar arm; beside it, a goal that leaves it clear."""
    path = tmp_path / "ball.xml"
    path.write_text("""
    <mujoco><compiler angle="radian"/><worldbody><geom name="ball" size=".15" pos=".4 0 0"/>
    <body><joint name="a" axis="0 0 1"/><geom name="up" type="capsule" size=".03" fromto="0 0 0 .3 0 0"/>
    <body pos=".3 0 0"><joint name="b" axis="0 0 1"/>
    <geom name="fore" type="capsule" size=".03" fromto="0 0 0 .3 0 0"/><site name="tip" pos=".3 0 0"/></body>
    </body></worldbody></mujoco>""")
    code, text = _run(path, "--to", ".45,0,0", "--obstacle", "fore,ball")
    assert code == 1
    assert "not clear: fore and ball overlap by 0." in text
    code, text = _run(path, "--to", "-.45,0,0", "--obstacle", "fore,ball")
    assert code == 0 and "not clear" not in text


@needs_gl
def test_the_way_can_be_pictured(tmp_path):
    code, _ = _run("arm6", "--to", "0.4,0.1,0.4,0,1,0,0", "--film", tmp_path / "pose.png")
    assert code == 0
    assert (tmp_path / "pose.png").stat().st_size > 1000


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("arm6", "--to", "1,2"), "x,y,z"),
        (("arm6", "--to", "1,2,a"), "x,y,z"),
        (("puppet", "--to", "1,2,3"), "--site"),
        (("arm6", "--to", "1,0,0", "--site", "tipp"), "tip"),
        (("arm6", "--to", "nan,0,0"), "finite"),
        (("arm6", "--to", "1,0,0", "--joint", "x*"), "waist"),
        (("arm6", "--to", "1,0,0", "--hold", "tipp"), "tip"),
        (("arm6", "--to", "1,0,0", "--keyframe", "none such"), "no keyframe"),
        (("arm6", "--to", "1,0,0", "--prefer", "clear"), "--obstacle GEOM,GEOM"),
        (("arm6", "--to", "1,0,0", "--prefer", "middle", "--obstacle", "floor,base_foot"), "--prefer clear"),
        (("arm6", "--to", "1,0,0", "--obstacle", "floor"), "pair of geoms"),
        (("arm6", "--to", "1,0,0", "--obstacle", "floor,flor"), "no geom 'flor'"),
        (("arm6", "--to", "1,0,0", "--obstacle", "base_plate,base_foot"), "never part"),
        (("arm6", "--to", "1,0,0", "--prefer", "best"), "manipulability"),
    ],
)
def test_mistakes_are_told(words, message):
    with pytest.raises(PantographError, match=message):
        _run(*words)
