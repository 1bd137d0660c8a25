"""Angles of a scene in degrees, as its controller means them."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.controllers.design.law import loop_of
from pantograph.controllers.listing import laws
from pantograph.controllers.trial import Disturbance, run_trial
from pantograph.models import joint_names
from pantograph.sim import Scene, make_plan, run
from pantograph.sim.compose import LAWS, make_controls
from pantograph.sim.engines.interface import Role
from pantograph.sim.scene.angles import ANGLES, law_words

# a hinge and a slide that are driven, and one of each that is not
BOTH = """<mujoco><option gravity="0 0 -9.81"/><worldbody>
  <body name="cart"><joint name="x" type="slide" axis="1 0 0" armature=".05" range="-3 3"/>
    <geom size=".1" mass="2"/>
    <body name="arm"><joint name="turn" axis="0 1 0" armature=".05"/>
      <geom size=".05" pos="0 0 -.4" mass=".5"/>
      <body name="sleeve" pos="0 0 -.4"><joint name="slip" type="slide" axis="1 0 0" stiffness="20"/>
        <geom size=".05" mass=".2"/></body></body></body>
  <body name="door" pos="3 0 0"><joint name="swing" axis="0 1 0" stiffness="2" damping=".1"/>
    <geom size=".05" pos="0 0 -.3" mass=".3"/></body>
  </worldbody><actuator><motor joint="x" ctrlrange="-30 30"/><motor joint="turn" ctrlrange="-6 6"/></actuator>
