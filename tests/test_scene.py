from pathlib import Path

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import PantographError, Scene, SceneError, load_scene, make_plan, parse_scene, run
from pantograph.sim.scene.load import locate
from scenes import SCALARS, numbers, placements, scenes, to_toml
from scipy.spatial.transform import Rotation

CATALOGUE = Path(__file__).parent / "broken_scenes"
PENDULUM = 'duration = 1.0\n[[models]]\nfile = "pendulum"\n'


def broken_scenes():
    """(text, mistakes) of every block of the catalogue: lines '#: mistake' (to be continued where it ends
    in ...), then the scene as in its file."""
    out = []
    for path in sorted(CATALOGUE.glob("*.txt")):
        lines = path.read_text().split("\n")
        starts = [i for i, line in enumerate(lines) if line[:2] == "#:" and lines[i - 1][:2] != "#:"]
        for i, end in zip(starts, [*starts[1:], len(lines)], strict=True):
            says = [line[3:] for line in lines[i:end] if line.startswith("#:")]
            text = "\n".join(lines[i + len(says) : end])
            out.append(pytest.param(text, says, id=f"{path.stem}:{i + 1}"))
    return out


def mistakes(text, **options):
    """First lines of the mistakes that the report of a scene's text lists."""
    with pytest.raises(SceneError) as error:
        make_plan(parse_scene(text, file="scene.toml", **options))
    first, *rest = str(error.value).split("\n")
    if "not valid TOML" in first:
        return [first.removeprefix("scene.toml: ")]
    rows = [row.strip() for row in rest if not row.startswith("    ")]
    assert first == f"scene.toml: {len(rows)} mistake{'s' * (len(rows) > 1)}"
    return rows


@pytest.mark.parametrize(("text", "says"), broken_scenes())
def test_broken_scene_says_what_is_wrong_and_where(text, says):
    found = mistakes(text)
    for i, said in enumerate(says):
        if said.endswith("..."):
            found[i] = found[i][: len(said) - 3] + "..."
    assert found == says


def test_five_mistakes_of_different_kinds_are_reported_at_once():
    text = """\
duration = -1.0
[[models]]
file = "pendulum"
[[keys]]
joint = "hinge"
times = [0, 1]
values = [0, 1, 2]
[[keys]]
joint = "hing"
times = [0, 1]
values = [0, 1]
[initial.position]
elbow = 3
[solver]
integrator = "rk5"
stepp = 0.1
[[forces]]
body = "world"
force = [0, 0, 1]
"""
    assert [row.split(":")[0] for row in mistakes(text)] == [
        "line 1, duration",
        "line 7, keys[0].values",
        "line 9, keys[1].joint",
        "line 13, initial.position.elbow",
        "line 15, solver.integrator",
        "line 16, solver.stepp",
        "line 18, forces[0].body",
    ]


def test_mistakes_that_follow_from_others_are_not_reported():
    text = PENDULUM + '[roles]\nkeyed = ["hinge"]\n[film]\ncamera = "c"\n[actuators]\nhinge = "keys"\n'
    text += '[[keys]]\njoint = "hinge"\ntimes = [0]\nvalues = ["x"]\n[[cameras]]\nname = "c"\nfovy = 0\n'
    text += '[[keys]]\ncamera = "c"\nchannel = "fovy"\ntimes = [0]\nvalues = [10]\n'
    assert mistakes(text) == [
        "line 13, keys[0].values[0]: must be a number, or a list, got 'x'",
        "line 16, cameras[0].fovy: must be greater than 0, got 0",
    ]


def test_indices_are_those_of_the_file_though_a_malformed_item_comes_first():
    keys = '[[keys]]\njoint = "{}"\ntimes = [{}]\nvalues = [0]\n'
    text = PENDULUM + keys.format("hinge", "'x'") + keys.format("elbow", "0") + keys.format("knee", "'y'")
    assert [row.split(":")[0] for row in mistakes(text)] == [
        "line 6, keys[0].times[0]",
        "line 9, keys[1].joint",
        "line 14, keys[2].times[0]",
    ]


