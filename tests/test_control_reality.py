"""What loops know of keyed joints, encoders, drives and friction."""

import mujoco
import numpy as np
import pytest
from pantograph.controllers.drives import at_speed, by_speed
from pantograph.controllers.nominal import Nominal
from pantograph.controllers.observers import Kalman
from pantograph.controllers.predictive.linear import MPC
from pantograph.controllers.reality import Loop
from pantograph.models import load_model
from pantograph.sim import PantographError, Scene, make_plan, run
from pantograph.sim.compose import make_law
from pantograph.sim.control import Target


class Always:
    """The same forces."""

    def __init__(self, tau):
        self.tau = np.array(tau, dtype=float)

    def start(self):
        return None

    def __call__(self, t, q, v, target, memory):
        return self.tau, None


def slide(force=1.0, joint=""):
    limit = f'ctrlrange="-{force} {force}"' if np.isfinite(force) else ""
    return f"""<mujoco><option gravity="0 0 0"/><worldbody><body name="b">
      <joint name="x" type="slide" axis="1 0 0" {joint}/><geom size=".1" mass="1"/></body></worldbody>
      <actuator><motor name="m" joint="x" {limit}/></actuator></mujoco>"""


# ---- observers


def two_links(observer, tracked):
    return Scene(
        duration=0.6,
        models=[{"file": "planar_2r"}],
        roles={"tracked": tracked},
        actuators={"*": "off"},
        keys=[
            {"joint": "shoulder", "times": [0, 0.3, 0.6], "values": [0, 1, 0], "curve": "clamped"},
            {"joint": "elbow", "times": [0, 0.3, 0.6], "values": [0.5, 0, 0.5], "curve": "clamped"},
        ],
        physics={"contacts": "none", "friction": False},
        controller={"law": "computed-torque", "period": 0.002, "observer": observer, "encoder": 65536},
    )


@pytest.mark.parametrize("tracked", [["shoulder", "elbow"], ["elbow"]])
def test_an_observer_beside_keyed_joints_is_as_good_as_without(tracked):
    plan = make_plan(two_links("extended", tracked))
    recording = run(plan)
    error = (recording.q - plan.problem.clip.evaluate(recording.t).q)[:, 1]
    assert np.sqrt(np.mean(error**2)) < 1e-3


@pytest.mark.parametrize("extended", [True, False])
def test_predictions_know_how_keyed_joints_move(extended):
    """A pendulum (measured badly) on a joint that is shaken: what the model says of it, from an exact start.
    About rest the model is linear: small motions."""
    model, T, steps = load_model("double_pendulum"), 0.002, 150
    model.opt.gravity[:] = 0.0
    told = np.array([True, False])
    smooth = Nominal(model).smooth_with(told)
    size, w = (0.5 if extended else 0.02), 8.0

    def shaken(t):
        s, c = np.sin(w * t), np.cos(w * t)
        return size * np.stack([s, w * c, -w * w * s], axis=-1)

    path = smooth.rollout([0.0], [0.0], step=T, steps=steps, w=lambda t: shaken(np.asarray(t)))
    kalman = Kalman(model, np.zeros(2), told, noise=10.0, push=1e-9, extended=extended)
    memory = kalman.start()._replace(P=np.zeros((2, 2)))
    for k in range(steps + 1):
        q, v, a = shaken(k * T)
        target = Target(np.array([q, 0.0]), np.array([v, 0.0]), np.array([a, 0.0]))
        memory = kalman.update(memory, k * T, np.array([q, path.q[k, 0]]), np.zeros(2), target)
        assert memory.q[0] == q
        assert memory.v[0] == v
    moved = np.abs(path.v).max()
    assert moved > 1.5 * size
    # halfway accelerations, taken to change evenly, err by (w T)^2 / 8 of themselves
    assert abs(memory.v[1] - path.v[-1, 0]) < ((w * T) ** 2 / 8 if extended else 2e-2) * moved


def test_an_observer_knows_what_the_motor_gave_and_not_what_friction_left():
    model = load_model("pendulum")
    loop = Loop(Always([0.2]), model, np.array([True]), model.qpos0, 0.01, friction=0.15, observer="extended")
    target = Target(model.qpos0, np.zeros(1), np.zeros(1))
    _, memory = loop(0.0, np.array([0.1]), np.array([1.0]), target, loop.start())
    assert memory.applied[0] == 0.2


def test_encoders_of_slides_count_metres_and_noise_can_be_told():
    model = load_model("cart_pole")  # a slide and a hinge
    made = [np.array([True, False]), model.qpos0, 0.01]
    loop = Loop(Always([0, 0]), model, *made, observer="kalman", encoder=1000)
    np.testing.assert_allclose(loop.observer.noise, np.array([1e-3, 2e-3 * np.pi]) / np.sqrt(12))
    loop = Loop(Always([0, 0]), model, *made, observer="kalman", noise={"slide": 0.1}, push=3.0)
    np.testing.assert_allclose(loop.observer.noise, [0.1, 1e-4])
    np.testing.assert_allclose(loop.observer.push, 3.0)


# ---- drives


