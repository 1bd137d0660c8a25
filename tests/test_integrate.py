"""Integrators against closed forms and independent programs: orders as slopes, tolerances, failures."""

import sys

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import pendulum
from oracles.rigid_body import FreeBody, Top
from pantograph.sim.errors import EngineError
from pantograph.sim.integrate import ODE, TABLEAUS, Status, mujoco_problem, solve
from pantograph.sim.integrate.peers import PEERS

METHODS = list(TABLEAUS)
PAIRS = [name for name, method in TABLEAUS.items() if method.adaptive]
G = 9.81

SWING = ODE(lambda t, y: np.array([y[1], -G * np.sin(y[0])]), 2)
SWING_START = np.array([2.0, 0.0])

# Nonlinear, not autonomous: y = 1 / (1 + t^2).
BELL = ODE(lambda t, y: -2 * t * y * y, 1)


def bell(t):
    return 1 / (1 + t * t)


FREE_BODY = """<mujoco><option gravity="0 0 0"/><worldbody><body><freejoint/>
<inertial pos="0 0 0" mass="2" diaginertia="1.1 0.7 0.5"/></body></worldbody></mujoco>"""
FREE_RATES = np.array([0.4, 2.0, -0.9])

ARM = """<mujoco><option timestep="0.004"/><compiler autolimits="false"/><worldbody>
<body><joint name="a" type="hinge" axis="0 0 1" damping="0.1"/>
<geom type="capsule" size="0.04" fromto="0 0 0 0.3 0 0.2" contype="0" conaffinity="0"/>
<body pos="0.3 0 0.2"><joint name="b" type="hinge" axis="0 1 0" armature="0.02"/>
<geom type="capsule" size="0.03" fromto="0 0 0 0.4 0 0" contype="0" conaffinity="0"/>
<body pos="0.4 0 0"><joint name="c" type="slide" axis="1 0 0" stiffness="80"/>
<geom type="box" size=".05 .03 .02" contype="0" conaffinity="0"/></body></body></body></worldbody>
<actuator><motor joint="b" gear="2"/></actuator></mujoco>"""


def slope(steps: np.ndarray, errors: np.ndarray, *, low: float = 1e-12, high: float = 3e-3) -> float:
    """Order from the six finest steps whose errors are not yet lost in rounding."""
    usable = (errors > low) & (errors < high)
    assert usable.sum() >= 4, f"too few usable errors: {errors}"
    steps, errors = steps[usable][-6:], errors[usable][-6:]
    return float(np.polyfit(np.log(steps), np.log(errors), 1)[0])


def assert_slope(measured: float, order: int) -> None:
    """The full order; from above only where errors become a pure power before they are lost in rounding.

    That no method has a higher order than stated is shown by the order conditions (test_tableaus).
    """
    assert order - 0.3 < measured
    assert order > 4 or measured < order + 0.3


def counts(order: int) -> np.ndarray:
    """Numbers of steps that sweep errors from coarse to rounding for a method of that order."""
    finest = {1: 3000, 2: 1500, 3: 800, 4: 400, 5: 300, 8: 140, 9: 140}[order]
    return np.unique(np.round(np.geomspace(finest / 12, finest, 14)).astype(int))


def duration(order: int) -> float:
    """Spans [s] over which the errors of all methods are of a similar size."""
    return {1: 0.5, 8: 6.0, 9: 6.0}.get(order, 2.0)


def rotation_matrix(quat_wxyz: np.ndarray) -> np.ndarray:
    R = np.empty(9)
    mujoco.mju_quat2Mat(R, quat_wxyz)
    return R.reshape(3, 3)


