import itertools
import re
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import Scene, SceneError, make_plan, run
from pantograph.sim.engines.interface import Drive, Role
from pantograph.sim.engines.smooth import width_of
from pantograph.sim.engines.stiffness import Look, fastest_rate, friction_width
from pantograph.sim.engines.touch import can_touch
from pantograph.sim.gain import gain_without_contacts
from pantograph.sim.needs import Needs

PENDULUM = {"models": [{"file": "pendulum"}]}
KEYED = {"keys": [{"joint": "hinge", "times": [0, 1], "values": [0, 1]}]}
BALL = {"name": "ball", "shape": "sphere", "size": [0.1], "position": [0, 0, 1]}
FLOOR = {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True}


def plan_of(**data):
    return make_plan(Scene(**{"duration": 1.0, **data}))


def test_no_dynamics_where_every_joint_is_keyed():
    plan = plan_of(**PENDULUM, **KEYED)
    assert plan.engine.what == "kinematic"
    assert "every joint is keyed" in plan.engine.why
    assert plan.integrator.what == "none"
    assert any(line.startswith("all dynamics") for line in plan.left_out)
    assert plan_of(props=[BALL, FLOOR]).engine.what == "contact"
    assert plan_of(**PENDULUM, **KEYED, solver={"engine": "contact"}).engine.what == "contact"
    assert "the scene asks" in plan_of(**PENDULUM, **KEYED, solver={"engine": "kinematic"}).engine.why


def test_every_joint_and_actuator_is_listed_under_what_moves_it():
    plan = plan_of(
        models=[{"file": "arm6"}],
        roles={"tracked": ["elbow", "wrist_*"]},
        keys=[{"joint": "waist", "times": [0], "values": [0]}],
        actuators={"shoulder": "keys"},
        controller={"law": "pd"},
    )
    assert plan.joints(Role.KEYED) == ("waist",)
    assert plan.joints(Role.TRACKED) == ("elbow", "wrist_pitch")
    assert plan.joints(Role.PASSIVE) == ("shoulder", "forearm_roll", "tool_roll")
    assert plan.actuators(Drive.KEYS) == ("shoulder",)
    assert plan.actuators(Drive.CONTROLLER) == ("elbow", "wrist_pitch")
    (idle,) = [line for line in plan.left_out if line.startswith("actuators that nothing drives")]
    assert idle == "actuators that nothing drives: waist, forearm_roll, tool_roll"


@pytest.mark.parametrize(
    ("top", "physics", "told"), [(1.4, {}, True), (1.19, {}, False), (1.4, {"limits": False}, False)]
)
def test_keys_that_limits_hold_back_are_told(top, physics, told):
    """The elbow's range ends at 1.2 rad; between its keys the curve stays below the highest."""
    plan = plan_of(
        models=[{"file": "arm6"}],
        roles={"tracked": ["elbow"]},
        keys=[{"joint": "elbow", "times": [0, 0.5, 1], "values": [0, top, 0]}],
        controller={"law": "pd"},
        physics=physics,
    )
    said = [line for line in plan.left_out if line.startswith("keys that joint limits")]
    assert said == (
        ["keys that joint limits do not let through: elbow 1.4 rad outside [-2.6, 1.2]"] if told else []
    )


periods = st.floats(1e-3, 0.05)


@given(periods, st.floats(0.03, 2.0))
@settings(max_examples=40)
def test_the_step_of_a_controlled_scene_divides_its_period(period, duration):
    plan = plan_of(duration=duration, roles={"tracked": ["hinge"]}, controller={"period": period}, **PENDULUM)
    h, own = plan.problem.step, 0.002
    assert plan.period == period
    assert period / h == pytest.approx(round(period / h), abs=1e-6)
    assert h <= own * (1 + 1e-6)
    assert h > own / 2 or h == pytest.approx(period)
    assert abs(plan.problem.steps * h - duration) <= h / 2


