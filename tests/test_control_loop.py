"""Linear loops with the memory of their laws, unstable ones, and pictures of slow ones."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.controllers import cli
from pantograph.controllers.design import LinearSystem, closed_loop, figures, held, margins
from pantograph.controllers.design.law import loop_of
from pantograph.controllers.nominal import Nominal
from pantograph.sim import PantographError, Scene, make_plan, run
from pantograph.sim.compose import make_law
from pantograph.sim.control import Target
from scipy import linalg
from strategies import seeds

SLIDE = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide" axis="1 0 0"/>
  <geom size=".1" mass="2"/></body></worldbody></mujoco>"""


def sliding(tmp_path, law, duration=1.0, **words):
    """A body of 2 kg on a slide, at rest 1 mm from where it belongs."""
    (tmp_path / "slide.xml").write_text(SLIDE)
    return Scene(
        duration=duration,
        models=[{"file": str(tmp_path / "slide.xml")}],
        roles={"tracked": ["x"]},
        keys=[{"joint": "x", "times": [0], "values": [0]}],
        initial={"position": {"x": 1e-3}},
        controller={"law": law, "period": 0.02, **words},
    )


def poles_of(scene, words):
    found, K, *_ = loop_of(make_plan(scene), scene.controller.law, words)
    return np.sort_complex(linalg.eigvals(closed_loop(found, K).A)), found


def same(found, expected):
    """Poles, of which rounding may split equal ones."""
    order = [int(np.argmin(np.abs(expected - p))) for p in found]
    assert len(found) == len(expected)
    np.testing.assert_allclose(found, expected[order], atol=1e-5)
    assert sorted(order) == list(range(len(expected)))


@pytest.mark.parametrize("ki", [0.0, 40.0, 4000.0])
def test_a_pid_loop_has_its_integral_and_its_filter_as_states(tmp_path, ki):
    """States x, v, I, v_f: u = -kp x + I - kd (E v_f + (1 - E) v), E = exp(-2 pi f T), by hand."""
    kp, kd, T, m, f = 60.0, 18.0, 0.02, 2.0, 6.0
    words = {"kp": kp, "ki": ki, "kd": kd, "filter": f, "feedforward": "none", "windup": 1.0}
    E = np.exp(-2 * np.pi * f * T)
    u = np.array([-kp, -kd * (1 - E), 1.0, -kd * E])
    by_hand = np.array([[1, T, 0, 0], [0, 1, 0, 0], [-ki * T, 0, 1, 0], [0, 1 - E, 0, E]])
    by_hand[:2] += np.outer([T * T / 2 / m, T / m], u)
    scene = sliding(tmp_path, "pid", **words)
    found, system = poles_of(scene, words)
    expected = linalg.eigvals(by_hand if ki else np.delete(np.delete(by_hand, 2, 0), 2, 1))
    same(found, np.asarray(expected, dtype=complex))
    assert system.states[2:] == (("integral x", "velocity x") if ki else ("velocity x",))


def test_an_integral_that_is_too_large_is_told_as_what_it_does(tmp_path):
    """The loop that is told to be unstable grows in simulation, the other one settles."""
    for ki, stable in ((100.0, True), (3000.0, False)):
        words = {"kp": 60.0, "ki": ki, "kd": 18.0, "filter": 6.0, "feedforward": "none"}
        scene = sliding(tmp_path, "pid", 6.0, **words)
        found, K, *_ = loop_of(make_plan(scene), "pid", words)
        assert margins(found, K).stable == stable
        last = np.abs(run(scene).q[-50:, 0]).max()
        assert (last < 1e-3) == stable


def test_a_delay_is_part_of_the_loop(tmp_path):
    """Forces d ticks late are d states: poles of z^d det(z - A) + ..., by the companion form."""
    T, kp, kd, m = 0.02, 60.0, 18.0, 2.0
    words = {"kp": kp, "kd": kd, "delay": 2 * T, "gravity": False}
    found, system = poles_of(sliding(tmp_path, "pd", **words), words)
    A = np.zeros((4, 4))
    A[:2, :2], A[:2, 2] = [[1, T], [0, 1]], [T * T / 2 / m, T / m]
    A[2, 3] = 1.0
    A[3, :2] = [-kp, -kd]
    same(found, np.asarray(linalg.eigvals(A), dtype=complex))
    assert len(system.states) == 4


