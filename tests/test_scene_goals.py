"""Every kind of goal in a scene, baked and live, as MuJoCo's own kinematics sees it; mistakes are told."""

import mujoco
import numpy as np
import pytest
from oracles.ik_motions import walk
from pantograph.models import load_model
from pantograph.sim import Scene, SceneError, make_plan, run

PUPPET = load_model("puppet")
LEFT = ["left_shoulder_pitch", "left_shoulder_roll", "left_shoulder_yaw", "left_elbow"]
RIGHT = [name.replace("left", "right") for name in LEFT]
START = {"left_elbow": 0.9, "left_shoulder_pitch": 0.4, "right_elbow": 0.9, "right_shoulder_pitch": 0.4}
TIMES = [0, 0.5, 1]
HAND = [0.23, 0.15, 0.76]


def _keys(but):
    """Constant keys of all joints of the puppet but some: nothing is left for physics."""
    q = PUPPET.qpos0
    free = {"joint": "root", "times": [0]}
    out = [free | {"channel": "position", "values": [q[:3].tolist()]}]
    out.append(free | {"channel": "rotation", "values": [q[3:7].tolist()]})
    for j in range(1, PUPPET.njnt):
        name, ball = PUPPET.joint(j).name, PUPPET.jnt_type[j] == mujoco.mjtJoint.mjJNT_BALL
        if name not in but:
            values = [[1, 0, 0, 0]] if ball else [START.get(name, 0.0)]
            out.append({"joint": name, "times": [0], "values": values})
    return out


def _puppet(*goals, moving=LEFT, **words):
    base = {"duration": 1.0, "rate": 60.0, "models": [{"file": "puppet"}], "goals": list(goals)}
    initial = {"position": {name: x for name, x in START.items() if name in moving}}
    return Scene(**(base | {"keys": _keys(moving), "initial": initial} | words))


class Seen:
    """A recording of a scene as MuJoCo's kinematics sees it."""

    def __init__(self, scene):
        self.recording = run(scene)
        self.t, self.q, self.model = self.recording.t, self.recording.q, self.recording.model
        assert self.recording.stats["engine"] == "kinematic"

    def each(self, what):
        data, out = mujoco.MjData(self.model), []
        for q in self.q:
            data.qpos[:] = q
            mujoco.mj_forward(self.model, data)
            out.append(np.array(what(data)))
        return np.array(out)

    def site(self, name):
        return self.each(lambda data: data.site(name).xpos)

    def joint(self, name):
        return self.q[:, self.model.joint(name).qposadr[0]]

    def missed(self, label):
        return self.recording.missed[:, self.recording.goals.index(label)]

    def says(self, label):
        return next(note for note in self.recording.notes if repr(label) in note)


def _late(seen):
    """Baked goals hold at every time; live ones from a start elsewhere are there after a while."""
    return seen.t > 0.7


SOLVE = pytest.mark.parametrize("solve", ["baked", "live"])


@SOLVE
def test_a_point_moves_on_a_line(solve):
    goal = {"kind": "point_on_line", "at": "left_hand", "point": [[0.22, 0, 0.75]], "direction": [0, 1, 0]}
    seen = Seen(_puppet(goal | {"solve": solve}))
    away = np.linalg.norm((seen.site("left_hand") - [0.22, 0, 0.75])[:, [0, 2]], axis=1)
    assert away[_late(seen)].max() < 1e-5
    np.testing.assert_allclose(seen.missed("pointonline left_hand")[:, 0], away, atol=1e-9)


@SOLVE
def test_a_point_stays_on_a_plane_that_rises(solve):
    point = [[0, 0, 0.62], [0, 0, 0.7], [0, 0, 0.7]]
    goal = {"kind": "point_on_plane", "at": "left_hand", "times": TIMES, "point": point, "normal": [0, 0, 1]}
    seen = Seen(_puppet(goal | {"solve": solve, "curve": "linear"}))
    away = np.abs(seen.site("left_hand")[:, 2] - np.interp(seen.t, TIMES, [0.62, 0.7, 0.7]))
    assert away[_late(seen)].max() < 1e-4
    np.testing.assert_allclose(seen.missed("pointonplane left_hand")[:, 0], away, atol=1e-9)


@SOLVE
@pytest.mark.parametrize("to", ["right_hand", (0.2, 0.1, 0.95)])
def test_a_distance_to_a_site_or_a_point_is_kept(solve, to):
    goal = {"kind": "distance", "at": "left_hand", "to": to, "distance": [0.25]}
    seen = Seen(_puppet(goal | {"solve": solve}))
    other = seen.site(to) if isinstance(to, str) else np.array(to)
    apart = np.linalg.norm(seen.site("left_hand") - other, axis=1)
    assert np.abs(apart - 0.25)[_late(seen)].max() < 1e-5
    np.testing.assert_array_equal(seen.joint("right_elbow"), 0.9)


