"""What answers of inverse kinematics say of themselves: starts, lists of solutions, nearest poses, units."""

import re

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from oracles import ik_cases, ik_loops, ik_planar
from pantograph.models import ModelError, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import (
    ChainSolver,
    Distance,
    JointValue,
    LookAt,
    Orientation,
    PointOnLine,
    PointOnPlane,
    Pose,
    Position,
    Posture,
    Spread,
    solve,
)
from pantograph.sim.ik.problem import Problem
from pantograph.sim.ik.proofs.gaps import goal_gap
from pantograph.sim.ik.space import Space
from strategies import seeds

Z = (0, 0, 1)


def _trap():
    """One hinge to a point at 3.0 rad, and starts from which the way there ends at the limit of -3.1 rad."""
    model = ik_cases.planar_chain([1.0], [(-3.1, 3.1)])
    return model, np.array([np.cos(3.0), np.sin(3.0), 0])


@pytest.mark.parametrize("count", [0, 1, 3, 7, 8, 40])
def test_a_race_makes_the_starts_it_is_given_and_counts_them(count):
    model, p = _trap()
    racer = ChainSolver(model, "tip", rotation=False).racer
    trapped = np.linspace(-3.0, -2.0, count)[:, None]
    raced = racer([-2.9], np.eye(3), p, tolerance=(1e-9, 1e-9), most=100_000, starts=trapped)
    assert not raced.met[0]
    assert raced.starts[0] == count
    assert raced.iterations[0] < 100 * (count + 1)
    good = np.append(trapped, [[2.9]], axis=0)
    raced = racer([-2.9], np.eye(3), p, tolerance=(1e-9, 1e-9), most=100_000, starts=good)
    assert raced.met[0]
    assert raced.starts[0] == count + 1
    assert raced.q[0, 0] == pytest.approx(3.0, abs=1e-8)


def test_machine_code_is_used_at_once_never_or_when_it_pays():
    """A structure that was never asked for before: the first two answers are of one code, or of another."""
    length = 0.3 + 1e-3 * np.random.default_rng().random()
    model = ik_cases.planar_chain([1.0, 0.8, length, 0.5], [(-2, 2)] * 4)
    problem = Problem(model, [Position("tip", [1.2, 0.9, 0])], Space(model))
    for compiled, made in ((False, False), (None, False), (True, True)):
        assert solve(model, problem.goals, compiled=compiled).solved
        assert (problem.prepared() is not None) == made
        problem = problem.only(problem.goals)
    assert Problem(model, problem.goals, Space(model), code=False).prepared(build=True) is None
    numpy, machine = (solve(model, problem.goals, compiled=compiled).q for compiled in (False, True))
    np.testing.assert_allclose(numpy, machine, rtol=0, atol=1e-7)
    assert (numpy != machine).any()


def _hard_pose(index):
    case = ik_cases.reachable_at_limit(np.random.default_rng([index, 3]))
    return case.model, case.goals


@pytest.mark.parametrize("compiled", [False, True])
def test_the_seed_decides_the_starts_and_the_answer_bit_for_bit(compiled):
    differ = 0
    for index in range(12):
        model, goals = _hard_pose(index)
        one, same, other = (
            solve(model, goals, seed=seed, q0=model.jnt_range[:, 0], compiled=compiled) for seed in (4, 4, 5)
        )
        np.testing.assert_array_equal(one.q, same.q)
        assert (one.iterations, one.restarts, str(one.verdict)) == (
            same.iterations, same.restarts, str(same.verdict),
        )  # fmt: skip
        differ += one.iterations != other.iterations
    assert differ > 2


