"""Locked feet: they stand still on the curve that a user gets, and tell where their legs are too short."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import captures, ik_cases
from oracles.ik_motions import walk
from pantograph.models import ModelError, load_model
from pantograph.sim.ik import lock
from pantograph.sim.ik.spline import smooth_clip
from pantograph.sim.kinematics import frame
from strategies import seeds

needs_captures = pytest.mark.skipif(captures.folder() is None, reason="no data folder with motion captures")


def _drift(model, locked, name, start, end):
    """Times, and how far a frame moves from where it is in the middle (m,), a thousand times a second, on a
    spline through the answer made here, by MuJoCo's kinematics."""
    clip, data = smooth_clip(model, locked.t, locked.q, range(model.njnt)), mujoco.MjData(model)
    times = np.unique(np.concatenate([np.arange(start, end, 1e-3), [start, 0.5 * (start + end), end]]))
    p = np.empty((len(times), 3))
    kind, _, word = name.rpartition(":")
    for k, q in enumerate(clip.evaluate(times).q):
        data.qpos[:] = q
        mujoco.mj_kinematics(model, data)
        p[k] = data.body(word).xpos if kind else data.site(word).xpos
    middle = np.argmin(np.abs(times - 0.5 * (start + end)))
    return times, np.linalg.norm(p - p[middle], axis=1)


def _far(model, locked, stances):
    return max(
        float(_drift(model, locked, name, *span)[1].max())
        for name, spans in stances.items()
        for span in spans
    )


@settings(max_examples=3, deadline=None)
@given(seeds, st.sampled_from([15, 30, 60]))
def test_a_locked_foot_stands_still_at_every_time(seed, rate):
    """Stances of any times, which the motion's instants do not hit."""
    rng = np.random.default_rng(seed)
    model, times = load_model("puppet"), np.arange(0, 1.5, 1 / rate)
    q = walk(model, times)
    for side in ("left", "right"):  # legs long enough for every stance
        q[:, model.joint(f"{side}_knee").qposadr[0]] += 0.25
        q[:, model.joint(f"{side}_hip_pitch").qposadr[0]] -= 0.12
    starts = rng.uniform(0.1, 0.3), rng.uniform(0.65, 0.8)
    stances = {
        foot: [(float(s), float(s + rng.uniform(0.05, 0.35)))]
        for foot, s in zip(("left_foot", "right_foot"), starts, strict=True)
    }
    locked = lock(model, times, q, stances)
    assert locked.met.all() and locked.slides == ()
    assert _far(model, locked, stances) <= 1e-4
    assert _far(model, locked, stances) <= 2 * locked.slip.max() + 1e-7  # it moves in the middle, too
    loose = type("Motion", (), {"t": times, "q": q})
    assert _far(model, loose, stances) > 5e-3
    given = smooth_clip(model, times, q, range(model.njnt))
    away = np.ones(len(locked.t), dtype=bool)
    for ((start, end),) in stances.values():
        away &= (locked.t < start - 0.15 - 1 / rate) | (locked.t > end + 0.15 + 1 / rate)
    np.testing.assert_allclose(locked.q[away], given.evaluate(locked.t[away]).q, atol=1e-9)
    assert all(ik_cases.illegal(model, x) == [] for x in locked.q)
    fine = locked.clip().evaluate(np.linspace(0, times[-1], 1500))
    assert np.abs(fine.v).max() < 8 and np.abs(fine.a).max() < 250  # of the walk as given: 4.2 and 19


@settings(max_examples=4, deadline=None)
@given(seeds, st.sampled_from([15, 30, 60]), st.floats(0.1, 0.5))
def test_what_slides_is_told_whatever_the_motion(seed, rate, drift):
    """Legs that are stretched out, or too short for a pelvis that walks on while they stand."""
    rng = np.random.default_rng(seed)
    model, times = load_model("puppet"), np.arange(0, 1.2, 1 / rate)
    q = walk(model, times)
    q[:, 0] += drift * times
    start = float(rng.uniform(0.15, 0.3))
    stances = {"left_foot": [(start, start + float(rng.uniform(0.2, 0.7)))]}
    locked = lock(model, times, q, stances)
    seen, far = _drift(model, locked, "left_foot", *stances["left_foot"][0])
    told = np.any([(seen >= s.start - 3e-3) & (seen <= s.end + 3e-3) for s in locked.slides], axis=0)
    assert (far[~np.broadcast_to(told, far.shape)] <= 1e-4 + 1e-6).all()
    assert all(
        s.far == pytest.approx(np.interp(s.worst, seen, far), rel=0.02, abs=1e-5) for s in locked.slides
    )
    assert locked.met.all() == (not locked.slides)
    assert all(ik_cases.illegal(model, x) == [] for x in locked.q)


@needs_captures
def test_captured_feet_stand_still():
    model, t, q, stances = captures.capture("fb")
    assert sum(map(len, stances.values())) >= 4
    locked = lock(model, t, q, stances)
    assert locked.met.all()
    assert _far(model, locked, stances) <= 1e-4
    given = smooth_clip(model, t, q, range(model.njnt)).evaluate(locked.t)
    assert np.abs(locked.clip().evaluate(locked.t).a).max() < 1.5 * np.abs(given.a).max()


