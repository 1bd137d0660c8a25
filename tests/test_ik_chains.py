"""Compiled inverse kinematics of chains: right, within limits, repeatable, and the step against NumPy."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import ik_cases, ik_planar, ik_ur
from pantograph.models import ModelError, data_robots, load_model
from pantograph.sim import rotations
from pantograph.sim.ik import ChainSolver, Pose, Position, solve
from pantograph.sim.ik.chains.axes import Axis, linear_trig, three_turns, trig_roots
from pantograph.sim.ik.chains.closed_form import closed_form
from pantograph.sim.ik.chains.solver import moving_part
from pantograph.sim.ik.chains.step import Chain, step_tape
from pantograph.sim.ik.numeric.descend import _steps, descend, held_projection
from pantograph.sim.ik.problem import Problem
from pantograph.sim.ik.space import Space
from pantograph.sim.kinematics import frame
from strategies import seeds


def _targets(model, site, k, seed=0):
    low, high = model.jnt_range.T
    q = np.random.default_rng(seed).uniform(low, high, (k, model.nq))
    X = frame(model, "site", site).pose(q)
    return X[:, :3, :3], X[:, :3, 3]


def _errors(model, site, q, R, p):
    X = frame(model, "site", site).pose(q)
    turn = np.arccos(np.clip(0.5 * (np.einsum("kij,kij->k", X[:, :3, :3], R) - 1), -1, 1))
    return np.linalg.norm(X[:, :3, 3] - p, axis=1), turn


def test_every_pose_of_an_arm_is_found_within_limits():
    model = load_model("arm6")
    arm = ChainSolver(model, "tip")
    R, p = _targets(model, "tip", 500)
    raced = arm(R, p)
    assert raced.met.all()
    position, rotation = _errors(model, "tip", raced.q, R, p)
    assert position.max() < 1e-6 * 3**0.5
    assert rotation.max() < 1e-5  # arccos loses digits near one
    low, high = model.jnt_range.T
    assert (raced.q >= low).all() and (raced.q <= high).all()


def test_points_and_orientations_alone():
    model = load_model("arm6")
    R, p = _targets(model, "tip", 50)
    raced = ChainSolver(model, "tip", rotation=False)(R, p)
    assert raced.met.all()
    assert _errors(model, "tip", raced.q, R, p)[0].max() < 1e-5
    raced = ChainSolver(model, "tip", position=False)(R, p)
    assert raced.met.all()
    assert _errors(model, "tip", raced.q, R, p)[1].max() < 1e-5


@settings(max_examples=8, deadline=None)
@given(seeds, st.integers(1, 7))
def test_random_chains_with_slides(seed, n):
    rng = np.random.default_rng(seed)
    kinds = [ik_cases.SLIDE if rng.random() < 0.25 else ik_cases.HINGE for _ in range(n)]
    links = [
        (0.3 * rng.normal(size=3), kind, ik_cases.unit(rng), np.sort(rng.uniform(-2.5, 2.5, 2)))
        for kind in kinds
    ]
    model = ik_cases.chain([*links, (0.2 * rng.normal(size=3), None, None, None)])
    R, p = _targets(model, "tip", 20, seed)
    raced = ChainSolver(model, "tip")(R, p)
    low, high = model.jnt_range.T
    assert np.isfinite(raced.q).all()
    assert (raced.q >= low).all() and (raced.q <= high).all()
    assert raced.met.mean() > 0.9
    assert max(_errors(model, "tip", raced.q[raced.met], R[raced.met], p[raced.met])[0], default=0) < 1e-5


@pytest.mark.parametrize("far", [1e1, 1e6, 1e150])
def test_unreachable_and_absurd_targets_end_without_harm(far):
    model = load_model("arm6")
    arm = ChainSolver(model, "tip")
    raced = arm(np.eye(3), [far, 0, 0], most=200)
    assert not raced.met[0]
    assert raced.iterations[0] == 200
    assert ik_cases.illegal(model, raced.q[0]) == []


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_targets_that_are_no_numbers_are_refused_and_never_met(bad):
    model = load_model("arm6")
    arm = ChainSolver(model, "tip")
    for k in range(3):
        p, R = np.array([0.3, 0.1, 0.4]), np.eye(3)
        p[k], R[k, 2 - k] = bad, bad
        with pytest.raises(ModelError, match="p must be finite"):
            arm(np.eye(3), p)
        with pytest.raises(ModelError, match="R must be a rotation"):
            arm(R, [0.3, 0.1, 0.4])
        for target in ((np.eye(3), p), (R, np.array([0.3, 0.1, 0.4]))):  # past the check
            assert not arm.racer(arm.middle, *target, tolerance=(1e-6, 1e-6), most=100).met.any()
    with pytest.raises(ModelError, match="seed must be finite"):
        arm(np.eye(3), [0.3, 0.1, 0.4], seed=np.full(6, bad))


def test_only_rotations_of_the_right_shape_are_targets():
    model = load_model("arm6")
    arm = ChainSolver(model, "tip")
    R, p = _targets(model, "tip", 4)
    wrong = [2 * np.eye(3), -np.eye(3), np.zeros((3, 3)), np.diag([1, 1, -1]), np.eye(3)[[1, 0, 2]],
             np.eye(3) + 1e-3 * np.ones((3, 3)), [[1, 0, 0], [0, 1, 0], [0, 1, 0]]]  # fmt: skip
    for each in wrong:
        many = R.copy()
        many[2] = each
        for target, place in ((each, p[0]), (many, p)):
            with pytest.raises(ModelError, match="R must be a rotation"):
                arm(target, place)
    assert ChainSolver(model, "tip", rotation=False)(np.zeros((3, 3)), p[0]).met.all()  # R is not asked
    assert arm(np.round(R, 7), p).met.all()  # as printed
    for words, args in (("R", (np.eye(4), p[0])), ("p", (R, p[:, :2])), ("seed", (R, p, np.zeros(5)))):
        with pytest.raises(ModelError, match=f"{words} must have the shape"):
            arm(*args[:2], seed=args[2] if len(args) > 2 else None)


def test_one_call_and_a_batch_agree_and_repeat():
    model = load_model("arm6")
    arm = ChainSolver(model, "tip")
    R, p = _targets(model, "tip", 20)
    batch = arm(R, p)
    for i in range(20):
        np.testing.assert_array_equal(arm(R[i], p[i]).q[0], batch.q[i])


def test_joints_without_limits_stay_within_half_a_turn_of_the_seed():
    rng = np.random.default_rng(0)
    links = [(0.3 * rng.normal(size=3), ik_cases.HINGE, ik_cases.unit(rng), None) for _ in range(6)]
    model = ik_cases.chain([*links, ([0.1, 0.2, 0.1], None, None, None)])
    X = frame(model, "site", "tip").pose(rng.uniform(-np.pi, np.pi, (50, 6)))
    raced = ChainSolver(model, "tip")(X[:, :3, :3], X[:, :3, 3])
    assert raced.met.all()
    assert np.abs(raced.q).max() <= np.pi
    position, _ = _errors(model, "tip", raced.q, X[:, :3, :3], X[:, :3, 3])
    assert position.max() < 3e-6


def test_the_seed_is_tried_first():
    model = load_model("arm6")
    arm = ChainSolver(model, "tip")
    q = np.array([0.4, 0.3, -0.7, 0.5, 0.8, -0.3])
    X = frame(model, "site", "tip").pose(q)
    raced = arm(X[:3, :3], X[:3, 3], seed=q + 1e-3)
    np.testing.assert_allclose(raced.q[0], q, atol=1e-5)


def test_a_step_is_the_damped_least_squares_step():
    """Against NumPy's solution of the same normal equations, for a short and for a redundant chain."""
    for lengths in ((0.5, 0.4, 0.3, 0.2), (0.5,) * 7):
        rng = np.random.default_rng(len(lengths))
        links = [([0, 0, x], ik_cases.HINGE, ik_cases.unit(rng), (-3, 3)) for x in lengths]
        model = ik_cases.chain([*links, ([0.1, 0.2, 0.3], None, None, None)])
        f = frame(model, "site", "tip")
        scale = 0.7
        tape = step_tape(Chain(f, model.jnt_range, True, True, scale))
        q, target = rng.uniform(-1, 1, (2, model.nq))
        q_near = q + 0.1 * (target - q)
        X_T = f.pose(q_near)
        t = np.concatenate([X_T[:3, :3].ravel(), X_T[:3, 3], [1e-5, 1e-5]])
        out, error = tape.evaluate(q, t)
        X, J = f.pose(q), f.jacobian(q)
        from scipy.spatial.transform import Rotation

        turn = Rotation.from_matrix(X[:3, :3] @ X_T[:3, :3].T).as_rotvec()
        angle = np.linalg.norm(turn)
        e = np.concatenate([(X[:3, 3] - X_T[:3, 3]) / scale, turn / angle * 2 * np.sin(angle / 2)])
        A = np.vstack([J[3:] / scale, J[:3]])
        damping = 0.03 * e @ e + 1e-11
        d = -np.linalg.solve(A.T @ A + damping * np.eye(model.nv), A.T @ e)
        d *= min(1.0, 0.8 / np.abs(d).max())
        np.testing.assert_allclose(out - q, d, rtol=1e-6, atol=1e-9)
        assert error[0] == pytest.approx(
            np.abs(np.concatenate([e[:3] * scale, e[3:]])).max() / 1e-5, rel=1e-9
        )