@pytest.mark.parametrize("restarts", [0, 1, 20, 33, 90])
def test_no_more_restarts_are_made_than_are_asked_for_and_all_are_counted(restarts):
    """Six skew joints have no closed form, and the limits leave no pose out that lengths could exclude."""
    rng = np.random.default_rng(2)
    links = [(0.3 * rng.normal(size=3), ik_cases.HINGE, ik_cases.unit(rng), (-0.4, 0.4)) for _ in range(6)]
    model = ik_cases.chain([*links, ([0.2, 0.1, 0.3], None, None, None)])
    p, quat = ik_cases.pose_of(model, [0.9, -0.9, 0.9, 0.8, -0.9, 0.9], "tip")
    solution = solve(model, Pose("tip", p, quat), restarts=restarts)
    assert not solution.solved
    assert solution.restarts == solution.verdict.restarts == restarts
    assert f"none found in {restarts} restarts" in str(solution.verdict)
    listed = solve(
        model, Position("tip", ik_cases.pose_of(model, [0.1] * 6, "tip")[0]), restarts=restarts, all=True
    )
    assert listed.restarts == restarts
    model, goals = _hard_pose(3)
    assert solve(model, goals, restarts=restarts, all=True, q0=model.jnt_range[:, 0]).restarts <= restarts


def test_numbers_of_restarts_and_seeds_are_whole_and_not_negative():
    model = ik_cases.planar_chain([1.0, 0.8])
    goal = Position("tip", [1.2, 0.7, 0])
    for wrong in ({"restarts": -1}, {"restarts": 1.5}, {"seed": -3}, {"seed": "one"}):
        with pytest.raises(ModelError, match="whole number"):
            solve(model, goal, **wrong)
    with pytest.raises(ModelError, match="a goal is"):
        solve(model, [goal, [1.2, 0.7, 0]])


# Lists of solutions.


def test_a_closed_form_says_that_the_list_is_complete():
    model, target = ik_cases.planar_chain([1.0, 0.8], [(-7, 7), (-7, 7)]), [1.2, 0.7, 0]
    found = solve(model, Position("tip", target), all=True)
    assert found.complete and len(found.solutions) == 2  # whole turns within the limits count as one
    assert "2 solutions, all there are" in str(found.verdict)
    assert not solve(model, Position("tip", target)).complete
    model.jnt_range[1] = 0.1, 3.0
    found = solve(model, Position("tip", target), all=True)
    assert found.complete
    np.testing.assert_allclose(
        found.solutions, [max(ik_planar.two_links((1.0, 0.8), target[:2]), key=lambda q: q[1])]
    )
    nothing = solve(model, Position("tip", [2.0, 0, 0]), all=True)
    assert nothing.complete and len(nothing.solutions) == 0


def test_a_search_says_that_its_list_may_not_be_complete():
    rng = np.random.default_rng(2)
    links = [(0.3 * rng.normal(size=3), ik_cases.HINGE, ik_cases.unit(rng), (-2, 2)) for _ in range(6)]
    model = ik_cases.chain([*links, ([0.2, 0.1, 0.3], None, None, None)])
    p, quat = ik_cases.pose_of(model, rng.uniform(-1, 1, 6), "tip")
    found = solve(model, Pose("tip", p, quat), all=True)
    assert not found.complete
    assert "found, not proved to be all" in str(found.verdict)
    for i, x in enumerate(found.solutions):
        for y in found.solutions[:i]:
            assert np.abs(ik_planar.wrap(x - y)).max() > 1e-3
    loose = solve(model, Position("tip", p), all=True, restarts=10)
    assert not loose.complete and "3 freedoms are left" in str(loose.verdict)
    band = Position("tip", [1.2, 0.7, 0], tolerance=(0.01, 1e-6, 1e-6))
    assert not solve(ik_cases.planar_chain([1.0, 0.8]), band, all=True).complete


@pytest.mark.parametrize("seed", [12, 30, 63, 80, 81, 1, 2, 3])
def test_near_is_the_nearest_of_all_also_where_the_way_from_the_start_leads_elsewhere(seed):
    """A limited 3R arm to a point, from anywhere; by brute force along the first joint, the rest closed."""
    rng = np.random.default_rng([seed, 3000])
    lengths, limit = rng.uniform(0.4, 1, 3), rng.uniform(1.5, 3)
    model = ik_cases.planar_chain(lengths, [(-limit, limit)] * 3)
    target = ik_planar.forward(lengths, rng.uniform(-limit, limit, 3))[-1]
    q0, best = rng.uniform(-limit, limit, 3), np.inf
    for first in np.linspace(-limit, limit, 2001):
        c, s = np.cos(first), np.sin(first)
        rest = [[c, s], [-s, c]] @ (target - lengths[0] * np.array([c, s]))
        if abs(lengths[1] - lengths[2]) < np.hypot(*rest) < lengths[1] + lengths[2]:
            for pair in ik_planar.two_links(lengths[1:], rest):
                if np.abs(pair).max() <= limit:
                    best = min(best, np.sum((np.array([first, *pair]) - q0) ** 2))
    solution = solve(model, Position("tip", [*target, 0]), q0=q0)
    assert np.sum((solution.q - q0) ** 2) <= best + 1e-6


