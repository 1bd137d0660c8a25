"""Scenes whose models bring floors of their own: floors at the same place are one."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import Scene, make_plan, run
from pantograph.sim.film.drawing import drawn_geoms

OWN = """<mujoco><asset>
    <texture name="checker" type="2d" builtin="checker" rgb1="1 1 1" rgb2="0 0 0" width="8" height="8"/>
    <material name="tiles" texture="checker" texrepeat="4 6"/></asset>
  <worldbody><geom {name} type="plane" size="{size}" material="tiles" friction="{friction}" {touch}/>
    <body name="box" pos="0 0 {height}" euler="10 20 0"><freejoint name="box"/>
      <geom name="box" type="box" size=".1 .08 .06" friction=".2"/></body>
  </worldbody>{pairs}</mujoco>"""


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A box over a floor of its own, as a model file."""

    def write(name='name="floor"', size="1 1.5 .1", friction=1, touch="", height=0.2, pairs=""):
        path = tmp_path_factory.mktemp("own") / "own.xml"
        values = {"name": name, "size": size, "friction": friction, "touch": touch}
        path.write_text(OWN.format(height=height, pairs=pairs, **values))
        return str(path)

    return write


def planes(model):
    return [g for g in drawn_geoms(model) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_PLANE]


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-180, 180), st.booleans())
@settings(max_examples=8, deadline=None)
def test_what_falls_on_one_of_several_floors_falls_as_on_a_single_one(own, x, y, yaw, unnamed):
    """Equal motion to rounding; with every contact doubled the boxes come to rest elsewhere."""
    file = own(name="" if unnamed else 'name="floor"')
    at = {"position": [x + (1 if x >= 0 else -1), y, 0], "euler": [0, 0, yaw]}
    common = {"duration": 0.6, "angle": "degree"}
    alone = run(Scene(**common, models=[{"file": file, "name": "a"}]))
    both = run(Scene(**common, models=[{"file": file, "name": "a"}, {"file": file, "name": "b", **at}]))
    assert alone.normal.max() > 0
    m = both.model
    a, b = (m.jnt_qposadr[m.joint(n).id] for n in ("a/box", "b/box"))
    np.testing.assert_allclose(both.q[:, a : a + 7], alone.q, atol=1e-4)
    np.testing.assert_allclose(both.q[-1, b + 2], alone.q[-1, 2], atol=5e-3)


@given(st.floats(-3, 3), st.floats(-3, 3), st.floats(-180, 180))
@settings(max_examples=10, deadline=None)
def test_the_one_floor_is_seen_wherever_there_was_one_and_its_tiles_keep_their_size(own, x, y, yaw):
    at = {"position": [x, y, 0], "euler": [0, 0, yaw]}
    models = [{"file": own(), "name": "a"}, {"file": own(size="2 .5 .1"), "name": "b", **at}]
    model = make_plan(Scene(duration=1, angle="degree", models=models)).problem.model
    (floor,) = planes(model)
    assert model.geom(floor).name == "a/floor"
    half, turn = model.geom_size[floor, :2], np.deg2rad(yaw)
    R = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    corners = np.array([[i, j] for i in (-2, 2) for j in (-0.5, 0.5)]) @ R.T + [x, y]
    assert (np.abs(corners) <= half + 1e-9).all()
    assert (half >= [1, 1.5]).all()
    assert (half <= np.maximum([1, 1.5], np.abs(corners).max(axis=0)) + 1e-9).all()
    material = model.geom_matid[floor]
    repeats = model.mat_texrepeat[material]
    if (half > [1, 1.5]).any():  # images over two metres: 4 over 2 m and 6 over 3 m of the file's floor
        assert model.mat_texuniform[material]
        np.testing.assert_allclose(repeats, [4, 4])
    else:
        np.testing.assert_allclose(repeats, [4, 6])


def test_a_floor_without_end_stays_so(own):
    models = [{"file": own(), "name": "a"}, {"file": own(size="0 0 .1"), "name": "b"}]
    model = make_plan(Scene(duration=1, models=models)).problem.model
    (floor,) = planes(model)
    np.testing.assert_array_equal(model.geom_size[floor, :2], 0)


@given(st.floats(1e-4, 1.0), st.sampled_from(["height", "tilt"]))
@settings(max_examples=10, deadline=None)
def test_floors_elsewhere_stay_apart(own, by, how):
    at = {"position": [0, 0, by]} if how == "height" else {"euler": [by, 0, 0]}
    models = [{"file": own(), "name": "a"}, {"file": own(), "name": "b", **at}]
    plan = make_plan(Scene(duration=1, models=models))
    assert len(planes(plan.problem.model)) == 2
    assert not plan.setup.floors


def test_the_plan_says_which_floor_stands_for_which_and_what_that_changes(own):
    models = [{"file": own(friction=0.9), "name": "a"}, {"file": own(friction=0.5), "name": "b"}]
    said = make_plan(Scene(duration=1, models=models)).left_out
    assert (
        "floor 'b/floor': 'a/floor' is the same plane and stands for it (friction 0.9 instead of 0.5)" in said
    )
    prop = {"name": "ice", "shape": "plane", "size": [3, 3], "fixed": True, "friction": 0.01}
    said = make_plan(Scene(duration=1, models=models[:1], props=[prop])).left_out
    assert "floor 'a/floor': 'ice' is the same plane and stands for it (friction 0.01 instead of 0.9)" in said


def test_a_floor_that_is_only_seen_gives_way_to_one_that_holds(own):
    seen = own(touch='contype="0" conaffinity="0"')
    models = [{"file": seen, "name": "a"}, {"file": own(), "name": "b", "position": [2, 0, 0]}]
    r = run(Scene(duration=1, models=models))
    assert r.q[-1, [2, 9]].min() > 0.05
    (floor,) = planes(r.model)
    assert r.model.geom(floor).name == "b/floor"


@pytest.mark.parametrize("name", ["a/floor", "b/floor"])
def test_contacts_by_the_name_of_a_floor_that_another_stands_for(own, name):
    models = [{"file": own(), "name": "a"}, {"file": own(), "name": "b", "position": [2, 0, 0]}]
    r = run(Scene(duration=1, models=models, physics={"contacts": [["b/box", name]]}))
    assert r.q[-1, 9] == pytest.approx(0.06, abs=0.05)
    assert r.q[-1, 2] < -1


def test_pairs_of_a_model_file_follow_its_floor(own):
    """Else the box of b would feel its pair's floor and the one that stands for it."""
    file = own(pairs='<contact><pair geom1="box" geom2="floor"/></contact>')
    alone = run(Scene(duration=0.6, models=[{"file": file, "name": "b"}]))
    models = [{"file": own(), "name": "a", "position": [2, 0, 0]}, {"file": file, "name": "b"}]
    both = run(Scene(duration=0.6, models=models))
    np.testing.assert_allclose(both.q[:, 7:], alone.q, atol=1e-4)


def test_two_planes_of_one_model_are_its_own_business(tmp_path, own):
    path = tmp_path / "two.xml"
    two = '<geom type="plane" size="1 1 .1"/>' * 2
    path.write_text(
        f'<mujoco><worldbody>{two}<body><freejoint/><geom size=".1"/></body></worldbody></mujoco>'
    )
    for models in (
        [{"file": str(path)}],
        [{"file": str(path), "name": "a"}],
        [{"file": str(path), "name": "a"}, {"file": own(), "name": "b"}],
    ):
        model = make_plan(Scene(duration=1, models=models)).problem.model
        assert [model.geom(g).name.startswith("b/") for g in planes(model)] == [False, False]