@given(st.floats(1e-4, 1.0))
@settings(max_examples=40)
def test_a_run_lasts_as_long_as_the_scene_says(duration):
    for scene in (Scene(duration=duration, **PENDULUM), Scene(duration=duration, **PENDULUM, **KEYED)):
        r = run(scene)
        assert r.t[0] == 0
        assert r.t[-1] == pytest.approx(duration, rel=1e-9)
        assert np.all(np.diff(r.t) > 0)


def test_a_step_that_the_scene_asks_for_is_taken_and_its_end_told():
    plan = plan_of(**PENDULUM, solver={"step": 0.3})
    assert plan.problem.step == 0.3
    assert "the run ends after whole steps, at 0.9 s" in plan.step.why
    assert run(plan).t[-1] == pytest.approx(0.9)
    assert plan_of(**PENDULUM, solver={"step": 0.25}).step.why == "the scene asks for it"
    exact = plan_of(
        **PENDULUM, roles={"tracked": ["hinge"]}, controller={"period": 0.003}, solver={"step": 1e-3}
    )
    assert exact.problem.step == 1e-3


@given(st.floats(1e-3, 0.1), st.floats(1e-3, 0.1))
@settings(max_examples=60)
def test_a_period_that_is_no_multiple_of_the_step_is_refused_with_both_and_what_would_do(period, step):
    data = {"roles": {"tracked": ["hinge"]}, **PENDULUM}
    scene = Scene(duration=1, controller={"period": period}, solver={"step": step}, **data)
    ratio = period / step
    if ratio > 0.5 and abs(ratio - round(ratio)) <= 1e-6:
        assert make_plan(scene).problem.step == step
        return
    with pytest.raises(SceneError, match=r"controller\.period: the controller's period") as error:
        make_plan(scene)
    text = str(error.value)
    assert f"{period:g} s" in text
    assert f"{step:g} s" in text
    for h in text.split("try a step of ")[1].replace(" s", "").split(" or "):
        ratio = period / float(h)
        assert ratio == pytest.approx(round(ratio), rel=1e-5)


def test_samples_are_as_many_as_asked_rounded_to_whole_steps():
    r = run(Scene(duration=1.0, rate=50, **PENDULUM))
    np.testing.assert_allclose(r.t, np.arange(51) * 0.02, atol=1e-12)
    assert len(run(Scene(duration=1.0, rate=1e6, **PENDULUM)).t) == 501


def spring_scene(tmp_path, joint, actuator="", **data):
    path = tmp_path / "spring.xml"
    path.write_text(
        f'<mujoco><option timestep="0.01"/><worldbody><body><joint name="x" type="slide" {joint}/>'
        f'<geom size="0.1" mass="4"/></body></worldbody><actuator>{actuator}</actuator></mujoco>'
    )
    return Scene(duration=1.0, models=[{"file": str(path)}], **data)


def test_the_fastest_rate_is_that_of_the_stiffest_spring_damper_or_servo(tmp_path):
    def rate(*args, **data):
        return Needs(make_plan(spring_scene(tmp_path, *args, **data)).setup).fastest

    assert rate("") == 0
    assert rate('stiffness="400"') == pytest.approx(10)
    assert rate('damping="8"') == pytest.approx(2)
    assert rate('springdamper="0.1 1"') == pytest.approx(10, rel=1e-2)
    servo = '<position joint="x" kp="100" gear="3"/>'
    assert rate("", servo) == 0  # nothing drives it
    assert rate("", servo, roles={"tracked": ["x"]}) == pytest.approx(15)
    keyed = [{"joint": "x", "times": [0], "values": [0]}]
    assert rate('stiffness="400"', keys=keyed) == 0


@given(st.integers(0, 2**32 - 1), st.sampled_from([1, 7, 60]))
@settings(max_examples=12)
def test_the_fastest_of_many_oscillators_is_found(seed, n):
    """Roots of m s^2 + c s + k, in closed form; a keyed one does not count."""
    rng, spec = np.random.default_rng(seed), mujoco.MjSpec()
    m, k, c = (10.0 ** rng.uniform(low, high, n + 1) for low, high in ((-1, 1), (0, 4), (-2, 2)))
    for i in range(n + 1):
        body = spec.worldbody.add_body()
        body.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, stiffness=[k[i], 0, 0], damping=[c[i], 0, 0])
        body.add_geom(size=[0.1, 0, 0], mass=m[i])
    model, moving = spec.compile(), np.arange(n + 1) > 0
    look = Look(rng.normal(size=n + 1), rng.normal(size=n + 1), np.zeros(0))
    exact = max(np.abs(np.roots([m[i], c[i], k[i]])).max() for i in range(1, n + 1))
    assert fastest_rate(model, [look], moving) == pytest.approx(exact, rel=5e-3)


