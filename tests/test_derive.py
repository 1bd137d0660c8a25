"""What is derived from recorded states, against closed forms and the matrices of the model as filed."""

import dataclasses

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import Scene, run
from pantograph.sim.clip import Clip
from pantograph.sim.engines.derive import derive
from pantograph.sim.engines.interface import Problem, Role, Segment, State
from strategies import random_states, seeds, trees

G = 9.81


@st.composite
def segments(draw):
    """A random tree, some of its joints keyed, and random states of it as an engine's samples."""
    model = draw(trees())
    roles = np.array([draw(st.sampled_from([Role.PASSIVE, Role.KEYED])) for _ in range(model.njnt)], np.int8)
    n = draw(st.integers(0, 4))
    q, v, _ = random_states(model, draw(seeds), n)
    none = np.zeros(0)
    return (
        Problem(
            model=model,
            state0=State(model.qpos0, np.zeros(model.nv), none),
            duration=1.0,
            roles=roles,
            clip=Clip(model, {}),
            integrator="rk4",
            step=0.01,
            sample_every=1,
            drives=np.zeros(0, dtype=np.int8),
        ),
        Segment(
            t=0.1 * np.arange(n),
            q=q,
            v=v,
            act=np.zeros((n, 0)),
            tick_t=none,
            tick_ctrl=np.zeros((0, 0)),
            tick_qfrc=np.zeros((0, model.nv)),
            status="done",
            message="",
            stats={},
        ),
    )


@given(segments())
@settings(max_examples=40)
def test_energies_are_those_of_the_model_whatever_is_keyed(case):
    """T = v M v / 2 with the inertia of the scene, not of what makes keyed joints move; V = -sum m g x."""
    problem, segment = case
    m, d = problem.model, mujoco.MjData(problem.model)
    found, M = derive(problem, segment), np.zeros((m.nv, m.nv))
    for i, (q, v) in enumerate(zip(segment.q, segment.v, strict=True)):
        d.qpos[:], d.qvel[:] = q, v
        mujoco.mj_forward(m, d)
        mujoco.mj_fullM(m, d, M)
        np.testing.assert_allclose(found.kinetic[i], 0.5 * v @ M @ v, rtol=1e-12)
        height = -m.body_mass @ (d.xipos @ m.opt.gravity)
        np.testing.assert_allclose(found.potential[i], height, rtol=1e-12, atol=1e-10)
    assert len(found.kinetic) == len(found.potential) == len(found.tau) == len(segment.t)


@given(segments())
@settings(max_examples=20)
def test_a_sample_is_derived_from_itself_alone(case):
    """Samples in reverse have the same accelerations, forces and energies: keyed joints do as told in all."""
    problem, segment = case
    back = dataclasses.replace(segment, q=segment.q[::-1].copy(), v=segment.v[::-1].copy())
    one, two = derive(problem, segment), derive(problem, back)
    for name, tolerance in (("a", 1e-9), ("tau", 1e-7), ("kinetic", 0.0), ("potential", 0.0)):
        x, y = getattr(one, name), getattr(two, name)[::-1]
        np.testing.assert_allclose(x, y, rtol=1e-12, atol=tolerance * (1.0 + np.abs(x).max(initial=0.0)))


BOXES = """<mujoco><option cone="{cone}" timestep="0.002" gravity="2 0 -9.81"/><worldbody>
  <geom type="plane" size="3 3 .1" condim="{condim}"/>
  <body pos="0 0 .1"><freejoint/><geom type="box" size=".1 .1 .1" mass="3" condim="{condim}"/></body>
  <body pos="1 0 .1"><freejoint/><geom type="sphere" size=".1" mass="2" condim="1"/></body>
  <body pos="-1 0 2"><freejoint/><geom type="sphere" size=".1" mass="7" condim="{condim}"/></body>
  <body pos="0 1 .5"><joint name="stop" type="slide" axis="0 0 1" range="0 1" limited="true"/>
    <joint type="hinge" frictionloss="1"/><geom type="sphere" size=".1" mass="5"/></body>
</worldbody></mujoco>"""


@pytest.mark.parametrize("condim", [1, 3, 4, 6])
@pytest.mark.parametrize("cone", ["pyramidal", "elliptic"])
def test_normal_forces_carry_what_rests_on_the_floor_and_nothing_else(tmp_path, cone, condim):
    """A box that friction holds and a ball that slides, while a ball falls, a limit holds a weight and dry
    friction acts."""
    path = tmp_path / "boxes.xml"
    path.write_text(BOXES.format(cone=cone, condim=condim))
    r = run(Scene(duration=0.55, models=[{"file": str(path)}], solver={"integrator": "implicitfast"}))
    assert ("limit", "stop") in {(e.kind, e.what) for e in r.events}
    np.testing.assert_allclose(r.normal[-5:], (3 + 2) * G, rtol=1e-3)
