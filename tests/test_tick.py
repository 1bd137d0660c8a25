"""A controller's ticks in machine code: the same motion as when Python samples the law, whatever happens."""

from __future__ import annotations

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.controllers.gains import force_limits
from pantograph.controllers.ilc import Fed
from pantograph.sim.clip import Clip
from pantograph.sim.compose import make_law
from pantograph.sim.control import Sampled, controlled_actuators
from pantograph.sim.curves import keyed
from pantograph.sim.engines import tick as ticks
from pantograph.sim.engines.common import Broken
from pantograph.sim.engines.contact import ContactEngine
from pantograph.sim.engines.interface import Drive, Problem, Role, State
from pantograph.sim.engines.smooth import SmoothEngine
from pantograph.sim.engines.smooth_run import Run
from pantograph.sim.engines.tick import tick_of

KINDS = {
    "hinge": mujoco.mjtJoint.mjJNT_HINGE,
    "slide": mujoco.mjtJoint.mjJNT_SLIDE,
    "ball": mujoco.mjtJoint.mjJNT_BALL,
}
LAWS = [
    ("pd", {}),
    ("pd", {"gravity": False, "damping": 0.5}),
    ("pid", {}),
    ("pid", {"feedforward": "full", "frequency": 3.0}),
    ("pid", {"feedforward": "none", "windup": 0.05}),
    ("computed-torque", {}),
    ("lqr", {}),
    ("lqr", {"final": 0.5}),
    ("pd", {"encoder": 4096, "delay": 0.004, "observer": "filter", "corner": 80.0}),
    ("pid", {"backlash": 0.002, "observer": "filter", "encoder": 20000}),
    ("computed-torque", {"delay": 0.003, "backlash": 0.001}),
]