CART = """<mujoco><worldbody><body><joint name="cart" type="slide" axis="1 0 0" frictionloss="{f}"/>
<geom size=".1" mass="1"/><body><joint name="pole" axis="0 1 0" frictionloss="2"/>
<geom size=".1" mass="3" pos="0 0 -.5"/></body></body></worldbody></mujoco>"""


@pytest.mark.parametrize("cart_keyed", [True, False])
def test_the_width_of_friction_is_that_of_what_moves(cart_keyed):
    """A pole of inertia J and moment h = 1.5 kg m: 1/J with the cart held, else 1/(J - h^2/M)."""
    model = mujoco.MjModel.from_xml_string(CART.format(f=0))
    J = 3 * (0.5**2 + 0.4 * 0.1**2)
    mobility = 1 / J if cart_keyed else 1 / (J - 1.5**2 / 4)
    moving = np.array([not cart_keyed, True])
    assert friction_width(model, np.zeros(2), moving, 0.02) == pytest.approx(2 * mobility * 0.02, rel=1e-6)
    # dry as well, the cart counts where it moves: the larger root of both together
    model = mujoco.MjModel.from_xml_string(CART.format(f=5))
    M, F = np.array([[4, -1.5], [-1.5, J]]), np.diag([5.0, 2.0])
    rate = 2 / J if cart_keyed else np.linalg.eigvals(np.linalg.solve(M, F)).max()
    assert friction_width(model, np.zeros(2), moving, 0.02) == pytest.approx(rate * 0.02, rel=1e-6)


STIFF = ("joint", "cubic", "damper", "tendon", "tendon damper", "servo", "tendon servo")