def test_joints_that_stand_are_folded_into_the_chain():
    model = load_model("puppet")
    f = frame(model, "site", "left_hand")
    moved = np.zeros(model.nv, dtype=bool)
    arm = [model.joint(n).dofadr[0] for n in ("left_shoulder_pitch", "left_shoulder_roll", "left_elbow")]
    moved[arm] = True
    rng = np.random.default_rng(0)
    start = model.qpos0.copy()
    start[:3] = rng.normal(size=3)
    start[3:7] = ik_cases.unit(rng)[0], 0.5, 0.2, 0.1
    part = moving_part(f, moved, start)
    q = start.copy()
    q[[model.joint(n).qposadr[0] for n in ("left_shoulder_pitch", "left_shoulder_roll", "left_elbow")]] += 0.3
    np.testing.assert_allclose(part.pose(q), f.pose(q), atol=1e-12)
    assert len(part.joints) == 3


def test_chains_of_other_joints_are_refused():
    with pytest.raises(ModelError, match="hinges and slides"):
        ChainSolver(load_model("puppet"), "left_hand")


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_trigonometric_roots_are_roots_and_all(seed):
    rng = np.random.default_rng(seed)
    c = rng.normal(size=5) * (rng.random(5) < 0.8)

    def f(x):
        return c[0] + c[1] * np.cos(x) + c[2] * np.sin(x) + c[3] * np.cos(2 * x) + c[4] * np.sin(2 * x)

    roots = trig_roots(f(2 * np.pi * np.arange(5) / 5))
    size = np.abs(c).max() + 1e-9
    grid = np.linspace(-np.pi, np.pi, 20_001)
    crossings = np.flatnonzero(np.diff(np.sign(f(grid))) != 0)
    if roots.complete:
        assert all(abs(f(x)) < 1e-7 * size for x in roots.angles)
        for i in crossings:
            turns = np.angle(np.exp(1j * (np.array(roots.angles) - grid[i])))
            assert np.abs(turns).min() < 1e-3


