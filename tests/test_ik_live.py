"""Live goals: followed from the state of the run, on every engine, within limits, the same every time."""

import mujoco
import numpy as np
import pytest
from pantograph.models import load_model
from pantograph.sim import Scene, SceneError, run
from pantograph.sim.kinematics import frame
from pantograph.sim.plan import make_plan

ARM = {"name": "arm", "file": "arm6"}
ROPE = {
    "name": "rope",
    "chain": {"links": 2, "length": 0.6, "mass": 0.3, "joint": "hinge", "radius": 0.01},
    "position": (0.62, 0, 1.15),
    "euler": (0, 0, np.pi / 2),
}
START = {"arm/shoulder": 0.2, "arm/elbow": 0.4, "arm/wrist_pitch": -0.5, "rope/joint_1": 0.3}
BESIDE = {"at": "arm/tip", "times": [0], "position": [(0, 0.1, 0)], "relative_to": "rope/tip"}
LAW = {"law": "computed-torque", "frequency": 15}


def _scene(goal=None, **words):
    base = {
        "duration": 1.5,
        "models": [ARM, ROPE],
        "initial": {"position": START},
        "goals": [BESIDE | {"velocity": 3.0, "acceleration": 30.0} | (goal or {})],
        "controller": LAW,
        "physics": {"contacts": "none"},
    }
    return Scene(**(base | words))


def _missed(recording):
    """Distance (n,) of the arm's tip from its place beside the end of the rope, by the kinematics alone."""
    tip = frame(recording.model, "site", "arm/tip").pose(recording.q)[:, :3, 3]
    end = frame(recording.model, "site", "rope/tip").pose(recording.q)
    return np.linalg.norm(tip - (end[:, :3, :3] @ [0, 0.1, 0] + end[:, :3, 3]), axis=1)


@pytest.mark.parametrize("engine", ["smooth", "contact"])
def test_a_tracked_arm_stays_beside_a_rope_that_physics_swings(engine):
    recording = run(_scene(solver={"engine": engine}))
    assert recording.stats["engine"] == engine and recording.status == "done"
    missed = _missed(recording)
    told = recording.missed[:, recording.goals.index("position arm/tip rope/tip"), 0]
    np.testing.assert_allclose(told, missed, atol=1e-12)
    end = frame(recording.model, "site", "rope/tip").pose(recording.q)[:, :3, 3]
    late = recording.t > 0.7
    assert np.ptp(end[late], axis=0).max() > 0.15  # it does swing
    assert missed[0] > 0.15 and missed[late].max() < 0.003
    tracked = {recording.model.joint(j).name for j in recording.model.dof_jntid[recording.tracked]}
    assert "arm/waist" in tracked and not any(name.startswith("rope") for name in tracked)


def test_where_all_else_has_keys_the_engine_is_kinematic_and_the_arm_sees_no_future():
    swing = {"joint": "rope/joint_1", "times": [0, 0.5, 1, 1.5], "values": [0.3, -0.3, 0.3, -0.3]}
    still = {"joint": "rope/joint_2", "times": [0], "values": [0]}
    one = run(_scene({"solve": "live"}, keys=[swing, still], controller=None))
    assert one.stats["engine"] == "kinematic"
    missed = _missed(one)
    assert missed[one.t > 0.8].max() < 2e-4
    turned = swing | {"values": [0.3, -0.3, 0.3, 0.3]}
    two = run(_scene({"solve": "live"}, keys=[turned, still], controller=None))
    before = one.t < 0.5  # keys of `auto` curves reach to their neighbours
    np.testing.assert_array_equal(one.q[before, :6], two.q[before, :6])
    assert np.abs(one.q - two.q).max() > 0.05
    plan = make_plan(_scene(keys=[swing, still], controller=None))
    assert [choice.what for _, choice in plan.goals] == ["baked"]


def test_a_path_in_the_world_is_followed_without_lag():
    """The targets at t are those of the path at t: what shapes them half a tick late is asked for ahead."""
    w = 2 * np.pi / 1.5
    times = np.linspace(0, 1.5, 31)
    circle = np.stack([0.45 + 0 * times, 0.1 * np.sin(w * times), 0.5 + 0.1 * np.cos(w * times)], axis=1)
    goal = {
        "at": "tip",
        "times": times.tolist(),
        "position": circle.tolist(),
        "curve": "natural",
        "solve": "live",
    }
    scene = Scene(duration=1.5, models=[{"file": "arm6"}], goals=[goal | {"acceleration": 60.0}])
    recording = run(scene)
    assert recording.stats["engine"] == "kinematic"
    late = (recording.t > 0.8) & (recording.t < 1.49)  # at the end the path stands still at once
    assert recording.missed[late, 0, 0].max() < 5e-5  # a lag of a millisecond would be 0.4 mm


