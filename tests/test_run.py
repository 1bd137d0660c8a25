import _thread
import dataclasses
import gc
import sys
import threading
import time

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import EngineError, RunError, Scene, load, load_scene, make_plan, run
from scenes import numbers, scenes

FALL = {"duration": 2.0, "models": [{"file": "double_pendulum"}], "initial": {"position": {"shoulder": 2.0}}}
TRACKED = {
    "duration": 1.0,
    "models": [{"file": "arm6"}],
    "roles": {"tracked": ["elbow", "wrist_pitch"]},
    "keys": [
        {"joint": "waist", "times": [0, 0.4, 1], "values": [0, 1, 0.3]},
        {"joint": "elbow", "times": [0, 0.5, 1], "values": [0.4, 1, 0.4]},
    ],
}
SAMPLED = ("t", "q", "v", "a", "tau", "ctrl", "kinetic", "potential", "normal")


def test_a_scene_its_plan_and_its_file_run_alike(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text('duration = 0.1\n[[models]]\nfile = "pendulum"\n[initial.position]\nhinge = 1\n')
    scene = Scene(duration=0.1, models=[{"file": "pendulum"}], initial={"position": {"hinge": 1}})
    runs = [run(path), run(str(path)), run(scene), run(make_plan(scene))]
    for r in runs:
        np.testing.assert_array_equal(r.q, runs[0].q)
        assert r.status == "done"
        assert Scene(**r.scene) == scene


def test_a_file_is_resolved_once(tmp_path, monkeypatch):
    from pantograph.sim.scene import build

    path = tmp_path / "scene.toml"
    path.write_text('duration = 0.1\n[[models]]\nfile = "pendulum"\n')
    calls, real = [], build.assemble
    monkeypatch.setattr(build, "assemble", lambda scene: calls.append(scene) or real(scene))
    run(path)
    make_plan(path)
    load_scene(path)
    assert len(calls) == 3


@given(scenes())
@settings(max_examples=15)
def test_two_runs_are_equal_to_the_last_bit(data):
    one, two = run(Scene(**data)), run(Scene(**data))
    for name in (*SAMPLED, "tick_t", "tick_ctrl", "tick_qfrc"):
        np.testing.assert_array_equal(getattr(one, name), getattr(two, name))
    assert one.events == two.events


@given(st.sampled_from([FALL, {**FALL, "solver": {"engine": "contact"}}, TRACKED]), st.integers(1, 200))
@settings(max_examples=25)
def test_an_interrupted_run_keeps_the_beginning_of_the_whole_one(tmp_path_factory, data, calls):
    whole = run(Scene(**data))
    left = calls

    def progress(t):
        nonlocal left
        left -= 1
        if left == 0:
            raise KeyboardInterrupt

    r = run(Scene(**data), progress=progress)
    if left > 0:
        assert r.status == "done"
        return
    assert r.status == "interrupted"
    assert "interrupted at t = " in r.message
    n = len(r.t) - (r.t[-1] not in whole.t)
    assert 0 < n < len(whole.t)
    for name in SAMPLED:
        np.testing.assert_array_equal(getattr(r, name)[:n], getattr(whole, name)[:n])
    np.testing.assert_array_equal(r.tick_qfrc, whole.tick_qfrc[: len(r.tick_t)])
    again = load(r.save(tmp_path_factory.getbasetemp() / "interrupted.npz"))
    np.testing.assert_array_equal(again.q, r.q)
    assert again.status == "interrupted"


class Stop(Exception):
    """Something that goes wrong."""


@pytest.mark.parametrize("stop", [KeyboardInterrupt, Stop])
@pytest.mark.parametrize("integrator", ["rk4", "euler"])
@pytest.mark.parametrize("data", [{**FALL, "duration": 0.5}, {**TRACKED, "duration": 0.5}])
@given(calls=st.integers(1, 120), late=st.booleans())
@settings(max_examples=6)
def test_a_run_stopped_within_a_step_keeps_the_last_whole_one(data, integrator, stop, calls, late):
    """Ctrl-C or an error at any evaluation of the equations of motion, before or after it, of any stage."""
    from pantograph.sim.engines import contact

    step = make_plan(Scene(**data)).problem.step
    scene = {**data, "solver": {"engine": "contact", "integrator": integrator, "step": step}}
    dense = run(Scene(**scene, rate=1 / step))
    left = calls

    def failing(real):
        def call(*args):
            nonlocal left
            left -= 1
            if left == 0 and not late:
                raise stop
            out = real(*args)
            if left == 0:
                raise stop
            return out

        return call

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(contact.mujoco, "mj_step", failing(mujoco.mj_step))
        patch.setattr(contact.Prescriber, "forward", failing(contact.Prescriber.forward))
        try:
            r = run(Scene(**scene, rate=25))
        except RunError as e:
            assert isinstance(e.__cause__, Stop)
            r = e.recording
    assert r.status == ("interrupted" if stop is KeyboardInterrupt else "failed")
    assert f"{r.status} at t = {r.t[-1]:.4g} s" in r.message
    at = np.searchsorted(dense.t, r.t - 1e-9)
    for name in ("t", "q", "v"):
        np.testing.assert_array_equal(getattr(r, name), getattr(dense, name)[at])
    if "keys" not in data:  # one evaluation to settle, then one call a step
        assert at[-1] == max(0, calls - 2 + late)
    else:  # at most four to settle
        each = 4 if integrator == "rk4" else 1
        assert (calls - 4) // each - 1 <= at[-1] <= calls // each


def test_a_controller_that_fails_or_gives_no_number_is_named_and_the_run_kept(monkeypatch):
    from pantograph.controllers.pd import PD

    real, whole = PD.__call__, run(Scene(**TRACKED, controller={"law": "pd"}, solver={"engine": "contact"}))

    def nothing(self, t, q, v, target, memory):
        tau, memory = real(self, t, q, v, target, memory)
        return (tau if t < 0.5 else tau * np.nan), memory

    monkeypatch.setattr(PD, "__call__", nothing)
    with pytest.raises(
        RunError, match=r"failed at t = 0.5 s: .* no finite force for joint 'elbow'"
    ) as caught:
        run(Scene(**TRACKED, controller={"law": "pd"}, solver={"engine": "contact"}), error=True)
    kept = caught.value.recording
    assert kept.status == "failed"
    assert kept.error is None
    assert kept.t[-1] == pytest.approx(0.5)
    n = len(kept.t) - 1
    np.testing.assert_array_equal(kept.q[:n], whole.q[:n])
    assert np.isfinite(kept.tau).all()


class Spring:
    """A law of one's own: a spring to the keys and a damper, and the number of its samples as memory."""

    def start(self):
        return 0

    def __call__(self, t, q, v, target, memory):
        return 20.0 * (target.q - q) - 2.0 * v, memory + 1


def test_a_law_of_ones_own_drives_a_scene_as_the_same_built_in_one():
    keys = [{"joint": "hinge", "times": [0, 1], "values": [0.5, 0.5]}]
    words = {"law": "pd", "period": 0.01, "kp": 20.0, "kd": 2.0, "gravity": False}
    scene = Scene(
        duration=1.0, models=[{"file": "pendulum"}], roles={"tracked": ["hinge"]}, keys=keys, controller=words
    )
    known, own = run(scene, error=True), run(scene, law=Spring(), error=True)
    np.testing.assert_allclose(own.q, known.q, atol=1e-12)
    np.testing.assert_allclose(own.error.angle, known.error.angle, atol=1e-12)
    assert len(own.tick_t) == 100 and own.tick_t[1] == 0.01
    passive = Scene(duration=1.0, models=[{"file": "pendulum"}])
    with pytest.raises(EngineError, match=r"roles\.tracked"):
        run(passive, law=Spring())
    for answer, said in (
        (1.0, "not float"),
        ((1.0, None), r"not shape \(\)"),
        (([1.0, 2.0], None), r"not shape \(2,\)"),
    ):
        spring = Spring()
        spring.__class__ = type("Odd", (Spring,), {"__call__": lambda *args, answer=answer: answer})
        with pytest.raises(RunError, match=said):
            run(scene, law=spring)
    for what in (Spring, "pd", lambda *args: 0.0):
        with pytest.raises(EngineError, match="a law is an object with start"):
            run(scene, law=what)


@pytest.mark.parametrize("words", [{}, {"encoder": 4096}])
def test_a_swing_up_that_does_not_arrive_says_so(words):
    scene = Scene(
        duration=0.1,
        models=[{"file": "cart_pole"}],
        roles={"tracked": ["slide"]},
        initial={"position": {"hinge": 3.1}},
        controller={"law": "swing-up", "period": 0.01, "tries": 8, "foresight": 2.0, **words},
    )
    (note,) = (note for note in run(scene).notes if "swing-up" in note)
    assert "not caught at the goal" in note and "0.1 s" in note


def test_an_estimate_that_fails_leaves_the_run_and_a_note(monkeypatch):
    def fails(*args):
        raise EngineError("too many impacts")

    monkeypatch.setattr(sys.modules[run.__module__], "estimate_error", fails)
    r = run(Scene(**FALL), error=True)
    assert (r.status, r.error) == ("done", None)
    assert "no error estimate: too many impacts" in r.notes


@pytest.mark.parametrize("after", [0.05, 0.2, 0.35])
@pytest.mark.parametrize("engine", ["contact", "auto"])
def test_an_interrupt_at_any_moment_of_the_simulation_is_kept(after, engine):
    scene = Scene(**{**FALL, "duration": 1e5}, rate=1.0, solver={"engine": engine})
    started = threading.Event()

    def interrupt():
        started.wait()
        time.sleep(after)
        _thread.interrupt_main()

    thread = threading.Thread(target=interrupt)
    thread.start()
    gc.disable()  # an interrupt within a callback of the collector, as hypothesis has one, would be lost
    try:
        r = run(scene, progress=lambda _: started.set())
    finally:
        gc.enable()
    thread.join()
    assert r.status == "interrupted"
    assert len(r.t) == len(r.q) == len(r.a) > 0
    assert r.t[-1] < 1e5


@pytest.mark.parametrize("late", ["derive", "check_frames", "estimate_error"])
def test_an_interrupt_after_the_simulation_loses_no_motion(late, monkeypatch):
    module = sys.modules[run.__module__]
    whole, real, calls = run(Scene(**FALL)), getattr(module, late), []

    def interrupted_once(*args):
        calls.append(1)
        if len(calls) == 1:
            raise KeyboardInterrupt
        return real(*args)

    monkeypatch.setattr(module, late, interrupted_once)
    r = run(Scene(**FALL), error=True)
    assert (r.status, r.message) == ("interrupted", "interrupted after the simulation; the motion is whole")
    assert r.error is None
    for name in SAMPLED:
        np.testing.assert_array_equal(getattr(r, name), getattr(whole, name))
    assert any("interrupted" in note for note in r.notes) == (late != "estimate_error")


@pytest.mark.parametrize("solver", [{"engine": "contact"}, {}, {"tolerance": 1e-6}])
def test_an_interrupt_of_the_second_run_gives_no_estimate(monkeypatch, solver):
    module, plan = sys.modules[run.__module__], make_plan(Scene(**FALL, solver=solver))
    engine, runs = type(module.make_engine(plan.engine.what)), []

    class Interrupted(engine):
        def run(self, *args, **options):
            runs.append(super().run(*args, **options))
            return runs[-1] if len(runs) == 1 else dataclasses.replace(runs[-1], status="interrupted")

    monkeypatch.setattr(module, "make_engine", lambda _: Interrupted())
    r = run(plan, error=True)
    assert len(runs) == 2
    assert r.status == "interrupted"
    assert r.error is None
    assert r.t[-1] == pytest.approx(2.0)


SPRING = """<mujoco><worldbody>
  <body name="calm"><joint name="calm" type="slide"/>
    <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body>
  <body name="b"><joint name="spring" type="slide" stiffness="{k}"/>
    <geom size="0.1" mass="1" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""


@given(st.floats(5.0, 9.0), st.sampled_from(["rk4", "euler"]), st.floats(0.01, 1.0))
@settings(max_examples=10)
def test_a_diverging_run_says_when_where_and_why_and_keeps_what_it_has(
    tmp_path_factory, log_k, integrator, x
):
    """A mass of 1 kg on a spring of k N/m, h = 0.02 s: unstable for h sqrt(k) > 2.8 (RK4) or 2 (Euler)."""
    path = tmp_path_factory.getbasetemp() / "spring.xml"
    path.write_text(SPRING.format(k=10**log_k))
    scene = Scene(
        duration=20.0,
        models=[{"file": str(path)}],
        initial={"position": {"spring": x}},
        physics={"gravity": False},
        solver={"integrator": integrator, "step": 0.02},
    )
    r = run(scene, error=True)
    assert r.status == "diverged"
    for part in ("diverged at t = ", "'spring'", integrator, "0.02 s", "stiff", "smaller step"):
        assert part in r.message
    assert 0 < len(r.t) < 2400
    for name in SAMPLED:
        assert np.isfinite(getattr(r, name)).all(), name
    assert r.q[0, 1] == x
    assert r.error is None
    assert run(Scene(**{**scene.model_dump(), "solver": {"step": 1e-5}, "duration": 0.01})).status == "done"


def independent(model):
    """The model for plain MuJoCo calls: what the scene switched off stays off, energies on."""
    model.opt.enableflags |= int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    return model, mujoco.MjData(model)


@given(numbers, numbers, numbers, numbers, st.booleans(), st.sampled_from(["rk4", "euler", "discrete"]))
@settings(max_examples=15)
def test_derived_quantities_belong_to_the_recorded_state(q1, q2, v1, v2, loaded, integrator):
    """planar_2r: accelerations, energies by MuJoCo from q and v alone, at every sample."""
    scene = Scene(
        duration=0.3,
        models=[{"file": "planar_2r"}],
        initial={"position": {"shoulder": q1, "elbow": q2}, "velocity": {"shoulder": v1, "elbow": v2}},
        forces=[{"body": "forearm", "force": [3, 1, 20], "torque": [0, 2, 0]}] if loaded else [],
        solver={"integrator": integrator},
    )
    r = run(scene)
    model, data = independent(make_plan(scene).problem.model)
    for i in range(0, len(r.t), 7):
        data.qpos[:], data.qvel[:] = r.q[i], r.v[i]
        if loaded:
            data.body("forearm").xfrc_applied[:] = [3, 1, 20, 0, 2, 0]
        mujoco.mj_forward(model, data)
        np.testing.assert_allclose(r.a[i], data.qacc, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose([r.potential[i], r.kinetic[i]], data.energy, rtol=1e-12, atol=1e-12)
        height = model.body_mass @ data.xipos[:, 2]
        assert r.potential[i] == pytest.approx(9.81 * height, abs=1e-9)
    assert not r.tau.any()
    assert not r.normal.any()


@pytest.mark.parametrize("engine", ["contact", "auto"])
@pytest.mark.parametrize("drives", [{}, {"actuators": {"*": "off"}}, {"controller": {"law": "pd"}}])
def test_drive_forces_of_all_roles_are_what_inverse_dynamics_asks_for(drives, engine):
    """Of the model's servos along the keys, of ideal joint forces, and of the controller's actuators."""
    drives = {**drives, "solver": {"engine": engine}}
    scene = Scene(**TRACKED, **drives, physics={"contacts": "none", "limits": False, "friction": False})
    r = run(scene)
    model = make_plan(scene).problem.model
    model.opt.disableflags |= int(
        mujoco.mjtDisableBit.mjDSBL_ACTUATION | mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    )
    data = mujoco.MjData(model)
    for i in range(0, len(r.t), 10):
        data.qpos[:], data.qvel[:], data.qacc[:] = r.q[i], r.v[i], r.a[i]
        mujoco.mj_inverse(model, data)
        np.testing.assert_allclose(r.tau[i], data.qfrc_inverse, atol=1e-6)
    passive = ~(r.keyed | r.tracked)
    assert passive.any()
    assert r.keyed.any()
    np.testing.assert_allclose(r.tau[:, passive], 0.0, atol=1e-12)
    clip = make_plan(scene).problem.clip.evaluate(r.t)
    for moved, keyed in ((r.q, clip.q), (r.v, clip.v), (r.a, clip.a)):
        np.testing.assert_allclose(moved[:, r.keyed], keyed[:, r.keyed], atol=1e-8)


def test_the_normal_force_carries_the_weight_of_what_rests():
    scene = Scene(
        duration=3.0,
        props=[
            {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True},
            {"name": "box", "shape": "box", "size": [0.1, 0.1, 0.1], "mass": 2.0, "position": [0, 0, 0.11]},
        ],
    )
    r = run(scene)
    assert r.normal[0] == 0
    assert r.normal[-1] == pytest.approx(2 * 9.81, rel=1e-3)
    assert [e.kind for e in r.events][:1] == ["contact"]
    fall = np.sqrt(2 * 0.01 / 9.81)
    assert r.events[0].t == pytest.approx(fall, abs=2 / 120)
    assert "box" in r.events[0].what