def test_python_scenes_report_all_their_mistakes_too():
    with pytest.raises(SceneError) as error:
        Scene(duration=-1, models=[{"file": "pendulum", "position": [0, 0]}], solver={"step": "x"}, sped=3)
    text = str(error.value)
    for place in ("duration: ", "models[0].position: ", "solver.step: ", "sped: "):
        assert f"\n  {place}" in text
    with pytest.raises(SceneError, match=r"scene: 1 mistake\n  roles.tracked\[0\]: no joint 'knee'"):
        run(Scene(duration=1, models=[{"file": "pendulum"}], roles={"tracked": ["knee"]}))


def test_arrays_of_numpy_are_numbers_and_lists():
    t = np.linspace(0, 1, 3)
    keys = {"joint": "hinge", "times": t, "values": np.sin(t).astype(np.float32), "curve": "linear"}
    scene = Scene(
        duration=np.float64(1),
        models=[{"file": "pendulum", "position": np.arange(3)}],
        keys=[keys, {"joint": "b", "channel": "position", "times": [0], "values": np.zeros((1, 3))}],
        props=[{"name": "b", "shape": "box", "size": [np.float32(0.5)] * 3}],
    )
    assert scene.models[0].position == (0.0, 1.0, 2.0)
    assert scene.keys[0].values[1] == float(np.float32(np.sin(0.5)))
    with pytest.raises(SceneError, match=r"keys\[0\].times\[1\]: must be a finite number, got nan"):
        Scene(duration=1, models=[{"file": "pendulum"}], keys=[{**keys, "times": [0, np.nan, 1]}])


def test_files_that_are_no_scene(tmp_path):
    (tmp_path / "good.toml").write_text(PENDULUM)
    with pytest.raises(SceneError, match=r"no scene file .*bad.toml; .* has: good.toml"):
        load_scene(tmp_path / "bad.toml")
    with pytest.raises(SceneError, match="is a folder"):
        load_scene(tmp_path)
    (tmp_path / "binary").write_bytes(b"duration\xff\xfe\x00")
    with pytest.raises(SceneError, match=r"is not UTF-8 text \(byte 8\)"):
        load_scene(tmp_path / "binary")
    (tmp_path / "zero.toml").write_bytes(b"duration = \x00")
    with pytest.raises(SceneError, match=r"zero.toml: line 1, column 12, not valid TOML"):
        load_scene(tmp_path / "zero.toml")