class TestOrder:
    @pytest.mark.parametrize("name", METHODS)
    def test_scalar(self, name):
        order = TABLEAUS[name].order
        T, n = duration(order), counts(order)
        errors = [
            abs(solve(BELL, (-T, T / 2), [bell(T)], method=name, step=1.5 * T / k).y[-1, 0] - bell(T / 2))
            for k in n
        ]
        assert_slope(slope(1 / n, np.array(errors), low=1e-15 if order > 5 else 1e-12), order)

    @pytest.mark.parametrize("name", METHODS)
    def test_pendulum(self, name):
        order = TABLEAUS[name].order
        T, n = duration(order), counts(order)
        exact = pendulum.swing([T], 2.0)[0]
        errors = [
            np.abs(solve(SWING, (0, T), SWING_START, method=name, step=T / k).y[-1] - exact).max() for k in n
        ]
        assert_slope(slope(1 / n, np.array(errors)), order)

    @pytest.mark.parametrize("name", METHODS)
    def test_attitude_of_a_free_body(self, name):
        """Quaternions integrated beside the sphere and put back on it keep the full order."""
        order = TABLEAUS[name].order
        problem = mujoco_problem(mujoco.MjModel.from_xml_string(FREE_BODY))
        body = FreeBody([1.1, 0.7, 0.5], FREE_RATES)
        T, n = 3 * duration(order), counts(order)
        R, omega = body.attitude(T), body.omega(T)[0]
        start = np.array([0, 0, 0, 1, 0, 0, 0, 0.3, 0, -1, *FREE_RATES])
        errors = []
        for k in n:
            y = solve(problem, (0, T), start, method=name, step=T / k).y[-1]
            assert np.linalg.norm(y[3:7]) == pytest.approx(1, abs=1e-15)
            errors.append(max(np.abs(rotation_matrix(y[3:7]) - R).max(), np.abs(y[10:] - omega).max()))
        assert_slope(slope(1 / n, np.array(errors)), order)

    @pytest.mark.parametrize("name", METHODS)
    def test_dense_output_within_one_step(self, name):
        q = TABLEAUS[name].dense.order
        theta = np.linspace(0, 1, 21)
        start, h = (0.5, np.geomspace(0.6, 0.12, 10)) if q > 5 else (-1.0, np.geomspace(0.3, 0.02, 10))
        errors = []
        for step in h:
            t = start + theta * step
            y = solve(BELL, (start, t[-1]), [bell(start)], method=name, step=step, t_eval=t).y[:, 0]
            errors.append(np.abs(y - bell(t)).max())
        assert_slope(slope(h, np.array(errors)), q + 1)

    @pytest.mark.parametrize("name", METHODS)
    def test_dense_output_over_many_steps(self, name):
        """Between the steps the solution is as good as at their ends."""
        order = TABLEAUS[name].order
        T, n = duration(order), counts(order)
        t = np.sort(np.random.default_rng(3).uniform(-T, T, 40))
        errors = [
            np.abs(
                solve(BELL, (-T, T), [bell(-T)], method=name, step=2 * T / k, t_eval=t).y[:, 0] - bell(t)
            ).max()
            for k in n
        ]
        assert_slope(slope(1 / n, np.array(errors)), order)

    @given(st.sampled_from(METHODS), st.floats(0.01, 1.0), st.integers(1, 60))
    @settings(max_examples=60, deadline=None)
    def test_a_linear_oscillator_is_multiplied_by_the_stability_function(self, name, h, steps):
        """R(z) = 1 + z b (1 - z A)^-1 1 at z = i h: how each method damps or feeds an oscillation."""
        method = TABLEAUS[name]
        z = 1j * h
        R = 1 + z * method.b @ np.linalg.solve(np.eye(method.stages) - z * method.A, np.ones(method.stages))
        problem = ODE(lambda t, y: np.array([-y[1], y[0]]), 2)
        y = solve(problem, (0, h * steps), [1.0, 0.0], method=name, step=h).y[-1]
        np.testing.assert_allclose(y[0] + 1j * y[1], R**steps, rtol=1e-12)


