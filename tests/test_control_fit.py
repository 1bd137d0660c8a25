"""Motion against machines: what is impossible is found, and retimed motion is possible and the fastest."""

import copy
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pantograph.controllers.fit import Phase, check, machine, retime
from pantograph.controllers.fit.check import follow, forces
from pantograph.controllers.fit.timing.halfspaces import needed
from pantograph.models import load_model
from pantograph.sim import PantographError
from pantograph.sim.clip import Clip, Motion
from pantograph.sim.curves import PolynomialCurve, keyed
from scipy.interpolate import PPoly
from scipy.optimize import brentq, linprog
from strategies import seeds

NAMES = ("shoulder", "elbow")
ARM = load_model("planar_2r")


def arm_clip(seed, *, kind="natural", seconds=2.0, keys=4, size=1.0):
    rng = np.random.default_rng(seed)
    t = np.linspace(0, seconds, keys)
    return Clip(ARM, {n: keyed(t, size * rng.uniform(-1, 1, keys), kind=kind) for n in NAMES}, ARM.qpos0)


def line(distance, seconds=1.0):
    return Clip(ARM, {"shoulder": keyed([0, seconds], [0, distance], kind="linear")}, ARM.qpos0)


@given(st.floats(0.05, 2.5), st.floats(0.2, 5), st.floats(0.5, 20), st.floats(0.3, 3))
def test_a_straight_way_takes_the_time_of_the_trapezoid(d, v, a, seconds):
    able = machine(ARM, velocity=v, acceleration=a, force=np.inf)
    found = retime(line(d, seconds), able, points=400)
    closed = 2 * np.sqrt(d / a) if d <= v * v / a else d / v + v / a
    piece = d / 400 / min(v, np.sqrt(a * d))  # a switch between points costs up to the time of a piece
    assert closed * (1 - 1e-9) <= found.duration <= closed + 2 * piece
    assert found.report.possible


@given(seeds, st.sampled_from(["natural", "clamped", "auto", "linear"]))
@settings(max_examples=30)
def test_limits_hold_between_the_points_of_the_grid_too(seed, kind):
    """By MuJoCo's inverse dynamics and plain differences on a grid of its own."""
    top = 12.0
    able = machine(
        ARM, velocity=2.0, acceleration=9.0, force={"shoulder": 90.0, "elbow": 25.0}, top_speed=top
    )
    clip = arm_clip(seed, kind=kind)
    found = retime(clip, able, points=300)
    t = np.linspace(0, found.duration, 7001)
    q, v, a = found.clip.evaluate(t)
    data = mujoco.MjData(ARM)
    tau = np.empty_like(v)
    for i in range(0, len(t), 7):
        data.qpos[:], data.qvel[:], data.qacc[:] = q[i], v[i], a[i]
        mujoco.mj_inverse(ARM, data)
        tau[i] = data.qfrc_inverse
    limit = np.array([90.0, 25.0]) * (1 - np.maximum(np.sign(tau[::7]) * v[::7], 0) / top)
    assert (np.abs(tau[::7]) <= limit * (1 + 1e-4)).all()
    assert np.abs(v).max() <= 2.0 * (1 + 1e-6)
    assert np.abs(a).max() <= 9.0 * (1 + 2e-4)
    h = np.diff(t)[0]
    np.testing.assert_allclose(np.diff(q, axis=0) / h, 0.5 * (v[1:] + v[:-1]), atol=9.0 * h)