# The nearest pose.


def test_wishes_are_met_beside_a_goal_out_of_reach():
    links = [
        ([0, 0, 0], ik_cases.HINGE, Z, None),
        ([1, 0, 0], ik_cases.HINGE, Z, None),
        ([0.8, 0, 0], *[None] * 3),
    ]
    model = ik_cases.chain(links, branches=[links])
    place = ik_planar.forward((1.0, 0.8), (0.5, 0.9))[-1]
    solution = solve(model, [Position("tip", [2.3, 0.5, 0]), Position("tip1", [*place, 0], weight=1.0)])
    assert solution.verdict.kind == "out of reach"
    far, wished = solution.residuals
    assert far.position == pytest.approx(np.hypot(2.3, 0.5) - 1.8, abs=1e-9)
    assert wished.position < 1e-6


@settings(max_examples=10, deadline=None)
@given(seeds)
def test_a_stretched_limb_turns_to_what_is_wished(seed):
    """A limb stretched along u spins about u: the least angle of its across axis to d is asin |d . u|."""
    rng = np.random.default_rng(seed)
    links = [([0, 0, 0], ik_cases.BALL, Z, None), ([0.5, 0, 0], ik_cases.HINGE, (0, 1, 0), (-2.5, 2.5)),
             ([0.4, 0, 0], *[None] * 3)]  # fmt: skip
    model = ik_cases.chain(links)
    u, beyond = ik_cases.unit(rng), rng.uniform(0.05, 1.0)
    seen = 0.9 * u + 2 * ik_cases.unit(rng)
    goals = [Position("tip", (0.9 + beyond) * u), LookAt("tip", seen, axis=(0, 1, 0), weight=1.0)]
    far, sight = solve(model, goals).residuals
    assert far.position == pytest.approx(beyond, abs=1e-9)
    d = (seen - 0.9 * u) / 2
    assert sight.rotation == pytest.approx(np.arcsin(abs(d @ u)), abs=1e-4)


def test_the_nearest_pose_keeps_loops_closed():
    """A crank-rocker's rocker stops where crank and coupler are in line; its loop stays closed there."""
    ground, crank, coupler, rocker = ik_loops.GROUND, ik_loops.CRANK, ik_loops.COUPLER, ik_loops.ROCKER
    dead = np.pi - np.arccos((ground**2 + rocker**2 - (crank + coupler) ** 2) / (2 * ground * rocker))
    for beyond in (1e-3, 0.05, 0.5):
        solution = solve(ik_loops.four_bar(), JointValue("rocker", dead - beyond), q0=[0.5, 0.3, 1.3])
        assert solution.verdict.kind == "out of reach"
        assert solution.verdict.rotation == pytest.approx(beyond, abs=1e-7)
        asked, loop = solution.residuals
        assert asked.rotation == pytest.approx(beyond, abs=1e-7)
        assert loop.position < 1e-9


@pytest.mark.parametrize("far", [3.0, 30.0, 3e3, 1e6])
def test_a_floating_body_goes_as_far_as_it_is_asked(far):
    model = load_model("puppet")
    left = far * np.array([0.6, -0.8, 0.1])
    right = np.add(left, [0.2, 0.1, 0])
    assert solve(model, [Position("left_hand", left), Position("right_hand", right)]).solved