@st.composite
def stiff_models(draw):
    """Random trees out of their rest, one spring, damper or servo of any strength in them: the model, its
    state, and the energy that its springs and servos hold."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    stiff, strength = draw(st.sampled_from(STIFF)), 10.0 ** draw(st.floats(2.0, 7.0))
    spec, n = mujoco.MjSpec(), draw(st.integers(2, 4))
    spec.option.timestep, spec.option.gravity = 0.002, [0.0, 0.0, 0.0]
    bodies, tendon = [spec.worldbody], spec.add_tendon(name="t")
    q, arms = 0.1 * rng.normal(size=n), rng.normal(size=n)
    for i in range(n):
        body = bodies[draw(st.integers(0, i))].add_body(name=f"b{i}", pos=rng.normal(size=3) * 0.3)
        kind = mujoco.mjtJoint.mjJNT_SLIDE if draw(st.booleans()) else mujoco.mjtJoint.mjJNT_HINGE
        joint = body.add_joint(name=f"j{i}", type=kind, axis=rng.normal(size=3), stiffness=[1.0, 0.0, 0.0])
        tendon.wrap_joint(f"j{i}", arms[i])
        size = 0.05 + 0.1 * rng.random(3)
        body.add_geom(type=mujoco.mjtGeom.mjGEOM_BOX, size=size, contype=0, conaffinity=0)
        bodies.append(body)
    energy, length = 0.5 * q @ q, arms @ q
    if stiff == "joint":
        joint.stiffness[0] = strength
        energy += 0.5 * strength * q[-1] ** 2
    elif stiff == "cubic":
        joint.stiffness[2] = 100 * strength
        energy += 25 * strength * q[-1] ** 4
    elif stiff == "tendon":
        tendon.stiffness[0], tendon.springlength = strength, [0.0, 0.0]
        energy += 0.5 * strength * length**2
    elif "damper" in stiff:
        (tendon if "tendon" in stiff else joint).damping[0] = strength / 100
    else:
        servo = spec.add_actuator(name="servo", target="t", trntype=mujoco.mjtTrn.mjTRN_TENDON)
        if stiff == "servo":
            servo.target, servo.trntype = joint.name, mujoco.mjtTrn.mjTRN_JOINT
        servo.set_to_position(kp=strength, kv=0.01)
        servo.gear[0] = 3.0
        energy += 4.5 * strength * (length if "tendon" in stiff else q[-1]) ** 2
    return spec, q, energy


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("models")


@given(case=stiff_models())
@settings(max_examples=60)
def test_the_method_that_is_chosen_is_stable_at_its_step(folder, case):
    """Nothing can move faster than what its springs hold lets it: sum of v M v / 2 <= energy."""
    spec, q, energy = case
    spec.compile()
    file = folder / "model.xml"
    file.write_text(spec.to_xml())
    keys = [{"actuator": a.name, "times": [0], "values": [0]} for a in spec.actuators]
    start = {"position": {f"j{i}": x for i, x in enumerate(q)}}
    scene = Scene(duration=0.4, models=[{"file": str(file)}], keys=keys, initial=start)
    recording = run(scene)
    assert recording.status == "done", recording.message
    assert recording.kinetic.max() <= 1.1 * energy, make_plan(scene).integrator


def test_activations_that_no_step_follows_are_refused_with_what_would_do(tmp_path):
    def scene(kind="filter", **solver):
        motor = f'<general name="m" joint="x" dyntype="{kind}" dynprm="1e-4" gainprm="5"/>'
        keys = [{"actuator": "m", "times": [0, 1], "values": [0, 1]}]
        return spring_scene(tmp_path, "", motor, keys=keys, solver=solver, physics={"gravity": False})

    with pytest.raises(
        SceneError, match=r"'m' has a time constant of 0\.0001 s.*below 0\.0002 s.*not 0\.01 s"
    ):
        make_plan(scene())
    for words in ({"kind": "filterexact"}, {"step": 1e-4}, {"tolerance": 1e-6}):
        r = run(scene(**words))
        assert r.status == "done", r.message
        # a ramp, hardly late: v = 5 / 4 t^2 / 2, of which one step of the order 1 method may be missing
        assert r.v[-1, 0] == pytest.approx(5 / 4 / 2, rel=0.04)


def test_stiff_scenes_get_the_integrator_for_them(tmp_path):
    stiff, soft = (make_plan(spring_scene(tmp_path, f'stiffness="{k}"')) for k in ("1e6", "100"))
    assert stiff.integrator.what == "discrete"
    assert "stiff" in stiff.integrator.why
    assert soft.integrator.what == "rk4"
    assert run(stiff).status == "done"
    assert (
        plan_of(**PENDULUM, solver={"integrator": "euler", "engine": "contact"}).problem.integrator == "euler"
    )


@st.composite
def piles(draw):
    """Trees of spheres that all overlap, with random collision masks, exclusions and pairs."""
    bits = st.sampled_from([(0, 0), (1, 1), (1, 0), (0, 1), (2, 1)])
    spec = mujoco.MjSpec()
    bodies = [spec.worldbody]
    if draw(st.booleans()):
        a, b = draw(bits)
        spec.worldbody.add_geom(name="g0", size=[9, 0, 0], contype=a, conaffinity=b)
    for i in range(1, draw(st.integers(2, 5))):
        body = bodies[draw(st.integers(0, len(bodies) - 1))].add_body(name=f"b{i}")
        if draw(st.booleans()):
            body.add_joint(name=f"j{i}")
        a, b = draw(bits)
        body.add_geom(name=f"g{i}", size=[9, 0, 0], pos=[0, 0, 0.1 * i], contype=a, conaffinity=b)
        bodies.append(body)
    for x, y in itertools.combinations(range(1, len(bodies)), 2):
        if draw(st.integers(0, 3)) == 0:
            spec.add_exclude(bodyname1=f"b{x}", bodyname2=f"b{y}")
        if draw(st.integers(0, 9)) == 0:
            spec.add_pair(geomname1=f"g{x}", geomname2=f"g{y}")
    if draw(st.integers(0, 5)) == 0:
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    return spec.compile()


@given(piles())
@settings(max_examples=200)
def test_what_could_touch_is_what_mujoco_lets_touch(model):
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    assert can_touch(model) == (data.ncon > 0)


def test_what_is_left_out_is_told_with_its_reason():
    def told(*words, **physics):
        plan = plan_of(models=[{"file": "cart_pole"}], physics=physics)
        return [any(line.startswith(word) for line in plan.left_out) for word in words]

    words = ("contacts", "joint limits", "dry friction", "gravity")
    assert told(*words) == [False, False, False, False]
    assert told(*words, contacts="none") == [True, False, False, False]
    assert told(*words, contacts=[]) == [True, False, False, False]
    assert told(*words, limits=False) == [False, True, False, False]
    assert told(*words, friction=False) == [False, False, True, False]
    assert told(*words, gravity=False) == [False, False, False, True]
    assert told(*words, gravity=[0, 0, -1.6]) == [False, False, False, False]


def test_a_controller_with_nothing_to_control_is_told():
    def told(**data):
        plan = plan_of(**PENDULUM, controller={"law": "pd"}, **data)
        return any(line.startswith("the controller") for line in plan.left_out), plan.period

    assert told() == (True, None)
    assert told(roles={"tracked": ["hinge"]}) == (False, 0.002)
    assert plan_of(**PENDULUM, roles={"tracked": ["hinge"]}).period == 0.002


def test_what_would_be_cheaper_is_told_where_it_would():
    def cheaper(**data):
        return " | ".join(plan_of(**data).cheaper)

    touching = cheaper(props=[BALL, FLOOR])
    assert 'physics.contacts = "none"' in touching
    assert "discrete" in touching
    assert cheaper(props=[BALL]) == ""
    assert cheaper(props=[BALL, FLOOR], physics={"contacts": "none"}) == ""
    assert "2 times less" in cheaper(**PENDULUM, solver={"step": 0.001, "engine": "contact"})


def test_what_contacts_cost_is_measured_where_there_are_some():
    said = gain_without_contacts(plan_of(models=[{"file": "quadruped"}], duration=0.4))
    found = re.fullmatch(
        r'physics\.contacts = "none" takes ([\d.]+) times less time a simulated second: ([\d.]+) ms with the '
        r"smooth engine instead of ([\d.e+]+) ms \(measured over the first ([\d.]+) s\)",
        said,
    )
    times, less, cost, span = (float(x) for x in found.groups())
    assert times == pytest.approx(cost / less, rel=0.05) and span <= 0.4
    for none in (
        plan_of(**PENDULUM, **KEYED),
        plan_of(models=[{"file": "quadruped"}], physics={"contacts": "none"}),
        plan_of(models=[{"file": "quadruped"}], physics={"contacts": "none"}, solver={"engine": "contact"}),
    ):
        assert gain_without_contacts(none) is None
    # where the scene asks for the contact engine, its own gain is what is measured
    tied = plan_of(models=[{"file": "quadruped"}], solver={"engine": "contact"}, duration=0.1)
    said = gain_without_contacts(tied)
    assert "contact engine" in said or "nothing" in said


def test_joints_tied_to_keyed_ones_follow_them(tmp_path):
    path = tmp_path / "tied.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint name="a"/><geom size="0.1"/></body>'
        '<body pos="1 0 0"><joint name="b"/><geom size="0.1"/></body></worldbody>'
        '<equality><joint joint1="b" joint2="a" polycoef="0.1 2 0 0 0"/></equality></mujoco>'
    )
    keys = [{"joint": "a", "times": [0, 1], "values": [0, 1], "curve": "linear"}]
    plan = plan_of(models=[{"file": str(path)}], keys=keys)
    assert plan.setup.coupled == ("b",)
    assert plan.engine.what == "kinematic"
    r = run(plan)
    np.testing.assert_allclose(r.q[:, 1], 0.1 + 2 * r.t, atol=1e-12)


def test_switches_leave_the_model_as_filed_alone():
    plan = plan_of(
        models=[{"file": "cart_pole"}], physics={"contacts": "none", "limits": False, "gravity": False}
    )
    flags = mujoco.mjtDisableBit
    expected = flags.mjDSBL_CONTACT | flags.mjDSBL_LIMIT | flags.mjDSBL_GRAVITY
    assert plan.problem.model.opt.disableflags & expected == expected
    assert plan.setup.as_filed.opt.disableflags & expected == 0


@pytest.mark.parametrize(
    ("roles", "said"), [({"passive": ["*"]}, True), ({}, False), ({"tracked": ["elbow"]}, False)]
)
def test_keys_that_move_nothing_are_told(roles, said):
    keys = [{"joint": "elbow", "times": [0, 1], "values": [0, 1]}]
    left_out = make_plan(
        Scene(duration=1, models=[{"file": "double_pendulum"}], keys=keys, roles=roles)
    ).left_out
    assert ("keys of passive joints, but for where these start: elbow" in left_out) == said


def test_limits_of_balls_take_the_contact_engine(tmp_path):
    file = tmp_path / "ball.xml"
    file.write_text(
        '<mujoco><worldbody><body><joint type="ball" range="0 0.3" limited="true"/>'
        '<geom size="0.1" pos="0.3 0 0" contype="0" conaffinity="0"/></body></worldbody></mujoco>'
    )
    assert plan_of(models=[{"file": str(file)}]).engine.what == "contact"
    assert plan_of(models=[{"file": str(file)}], physics={"limits": False}).engine.what == "smooth"


def test_the_width_of_friction_stays_when_the_step_changes():
    plan = plan_of(models=[{"file": "arm6"}], physics={"contacts": "none"})
    assert plan.problem.friction_width == width_of(replace(plan.problem, step=plan.problem.step / 2)) > 0


ARM = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size=".02" pos=".3 0 0" mass="1"/>
  <body pos=".3 0 0"><joint name="b" {joint}/><geom size=".02" pos=".2 0 0.1" mass="1"/></body></body>
  </worldbody>
  <tendon><fixed name="rope"><joint joint="a" coef="1"/><joint joint="b" coef="1"/></fixed></tendon>
  <actuator><motor name="ma" joint="a"/>{actuator}</actuator></mujoco>"""