@SOLVE
def test_the_centre_of_mass_goes_where_it_should_with_an_axis_left_free(solve):
    x = float(_center(PUPPET.qpos0)[0])
    goal = {
        "kind": "center_of_mass",
        "times": [0, 1],
        "target": [[x, 0, 0], [x + 0.03, 0.02, 0]],
        "curve": "linear",
    }
    moving = [*LEFT, *RIGHT, "waist"]
    seen = Seen(_puppet(goal | {"tolerance": [1e-6, 1e-6, np.inf], "solve": solve}, moving=moving))
    center = seen.each(lambda data: data.subtree_com[0])[:, :2]
    wanted = np.stack([x + 0.03 * seen.t, 0.02 * seen.t], axis=1)
    away = np.linalg.norm(center - wanted, axis=1)
    assert away[_late(seen)].max() < 1e-4
    np.testing.assert_allclose(seen.missed("centre of mass")[:, 0], away, atol=1e-9)


def _center(q):
    data = mujoco.MjData(PUPPET)
    data.qpos[:] = q
    mujoco.mj_forward(PUPPET, data)
    return data.subtree_com[0]


@SOLVE
def test_a_joint_stands_at_a_value_in_the_scene_s_angles(solve):
    goal = {"kind": "joint_value", "joint": "left_elbow", "value": [30.0], "solve": solve}
    seen = Seen(_puppet(goal, angle="degree", initial={}, moving=["left_elbow"]))
    assert np.degrees(seen.joint("left_elbow"))[_late(seen)] == pytest.approx(30, abs=1e-4)


@SOLVE
def test_a_posture_is_a_wish_beside_a_hard_goal(solve):
    hand = {"at": "left_hand", "position": [HAND], "solve": solve}
    seen = {}
    for yaw in (-0.6, 0.6):
        wish = {"kind": "posture", "posture": {"left_shoulder_yaw": yaw}, "weight": 0.1, "name": "style"}
        seen[yaw] = Seen(_puppet(hand, wish | {"solve": solve}))
        late = _late(seen[yaw])
        away = np.linalg.norm(seen[yaw].site("left_hand") - HAND, axis=1)
        assert away[late].max() < 1e-4
        told = seen[yaw].missed("style")[:, 1]
        np.testing.assert_allclose(told, np.abs(seen[yaw].joint("left_shoulder_yaw") - yaw), atol=1e-9)
    ends = [s.joint("left_shoulder_yaw")[-1] for s in seen.values()]
    assert ends[1] - ends[0] > 0.5


def test_a_ball_joint_has_a_posture_too():
    quat = [float(np.cos(0.1)), 0.0, float(np.sin(0.1)), 0.0]
    seen = Seen(_puppet({"kind": "posture", "posture": {"neck": quat}}, moving=["neck"]))
    at = PUPPET.joint("neck").qposadr[0]
    np.testing.assert_allclose(seen.q[:, at : at + 4], np.tile(quat, (len(seen.t), 1)), atol=1e-6)


@SOLVE
def test_a_hand_mirrors_the_other_one_that_has_keys(solve):
    keys = [k for k in _keys(LEFT) if k["joint"] != "right_shoulder_pitch"]
    keys.append({"joint": "right_shoulder_pitch", "times": TIMES, "values": [0.4, 0.7, 0.4]})
    goal = {"kind": "mirror", "at": "left_hand", "of": "right_hand", "relative_to": "body:chest"}
    goal |= {"solve": solve, "velocity": 6.0, "acceleration": 60.0}
    seen = Seen(_puppet(goal, keys=keys))
    away = np.linalg.norm(seen.site("left_hand") - seen.site("right_hand") * [1, -1, 1], axis=1)
    assert away[_late(seen)].max() < 2e-4
    assert np.ptp(seen.site("right_hand"), axis=0).max() > 0.05


@SOLVE
def test_the_elbow_bends_towards_its_pole(solve):
    hand = {"at": "left_hand", "position": [HAND], "solve": solve}
    pole = {"kind": "pole", "root": "body:left_upper_arm", "mid": "body:left_forearm", "tip": "left_hand"}
    sides = []
    for y in (2.0, -1.0):
        seen = Seen(_puppet(hand, pole | {"pole": [[0, y, 0.7]], "weight": 1.0, "solve": solve}))
        assert np.linalg.norm(seen.site("left_hand")[-1] - HAND) < 1e-5
        root, mid = (seen.each(lambda d, b=b: d.body(b).xpos)[-1] for b in ("left_upper_arm", "left_forearm"))
        along = seen.site("left_hand")[-1] - root
        along /= np.linalg.norm(along)
        side = mid - root - ((mid - root) @ along) * along
        sides.append(side)
    assert sides[0][1] - sides[1][1] > 0.05


