import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import Scene, run

FLOOR = {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True}


def ball(name="ball", height=1.0, x=0.0):
    return {"name": name, "shape": "sphere", "size": [0.1], "position": [x, 0, height]}


def notes(**data):
    return run(Scene(**{"duration": 1.0, **data})).notes


def test_a_limit_that_is_left_out_and_crossed_is_told_with_how_far_and_when():
    def told(speed, limits):
        return notes(
            models=[{"file": "cart_pole"}],
            physics={"limits": limits, "contacts": "model"},
            initial={"velocity": {"slide": speed}},
        )

    assert told(4.0, True) == ()
    assert told(0.5, False) == ()
    (note,) = told(4.0, False)
    r = run(
        Scene(
            duration=1.0,
            models=[{"file": "cart_pole"}],
            physics={"limits": False},
            initial={"velocity": {"slide": 4.0}},
        )
    )
    worst = np.argmax(r.q[:, 0])
    assert note == (
        f"joint 'slide' leaves its range [-1, 1] m by {r.q[worst, 0] - 1:.3g} m at t = {r.t[worst]:.3g} s "
        "(limit not simulated)"
    )


@given(st.floats(-1.5, 1.5))
@settings(max_examples=30)
def test_keys_beyond_a_limit_are_told(x):
    found = notes(
        models=[{"file": "cart_pole"}],
        keys=[{"joint": "slide", "times": [0, 1], "values": [0, x], "curve": "linear"}],
    )
    beyond = abs(x) - 1
    assert len(found) == (beyond > 1e-9)
    if found:
        assert f"by {beyond:.3g} m at t = 1 s" in found[0]


def test_overlaps_of_contacts_that_are_left_out_are_told_with_how_deep_and_when():
    scene = {"props": [ball(), FLOOR]}
    assert notes(**scene) == ()
    (note,) = notes(**scene, physics={"contacts": "none"})
    depth = 9.81 / 2 - 1 + 0.1
    assert note == f"ball and floor overlap by {depth:.3g} m at t = 1 s (contact not simulated)"
    assert notes(**scene, duration=0.4, physics={"contacts": "none"}) == ()


def test_only_pairs_that_are_left_out_are_told():
    props = [ball(), ball("other", x=1.0), FLOOR]
    (note,) = notes(props=props, physics={"contacts": [["ball", "floor"]]})
    assert "other and floor overlap" in note
    assert notes(props=props, physics={"contacts": [["ball", "floor"], ["floor", "other"]]}) == ()


@given(st.floats(-3e-3, 3e-3))
@settings(max_examples=30)
def test_overlaps_within_the_softness_of_contacts_are_not_told(depth):
    """Two balls rest 2 r - depth apart without gravity."""
    props = [ball(), ball("other", x=0.2 - depth)]
    found = notes(props=props, duration=0.05, physics={"contacts": "none", "gravity": False})
    assert len(found) == (depth > 1e-3)
    if found:
        assert f"overlap by {1e3 * depth:.3g} mm" in found[0]


@pytest.mark.parametrize("engine", ["kinematic", "contact"])
def test_keyed_things_that_pass_through_others_are_told(engine):
    keys = {"joint": "ball", "channel": "position", "times": [0, 1], "values": [[0, 0, 1], [0, 0, -1]]}
    turn = {"joint": "ball", "channel": "rotation", "times": [0], "values": [[1, 0, 0, 0]]}
    found = notes(props=[ball(), FLOOR], keys=[keys, turn], solver={"engine": engine})
    assert len(found) == 1
    assert "ball and floor overlap by 1.1 m" in found[0]
    high = {**keys, "values": [[0, 0, 1], [0, 0, 0.2]]}
    assert notes(props=[ball(), FLOOR], keys=[high, turn], solver={"engine": engine}) == ()


def test_every_pair_of_bodies_is_told_once_the_deepest_first():
    props = [ball(), ball("other", x=1.0, height=0.5), FLOOR]
    found = notes(props=props, physics={"contacts": "none"})
    assert [("other" in n, "ball" in n) for n in found] == [(True, False), (False, True)]


def test_deepest_overlaps_are_those_of_an_independent_search():
    """A ball flies along x through a wall, in a frame that is not the last."""
    wall = {"name": "wall", "shape": "box", "size": [0.1, 1, 1], "position": [1, 0, 0], "fixed": True}
    scene = Scene(
        duration=1.0,
        props=[ball(height=0.0), wall],
        initial={"velocity": {"ball": [2, 0, 0, 0, 0, 0]}},
        physics={"contacts": "none", "gravity": False},
    )
    r = run(scene)
    (note,) = r.notes
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><worldbody><geom name="w" type="box" size="0.1 1 1" pos="1 0 0"/><body name="b"><freejoint/>'
        '<geom name="b" size="0.1"/></body></worldbody></mujoco>'
    )
    data = mujoco.MjData(model)
    depth = []
    for q in r.q:
        data.qpos[:] = q
        mujoco.mj_forward(model, data)
        depth.append(max((-c.dist for c in data.contact), default=0.0))
    worst = int(np.argmax(depth))
    assert f"overlap by {1e3 * depth[worst]:.3g} mm at t = {r.t[worst]:.3g} s" in note


def test_a_short_overlap_in_a_long_run_is_found():
    """A ball is keyed through another within two of 1200 frames."""
    times, xs = [0, 5.0, 5.01, 5.02, 10], [1, 1, 0, 1, 1]
    keys = [
        {
            "joint": "ball",
            "channel": "position",
            "times": times,
            "values": [[x, 0, 1] for x in xs],
            "curve": "step",
        }
    ]
    turn = {"channel": "rotation", "times": [0], "values": [[1, 0, 0, 0]]}
    rest = {"joint": "other", "channel": "position", "times": [0], "values": [[0, 0, 1]]}
    keys += [rest, {**turn, "joint": "ball"}, {**turn, "joint": "other"}]
    (note,) = notes(duration=10.0, props=[ball(), ball("other")], keys=keys)
    assert note == "ball and other overlap by 200 mm at t = 5.02 s (contact not simulated)"
