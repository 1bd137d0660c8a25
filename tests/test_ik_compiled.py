"""Compiled goals: rows as the goals have them, descents and settling as in NumPy, nearest by brute force."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from oracles import ik_cases, ik_loops, ik_planar
from pantograph.models import ModelError, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import (
    CenterOfMass,
    Distance,
    JointValue,
    LookAt,
    Mirror,
    Orientation,
    PointOnLine,
    PointOnPlane,
    Pose,
    Position,
    Posture,
    solve,
)
from pantograph.sim.ik.animate import Pole, Spread
from pantograph.sim.ik.chains import machine as machines
from pantograph.sim.ik.chains.iteration import rows_tape
from pantograph.sim.ik.chains.layout import arguments, layout
from pantograph.sim.ik.numeric.descend import _descend
from pantograph.sim.ik.numeric.settle import settle, settle_near, worth
from pantograph.sim.ik.preferences import preference
from pantograph.sim.ik.problem import Problem, asked
from pantograph.sim.ik.space import Space
from strategies import random_states, seeds, trees


@pytest.fixture
def plain(monkeypatch):
    """Everything in NumPy."""
    monkeypatch.setattr(Problem, "prepared", lambda self, **_: None)


@pytest.fixture
def eager(monkeypatch):
    """Everything compiled at once."""
    monkeypatch.setattr(machines, "_expected", lambda problem: -1.0)


def machine_of(problem):
    return machines.compiled(problem, machines.structure(problem))


def _agree(problem, q):
    """The program's rows against those of the goals, in a batch and by MuJoCo's kinematics one by one."""
    at = layout(problem)
    tape, entries = rows_tape(problem, at)
    a = arguments(problem, at)
    r, values = tape.evaluate(q, a)
    J = np.zeros((len(q), problem.m, problem.model.nv))
    for k, (i, v) in enumerate(entries):
        J[:, i, v] = values[:, k]
    for rows, r_k, J_k in [
        (problem.raw(q), r, J),
        *((problem.raw(q[k : k + 1]), r[k : k + 1], J[k : k + 1]) for k in range(len(q))),
    ]:
        scale = 1 + np.abs(rows.J).max(initial=0.0)
        np.testing.assert_allclose(r_k, rows.r, atol=1e-9 * scale)
        np.testing.assert_allclose(J_k, rows.J, atol=1e-9 * scale)


@settings(max_examples=25, deadline=None)
@given(trees(), seeds)
def test_programs_of_goals_compute_their_rows(model, seed):
    rng = np.random.default_rng(seed)
    q = random_states(model, seed, 3)[0]
    a, b = (f"s{k}" for k in rng.integers(0, model.nsite, 2))
    x, y, quat = rng.normal(size=3), rng.normal(size=3), rng.normal(size=4)
    goals = [
        Position(a, x), Position(a, x, relative_to=b), Orientation(a, quat),
        Pose(a, x, quat, relative_to="s0"), Orientation(b, quat, relative_to=a),
        LookAt(a, 5 * x, axis=y), PointOnLine(a, x, y), PointOnPlane(a, x, y), Distance(a, 3 * x, 1.0),
        PointOnLine(a, x, y, b), PointOnPlane(b, x, y, a),
        Distance(a, b, 0.5), Posture(q[1]), Mirror(a, "s0", y, x, relative_to=b), Pole(a, "s0", b, x),
        LookAt(a, 5 * x, axis=y, relative_to=b), Mirror(a, b, y, x, what="pose", flip=y[::-1]),
        Mirror(b, a, y, relative_to="s0", what="orientation"),
    ]  # fmt: skip
    names = [model.joint(j).name for j in range(model.njnt)]
    by_kind = {k: [names[j] for j in np.flatnonzero(model.jnt_type == k)] for k in (1, 2, 3)}
    goals += [JointValue(name, 0.3) for name in by_kind[2] + by_kind[3]]
    goals += [Spread(tuple(group), tuple(rng.uniform(1, 2, len(group)))) for group in by_kind.values()
              if len(group) > 1]  # fmt: skip
    some = [name for name in names if rng.random() < 0.7]
    for goal in goals:
        for joints in (None, some):
            _agree(Problem(model, [goal], Space(model), joints=joints), q)
    try:
        _agree(Problem(model, [CenterOfMass(x)], Space(model)), q)
    except ModelError as error:
        assert "mass" in str(error)


def test_programs_of_closed_loops_compute_their_rows():
    rng = np.random.default_rng(0)
    bar, (plate, _) = ik_loops.four_bar(), ik_loops.stewart()
    for model, goal in ((bar, JointValue("crank", 0.5)), (plate, Position("plate", [0, 0, 1.1]))):
        problem = Problem(model, [goal], Space(model))
        assert problem.loops
        _agree(problem, problem.space.step(np.tile(model.qpos0, (4, 1)), rng.normal(size=(4, model.nv))))
    welded = mujoco.MjModel.from_xml_string("""
    <mujoco><worldbody>
      <body name="a"><joint name="u" type="ball"/><geom size=".01" mass="1"/><site name="tip" pos="1 0 0"/>
      </body>
      <body name="b" pos="1 .2 0"><joint name="h" axis="1 2 3"/><joint name="s" type="slide"/>
        <geom size=".01" mass="1"/>
        <body name="c" pos=".3 0 0"><joint name="k" ref=".2"/><geom size=".01" mass="1"/></body></body>
    </worldbody><equality><weld body1="a" body2="c"/>
      <joint joint1="k" joint2="h" polycoef=".1 2 -.5 .3 .2"/><joint joint1="s" polycoef=".3 0 0 0 0"/>
    </equality></mujoco>""")  # fmt: skip
    problem = Problem(welded, [Position("tip", [1, 0, 0])], Space(welded))
    assert len(problem.loops) == 3
    _agree(problem, random_states(welded, 5, 4)[0])


def _puppet_problem(rng, **kw):
    model = load_model("puppet")
    space = Space(model)
    q = space.step(model.qpos0[None], 0.4 * rng.normal(size=(1, model.nv)))
    aim = Problem(model, [Position(s, [0, 0, 0]) for s in ("left_hand", "right_foot")], space).raw(q).r[0]
    goals = [Position("left_hand", aim[:3], tolerance=(1e-6, np.inf, 0.01)), Position("right_foot", aim[3:]),
             CenterOfMass([0, 0, 0.8], **kw)]  # fmt: skip
    return Problem(model, goals, space)


def _limited_tree(rng):
    """Hinges and balls with limits narrow enough to hold."""
    ball, hinge = ik_cases.BALL, ik_cases.HINGE
    links = [([0.1, 0, 0.1], ball, (0, 0, 1), (0, 0.7)), ([0.4, 0, 0], hinge, (0, 1, 0), (-0.5, 0.6)),
             ([0.3, 0, 0], ball, (0, 0, 1), (0, 0.4)), ([0.2, 0, 0], None, None, None)]  # fmt: skip
    model = ik_cases.chain(links)
    space = Space(model)
    q = space.random(rng, 1, space.check(model.qpos0), np.ones(model.nv, dtype=bool))[0]
    p, quat = ik_cases.pose_of(model, q, "tip")
    mujoco.mju_rotVecQuat(ahead := np.empty(3), [0.0, 0.0, 2.0], quat)
    return Problem(model, [Position("tip", p), LookAt("tip", p + ahead)], space)


@pytest.mark.parametrize("make", [_puppet_problem, _limited_tree], ids=["puppet", "limits"])
def test_descents_are_those_of_numpy(make, plain):
    for seed in range(3):
        rng = np.random.default_rng(seed)
        problem = make(rng)
        machine = machine_of(problem)
        q = problem.space.random(rng, 11, problem.space.check(problem.model.qpos0), problem.moved)
        for k in (0, 1, 6):
            ends = machine.descend(q, machine.arguments(problem), iterations=k, first=False)
            truth = _descend(problem, q.copy(), k, False)
            np.testing.assert_allclose(ends.cost, truth.cost, rtol=1e-6, atol=1e-12)
            np.testing.assert_allclose(ends.q, truth.q, atol=1e-6)
            judged = np.abs(truth.r) / problem.tolerance * problem.judged
            np.testing.assert_allclose(ends.worst, judged.max(axis=1), rtol=1e-5, atol=1e-3)
        for x in ends.q:
            assert ik_cases.illegal(problem.model, x) == []


def test_the_first_to_meet_its_goals_ends_a_search_in_any_lane(plain):
    """Among more starts than lanes, as in NumPy's lockstep."""
    rng = np.random.default_rng(4)
    problem = _puppet_problem(rng)
    machine = machine_of(problem)
    q = problem.space.random(rng, 20, problem.space.check(problem.model.qpos0), problem.moved)
    truth = _descend(problem, q.copy(), 100, True)
    ends = machine.descend(q, machine.arguments(problem), iterations=100, first=True)
    met = ends.worst <= 1
    met &= ends.iterations <= ends.iterations[met].min()
    np.testing.assert_array_equal(met, truth.met)
    np.testing.assert_allclose(ends.q[met], truth.q[met], atol=1e-6)
    assert ends.iterations[met].max() == truth.iterations