@given(seeds)
@settings(max_examples=10)
def test_no_timing_is_faster(seed):
    """The largest profile on the grid is the solution of one linear program, here by HiGHS."""
    clip, n = arm_clip(seed, keys=3), 40
    able = machine(ARM, velocity=2.0, acceleration=9.0, force=np.inf)
    found = retime(clip, able, points=n)
    s = found.s
    h, n = np.diff(s), len(s) - 1
    first, last = clip.evaluate(s[:-1]), clip.evaluate(s[1:], left=True)
    rows, bound = [], []
    for i in range(n):  # u_i = (x_{i+1} - x_i) / 2h
        for motion, k in ((first, i), (last, i + 1)):
            for dof in range(2):
                row = np.zeros(n + 1)
                row[i], row[i + 1] = -motion.v[i, dof] / (2 * h[i]), motion.v[i, dof] / (2 * h[i])
                row[k] += motion.a[i, dof]
                rows += [row, -row]
                bound += [9.0, 9.0]
    at = clip.evaluate(s)
    cap = np.min((2.0 / np.maximum(np.abs(at.v), 1e-12)) ** 2, axis=1)
    cap[0] = cap[-1] = 0.0
    lp = linprog(
        -np.ones(n + 1), np.array(rows), np.array(bound), bounds=list(zip(np.zeros(n + 1), cap, strict=True))
    )
    rate = np.sqrt(np.maximum(lp.x, 0.0))
    best = float(np.sum(2 * h / (rate[1:] + rate[:-1])))
    slowed = found.t[-1] / best
    assert slowed == pytest.approx(1.0, abs=2e-2)
    raw = np.diff(found.t) / slowed
    assert np.abs(raw - 2 * h / (rate[1:] + rate[:-1])).max() <= 1e-3 * best  # HiGHS: x to 1e-7


@given(seeds, st.floats(0.2, 3))
@settings(max_examples=15)
def test_the_nearest_timing_is_the_keyed_one_where_that_is_possible(seed, speed):
    clip = arm_clip(seed, kind="clamped")
    able = machine(ARM, velocity=speed, acceleration=30.0, force=np.inf)
    found = retime(clip, able, keep=True, points=300)
    rate = np.diff(found.s) / np.diff(found.t)
    assert rate.max() <= 1.0 + 1e-9
    if check(clip, able).possible:
        assert found.duration == pytest.approx(2.0, rel=1e-6)
        t = np.linspace(0, 2, 101)
        np.testing.assert_allclose(found.clip.evaluate(t).q, clip.evaluate(t).q, atol=1e-6)
    else:
        assert found.duration > 2.0
        assert found.report.possible


@given(seeds)
@settings(max_examples=15)
def test_the_path_stays_the_same(seed):
    clip = arm_clip(seed)
    found = retime(clip, machine(ARM, velocity=1.0, acceleration=5.0, force=np.inf), points=200)
    fine = np.linspace(0, found.duration, 5000)
    way = clip.evaluate(np.linspace(0, 2, 4001)).q
    for q in found.clip.evaluate(fine[::250]).q:
        assert np.abs(way - q).max(axis=1).min() < 2e-3
    ends = found.clip.evaluate([0.0, found.duration]).q
    np.testing.assert_allclose(ends, clip.evaluate([0.0, 2.0]).q, atol=1e-9)
    q, v, a = found.clip.evaluate(fine)
    inner = np.ones(len(fine), dtype=bool)
    for knot in found.t:
        inner &= np.abs(fine - knot) > 1e-6
    h = 1e-6
    ahead, behind = (
        found.clip.evaluate(fine[inner][1:-1] + h / 2),
        found.clip.evaluate(fine[inner][1:-1] - h / 2),
    )
    np.testing.assert_allclose((ahead.q - behind.q) / h, v[inner][1:-1], atol=1e-4)
    np.testing.assert_allclose((ahead.v - behind.v) / h, a[inner][1:-1], atol=1e-3)


@given(st.floats(0.1, 2.5), st.floats(5.0, 200.0), st.sampled_from(["linear", "clamped", "auto"]))
@settings(max_examples=6)
def test_bounded_jerk_takes_four_equal_parts(d, jerk, kind):
    """From rest to rest with jerk alone bounded: + - - +, T = (32 d / j)^(1/3), however it is keyed."""
    clip = Clip(ARM, {"shoulder": keyed([0, 1], [0, d], kind=kind)}, ARM.qpos0)
    found = retime(clip, machine(ARM, jerk=jerk, force=np.inf), points=400)
    closed = np.cbrt(32 * d / jerk)
    assert closed * (1 - 1e-6) <= found.duration <= closed * 1.01
    assert found.report.possible