class TestTolerance:
    @pytest.mark.parametrize("name", PAIRS)
    def test_error_is_proportional_to_the_tolerance(self, name):
        finest = {"heun": 1e-7, "bosh3": 1e-8}.get(name, 1e-11)
        rtol = np.geomspace(1e-4, finest, 9)
        exact = pendulum.swing([3.0], 2.0)[0]
        errors = np.array(
            [np.abs(solve(SWING, (0, 3), SWING_START, method=name, rtol=r).y[-1] - exact).max() for r in rtol]
        )
        assert np.polyfit(np.log(rtol), np.log(errors), 1)[0] == pytest.approx(1, abs=0.2)
        assert np.all(errors < 100 * rtol)

    @pytest.mark.parametrize("name", PAIRS)
    def test_one_tolerance_stands_for_both(self, name):
        a = solve(SWING, (0, 1), SWING_START, method=name, rtol=1e-5)
        b = solve(SWING, (0, 1), SWING_START, method=name, atol=1e-5)
        np.testing.assert_array_equal(a.y, b.y)

    def test_a_component_may_have_its_own(self):
        loose = solve(SWING, (0, 3), SWING_START, rtol=1e-9, atol=1e-9).stats
        speed_free = solve(SWING, (0, 3), SWING_START, rtol=1e-9, atol=np.array([1e-9, 1e3])).stats
        assert speed_free.evaluations < loose.evaluations

    def test_the_first_step_fits_the_scale_of_time(self):
        """A motion of microseconds and one of years are integrated at the same cost."""
        evaluations = []
        for scale in (1e-6, 1.0, 3e7):
            problem = ODE(lambda t, y, s=scale: np.array([y[1], -y[0]]) / s, 2)
            solution = solve(problem, (0, 10 * scale), [1.0, 0.0], rtol=1e-8)
            assert np.abs(solution.y[-1] - [np.cos(10), -np.sin(10)]).max() < 1e-6
            evaluations.append(solution.stats.evaluations)
        assert max(evaluations) < 1.3 * min(evaluations)

    @pytest.mark.parametrize("name", PAIRS)
    def test_a_sudden_kick_costs_few_rejections(self, name):
        """At t = 1 f jumps and its time scale shrinks a thousand times: good control is quick to follow."""
        problem = ODE(lambda t, y: np.array([1.0 if t < 1 else 1e3 * np.cos(1e3 * t)]), 1)
        stats = solve(problem, (0, 1.02), [0.0], method=name, rtol=1e-6).stats
        assert 2 < stats.rejected < 40

    def test_stiff_problem_is_finished_within_the_stability_limit(self):
        """x' = -1e4 (x - cos t): DOPRI5 is stable up to |h lambda| = 3.3, which sets its number of steps."""
        problem = ODE(lambda t, y: -1e4 * (y - np.cos(t)), 1)
        solution = solve(problem, (0, 1), [0.0], rtol=1e-6)
        assert solution.success
        assert abs(solution.y[-1, 0] - np.cos(1)) < 1e-3
        assert 1e4 / 3.4 < solution.stats.steps < 1e4


class TestErrorEstimate:
    @pytest.mark.parametrize("name", METHODS)
    def test_of_fixed_steps(self, name):
        step = {1: 0.002, 2: 0.01, 8: 0.1, 9: 0.1}.get(TABLEAUS[name].order, 0.02)
        solution = solve(SWING, (0, 2.0), SWING_START, method=name, step=step, error=True)
        true = solution.y - pendulum.swing(solution.t, 2.0)
        big = np.abs(true) > 1e-11
        assert big.sum() > 10
        np.testing.assert_allclose(solution.error[big].max(), true[big].max(), rtol=0.25)
        assert solution.max_error == np.abs(solution.error).max()
        assert (
            solution.stats.evaluations
            == solve(SWING, (0, 2), SWING_START, method=name, step=step).stats.evaluations
        )
        assert solution.error_stats.steps == 2 * solution.stats.steps

    @pytest.mark.parametrize("name", PAIRS)
    def test_of_adaptive_steps(self, name):
        t = np.linspace(0, 3, 20)
        solution = solve(SWING, (0, 3), SWING_START, method=name, rtol=1e-5, t_eval=t, error=True)
        true = solution.y - pendulum.swing(t, 2.0)
        np.testing.assert_allclose(solution.error, true, rtol=0, atol=0.1 * np.abs(true).max())
        assert solution.error_stats.evaluations > solution.stats.evaluations

    def test_is_not_invented(self):
        with pytest.raises(ValueError, match="error=True"):
            _ = solve(SWING, (0, 1), SWING_START).max_error


