"""Events are found where closed forms put them, in order, in either direction of time, and only once."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from oracles import pendulum
from oracles.small_motion import bounce_times, rest_time
from pantograph.sim.errors import EngineError
from pantograph.sim.integrate import ODE, TABLEAUS, Event, Status, solve

G = 9.81
METHODS = list(TABLEAUS)
PRECISE = ["rk4", "rk38", "dopri5", "dop853", "verner98"]
SWING = ODE(lambda t, y: np.array([y[1], -G * np.sin(y[0])]), 2)
BALL = ODE(lambda t, y: np.array([y[1], -G]), 2)
CLOCK = ODE(lambda t, y: np.ones(1), 1)


def bounce(restitution: float) -> Event:
    return Event(lambda t, y: y[0], -1, jump=lambda t, y: np.array([0.0, -restitution * y[1]]), name="ground")


def control(method: str) -> dict[str, float]:
    return {"rtol": 1e-12} if TABLEAUS[method].order >= 5 else {"step": 0.002}


def times(solution, event: int = 0) -> np.ndarray:
    return np.array([o.t for o in solution.events if o.event == event])


@pytest.mark.parametrize("method", PRECISE)
@pytest.mark.parametrize("amplitude", [0.2, 2.0, 3.1])
def test_zero_crossings_of_a_pendulum(method, amplitude):
    period = pendulum.period(amplitude)
    bottom = Event(lambda t, y: y[0])
    top = Event(lambda t, y: y[1], direction=-1)
    solution = solve(
        SWING, (0, 3.1 * period), [amplitude, 0], method=method, events=[bottom, top], **control(method)
    )
    np.testing.assert_allclose(times(solution, 0), period * (0.25 + 0.5 * np.arange(6)), rtol=0, atol=2e-8)
    np.testing.assert_allclose(times(solution, 1), period * np.arange(1, 4), rtol=0, atol=2e-8)
    assert np.all(np.diff([o.t for o in solution.events]) > 0)
    for o in solution.events:
        np.testing.assert_allclose(o.y, pendulum.swing([o.t], amplitude)[0], rtol=0, atol=2e-7)
        assert abs((o.y[0], o.y[1])[o.event]) < 1e-12, "the event function is zero at the event"


@pytest.mark.parametrize("method", METHODS)
def test_time_of_an_event_has_the_order_of_the_method(method):
    order = TABLEAUS[method].order
    exact = pendulum.period(2.0) * (0.25 + 0.5 * np.arange(2))
    base = {1: 0.002, 2: 0.004, 3: 0.01, 4: 0.006, 5: 0.04, 8: 0.15, 9: 0.15}[order]
    steps = base / np.geomspace(1, 2.5, 6)
    errors = []
    for step in steps:
        solution = solve(
            SWING, (0, 2.7), [2.0, 0], method=method, step=step, events=[Event(lambda t, y: y[0])]
        )
        errors.append(np.abs(times(solution)[:2] - exact).max())
    assert np.polyfit(np.log(steps), np.log(errors), 1)[0] > order - 0.3


@pytest.mark.parametrize(("direction", "first", "count"), [(1, 0.75, 2), (-1, 0.25, 3), (0, 0.25, 5)])
def test_direction(direction, first, count):
    period = pendulum.period(1.0)
    event = Event(lambda t, y: y[0], direction)
    found = times(solve(SWING, (0, 2.5 * period), [1.0, 0], rtol=1e-9, events=[event]))
    assert len(found) == count and found[0] == pytest.approx(first * period, abs=1e-7)


@pytest.mark.parametrize("method", ["dopri5", "scipy:DOP853", "scipy:Radau"])
def test_a_terminal_event_ends_the_solution(method):
    period = pendulum.period(1.0)
    event = Event(lambda t, y: y[0], terminal=True, name="bottom")
    solution = solve(SWING, (0, 5), [1.0, 0], method=method, rtol=1e-9, events=[event])
    assert solution.status == Status.EVENT and solution.success
    assert solution.t[-1] == pytest.approx(period / 4, abs=1e-6)
    assert solution.events[0].name == "bottom"
    grid = np.linspace(0, 5, 501)
    at_grid = solve(SWING, (0, 5), [1.0, 0], method=method, rtol=1e-9, events=[event], t_eval=grid)
    np.testing.assert_array_equal(at_grid.t, grid[grid <= at_grid.events[0].t])
    np.testing.assert_allclose(at_grid.y, pendulum.swing(at_grid.t, 1.0), rtol=0, atol=1e-6)


@pytest.mark.parametrize("method", METHODS[1:])
def test_bounces(method):
    """Parabolas are integrated exactly from order 2 on, so the times of bounces are exact too."""
    kind = {"step": 0.01} if TABLEAUS[method].order < 5 else {"rtol": 1e-8}
    exact = bounce_times(5, height=1.0, restitution=0.5)
    solution = solve(BALL, (0, 1.3), [1.0, 0.0], method=method, events=[bounce(0.5)], **kind)
    np.testing.assert_allclose(times(solution)[:5], exact, rtol=0, atol=1e-12)
    for o in solution.events:
        np.testing.assert_array_equal(o.y_after, [0, -0.5 * o.y[1]])
    repeated = np.flatnonzero(np.diff(solution.t) == 0)
    assert len(repeated) == len(solution.events), "both sides of a jump are in the output"
    assert solution.y[:, 0].min() > -1e-12


@given(
    st.sampled_from(PRECISE),
    st.floats(0.1, 3.0),
    st.floats(0.3, 0.95),
    st.floats(0.003, 0.4),
)
@settings(max_examples=60, deadline=None)
def test_bounces_of_any_ball(method, height, restitution, step):
    exact = bounce_times(6, height=height, restitution=restitution)
    end = (exact[-1] + exact[-2]) / 2
    t = np.linspace(0, end, 23)
    solution = solve(
        BALL, (0, end), [height, 0.0], method=method, step=step, events=[bounce(restitution)], t_eval=t
    )
    np.testing.assert_allclose(times(solution), exact[:-1], rtol=1e-11)
    speed = np.sqrt(2 * G * height)
    for when, state in zip(t, solution.y, strict=True):
        k = int(np.searchsorted(exact, when, side="right"))  # bounces so far
        if k == 0:
            continue
        tau = when - exact[k - 1]
        v = speed * restitution**k
        assert state[0] == pytest.approx(v * tau - G * tau**2 / 2, abs=1e-10)


@given(st.floats(0.2, 0.8), st.floats(0.5, 2.0), st.sampled_from(PRECISE))
@settings(max_examples=25, deadline=None)
def test_ever_faster_bounces_end_in_rest(restitution, height, method):
    exact = rest_time(height=height, restitution=restitution)
    span = 2 * exact
    solution = solve(BALL, (0, span), [height, 0.0], method=method, step=0.02, events=[bounce(restitution)])
    assert solution.status == Status.ACCUMULATED and "ground" in solution.message
    # The flight just before is shorter than 1e-8 of the span; those after it sum to r / (1 - r) of it.
    left = exact - solution.events[-1].t
    assert -1e-11 <= left <= 1e-8 * span * restitution / (1 - restitution) + 1e-11


def test_events_of_one_step_come_in_order():
    """One step over several zeros of several functions, in both directions of time."""
    events = [Event(lambda t, y, z=z: y[0] - z) for z in (0.7, 0.2, 0.45)]
    forward = solve(CLOCK, (0, 1), [0.0], method="rk4", step=1.0, events=events)
    assert [o.event for o in forward.events] == [1, 2, 0]
    np.testing.assert_allclose([o.t for o in forward.events], [0.2, 0.45, 0.7], rtol=1e-15)
    backward = solve(CLOCK, (1, 0), [1.0], method="rk4", step=1.0, events=events)
    assert [o.event for o in backward.events] == [0, 2, 1]
    rising = solve(CLOCK, (1, 0), [1.0], method="rk4", step=1.0, events=[Event(lambda t, y: y[0] - 0.5, 1)])
    assert not rising.events, "in the direction of integration the function falls"


def test_an_interruption_hides_later_events_of_its_step():
    events = [Event(lambda t, y: y[0] - 0.7), Event(lambda t, y: y[0] - 0.2, terminal=True)]
    solution = solve(CLOCK, (0, 1), [0.0], method="rk4", step=1.0, events=events)
    assert [o.event for o in solution.events] == [1] and solution.t[-1] == pytest.approx(0.2)
    jump = Event(lambda t, y: y[0] - 0.5, 1, jump=lambda t, y: y - 0.4)
    solution = solve(CLOCK, (0, 2), [0.0], method="rk4", step=0.8, events=[events[0], jump])
    np.testing.assert_allclose(times(solution, 1), [0.5, 0.9, 1.3, 1.7], rtol=1e-14)
    assert not times(solution, 0).size, "0.7 is never reached"


@pytest.mark.parametrize(("depth", "expected"), [(1e-6, 2), (1e-3, 2), (-1e-9, 0)])
@pytest.mark.parametrize("method", ["rk4", "dopri5", "verner98"])
def test_a_dip_inside_one_step(depth, expected, method):
    """A ball thrown up reaches its apex inside a single step; the bar hangs `depth` below the apex."""
    apex = 1.0 / (2 * G)
    bar = Event(lambda t, y: y[0] - (apex - depth))
    solution = solve(BALL, (0, 0.25), [0.0, 1.0], method=method, step=0.25, events=[bar])
    found = times(solution)
    assert len(found) == expected
    if expected:
        half = np.sqrt(2 * depth / G)
        np.testing.assert_allclose(found, [1 / G - half, 1 / G + half], rtol=0, atol=1e-9)


@pytest.mark.parametrize("method", ["rk4", "dopri5", "verner98"])
@pytest.mark.parametrize("floor", [-1e4, 0.0, 3.0, 1e5])
def test_bounces_far_from_the_origin_of_coordinates(method, floor):
    """The first step after a jump begins on zero, and rounding must not let the ball through."""
    ground = Event(lambda t, y: y[0] - floor, -1, jump=lambda t, y: np.array([floor, -0.5 * y[1]]))
    exact = bounce_times(8, height=1.0, restitution=0.5)
    solution = solve(
        BALL, (0, (exact[6] + exact[7]) / 2), [floor + 1, 0.0], method=method, step=0.3, events=[ground]
    )
    np.testing.assert_allclose(times(solution), exact[:7], rtol=0, atol=1e-9)


def test_a_crossing_right_after_the_start_is_found():
    for z in (1e-3, 1e-8, 1e-11):
        found = times(
            solve(CLOCK, (0, 1), [0.0], method="rk4", step=1.0, events=[Event(lambda t, y, z=z: y[0] - z)])
        )
        np.testing.assert_allclose(found, [z], rtol=1e-9)


@pytest.mark.parametrize("method", ["rk4", "dopri5"])
def test_a_start_on_zero_is_not_an_event(method):
    solution = solve(BALL, (0, 0.3), [0.0, 1.0], method=method, step=0.02, events=[Event(lambda t, y: y[0])])
    np.testing.assert_allclose(times(solution), [2 / G], rtol=1e-12)


def test_events_do_not_change_the_steps():
    watched = solve(
        SWING, (0, 3), [2.0, 0], rtol=1e-8, events=[Event(lambda t, y: y[0]), Event(lambda t, y: y[1])]
    )
    plain = solve(SWING, (0, 3), [2.0, 0], rtol=1e-8)
    np.testing.assert_array_equal(watched.y, plain.y)


def test_fixed_steps_return_to_their_grid_after_a_jump():
    solution = solve(BALL, (0, 1), [1.0, 0.0], method="rk4", step=0.1, events=[bounce(0.5)])
    on_grid = np.isin(np.round(np.linspace(0, 1, 11), 12), np.round(solution.t, 12))
    assert on_grid.all()


@pytest.mark.parametrize("method", ["scipy:RK45", "scipy:LSODA"])
def test_scipy_finds_the_same_events(method):
    events = [Event(lambda t, y: y[0], -1, name="down"), Event(lambda t, y: y[1])]
    ours = solve(SWING, (0, 5), [2.0, 0.1], rtol=1e-10, events=events)
    theirs = solve(SWING, (0, 5), [2.0, 0.1], method=method, rtol=1e-10, events=events)
    assert [o.name for o in theirs.events] == [o.name for o in ours.events]
    np.testing.assert_allclose([o.t for o in theirs.events], [o.t for o in ours.events], rtol=0, atol=1e-6)


def test_what_peers_cannot_do_is_said():
    with pytest.raises(EngineError, match="cannot jump"):
        solve(BALL, (0, 1), [1.0, 0], method="scipy:RK45", events=[bounce(0.5)])
    with pytest.raises(EngineError, match="events"):
        solve(BALL, (0, 1), [1.0, 0], method="torch:dopri5", events=[bounce(0.5)])


def test_error_estimate_of_a_bouncing_pendulum_reaches_its_end():
    wall = Event(lambda t, y: y[0] + 0.5, -1, jump=lambda t, y: np.array([-0.5, -0.8 * y[1]]))
    solution = solve(SWING, (0, 3), [1.0, 0], method="rk4", step=0.01, events=[wall], error=True)
    fine = solve(SWING, (0, 3), [1.0, 0], method="verner98", rtol=1e-12, events=[wall], t_eval=solution.t)
    assert len(solution.events) == len(fine.events) > 1
    true = np.abs(solution.y - fine.y)[-1]
    np.testing.assert_allclose(np.abs(solution.error[-1]), true, rtol=0.5)
    jumps = np.isin(solution.t, [o.t for o in solution.events])
    assert np.isnan(solution.error[jumps]).all() and np.isfinite(solution.error[~jumps]).all()