@settings(max_examples=60, deadline=None)
@given(seeds)
def test_three_turns_compose_to_the_rotation(seed):
    from scipy.spatial.transform import Rotation

    rng = np.random.default_rng(seed)
    axes = [Axis(np.zeros(3), ik_cases.unit(rng)) for _ in range(3)]
    angles = rng.uniform(-np.pi, np.pi, 3)

    def product(angles):
        out = Rotation.identity()
        for axis, angle in zip(axes, angles, strict=True):
            out = out * Rotation.from_rotvec(angle * axis.u)
        return out.as_matrix()

    found = three_turns(axes, product(angles))
    assert found.angles
    for each in found.angles:
        np.testing.assert_allclose(product(each), product(angles), atol=1e-6)


def test_linear_trigonometric_equation():
    roots = linear_trig(3.0, 4.0, 2.0)
    assert roots.complete and len(roots.angles) == 2
    for x in roots.angles:
        assert 3 * np.cos(x) + 4 * np.sin(x) == pytest.approx(2.0)
    assert linear_trig(3.0, 4.0, 5.1) == ([], True)


@pytest.mark.skipif("wx250s" not in data_robots(), reason="the data folder with wx250s is absent")
def test_a_real_arm_from_its_own_file():
    model = load_model("wx250s")
    arm = ChainSolver(model, "body:wx250s/gripper_link")
    rng = np.random.default_rng(0)
    q = np.tile(model.qpos0, (200, 1))
    q[:, arm.columns] = rng.uniform(*arm.chain.limits.T, (200, 6))
    X = frame(model, "body", "wx250s/gripper_link").pose(q)
    raced = arm(X[:, :3, :3], X[:, :3, 3])
    assert raced.met.all()
    q[:, arm.columns] = raced.q
    np.testing.assert_allclose(frame(model, "body", "wx250s/gripper_link").pose(q), X, atol=3e-6)


@pytest.mark.parametrize("outward", [True, False])
def test_a_joint_at_its_limit_is_left_out_of_the_step_only_when_it_is_pushed_outward(outward):
    """Both solvers, against damped least squares with and without the joint's column."""
    model = load_model("arm6")
    f, scale = frame(model, "site", "tip"), 0.5
    q = np.array([0.2, 0.3, -0.4, 0.5, 0.6, -0.3])
    X, J = f.pose(q), f.jacobian(q)
    p_T = X[:3, 3] + [0.05, -0.04, 0.03]
    e = np.concatenate([(X[:3, 3] - p_T) / scale, np.zeros(3)])
    A = np.vstack([J[3:] / scale, J[:3]])
    g = A.T @ e
    j = int(np.argmax(np.abs(g)))
    model.jnt_range[j, int(g[j] < 0) if outward else int(g[j] > 0)] = q[j]
    damping = 0.03 * e @ e + 1e-11
    B = A * (np.arange(6) != j) if outward else A
    d = -B.T @ np.linalg.solve(B @ B.T + damping * np.eye(6), e)
    d *= min(1.0, 0.8 / np.abs(d).max())
    limits = model.jnt_range
    out, _ = step_tape(Chain(f, limits, True, True, scale)).evaluate(
        q, np.concatenate([X[:3, :3].ravel(), p_T, [1, 1]])
    )
    np.testing.assert_allclose(out, np.clip(q + d, *limits.T), atol=1e-9)
    assert (d[j] == 0) == outward
    problem = Problem(model, [Position("tip", p_T)], Space(model))
    w = problem.weighted(problem.raw(q[None]))
    mask = held_projection(problem, q[None], (w.r[:, None] @ w.J)[:, 0], w.J)[1][0]
    assert mask[j] == (not outward)
    direct = _steps(problem, q[None], w, np.array([1e-9]))[0]
    assert (direct[j] == 0) == outward