@pytest.mark.parametrize(("seed", "kind"), [(0, "natural"), (2, "clamped"), (3, "auto")])
def test_jerk_holds_with_all_other_limits(seed, kind):
    """By plain differences and MuJoCo's inverse dynamics on a grid of its own; the path is the keyed one."""
    limits = {"velocity": 2.0, "acceleration": 9.0, "force": {"shoulder": 90.0, "elbow": 25.0}}
    clip, tight = arm_clip(seed, kind=kind, keys=3), machine(ARM, **limits, jerk=80.0)
    found = retime(clip, tight, points=400)
    assert found.report.possible
    assert found.duration > retime(clip, machine(ARM, **limits), points=400).duration
    t = np.linspace(0, found.duration, 5001)[:-1]
    q, v, a = found.clip.evaluate(t)
    assert np.abs(v).max() <= 2.0 * (1 + 1e-4)
    assert np.abs(a).max() <= 9.0 * (1 + 1e-3)
    assert np.abs(a[0]).max() <= 1e-6
    assert (np.abs(np.diff(a, axis=0)) / t[1]).max() <= 80.0 * (1 + 1e-3)
    np.testing.assert_allclose(np.diff(v, axis=0) / t[1], 0.5 * (a[1:] + a[:-1]), atol=1e-2)
    data = mujoco.MjData(tight.model)
    for row in zip(q[::10], v[::10], a[::10], strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(tight.model, data)
        assert (np.abs(data.qfrc_inverse) <= np.array([90.0, 25.0]) * (1 + 1e-3)).all()
    way = clip.evaluate(np.linspace(0, 2, 20001)).q
    off = max(np.abs(way - row).max(axis=1).min() for row in q[::100])
    assert off < 2e-4
    np.testing.assert_allclose(found.clip.evaluate(found.duration).q, clip.evaluate(2.0).q, atol=1e-9)


def test_curvature_that_jumps_is_a_stop_and_only_there():
    """Between the keys of an auto curve from stop to stop; a natural one has none, and is the faster."""
    times, keys = [0, 1, 2, 3], np.array([[0.0, 0.5, 0.9, 1.0], [0.0, 0.1, 0.5, 0.6]])
    able = machine(ARM, velocity=3.0, acceleration=20.0, jerk=300.0, force=np.inf)
    found = {}
    for kind in ("auto", "natural"):
        tracks = {n: keyed(times, row, kind=kind) for n, row in zip(NAMES, keys, strict=True)}
        found[kind] = retime(Clip(ARM, tracks, ARM.qpos0), able, points=1200)
        assert found[kind].report.possible
        assert found[kind].slowed < 1.01
    auto = found["auto"]
    assert [s.s for s in auto.stops] == [1.0, 2.0]
    assert all(s.why == "the curvature of shoulder, elbow jumps" for s in auto.stops)
    at = auto.clip.evaluate([s.t for s in auto.stops])
    assert np.abs(at.v).max() <= 1e-9
    assert np.abs(at.a).max() <= 1e-6
    assert found["natural"].stops == ()
    assert found["natural"].duration < auto.duration
    parts = []  # each piece by itself, from rest to rest, takes as long
    for k in range(3):
        cut = [keyed_piece(c, times[k], times[k + 1]) for c in auto_curves(times, keys)]
        clip = Clip(ARM, dict(zip(NAMES, cut, strict=True)), ARM.qpos0)
        parts.append(retime(clip, able, points=400).duration)
    assert auto.duration == pytest.approx(sum(parts), rel=5e-3)


def auto_curves(times, keys):
    return [keyed(times, row, kind="auto") for row in keys]


def keyed_piece(curve, start, stop):
    """A cubic piece of a curve as a curve of its own."""
    inside = np.linspace(start, stop, 4)
    powers = np.linalg.solve(np.vander(inside - start, 4), curve(inside).q)
    t = np.array([0.0, stop - start])
    ends = curve([start]).q, curve([stop], left=True).q
    return PolynomialCurve(t, np.concatenate(ends), t, "hold", "hold", powers[:, None, :])


@given(st.floats(0.2, 2.0), st.floats(20.0, 300.0))
@settings(max_examples=5)
def test_the_way_back_is_no_stop(d, jerk):
    """There and back with jerk alone bounded: + - on the way and, mirrored, - + back; no rest at the turn."""
    clip = Clip(ARM, {"shoulder": keyed([0, 1, 2], [0, d, 0], kind="clamped")}, ARM.qpos0)
    found = retime(clip, machine(ARM, jerk=jerk, force=np.inf), points=400)
    assert found.stops == ()
    assert found.duration == pytest.approx(2 * np.cbrt(d / jerk / half_way_back()), rel=5e-3)
    turn = np.interp(1.0, found.s, found.t)
    assert abs(found.clip.evaluate(turn).v[0]) <= 1e-9
    assert abs(found.clip.evaluate(turn).a[0]) > 0.3 * np.cbrt(d * jerk**2)


def half_way_back():
    """Distance in one second from rest to a speed of zero with jerk + 1, then - 1: v(1) = 0."""
    t = brentq(lambda x: 0.5 * x**2 + x * (1 - x) - 0.5 * (1 - x) ** 2, 0.1, 0.9)
    w = 1 - t
    return t**3 / 6 + 0.5 * t**2 * w + 0.5 * t * w**2 - w**3 / 6


@pytest.mark.parametrize("kind", ["linear", "auto", "natural", "clamped", "smooth"])
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_bounded_jerk_costs_little_for_any_kind_of_keys(seed, kind):
    """No faster than without, and slower by no more than a few changes of the acceleration a key."""
    rng = np.random.default_rng(seed)
    t = np.cumsum(rng.uniform(0.2, 1.0, 5))
    ease = {"ease": "smooth"} if kind == "smooth" else {"kind": kind}
    tracks = {n: keyed(t, rng.uniform(-1, 1, 5), **ease) for n in NAMES[: 1 + seed % 2]}
    clip = Clip(ARM, tracks, ARM.qpos0)
    limits = {"velocity": 2.0, "acceleration": 8.0, "force": np.inf}
    found = retime(clip, machine(ARM, **limits, jerk=80.0), points=400)
    least = retime(clip, machine(ARM, **limits), points=400).duration
    assert found.report.possible
    assert found.slowed < 1.03
    assert least <= found.duration <= least + 3 * len(t) * 2 * 8.0 / 80.0


def test_a_hairpin_is_no_stop():
    """Two joints that turn within a millisecond of each other."""
    t = [0.0, 1.0, 2.0]
    tracks = {
        "shoulder": keyed(t, [0.0, 0.8, 0.1], kind="natural"),
        "elbow": keyed(t, [0.0, 0.5, 0.06], kind="natural"),
    }
    clip = Clip(ARM, tracks, ARM.qpos0)
    able = machine(ARM, velocity=3.0, acceleration=20.0, jerk=200.0, force=np.inf)
    found = retime(clip, able, points=400)
    assert found.report.possible
    assert found.slowed < 1.03
    straight = retime(Clip(ARM, {"shoulder": tracks["shoulder"]}, ARM.qpos0), able, points=400)
    assert found.duration == pytest.approx(straight.duration, rel=0.1)


@given(seeds)
@settings(max_examples=10)
def test_limits_left_out_follow_from_those_that_stay(seed):
    """What the others allow never exceeds them; some rows are equal, some hardly differ, some ask for nothing
    or for the same of one coordinate, and one coordinate may be far larger."""
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(2, 20, 3)) * [1.0, 10.0 ** rng.uniform(-6, 6), 1.0]
    rows[:, :8, 2] = 4.0
    rows = np.concatenate([rows, -rows, rows[:, :5], 0.999 * rows[:, :3], np.zeros((2, 2, 3))], axis=1)
    positive = (False, bool(seed % 2), True)
    kept = needed(rows, positive)
    assert kept.sum() < 0.7 * kept.size
    ends = [(0.0 if p else None, None) for p in positive]
    for at, mine in zip(rows / np.abs(rows).max(axis=1, keepdims=True), kept, strict=True):
        for row in at[~mine]:
            most = linprog(-row, A_ub=at[mine], b_ub=np.ones(mine.sum()), bounds=ends, method="highs")
            assert most.status == 0
            assert -most.fun <= 1.0 + 1e-7