@SOLVE
def test_a_turn_is_spread_over_a_spine(solve):
    gaze = {"at": "gaze", "look_at": [[1.0, 0.7, 1.007]], "axis": [1, 0, 0], "solve": solve}
    spread = {"kind": "spread", "joints": ["waist", "neck"], "shares": [1, 2], "weight": 1.0, "solve": solve}
    seen = Seen(_puppet(gaze, spread, moving=["waist", "neck"]))
    assert seen.missed("lookat gaze")[_late(seen), 1].max() < 1e-4
    turns = []
    for name in ("waist", "neck"):
        at, turn = PUPPET.joint(name).qposadr[0], np.empty(3)
        mujoco.mju_quat2Vel(turn, seen.q[-1, at : at + 4], 1.0)
        turns.append(turn)
    assert np.linalg.norm(turns[0]) > 0.05
    np.testing.assert_allclose(turns[1], 2 * turns[0], atol=5e-3)


def _walking(goals, rate=120.0):
    times = np.arange(0, 1.51, 1 / 30)
    q, keys = walk(PUPPET, times), []
    for j in range(PUPPET.njnt):
        at, kind, name = PUPPET.jnt_qposadr[j], int(PUPPET.jnt_type[j]), PUPPET.joint(j).name
        if kind == 0:
            key = {"joint": name, "times": times.tolist(), "curve": "natural"}
            keys.append(key | {"channel": "position", "values": q[:, at : at + 3].tolist()})
            keys.append(key | {"channel": "rotation", "values": q[:, at + 3 : at + 7].tolist()})
        else:
            values = q[:, at : at + 4] if kind == 1 else q[:, at]
            keys.append(
                {"joint": name, "times": times.tolist(), "curve": "natural", "values": values.tolist()}
            )
    return Scene(duration=1.5, rate=rate, models=[{"file": "puppet"}], keys=keys, goals=goals)