HINGE, BALL_JOINT = 'axis="0 1 0"', 'type="ball"'


def arm_with(folder, actuator, joint=HINGE, **data):
    text = ARM.format(actuator=actuator, joint=joint)
    text = text if joint == HINGE else text.replace('<joint joint="b" coef="1"/>', "")
    (folder / "arm.xml").write_text(text)
    models = [{"file": str(folder / "arm.xml")}]
    data = {"roles": {"tracked": ["a", "b"]}, "physics": {"contacts": "none"}, "duration": 0.02, **data}
    return Scene(**data, models=models)


@pytest.mark.parametrize(
    ("actuator", "joint", "said"),
    [
        ('<motor name="m" joint="b"/>', HINGE, None),
        ("", HINGE, None),
        (
            '<general name="m" joint="b" dyntype="filter" dynprm=".1" gainprm="1"/>',
            HINGE,
            "tracked joint 'b', instead of actuator 'm': no controller drives it, since it has activation",
        ),
        (
            '<muscle name="m" joint="b" lengthrange="0 1"/>',
            HINGE,
            "tracked joint 'b', instead of actuator 'm'",
        ),
        (
            '<motor name="m" tendon="rope"/>',
            HINGE,
            "tracked joint 'b', instead of actuator 'm': no controller drives it, since it does not act",
        ),
        (
            '<motor name="m" joint="b" gear="1 0 0"/><motor name="n" joint="b" gear="0 2 0"/>',
            BALL_JOINT,
            "tracked joint 'b', instead of actuators 'm', 'n': no controller drives it, since it acts on",
        ),
    ],
)
def test_tracked_joints_whose_drives_no_controller_uses_are_told(tmp_path, actuator, joint, said):
    scene = arm_with(tmp_path, actuator, joint, controller={"law": "pd"})
    notes = make_plan(scene).notes
    if said is None:
        assert notes == ()
        return
    (note,) = notes
    assert f"ideal forces without limit on {said}" in note
    assert note in run(scene).notes
    idle = [line for line in make_plan(scene).left_out if line.startswith("actuators that nothing")]
    assert len(idle) == 1