@pytest.mark.parametrize("jerk", [30.0, 3000.0])
def test_all_limits_of_many_joints_are_asked_for(jerk):
    """Forth and back, speeding up and braking: nothing is left for slowing down the whole."""
    model, rng = load_model("arm6"), np.random.default_rng(5)
    times, names = np.linspace(0.0, 3.0, 6), [model.joint(j).name for j in range(6)]
    tracks = {n: keyed(times, rng.uniform(-0.9, 0.9, 6), kind="natural") for n in names}
    able = machine(model, velocity=9.0, acceleration=8.0, jerk=jerk, force=np.inf)
    found = retime(Clip(model, tracks, model.qpos0), able, points=400)
    assert found.report.possible
    assert found.slowed < 1.02


@given(seeds)
@settings(max_examples=10)
def test_jerk_of_a_trace_is_that_of_the_polynomials(seed):
    """Quintics: by SciPy's third derivative, and infinite where accelerations jump."""
    rng = np.random.default_rng(seed)
    t, c = np.array([0.0, 0.7, 1.0]), rng.normal(size=(6, 2, 1))
    c[-1, 1] = sum(c[k, 0] * 0.7 ** (5 - k) for k in range(6))
    curve = PolynomialCurve(t, np.zeros((3, 1)), t, "hold", "hold", c)
    clip = Clip(ARM, {"elbow": curve}, ARM.qpos0)
    trace = follow(clip, t)
    exact = np.abs(PPoly(c, t).derivative(3)(trace.t[:, None])[..., 0, 0])
    inner = np.ones(22, dtype=bool)
    inner[[10, 11]] = False  # the right side of the break is what SciPy gives
    np.testing.assert_allclose(trace.jerk[inner, 1], exact[inner], rtol=1e-9, atol=1e-9)
    assert np.isinf(trace.jerk[[10, 11], 1]).all()


