"""Equal limbs computed side by side: the same numbers, whatever the limbs' constants, signs and order."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.models import load_model
from pantograph.sim.compile import graph as g
from pantograph.sim.compile import kernels
from pantograph.sim.compile.cache import Cache
from pantograph.sim.compile.graph import Graph
from pantograph.sim.compile.packs import find_packs
from pantograph.sim.compile.program import Program, map_source, obtain
from pantograph.sim.compile.tape import Tape
from pantograph.sim.dynamics.layout import Layout
from pantograph.sim.dynamics.smooth import compile_model
from pantograph.sim.dynamics.symbolic import Equations

JOINTS, SHARED = 2, 3
OPERATIONS = ("add", "sub", "sub", "mul", "mul", "sin", "cos", "neg", "abs", "max", "min", "root", "inverse")
STEPS = st.lists(
    st.tuples(st.sampled_from(OPERATIONS), st.integers(0, 99), st.integers(0, 99)), min_size=2, max_size=12
)


def apply(op, x, y):
    """One operation whose result stays near 1."""
    results = {
        "add": lambda: x + y,
        "sub": lambda: x - y,
        "mul": lambda: g.sin(x) * y,
        "sin": lambda: g.sin(x),
        "cos": lambda: g.cos(x),
        "neg": lambda: -x,
        "abs": lambda: g.absolute(x),
        "max": lambda: g.maximum(x, y),
        "min": lambda: g.minimum(x, y),
        "root": lambda: g.sqrt(1.0 + g.absolute(x)),
        "inverse": lambda: 1.0 / (2.0 + g.cos(x)),
    }
    return results[op]()


def limbs_program(count, recipe, after, rng):
    """Limbs with the same formulas, other constants and signs; their sum; and products of neighbours."""
    graph = Graph()
    q, shared = graph.inputs("q", count * JOINTS), graph.inputs("s", SHARED)
    mirror = rng.choice([-1.0, 1.0], size=count)
    numbers = rng.uniform(0.5, 1.5, size=(count, 4)) * rng.choice([-1.0, 1.0], size=(count, 4))

    def run(limb, start, steps):
        values = list(start)
        for op, i, j in steps:
            x, y = values[i % len(values)], values[j % len(values)]
            constant = numbers[limb, (i + j) % 4]
            values.append(apply(op, x * constant if i % 3 == 0 else x, y + constant if j % 3 == 1 else y))
        return values

    limbs = []
    for limb in range(count):
        own = [mirror[limb] * x for x in q[limb * JOINTS : (limb + 1) * JOINTS]]
        limbs.append(run(limb, [*own, *shared], recipe))
    total = sum((values[-1] * (1.0 / count) for values in limbs), 0.0)
    outputs = [x for limb, values in enumerate(limbs) for x in run(limb, [*values[-2:], total], after)]
    outputs += [x[-2] * (y[-1] - y[-3]) for x, y in zip(limbs, limbs[1:] + limbs[:1], strict=True)]
    names = [[("q", limb * JOINTS + k) for k in range(JOINTS)] for limb in range(count)]
    sizes = {"q": count * JOINTS, "s": SHARED}
    return Tape.build(sizes, {"y": [*outputs, total]}, [names])


def evaluated(tape, *arguments):
    source = map_source(tape, 1)
    program = Program(obtain("test", 1, Cache(None), "", lambda: source), 1)
    return program([np.ascontiguousarray(x) for x in arguments], len(arguments[0]), 1)[0]


@settings(deadline=None, max_examples=80)
@given(st.integers(2, 5), STEPS, STEPS, st.integers(0, 2**32 - 1), st.sampled_from([7, 3000]))
def test_packed_limbs_compute_what_the_tape_says(count, recipe, after, seed, chunk):
    rng = np.random.default_rng(seed)
    tape = limbs_program(count, recipe, after, rng)
    q, s = rng.normal(size=(3, count * JOINTS)), rng.normal(size=(3, SHARED))
    before, kernels.CHUNK = kernels.CHUNK, chunk  # short functions: vectors pass through memory
    try:
        got = evaluated(tape, q, s)
    finally:
        kernels.CHUNK = before
    exact = tape.evaluate(q, s)[0]
    assert np.abs(got - exact).max() <= 1e-11 * np.abs(exact).max()


@settings(deadline=None)
@given(st.integers(2, 5), STEPS, STEPS, st.integers(0, 2**32 - 1))
def test_packs_hold_every_row_once_and_come_after_their_operands(count, recipe, after, seed):
    tape = limbs_program(count, recipe, after, np.random.default_rng(seed))
    packs = find_packs(tape)
    rows = [row for pack in packs for row in pack.rows]
    assert len(rows) == len(set(rows))
    for number, pack in enumerate(packs):
        assert all(source.pack is None or source.pack < number for source in pack.sources)


def quadruped():
    return load_model("quadruped")


def test_most_of_a_quadruped_is_packed_although_its_sides_mirror_each_other():
    tape = compile_model(quadruped(), lanes=1).tape("forward")
    packs = find_packs(tape)
    packed = sum(len(pack.rows) for pack in packs if pack.op not in (g.INPUT, g.CONST))
    operations = sum(tape.counts.values())
    assert packed > operations * 2 / 3
    assert {len(pack.rows) for pack in packs} == {4}


@pytest.mark.parametrize(
    ("model", "name"),
    [("quadruped", name) for name in ("forward", "inverse", "derivatives", "vjp", "rate")]
    + [("puppet", name) for name in ("forward", "inverse", "vjp", "rate")],
)
def test_packed_equations_equal_the_tape_on_real_limbs(model, name):
    tape = compile_model(load_model(model), lanes=1).tape(name)
    rng = np.random.default_rng(0)
    arguments = [rng.normal(size=(3, size)) for size in tape.inputs.values()]
    source = map_source(tape, 1)
    program = Program(obtain("test", 1, Cache(None), "", lambda: source), 1)
    found = program([np.ascontiguousarray(x) for x in arguments], 3, 1)
    exact = tape.evaluate(*(x.astype(np.longdouble) for x in arguments))
    for got, want in zip(found, exact, strict=True):
        assert np.abs(got - want).max(initial=0.0) <= 1e-10 * np.abs(want).max(initial=0.0)


def names_of(model, layout, limb):
    joints = [model.joint(j).name for j in range(model.njnt)]
    free = [
        name for name, kind in zip(joints, model.jnt_type, strict=True) if kind == mujoco.mjtJoint.mjJNT_HINGE
    ]
    first = 7
    return [free[i - first] for name, i in limb if name == "q"]


def test_limbs_are_siblings_with_the_same_joints():
    model = quadruped()
    equations = Equations(model, Layout(model))
    (legs,) = equations.tape("q v u", {"a": equations.q}).limbs
    assert len(legs) == 4
    named = [names_of(model, equations.layout, [("q" if a == 0 else "", i) for a, i in leg]) for leg in legs]
    assert all(len(leg) == 3 for leg in named)
    assert len({name for leg in named for name in leg}) == 12
    for leg in named:  # joints of one leg share its prefix, and stand in the same order in all
        assert len({name.rsplit("_", name.count("_") - 1)[0] for name in leg}) == 1
        assert [name.split("_")[2:] for name in leg] == [name.split("_")[2:] for name in named[0]]


def test_keyed_limbs_are_limbs_as_well():
    model = quadruped()
    hinges = tuple(j for j in range(model.njnt) if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE)
    equations = Equations(model, Layout(model, hinges))
    (legs,) = equations.tape("q v w", {"a": equations.q}).limbs
    assert [len(leg) for leg in legs] == [9] * 4  # position, velocity and acceleration of three joints


def many_legged(legs, kinds, rng):
    """A floating body with legs of the same joints, each with its own lengths and masses."""

    def vector(x):
        return " ".join(map(str, x))

    def leg(depth=0):
        if depth == len(kinds):
            return ""
        joint = {"x": 'axis="1 0 0"', "y": 'axis="0 1 0"', "ball": 'type="ball"'}[kinds[depth]]
        inertial = f'<inertial pos="{vector(rng.normal(size=3) * 0.1)}" mass="{rng.uniform(0.5, 1.5)}"'
        inertial += ' diaginertia="0.01 0.012 0.011"/>'
        place = vector(rng.normal(size=3) * 0.2)
        return f'<body pos="{place}"><joint {joint}/>{inertial}{leg(depth + 1)}</body>'

    trunk = '<freejoint/><inertial pos="0.01 0.02 0" mass="3" diaginertia="0.1 0.1 0.12"/>'
    body = f"<body>{trunk}{''.join(leg() for _ in range(legs))}</body>"
    return mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{body}</worldbody></mujoco>")


@pytest.mark.parametrize("legs", [2, 3, 9])
@pytest.mark.parametrize("kinds", [("x", "y", "y"), ("ball", "y")])
def test_any_number_of_legs_has_mujocos_accelerations(legs, kinds):
    rng = np.random.default_rng(legs)
    model = many_legged(legs, kinds, rng)
    smooth, data = compile_model(model, lanes=1), mujoco.MjData(model)
    for _ in range(5):
        data.qpos[:], data.qvel[:] = rng.normal(size=model.nq), rng.normal(size=model.nv)
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        error = np.abs(smooth.forward(data.qpos, data.qvel) - data.qacc).max()
        assert error <= 1e-11 * np.abs(data.qacc).max()
    tape = smooth.tape("forward")
    packed = sum(len(pack.rows) for pack in find_packs(tape) if pack.op != g.INPUT)
    assert packed > sum(tape.counts.values()) / 2