@pytest.fixture(autouse=True, scope="module")
def _worth_it():
    """Compile ticks of the shortest runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ticks, "WORTH", 0)
        yield


class Unknown:
    """A law that is no expression: the one inside it, as Python calls it."""

    def __init__(self, law):
        self.law, self.lost = law, getattr(law, "lost", None)

    def start(self):
        return self.law.start()

    def __call__(self, t, q, v, target, memory):
        return self.law(t, q, v, target, memory)


def random_machine(
    seed, *, joints=("hinge", "slide", "ball", "free"), narrow=False, moving=True, motors=False
):
    """A random tree with joints of every role, motors and servos on some of the tracked ones."""
    rng, spec = np.random.default_rng(seed), mujoco.MjSpec()
    bodies, tracks, roles, driven = [spec.worldbody], {}, [], []
    bend = rng.choice([0.036, 0.037])  # at a tick and between two
    for i in range(int(rng.integers(1, 5))):
        parent = bodies[rng.integers(0, len(bodies))]
        kind = str(rng.choice(joints)) if parent is not spec.worldbody else str(rng.choice(joints[:-1]))
        kind = "hinge" if kind == "free" else kind
        body = parent.add_body(name=f"b{i}", pos=rng.normal(size=3) * 0.3)
        role = int(rng.choice([Role.TRACKED, Role.TRACKED, Role.KEYED, Role.PASSIVE])) if i else Role.TRACKED
        role = Role.TRACKED if kind == "ball" and role == Role.KEYED else role
        scalar = kind != "ball"
        ranged = {"range": [-0.2, 0.25] if kind == "slide" else [-11.0, 14.0], "limited": True}
        body.add_joint(
            name=f"j{i}", type=KINDS[kind], axis=rng.normal(size=3), damping=[0.05, 0, 0],
            stiffness=[float(rng.choice([0.0, 2.0])), 0, 0], armature=float(rng.choice([0.0, 0.02])),
            **(ranged if narrow and scalar and role != Role.KEYED else {}),
        )  # fmt: skip
        if role != Role.PASSIVE and scalar:
            kinds = ["clamped", "natural"] if role == Role.TRACKED or not moving else ["clamped", "linear"]
            values = [[0.0], [0.3 * rng.normal()], [0.1]] if moving else [[0.1]] * 3
            tracks[f"j{i}"] = keyed([0.0, bend, 0.1], values, kind=str(rng.choice(kinds)))
        if role == Role.TRACKED and scalar and (motors or rng.random() < 0.6):
            act = spec.add_actuator(name=f"a{i}", target=f"j{i}", trntype=mujoco.mjtTrn.mjTRN_JOINT)
            act.gear[0] = rng.choice([1.0, -2.5])
            act.gainprm[0] = 3.0
            if not motors and rng.random() < 0.5:  # a servo, whose bias the controller has to overcome
                act.biastype = mujoco.mjtBias.mjBIAS_AFFINE
                act.biasprm[:3] = [0.1, -3.0, -0.2]
            if motors or rng.random() < 0.6:
                act.ctrlrange, act.ctrllimited = [-0.8, 0.5], True
            driven.append(Drive.CONTROLLER)
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_BOX, size=0.05 + 0.1 * rng.random(3), contype=0, conaffinity=0
        )
        bodies.append(body)
        roles.append(role)
    model = spec.compile()
    q = np.array(model.qpos0)
    clip = Clip(model, tracks, q)
    start, v = clip.evaluate(0.0), 0.5 * rng.normal(size=model.nv)
    q[clip.qpos_mask], v[clip.dofs] = start.q[clip.qpos_mask], start.v[clip.dofs]
    return Problem(
        model=model, state0=State(q, v, np.zeros(0)), duration=0.101, roles=np.array(roles, dtype=np.int8),
        clip=clip, integrator="rk4", step=0.001, sample_every=7, drives=np.array(driven, dtype=np.int8),
    )  # fmt: skip


def both(problem, law, words, *, period=0.003, engine=SmoothEngine):
    """Segments with ticks in machine code and with ticks in Python."""
    made, span = make_law(law, problem, dict(words), period), (0.0, problem.duration)
    return [engine().run(problem, span, Sampled(x, problem, period)) for x in (made, Unknown(made))]


def assert_alike(ours, theirs, tolerance=1e-9):
    assert ours.status == theirs.status == "done"
    np.testing.assert_array_equal(ours.t, theirs.t)
    np.testing.assert_array_equal(ours.tick_t, theirs.tick_t)
    scale = 1 + np.abs(theirs.v).max() ** 2
    for name in ("q", "v", "tick_ctrl", "tick_qfrc"):
        force = 1 + np.abs(getattr(theirs, name)).max(initial=0.0)
        np.testing.assert_allclose(
            getattr(ours, name), getattr(theirs, name), atol=tolerance * scale * force, err_msg=name
        )


@pytest.mark.parametrize(("law", "words"), LAWS)
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32 - 1))
def test_machine_code_gives_the_forces_of_the_law(law, words, seed):
    problem = random_machine(seed)
    assert tick_of(Sampled(make_law(law, problem, dict(words), 0.003), problem, 0.003), 1.0) is not None
    assert_alike(*both(problem, law, words))
    assert_alike(*both(problem, law, words, engine=ContactEngine))


@pytest.mark.parametrize(("law", "words"), LAWS[2:6:3])
@settings(max_examples=4)
@given(seed=st.integers(0, 2**32 - 1))
def test_steps_that_follow_a_tolerance_sample_alike(law, words, seed):
    problem = dataclasses.replace(random_machine(seed), tolerance=1e-9, integrator="dopri5")
    assert_alike(*both(problem, law, words), tolerance=1e-8)


@pytest.mark.parametrize("tolerance", [None, 1e-10])
@pytest.mark.parametrize("law", ["pd", "pid"])
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32 - 1))
def test_limits_met_between_ticks_and_the_memory_after_them(law, tolerance, seed):
    """Narrow limits: runs go on from events under what is held, with the memory of the tick before."""
    problem = random_machine(seed, joints=("hinge", "slide", "free"), narrow=True)
    problem = dataclasses.replace(
        problem, tolerance=tolerance, integrator="dopri5", state0=problem.state0._replace(
            v=np.where(problem.dofs(Role.KEYED), problem.state0.v, 4.0 * problem.state0.v)
        )
    )  # fmt: skip
    ours, theirs = both(problem, law, {})
    assert [e.what for e in ours.events] == [e.what for e in theirs.events]
    assert_alike(ours, theirs, tolerance=1e-7)


def test_a_loop_that_blows_up_is_told_at_the_same_time():
    problem = random_machine(5, joints=("hinge", "hinge"))
    problem = dataclasses.replace(problem, duration=3.0)
    ours, theirs = both(problem, "pd", {"kp": 1e5, "kd": 0.0})
    assert ours.status == theirs.status == "diverged"
    assert ours.message == theirs.message
    np.testing.assert_array_equal(ours.t, theirs.t)
    np.testing.assert_array_equal(ours.tick_t, theirs.tick_t)


class Spoilt:
    """Forces that are no number from a tick on, in both forms of the law."""

    def __init__(self, law, since):
        self.law, self.since = law, since

    def start(self):
        return None

    def __call__(self, t, q, v, target, memory):
        tau, _ = self.law(t, q, v, target, None)
        return tau + (np.nan if t > self.since else 0.0), None

    def formula(self, period):
        inner = self.law.formula(period)

        def rows(first, targets):
            out = inner.rows(first, targets)
            out[period * (first + np.arange(len(out))) > self.since] = np.nan
            return out

        return dataclasses.replace(inner, rows=rows)


@pytest.mark.parametrize(
    ("engine", "tolerance"), [(SmoothEngine, None), (SmoothEngine, 1e-6), (ContactEngine, None)]
)
def test_forces_that_are_no_numbers_end_the_run_with_the_joints_name(engine, tolerance):
    problem = random_machine(5, joints=("hinge", "hinge"))
    integrator = "rk4" if tolerance is None else "dopri5"
    problem = dataclasses.replace(problem, tolerance=tolerance, integrator=integrator)
    law = Spoilt(make_law("pd", problem, {}, 0.003), 0.05)
    with pytest.raises(Broken, match=r"failed at t = 0\.051 s: .* no finite force for joint 'j\d'") as broken:
        engine().run(problem, (0.0, problem.duration), Sampled(law, problem, 0.003))
    assert broken.value.segment.t[-1] == pytest.approx(0.051)


@pytest.mark.parametrize(
    ("law", "words"),
    [
        ("pd", {"top_speed": 1.0, "saturation": 0.5}),
        ("pid", {"top_speed": 0.7}),
        ("pd", {"top_speed": 1.5, "observer": "filter"}),
    ],
)
@settings(max_examples=3)
@given(seed=st.integers(0, 2**32 - 1))
def test_motors_that_give_less_at_speed(law, words, seed):
    problem = random_machine(seed, joints=("hinge", "slide", "free"), motors=True)
    assert tick_of(Sampled(make_law(law, problem, dict(words), 0.003), problem, 0.003), 1.0) is not None
    assert_alike(*both(problem, law, words))


def test_learned_forces_are_added_a_tick_at_a_time():
    problem, period = random_machine(8), 0.003
    rows = np.random.default_rng(0).normal(size=(20, problem.model.nv))  # fewer than the run has ticks
    law = Fed(make_law("pid", problem, {}, period), rows, period)
    span = (0.0, problem.duration)
    assert_alike(
        *(SmoothEngine().run(problem, span, Sampled(x, problem, period)) for x in (law, Unknown(law)))
    )


@pytest.mark.parametrize(
    "words",
    [{"observer": "kalman"}, {"play": 0.01}, {"friction": 0.1}, {"delay": 0.006, "predict": True}],
)
def test_what_is_no_expression_is_sampled_by_python(words):
    problem = random_machine(5, joints=("hinge", "hinge"))
    problem.model.dof_armature[:] = 0.02
    assert tick_of(Sampled(make_law("pd", problem, dict(words), 0.003), problem, 0.003), 1.0) is None
    ours, theirs = both(problem, "pd", words)
    np.testing.assert_array_equal(ours.q, theirs.q)


def test_encoders_of_keyed_joints_play_no_part():
    machines = (random_machine(seed) for seed in range(99))
    problem = next(m for m in machines if (m.roles == Role.KEYED).any() and len(m.roles) > 2)
    assert_alike(*both(problem, "pd", {"encoder": 100, "backlash": 0.01, "observer": "filter"}))


def test_an_interrupt_leaves_no_tick_after_the_last_state(monkeypatch):
    problem, kept = random_machine(5, joints=("hinge", "hinge")), Run.keep
    seen = []

    def keep(self, *state):
        seen.append(state)
        if len(seen) == 9:
            raise KeyboardInterrupt
        kept(self, *state)

    monkeypatch.setattr(Run, "keep", keep)
    law = make_law("pd", problem, {}, 0.003)
    ours = SmoothEngine().run(problem, (0.0, problem.duration), Sampled(law, problem, 0.003))
    assert ours.status == "interrupted"
    assert ours.tick_t[-1] <= ours.t[-1] < problem.duration


def test_a_servo_along_keys_gets_no_help_from_the_controller():
    """Of two tracked hinges one has a servo that follows its keys: only the other is the law's."""
    xml = """<mujoco><worldbody>
      <body name="a"><joint name="a" axis="0 1 0"/><geom size="0.1" mass="1" pos="0.3 0 0"/>
        <body pos="0.6 0 0"><joint name="b" axis="0 1 0"/><geom size="0.1" mass="1" pos="0.3 0 0"/></body>
      </body></worldbody><actuator><position name="s" joint="b" kp="50" kv="5"/></actuator></mujoco>"""
    model = mujoco.MjModel.from_xml_string(xml)
    clip = Clip(model, {j: keyed([0.0, 0.1], [[0.0], [0.2]], kind="clamped") for j in "ab"}, model.qpos0)
    tracked = np.full(2, Role.TRACKED, dtype=np.int8)
    problem = Problem(
        model=model, state0=State(model.qpos0, np.zeros(2), np.zeros(0)), duration=0.1, roles=tracked,
        clip=clip, integrator="rk4", step=0.001, sample_every=10,
        drives=np.array([Drive.KEYS], dtype=np.int8), servo={0: lambda t: clip.evaluate(t).q[:, 1]},
    )  # fmt: skip
    ours, theirs = both(problem, "pd", {})
    assert_alike(ours, theirs)
    assert np.abs(ours.tick_qfrc[:, 0]).min() > 0 and not ours.tick_qfrc[:, 1].any()


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32 - 1))
def test_actuators_of_one_joint_share_its_force_as_they_can(seed):
    """Together they give what is asked for, up to all that all of them can."""
    rng, spec = np.random.default_rng(seed), mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_joint(name="j", type=mujoco.mjtJoint.mjJNT_HINGE)
    body.add_geom(size=[0.1, 0, 0], pos=[0.1, 0, 0])
    for k in range(int(rng.integers(1, 4))):
        act = spec.add_actuator(name=f"a{k}", target="j", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        act.gear[0], act.gainprm[0] = rng.choice([-20.0, 1.0, 3.0]), rng.choice([1.0, 2.5])
        act.ctrlrange, act.ctrllimited = (
            rng.choice([[0.0, 1.0], [-0.5, 1.0], [-2.0, 2.0]]),
            rng.random() < 0.8,
        )
        act.forcerange, act.forcelimited = [-0.4, 1.5], rng.random() < 0.3
    model = spec.compile()
    low, high = force_limits(model)
    asked = rng.normal() * 10 ** rng.uniform(-1, 2)
    data = mujoco.MjData(model)
    actuators = controlled_actuators(model, np.full(model.nu, Drive.CONTROLLER, dtype=np.int8))
    data.ctrl[:] = actuators.ctrl_for(np.array([asked]), data.qpos, data.qvel)
    mujoco.mj_forward(model, data)
    np.testing.assert_allclose(data.qfrc_actuator, np.clip(asked, low, high), rtol=1e-12)


def test_compiled_ticks_share_it_alike():
    problem = random_machine(5, joints=("hinge", "hinge"), motors=True)
    spec = mujoco.MjSpec()
    body = spec.worldbody.add_body()
    body.add_joint(name="j", type=mujoco.mjtJoint.mjJNT_HINGE, axis=[0, 1, 0])
    body.add_geom(size=[0.1, 0, 0], pos=[0.1, 0, 0])
    for gear in (20.0, -20.0, 3.0):
        act = spec.add_actuator(target="j", trntype=mujoco.mjtTrn.mjTRN_JOINT)
        act.gear[0], act.ctrlrange, act.ctrllimited = gear, [0.0, 1.0], True
    model = spec.compile()
    clip = Clip(model, {"j": keyed([0.0, 0.05, 0.1], [[0.0], [0.3], [0.0]], kind="clamped")}, model.qpos0)
    problem = dataclasses.replace(
        problem, model=model, clip=clip, roles=np.array([Role.TRACKED], dtype=np.int8),
        state0=State(np.zeros(1), np.zeros(1), np.zeros(0)),
        drives=np.full(3, Drive.CONTROLLER, dtype=np.int8),
    )  # fmt: skip
    ours, theirs = both(problem, "pd", {})
    assert_alike(ours, theirs)
    assert (ours.tick_ctrl[:, :2] > 0).any(axis=0).all()  # pushed both ways
