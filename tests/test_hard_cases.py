"""The values of the hard cases, derived anew; and the smooth engine reaches every one of them."""

import numpy as np
import pytest
from oracles import pendulum, small_motion
from oracles.rigid_body import FreeBody, Top
from pantograph.sim.dynamics.smooth import compile_model
from pantograph.sim.hard_cases import HARD_CASES
from pantograph.sim.work_runners import smooth_reference
from scipy.integrate import solve_ivp

CASES = {case.name: case for case in HARD_CASES}
NAMED = {"argvalues": HARD_CASES, "ids": list(CASES)}


def agree(name: str, value, tolerance: float) -> None:
    case = CASES[name]
    assert np.max(np.abs(np.asarray(value) - case.expected) / np.asarray(case.scale)) < tolerance


def test_there_are_ten():
    assert len(CASES) == 10


@pytest.mark.parametrize("case", **NAMED)
def test_smooth_engine_reaches_the_value(case):
    motion = case.case()
    reference = smooth_reference(motion, compile_model(motion.model))
    assert case.error(reference.motion, motion.model) < 1e-9


@pytest.mark.parametrize("case", **NAMED)
def test_an_error_is_seen(case):
    """What is observed moves when the motion is a little off."""
    motion = case.case()
    reference = smooth_reference(motion, compile_model(motion.model)).motion
    off = type(reference)(reference.q + 1e-6, reference.v + 1e-6, 0)
    assert case.error(off, motion.model) > 1e-8
    lost = type(reference)(reference.q * np.nan, reference.v, 0)
    assert np.isnan(case.error(lost, motion.model))


def test_pendulums():
    top = CASES["pendulum from 179 deg"]
    assert top.duration == pytest.approx(1.25 * 7.82579683753768270, rel=1e-15)
    assert pendulum.period(top.q[0]) == pytest.approx(7.82579683753768270, rel=1e-15)
    agree(top.name, pendulum.swing([top.duration], top.q[0])[0, :1], 1e-12)
    agree("pendulum for 100 s", pendulum.swing([100.0], np.pi / 2)[0, :1], 1e-13)


def test_double_pendulum():
    """Textbook equations in angles from down, by SciPy."""

    def rate(t, y):
        a, b, p, q = y
        c, s = np.cos(a - b), np.sin(a - b)
        M = np.array([[2, c], [c, 1]])
        force = np.array([-q * q * s - 2 * 9.81 * np.sin(a), p * p * s - 9.81 * np.sin(b)])
        return np.concatenate([[p, q], np.linalg.solve(M, force)])

    case = CASES["double pendulum for 10 s"]
    start = [case.q[0], case.q[0] + case.q[1], 0, 0]
    a, b = solve_ivp(rate, (0, 10), start, method="DOP853", rtol=1e-13, atol=1e-13).y[:2, -1]
    agree(case.name, (a, b - a), 1e-9)


def test_rigid_bodies():
    tumbling = CASES["tumbling body"]
    body = FreeBody([0.80833333, 0.68333333, 0.14166667], tumbling.v)
    agree(tumbling.name, body.omega([10.0])[0], 1e-13)
    top = CASES["heavy top"]
    axis = Top(15.234375, 0.46875 * 150, 15 * 9.81, [0, 1, 0], np.cross(top.v, [0, 1, 0])).axis(top.duration)
    agree(top.name, axis, 1e-13)
    swing = CASES["spherical pendulum"]
    side = np.sin(np.pi / 3)
    axis = Top(1.0, 0.0, 9.81, [side, 0, -0.5], [0, 3 * side, 0]).axis(swing.duration)
    agree(swing.name, 0.9 * axis, 1e-13)


def test_linear_motions():
    servo = CASES["stiff servo"]
    agree(servo.name, small_motion.servo([servo.duration], kp=1e6, kd=2000)[0, :1], 1e-15)
    shaken = CASES["Kapitza's pendulum"]
    assert small_motion.kapitza_threshold(0.05) == pytest.approx(88.6373138487898, rel=1e-13)
    angle = 1e-8 * small_motion.shaken_upright(shaken.duration, frequency=100.0, amplitude=0.05)
    agree(shaken.name, (0.05 * np.cos(100 * shaken.duration), angle), 1e-12)


def test_heavy_tip():
    case = CASES["heavy tip"]
    w, modes = small_motion.double_pendulum_modes(1e4)
    np.testing.assert_allclose(w, [2.21475114152112656, 442.961301783102867], rtol=1e-15)
    absolute = np.array([case.q[0], case.q[0] + case.q[1]])
    amounts = np.linalg.solve(modes, absolute)
    end = modes @ (amounts * np.cos(w * case.duration))
    agree(case.name, (end[0], end[1] - end[0]), 1e-11)


def test_hanging_chain():
    case = CASES["hanging chain"]
    w = small_motion.hanging_chain_modes(10)[0]
    assert w == pytest.approx(3.67662065761784941, rel=1e-15)
    assert case.duration == pytest.approx(10 * np.pi / w, rel=1e-15)
    angles = np.diff(small_motion.chain_mode(10), prepend=0) / 0.1
    shape = np.diff(angles, prepend=0)
    np.testing.assert_allclose(np.array(case.q) / case.q[0], shape / shape[0], rtol=1e-12)
    agree(case.name, case.q, 1e-15)