def test_equalities_that_cannot_hold_are_named():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body><joint name="j"/><geom size=".1"/><site name="s" pos="1 0 0"/></body>
      <site name="w" pos="3 0 0"/></worldbody>
      <equality><connect name="tie" site1="s" site2="w"/></equality></mujoco>""")
    verdict = solve(model, JointValue("j", 0.1)).verdict
    assert verdict.goals == ("tie",)
    assert (verdict.kind, verdict.position) == ("out of reach", pytest.approx(2.0))


def test_wishes_of_any_weight_are_served():
    model, place = load_model("arm6"), [0.3, 0.1, 0.4]
    for weight in (1e-200, 1e12):
        solution = solve(model, [Position("tip", place), JointValue("waist", 9, weight=weight)])
        assert solution.solved and solution.residuals[0].position < 1e-6


# Obstacles, units and tolerances.


def test_obstacles_count_where_they_are_named_or_are_a_mistake():
    spec = mujoco.MjSpec()
    body = spec.worldbody
    for i, length in enumerate((0.6, 0.5, 0.4)):
        body = body.add_body(name=f"b{i}", pos=[(0, 0.6, 0.5)[i], 0, 0])
        body.add_joint(name=f"j{i}", axis=[0, 0, 1])
        ends = [0, 0, 0, length, 0, 0]
        body.add_geom(name=f"g{i}", type=mujoco.mjtGeom.mjGEOM_CAPSULE, fromto=ends, size=[0.03, 0, 0])
    body.add_site(name="tip", pos=[0.4, 0, 0])
    spec.worldbody.add_geom(name="post", size=[0.05, 0, 0], pos=[0.62, 0.05, 0])
    model = spec.compile()
    goal, pairs = Position("tip", [0.8, 0.7, 0]), [(f"g{i}", "post") for i in range(3)]
    asked, said = (
        solve(model, goal, prefer=prefer, obstacles=pairs, compiled=False) for prefer in (None, "clear")
    )
    np.testing.assert_array_equal(asked.q, said.q)
    assert re.search("0[.]1 m (apart|away)", str(asked.verdict))
    inside = solve(model, Position("tip", [0.62, 0.05, 0]), obstacles=pairs)
    assert inside.solved and "g2 and post overlap" in str(inside.verdict)
    with pytest.raises(ModelError, match="'clear'"):
        solve(model, goal, prefer="near", obstacles=pairs)


def _gantry():
    kinds = [(ik_cases.SLIDE, e, (-1, 1)) for e in np.eye(3)] + [(ik_cases.HINGE, Z, (-2, 2))]
    return ik_cases.chain([*(([0, 0, 0], *kind) for kind in kinds), ([0.1, 0, 0], None, None, None)])


def test_residuals_have_the_units_of_their_joints():
    model = _gantry()
    slide, hinge = solve(model, [JointValue("j0", 1.4), JointValue("j3", 2.3)]).residuals
    assert (slide.position, slide.rotation) == (pytest.approx(0.4), 0.0)
    assert (hinge.position, hinge.rotation) == (0.0, pytest.approx(0.3))
    gap = goal_gap(Problem(model, [JointValue("j0", 1.4)], Space(model)), JointValue("j0", 1.4), model.qpos0)
    assert (gap.position, gap.rotation) == (pytest.approx(0.4), 0.0)
    assert solve(model, [JointValue("j0", 0.3), JointValue("j0", 0.5)]).verdict.bound == pytest.approx(0.2)
    verdict = solve(model, JointValue("j0", 1.4)).verdict
    assert (verdict.position, verdict.rotation) == (pytest.approx(0.4), 0.0)
    goals = [JointValue("j0", 0.0), JointValue("j1", 0.3), Spread(("j0", "j1"), weight=1.0)]
    spread = solve(model, goals).residuals[2]
    assert (spread.position, spread.rotation) == (pytest.approx(0.6), 0.0)  # shares are halves
    posture = solve(
        model, [Posture([0.5, 0, 0, 0.5]), JointValue("j0", 0.2), JointValue("j3", 0.1)]
    ).residuals[0]
    assert posture.position > 0 and posture.rotation > 0
    free = load_model("puppet")
    q = free.qpos0.copy()
    q[:3] += [0.3, 0, 0.4]
    q[3:7] = rotations.exp([0.2, 0, 0])
    joints = [free.joint(j).name for j in range(1, free.njnt)]
    off = solve(free, Posture(q), joints=joints).residuals[0]
    assert (off.position, off.rotation) == (pytest.approx(0.5), pytest.approx(0.2))


def test_coupled_slides_are_told_in_metres():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body><joint name="a" type="slide" axis="1 0 0"/><geom size=".1"/></body>
      <body><joint name="b" type="slide" axis="1 0 0"/><geom size=".1"/></body>
    </worldbody><equality><joint name="tie" joint1="a" joint2="b" polycoef="0 -1 0 0 0"/>
    </equality></mujoco>""")
    solution = solve(model, JointValue("a", 0.3))
    assert solution.solved and solution.q[1] == pytest.approx(-0.3)
    both = solve(model, [JointValue("a", 0.3), JointValue("b", 0.3)])
    assert both.verdict.kind == "conflict"
    assert solution.residuals[1].goal == "tie" and "rad" not in solution.verdict.reason


