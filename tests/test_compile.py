"""From expressions to machine code: the same numbers, exact derivatives, a cache that survives anything."""

import ctypes
import threading
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pantograph.sim.compile import graph as g
from pantograph.sim.compile import kernels
from pantograph.sim.compile import llvm as emission
from pantograph.sim.compile.cache import Cache, default_folder, key_of, pack, unpack
from pantograph.sim.compile.diff import directional, gradient
from pantograph.sim.compile.graph import Graph
from pantograph.sim.compile.jit import compile_ir, load
from pantograph.sim.compile.program import Program, map_source, obtain
from pantograph.sim.compile.tape import Tape

LONG = np.longdouble
needs_long_double = pytest.mark.skipif(
    np.finfo(LONG).eps > 1e-18, reason="long double is no wider than double here: nothing to compare with"
)
SMOOTH = ("add", "sub", "mul", "neg", "div", "sin", "cos", "sqrt")
STEEP = (*SMOOTH, "min", "max", "abs", "less", "atan2", "round")


def apply(op, a, b):
    """One operation with operands kept away from singularities, over numbers or nodes."""
    table = {
        "add": lambda: a + b,
        "sub": lambda: a - b,
        "mul": lambda: a * b,
        "neg": lambda: -a,
        "div": lambda: a / (2.0 + b * b),
        "sin": lambda: g.sin(a),
        "cos": lambda: g.cos(a),
        "sqrt": lambda: g.sqrt(1.0 + a * a),
        "min": lambda: g.minimum(a, b),
        "max": lambda: g.maximum(a, b),
        "abs": lambda: g.absolute(a),
        "less": lambda: g.less(a, b),
        "atan2": lambda: g.atan2(a, b),
        "round": lambda: g.nearest(a),
    }
    return table[op]()


def programs(ops):
    """Recipes: three inputs, then operations on earlier values or constants."""
    step = st.tuples(st.sampled_from(ops), st.integers(0, 40), st.integers(0, 40))
    return st.lists(step, min_size=3, max_size=25)


def run(recipe, inputs):
    values = [*inputs, 0.0, 1.0, -1.0, 0.7]
    for op, a, b in recipe:
        values.append(apply(op, values[a % len(values)], values[b % len(values)]))
    return values[-4:]


def tape_of(recipe):
    graph = Graph()
    return Tape.build({"x": 3}, {"y": run(recipe, graph.inputs("x", 3))})


def compiled(tape, lanes):
    kernels, loops, facts = map_source(tape, lanes)
    code = obtain("test", lanes, Cache(None), "", lambda: (kernels, loops, facts))
    return Program(code, lanes)


def points(seed, n):
    return np.random.default_rng(seed).normal(size=(n, 3))


@given(programs(STEEP), st.integers(0, 2**32 - 1))
def test_folding_and_sharing_leave_the_value_alone(recipe, seed):
    x = points(seed, 1)[0]
    expected = [float(y) for y in run(recipe, list(map(float, x)))]
    np.testing.assert_allclose(tape_of(recipe).evaluate(x)[0], expected, rtol=1e-12, atol=1e-12)


@settings(max_examples=25)
@given(programs(STEEP), st.integers(0, 2**32 - 1), st.sampled_from([1, 2, 4, 8]), st.integers(1, 19))
def test_machine_code_gives_the_tape_s_numbers_in_any_lanes_and_batch(recipe, seed, lanes, n):
    tape, x = tape_of(recipe), points(seed, n)
    got = compiled(tape, lanes)([x], n, 1)[0]
    np.testing.assert_allclose(got, tape.evaluate(x)[0], rtol=1e-12, atol=1e-12)