@given(seeds)
@settings(max_examples=8)
def test_velocity_alone_holds_where_keys_rest(seed):
    """Where keys rest any rate will do at a point, but not beside it."""
    clip = arm_clip(seed, kind="auto", keys=5)
    found = retime(clip, machine(ARM, velocity=1.5, force=np.inf), points=300)
    assert found.report.possible
    assert found.slowed < 1.02
    way = np.abs(np.diff(clip.evaluate(np.linspace(0, 2, 4001)).q, axis=0)).max(axis=1).sum()
    assert way / 1.5 <= found.duration * (1 + 1e-6) <= 1.05 * way / 1.5


def test_a_missing_drive_is_a_violation():
    """A keyed joint without a drive, and what it would need: here its weight, or the ground's push."""
    still = Clip(ARM, {"elbow": keyed([0, 1], [0.0, 0.0])}, ARM.qpos0)
    able = machine(ARM, driven=np.array([True, False]))
    report = check(still, able)
    assert [v.kind for v in report.violations] == ["missing force"]
    assert report.violations[0].value == pytest.approx(abs(able.nominal.weight(ARM.qpos0)[1]), rel=1e-9)
    assert np.isinf(machine(ARM, driven=able.driven, velocity=1.0).velocity).tolist() == [False, True]
    ground = Phase(0.0, 1.0, ("tip",), ground=None)
    assert check(still, able, phases=[ground]).possible
    late = Phase(0.5, 1.0, ("tip",), ground=None)
    assert check(still, able, phases=[late]).violations[0].stop == pytest.approx(0.5, abs=1e-3)


def test_a_battery_bounds_the_sum_of_currents():
    clip, ampere = arm_clip(3), {"shoulder": 0.1, "elbow": 0.2}
    free = retime(clip, machine(ARM, velocity=3.0), points=200)
    tight = machine(ARM, velocity=3.0, ampere=ampere, current=9.0)
    found = retime(clip, tight, points=200)
    assert found.duration > free.duration
    tau = forces(found.clip.evaluate(np.linspace(0, found.duration, 3001)), tight)
    assert (np.abs(tau) @ np.array([0.1, 0.2])).max() <= 9.0 * (1 + 1e-4)