class TestTime:
    @given(
        st.sampled_from(METHODS),
        st.floats(-2, 2),
        st.floats(-3, 3),
        st.floats(0.01, 0.1),
    )
    @settings(max_examples=40, deadline=None)
    def test_backward_is_the_mirror_of_forward(self, name, angle, rate, step):
        """The pendulum's flow commutes with (t, rate) -> (-t, -rate), and so does every method."""
        forward = solve(SWING, (0, 0.95), [angle, rate], method=name, step=step)
        backward = solve(SWING, (0, -0.95), [angle, -rate], method=name, step=step)
        np.testing.assert_array_equal(backward.t, -forward.t)
        np.testing.assert_allclose(backward.y, forward.y * [1, -1], rtol=1e-13, atol=1e-13)

    @pytest.mark.parametrize("name", PAIRS[1:])
    def test_there_and_back(self, name):
        there = solve(SWING, (0, 3), SWING_START, method=name, rtol=1e-9).y[-1]
        back = solve(SWING, (3, 0), there, method=name, rtol=1e-9).y[-1]
        np.testing.assert_allclose(back, SWING_START, rtol=0, atol=1e-6)

    @pytest.mark.parametrize("name", METHODS)
    def test_output_times_do_not_change_the_steps(self, name):
        t = np.linspace(0, 2, 77)
        plain = solve(SWING, (0, 2), SWING_START, method=name, step=0.03)
        at_t = solve(SWING, (0, 2), SWING_START, method=name, step=0.03, t_eval=t)
        np.testing.assert_array_equal(at_t.t, t)
        np.testing.assert_array_equal(at_t.y[[0, -1]], plain.y[[0, -1]])
        again = solve(SWING, (0, 2), SWING_START, method=name, step=0.03, t_eval=plain.t)
        np.testing.assert_array_equal(again.y, plain.y)

    def test_interpolant_and_output_times_agree_backward_too(self):
        for span in ((0.0, 2.0), (2.0, -1.0)):
            t = np.linspace(*span, 33)
            solution = solve(SWING, span, SWING_START, rtol=1e-8, t_eval=t, dense=True)
            np.testing.assert_array_equal(solution.interpolant(t), solution.y)
            with pytest.raises(EngineError, match="outside"):
                solution.interpolant(5.0)

    @pytest.mark.parametrize("name", METHODS)
    def test_quaternions_between_the_steps_are_unit_too(self, name):
        problem = mujoco_problem(mujoco.MjModel.from_xml_string(FREE_BODY))
        start = np.array([0, 0, 0, 1, 0, 0, 0, 0.3, 0, -1, *FREE_RATES])
        y = solve(problem, (0, 1), start, method=name, step=0.2, t_eval=np.linspace(0, 1, 24)).y
        np.testing.assert_allclose(np.linalg.norm(y[:, 3:7], axis=1), 1, rtol=0, atol=4e-16)

    def test_the_last_fixed_step_is_cut(self):
        solution = solve(SWING, (0, 1), SWING_START, method="rk4", step=0.3)
        np.testing.assert_allclose(solution.t, [0, 0.3, 0.6, 0.9, 1.0], rtol=1e-15)
        assert solve(SWING, (0, 1), SWING_START, method="rk4", step=0.1).stats.steps == 10

    def test_results_are_read_only(self):
        solution = solve(SWING, (0, 1), SWING_START)
        with pytest.raises(ValueError, match="read-only"):
            solution.y[0, 0] = 1


class TestFailure:
    @pytest.mark.parametrize("control", [{"method": "rk4", "step": 0.01}, {"method": "dopri5", "rtol": 1e-6}])
    def test_a_state_that_is_not_finite_ends_it_and_keeps_the_rest(self, control):
        problem = ODE(lambda t, y: np.array([y[1], np.nan if t > 0.5 else -y[0]]), 2)
        solution = solve(problem, (0, 1), [1.0, 0.0], t_eval=np.linspace(0, 1, 101), **control)
        assert solution.status == Status.DIVERGED and not solution.success
        assert "t = 0." in solution.message and "component 1 of f" in solution.message
        assert np.all(np.isfinite(solution.y)) and 0.3 < solution.t[-1] <= 0.5
        np.testing.assert_allclose(solution.y[:, 0], np.cos(solution.t), rtol=0, atol=1e-5)

    def test_blow_up(self):
        """y' = y^2, y(0) = 1 leaves every bound at t = 1."""
        problem = ODE(lambda t, y: np.array([0.1, y[1] ** 2, -0.1]), 3)
        adaptive = solve(problem, (0, 2), [1.0, 1.0, 1.0], rtol=1e-8)
        assert adaptive.status == Status.STEP_TOO_SMALL and "component 1 " in adaptive.message
        assert adaptive.t[-1] == pytest.approx(1, abs=1e-6)
        fixed = solve(problem, (0, 2), [1.0, 1.0, 1.0], method="rk4", step=0.01)
        assert fixed.status == Status.DIVERGED and 1 < fixed.t[-1] < 1.2

    def test_not_finite_at_the_start(self):
        solution = solve(ODE(lambda t, y: y / t, 1), (0, 1), [0.0])
        assert solution.status == Status.DIVERGED and "at the start" in solution.message
        assert len(solution.t) == 1

    def test_limit_of_steps(self):
        solution = solve(SWING, (0, 10), SWING_START, rtol=1e-10, max_steps=20)
        assert solution.status == Status.TOO_MANY_STEPS and solution.stats.steps == 20