def test_an_unstable_loop_has_no_margins():
    plant = LinearSystem(np.array([[0, 1.0], [9.81, 0]]), np.array([[0.0], [1.0]]), ("x", "v"), ("u",))
    for s in (plant, held(plant, 0.01)):
        weak, strong = margins(s, [[5.0, 2.0]]), margins(s, [[30.0, 10.0]])
        assert (weak.stable, weak.gain) == (False, (1.0, 1.0))
        assert weak.phase == weak.delay == weak.disk == 0.0
        assert strong.stable
        assert strong.disk > 0.1
        assert "unstable" in figures.bode(s, [[5.0, 2.0]]).get_suptitle()
        chart = figures.step(s, [[5.0, 2.0]], 0)
        assert chart.axes[0].get_title() == "unstable"
        assert chart.axes[0].lines[0].get_xdata()[-1] <= 2.0


def test_a_loop_that_drifts_is_not_unstable():
    """A body that nothing holds beside one that is held: a double pole at the edge, split by rounding."""
    A, B = np.zeros((4, 4)), np.zeros((4, 1))
    A[0, 2] = A[1, 3] = 1.0
    B[3, 0], B[2, 0] = 1.0, 0.3
    found = margins(held(LinearSystem(A, B, ("a", "b", "a rate", "b rate"), ("b",)), 0.01), [[0, 9, 0, 6]])
    assert found.stable
    assert found.phase > 0.5


@pytest.mark.parametrize("slow", [1.0, 1e-3])
def test_a_step_of_any_length_is_drawn_with_few_samples(slow):
    """x' = -slow x + u sampled at 1 kHz: a picture of hours would have millions."""
    s = held(LinearSystem(np.array([[-slow]]), np.eye(1), ("x",), ("x",)), 1e-3)
    line = figures.step(s, [[0.0]], 0).axes[0].lines[0]
    t, y = line.get_data()
    assert len(t) < 1300
    assert t[-1] == pytest.approx(6.0 / slow, rel=0.01)
    np.testing.assert_allclose(t / 1e-3, np.round(t / 1e-3), atol=1e-6)
    np.testing.assert_allclose(y, (1 - np.exp(-slow * t)) / slow, rtol=1e-7, atol=1e-9)


def test_what_the_step_does_not_show_does_not_stretch_its_picture():
    s = held(LinearSystem(np.diag([-2.0, 0.0]), np.eye(2), ("x", "y"), ("x", "y")), 1e-3)
    t = figures.step(s, np.zeros((2, 2)), 0).axes[0].lines[0].get_xdata()
    assert t[-1] == pytest.approx(3.0, rel=0.01)


def test_the_command_tells_unstable_loops(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "slide.xml").write_text(SLIDE)
    Path("slide.toml").write_text(
        """duration = 1.0
[[models]]
file = "slide.xml"
[roles]
tracked = ["x"]
[controller]
law = "pid"
period = 0.02
kp = 60.0
kd = 18.0
ki = 9000.0
"""
    )
    cli.gains(Path("slide.toml"))
    said = capsys.readouterr().out
    assert "unstable" in said
    assert "NO" in said
    assert {p.suffix for p in Path("out").iterdir()} == {".png"}


CART = """duration = 1.0
[[models]]
file = "cart_pole"
[roles]
tracked = ["slide"]
[initial.position]
hinge = 0.2
[controller]
law = "lqr"
period = 0.01
velocity = 2.0
goal = {hinge = 0.0}
delay = 0.02
observer = "filter"
"""


@pytest.mark.parametrize(
    ("law", "told"),
    [
        ("", {"velocity", "goal", "delay", "observer"}),
        ("lqr", {"velocity", "goal", "delay", "observer"}),
        ("mpc", {"velocity", "goal", "delay", "observer"}),
        ("pd", {"delay", "observer"}),
    ],
)
def test_another_law_is_told_what_the_scene_says_of_its_task_and_its_loop(tmp_path, monkeypatch, law, told):
    monkeypatch.chdir(tmp_path)
    Path("cart.toml").write_text(CART)
    heard = {}

    def spy(plan, law, words, **more):
        heard.update(words)
        return loop_of(plan, law, words, **more)

    monkeypatch.setattr("pantograph.controllers.design.law.loop_of", spy)
    cli.gains(Path("cart.toml"), law=law)
    assert set(heard) == told
    assert {word: heard[word] for word in ("delay", "observer")} == {"delay": 0.02, "observer": "filter"}


def cart(law, **words):
    return Scene(
        duration=1.0,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        initial={"position": {"hinge": 3.0}},
        controller={"law": law, "period": 0.02, **words},
    )