def _same_angles(a, b, atol):
    """Whether rows of a and of b are the same up to order and whole turns."""
    apart = np.abs(ik_planar.wrap(a[:, None] - b[None])).max(axis=2)
    return len(a) == len(b) and (apart.min(axis=0) < atol).all() and (apart.min(axis=1) < atol).all()


def _ur5():
    import sys
    from pathlib import Path

    sys.path.insert(0, str(Path(__file__).parent / "bench"))
    from arms import ur5

    return ur5()


def test_all_solutions_of_a_ur_arm_are_those_of_its_dh_formulas():
    model, rng, counts = _ur5(), np.random.default_rng(0), []
    for _ in range(150):
        X = frame(model, "site", "tip").pose(rng.uniform(-np.pi, np.pi, 6))
        quat = rotations.from_matrix(X[:3, :3])
        problem = Problem(model, [Pose("tip", X[:3, 3], quat)], Space(model))
        found = closed_form(problem, model.qpos0)
        assert found.structure == "three parallel axes"
        assert found.complete
        truth = ik_ur.angles(X)
        assert _same_angles(found.q, truth, 1e-6)
        assert np.abs(problem.raw(found.q).r).max() < 1e-10
        counts.append(len(truth))
    assert max(counts) == 8
    assert min(counts) < 8
    solution = solve(model, Pose("tip", X[:3, 3], quat), all=True)
    assert _same_angles(solution.solutions, truth, 1e-6)
    quat = rotations.from_matrix(np.eye(3))
    assert len(closed_form(Problem(model, [Pose("tip", [2, 0, 0], quat)], Space(model)), model.qpos0).q) == 0


@pytest.mark.parametrize("backwards", [False, True])
def test_any_arm_with_three_parallel_axes_and_two_that_meet(backwards):
    """Skew first axis, offsets everywhere; what a search from many starts finds is in the closed form."""
    rng = np.random.default_rng(int(backwards))
    for _ in range(4):
        u, five = ik_cases.unit(rng), ik_cases.unit(rng)
        axes = [ik_cases.unit(rng), u, u, -u, five, ik_cases.unit(rng)]
        offsets = [np.zeros(3), *(0.3 * rng.normal(size=(4, 3))), np.zeros(3)]
        if backwards:
            axes, offsets = axes[::-1], [np.zeros(3), np.zeros(3), *offsets[1:5]]
        links = [(o, ik_cases.HINGE, a, (-np.pi, np.pi)) for o, a in zip(offsets, axes, strict=True)]
        model = ik_cases.chain([*links, (0.3 * rng.normal(size=3), None, None, None)])
        q = rng.uniform(-3, 3, 6)
        problem = Problem(model, [Pose("tip", *ik_cases.pose_of(model, q, "tip"))], Space(model))
        found = closed_form(problem, model.qpos0)
        assert found is not None and found.structure == "three parallel axes"
        assert found.complete
        assert 1 <= len(found.q) <= 8
        assert np.abs(problem.raw(found.q).r).max() < 1e-8
        starts = problem.space.random(rng, 60, model.qpos0, problem.moved)
        ends = descend(problem, starts)
        for x in [q, *ends.q[ends.met]]:
            assert np.abs(ik_planar.wrap(found.q - x)).max(axis=1).min() < 1e-4


@pytest.mark.parametrize("spoil", ["none", "parallel", "meeting"])
def test_arms_that_nearly_have_a_structure_are_not_taken_for_it(spoil):
    model = _ur5()
    if spoil == "parallel":
        model.body_quat[3] += [0, 1e-7, 0, 0]
    if spoil == "meeting":
        model.body_pos[6] += [1e-6, 0, 0]
    problem = Problem(model, [Pose("tip", [0.3, 0.2, 0.4], [1, 0, 0, 0])], Space(model))
    assert (closed_form(problem, model.qpos0) is None) == (spoil != "none")