@given(programs(SMOOTH), st.integers(0, 2**32 - 1))
def test_both_modes_of_differentiation_agree_with_the_complex_step(recipe, seed):
    graph = Graph()
    inputs = graph.inputs("x", 3)
    outputs = run(recipe, inputs)
    columns = directional(outputs, [{x: 1.0} for x in inputs])
    rows = [gradient([y], [1.0], inputs) for y in outputs]
    forward = Tape.build({"x": 3}, {"J": [columns[j][i] for i in range(4) for j in range(3)]})
    reverse = Tape.build({"x": 3}, {"J": [entry for row in rows for entry in row]})
    x, h = points(seed, 1)[0], 1e-40
    tape = Tape.build({"x": 3}, {"y": outputs})
    exact = np.array([tape.evaluate(x + 1j * h * e)[0].imag / h for e in np.eye(3)]).T.ravel()
    np.testing.assert_allclose(forward.evaluate(x)[0], exact, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(reverse.evaluate(x)[0], exact, rtol=1e-9, atol=1e-9)


def test_derivatives_choose_the_side_of_a_kink_and_stop_at_held_values():
    graph = Graph()
    x, y = graph.inputs("x", 2)
    outputs = [g.minimum(x, y), g.maximum(x, y), g.absolute(x), g.atan2(x, y), g.clip(x, -1.0, 1.0)]
    outputs.append(graph.hold(x * y) * y)
    columns = directional(outputs, [{x: 1.0}, {y: 1.0}])
    tape = Tape.build({"x": 2}, {"dx": columns[0], "dy": columns[1]})
    by_x, by_y = tape.evaluate(np.array([-2.0, 3.0]))
    np.testing.assert_allclose(by_x, [1, 0, -1, 3 / 13, 0, 0], atol=1e-15)
    np.testing.assert_allclose(by_y, [0, 1, 0, 2 / 13, 0, -6], atol=1e-15)


def test_equal_work_is_done_once():
    graph = Graph()
    x, y = graph.inputs("x", 2)
    tape = Tape.build(
        {"x": 2}, {"z": [(x - y) * (y - x), x / y + 1.0 / y, g.sin(-x) * g.sin(x), x * 0.0 + 1.0 * y]}
    )
    assert tape.counts == {"sub": 1, "mul": 3, "neg": 2, "inv": 1, "add": 1, "sin": 1}


def awkward_angles():
    """Angles of all sizes, quarter turns, and their neighbourhoods."""
    rng = np.random.default_rng(0)
    quarters = np.arange(-2000, 2000) * (np.pi / 2)
    near = quarters + rng.normal(size=quarters.size) * 10.0 ** rng.uniform(-16, 0, quarters.size)
    return np.concatenate(
        [rng.uniform(-4, 4, 20000), rng.uniform(-1e6, 1e6, 20000), quarters, near, [0.0, 1e-300]]
    )


@needs_long_double
@pytest.mark.parametrize("fused", [True, False])
@pytest.mark.parametrize("lanes", [1, 4, 8])
def test_sine_and_cosine_are_accurate_to_rounding(lanes, fused, monkeypatch):
    if fused and not emission.fused():
        pytest.skip("this processor has no fused multiply-add")
    monkeypatch.setattr(emission, "fused", lambda: fused)
    graph = Graph()
    (x,) = graph.inputs("x", 1)
    program = compiled(Tape.build({"x": 1}, {"y": [g.sin(x), g.cos(x)]}), lanes)
    angles = awkward_angles()
    got = program([angles[:, None]], len(angles), 1)[0]
    exact = np.stack([np.sin(LONG(1) * angles), np.cos(LONG(1) * angles)], axis=1)
    assert np.abs(got - exact).max() < 1.25e-16
    small = (np.abs(angles) < 1e-3) & (angles != 0)
    assert np.abs(got[small, 0] / exact[small, 0] - 1).max() < 3e-16


@needs_long_double
@pytest.mark.parametrize("count", [2, 3, 5, 9, 17])  # the last two are too long to be inlined
def test_sines_of_one_state_are_computed_side_by_side(count):
    graph = Graph()
    x = graph.inputs("x", count)
    program = compiled(Tape.build({"x": count}, {"y": [f(a) for a in x for f in (g.sin, g.cos)]}), 1)
    angles = np.random.default_rng(1).permutation(awkward_angles())[: 2000 * count].reshape(-1, count)
    got = program([angles], len(angles), 1)[0].reshape(-1, count, 2)
    exact = np.stack([np.sin(LONG(1) * angles), np.cos(LONG(1) * angles)], axis=2)
    assert np.abs(got - exact).max() < 1.25e-16


@needs_long_double
def test_arctangent_is_accurate_in_all_quadrants():
    graph = Graph()
    y, x = graph.inputs("x", 2)
    program = compiled(Tape.build({"x": 2}, {"a": [g.atan2(y, x)]}), 8)
    rng = np.random.default_rng(0)
    pairs = rng.normal(size=(40000, 2)) * 10.0 ** rng.uniform(-8, 8, (40000, 2))
    pairs = np.concatenate([pairs, [[0, 1], [1, 0], [0, -1], [-1, 0], [1, 1], [-1, -1], [1e-100, 1.0]]])
    got = program([pairs], len(pairs), 1)[0][:, 0]
    exact = np.arctan2(LONG(1) * pairs[:, 0], LONG(1) * pairs[:, 1])
    error = np.abs(got - exact) / np.maximum(np.abs(exact), 1e-300)
    assert error[exact != 0].max() < 4e-16
    assert got[list(pairs[:, 0]).index(0.0)] == 0.0


def test_a_long_tape_cut_into_pieces_computes_the_same(monkeypatch):
    graph = Graph()
    x = graph.inputs("x", 3)
    rng, values = np.random.default_rng(1), [*x]
    for _ in range(400):
        a, b = (values[i] for i in rng.integers(0, len(values), 2))
        values.append(apply(SMOOTH[rng.integers(len(SMOOTH))], a, g.sin(b)))
    tape = Tape.build({"x": 3}, {"y": [values[i] for i in rng.integers(0, len(values), 30)]})
    whole = compiled(tape, 4)([points(0, 9)], 9, 1)[0]
    monkeypatch.setattr(kernels, "CHUNK", 37)
    assert "@f.4(" in map_source(tape, 4)[0]
    np.testing.assert_allclose(compiled(tape, 4)([points(0, 9)], 9, 1)[0], whole, rtol=1e-13)


def test_threads_split_a_batch_without_a_trace():
    recipe = [("sin", 0, 0), ("mul", 7, 1), ("add", 8, 2)]
    program, x = compiled(tape_of(recipe), 4), points(3, 1001)
    np.testing.assert_array_equal(program([x], 1001, 7)[0], program([x], 1001, 1)[0])


def test_the_same_program_speaks_casadi():
    recipe = [("sin", 0, 0), ("div", 7, 1), ("atan2", 8, 2), ("max", 9, 7), ("sqrt", 10, 0), ("less", 0, 1)]
    tape, x = tape_of(recipe), points(5, 1)[0]
    function = tape.casadi()
    np.testing.assert_allclose(np.asarray(function(x)).ravel(), tape.evaluate(x)[0], rtol=1e-14)


def test_object_code_runs_after_a_trip_through_bytes():
    ir = """
    define void @twice(ptr %x) {
      %a = load double, ptr %x
      %b = fmul double %a, 2.0
      store double %b, ptr %x
      ret void
    }"""
    x = np.array([21.0])
    load(bytes(bytearray(compile_ir("", ir, inline=True)))).function("twice", ctypes.c_void_p)(x.ctypes.data)
    assert x[0] == 42.0


# ---- cache


@given(st.dictionaries(st.text(max_size=8), st.binary(max_size=64), max_size=4))
def test_an_entry_survives_packing_and_any_damage_is_noticed(entry):
    data = pack(entry)
    assert unpack(data) == entry
    for cut in range(0, len(data), max(1, len(data) // 20)):
        assert unpack(data[:cut]) is None
    for place in range(0, len(data), max(1, len(data) // 20)):
        assert unpack(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :]) is None


def test_a_torn_or_foreign_file_counts_as_absent_and_is_replaced(tmp_path):
    cache = Cache(tmp_path)
    key = key_of("model", b"bytes")
    assert cache.get(key) is None
    cache.put(key, {"object": b"code"})
    (path,) = tmp_path.rglob("*.pgsm")
    for damage in (b"", b"\x7fELF", path.read_bytes()[:-1]):
        path.write_bytes(damage)
        assert cache.get(key) is None
        cache.put(key, {"object": b"code"})
        assert cache.get(key) == {"object": b"code"}


def test_writers_at_once_never_show_a_half_written_entry(tmp_path):
    cache, key = Cache(tmp_path), key_of("shared")
    entries = [{"object": bytes([k]) * 200_000} for k in range(4)]
    wrong, stop = [], threading.Event()

    def write(entry):
        while not stop.is_set():
            cache.put(key, entry)

    def read():
        while not stop.is_set():
            found = cache.get(key)
            if found not in entries:
                wrong.append(found)

    cache.put(key, entries[0])
    threads = [threading.Thread(target=write, args=(e,)) for e in entries] + [threading.Thread(target=read)]
    for t in threads:
        t.start()
    stop.wait(0.5)
    stop.set()
    for t in threads:
        t.join()
    assert not wrong
    assert not list(tmp_path.rglob("*.part"))


def test_a_folder_that_refuses_is_no_error(tmp_path):
    blocked = tmp_path / "file"
    blocked.write_text("not a folder")
    cache = Cache(blocked)
    cache.put("ab12", {"object": b"code"})
    assert cache.get("ab12") is None


def test_keys_tell_apart_what_runs_together():
    assert len({key_of("ab", "c"), key_of("a", "bc"), key_of("abc"), key_of("abc", "")}) == 4


def test_the_cache_lies_where_the_user_s_settings_say(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert default_folder() == tmp_path / "pantograph" / "smooth"
    monkeypatch.setenv("XDG_CACHE_HOME", "relative/is/ignored")
    assert default_folder().is_relative_to(Path.home())
