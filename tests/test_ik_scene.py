"""Goals in scenes: baked to joints, together with keys and roles, and deviations told."""

import numpy as np
import pytest
from pantograph.models import load_model
from pantograph.sim import Scene, SceneError, run
from pantograph.sim.kinematics import frame
from pantograph.sim.scene.goals import deviations


def _scene(**words):
    goal = {
        "at": "tip",
        "times": [0, 1],
        "position": [[0.45, -0.1, 0.4], [0.45, 0.1, 0.5]],
        "curve": "clamped",
    }
    base = {"duration": 1.0, "models": [{"file": "arm6"}], "goals": [goal | words.pop("goal", {})]}
    return Scene(**(base | words))


def test_the_recorded_motion_goes_where_the_goals_say():
    recording = run(_scene())
    assert recording.stats["engine"] == "kinematic"
    p = frame(recording.model, "site", "tip").pose(recording.q)[:, :3, 3]
    np.testing.assert_allclose(p[0], [0.45, -0.1, 0.4], atol=1e-6)
    np.testing.assert_allclose(p[-1], [0.45, 0.1, 0.5], atol=1e-6)
    s = 3 * recording.t**2 - 2 * recording.t**3  # clamped spline through two keys
    np.testing.assert_allclose(p[:, 1], -0.1 + 0.2 * s, atol=1e-4)
    told = deviations(_scene(), recording.model, recording.t, recording.q)["position tip"]
    np.testing.assert_array_equal(recording.missed[:, recording.goals.index("position tip")], told)
    truth = np.stack([np.full_like(s, 0.45), -0.1 + 0.2 * s, 0.4 + 0.1 * s], axis=1)
    np.testing.assert_allclose(told[:, 0], np.linalg.norm(p - truth, axis=1), atol=1e-12)
    assert any("position tip" in note for note in recording.notes)


def test_keyed_joints_stay_keyed_and_goals_work_around_them():
    keys = [{"joint": "waist", "times": [0, 1], "values": [-0.2, 0.25]}]
    recording = run(_scene(keys=keys, goal={"position": [[0.45, -0.1, 0.4], [0.45, 0.1, 0.45]]}))
    waist = recording.q[:, load_model("arm6").joint("waist").qposadr[0]]
    assert waist[0] == pytest.approx(-0.2) and waist[-1] == pytest.approx(0.25)
    p = frame(recording.model, "site", "tip").pose(recording.q)[:, :3, 3]
    np.testing.assert_allclose(p[-1], [0.45, 0.1, 0.45], atol=1e-5)


def test_what_is_out_of_reach_is_told_after_the_run():
    recording = run(_scene(goal={"position": [[0.45, 0, 0.4], [3.0, 0, 0.4]]}))
    note = next(note for note in recording.notes if "position tip" in note)
    assert "missed by" in note
    p = frame(recording.model, "site", "tip").pose(recording.q[-1])[:3, 3]
    assert f"{np.linalg.norm(p - [3.0, 0, 0.4]):.3g} m" in note


@pytest.mark.parametrize(
    ("goal", "message"),
    [
        ({"at": "tipp"}, "tip"),
        ({"position": [[0, 0, 0]]}, "2 times but 1 rows"),
        ({"position": None}, "where to"),
        ({"joints": ["elbo"]}, "elbow"),
        ({"times": [1, 0]}, "ascend"),
    ],
)
def test_mistakes_are_told_at_their_place(goal, message):
    with pytest.raises(SceneError, match=message):
        run(_scene(goal=goal))


def test_goals_of_keyed_joints_alone_are_a_mistake():
    names = ["waist", "shoulder", "elbow", "forearm_roll", "wrist_pitch", "tool_roll"]
    keys = [{"joint": name, "times": [0], "values": [0.1]} for name in names]
    with pytest.raises(SceneError, match="no joint without keys"):
        run(_scene(keys=keys))