def test_feet_of_a_keyed_walk_are_locked():
    left, right = (0.21, 0.43), (0.72, 0.95)
    goals = [
        {"kind": "lock", "at": "left_foot", "stances": [left]},
        {"kind": "lock", "at": "right_foot", "stances": [right]},
    ]
    seen, loose = Seen(_walking(goals, 1000.0)), Seen(_walking([], 1000.0))
    for foot, (start, end) in (("left_foot", left), ("right_foot", right)):
        on = (seen.t >= start) & (seen.t <= end)
        p, given = seen.site(foot)[on], loose.site(foot)[on]
        away = np.linalg.norm(p - p[len(p) // 2], axis=1)
        assert away.max() < 1.5e-4 and np.linalg.norm(given - given[0], axis=1).max() > 5e-3
        told = seen.missed(f"lock {foot}")[:, 0]
        np.testing.assert_allclose(told[on], away, atol=1e-5)
        assert (told[(seen.t < start - 1e-6) | (seen.t > end + 1e-6)] == 0).all()
        assert "is met" in seen.says(f"lock {foot}")
    arms = [int(PUPPET.joint(name).qposadr[0]) for name in LEFT]
    np.testing.assert_allclose(seen.q[:, arms], loose.q[:, arms], atol=1e-12)


def test_a_locked_foot_out_of_reach_is_told():
    goal = {"kind": "lock", "at": "left_foot", "stances": [[0.0, 1.0]], "name": "planted"}
    keys = _keys([])
    keys[0] |= {"times": [0, 1], "values": [[-0.8, 0, PUPPET.qpos0[2]], [0.8, 0, PUPPET.qpos0[2]]]}
    seen = Seen(_puppet(goal, moving=[], keys=keys))
    foot = seen.site("left_foot")
    away = np.linalg.norm(foot - foot[len(foot) // 2], axis=1)
    assert away.max() > 0.1
    np.testing.assert_allclose(seen.missed("planted")[:, 0], away, atol=1e-9)
    assert "missed by" in seen.says("planted")


def test_keys_and_goals_are_blended_over_time():
    keys = [*_keys(LEFT), {"joint": "left_elbow", "times": [0, 1], "values": [0.9, 1.4], "curve": "linear"}]
    others = [n for n in LEFT if n != "left_elbow"]
    keys += [{"joint": n, "times": [0], "values": [START.get(n, 0.0)]} for n in others]
    goal = {"at": "left_hand", "position": [HAND] * 4, "times": [0, 0.3, 0.6, 1], "joints": LEFT}
    goal |= {"blend": [0, 0, 1, 1], "curve": "linear"}
    seen = Seen(_puppet(goal, moving=[], keys=keys))
    elbow, early, late = seen.joint("left_elbow"), seen.t < 0.299, seen.t > 0.601
    np.testing.assert_allclose(elbow[early], 0.9 + 0.5 * seen.t[early], atol=1e-6)
    away = np.linalg.norm(seen.site("left_hand") - HAND, axis=1)
    assert away[early].min() > 0.02 and away[late].max() < 1e-5
    assert "is met" in seen.says("position left_hand")
    assert np.abs(np.diff(seen.q, axis=0)).max() < 0.15


def test_a_wish_fades_over_time():
    high, low = [0.23, 0.15, 0.8], [0.23, 0.15, 0.65]
    goals = [
        {"at": "left_hand", "position": [p] * 3, "times": TIMES, "weight": w, "name": n, "curve": "linear"}
        for p, w, n in ((high, [1, 1, 0], "high"), (low, [0, 0, 1], "low"))
    ]
    seen = Seen(_puppet(*goals))
    assert np.linalg.norm(seen.site("left_hand")[0] - high) < 1e-3
    assert np.linalg.norm(seen.site("left_hand")[-1] - low) < 5e-3
    assert seen.missed("high")[-1, 0] == pytest.approx(0.15, abs=5e-3)


def test_a_tolerance_is_room_in_the_scene_s_units():
    goal = {"at": "gaze", "look_at": [[1.0, 0.7, 1.007]], "axis": [1, 0, 0], "tolerance": 5.0}
    seen = Seen(_puppet(goal, moving=["neck"], angle="degree"))
    angle = np.degrees(seen.missed("lookat gaze")[-1, 1])
    assert 3.0 < angle <= 5.0 * np.sqrt(3)
    assert "is met" in seen.says("lookat gaze")


def test_goals_of_equal_names_are_told_apart():
    eyes = [
        {"at": "gaze", "look_at": [p], "axis": [1, 0, 0], "weight": 1.0}
        for p in ([1, 0.7, 1.007], [1, -0.7, 1.007])
    ]
    seen = Seen(_puppet(*eyes, moving=["neck"]))
    assert seen.recording.goals == ("lookat gaze", "lookat gaze (2)")
    for label, point in zip(seen.recording.goals, ([1, 0.7, 1.007], [1, -0.7, 1.007]), strict=True):
        axes, p = seen.each(lambda d: d.site("gaze").xmat.reshape(3, 3)), seen.site("gaze")
        sight = (np.array(point) - p) / np.linalg.norm(point - p, axis=1)[:, None]
        angle = np.arccos(np.sum(axes[:, :, 0] * sight, axis=1))
        assert angle[-1] > 0.5
        np.testing.assert_allclose(seen.missed(label)[:, 1], angle, atol=1e-7)
    plan = make_plan(_puppet(*eyes, moving=["neck"]))
    assert [name for name, _ in plan.goals] == ["lookat gaze", "lookat gaze (2)"]


@pytest.mark.parametrize(
    ("goal", "moving", "message"),
    [
        ({"kind": "lock", "at": "left_foot", "stances": [[0.2, 0.5], [0.4, 0.6]]}, [], "overlap"),
        ({"kind": "lock", "at": "left_foot", "stances": [[0.2, 3]]}, [], "not within the motion"),
        (
            {"kind": "spread", "joints": ["waist", "left_elbow"]},
            ["waist", "left_elbow"],
            "only hinges, only slides or only balls",
        ),
        ({"kind": "joint_value", "joint": "neck", "value": [0]}, ["neck"], "no hinge or slide"),
        (
            {"kind": "posture", "posture": {"neck": [0, 0, 0]}},
            ["neck"],
            "posture.neck: .*needs 4 numbers, got 3",
        ),
        ({"kind": "posture", "posture": {"nek": 0}}, ["neck"], "neck"),
        ({"at": "gaze", "rotation": [[1, 0]]}, ["neck"], "got rows of 2 numbers"),
        ({"at": "left_hand", "position": [[0, 0, 1]], "tolerance": [1, 1]}, LEFT, "2 tolerances for 3 rows"),
    ],
)
def test_goals_that_do_not_fit_the_model_are_told(goal, moving, message):
    with pytest.raises(SceneError, match=message):
        make_plan(_puppet(goal, moving=moving))


def test_what_must_be_baked_says_why_it_cannot_be():
    lock = {"kind": "lock", "at": "left_foot", "stances": [[0.1, 0.2]]}
    hand = {"at": "left_hand", "position": [HAND], "blend": [1], "joints": ["left_*"]}
    for goal, message in ((lock, "kind: feet are locked before"), (hand, "blend: .*physics moves")):
        with pytest.raises(SceneError, match=rf"goals\[0\].{message}"):
            make_plan(Scene(duration=1.0, models=[{"file": "puppet"}], goals=[goal]))