class TestArguments:
    @pytest.mark.parametrize(
        ("arguments", "says"),
        [
            ({"step": 0.1, "rtol": 1e-3}, "give one"),
            ({"method": "rk4"}, "give step"),
            ({"method": "rk4", "rtol": 1e-3}, "dopri5, dop853, verner98"),
            ({"method": "rk5"}, "did you mean.*verner98"),
            ({"step": -0.1}, "positive"),
            ({"step": np.nan}, "positive"),
            ({"rtol": 1e-17}, "doubles"),
            ({"rtol": -1.0}, "positive"),
            ({"rtol": 1e-6, "atol": 0.0}, "positive"),
            ({"t_eval": [0.5, 1.5]}, "1.5 s, outside"),
            ({"t_eval": [0.5, 0.2]}, "ascend"),
            ({"t_eval": [np.nan]}, "outside"),
            ({"method": "scipy:RK45", "step": 0.1}, "rtol and atol"),
            ({"method": "scipy:rk45"}, "RK45"),
            ({"method": "torch:rk4"}, "step=0.001"),
            ({"method": "torch:rk4", "step": 0.1, "rtol": 1e-3}, "leave out"),
            ({"method": "torch:dopri5", "dense": True}, "dense"),
            ({"method": "scipy:RK45", "error": True}, "own methods"),
        ],
    )
    def test_contradictions_are_named(self, arguments, says):
        with pytest.raises(EngineError, match=says):
            solve(SWING, (0, 1), SWING_START, **arguments)

    @pytest.mark.parametrize(
        ("span", "y0", "says"),
        [((0, 0), [1, 0], "two different"), ((0, np.inf), [1, 0], "finite"), ((0, 1), [1], r"needs \(2,\)"),
         ((0, 1), [1, np.nan], "component 1")],
    )  # fmt: skip
    def test_spans_and_states(self, span, y0, says):
        with pytest.raises(EngineError, match=says):
            solve(SWING, span, y0)


class TestPeers:
    @pytest.mark.parametrize("name", [f"scipy:{name}" for name in PEERS["scipy"]])
    @pytest.mark.parametrize("span", [(0.0, 2.0), (0.0, -2.0)])
    def test_scipy_agrees(self, name, span):
        t = np.linspace(*span, 9)
        solution = solve(SWING, span, SWING_START, method=name, rtol=1e-8, t_eval=t)
        assert solution.success and solution.stats.steps > 10
        np.testing.assert_array_equal(solution.t, t)
        np.testing.assert_allclose(solution.y, pendulum.swing(t, 2.0), rtol=0, atol=3e-6)

    @pytest.mark.parametrize("name", PEERS["torch"])
    def test_torchdiffeq_agrees(self, name):
        pytest.importorskip(
            "torchdiffeq", reason="torchdiffeq is not installed: pip install 'pantograph-sim[torch]'"
        )
        t = np.linspace(0.1, 2, 9)
        # Between its steps torchdiffeq interpolates by a quartic, whatever the method's order.
        low = {"euler": 0.05, "midpoint": 1e-4, "adaptive_heun": 1e-4, "dopri8": 1e-4, "bosh3": 1e-4}.get(
            name, 1e-5
        )
        # Its explicit Adams has order 12 and is unstable beyond a millisecond here.
        fixed = {"euler": 0.001, "midpoint": 0.001, "explicit_adams": 0.001}.get(name, 0.005)
        control = {"step": fixed} if name in PEERS["torch"][5:] else {"rtol": 1e-8}
        if name == "adaptive_heun":
            control = {"rtol": 1e-6}
        solution = solve(SWING, (0, 2), SWING_START, method=f"torch:{name}", t_eval=t, **control)
        np.testing.assert_array_equal(solution.t, t)
        np.testing.assert_allclose(solution.y, pendulum.swing(t, 2.0), rtol=0, atol=low)
        assert solution.stats.evaluations > 30

    @pytest.mark.parametrize(("theirs", "ours"), [("torch:rk4", "rk38"), ("torch:euler", "euler")])
    @pytest.mark.parametrize("span", [(0.0, 1.0), (0.0, -1.0)])
    def test_torchdiffeq_takes_our_very_steps(self, theirs, ours, span):
        """Its rk4 is the 3/8 rule."""
        pytest.importorskip(
            "torchdiffeq", reason="torchdiffeq is not installed: pip install 'pantograph-sim[torch]'"
        )
        a = solve(SWING, span, SWING_START, method=theirs, step=0.03)
        b = solve(SWING, span, SWING_START, method=ours, step=0.03)
        np.testing.assert_allclose(a.t, b.t, rtol=1e-15)
        np.testing.assert_allclose(a.y, b.y, rtol=1e-12, atol=1e-13)

    def test_missing_torch_is_said_with_the_remedy(self, monkeypatch):
        monkeypatch.setitem(sys.modules, "torchdiffeq", None)
        with pytest.raises(EngineError, match=r"pip install 'pantograph-sim\[torch\]'"):
            solve(SWING, (0, 1), SWING_START, method="torch:dopri5")


