"""What iterative learning keeps of its repeats, and when it gives the forces that it learned."""

import numpy as np
import pytest
from pantograph.controllers.ilc import Fed, Repeated, learn, seen_in
from pantograph.controllers.nominal import difference
from pantograph.controllers.reality import with_reality
from pantograph.controllers.trial import Disturbance, run_trial
from pantograph.sim import Scene, make_plan
from pantograph.sim.compose import make_engine, make_law
from pantograph.sim.control import Sampled
from pantograph.sim.engines.interface import Role

PERIOD = 0.005
SWING = Scene(
    duration=0.6,
    models=[{"file": "planar_2r"}],
    roles={"tracked": ["shoulder", "elbow"]},
    actuators={"*": "off"},
    keys=[
        {"joint": "shoulder", "times": [0, 0.3, 0.6], "values": [0, 0.7, 0.2], "curve": "clamped"},
        {"joint": "elbow", "times": [0, 0.3, 0.6], "values": [0.4, -0.5, 0.3], "curve": "clamped"},
    ],
    physics={"contacts": "none", "limits": False},
    controller={"law": "pd", "period": PERIOD, "gravity": False},
    solver={"engine": "smooth"},
)
PLAN = make_plan(SWING)
PROBLEM, ENGINE = PLAN.problem, make_engine("smooth")
TRACKED = PROBLEM.dofs(Role.TRACKED)


def law():
    return make_law("pd", PROBLEM, {"frequency": 2.0, "gravity": False}, PERIOD)


def around(delay, inner):
    words = {"delay": delay} if delay else {}
    return with_reality(inner, PROBLEM.model, TRACKED, PROBLEM.state0.q, PERIOD, words)


def run_with(inner, delay=0.0):
    """Recorded errors of a run of a law behind a delay, and the memory at its end."""
    controls = Sampled(around(delay, inner), PROBLEM, PERIOD)
    segment = ENGINE.run(PROBLEM, (0.0, PROBLEM.duration), controls)
    assert segment.status == "done"
    memory = controls.memory
    return getattr(memory, "law", memory) if delay else memory


def error_of(forces, delay=0.0):
    """RMS error of a run with learned forces, at its ticks."""
    seen, made = [], Fed(law(), forces, PERIOD)

    class Watched:
        def start(self):
            return made.start()

        def __call__(self, t, q, v, target, memory):
            seen.append(difference(PROBLEM.model, q, target.q))
            return made(t, q, v, target, memory)

    run_with(Watched(), delay)
    return float(np.sqrt(np.mean(np.square(seen))))


@pytest.mark.parametrize("late", [0, 1, 4])
def test_forces_are_learned_as_much_earlier_as_the_drives_are_late(late):
    """After one repeat, all frequencies let through, the force at a tick is the share of the feedback that
    the law gave ``late`` ticks later, when a force of this tick arrives."""
    delay = late * PERIOD
    repeated = Repeated(law(), PROBLEM.model, np.zeros((120, 2)), PERIOD)
    _, feedback = seen_in(run_with(repeated, delay))
    found = learn(
        law, PROBLEM, ENGINE, PERIOD, repeats=2, share=0.5, bandwidth=1e4, delay=delay,
        around=lambda inner: around(delay, inner),
    )  # fmt: skip
    assert found.errors[1] < found.errors[0]
    expected = 0.5 * feedback[np.minimum(np.arange(120) + late, 119)]
    np.testing.assert_allclose(found.forces[5:-5], expected[5:-5], atol=2e-3 * np.abs(expected).max())
    steepest = np.abs(np.diff(expected[5:-5], axis=0)).max()
    assert steepest > 1e-2 * np.abs(expected).max()  # a tick more or less would be seen


@pytest.mark.parametrize(("repeats", "delay"), [(4, 0.0), (9, 0.01)])
def test_what_is_kept_is_the_best_repeat(repeats, delay):
    """With drives that are late, nobody having said so, repeats first improve and then swing up."""
    found = learn(
        law, PROBLEM, ENGINE, PERIOD, repeats=repeats, bandwidth=80.0,
        around=lambda inner: around(delay, inner),
    )  # fmt: skip
    best = int(np.argmin(found.errors))
    assert found.errors[best] < found.errors[0]
    assert (best < len(found.errors) - 1) == bool(delay)
    assert error_of(found.forces, delay) == pytest.approx(found.errors[best], rel=1e-9)


def test_an_experiment_learns_with_the_delay_that_it_is_told():
    words = {"frequency": 2.0, "gravity": False, "delay": 0.02, "repeats": 3, "bandwidth": 80.0}
    found = run_trial(PLAN, "ilc", words, Disturbance()).learned
    expected = learn(
        law, PROBLEM, ENGINE, PERIOD, repeats=3, bandwidth=80.0, delay=0.02,
        around=lambda inner: around(0.02, inner),
    )  # fmt: skip
    np.testing.assert_allclose(found.errors, expected.errors, rtol=1e-9)
