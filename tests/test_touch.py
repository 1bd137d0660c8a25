"""Contacts and limits as events of a run: seen at every step, whatever the samples."""

from types import SimpleNamespace

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim import Scene, make_plan, run
from pantograph.sim.engines.touch import Touch

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


NAMED = """<mujoco><worldbody><geom name="floor" type="plane" size="1 1 .1"/>
  <body name="a"><joint name="j0"/><geom size=".1"/><site name="s"/>
    <body name="b"><joint name="j1"/><geom size=".1"/><geom size=".2"/></body></body></worldbody>
  <tendon><fixed name="t0"><joint joint="j0" coef="1"/></fixed><fixed name="t1"><joint joint="j1" coef="1"/>
  </fixed></tendon></mujoco>"""
KINDS = mujoco.mjtConstraint
LIMITED = {
    (KINDS.mjCNSTR_LIMIT_JOINT, 0): "j0",
    (KINDS.mjCNSTR_LIMIT_JOINT, 1): "j1",
    (KINDS.mjCNSTR_LIMIT_TENDON, 0): "t0",
    (KINDS.mjCNSTR_LIMIT_TENDON, 1): "t1",
}
GEOMS = {(0, 1): "a - world", (0, 2): "b - world", (3, 0): "b - world", (1, 3): "a - b"}
rows = st.floats(-1.0, 1.0) | st.just(0.0)


@st.composite
def evaluations(draw):
    """Constraints as MuJoCo lists them (dry friction, limits, contacts), and what of them pushes."""
    friction = draw(st.lists(rows, max_size=2))
    limits = draw(st.lists(st.tuples(st.sampled_from([*LIMITED]), rows), max_size=2))
    contacts = draw(st.lists(st.tuples(st.sampled_from([*GEOMS]), st.lists(rows, max_size=4)), max_size=3))
    kind = [int(KINDS.mjCNSTR_FRICTION_DOF)] * len(friction) + [int(k) for (k, _), _ in limits]
    which = [*range(len(friction)), *(i for (_, i), _ in limits)]
    force = [*friction, *(f for _, f in limits)]
    for i, (_, forces) in enumerate(contacts):
        kind += [int(KINDS.mjCNSTR_CONTACT_PYRAMIDAL)] * len(forces)
        which += [i] * len(forces)
        force += forces
    data = SimpleNamespace(
        ncon=len(contacts),
        nl=len(limits),
        efc_type=np.array(kind, dtype=np.int32),
        efc_id=np.array(which, dtype=np.int32),
        efc_force=np.array(force, dtype=float),
        contact=SimpleNamespace(geom=np.array([g for g, _ in contacts], dtype=np.int32).reshape(-1, 2)),
    )
    pushing = {("limit", LIMITED[what]) for what, f in limits if f}
    return data, pushing | {("contact", GEOMS[g]) for g, forces in contacts if any(forces)}


@given(st.lists(evaluations(), max_size=8))
@settings(max_examples=300)
def test_events_are_the_changes_of_what_pushes_whatever_the_constraints(steps):
    touch, expected, before = Touch(mujoco.MjModel.from_xml_string(NAMED)), [], set()
    for t, (data, now) in enumerate(steps):
        touch.look(data, float(t))
        expected += [(float(t), *e) for e in sorted(now - before)]
        expected += [(float(t), f"{kind} end", what) for kind, what in sorted(before - now)]
        before = now
    assert [(e.t, e.kind, e.what) for e in touch.events] == expected


@pytest.mark.parametrize("kinds", ["mjCNSTR_LIMIT_JOINT mjCNSTR_LIMIT_TENDON", "mjCNSTR_LIMIT_TENDON " * 2])
@pytest.mark.parametrize("ids", [(0, 0), (0, 1), (1, 1)])
def test_a_limit_that_takes_over_from_another_is_an_event(kinds, ids):
    touch, names = Touch(mujoco.MjModel.from_xml_string(NAMED)), []
    for kind, i in zip(kinds.split(), ids, strict=True):
        names.append(LIMITED[getattr(KINDS, kind), i])
        arrays = {"efc_type": [int(getattr(KINDS, kind))], "efc_id": [i], "efc_force": [1.0]}
        contact = SimpleNamespace(geom=np.zeros((0, 2), dtype=np.int32))
        data = {name: np.array(x) for name, x in arrays.items()}
        touch.look(SimpleNamespace(ncon=0, nl=1, contact=contact, **data), 0.0)
    found = [(e.kind, e.what) for e in touch.events]
    changed = [("limit", names[1]), ("limit end", names[0])] if names[0] != names[1] else []
    assert found == [("limit", names[0]), *changed]


def test_a_contact_that_takes_over_from_another_is_an_event():
    touch = Touch(mujoco.MjModel.from_xml_string(NAMED))
    for geoms in ((0, 1), (0, 2), (3, 0)):
        rows = {
            "efc_type": np.array([int(KINDS.mjCNSTR_CONTACT_FRICTIONLESS)]),
            "efc_id": np.array([0]),
            "efc_force": np.array([1.0]),
        }
        touch.look(
            SimpleNamespace(ncon=1, nl=0, contact=SimpleNamespace(geom=np.array([geoms])), **rows), 0.0
        )
    found = [(e.kind, e.what) for e in touch.events]
    assert found == [("contact", "a - world"), ("contact", "b - world"), ("contact end", "a - world")]