def test_every_row_has_its_own_tolerance():
    """A posture with room in one joint and none in another, a pose with room to turn and none to move."""
    model = ik_cases.planar_chain([1.0, 0.8, 0.6])
    place = [*ik_planar.forward((1.0, 0.8, 0.6), (0.3, 0.5, 0.4))[-1], 0]
    room = Posture([0.3, 0.5, 0.7], tolerance=(1e-6, 1e-6, 0.4))
    assert solve(model, [Position("tip", place), room]).solved
    assert not solve(
        model, [Position("tip", place), Posture([0.3, 0.5, 0.7], tolerance=(1e-6, 0.4, 1e-6))]
    ).solved
    with pytest.raises(ModelError, match="3 rows: one tolerance or 3"):
        solve(model, Posture([0.3, 0.5, 0.7], tolerance=(1e-6, 0.4)))
    turned = Pose("tip", [2.7, 0, 0], [1, 0, 0, 0], tolerance=(1e-6,) * 3 + (0.5,) * 3)
    verdict = solve(model, turned).verdict
    assert (verdict.kind, verdict.proved) == ("out of reach", True)
    assert verdict.bound == pytest.approx(0.3)  # less than the room to turn
    free = Pose("tip", [2.7, 0, 0], [1, 0, 0, 0], tolerance=(1e-6,) * 3 + (np.inf,) * 3)
    assert solve(model, free).verdict.bound == pytest.approx(0.3)
    loose = Orientation("tip", ik_cases.quat_z(0.3), tolerance=(0.2, 1e-6, 1e-6))
    tilted = rotations.multiply(np.array(ik_cases.quat_z(0.3)), rotations.exp([0.15, 0, 0]))
    assert solve(model, Orientation("tip", tilted, tolerance=(0.2, 1e-6, 1e-6))).solved
    assert not solve(model, Orientation("tip", tilted, tolerance=(1e-6, 0.2, 1e-6))).solved
    assert solve(model, loose).solved


def test_what_makes_no_goal_is_told_at_once():
    for wrong, words in (
        (lambda: Position(3, [0, 0, 0]), "named by text"),
        (lambda: Position("tip", "here"), "3 finite numbers"),
        (lambda: Position("tip", [0, 0, 0], weight="much"), "finite number"),
        (lambda: Position("tip", [0, 0, 0], weight=0), "positive"),
        (lambda: Position("tip", [0, 0, 0], tolerance="some"), "positive"),
        (lambda: Position("tip", [0, 0, 0], tolerance=(1e-6, np.nan, 1)), "positive"),
        (lambda: JointValue("j0", "up"), "finite number"),
        (lambda: Distance("tip", "at1", -1), "not negative"),
        (lambda: Spread(("j0",)), "two joints"),
        (lambda: Spread(("j0", "j1"), (1, -1)), "positive share"),
        (lambda: solve(_gantry(), Spread(("j0", "j3"))), "only slides"),
    ):
        with pytest.raises(ModelError, match=words):
            wrong()