def test_the_same_scene_moves_the_same_way_twice():
    one, two = (run(_scene(duration=0.3)) for _ in range(2))
    np.testing.assert_array_equal(one.q, two.q)
    np.testing.assert_array_equal(one.tick_ctrl, two.tick_ctrl)


def test_targets_keep_their_limits_and_are_each_others_derivatives_at_every_time():
    plan = make_plan(_scene())
    live, h = plan.problem.live(0.001), 0.001
    rng = np.random.default_rng(0)
    q, v = plan.problem.state0.q, plan.problem.state0.v
    out = []
    for k in range(800):
        if k % 200 == 0:
            q = q.copy()
            q[-2:] += 0.2 * rng.normal(size=2)  # the rope jumps
        out.append(live.at(k * h, q, v, (q, v, v)))
    Q, V, A = (np.array([row[i][:6] for row in out]) for i in range(3))
    assert np.abs(V).max() <= 3.0 * (1 + 1e-9) and np.abs(V).max() > 2.9
    assert np.abs(A).max() <= 30.0 * (1 + 1e-6)
    np.testing.assert_allclose(np.diff(V, axis=0) / h, A[:-1], atol=1e-6)
    np.testing.assert_allclose(np.diff(Q, axis=0), h * V[:-1] + 0.5 * h * h * A[:-1], atol=1e-12)
    np.testing.assert_array_equal(out[-1][0][6:], q[6:])


def test_a_free_body_that_falls_is_followed_while_it_can_be():
    """Nobody can tell where the ball goes before the floor and a post have turned it away."""
    ball = {"name": "ball", "shape": "sphere", "size": [0.04], "position": (0.45, 0.1, 0.5), "mass": 0.2}
    post = {"name": "post", "shape": "sphere", "size": [0.1], "position": (0.45, 0.13, 0.1), "fixed": True}
    floor = {"name": "ground", "shape": "plane", "size": [2, 2], "fixed": True}
    goal = {
        "at": "tip",
        "times": [0],
        "look_at": [(0, 0, 0)],
        "axis": (1, 0, 0),
        "relative_to": "body:ball",
    }
    scene = Scene(
        duration=0.8,
        models=[{"file": "arm6"}],
        props=[ball, post, floor],
        goals=[goal],
        controller=LAW,
        initial={"position": {"shoulder": -0.2, "elbow": 0.3}},
    )
    plan = make_plan(scene)
    assert plan.engine.what == "contact"
    ((name, choice),) = plan.goals
    assert name == "lookat tip body:ball" and choice.what.startswith("live") and "physics" in choice.why
    recording = run(plan)
    gone = recording.q[-1, recording.model.joint("ball").qposadr[0] :][:3]
    assert np.linalg.norm(gone[:2] - [0.45, 0.1]) > 0.03
    tip = frame(recording.model, "site", "tip").pose(recording.q[-1])
    sight = (gone - tip[:3, 3]) / np.linalg.norm(gone - tip[:3, 3])
    angle = np.arccos(np.clip(sight @ tip[:3, 0], -1, 1))
    assert angle < 0.05
    assert recording.missed[-1, 0, 1] == pytest.approx(angle, abs=1e-6)


@pytest.mark.parametrize("law", ["pd", "pid", "operational-space", "impedance"])
def test_other_laws_follow_live_goals_too(law):
    words = {"site": "arm/tip"} if law in ("operational-space", "impedance") else {}
    recording = run(_scene(controller={"law": law} | words, duration=1.0))
    assert recording.status == "done"
    assert _missed(recording)[recording.t > 0.8].max() < 0.5 * _missed(recording)[0]