def test_settling_finds_the_nearest_of_all():
    """A 4R arm at a point, two freedoms left, by brute force over two joints; with limits that hold, too."""
    lengths, start = (1.0, 0.8, 0.6, 0.5), np.array([1.5, -1.2, 0.9, 0.4])
    target = np.array([1.3, 0.7])
    for ranges in (None, [(-2, 0.3), (-1.0, 2), (-2, 2), (-2, 2)]):
        model = ik_cases.planar_chain(lengths, ranges)
        problem = Problem(model, [Position("tip", [*target, 0])], Space(model))
        q0 = problem.space.check(start)
        low, high = (-np.inf, np.inf) if ranges is None else np.array(ranges).T
        best = np.inf
        one, two = np.meshgrid(*(np.linspace(-np.pi, np.pi, 241),) * 2)
        for a, b in zip(one.ravel(), two.ravel(), strict=True):
            rest = target - ik_planar.forward(lengths[:2], [a, b])[-1]
            c, s = np.cos(a + b), np.sin(a + b)
            turned = np.array([[c, s], [-s, c]]) @ rest
            if 0.1 < np.hypot(*turned) < 1.1:
                for pair in ik_planar.two_links(lengths[2:], turned):
                    q = np.array([a, b, *pair])
                    if (q >= low).all() and (q <= high).all():
                        best = min(best, np.sum((q - q0) ** 2))
        machine = machine_of(problem)
        wish = preference("near", problem, q0)
        firsts = machine.descend(
            problem.space.random(np.random.default_rng(0), 24, q0, problem.moved),
            machine.arguments(problem), iterations=100, first=False,
        )  # fmt: skip
        far = machine.settle(firsts.q[firsts.worst <= 1], machine.arguments(problem, q0=q0))
        done = (far.step < 1e-9) & (far.worst < 1e-2)
        assert done.mean() > 0.8
        assert far.value[done].min() == pytest.approx(best, abs=0.02)  # the grid is 0.026 wide
        assert far.value[done].min() <= best + 1e-9
        near = far.q[done][np.argmin(far.value[done])]
        assert settle(problem, near, wish).value == pytest.approx(far.value[done].min(), abs=1e-12)