def test_goals_whose_rows_depend_on_each_other_are_judged(monkeypatch):
    """Three slides: a line, a plane through it, and a distance that misses the line, or does not."""
    monkeypatch.setattr(Problem, "prepared", lambda self, **_: None)
    axes = [([0, 0, 0], ik_cases.SLIDE, e, (-3, 3)) for e in np.eye(3)]
    model = ik_cases.chain([*axes, ([0, 0, 0], None, None, None)])
    for seed in range(15):
        rng = np.random.default_rng(seed)
        p, u, center = rng.uniform(-0.5, 0.5, 3), ik_cases.unit(rng), rng.uniform(-0.5, 0.5, 3)
        far = np.linalg.norm(np.cross(center - p, u))
        line, plane = PointOnLine("tip", p, u), PointOnPlane("tip", p, np.cross(u, ik_cases.unit(rng)))
        for share, kind in ((0.5, "conflict"), (1.5, "solved")):
            goals = [line, Distance("tip", center, share * far), plane]
            assert solve(model, goals, restarts=20).verdict.kind == kind


def test_a_model_without_joints_and_the_world_itself_are_judged():
    model = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody><body name="b" pos="0 0 1"><geom size=".1"/></body></worldbody></mujoco>""")
    assert solve(model, Position("body:b", [0, 0, 1])).solved
    for goals in ([Position("body:b", [0, 0, 1.5])], [Position("body:world", [0.5, 0, 0])]):
        verdict = solve(model, goals).verdict
        assert (verdict.kind, verdict.proved) == ("out of reach", True)
        assert verdict.position == pytest.approx(0.5)


# Limits.


def test_only_goals_that_limits_exclude_are_named():
    model = ik_cases.planar_chain([0.5, 0.5, 0.5], [(-1, 1)] * 3)
    beyond, fine = JointValue("j0", 1.5, name="beyond"), JointValue("j1", 0.5, name="fine")
    assert solve(model, [beyond, fine]).verdict.goals == ("beyond",)
    assert solve(model, [fine, beyond]).verdict.goals == ("beyond",)
    both = solve(model, [beyond, fine, JointValue("j2", -1.7, name="too")]).verdict
    assert both.goals == ("beyond", "too") and set(both.joints) == {"j0", "j2"}
    two = ik_cases.planar_chain([1.0, 0.8], [(-3, 3), (0.1, 3)])  # together alone: the elbow bends one way
    down = max(ik_planar.two_links((1.0, 0.8), [1.2, 0.7]), key=lambda q: q[0])
    place, aside = Position("tip", [1.2, 0.7, 0], name="p"), Orientation("tip", ik_cases.quat_z(down.sum()))
    verdict = solve(two, [place, aside]).verdict
    assert verdict.kind == "held by limits" and len(verdict.goals) == 2


@pytest.mark.parametrize("seed", [95, 136, 0, 1, 2, 3])  # the first two have nearer corners than searches met
def test_how_far_within_limits_is_the_least_there_is(seed):
    """Against all poses that could be nearest."""
    case = ik_cases.limited_point(np.random.default_rng([seed, 77]))
    verdict = solve(case.model, case.goals).verdict
    assert (verdict.kind, verdict.proved) == ("held by limits", True)
    assert verdict.position == pytest.approx(case.distance, abs=1e-9)
    assert f"{verdict.position:.6g} m remain" in verdict.reason


def test_a_distance_is_told_as_exact_where_a_bound_from_below_agrees():
    arm = ik_cases.planar_chain([1.0, 0.8])
    reason = solve(arm, Position("tip", [2.3, 0, 0])).verdict.reason
    assert "0.5 m remain" in reason and "at most" not in reason
    arm = ik_cases.planar_chain([1.0, 0.8], [(-1, 1)] * 2)
    verdict = solve(arm, Position("tip", [0, -1, 0])).verdict  # proved not to be met, not how far
    assert verdict.proved and f"at most {verdict.position:.6g} m remain" in verdict.reason
    reason = solve(arm, JointValue("j0", 1.5)).verdict.reason
    assert "0.5 rad remain" in reason and "at most" not in reason