def test_marks_and_line_ends_of_windows_editors_do_not_matter(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_bytes(b"\xef\xbb\xbf" + PENDULUM.replace("\n", "\r\n").encode())
    assert load_scene(path) == parse_scene(PENDULUM)
    path.write_bytes(path.read_bytes() + b"position = [1, 2]\r\n")
    with pytest.raises(SceneError, match=r"line 4, models\[0\].position: needs 3 numbers"):
        load_scene(path)


def test_files_are_looked_for_beside_the_scene(tmp_path):
    (tmp_path / "robots").mkdir()
    (tmp_path / "robots" / "one.xml").write_text(
        '<mujoco><worldbody><body name="b"><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    )
    (tmp_path / "scene.toml").write_text('duration = 1\n[[models]]\nfile = "robots/one.xml"\n')
    assert make_plan(load_scene(tmp_path / "scene.toml")).problem.model.nbody == 2
    rows = mistakes('duration = 1\n[[models]]\nfile = "robots"\n', base=tmp_path)
    assert rows == [
        f"line 3, models[0].file: {tmp_path / 'robots'} is a folder, not a model file; "
        "name a file in it: one.xml"
    ]
    mesh = '[[props]]\nname = "b"\nshape = "mesh"\nfile = "no.stl"\n'
    rows = mistakes(PENDULUM + mesh, base=tmp_path)
    assert rows == [f"line 7, props[0].file: no mesh file {tmp_path / 'no.stl'}"]


words = st.from_regex(r"[a-z][a-z0-9_-]{0,5}", fullmatch=True)
values = st.sampled_from(
    ["1", '"# [x] = 1"', "'[[y]]'", "[1, 2]", "[\n  [1], # ]\n  [2]\n]", "{ a = 1 }", '"""\n[t]\nk = 1\n"""']
)


@given(st.lists(st.tuples(words, st.booleans(), st.dictionaries(words, values, max_size=3)), max_size=5))
@settings(max_examples=60)
def test_every_word_of_a_file_is_found_on_its_line(tables):
    lines, where, counts, kinds = [], {}, {}, {}
    for name, several, entries in tables:
        if kinds.setdefault(name, several) != several or (name in counts and not several):
            continue
        counts[name] = counts.get(name, -1) + 1
        table = (name, counts[name]) if several else (name,)
        lines += ["# [comment]", f"[[{name}]]" if several else f"[{name}]  # here"]
        where[table] = len(lines)
        for key, value in entries.items():
            where[(*table, key)] = len(lines) + 1
            lines += f"{key} = {value}".split("\n")
    found = locate("\n".join(lines))
    assert {path: found.get(path) for path in where} == where


@given(scenes())
@settings(max_examples=40)
def test_toml_and_python_say_the_same_and_run_the_same(data):
    python, toml = Scene(**data), parse_scene(to_toml(data))
    assert toml == python
    one, other = run(python), run(toml)
    for name in ("t", "q", "v", "a", "tau", "ctrl", "kinetic", "potential", "tick_ctrl"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    assert Scene(**one.scene) == python


def test_scenes_that_differ_are_not_equal():
    scene = parse_scene(PENDULUM)
    assert scene == Scene(duration=1, models=[{"file": "pendulum"}])
    assert scene != Scene(duration=1.5, models=[{"file": "pendulum"}])
    assert scene != PENDULUM


def pose_of(item, angle):
    """X_W of a placement by SciPy: rotation and position."""
    R = Rotation.identity()
    if "rotation" in item:
        R = Rotation.from_quat(item["rotation"], scalar_first=True)
    if "euler" in item:
        R = Rotation.from_euler("xyz", item["euler"], degrees=angle == "degree")
    return R, np.array(item["position"])


def world(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    return data


@given(
    st.lists(st.tuples(st.sampled_from(sorted(SCALARS)), placements()), min_size=1, max_size=3),
    placements(),
    st.sampled_from(["radian", "degree"]),
    st.booleans(),
)
@settings(max_examples=40)
def test_everything_stands_where_its_placement_says(items, ball, angle, named):
    named = named or len(items) > 1
    models = [
        {"file": file, **place, **({"name": f"m{i}"} if named else {})}
        for i, (file, place) in enumerate(items)
    ]
    props = [{"name": "ball", "shape": "sphere", "size": [0.1], **ball}]
    model = make_plan(Scene(duration=1, angle=angle, models=models, props=props)).problem.model
    data = world(model)
    for item in models:
        alone = make_plan(Scene(duration=1, models=[{"file": item["file"]}])).problem.model
        own = world(alone)
        R, p = pose_of(item, angle)
        prefix = f"{item['name']}/" if named else ""
        for kind in ("body", "geom", "site", "light"):
            count = {"body": alone.nbody, "geom": alone.ngeom, "site": alone.nsite, "light": alone.nlight}[
                kind
            ]
            for i in range(kind == "body", count):
                name = getattr(alone, kind)(i).name
                there = getattr(data, kind)(prefix + name)
                here = getattr(own, kind)(name)
                np.testing.assert_allclose(there.xpos, R.apply(here.xpos) + p, atol=1e-12)
                if kind != "light":
                    R_there = R.as_matrix() @ here.xmat.reshape(3, 3)
                    np.testing.assert_allclose(there.xmat.reshape(3, 3), R_there, atol=1e-12)
                else:
                    np.testing.assert_allclose(there.xdir, R.apply(here.xdir), atol=1e-12)
    R, p = pose_of(ball, angle)
    np.testing.assert_allclose(data.body("ball").xpos, p, atol=1e-12)
    np.testing.assert_allclose(data.body("ball").xmat.reshape(3, 3), R.as_matrix(), atol=1e-12)


@given(placements(), numbers, numbers)
@settings(max_examples=10)
def test_a_moved_model_swings_as_the_one_in_a_turned_field(place, shoulder, elbow):
    """Moving a model moves its motion: the same as leaving it and turning gravity back."""
    R, _ = pose_of(place, "radian")
    common = {
        "duration": 0.1,
        "initial": {"position": {"shoulder": shoulder}, "velocity": {"elbow": elbow}},
    }
    moved = run(Scene(models=[{"file": "double_pendulum", **place}], **common))
    down = tuple(R.inv().apply([0, 0, -9.81]))
    stays = run(Scene(models=[{"file": "double_pendulum"}], physics={"gravity": down}, **common))
    np.testing.assert_allclose(moved.q, stays.q, atol=1e-12)
    np.testing.assert_allclose(moved.v, stays.v, atol=1e-11)


def test_options_come_from_the_first_model_and_the_plan_says_so(tmp_path, recwarn, capfd):
    body = '<worldbody><body name="b"><freejoint/><geom size="1"/></body></worldbody></mujoco>'
    slow = tmp_path / "slow.xml"
    slow.write_text('<mujoco><option timestep="0.01" gravity="0 0 -3" density="2" cone="elliptic"/>' + body)
    fast = tmp_path / "fast.xml"
    fast.write_text('<mujoco><option timestep="0.001" gravity="0 1 -5" density="1" iterations="7"/>' + body)
    items = [{"file": str(slow), "name": "slow"}, {"file": str(fast), "name": "fast"}]
    for order in (items, items[::-1]):
        plan = make_plan(Scene(duration=1, models=order))
        option = plan.problem.model.opt
        alone = mujoco.MjModel.from_xml_path(order[0]["file"]).opt
        for name in ("timestep", "density", "cone", "iterations"):
            assert getattr(option, name) == getattr(alone, name), name
        assert option.gravity == pytest.approx(alone.gravity)
        (said,) = [line for line in plan.left_out if line.startswith("options of further models")]
        assert all(word in said for word in ("timestep", "density", "gravity", order[0]["name"]))
    assert not recwarn.list
    assert capfd.readouterr() == ("", "")


def test_chains_are_models_like_others():
    chain = {"links": 5, "length": 2.0, "mass": 3.0, "joint": "hinge", "damping": 0.1}
    model = make_plan(
        Scene(duration=1, models=[{"chain": chain, "name": "rope", "position": [0, 0, 4]}])
    ).problem.model
    data = world(model)
    assert [model.joint(j).name for j in range(model.njnt)] == [f"rope/joint_{i}" for i in range(1, 6)]
    assert data.site("rope/tip").xpos == pytest.approx([0, 0, 2])
    assert model.body_subtreemass[0] == pytest.approx(3.0)
    assert np.ravel(model.dof_damping)[0] == pytest.approx(0.1)


def test_props_are_what_they_say():
    props = [
        {"name": "box", "shape": "box", "size": [0.1, 0.2, 0.3], "mass": 2.0, "friction": 0.4},
        {"name": "ball", "shape": "sphere", "size": [0.1], "color": [1, 0, 0, 0.5]},
        {"name": "floor", "shape": "plane", "size": [3, 2], "fixed": True},
    ]
    model = make_plan(Scene(duration=1, props=props)).problem.model
    assert model.body("box").mass == pytest.approx(2.0)
    assert model.geom("box").friction[0] == pytest.approx(0.4)
    assert model.geom("box").size == pytest.approx([0.1, 0.2, 0.3])
    assert model.body("ball").mass == pytest.approx(1000 * 4 / 3 * np.pi * 1e-3)
    assert model.geom("ball").rgba == pytest.approx([1, 0, 0, 0.5])
    assert model.geom("floor").size[:2] == pytest.approx([3, 2])
    assert [model.joint(j).name for j in range(model.njnt)] == ["box", "ball"]


ball = {"name": "ball", "shape": "sphere", "size": [0.1], "position": [0, 0, 1]}
floor = {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True}


@given(st.one_of(st.booleans(), st.tuples(numbers, numbers, numbers)), numbers)
@settings(max_examples=15)
def test_free_fall_in_the_gravity_of_the_scene(gravity, up):
    g = np.array([0, 0, -9.81]) if gravity is True else np.zeros(3) if gravity is False else np.array(gravity)
    scene = Scene(
        duration=0.5,
        props=[ball],
        physics={"gravity": gravity},
        initial={"velocity": {"ball": [0.1, -0.2, up, 0, 0, 0]}},
    )
    r = run(scene)
    t = r.t[:, None]
    np.testing.assert_allclose(r.q[:, :3], [0, 0, 1] + t * [0.1, -0.2, up] + g * t**2 / 2, atol=1e-12)
    np.testing.assert_allclose(r.a[:, :3], np.broadcast_to(g, (len(t), 3)), atol=1e-12)


def test_contacts_as_the_scene_chooses():
    other = {**ball, "name": "other", "position": [1, 0, 1]}

    def heights(contacts):
        r = run(Scene(duration=1.0, props=[ball, other, floor], physics={"contacts": contacts}))
        return r.q[-1, [2, 9]]

    fallen = 1 - 9.81 / 2
    assert heights("model") == pytest.approx([0.1, 0.1], abs=0.01)
    assert heights("none") == pytest.approx([fallen, fallen])
    assert heights([["ball", "floor"]]) == pytest.approx([heights("model")[0], fallen], abs=1e-9)
    assert heights([]) == pytest.approx([fallen, fallen])


def test_limits_as_the_scene_chooses():
    def farthest(limits):
        scene = Scene(
            duration=1.0,
            models=[{"file": "cart_pole"}],
            initial={"velocity": {"slide": 5.0}},
            physics={"limits": limits},
        )
        return run(scene).q[:, 0].max()

    assert farthest(True) < 1.1
    assert farthest(False) > 2.0


def test_dry_friction_as_the_scene_chooses(tmp_path):
    path = tmp_path / "slider.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" frictionloss="4"/>'
        '<geom size="0.1" mass="2"/></body></worldbody></mujoco>'
    )

    def speed(friction):
        scene = Scene(
            duration=0.5,
            models=[{"file": str(path)}],
            initial={"velocity": {"x": 3.0}},
            physics={"friction": friction},
        )
        return run(scene).v[-1, 0]

    assert speed(False) == pytest.approx(3.0, abs=1e-12)
    assert speed(True) == pytest.approx(3.0 - 4 / 2 * 0.5, abs=0.01)


def test_initial_states_are_those_of_the_keyframe_the_scene_and_the_keys():
    scene = Scene(
        duration=0.1,
        angle="degree",
        models=[{"file": "double_pendulum"}],
        initial={"position": {"shoulder": 90, "elbow": 10}, "velocity": {"shoulder": 180}},
        keys=[{"joint": "elbow", "times": [0, 1], "values": [30, 60], "curve": "linear"}],
    )
    s = make_plan(scene).problem.state0
    assert s.q == pytest.approx([np.pi / 2, np.pi / 6])
    assert s.v == pytest.approx([np.pi, np.pi / 6])
    tracked = scene.model_dump(exclude_defaults=True) | {"roles": {"tracked": ["elbow"]}}
    s = make_plan(Scene(**tracked)).problem.state0
    assert s.q == pytest.approx([np.pi / 2, np.pi / 18])
    assert s.v == pytest.approx([np.pi, np.pi / 6])


def test_initial_states_start_from_a_keyframe(tmp_path):
    path = tmp_path / "two.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="a"/><geom size="1"/><body pos="3 0 0">'
        '<joint name="b" type="ball"/><geom size="1"/></body></body></worldbody>'
        '<keyframe><key name="home" qpos="0.5 0 2 0 0" qvel="1 2 3 4"/></keyframe></mujoco>'
    )
    initial = {"keyframe": "home", "velocity": {"a": 7}}
    s = make_plan(Scene(duration=1, models=[{"file": str(path)}], initial=initial)).problem.state0
    assert s.q == pytest.approx([0.5, 0, 1, 0, 0])
    assert s.v == pytest.approx([7, 2, 3, 4])
    initial = {"keyframe": "m/home"}
    models = [{"file": "pendulum", "name": "p"}, {"file": str(path), "name": "m"}]
    s = make_plan(Scene(duration=1, models=models, initial=initial)).problem.state0
    assert s.q == pytest.approx([0, 0.5, 0, 1, 0, 0])


def test_all_errors_are_of_one_family():
    assert issubclass(SceneError, PantographError)