@pytest.mark.parametrize("seed", range(2))
def test_settling_among_wishes_and_ball_limits_is_that_of_numpy(seed):
    rng = np.random.default_rng(seed)
    problem = _limited_tree(rng)
    problem = problem.only(problem.goals[1:])
    q0 = problem.space.check(problem.model.qpos0)
    wish = preference("near", problem, q0)
    machine = machine_of(problem)
    ends = machine.descend(
        problem.space.random(rng, 16, q0, problem.moved),
        machine.arguments(problem),
        iterations=100,
        first=False,
    )
    met = ends.q[ends.worst <= 1]
    assert len(met)
    assert problem.prepared() is not None
    for quick, slow in zip(settle_near(problem, met, q0, wish, faint=1.0), met, strict=True):
        assert ik_cases.illegal(problem.model, quick.q) == []
        assert np.abs(problem.raw(quick.q[None]).r).max() < 1e-6
        assert quick.value <= settle(problem, slow, wish).value * (1 + 1e-6) + 1e-9


def _ends(problem, rng, q0):
    """Configurations that meet the goals, from all over."""
    machine = machine_of(problem)
    starts = problem.space.random(rng, 24, q0, problem.moved)
    ends = machine.descend(starts, machine.arguments(problem), iterations=100, first=False)
    return machine, ends.q[ends.worst <= 1]