@needs_captures
def test_a_captured_leg_that_is_too_short_slides_where_it_says():
    """Down on one knee: at last the place of the right foot is further from the hip than the leg is long."""
    model, t, q, stances = captures.capture("mb")
    few = slice(60, 125)
    t, q = t[few], q[few]
    stances = {"body:RightAnkle": [(float(t[5]), 3.66)], "body:LeftAnkle": [(float(t[0]), float(t[-1]))]}
    locked = lock(model, t, q, stances)
    assert {slide.frame for slide in locked.slides} == {"body:RightAnkle"}
    times, far = _drift(model, locked, "body:RightAnkle", *stances["body:RightAnkle"][0])
    place = frame(model, "body", "RightAnkle").pose(
        smooth_clip(model, t, q, range(model.njnt)).evaluate(np.array([0.5 * (t[5] + 3.66)])).q
    )[0, :3, 3]
    hip = frame(model, "body", "RightHip").pose(smooth_clip(model, t, q, range(model.njnt)).evaluate(times).q)
    leg = sum(np.linalg.norm(model.body(name).pos) for name in ("RightKnee", "RightAnkle"))
    beyond = np.maximum(0, np.linalg.norm(hip[:, :3, 3] - place, axis=1) - leg)
    assert beyond.max() > 0.01
    assert (far > beyond - 1e-4).all()
    told = np.any([(times >= s.start - 5e-3) & (times <= s.end + 5e-3) for s in locked.slides], axis=0)
    assert (far[~told] <= 1e-4).all()
    np.testing.assert_allclose(far, beyond, atol=3e-4)  # where the leg stretches, the spline has a kink
    slide = max(locked.slides, key=lambda slide: slide.far)
    assert slide.far == pytest.approx(beyond.max(), abs=1e-4)
    over = times[far > 1e-4]
    assert min(s.start for s in locked.slides) == pytest.approx(over.min(), abs=0.01)
    assert max(s.end for s in locked.slides) == pytest.approx(over.max(), abs=0.01)
    assert all(np.interp(s.worst, times, far) == pytest.approx(s.far, abs=1e-4) for s in locked.slides)
    assert locked.slip.max() == pytest.approx(far.max(), abs=1e-4)
    assert _drift(model, locked, "body:LeftAnkle", *stances["body:LeftAnkle"][0])[1].max() <= 1e-4


def test_a_place_out_of_a_legs_reach_is_told():
    model, times = load_model("puppet"), np.arange(0, 1, 1 / 10)
    q = np.tile(model.qpos0, (len(times), 1))
    q[:, 0] += np.linspace(-1, 1, len(times))
    locked = lock(model, times, q, {"left_foot": [(0.0, 0.9)]})
    assert not locked.met[0] and locked.slip[0] > 0.1
    f = frame(model, "site", "left_foot").pose(locked.q[[0, len(locked.q) // 2]])[:, :3, 3]
    first, last = locked.slides
    assert (first.start, last.end) == (0.0, pytest.approx(0.9)) and first.end < 0.45 < last.start
    assert first.far == pytest.approx(np.linalg.norm(f[0] - f[1]), abs=2e-3)
    assert "left_foot slides between 0.000 s" in str(first)


@pytest.mark.parametrize(
    ("stances", "message"),
    [
        ({}, "no frame stands"),
        ({"tip": []}, "'tip' has no stance"),
        ({"tip": [(1, 0)]}, "end after it starts"),
        ({"tip": [(0.5, 0.5)]}, "end after it starts"),
        ({"tip": [(0.5, float("nan"))]}, "end after it starts"),
        ({"tip": [(3, 4)]}, "not within the motion, 0 s to 2 s"),
        ({"tip": [(1, 2.1)]}, "not within the motion, 0 s to 2 s"),
        ({"tip": [(0.5, 1), (0.2, 0.6)]}, "overlap: one ends at 0.6 s, the next starts at 0.5 s"),
        ({"tipp": [(0.5, 1)]}, "tip"),
    ],
)
def test_stances_that_mean_nothing_are_told(stances, message):
    with pytest.raises(ModelError, match=message):
        lock(load_model("arm6"), [0, 1, 2], np.zeros((3, 6)), stances)


def test_motions_that_mean_nothing_are_told():
    model, stances = load_model("arm6"), {"tip": [(0, 0.1)]}
    with pytest.raises(ModelError, match="3 x 6 finite"):
        lock(model, [0, 0.1, 0.2], np.zeros((3, 5)), stances)
    with pytest.raises(ModelError, match="evenly spaced"):
        lock(model, [0, 0.1, 0.3], np.zeros((3, 6)), stances)
    with pytest.raises(ModelError, match="ease in"):
        lock(model, [0, 0.1, 0.2], np.zeros((3, 6)), stances, ease=-1)
    with pytest.raises(ModelError, match="tolerance"):
        lock(model, [0, 0.1, 0.2], np.zeros((3, 6)), stances, tolerance=0)