def test_a_drive_that_the_scene_switches_off_is_told(tmp_path):
    words = {"actuators": {"m": "off"}, "controller": {"law": "pd"}}
    (note,) = make_plan(arm_with(tmp_path, '<motor name="m" joint="b"/>', **words)).notes
    assert note.endswith("instead of actuator 'm': it is off; 'controller' in [actuators] uses it")


def test_a_keyed_tendon_is_no_servo_of_the_joint_of_its_number(tmp_path):
    """Tendon 0 is not joint 0: tracked joints still get their controller."""
    roles = {"tracked": ["a"]}
    keys = [{"actuator": "m", "times": [0], "values": [0]}]
    text = ARM.format(actuator='<motor name="m" tendon="rope"/>', joint=HINGE)
    (tmp_path / "arm.xml").write_text(text.replace('<motor name="ma" joint="a"/>', ""))
    models = [{"file": str(tmp_path / "arm.xml")}]
    plan = make_plan(Scene(duration=0.1, models=models, roles=roles, keys=keys))
    assert plan.period == 0.002
    (note,) = plan.notes
    assert "'a', instead of actuator 'm': keys drive it, since it does not act on one joint" in note


@pytest.mark.parametrize("law", ["lqr", "mpc", "nmpc"])
@pytest.mark.parametrize(
    ("start", "goal", "said"),
    [
        (0.0, None, None),
        (0.2, None, "'hinge' at 0.2 rad, as it starts, where it needs"),
        (0.2, 0.0, None),
        (3.14159265, None, None),
        (0.0, 0.3, "'hinge' at 0.3 rad, where it needs"),
    ],
)
def test_a_law_that_regulates_about_no_equilibrium_says_so(law, start, goal, said):
    """A pole falls from any angle but upright and hanging; the force is that of its weight by hand."""
    goals = {} if goal is None else {"goal": {"hinge": goal}}
    plan = plan_of(
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        initial={"position": {"hinge": start}},
        controller={"law": law, **goals},
    )
    assert len(plan.notes) == (said is not None)
    if said is not None:
        m = plan.setup.model
        pole = m.body(m.jnt_bodyid[m.joint("hinge").id]).id
        lever = m.body_mass[pole] * 9.81 * np.hypot(m.body_ipos[pole][0], m.body_ipos[pole][2])
        force = abs(lever * np.sin(start if goal is None else goal))
        assert f"{said} {force:.3g} N m but nothing drives it" in plan.notes[0]


def test_what_rests_on_springs_friction_or_servos_is_an_equilibrium(tmp_path):
    def notes(joint, drive="", **data):
        (tmp_path / "lift.xml").write_text(
            f"""<mujoco><worldbody><body><joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="1"/>
            <body pos="1 0 0"><joint name="z" type="slide" axis="0 0 1" {joint}/><geom size=".1" mass="2"/>
            </body></body></worldbody><actuator>{drive}</actuator></mujoco>"""
        )
        models = [{"file": str(tmp_path / "lift.xml")}]
        data = {"roles": {"tracked": ["x"]}, "controller": {"law": "lqr"}} | data
        return make_plan(Scene(duration=1.0, models=models, physics={"contacts": "none"}, **data)).notes

    (note,) = notes('damping="1"')
    assert "'z' at 0 m, as it starts, where it needs 19.6 N but nothing drives it" in note
    assert notes('stiffness="196.2" springref="0.1"') == ()
    assert notes('frictionloss="20"') == ()
    servo = {"actuators": {"p": "keys"}}
    assert notes("", '<position name="p" joint="z" kp="1000"/>', **servo) == ()
    assert notes('damping="1"', controller={"law": "pd"}) == ()
