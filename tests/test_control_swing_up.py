"""Swing-up: what energy shaping promises, what the catch holds, and arrivals in the engines."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.controllers.basin import Basin, Catch, advance, comes_home, map_basin
from pantograph.controllers.gains import force_limits
from pantograph.controllers.nominal import Nominal
from pantograph.controllers.swing_up import SwingUp
from pantograph.models import load_model
from pantograph.sim import PantographError, Scene, SceneError, make_plan, run
from strategies import seeds

FORCE = 0.5 * 0.7 * 9.81


def cart_law(**words):
    model = load_model("cart_pole")
    model.actuator_ctrlrange[0] = [-FORCE, FORCE]
    return SwingUp(model, np.array([True, False]), model.qpos0, 0.01, **words)


def acrobot_law(**words):
    model = load_model("acrobot")
    return SwingUp(model, np.array([False, True]), model.qpos0, 0.01, **words)


CART, ACROBOT = cart_law(foresight=6.0, tries=24), acrobot_law()


def test_goals_are_upright():
    np.testing.assert_array_equal(CART.shaping.goal, [0, 0])
    np.testing.assert_array_equal(ACROBOT.shaping.goal, [np.pi, 0])
    assert ACROBOT.shaping.lift == pytest.approx(2 * 9.81 * 3)
    assert CART.shaping.lift == pytest.approx(2 * 0.2 * 9.81 * 0.3)
    assert 1 / CART.shaping.mobility == pytest.approx(0.7 - (0.2 * 0.3) ** 2 / (0.006 + 0.2 * 0.3**2))


@given(seeds)
@settings(max_examples=20)
def test_energy_shaping_makes_its_function_fall(seed):
    """V' = -kv v_a^2 exactly, wherever the shaped force is in use and no limit cuts it."""
    rng = np.random.default_rng(seed)
    law = ACROBOT
    q, v = rng.uniform(-np.pi, np.pi, (30, 2)), 3 * rng.normal(size=(30, 2))
    gains = np.tile(np.array([[2.0, 0.5, 3.0, 0.0]]), (30, 1))
    a, smooth = law.a, law.nominal.smooth
    x = law.shaping.catch[0].state(q, v)[:, a]
    tau = law.shaping.push(q, v, x, gains)
    w, zeta, weight, _ = gains[0]
    kd = law.shaping.lift * weight / law.shaping.mobility
    acc = smooth.forward(q, v, tau=tau)
    energy = np.add(*smooth.energy(q, v)) - law.shaping.top
    rate = energy * tau[:, a] * v[:, a] + kd * v[:, a] * acc[:, a] + kd * w**2 * x * v[:, a]
    c = np.linalg.inv(smooth.mass_matrix(q))[:, a, a]
    shaped = kd * c + energy > 0.05 * kd * c
    expected = -2 * zeta * w * kd * v[:, a] ** 2
    assert shaped.sum() > 3
    np.testing.assert_allclose(rate[shaped], expected[shaped], rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@pytest.mark.parametrize("law", [CART, ACROBOT])
def test_the_catch_holds_what_it_takes(law):
    """Fresh random states at the level: nearly all come home although forces are cut."""
    catch, level = law.shaping.catch
    rng, n = np.random.default_rng(99), 2
    root = np.linalg.cholesky(np.linalg.inv(catch.regulator.P))
    x = rng.normal(size=(300, 2 * n))
    x = np.sqrt(level) * (x / np.linalg.norm(x, axis=1)[:, None]) @ root.T
    q, v = law.shaping.goal + x[:, :n], x[:, n:]
    np.testing.assert_allclose(catch.value(catch.state(q, v)), level, rtol=1e-6)
    home = comes_home(catch, q, v, (law.low, law.high), seconds=30 / law.shaping.rate)
    assert home.mean() > 0.85
    far = comes_home(
        catch,
        law.shaping.goal + 6 * x[:, :n],
        6 * x[:, n:],
        (law.low, law.high),
        seconds=30 / law.shaping.rate,
    )
    assert far.mean() < home.mean()


def test_angles_count_modulo_a_turn():
    catch, _ = ACROBOT.shaping.catch
    q, v = np.array([0.3 + np.pi, -0.2]), np.array([0.1, 0.4])
    for turns in ([2, -4], [-2, 0]):
        x = catch.state(q + np.pi * np.array(turns), v)
        np.testing.assert_allclose(x, catch.state(q, v), atol=1e-12)


@given(st.floats(1e-3, 5e-3))
@settings(max_examples=5)
def test_advance_is_the_engines_motion(step):
    nominal = Nominal(load_model("double_pendulum"))
    q, v, tau = (
        np.array([[2.0, -1.0], [0.3, 0.4]]),
        np.array([[0.5, 1.0], [-1.0, 2.0]]),
        np.array([[1.0, -2.0]] * 2),
    )
    got = advance(nominal, q, v, tau, step, 10)
    fine = advance(nominal, q, v, tau, step / 8, 80)
    for a, b in zip(got, fine, strict=True):
        np.testing.assert_allclose(a, b, atol=20 * (8 * step) ** 4)


def scene(file, tracked, position, duration, **words):
    return Scene(
        duration=duration,
        models=[{"file": file}],
        roles={"tracked": [tracked]},
        keys=[{"joint": tracked, "times": [0], "values": [0]}],
        initial={"position": position},
        controller={"law": "swing-up", "period": 0.01, **words},
    )


def test_a_cart_pole_of_the_scene_stands_up_and_stays():
    """In the engine, with its own limits, from hanging; the model's drive is stronger than the bench's."""
    recording = run(scene("cart_pole", "slide", {"hinge": 3.0}, 8.0, foresight=5.0, tries=16))
    late = recording.t > 5.0
    angle = np.mod(recording.q[late, 1] + np.pi, 2 * np.pi) - np.pi
    assert np.abs(angle).max() < 0.1
    assert np.abs(recording.q[:, 0]).max() < 1.0


def test_weak_carts_stand_up_from_anywhere():
    law, rng = CART, np.random.default_rng(0)
    q, v = np.zeros((12, 2)), rng.uniform(-1, 1, (12, 2))
    q[:, 1] = rng.uniform(-np.pi, np.pi, 12)
    memory, worst = law.begin(12), 0.0
    for tick in range(1500):
        tau, memory = law.batch(q, v, memory)
        assert np.abs(tau).max() <= FORCE * (1 + 1e-12)
        q, v = advance(law.nominal, q, v, tau, 0.002, 5)
        worst = max(worst, np.abs(q[:, 0]).max())
        if tick > 1000:
            assert np.abs(law.shaping.catch[0].state(q, v)[:, 1]).max() < 0.2
    assert worst < 1.0


def test_what_the_catch_would_drive_off_the_rail_it_gets_later():
    """A heavy pole beside upright on a short rail: within the catch's level, and with too little rail."""
    model = load_model("cart_pole")
    model.body_mass[-1], model.body_inertia[-1] = 2 * model.body_mass[-1], 2 * model.body_inertia[-1]
    mujoco.mj_setConst(model, mujoco.MjData(model))
    limit = 0.5 * 9.81 * model.body_mass.sum()
    model.actuator_ctrlrange[0], model.jnt_range[0] = [-limit, limit], [-0.2, 0.2]
    law = SwingUp(model, np.array([True, False]), model.qpos0, 0.01)
    start = np.array([[-0.11, 0.22]]), np.array([[-0.07, -0.66]])
    catch, level = law.shaping.catch
    assert catch.value(catch.state(*start))[0] < level
    (q, v), worst = start, 0.0
    for _ in range(100):
        tau = np.clip(catch.force(catch.state(q, v)), law.low, law.high)
        q, v = advance(law.nominal, q, v, tau, 0.001, 10)
        worst = max(worst, abs(q[0, 0]))
    assert worst > 0.2
    (q, v), memory = start, law.begin(1)
    for _ in range(500):
        tau, memory = law.batch(q, v, memory)
        q, v = advance(law.nominal, q, v, tau, 0.001, 10)
        assert abs(q[0, 0]) < 0.2
    assert np.abs(catch.state(q, v)).max() < 0.05


def test_one_machine_does_what_it_does_in_a_batch():
    """Also where gains alone do not arrive within the foresight, so that forces are added to them."""
    law, rng = acrobot_law(foresight=2.0, tries=4), np.random.default_rng(2)
    q, v = rng.normal(size=(3, 2)), rng.normal(size=(3, 2))
    together, memory = [], law.begin(3)
    alone, memories = [], [law.start() for _ in range(3)]
    for _ in range(5):
        tau, memory = law.batch(q, v, memory)
        together.append(tau)
        rows = [law(0.0, q[i], v[i], None, memories[i]) for i in range(3)]
        alone.append([r[0] for r in rows])
        memories = [r[1] for r in rows]
        q, v = advance(law.nominal, q, v, tau, 0.005, 2)
    assert np.abs(memory.intent.extra).max() > 0.0
    np.testing.assert_allclose(alone, together, atol=1e-9)


def test_what_is_foreseen_comes_true():
    """Machines that do as intended arrive when the look ahead says, in another integration of the motion."""
    law, rng = ACROBOT, np.random.default_rng(8)
    q, v = rng.uniform(-np.pi, np.pi, (4, 2)), rng.uniform(-1, 1, (4, 2))
    intent = law.intend(q, v, 0, law.begin(4).intent)
    home, _, _, _ = law.foresee(q, v, intent, 0, np.arange(4))
    foreseen = np.isfinite(home)
    assert foreseen.sum() >= 2
    q, v, intent, home = q[foreseen], v[foreseen], intent.of(foreseen), home[foreseen]
    caught, first = np.zeros(len(q), dtype=bool), np.full(len(q), np.inf)
    for tick in range(1000):
        tau, caught, value = law.force(q, v, intent, tick, caught)
        first = np.where(caught & (value < 0.1 * law.shaping.catch[1]), np.minimum(first, tick), first)
        q, v = advance(law.nominal, q, v, tau, law.period / 8, 8)
    np.testing.assert_allclose(first, home, atol=30)
    assert np.abs(law.shaping.catch[0].state(q, v)[:, :2]).max() < 0.5


def looks_of(law, monkeypatch):
    """Ticks at which a law looks ahead, in a list that goes on growing."""
    seen, intend = [], law.intend

    def watched(q, v, tick, before):
        seen.append(tick)
        return intend(q, v, tick, before)

    monkeypatch.setattr(law, "intend", watched)
    return seen


@pytest.mark.parametrize("kick", [0.0, 0.5])
def test_a_machine_on_its_way_as_foreseen_needs_no_new_look(kick, monkeypatch):
    """In another integration of the motion; one that was pushed off its way is looked at again."""
    law = cart_law(foresight=6.0, tries=24, every=0.5)
    looks = looks_of(law, monkeypatch)
    q, v, memory = np.array([[0.0, np.pi - 0.1]]), np.zeros((1, 2)), law.begin(1)
    for tick in range(600):
        tau, memory = law.batch(q, v, memory)
        q, v = advance(law.nominal, q, v, tau, 0.001, 10)
        if tick == 70:
            v = v + kick
    assert memory.caught.all()
    assert looks[: 1 + bool(kick)] == ([0, 100] if kick else [0])
    if not kick:
        assert looks == [0]


def test_what_was_asked_before_a_run_is_known_when_it_begins(monkeypatch):
    law = cart_law(foresight=6.0, tries=24)
    looks = looks_of(law, monkeypatch)
    q, v = np.array([0.0, 3.0]), np.zeros(2)
    forces = [law(0.0, q, v, None, law.start())[0] for _ in range(3)]
    assert looks == [0]
    np.testing.assert_array_equal(forces[0], forces[2])
    law(0.0, q + 0.01, v, None, law.start())
    assert looks == [0, 0]


def test_the_basin_of_a_double_pole_lies_around_upright():
    model = load_model("cart_double_pole")
    tracked = np.array([True, False, False])
    nominal, limits = Nominal(model), force_limits(model)
    catch = Catch(nominal, tracked, np.zeros(3), 0.005, reach=0.1, speed=1.0)
    basin = map_basin(catch, limits, (1, 2), (1.2, 1.2), points=21, seconds=5.0)
    assert basin.home[10, 10]
    np.testing.assert_array_equal(basin.home, basin.home[::-1, ::-1])  # the machine is symmetric
    assert not basin.home[0].any()
    assert 0.1 < basin.area < 2.4**2
    x, y = np.linspace(-1, 1, 201), np.linspace(-0.6, 0.6, 121)
    disc = Basin(x, y, np.hypot(*np.meshgrid(x, y)) <= 0.5)
    assert disc.area == pytest.approx(np.pi * 0.25, rel=2e-3)
    weak = map_basin(catch, (limits[0] / 8, limits[1] / 8), (1, 2), (1.2, 1.2), points=21, seconds=5.0)
    assert weak.area < basin.area


def machine(kind, rng, force=1.0):
    """A pendulum of random size behind a driven arm about the vertical (furuta), a driven shoulder (pendubot)
    or with a driven wheel at its end (wheel): its law; ``force`` as part of an ample one."""
    long, other = np.exp(rng.uniform(np.log(0.12), np.log(0.6), 2))
    m, n = np.exp(rng.uniform(np.log(0.05), np.log(0.5), 2))
    first, last = {
        "furuta": ("0 0 1", "1 0 0"),
        "pendubot": ("0 1 0", "0 1 0"),
        "wheel": ("0 1 0", "0 1 0"),
    }[kind]
    link = f"{other} 0 0" if kind == "furuta" else f"0 0 {-other}"
    tip = f'type="capsule" fromto="0 0 0 0 0 {-long}" size=".008"'
    if kind == "wheel":
        tip = f'type="cylinder" size="{0.4 * other} .01" euler="90 0 0"'
    torque = force * 9.81 * {"furuta": m * long, "pendubot": (m + n) * other, "wheel": m * other / 2}[kind]
    driven = "far" if kind == "wheel" else "near"
    model = mujoco.MjModel.from_xml_string(
        f"""<mujoco><option><flag contact="disable"/></option><worldbody>
        <body><joint name="near" axis="{first}" damping="1e-4"/>
        <geom type="capsule" fromto="0 0 0 {link}" size=".01" mass="{n}"/>
        <body pos="{link}"><joint name="far" axis="{last}"/><geom {tip} mass="{m}"/></body></body>
        </worldbody><actuator>
        <motor joint="{driven}" ctrllimited="true" ctrlrange="{-torque} {torque}"/>
        </actuator></mujoco>"""
    )
    tracked = np.array([kind != "wheel", kind == "wheel"])
    return SwingUp(model, tracked, model.qpos0, 0.01, foresight=6.0, tries=32)


@pytest.mark.parametrize("kind", ["furuta", "pendubot", "wheel"])
@given(seeds)
@settings(max_examples=3)
def test_every_machine_has_a_basin(kind, seed):
    """It holds at least half of where forces are not cut, and what starts there comes home, in much time."""
    rng = np.random.default_rng(seed)
    law = machine(kind, rng, force=rng.uniform(0.5, 2.0))
    catch, level = law.shaping.catch
    root = np.linalg.cholesky(np.linalg.inv(catch.regulator.P))
    uncut = law.shaping.spare / np.linalg.norm(catch.regulator.K @ root)
    assert level > 0.25 * uncut**2
    x = rng.normal(size=(60, 4))
    x = 0.7 * np.sqrt(level) * (x / np.linalg.norm(x, axis=1)[:, None]) @ root.T
    q, v = law.shaping.goal + x[:, :2], x[:, 2:]
    assert comes_home(catch, q, v, (law.low, law.high), seconds=10.0).mean() > 0.9


@pytest.mark.parametrize("kind", ["furuta", "pendubot", "wheel"])
def test_pendulums_behind_arms_and_wheels_stand_up(kind):
    law = machine(kind, np.random.default_rng(4))
    q, v = np.array([[0.0, 0.0], [0.4, 2.6], [-2.0, 1.0]]), np.zeros((3, 2))
    memory = law.begin(3)
    for _ in range(1200):
        tau, memory = law.batch(q, v, memory)
        q, v = advance(law.nominal, q, v, tau, 0.005, 2)
    assert memory.caught.all()
    assert np.abs(law.shaping.catch[0].state(q, v)).max() < 0.3


def test_a_run_that_ends_uncaught_or_wound_up_says_so():
    law = cart_law(foresight=0.0)
    q, v, memory = np.array([0.0, np.pi]), np.zeros(2), law.start()
    for _ in range(20):
        _, memory = law(0.0, q, v, None, memory)
    (said,) = law.remarks(q, memory)
    assert "not caught at the goal (slide = 0, hinge = 0) within 0.2 s" in said
    held = memory._replace(caught=np.array([True]))
    assert law.remarks(np.zeros(2), held) == ()
    law = machine("furuta", np.random.default_rng(4))
    (said,) = law.remarks(law.shaping.goal - np.array([4 * np.pi - 0.1, 0.0]), held)
    assert "'near' is held 2 turns from its goal" in said


def test_a_drive_that_cannot_hold_the_goal_is_told_at_the_start():
    model = load_model("cart_pole")
    model.actuator_ctrlrange[0] = [0.0, FORCE]
    law = SwingUp(model, np.array([True, False]), model.qpos0, 0.01)
    with pytest.raises(PantographError, match=r"hold the goal \(slide = 0, hinge = 0\).* gives 0 to 3\.4"):
        law.start()


def test_goals_lie_in_the_ranges_of_their_joints():
    model = load_model("acrobot")
    model.jnt_limited[:] = True
    model.jnt_range[:] = [[-4.0, 0.5], [-1.0, 1.0]]
    law = SwingUp(model, np.array([False, True]), model.qpos0, 0.01)
    np.testing.assert_array_equal(law.shaping.goal, [-np.pi, 0.0])
    model.jnt_range[1] = [0.5, 1.0]
    with pytest.raises(PantographError, match="neither 0 nor a half turn is in the range of elbow"):
        _ = SwingUp(model, np.array([False, True]), model.qpos0, 0.01).shaping.goal


def test_what_cannot_swing_up_is_told():
    with pytest.raises(SceneError, match="exactly one tracked joint, got 2"):
        make_plan(
            Scene(
                duration=1.0,
                models=[{"file": "double_pendulum"}],
                roles={"tracked": ["shoulder", "elbow"]},
                controller={"law": "swing-up"},
            )
        )
    with pytest.raises(SceneError, match="set the actuator's ctrlrange"):
        make_plan(scene("double_pendulum", "elbow", {}, 1.0).model_copy(update={"actuators": {"*": "off"}}))