def test_the_loop_of_a_swing_up_is_the_one_that_its_catch_closes():
    """It holds the pole up: stable about the goal, by the gains that it applies there."""
    plan = make_plan(cart("swing-up"))
    system, K, says, alone = loop_of(plan, "swing-up", {"delay": 0.01})
    assert "about the goal, where the catch holds" in says
    assert "left out of the loop: delay" in says
    assert margins(system, K).stable
    assert not margins(alone, np.zeros((1, 4))).stable
    made, tiny = make_law("swing-up", plan.problem, {}, plan.period), 1e-5 * np.array([1.0, -2.0, 3.0, 1.0])
    goal = made.shaping.goal
    tau, _ = made(0.0, goal + tiny[:2], tiny[2:], Target(goal, np.zeros(2), np.zeros(2)), made.start())
    assert tau[0] == pytest.approx(-(K @ tiny)[0], rel=1e-6)


def test_a_law_that_plans_has_no_linear_loop_but_does_what_lqr_does():
    scene = cart("nmpc", goal={"hinge": 0.0})
    plan = make_plan(scene)
    with pytest.raises(PantographError, match="'nmpc' has no linear loop: it plans anew"):
        loop_of(plan, "nmpc", {})
    made = make_law("nmpc", plan.problem, {"goal": {"hinge": 0.0}, "step": 0.02}, 0.02)
    _, K, *_ = loop_of(plan, "lqr", {"goal": {"hinge": 0.0}})
    for x in 1e-4 * np.eye(4):
        now = Target(*made.clip.evaluate(0.0))
        tau, _ = made(0.0, x[:2], x[2:], now, made.start())
        assert tau[0] == pytest.approx(-(K @ x)[0], rel=0.02)


def test_a_loop_without_gain_is_drawn_without_warnings(recwarn):
    s = held(LinearSystem(np.array([[-1.0]]), np.eye(1), ("x",), ("x",)), 0.01)
    figures.bode(s, [[0.0]]).canvas.draw()
    assert not [w for w in recwarn if issubclass(w.category, RuntimeWarning)]


def test_the_command_says_what_no_force_holds_before_it_says_margins(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("cart.toml").write_text(CART.replace("goal = {hinge = 0.0}", ""))
    cli.gains(Path("cart.toml"))
    said = capsys.readouterr().out
    assert said.startswith("note: law 'lqr' regulates about 'hinge' at 0.2 rad, as it starts")
    cli.gains(Path("cart.toml"), law="pd")
    assert "note" not in capsys.readouterr().out


def test_the_command_looks_at_its_folder_before_it_works(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(PantographError, match=r"cannot write into .*file: .*name another folder"):
        cli.gains(tmp_path / "no-scene.toml", out=tmp_path / "file")


def neck(n, heights, rng):
    """n joints on one spot, as of a neck that carries a head: each drags all others along."""
    axes = rng.normal(size=(n, 3))
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    text, close = "", ""
    for i, axis in enumerate(axes):
        text += f"""<body pos="0 0 {0.01 * i}"><joint name="j{i}" axis="{axis[0]} {axis[1]} {axis[2]}"
          damping=".02"/><geom size=".01" mass=".05"/>"""
        close += "</body>"
    text += f'<geom type="box" size=".06 .09 .05" pos=".02 0 {heights}" mass="2"/>'
    return f"<mujoco><worldbody>{text}{close}</worldbody></mujoco>"


@given(seeds, st.integers(1, 3), st.sampled_from([-0.3, 0.1, 0.3, 0.6]), st.sampled_from([0.3, 1.0, 2.0]))
@settings(max_examples=30, deadline=None)
def test_gains_that_a_pid_law_chooses_are_stable(tmp_path_factory, seed, n, height, damping):
    """Also above their joints, where weight pulls away, and of joints that drag each other along."""
    path = tmp_path_factory.mktemp("neck") / "neck.xml"
    path.write_text(neck(n, height, np.random.default_rng(seed)))
    scene = Scene(
        duration=1.0,
        models=[{"file": str(path)}],
        roles={"tracked": ["j*"]},
        physics={"contacts": "none"},
        controller={"law": "pid", "period": 0.001, "damping": damping},
    )
    system, K, *_ = loop_of(make_plan(scene), "pid", {"damping": damping})
    assert margins(system, K).stable


def test_a_pid_law_of_one_joint_that_hangs_has_the_gains_of_a_pd_law():
    words = {"duration": 1.0, "models": [{"file": "pendulum"}], "roles": {"tracked": ["hinge"]}}
    problem = make_plan(Scene(**words)).problem
    pd, pid = (make_law(law, problem, {}) for law in ("pd", "pid"))
    np.testing.assert_allclose([pid.kp, pid.kd], [pd.kp, pd.kd])
    np.testing.assert_allclose(pid.ki, pid.kp * np.pi)
    up = make_plan(Scene(**words, initial={"position": {"hinge": np.pi}})).problem
    weight = Nominal(up.model).weight(np.array([np.pi / 2]))
    np.testing.assert_allclose(make_law("pid", up, {}).kp - pd.kp, np.abs(weight), rtol=1e-6)