def test_goals_of_one_limb_are_live_together_and_of_another_baked():
    goals = [
        BESIDE,
        {"at": "arm/tip", "times": [0], "rotation": [(1, 0, 0, 0)], "weight": 0.1},
        {"at": "other/tip", "times": [0, 1], "position": [(2.4, 0, 0.4), (2.4, 0.1, 0.4)]},
    ]
    models = [ARM, ROPE, {"name": "other", "file": "arm6", "position": (2, 0, 0)}]
    plan = make_plan(_scene(models=models, goals=goals))
    how = [choice.what.split(",")[0] for _, choice in plan.goals]
    assert how == ["live", "live", "baked"]
    assert "arm/waist" in plan.goals[1][1].why


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"goal": {"solve": "baked"}}, r"cannot be baked: .*rope.joint_1.* = .live."),
        ({"goal": {"relative_to": "rope/tipp"}}, "rope/tip"),
        ({"goal": {"velocity": -1}}, "velocity"),
        ({"controller": {"law": "nmpc"}}, "looks far ahead.*computed-torque"),
        ({"roles": {"keyed": ["arm/waist"]}}, "must be tracked"),
        ({"actuators": {"arm/waist": "keys"}}, "follows a live goal"),
    ],
)
def test_mistakes_are_told_at_their_place(words, message):
    with pytest.raises(SceneError, match=message):
        make_plan(_scene(**words))


def test_a_goal_at_rest_is_held_exactly_by_the_targets():
    plan = make_plan(_scene({"relative_to": None, "position": [(0.45, 0.1, 0.5)], "solve": "live"}))
    live = plan.problem.live(0.002)
    q, v = plan.problem.state0.q, plan.problem.state0.v
    target = [live.at(0.002 * k, q, v, (q, v, v)) for k in range(600)][-1]
    model = load_model("arm6")
    tip = frame(model, "site", "tip").pose(target[0][:6])[:3, 3]
    np.testing.assert_allclose(tip, [0.45, 0.1, 0.5], atol=1e-6)


@pytest.mark.parametrize("solve", ["live", "baked"])
def test_an_arm_that_begins_straight_follows_a_goal_inwards_along_it(solve):
    goal = {"at": "tip", "times": [0, 1, 2], "position": [[1.8, 0, 2], [1.08, 0, 2], [1.08, 0, 2]]}
    recording = run(Scene(duration=2.0, models=[{"file": "planar_2r"}], goals=[goal | {"solve": solve}]))
    assert recording.missed[0, 0, 0] < 1e-6 and recording.missed[-1, 0, 0] < 1e-5


POST = {"name": "post", "shape": "sphere", "size": [0.06], "position": (0.42, 0.0, 0.5), "fixed": True}
PAST = {
    "at": "tip",
    "times": [0, 0.4, 1.6],
    "position": [[0.4, -0.2, 0.45], [0.4, -0.2, 0.45], [0.4, 0.2, 0.45]],
    "solve": "live",
}
TOOL = ["tool_cup", "tool_bellows", "tool_stem", "flange", "wrist_link"]


def _past(**words):
    start = {"position": {"waist": -0.45, "shoulder": 0.2, "elbow": 0.4}}
    goals = [PAST | words]
    return Scene(duration=2.4, models=[{"file": "arm6"}], props=[POST], goals=goals, initial=start)


def _nearest(recording):
    """Least distance of the tool from the post in a recording, by MuJoCo."""
    model, data, out = recording.model, mujoco.MjData(recording.model), np.inf
    for q in recording.q:
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        for name in TOOL:
            ends = np.zeros(6)
            pair = model.geom(name).id, model.geom("post").id
            out = min(out, mujoco.mj_geomDistance(model, data, *pair, 1.0, ends))
    return out


def test_live_goals_of_a_scene_keep_named_geoms_apart():
    assert _nearest(run(_past())) < 0
    pairs = [(name, "post") for name in TOOL]
    recording = run(_past(apart=pairs, clearance=0.02))
    assert _nearest(recording) > 0.018
    assert recording.missed[-1, 0, 0] < 1e-3  # it goes around


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ({"apart": [("tool_cap", "post")]}, r"goals\[0\]\.apart\[0\].*tool_cap.*tool_cup"),
        ({"apart": [("tool_cup", "tool_bellows")]}, "on one body"),
        ({"apart": [("tool_cup", "post")], "solve": "auto"}, "baked.*solve = .live"),
        ({"apart": [("tool_cup", "post")], "solve": "baked"}, "baked goal keeps no geoms apart"),
        ({"clearance": 0.1}, "needs pairs of geoms"),
    ],
)
def test_mistakes_of_geoms_to_be_kept_apart_are_told(words, message):
    with pytest.raises(SceneError, match=message):
        make_plan(_past(**words))