class TestMujoco:
    def test_rk4_takes_the_very_steps_of_mujoco(self):
        model = mujoco.MjModel.from_xml_string(ARM)
        model.opt.integrator = mujoco.mjtIntegrator.mjINT_RK4
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.ctrl[:] = (0.3, -0.5, 0.05), (1, 2, 0), 0.4
        start = np.concatenate([data.qpos, data.qvel])
        for _ in range(250):
            mujoco.mj_step(model, data)
        problem = mujoco_problem(model, control=np.array([0.4]))
        solution = solve(problem, (0, 1), start, method="rk4", step=0.004)
        np.testing.assert_allclose(
            solution.y[-1], np.concatenate([data.qpos, data.qvel]), rtol=1e-10, atol=1e-11
        )

    def test_a_control_may_depend_on_time_and_state(self):
        model = mujoco.MjModel.from_xml_string(ARM)
        problem = mujoco_problem(model, control=lambda t, y: np.array([np.sin(t) - y[1]]))
        y = np.array([0.1, 0.2, 0.3, 0.4, 0.5, 0.6])
        constant = mujoco_problem(model, control=np.array([np.sin(2.0) - 0.2]))
        np.testing.assert_array_equal(problem.f(2.0, y), constant.f(0.0, y))
        assert np.abs(problem.f(2.0, y) - mujoco_problem(model).f(2.0, y)).max() > 0.1

    def test_heavy_top(self):
        """A spinning top on a ball joint against its closed form: spin 150 rad/s, close to the lower pole."""
        xml = """<mujoco><worldbody><body><joint type="ball"/><inertial pos="0 1 0" mass="15"
        diaginertia="0.234375 0.46875 0.234375"/></body></worldbody></mujoco>"""
        omega = np.array([0, 150, -4.61538])
        top = Top(15.234375, 0.46875 * 150, 15 * G, [0, 1, 0], np.cross(omega, [0, 1, 0]))
        problem = mujoco_problem(mujoco.MjModel.from_xml_string(xml))
        y = solve(problem, (0, 2), [1, 0, 0, 0, *omega], method="dop853", rtol=1e-11).y[-1]
        axis = rotation_matrix(y[:4])[:, 1]
        np.testing.assert_allclose(axis, top.axis(2.0), rtol=0, atol=1e-7)
        published = (
            -0.15041682274564176,
            -0.72416559163689565,
            -0.67302226956044410,
        )  # Bruels 2012, 25 digits
        np.testing.assert_allclose(top.axis(2.0), published, rtol=0, atol=1e-12)

    def test_constraints_are_refused_by_name_or_dropped(self):
        xml = ARM.replace('type="slide"', 'type="slide" limited="true" range="-1 1" frictionloss="0.1"')
        model = mujoco.MjModel.from_xml_string(xml.replace('contype="0" conaffinity="0"', ""))
        with pytest.raises(
            EngineError, match=r"1 joint or tendon limit.*dry friction in 1 .*may touch.*drop_constr"
        ):
            mujoco_problem(model)
        dropped = mujoco_problem(model, drop_constraints=True)
        y = np.array([0.1, -2.0, 5.0, 1, 1, 1])  # far beyond the limit
        np.testing.assert_allclose(
            dropped.f(0, y), mujoco_problem(mujoco.MjModel.from_xml_string(ARM)).f(0, y)
        )
        assert model.opt.disableflags == 0