def test_settling_comes_to_rest_far_from_the_start(plain):
    """There the goals' curvature counts, and Gauss-Newton's whole steps would go on for ever."""
    rng, model = np.random.default_rng(0), load_model("puppet")
    space, data = Space(model), mujoco.MjData(model)
    data.qpos[:] = space.step(model.qpos0[None], 0.3 * rng.normal(size=(1, model.nv)))[0]
    mujoco.mj_forward(model, data)
    limbs = [f"{side}_{limb}" for side in ("left", "right") for limb in ("hand", "foot")]
    goals = [Position(limb, data.site(limb).xpos.copy()) for limb in limbs]
    exact = Problem(model, [*goals, CenterOfMass(data.subtree_com[0].copy())], space)
    for problem in (exact, _puppet_problem(np.random.default_rng(0))):  # the latter with room
        q0 = space.check(model.qpos0)
        machine, met = _ends(problem, rng, q0)
        assert len(met) > 5
        far = machine.settle(met, machine.arguments(problem, q0=q0))
        assert ((far.step < 1e-9) & (far.worst <= 1)).mean() > 0.9
        value = np.sum(preference("near", problem, q0)(met).r ** 2, axis=1)
        np.testing.assert_allclose(worth(problem, met, q0, 1.0), value, rtol=1e-9)
        np.testing.assert_allclose(worth(problem, met, q0, 1e-4), 1e-8 * value, rtol=1e-9)


def test_settling_comes_to_rest_at_the_limits_of_balls(plain):
    rng, held = np.random.default_rng(0), 0
    for _ in range(6):
        problem = _limited_tree(rng)
        problem = problem.only(problem.goals[:1])
        space = problem.space
        q0 = space.random(rng, 1, problem.model.qpos0, problem.moved)[0]
        machine, met = _ends(problem, rng, q0)
        far = machine.settle(met, machine.arguments(problem, q0=q0))
        rest = (far.step < 1e-9) & (far.worst <= 1)
        assert rest.mean() > 0.9
        angles = np.linalg.norm(rotations.log(far.q[rest][:, space.quats]), axis=-1)
        assert (angles <= space.cones + 1e-12).all()
        held += int((angles > space.cones - 1e-9).sum())
        slow = settle(problem, met[0], preference("near", problem, q0))
        if rest[0]:
            assert far.value[0] <= slow.value * (1 + 1e-6) + 1e-9
    assert held > 20


def _questions():
    rng = np.random.default_rng(1)
    for _ in range(2):
        case = ik_cases.reachable_several(rng)
        yield case.model, case.goals
    model = load_model("quadruped")
    data = mujoco.MjData(model)
    data.qpos[:] = Space(model).step(model.qpos0[None], 0.1 * rng.normal(size=(1, model.nv)))[0]
    mujoco.mj_forward(model, data)
    feet = [Position(f"{end}_{side}_foot", data.site(f"{end}_{side}_foot").xpos.copy())
            for end in ("front", "back") for side in ("left", "right")]  # fmt: skip
    quat = [np.cos(0.1), 0, np.sin(0.1), 0]
    yield model, [*feet, Orientation("imu", quat, weight=1.0), Posture(model.qpos0, weight=0.01)]
    yield model, [*feet, Position("imu", [5, 0, 0])]


def test_answers_are_the_same_with_and_without_machine_code(monkeypatch):
    monkeypatch.setattr(machines, "_expected", lambda problem: -1.0)
    for model, goals in _questions():
        with monkeypatch.context() as without:
            without.setattr(Problem, "prepared", lambda self, **_: None)
            slow = solve(model, goals, restarts=40)
        quick = solve(model, goals, restarts=40)
        assert (quick.verdict.kind, quick.verdict.proved) == (slow.verdict.kind, slow.verdict.proved)
        assert quick.verdict.position == pytest.approx(slow.verdict.position, abs=1e-6)
        if quick.solved:
            np.testing.assert_allclose(quick.q, slow.q, atol=1e-5)


def test_a_structure_is_compiled_when_numpy_has_cost_as_much(monkeypatch):
    model = ik_cases.planar_chain(
        [1.0, 0.8, 0.3 + 1e-3 * np.random.default_rng().random()]
    )  # never seen before
    goal = Position("tip", [1.2, 0.7, 0])
    problem = Problem(model, [goal], Space(model))
    assert problem.prepared() is None
    name = machines.structure(problem)
    assert machines._CASES[name].spent == 0
    solve(model, goal)
    assert 0 < machines._CASES[name].spent < 0.2
    assert Problem(model, [goal], Space(model)).prepared(build=True) is None
    machines.charge(name, 10.0)
    assert Problem(model, [goal], Space(model)).prepared() is None  # rows alone do not wait for it
    assert Problem(model, [goal], Space(model)).prepared(build=True) is not None
    other = Problem(model, [Position("tip", [0.3, 0.2, 0.1])], Space(model, limits=False))
    assert other.prepared() is not None  # another target and no limits: the same code
    apart = Problem(model, [Position("tip", [0.3, 0.2, 0.1], tolerance=(1e-6, 1e-6, np.inf))], Space(model))
    assert apart.prepared() is None