</mujoco>"""
HINGES = ("turn", "swing")


def scene(folder, degree, controller):
    """Two driven joints along keys; ``controller`` in radians, and the scene in degrees or radians."""
    (folder / "both.xml").write_text(BOTH)
    unit = np.rad2deg(1.0) if degree else 1.0
    words = dict(controller)
    for word in ANGLES:
        if isinstance(words.get(word), dict):
            words[word] = {j: x * (unit if j in HINGES else 1.0) for j, x in words[word].items()}
    return Scene(
        duration=0.2,
        angle="degree" if degree else "radian",
        models=[{"file": str(folder / "both.xml")}],
        roles={"tracked": ["x", "turn"]},
        keys=[
            {"joint": "x", "times": [0, 0.2], "values": [0, 0.1]},
            {"joint": "turn", "times": [0, 0.2], "values": [0, 0.3 * unit]},
        ],
        initial={"position": {"x": 0.02, "turn": 0.1 * unit}},
        physics={"contacts": "none", "limits": False},
        controller={"law": "pd", "period": 0.005} | words,
        solver={"engine": "smooth"},
    )


_each = {
    "law": st.sampled_from([
        {"law": "pd"},
        {"law": "lqr", "goal": {"swing": 0.4, "slip": 0.05}},
        {"law": "mpc", "goal": {"swing": 0.4}, "speed": {"turn": 0.2, "x": 0.1}},
        {"law": "nmpc", "goal": {"slip": 0.1, "swing": -0.3}, "horizon": 0.1},
    ]),
    "backlash": st.fixed_dictionaries({"turn": st.floats(0.01, 0.1), "x": st.floats(0.01, 0.1)}),
    "play": st.fixed_dictionaries({"turn": st.floats(0.01, 0.1), "x": st.floats(0.01, 0.1)}),
    "top_speed": st.fixed_dictionaries({"turn": st.floats(0.2, 2.0), "x": st.floats(0.2, 2.0)}),
    "noise": st.fixed_dictionaries({"turn": st.floats(1e-4, 1e-2), "slip": st.floats(1e-4, 1e-2)}),
    "push": st.fixed_dictionaries({"swing": st.floats(1.0, 9.0)}),
    "stiction": st.fixed_dictionaries({"turn": st.floats(0.1, 1.0), "x": st.floats(0.1, 1.0)}),
}  # fmt: skip


@settings(max_examples=12)
@given(words=st.fixed_dictionaries(_each))
def test_a_scene_in_degrees_moves_as_the_same_one_in_radians(words, tmp_path_factory):
    words = words.pop("law") | words | {"observer": "kalman", "friction": {"turn": 0.5, "x": 1.0}}
    folder = tmp_path_factory.mktemp("units")
    one, other = (make_plan(scene(folder, degree, words)) for degree in (False, True))
    np.testing.assert_allclose(run(one).q, run(other).q, rtol=0, atol=1e-7)
    law, own = words["law"], (p.setup.scene.controller.parameters for p in (one, other))
    tried = [run_trial(p, law, w, Disturbance()).tau for p, w in zip((one, other), own, strict=True)]
    np.testing.assert_allclose(*tried, rtol=0, atol=1e-4)


def test_gains_are_told_about_the_goal_in_degrees(tmp_path):
    own = {"law": "lqr", "goal": {"swing": 0.7}}
    plans = [make_plan(scene(tmp_path, degree, own)) for degree in (False, True)]
    loops = [loop_of(p, "lqr", p.setup.scene.controller.parameters) for p in plans]
    np.testing.assert_allclose(loops[0].system.A, loops[1].system.A, atol=1e-9)
    np.testing.assert_allclose(loops[0].K, loops[1].K, rtol=1e-6, atol=1e-6)


def test_one_number_for_all_joints_is_degrees_for_hinges_alone(tmp_path):
    plan = make_plan(scene(tmp_path, True, {}))
    model = plan.problem.model
    given = law_words(plan.setup.scene, model, {"backlash": 3.0, "push": {"": 90.0, "x": 2.0}, "kp": 3.0})
    hinge = np.array([name in HINGES for name in joint_names(model)])
    np.testing.assert_allclose(given["backlash"], np.where(hinge, np.deg2rad(3.0), 3.0))
    np.testing.assert_allclose(given["push"][""], np.where(hinge, np.pi / 2, 90.0))
    assert given["push"]["x"] == 2.0
    assert given["kp"] == 3.0
    made = scene(tmp_path, True, {"backlash": 3.0, "top_speed": 50.0, "play": 1.0})
    loop = make_controls(made, plan.problem, 0.005).law
    np.testing.assert_allclose(loop.backlash, np.where(hinge, np.deg2rad(3.0), 3.0))
    driven = plan.problem.dofs(Role.TRACKED)
    np.testing.assert_allclose(loop.drives.top[driven & hinge], np.deg2rad(50.0))
    np.testing.assert_allclose(loop.drives.top[driven & ~hinge], 50.0)
    np.testing.assert_allclose(loop.play.half[driven & hinge], 0.5 * np.deg2rad(1.0))


def test_a_machine_of_hinges_alone_is_told_one_number():
    data = {"duration": 1.0, "angle": "degree", "models": [{"file": "pendulum"}]}
    plan = make_plan(Scene(**data))
    assert law_words(plan.setup.scene, plan.problem.model, {"backlash": 180.0}) == {"backlash": np.pi}


def test_the_words_that_are_angles_are_those_whose_unit_is_of_radians():
    """Whatever a law's text says is in rad, rad/s or rad/s^2 is in degrees where the scene's angles are."""
    words = {word for entry in laws() for word in entry.words}
    assert {word.name for word in words if word.unit.startswith("rad")} == set(ANGLES)


@pytest.mark.parametrize("bad", ["much", True, None])
def test_what_is_no_number_is_left_for_the_law_to_refuse(bad):
    made = Scene(duration=1.0, angle="degree", models=[{"file": "cart_pole"}])
    model = make_plan(made).problem.model
    for word in ANGLES:
        given = {word: {"hinge": bad, "nobody": 3.0}}
        assert law_words(made, model, given) == given
        assert law_words(made, model, {word: bad}) == {word: bad}


def test_every_law_has_its_goal_in_the_scenes_angles():
    """A goal is a value of a joint in every law that has one."""
    assert {e.name for e in laws() for w in e.words if w.name == "goal" and w.unit == "rad, m"} == {
        name for name in LAWS if name in ("lqr", "mpc", "nmpc", "swing-up")
    }