def test_predicted_forces_are_those_that_a_motor_can_give_at_speed():
    """A cart that has a metre to go, with a motor that has none left at 1 m/s."""
    scene = Scene(
        models=[{"file": "cart_pole"}],
        duration=1.5,
        roles={"tracked": ["slide"]},
        keys=[
            {"joint": "slide", "times": [0, 1.5], "values": [0.0, 0.8], "curve": "clamped"},
            {"joint": "hinge", "times": [0], "values": [np.pi]},
        ],
        initial={"position": {"slide": -0.3}},
        physics={"limits": False},
    )
    problem, used = make_plan(scene).problem, 0.0
    law = make_law("mpc", problem, {"top_speed": 1.0, "position": 1e4}, 0.01)
    drives, memory = law.drives, law.start()
    for k in range(100):
        q, v = np.array([-0.3 + 0.006 * k, np.pi]), np.array([0.6 + 0.003 * k, 0.0])
        target = Target(*problem.clip.evaluate(0.01 * k))
        _, memory = law(0.01 * k, q, v, target, memory)
        asked = memory.law.u[0]
        low, high = (limit[0] for limit in drives.at(v))
        assert low - 1e-9 <= asked <= high + 1e-9
        used = max(used, asked / high)
    assert used > 0.999


def test_what_motors_lose_at_speed_has_the_slope_of_its_differences():
    low, high, top = np.array([-3.0]), np.array([2.0]), np.array([1.5])
    for v in np.linspace(-2.0, 2.0, 12):  # between the bends at 0 and 1.5
        slopes = by_speed(low, high, top, np.array([v]))
        ends = [at_speed(low, high, top, np.array([v + s])) for s in (1e-6, -1e-6)]
        for slope, plus, minus in zip(slopes, *ends, strict=True):
            assert slope[0] == pytest.approx((plus - minus)[0] / 2e-6, abs=1e-8)


@pytest.mark.parametrize("word", ["friction", "play", "top_speed"])
def test_what_drives_do_at_joints_without_drives_is_refused(word):
    model = load_model("cart_pole")
    with pytest.raises(PantographError, match=f"{word} of 'hinge' has no effect: .* tracked: slide"):
        Loop(Always([0, 0]), model, np.array([True, False]), model.qpos0, 0.01, **{word: {"hinge": 1.0}})


@pytest.mark.parametrize("law", ["pd", "pid"])
def test_gains_of_joints_that_are_not_tracked_are_refused(law):
    scene = Scene(models=[{"file": "cart_pole"}], duration=1.0, roles={"tracked": ["slide"]})
    with pytest.raises(PantographError, match="kp of 'hinge' has no effect"):
        make_law(law, make_plan(scene).problem, {"kp": {"hinge": 3.0}})


def test_the_integral_runs_back_to_what_the_loop_lets_through():
    """A drive of 1 N m, or a tenth of one of 10: integrals end alike; likewise at speed."""
    xml = """<mujoco><worldbody><body><joint name="j" axis="0 1 0"/><geom size=".1" mass="1"/></body>
      </worldbody><actuator><motor joint="j" forcerange="-{0} {0}"/></actuator></mujoco>"""
    still = Target(np.array([2.0]), np.zeros(1), np.zeros(1))

    def integral(force, **words):
        model = mujoco.MjModel.from_xml_string(xml.format(force))
        scene = Scene(models=[{"file": "pendulum"}], duration=1.0, roles={"tracked": ["hinge"]})
        problem = make_plan(scene).problem
        own = {"kp": 1.0, "ki": 4.0, "kd": 0.0, "windup": 0.1, "feedforward": "none"}
        law = make_law("pid", problem, own | words, 0.01, model=model)
        memory = law.start()
        for k in range(300):
            _, memory = law(0.01 * k, np.zeros(1), np.array([0.5]), still, memory)
        return getattr(memory, "law", memory).integral[0]

    assert integral(10.0, saturation=0.1) == pytest.approx(integral(1.0))
    assert integral(2.0, top_speed=1.0) == pytest.approx(integral(1.0))


def test_predictions_know_what_the_loop_lets_through():
    model = load_model("cart_pole")
    scene = Scene(models=[{"file": "cart_pole"}], duration=1.0, roles={"tracked": ["slide"]})
    problem = make_plan(scene).problem
    assert make_law("nmpc", problem, {"top_speed": 0.8}, 0.01).law.shooting.weights.top == [0.8]
    for law in ("mpc", "nmpc"):
        made = make_law(law, problem, {"saturation": 0.25}, 0.01).law
        limit = made.high if isinstance(made, MPC) else made.shooting.weights.high
        assert limit[0] == pytest.approx(0.25 * model.actuator_ctrlrange[0, 1])


@pytest.mark.parametrize("engine", ["smooth", "contact"])
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_friction_acts_beside_a_drive_at_its_limit(tmp_path, engine, way):
    """1 kg, a motor of 1 N and 0.5 N of friction: -1.5 m/s in a second of braking, 0.5 of driving."""
    (tmp_path / "slide.xml").write_text(slide())

    def change(**words):
        scene = Scene(
            duration=1.0,
            models=[{"file": str(tmp_path / "slide.xml")}],
            roles={"tracked": ["x"]},
            keys=[{"joint": "x", "times": [0], "values": [100.0 * way]}],
            initial={"position": {"x": 0.0}, "velocity": {"x": 3.0}},
            controller={"law": "pd", "period": 0.002, **words},
            solver={"engine": engine},
        )
        recording = run(scene)
        return recording.v[-1, 0] - recording.v[0, 0]

    assert change() == pytest.approx(way, abs=1e-6)
    assert change(friction=0.5) == pytest.approx(way - 0.5, abs=1e-6)
