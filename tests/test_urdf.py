"""URDF files: what is kept, where meshes are found, what is changed or refused, and how that is said."""

import re

import mujoco
import numpy as np
import pytest
from oracles.shapes import tetrahedron
from pantograph import models

LINK = """<link name="{}"><inertial><mass value="1"/>
<inertia ixx="{}" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>{}</link>"""
MESH = '<{0}><geometry><mesh filename="{1}"/></geometry></{0}>'


def urdf(*, kind="revolute", child="arm", parts="", ixx=1, name="elbow", extra="") -> str:
    return f"""<?xml version="1.0"?>
<!-- a small robot -->
<robot name="small">{extra}
<link name="base"/>
{LINK.format("arm", ixx, parts)}
<joint name="{name}" type="{kind}"><parent link="base"/><child link="{child}"/>
<origin xyz="0 0 0.5"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="2" effort="10" velocity="3"/><dynamics damping="0.3" friction="0.2"/></joint>
<link name="tool"/>
<joint name="mount" type="fixed"><parent link="arm"/><child link="tool"/><origin xyz="0 0 1"/></joint>
</robot>"""


def test_urdf_keeps_links_limits_and_friction(tmp_path):
    path = tmp_path / "small.urdf"
    path.write_text(urdf())
    model = models.load_model(path)
    assert models.names_of(model, "body") == ("world", "base", "arm", "tool")
    assert models.joint_names(model) == ("elbow",), "the base is fixed in the world"
    np.testing.assert_allclose(model.jnt_range, [[-1, 2]])
    np.testing.assert_allclose(model.jnt_actfrcrange, [[-10, 10]])
    np.testing.assert_allclose((model.dof_damping[0], model.dof_frictionloss[0]), (0.3, 0.2))
    data = mujoco.MjData(model)
    data.qpos[0] = np.pi / 2
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.body("tool").xpos, [1, 0, 0.5], atol=1e-15)


def test_urdf_inside_a_file_called_xml(tmp_path):
    (tmp_path / "small.xml").write_text(urdf())
    assert models.joint_names(models.load_model("small.xml", base=tmp_path)) == ("elbow",)


def test_urdf_with_a_floating_base(tmp_path):
    (tmp_path / "small.urdf").write_text(urdf(kind="floating"))
    assert models.load_model(tmp_path / "small.urdf").nv == 6


@pytest.mark.parametrize(
    "reference",
    [
        "package://small_description/meshes/wheel.stl",
        "package://another_name/meshes/wheel.stl",
        "../meshes/wheel.stl",
        "wheel.stl",
        "file://{root}/meshes/wheel.stl",
    ],
)
def test_urdf_finds_its_meshes(tmp_path, monkeypatch, reference):
    root = tmp_path / "small_description"
    for name in ("urdf", "meshes"):
        (root / name).mkdir(parents=True)
    (root / "meshes" / "wheel.stl").write_bytes(tetrahedron())
    if reference == "wheel.stl":
        (root / "meshes").rename(root / "urdf" / "meshes")
    path = root / "urdf" / "small.urdf"
    file = reference.format(root=root)
    path.write_text(urdf(parts=MESH.format("visual", file) + MESH.format("collision", file)))
    monkeypatch.chdir(tmp_path)
    model = models.load_model(path)
    assert model.ngeom == 2
    np.testing.assert_allclose(model.body_mass.sum(), 1, err_msg="geoms weigh nothing beside <inertial>")
    visual, collision = model.geom_group[np.argsort(model.geom_contype)]
    assert visual <= 2 < collision, "pictures show the visual mesh only"


BROKEN_URDF = {
    "missing mesh": (
        urdf(parts=MESH.format("visual", "package://x/meshes/arm.stl")),
        ["link 'arm'", "arm.stl' is missing", "looked for", "parts/wheel.stl"],
    ),
    "collision in COLLADA": (
        urdf(parts=MESH.format("collision", "arm.dae")),
        ["link 'arm'", "arm.dae", ".stl, .obj", "convert"],
    ),
    "unknown link": (
        urdf(child="amr"),
        ["joint 'elbow'", "no child link 'amr'", "mean 'arm'", "base"],
    ),
    "unknown joint type": (urdf(kind="screw"), ["joint 'elbow'", "'screw'", "revolute"]),
    "duplicate joint": (urdf(name="mount"), ["joint 'mount' occurs 2 times"]),
    "two mistakes": (urdf(name="mount", kind="screw"), ["2 mistake(s)", "occurs 2 times", "'screw'"]),
    "xacro": (urdf(extra='<xacro:include filename="x"/>'), ["xacro", "expand"]),
    "not closed": (urdf().replace("</robot>", ""), ["broken.urdf:", "not well-formed"]),
    "massless": (urdf().replace('mass value="1"', 'mass value="0"'), ["'arm'", "give it"]),
    "NaN": (urdf(ixx="nan"), ["finite", ":6: ixx='nan'"]),
    "mass in words": (urdf().replace('mass value="1"', 'mass value="heavy"'), ["broken.urdf", "'value'"]),
}


@pytest.mark.parametrize("case", BROKEN_URDF)
def test_broken_urdf(tmp_path, case):
    content, pieces = BROKEN_URDF[case]
    (tmp_path / "arm.dae").write_text("<COLLADA/>")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "wheel.stl").write_bytes(tetrahedron())
    path = tmp_path / "broken.urdf"
    path.write_text(content)
    with pytest.raises(models.ModelError) as caught:
        models.load_model(path)
    assert re.search(".*".join(map(re.escape, pieces)), str(caught.value), re.DOTALL), str(caught.value)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        (urdf(ixx=9), r"A \+ B < C.*arm"),
        (urdf(parts=MESH.format("visual", "arm.dae")), r"arm\.dae.*left out"),
        (
            re.sub(
                r"(?s)<inertial>.*</inertial>",
                '<collision><geometry><sphere radius="0.1"/></geometry></collision>',
                urdf(),
            ),
            r"no <inertial> in link arm.*1000 kg",
        ),
    ],
    ids=["impossible inertia", "COLLADA visual", "no inertial"],
)
def test_urdf_says_what_it_changed(tmp_path, text, says):
    (tmp_path / "arm.dae").write_text("<COLLADA/>")
    (tmp_path / "small.urdf").write_text(text)
    with pytest.warns(models.ModelWarning, match=says):
        model = models.load_model(tmp_path / "small.urdf")
    assert model.nv == 1


def test_visuals_weigh_nothing(tmp_path):
    shapes = "".join(
        f'<{part}><geometry><box size="{side} {side} {side}"/></geometry></{part}>'
        for part, side in (("visual", 0.3), ("collision", 0.2))
    )
    (tmp_path / "small.urdf").write_text(re.sub(r"(?s)<inertial>.*</inertial>", shapes, urdf()))
    with pytest.warns(models.ModelWarning, match="1000 kg"):
        model = models.load_model(tmp_path / "small.urdf")
    assert model.body_mass.sum() == pytest.approx(1000 * 0.2**3)


def test_urdf_settings_of_the_file_win(tmp_path):
    own = '<mujoco><compiler balanceinertia="false" fusestatic="true"/></mujoco>'
    (tmp_path / "small.urdf").write_text(urdf(extra=own))
    assert models.names_of(models.load_model(tmp_path / "small.urdf"), "body") == ("world", "arm")
    (tmp_path / "small.urdf").write_text(urdf(extra=own, ixx=9))
    with pytest.raises(models.ModelError, match=r"A \+ B >= C"):
        models.load_model(tmp_path / "small.urdf")
