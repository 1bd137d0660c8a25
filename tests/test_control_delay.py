"""Dead time compensated by prediction: the delay is outside the loop."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.controllers.basin import advance
from pantograph.controllers.design import closed_loop
from pantograph.controllers.design.law import loop_of
from pantograph.controllers.nominal import Nominal
from pantograph.controllers.trial import Disturbance, run_trial
from pantograph.sim import PantographError, Scene, make_plan
from pantograph.sim.compose import make_law
from pantograph.sim.control import Target
from strategies import seeds

T = 0.01
LAWS = {
    "pd": {"frequency": 4.0},
    "lqr": {"goal": {"hinge": 0.0}},
    "mpc": {"goal": {"hinge": 0.0}, "slew": 400.0},
    "computed-torque": {"frequency": 4.0},
}


MOVING = {"joint": "slide", "times": [0, 0.5, 1], "values": [0, 0.2, -0.1], "curve": "clamped"}


def cart(law="pd", keys=MOVING, **words):
    return make_plan(
        Scene(
            duration=1.0,
            models=[{"file": "cart_pole"}],
            roles={"tracked": ["slide"]},
            actuators={"*": "controller"},
            keys=[keys],
            physics={"contacts": "none", "limits": False},
            controller={"law": law, "period": T, **words},
            solver={"engine": "smooth"},
        )
    )


def go(law, words, late, x, ticks, start=0):
    """States of the cart-pole under a law behind ``late`` periods, from ``x`` at the tick ``start`` on."""
    problem = cart().problem
    made = make_law(law, problem, words | ({"delay": late * T, "predict": True} if late else {}), T)
    memory, nominal, path = made.start(), Nominal(problem.model), [x]
    low, high = problem.model.actuator_ctrlrange[0]
    for k in range(start, start + ticks):
        q, v = path[-1][:2], path[-1][2:]
        tau, memory = made(k * T, q, v, Target(*problem.clip.evaluate(k * T)), memory)
        tau = np.clip(tau, [low, 0.0], [high, 0.0])
        q, v = advance(nominal, q[None], v[None], tau[None], T / 2, 2)
        path.append(np.concatenate([q[0], v[0]]))
    return np.array(path)


@settings(max_examples=12)
@given(seed=seeds, late=st.integers(1, 5), law=st.sampled_from(sorted(LAWS)))
def test_with_an_exact_model_a_late_machine_moves_as_one_that_is_not(seed, late, law):
    """From when the first force arrives; unstable machines and forces at their limits included."""
    x = np.random.default_rng(seed).uniform(-1, 1, 4) * [0.2, 0.3, 1.0, 1.0]
    behind = go(law, LAWS[law], late, x, 40)
    prompt = go(law, LAWS[law], 0, behind[late], 40 - late, start=late)
    np.testing.assert_allclose(behind[late:], prompt, rtol=1e-6, atol=1e-6)


def test_beside_keyed_joints_and_along_keys():
    """The elbow of an arm whose shoulder is keyed to swing: six periods late, as good as at once."""
    scene = Scene(
        duration=1.0,
        models=[{"file": "planar_2r"}],
        roles={"tracked": ["elbow"]},
        actuators={"*": "off"},
        keys=[
            {"joint": "shoulder", "times": [0, 0.3, 1.0], "values": [-1.5, -0.2, -1.0], "curve": "natural"},
            {"joint": "elbow", "times": [0, 0.5, 1.0], "values": [0, 0.6, 0.2], "curve": "clamped"},
        ],
        physics={"contacts": "none", "friction": False, "limits": False},
        controller={"law": "computed-torque", "period": T},
        solver={"engine": "smooth", "step": T / 4},
    )
    plan = make_plan(scene)
    words = {"frequency": 4.0, "delay": 6 * T}
    prompt, late, rings = (
        run_trial(plan, "computed-torque", w, Disturbance()).error[60:]
        for w in ({"frequency": 4.0}, words | {"predict": True}, words)
    )
    assert np.abs(late).max() < 5e-5 + 2.0 * np.abs(prompt).max()
    assert np.abs(rings).max() > 0.05


def test_poles_of_a_predicted_loop_are_those_without_delay_and_zeros():
    words = {"goal": {"hinge": 0.0}}
    plan, late = cart("lqr", {"joint": "slide", "times": [0], "values": [0.1]}, **words), 3
    loops = [
        loop_of(plan, "lqr", words | extra, t=0.7) for extra in ({}, {"delay": late * T, "predict": True})
    ]
    poles = [np.linalg.eigvals(closed_loop(loop.system, loop.K).A) for loop in loops]
    assert [len(p) for p in poles] == [4, 4 + late]
    order = np.argsort(np.abs(poles[1]))
    assert np.abs(poles[1][order[:late]]).max() < 0.05  # a Jordan block of zeros, split by differences
    rest = poles[1][order[late:]]
    for pole in poles[0]:
        assert np.abs(rest - pole).min() < 2e-5  # gains by differences


def test_an_observer_knows_which_force_acted():
    """Forces three periods late, positions alone measured: velocities as they are."""
    problem = cart().problem
    words = {"goal": {"hinge": 0.0}, "delay": 3 * T, "predict": True, "observer": "extended", "noise": 1e-6}
    law, nominal = make_law("lqr", problem, words, T), Nominal(problem.model)
    memory, q, v, errors = law.start(), np.array([0.1, 0.1]), np.zeros(2), []
    for k in range(60):
        tau, memory = law(k * T, q, v, Target(*problem.clip.evaluate(k * T)), memory)
        errors.append(np.abs(memory.observer.v - v).max())
        q, v = (x[0] for x in advance(nominal, q[None], v[None], tau[None], T / 2, 2))
    assert max(errors[5:]) < 1e-3


def test_prediction_without_delay_is_nothing_and_mistakes_are_told(tmp_path):
    problem, x = cart().problem, np.array([0.1, 0.2, -0.3, 0.4])
    target = Target(*problem.clip.evaluate(0.2))
    laws = [make_law("pd", problem, words, T) for words in ({"predict": True}, {})]
    forces = [law(0.2, x[:2], x[2:], target, law.start())[0] for law in laws]
    np.testing.assert_array_equal(*forces)
    with pytest.raises(PantographError, match="predict must be true or false, got 'yes'"):
        make_law("pd", problem, {"predict": "yes", "delay": 0.02}, T)
    file = tmp_path / "learned.npz"
    np.savez(file, forces=np.zeros((100, 2)), period=T)
    with pytest.raises(PantographError, match="leave one of them out"):
        make_law("pd", problem, {"predict": True, "delay": 0.02, "learned": str(file)}, T)
    with pytest.raises(PantographError, match="what learns knows the delay already"):
        run_trial(cart(), "ilc", {"predict": True, "delay": 0.02}, Disturbance())
