"""Contacts and limits as events of a run: seen at every step, whatever the samples."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import Scene, make_plan, run

FLOOR = {"name": "floor", "shape": "plane", "size": [3, 3], "fixed": True}
G = 9.81


def bouncing(height, *, rate=120.0, **solver):
    """A ball dropped from a height of its lowest point."""
    ball = {"name": "ball", "shape": "sphere", "size": [0.1], "position": [0, 0, 0.1 + height]}
    return Scene(duration=1.0, rate=rate, props=[ball, FLOOR], solver={"step": 0.002, **solver})


@given(st.floats(0.05, 1.0), st.sampled_from(["rk4", "euler", "implicitfast"]))
@settings(max_examples=15)
def test_a_contact_begins_in_the_step_in_which_the_ball_arrives(height, integrator):
    r = run(bouncing(height, rate=2.0, integrator=integrator))
    arrival = np.sqrt(2 * height / G)
    first = r.events[0]
    assert (first.kind, first.what) == ("contact", "ball - floor")
    late = 0.0 if integrator == "rk4" else 0.004  # methods of order 1 fall a little too late or early
    assert arrival - 0.002 - late <= first.t <= arrival + late + 1e-9


@given(st.floats(0.05, 1.0), st.floats(1.0, 500.0))
@settings(max_examples=15)
def test_events_do_not_depend_on_the_samples(height, rate):
    assert run(bouncing(height, rate=rate)).events == run(bouncing(height, rate=7.0)).events


KNOCKED = """<mujoco><option timestep="0.002" cone="{cone}"/><worldbody>
  <geom name="floor" type="plane" size="3 3 .1"/>
  <body name="arm" pos="0 0 .5"><joint name="hinge" axis="0 1 0" range="-60 60"/>
    <geom type="capsule" fromto="0 0 0 .4 0 0" size=".03"/></body>
  <body name="a" pos=".2 0 .9"><freejoint/><geom type="box" size=".06 .05 .04"/></body>
  <body name="b" pos=".21 .02 1.2"><freejoint/><geom type="sphere" size=".06"/></body>
</worldbody></mujoco>"""


@given(st.sampled_from(["pyramidal", "elliptic"]), st.sampled_from(["rk4", "euler"]), st.floats(-2.0, 2.0))
@settings(max_examples=10)
def test_events_are_the_changes_of_what_mujoco_says_step_by_step(tmp_path_factory, cone, integrator, spin):
    """MuJoCo's own contact forces and limit forces after each of its steps, contact by contact."""
    path = tmp_path_factory.getbasetemp() / f"knocked-{cone}.xml"
    path.write_text(KNOCKED.format(cone=cone))
    scene = Scene(
        duration=0.8,
        models=[{"file": str(path)}],
        initial={"velocity": {"hinge": spin}},
        solver={"integrator": integrator, "engine": "contact"},
    )
    problem = make_plan(scene).problem
    m = problem.model
    m.opt.timestep, m.opt.integrator = problem.step, {"euler": 0, "rk4": 1}[integrator]
    d = mujoco.MjData(m)
    d.qpos[:], d.qvel[:] = problem.state0.q, problem.state0.v
    expected, before, force = [], set(), np.zeros(6)
    for k in range(problem.steps):
        mujoco.mj_step(m, d)
        now = set()
        for c in range(d.ncon):
            mujoco.mj_contactForce(m, d, c, force)
            if force[0] > 0:
                bodies = sorted(m.body(m.geom_bodyid[g]).name for g in d.contact[c].geom)
                now.add(("contact", " - ".join(bodies)))
        hinge = m.joint("hinge").id
        rows = (d.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT) & (d.efc_id == hinge)
        if d.efc_force[rows].any():
            now.add(("limit", "hinge"))
        expected += [(k * problem.step, kind, what) for kind, what in sorted(now - before)]
        expected += [(k * problem.step, f"{kind} end", what) for kind, what in sorted(before - now)]
        before = now
    found = [(e.t, e.kind, e.what) for e in run(scene).events]
    assert [e[1:] for e in found] == [e[1:] for e in expected]
    np.testing.assert_allclose([e[0] for e in found], [e[0] for e in expected], atol=1e-12)
    assert {"contact", "contact end"} <= {e[1] for e in found}


def test_a_tendon_at_its_limit_is_an_event(tmp_path):
    path = tmp_path / "rope.xml"
    path.write_text("""<mujoco><worldbody><site name="hook" pos="0 0 1"/>
      <body name="weight" pos="0 0 .9"><freejoint/><geom size=".02"/><site name="eye"/></body></worldbody>
      <tendon><spatial name="rope" range="0 .5" limited="true"><site site="hook"/><site site="eye"/></spatial>
      </tendon></mujoco>""")
    r = run(Scene(duration=1.0, models=[{"file": str(path)}]))
    fall = np.sqrt(2 * 0.4 / G)
    assert (r.events[0].kind, r.events[0].what) == ("limit", "rope")
    assert r.events[0].t == pytest.approx(fall, abs=0.003)
