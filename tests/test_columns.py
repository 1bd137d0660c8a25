"""Columns of derivatives computed side by side: the same numbers as one by one, in the fewest operations."""

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.models import load_model
from pantograph.sim.compile import graph as g
from pantograph.sim.compile import kernels
from pantograph.sim.compile.cache import Cache
from pantograph.sim.compile.diff import directional, grouped, merged
from pantograph.sim.compile.graph import Graph
from pantograph.sim.compile.program import Program, map_source, obtain
from pantograph.sim.compile.tape import Tape
from pantograph.sim.dynamics.smooth import compile_model

STEPS = st.lists(
    st.tuples(
        st.sampled_from(("add", "sub", "mul", "sin", "inverse", "abs")),
        st.integers(0, 99),
        st.integers(0, 99),
    ),
    min_size=2,
    max_size=14,
)
SIZES = st.integers(2, 7)
WIDEST = st.sampled_from([2, 4, 8])


def some_values(graph, size, steps):
    """Values of a random program of `size` inputs, some of which need few of them."""
    values = list(graph.inputs("x", size))
    inputs = list(values)
    apply = {
        "add": lambda x, y: x + y,
        "sub": lambda x, y: x - 2.0 * y,
        "mul": lambda x, y: g.sin(x) * y,
        "sin": lambda x, y: g.sin(x) - 0.5,
        "inverse": lambda x, y: 1.0 / (2.0 + g.cos(x)),
        "abs": lambda x, y: g.absolute(x - 0.1),
    }
    for op, i, j in steps:
        values.append(apply[op](values[i % len(values)], values[j % len(values)]))
    return inputs, values[size:]


def jacobian(graph, values, seeds, widest):
    columns = []
    for group in grouped(values, seeds, widest):
        (column,) = directional(values, [merged(graph, [seeds[k] for k in group])])
        columns += [[graph.lane(x, lane) for x in column] for lane in range(len(group))]
    return columns


def evaluated(tape, *arguments):
    source = map_source(tape, 1)
    program = Program(obtain("test", 1, Cache(None), "", lambda: source), 1)
    return program([np.ascontiguousarray(x) for x in arguments], len(arguments[0]), 1)


@settings(deadline=None, max_examples=60)
@given(SIZES, STEPS, WIDEST, st.sampled_from([5, 3000]), st.integers(0, 2**32 - 1))
def test_columns_side_by_side_are_the_columns_one_by_one(size, steps, widest, chunk, seed):
    graph = Graph()
    inputs, values = some_values(graph, size, steps)
    seeds = [{x: 1.0} for x in inputs]
    tapes = [
        Tape.build({"x": size}, {"J": [x for c in jacobian(graph, values, seeds, w) for x in c]})
        for w in (1, widest)
    ]
    x = np.random.default_rng(seed).normal(size=(3, size))
    exact = tapes[0].evaluate(x)[0]
    scale = 1e-12 * max(np.abs(exact).max(), 1.0)
    np.testing.assert_allclose(tapes[1].evaluate(x)[0], exact, rtol=0, atol=scale)
    before, kernels.CHUNK = kernels.CHUNK, chunk  # short functions: vectors pass through memory
    try:
        (got,) = evaluated(tapes[1], x)
    finally:
        kernels.CHUNK = before
    np.testing.assert_allclose(got, exact, rtol=0, atol=scale)


def touched(values, seeds):
    """Nodes whose derivative is not zero, column by column."""
    out = []
    for seed in seeds:
        known = {node.id for node in seed}
        for node in g.reachable(values):
            if node.a is not None and (node.a.id in known or (node.b is not None and node.b.id in known)):
                known.add(node.id)
        out.append(known)
    return out


def cuts(count, widest):
    for places in itertools.product((False, True), repeat=count - 1):
        edges = [0, *(k + 1 for k, cut in enumerate(places) if cut), count]
        groups = [list(range(a, b)) for a, b in itertools.pairwise(edges)]
        if all(len(group) <= widest for group in groups):
            yield groups


@settings(deadline=None, max_examples=60)
@given(SIZES, STEPS, WIDEST)
def test_no_other_cut_into_groups_takes_fewer_operations(size, steps, widest):
    inputs, values = some_values(Graph(), size, steps)
    seeds = [{x: 1.0} for x in inputs]
    found = grouped(values, seeds, widest)
    assert [k for group in found for k in group] == list(range(size))
    nodes = touched(values, seeds)

    def work(groups):
        return sum(len(set().union(*(nodes[k] for k in group))) for group in groups)

    assert max(map(len, found)) <= widest
    assert work(found) == min(work(groups) for groups in cuts(size, widest))


@pytest.mark.parametrize("model", ["arm6", "quadruped", "hopper"])
@pytest.mark.parametrize("name", ["derivatives", "control_derivatives", "rate_jacobian"])
def test_a_machine_s_derivatives_do_not_depend_on_how_many_columns_go_together(model, name):
    smooth, rng = compile_model(load_model(model), lanes=1), np.random.default_rng(0)
    one = smooth.tape(name)
    arguments = [rng.normal(size=(2, size)) for size in one.inputs.values()]
    exact = one.evaluate(*(x.astype(np.longdouble) for x in arguments))
    for columns in (2, 8):
        wide = smooth.tape(name, columns=columns)
        assert sum(width > 1 for width in wide.widths) > 0
        assert sum(wide.counts.values()) < sum(one.counts.values())
        for got, want in zip(evaluated(wide, *arguments), exact, strict=True):
            assert np.abs(got - want).max(initial=0.0) <= 1e-10 * np.abs(want).max(initial=0.0)