@pytest.mark.parametrize("joints", [5, 7])
def test_a_battery_of_many_joints_is_used_up_everywhere(joints):
    """One limit alone: the fastest timing draws all of it at nearly every time, by MuJoCo's own forces."""
    chain = "".join(
        f'<body pos=".1 0 0"><joint name="j{i}" axis="0 1 0" damping=".01"/><geom size=".03" mass=".1"/>'
        for i in range(joints)
    )
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{chain}{'</body>' * joints}</worldbody></mujoco>"
    )
    rng = np.random.default_rng(joints)
    tracks = {f"j{i}": keyed([0, 1, 2], rng.uniform(-0.5, 0.5, 3)) for i in range(joints)}
    clip = Clip(model, tracks, model.qpos0)
    q = clip.evaluate(np.linspace(0, 2, 201)).q
    still = Motion(q, np.zeros_like(q), np.zeros_like(q))
    current = 3.0 * 2.0 * np.abs(forces(still, machine(model))).sum(axis=1).max()
    found = retime(clip, machine(model, ampere=2.0, current=current), points=300)
    assert found.slowed < 1.01
    data, draw = mujoco.MjData(model), []
    for row in zip(*found.clip.evaluate(np.linspace(0, found.duration, 801)[1:-1]), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = row
        mujoco.mj_inverse(model, data)
        draw.append(2.0 * np.abs(data.qfrc_inverse).sum())
    assert max(draw) <= current * (1 + 1e-4)
    assert np.mean(np.array(draw) > 0.97 * current) > 0.9


RUBBING = mujoco.MjModel.from_xml_string(
    """<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0" frictionloss="3"/>
    <geom size=".1" mass="2"/><body><joint name="arm" axis="0 1 0" frictionloss="6"/>
    <geom size=".1" mass="0.1" pos=".5 0 0"/></body></body></worldbody></mujoco>"""
)


@given(st.floats(0.1, 2), st.floats(3.2, 20), st.sampled_from([1.0, -1.0]))
@settings(max_examples=15)
def test_friction_opposes_the_way_and_helps_to_brake(way, force, sign):
    """From rest to rest: (force - friction) / m to the switch, (force + friction) / m after it."""
    clip = Clip(RUBBING, {"x": keyed([0, 1], [0, sign * way], kind="linear")}, RUBBING.qpos0)
    able = machine(RUBBING, force={"x": force})
    slow, brake = (force - 3.0) / 2.1, (force + 3.0) / 2.1
    best = np.sqrt(2.0 * way * (1.0 / slow + 1.0 / brake))
    found = retime(clip, able, points=400)
    assert best * (1 - 1e-6) <= found.duration <= best * 1.01
    shares = check(found.clip, able).uses
    assert {use.who: use.share for use in shares}["x"] == pytest.approx(1.0, abs=1e-3)


@given(seeds)
@example(4)  # a turn right where the force is all there is
@settings(max_examples=10)
def test_friction_turns_where_joints_turn_back(seed):
    """By MuJoCo's inverse dynamics, dense around each turn; nothing has to be slowed as a whole for it."""
    model = copy.copy(ARM)
    model.dof_frictionloss[:] = friction = np.array([20.0, 8.0])
    clip, limit = Clip(model, arm_clip(seed).tracks, model.qpos0), np.array([110.0, 40.0])
    able = machine(model, velocity=3.0, force=dict(zip(NAMES, limit, strict=True)))
    found = retime(clip, able, points=300)
    assert found.slowed < 1.02
    t = np.linspace(0, found.duration, 3001)[1:-1]
    v = found.clip.evaluate(t).v
    turns = t[:-1][(v[1:] * v[:-1] < 0).any(axis=1)]
    t = np.concatenate([t, *(turns[:, None] + np.linspace(0, t[1] - t[0], 60)).reshape(-1, 60)])
    data = mujoco.MjData(able.model)
    for q, v, a in zip(*found.clip.evaluate(t), strict=True):
        data.qpos[:], data.qvel[:], data.qacc[:] = q, v, a
        mujoco.mj_inverse(able.model, data)
        assert (np.abs(data.qfrc_inverse + friction * np.sign(v)) <= limit * (1 + 1e-6)).all()


def test_what_friction_forbids_and_what_it_holds():
    """A drive weaker than friction moves nothing; what friction bears at rest needs no drive."""
    moves = Clip(RUBBING, {"x": keyed([0, 1], [0, 0.01], ease="smooth")}, RUBBING.qpos0)
    weak = machine(RUBBING, force={"x": 2.5, "arm": 0.1})
    found = check(moves, weak)
    assert [v.who for v in found.violations] == ["x"]  # the arm's weight, 0.5 N m, hangs in its friction
    assert found.worst > 3.0 / 2.5
    with pytest.raises(PantographError, match="dry friction counted"):
        retime(moves, weak)


def test_pauses_keep_their_length():
    clip = Clip(ARM, {"shoulder": keyed([0, 1, 2, 3], [0, 1, 1, 0], kind="auto")}, ARM.qpos0)
    found = retime(clip, machine(ARM, velocity=50.0, acceleration=200.0, force=np.inf), points=300)
    at = np.interp([1.0, 2.0], found.s, found.t)
    assert at[1] - at[0] == pytest.approx(1.0, rel=1e-2)
    assert found.duration < 1.6


def test_check_says_where_and_by_how_much():
    """A sine-like clamped move of known peaks: q from 0 to 1 in 1 s, peak speed 1.5, end acceleration 6."""
    clip = Clip(ARM, {"elbow": keyed([0, 1], [0.0, 1.0], kind="clamped")}, ARM.qpos0)
    able = machine(ARM, velocity=1.2, acceleration=5.0, jerk=20.0, force=np.inf)
    report = check(clip, able, points=5001)
    found = {v.kind: v for v in report.violations}
    assert found["velocity"].share == pytest.approx(1.5 / 1.2, rel=1e-6)
    assert found["velocity"].t == pytest.approx(0.5, abs=1e-3)
    cross = 0.5 - np.sqrt(0.25 - 1.2 / 6)  # 6 t (1 - t) = 1.2
    assert found["velocity"].start == pytest.approx(cross, abs=1e-3)
    assert found["velocity"].stop == pytest.approx(1 - cross, abs=1e-3)
    assert found["acceleration"].share == pytest.approx(6 / 5, rel=1e-3)
    assert "acceleration" in str(found["acceleration"])
    assert found["jerk"].share == np.inf
    assert (found["jerk"].start, found["jerk"].stop) == (0.0, 1.0)  # out of rest and into it
    assert not report.possible
    assert check(clip, machine(ARM, velocity=1.6, acceleration=6.1, force=np.inf)).possible
    far = Clip(ARM, {"elbow": keyed([0, 1], [0.0, 3.1], kind="clamped")}, ARM.qpos0)
    beyond = check(far, machine(ARM)).violations
    position = next(v for v in beyond if v.kind == "position")
    assert position.value == pytest.approx(0.3, abs=1e-9)


@pytest.mark.parametrize(
    ("clip", "limits", "words"),
    [
        (line(1.0), {"force": 1.0}, "joint 'shoulder' cannot hold the pose at 0.000 s"),
        (line(3.5), {"velocity": 1.0}, "no timing helps: shoulder: 0.4 rad or m beyond"),
        (arm_clip(0, kind="step"), {"velocity": 1.0}, "the path jumps at"),
        (line(1.0), {"velocity": {"sholder": 1.0}}, "did you mean 'shoulder'"),
        (line(1.0), {"velocity": -1.0}, "velocity must be a positive number, got -1.0"),
        (line(1.0), {"velocity": 0.0}, "velocity must be a positive number, got 0.0"),
        (
            line(1.0),
            {"driven": np.array([True, False])},
            "needs a drive at every joint of what moves, and nothing drives .elbow.",
        ),
    ],
)
def test_what_cannot_be_helped_is_said(clip, limits, words):
    with pytest.raises(PantographError, match=words):
        retime(clip, machine(ARM, **limits))


def test_drives_may_pull_harder_than_they_push():
    """A weight of 2 g N is held by what pushes up, whatever pulls down."""
    model = mujoco.MjModel.from_xml_string(
        """<mujoco><worldbody><body><joint name="z" type="slide" axis="0 0 1"/>
        <geom size=".1" mass="2"/></body></worldbody></mujoco>"""
    )
    clip = Clip(model, {"z": keyed([0, 1], [0.0, 1e-9])}, model.qpos0)
    for low, high, share in ((-5.0, 40.0, 0.4905), (-40.0, 5.0, 3.924)):
        able = replace(machine(model, force=1.0), force_low=np.array([low]), force_high=np.array([high]))
        assert check(clip, able).worst == pytest.approx(share, rel=1e-4)


def test_forces_are_those_of_one_state():
    able, rng = machine(ARM), np.random.default_rng(1)
    motion = Motion(*rng.normal(size=(3, 5, 2)))
    one = [able.nominal.inverse(*row) for row in zip(*motion, strict=True)]
    np.testing.assert_allclose(forces(motion, able), one)