def test_goals_of_ones_own_are_left_to_numpy():
    class Higher(Position):
        def rows(self, c):
            r, J = super().rows(c)
            return type(super().rows(c))(r - [0, 0.1, 0], J)

    model, goal = ik_cases.planar_chain([1.0, 0.8]), Higher("tip", [1.2, 0.5, 0])
    assert machines.structure(Problem(model, [goal], Space(model))) is None
    solution = solve(model, goal)
    assert solution.solved
    np.testing.assert_allclose(ik_cases.pose_of(model, solution.q, "tip")[0], [1.2, 0.6, 0], atol=1e-6)


def test_a_changed_model_or_question_is_not_taken_for_an_earlier_one(eager):
    """Limits, lengths, tolerances, weights and names changed in place after a first answer."""
    model = ik_cases.planar_chain([1.0, 0.8, 0.6], [(-2.5, 2.5)] * 3)
    goal = Position("tip", [1.2, 0.7, 0])
    first = solve(model, goal).q
    model.jnt_range[1] = (-2.5, -0.1) if first[1] > 0 else (0.1, 2.5)
    second = solve(model, goal)
    assert second.solved and ik_cases.illegal(model, second.q) == []
    model.body_pos[2, 0] = 0.5
    third = solve(model, goal)
    np.testing.assert_allclose(ik_cases.pose_of(model, third.q, "tip")[0], [1.2, 0.7, 0], atol=1e-6)
    far = Position("tip", [3.0, 0, 0])
    assert not solve(model, far).solved
    assert solve(model, Position("tip", [3.0, 0, 0], tolerance=(2.0, 1e-6, 1e-6))).solved
    assert solve(model, Position("at2", [0.9, 0.2, 0])).solved
    turned = [solve(model, [goal, JointValue("j0", x, weight=1.0)]).q[0] for x in (1.05, 1.2)]
    np.testing.assert_allclose(turned, [1.05, 1.2], atol=1e-4)
    one = [Position("tip", [1.0, 0.5, 0]), Position("at2", [0.9, 0.2, 0], weight=1.0)]
    other = [Position("at2", [0.9, 0.2, 0]), Position("tip", [1.0, 0.5, 0], weight=1.0)]
    for goals in (one, other, one[::-1]):
        solution = solve(model, goals)
        assert next(r.met for r, g in zip(solution.residuals, goals, strict=True) if g.weight is None)
        place = ik_cases.pose_of(model, solution.q, goals[0].at)[0]
        truth = np.linalg.norm(place - goals[0].target)
        assert solution.residuals[0].position == pytest.approx(truth, abs=1e-9)
        place = ik_cases.pose_of(model, solution.q, goals[1].at)[0]
        truth = np.linalg.norm(place - goals[1].target)
        assert solution.residuals[1].position == pytest.approx(truth, abs=1e-9)


def test_a_posture_of_another_length_is_refused_after_a_right_one(eager):
    model = ik_cases.planar_chain([1.0, 0.8, 0.6])
    goal = Position("tip", [1.2, 0.7, 0])
    for _ in range(2):
        assert solve(model, [goal, Posture([0.1, 0.2, 0.3], weight=0.1)]).solved
    with pytest.raises((ModelError, ValueError)):
        solve(model, [goal, Posture([0.1, 0.2], weight=0.1)])


def test_questions_of_one_kind_do_not_disturb_each_other():
    model = load_model("puppet")
    problem, _ = asked(model, [Position("left_hand", [0.4, 0.3, 1.0])], None)
    other, _ = asked(model, [Position("left_hand", [0.5, 0.1, 1.2])], None)
    q = problem.space.check(model.qpos0)[None]
    hand = ik_cases.pose_of(model, q[0], "left_hand")[0]
    np.testing.assert_allclose(problem.raw(q).r[0], hand - [0.4, 0.3, 1.0], atol=1e-12)
    np.testing.assert_allclose(other.raw(q).r[0], hand - [0.5, 0.1, 1.2], atol=1e-12)
    assert problem.kinematics is not other.kinematics
