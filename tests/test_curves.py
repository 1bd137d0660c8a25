import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pantograph.sim.curves import KINDS, keyed
from pantograph.sim.easings import EASINGS
from pantograph.sim.errors import KeyingError, PantographError
from scipy.interpolate import PchipInterpolator

laws = settings(deadline=None, max_examples=100)
SHAPES = [{"kind": kind} for kind in KINDS] + [{"ease": name} for name in EASINGS]
shapes = st.sampled_from(SHAPES)
ends = st.sampled_from(["hold", "loop"])
GAUSS_X, GAUSS_W = np.polynomial.legendre.leggauss(4)  # exact for the derivatives of quintics


@st.composite
def keys(draw, min_keys=1, max_dim=3):
    """Times with gaps over four decades, values over six, some repeated; (times, values)."""
    k, dim = draw(st.integers(min_keys, 8)), draw(st.integers(1, max_dim))
    gaps = draw(st.lists(st.floats(-2, 2), min_size=k, max_size=k))
    times = draw(st.floats(-100, 100)) + np.cumsum(10.0 ** np.array(gaps))
    number = st.sampled_from([0.0, 1.0]) | st.floats(-1e3, 1e3)
    rows = draw(st.lists(st.lists(number, min_size=dim, max_size=dim), min_size=k, max_size=k))
    return times, np.array(rows)


@st.composite
def curves(draw, shape=shapes, min_keys=1):
    times, values = draw(keys(min_keys))
    before, after = draw(ends), draw(ends)
    if "loop" in (before, after):
        values[-1] = values[0]
    return keyed(times, values, **draw(shape), before=before, after=after)


def scales(curve):
    """Sizes of q, v and a over a curve and of the terms they are sums of, as yardsticks for rounding."""
    h = np.diff(curve.knots)[:, None]
    power = np.arange(len(curve.coefficients) - 1, -1, -1)[:, None, None]
    q = np.abs(curve.coefficients) * h**power
    terms = q, q * power / h, q * power * (power - 1) / h**2
    size = 1e-30 + np.abs(curve.values).max()
    h = h.min(initial=np.inf)
    return tuple(
        floor + x.sum(axis=0).max(initial=0)
        for floor, x in zip((size, 1e-3 * size / h, 1e-3 * size / h**2), terms, strict=True)
    )


def test_reference_values_of_cubic_splines():
    knots = [0, 1, 1.5, 4], [0, 2, 1.5, 3]
    assert keyed(*knots, kind="natural")(2.0).q == pytest.approx(1.16112676056338028, abs=1e-15)
    assert keyed(*knots, kind="clamped")(2.0).q == pytest.approx(1.24722580645161290, abs=1e-15)


def test_reference_overshoot_of_a_natural_cubic_and_none_of_auto():
    keyframes, t = (range(6), [0, 0, 0, 1, 1, 1]), np.linspace(0, 5, 100_001)
    assert keyed(*keyframes, kind="natural")(t).q.max() == pytest.approx(1.10924, abs=1e-5)
    auto = keyed(*keyframes)(t).q
    assert auto.min() == 0
    assert auto.max() == 1


def test_reference_values_of_minimum_jerk():
    curve = keyed([0, 1], [0, 1], ease="smooth")
    assert curve(0.3).q == pytest.approx(0.16308, abs=1e-15)
    assert curve(0.5).v == pytest.approx(15 / 8, abs=1e-14)
    assert curve((3 - np.sqrt(3)) / 6).a == pytest.approx(10 / np.sqrt(3), abs=1e-13)
    assert len(curve.breaks) == 0  # at rest at both ends, without a jump of acceleration


@laws
@given(keys(), shapes)
def test_a_curve_passes_its_keys(keyframes, shape):
    times, values = keyframes
    curve = keyed(times, values, **shape)
    np.testing.assert_allclose(curve(times).q, values, rtol=0, atol=1e-12 * scales(curve)[0])
    if shape != {"kind": "step"}:
        q = curve(times, left=True).q
        np.testing.assert_allclose(q, values, rtol=0, atol=1e-12 * scales(curve)[0])


@laws
@given(curves(min_keys=2), st.floats(0, 1), st.floats(0, 1), st.data())
def test_v_and_a_are_the_exact_derivatives_of_q_and_v(curve, x, y, data):
    """Between two knots the integral of v is the difference of q, that of a the difference of v."""
    i = data.draw(st.integers(0, len(curve.knots) - 2))
    t0, t1 = curve.knots[i] + np.sort([x, y]) * (curve.knots[i + 1] - curve.knots[i])
    assume(t1 - t0 > 1e-6 * (curve.knots[i + 1] - curve.knots[i]))
    middle = curve(t0 + (t1 - t0) * (GAUSS_X + 1) / 2)
    first, last = curve(t0), curve(t1, left=True)
    size_q, size_v, size_a = scales(curve)
    rounding = 1e-14 * max(1.0, abs(t0), abs(t1))  # of times, seen through the slopes
    for low, high, slope, sizes in (
        (first.q, last.q, middle.v, (size_q, size_v)),
        (first.v, last.v, middle.a, (size_v, size_a)),
    ):
        integral = (t1 - t0) / 2 * GAUSS_W @ slope
        tolerance = 1e-12 * sizes[0] + 10 * rounding * sizes[1]
        np.testing.assert_allclose(high - low, integral, rtol=0, atol=tolerance)


@laws
@given(keys(min_keys=2), st.sampled_from([{"kind": k} for k in ("natural", "clamped", "auto", "linear")]))
def test_each_kind_is_as_smooth_as_it_promises(keyframes, shape):
    curve = keyed(*keyframes, **shape)
    left, right = curve(curve.times, left=True), curve(curve.times)
    size_q, size_v, size_a = scales(curve)
    np.testing.assert_allclose(left.q, right.q, rtol=0, atol=1e-12 * size_q)
    if shape["kind"] in ("auto", "clamped"):  # held ends included
        np.testing.assert_allclose(left.v, right.v, rtol=0, atol=1e-11 * size_v)
    if shape["kind"] in ("natural", "clamped"):
        np.testing.assert_allclose(left.v[1:-1], right.v[1:-1], rtol=0, atol=1e-11 * size_v)
        np.testing.assert_allclose(left.a[1:-1], right.a[1:-1], rtol=0, atol=1e-10 * size_a)
    if shape["kind"] == "natural":
        np.testing.assert_allclose(right.a[0], 0, rtol=0, atol=1e-10 * size_a)
        np.testing.assert_allclose(left.a[-1], 0, rtol=0, atol=1e-10 * size_a)


@laws
@given(keys(min_keys=3))
def test_auto_has_the_slopes_of_pchip_at_inner_keys(keyframes):
    times, values = keyframes
    assume(np.all((np.diff(values, axis=0) == 0) | (np.abs(np.diff(values, axis=0)) > 1e-9)))
    expected = PchipInterpolator(times, values).derivative()(times)[1:-1]
    curve = keyed(times, values)
    np.testing.assert_allclose(curve(times).v[1:-1], expected, rtol=1e-10, atol=1e-13 * scales(curve)[1])


@laws
@given(keys(min_keys=2), st.booleans())
def test_auto_is_monotone_between_keys(keyframes, loops):
    times, values = keyframes
    if loops:
        values[-1] = values[0]
    curve = keyed(times, values, after="loop" if loops else "hold")
    s = np.linspace(0, 1, 101)
    for i in range(len(times) - 1):
        q, v, _ = curve(times[i] + s[:-1] * (times[i + 1] - times[i]))
        low, high = np.minimum(*values[i : i + 2]), np.maximum(*values[i : i + 2])
        slack = 1e-12 * scales(curve)[0]
        assert np.all(q >= low - slack)
        assert np.all(q <= high + slack)
        assert np.all(v * np.sign(values[i + 1] - values[i]) >= -1e-12 * scales(curve)[1])


@laws
@given(keys(min_keys=2), st.sampled_from([{"kind": "natural"}, {"kind": "auto"}, {"kind": "clamped"}]))
def test_a_loop_is_as_smooth_across_its_seam_as_at_a_key(keyframes, shape):
    times, values = keyframes
    values[-1] = values[0]
    curve = keyed(times, values, **shape, after="loop")
    left, right = curve(curve.end, left=True), curve(curve.end)
    size_q, size_v, size_a = scales(curve)
    np.testing.assert_allclose(left.q, right.q, rtol=0, atol=1e-12 * size_q)
    np.testing.assert_allclose(left.v, right.v, rtol=0, atol=1e-11 * size_v)
    if shape["kind"] == "natural":
        np.testing.assert_allclose(left.a, right.a, rtol=0, atol=1e-10 * size_a)


@laws
@given(curves(min_keys=2), st.integers(-20, 20), st.floats(0, 1))
def test_looped_ends_repeat_and_held_ends_stay(curve, turns, s):
    period = curve.end - curve.start
    t = curve.start + s * period
    assume(np.abs(curve.knots - t).min() > 1e-9 * period)
    there = curve(t + turns * period)
    size_q, size_v, size_a = scales(curve)
    if turns == 0 or (curve.after if turns > 0 else curve.before) == "loop":
        dt = 1e-14 * (abs(curve.start) + 21 * period)
        here = curve(t)
        np.testing.assert_allclose(there.q, here.q, rtol=0, atol=1e-12 * size_q + dt * size_v)
        np.testing.assert_allclose(there.v, here.v, rtol=0, atol=1e-12 * size_v + dt * size_a)
    else:
        np.testing.assert_array_equal(there.q, curve.values[-1 if turns > 0 else 0])
        assert not np.any(there.v)
        assert not np.any(there.a)


@laws
@given(curves(min_keys=2))
def test_breaks_are_all_the_jumps_there_are_with_their_orders(curve):
    left, right = curve(curve.knots, left=True), curve(curve.knots)
    order = dict(zip(curve.breaks, curve.break_orders, strict=True))
    for i, t in enumerate(curve.knots):
        for k, size in enumerate(scales(curve)):
            jump = np.abs(right[k][i] - left[k][i]).max()
            if order.get(t, 3) > k:
                assert jump <= 1e-8 * size
        if t in order:
            k = order[t]
            assert np.any(right[k][i] != left[k][i])


@laws
@given(curves(min_keys=2), st.floats(-3, 3), st.floats(0, 4))
def test_breaks_between_two_times_are_where_a_fine_look_finds_them(curve, x, y):
    period = curve.end - curve.start
    t0, t1 = curve.start + x * period, curve.start + (x + y) * period
    expected = []
    for turn in range(-4, 9):
        first, last = curve.knots[0] + turn * period, curve.knots[-1] + turn * period
        for t in [first, *(curve.knots[1:-1] + turn * period), last]:
            assume(min(abs(t - t0), abs(t - t1)) > 1e-9 * period)
            left, right = curve(t, left=True), curve(t)
            if t0 < t < t1 and any(
                np.abs(a - b).max() > 1e-8 * size
                for a, b, size in zip(left, right, scales(curve), strict=True)
            ):
                expected.append(t)
    found = curve.breaks_between(t0, t1)
    assert np.all((found > t0) & (found < t1))
    for t in expected:
        assert np.abs(found - t).min(initial=np.inf) <= 1e-12 * (abs(t) + period)


@laws
@given(st.integers(1, 10_000), st.sampled_from([0.1, 0.01, 1 / 60, 1 / 24, 0.3]))
def test_times_within_rounding_of_a_key_are_at_the_key(n, h):
    curve = keyed([0, n * h, n * h + 1], [1, 2, 3], kind="step")
    for t in (n * h, np.nextafter(n * h, 0), np.nextafter(n * h, 1e9), sum([h] * n) if n < 4 else n * h):
        assert curve(t).q == 2
        assert curve(t, left=True).q == 1


def test_a_loop_steps_at_every_seam_however_late():
    curve = keyed([0, 0.1, 0.3], [1, 2, 1], kind="step", after="loop")
    turns = np.arange(1, 2000)
    np.testing.assert_array_equal(curve(turns * 0.3).q, 1)
    np.testing.assert_array_equal(curve(turns * 0.3, left=True).q, 2)
    np.testing.assert_array_equal(curve(turns * 0.3 + 0.1).q, 2)
    np.testing.assert_array_equal(curve(turns * 0.3 + 0.1, left=True).q, 1)


@pytest.mark.parametrize("shape", SHAPES)
def test_a_loop_closes_exactly_though_its_keys_do_within_rounding_only(shape):
    curve = keyed([0, 1, 2], [0.3, 1, 0.3 + 1e-10], **shape, after="loop")
    assert curve(2.0).q == curve(0.0).q == 0.3
    if shape != {"kind": "step"}:
        assert curve(2.0, left=True).q == pytest.approx(0.3, abs=1e-15)


def test_one_key_is_a_constant_for_all_times():
    for shape in SHAPES:
        curve = keyed([2.0], [[3.0, 4.0]], **shape, before="loop", after="loop")
        q, v, a = curve([-1.0, 2.0, 5.0])
        np.testing.assert_array_equal(q, [[3, 4]] * 3)
        assert not v.any()
        assert not a.any()
        assert (curve.start, curve.end, curve.dim, curve.dof, len(curve.breaks)) == (2, 2, 2, 2, 0)


def test_samples_have_the_shape_of_the_times():
    curve = keyed([0, 1], [[0, 1], [2, 3]])
    for t in (0.5, [0.5], np.zeros((2, 3)), np.zeros((4, 0))):
        assert {x.shape for x in curve(t)} == {(*np.shape(t), 2)}


def test_a_curve_cannot_be_changed_nor_changes_with_its_keys():
    values = np.array([0.0, 1.0])
    curve = keyed([0, 1], values)
    values[:] = 7
    assert curve(1).q == 1
    for array in (curve.times, curve.values, curve.knots, curve.coefficients, curve.breaks):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


@pytest.mark.parametrize("name", EASINGS)
def test_easings_go_from_zero_to_one(name):
    s = np.linspace(0, 1, 1001)
    e, slope, _ = EASINGS[name](s)
    assert e[0] == 0
    assert e[-1] == pytest.approx(1, abs=1e-15)
    if not name.startswith("back") and name != "bounce":
        assert slope.min() >= 0


def test_easings_do_what_their_names_say():
    s = np.linspace(0, 1, 1001)
    e = {name: EASINGS[name](s) for name in EASINGS}
    assert e["back_in"][0].min() == pytest.approx(-0.1, abs=1e-4)
    assert e["back_out"][0].max() == pytest.approx(1.1, abs=1e-4)
    assert (e["ease_in"][1][0], e["ease_out"][1][-1]) == (0, 0)
    assert np.allclose(e["ease_out"][0], 1 - e["ease_in"][0][::-1], atol=1e-15)
    assert np.allclose(e["ease_in_out"][0], 1 - e["ease_in_out"][0][::-1], atol=1e-15)
    bounce = EASINGS["bounce"]
    assert np.allclose(bounce(np.array([4, 8, 10]) / 11)[0], 1, atol=1e-15)  # floor
    assert np.allclose(bounce(np.array([6, 9, 10.5]) / 11)[0], [3 / 4, 15 / 16, 63 / 64], atol=1e-15)  # tops
    assert np.allclose(e["bounce"][2], 2 * 7.5625, atol=1e-12)  # one gravity throughout


@laws
@given(keys(min_keys=2), st.sampled_from(list(EASINGS)), st.floats(0, 0.999))
def test_an_ease_times_the_straight_way_between_two_keys(keyframes, name, s):
    times, values = keyframes
    curve = keyed(times, values, ease=name)
    h, dq = np.diff(times)[:, None], np.diff(values, axis=0)
    t = times[:-1] + s * h[:, 0]
    s = ((t - times[:-1]) / h[:, 0])[:, None]  # as rounded
    assume(np.abs(s - EASINGS[name].knots).min() > 1e-9)
    e, de, dde = EASINGS[name](s)
    sample = curve(t)
    size_q, size_v, size_a = scales(curve)
    dt = 1e-14 * np.abs(times).max()
    np.testing.assert_allclose(sample.q, values[:-1] + dq * e, rtol=0, atol=1e-12 * size_q + dt * size_v)
    np.testing.assert_allclose(sample.v, dq * de / h, rtol=0, atol=1e-12 * size_v + dt * size_a)
    np.testing.assert_allclose(sample.a, dq * dde / h**2, rtol=0, atol=(1e-12 + 10 * dt / h.min()) * size_a)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0, 2, 1], [0, 0, 0]), r"keys 2 and 3 are out of order \(t = 2 s, 1 s\): times must increase"),
        (([0, 1, 1], [0, 0, 0]), r"keys 2 and 3 have the same time \(t = 1 s, 1 s\)"),
        (([0, 1], [0, np.nan]), "key 2 is not finite: t = 1.0, value nan"),
        (([0, np.inf], [0, 1]), "key 2 is not finite"),
        (([], []), "at least one time"),
        (([[0, 1]], [0, 1]), r"not an array of shape \(1, 2\)"),
        (([0, 1], [0, 1, 2]), "2 key times but 3 key values"),
        (([0, 1], [[[0]], [[1]]]), r"must have shape \(2,\) or \(2, d\), not \(2, 1, 1\)"),
        (([0, 1], [[0, 1], [2]]), "keys must be numbers, the same count in every key"),
        (([0, 1], ["a", "b"]), "keys must be numbers"),
    ],
)
def test_bad_keys_are_named(arguments, message):
    with pytest.raises(KeyingError, match=message):
        keyed(*arguments)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"kind": "cubic"}, "no kind of curve 'cubic'.*auto, clamped, linear, natural, step"),
        ({"ease": "smoth"}, r"no easing 'smoth' \(did you mean 'smooth'\?\)"),
        ({"kind": "natural", "ease": "smooth"}, "kind 'natural' cannot be eased"),
        ({"after": "bounce"}, "no way to go on beyond the keys 'bounce'.*hold, loop"),
        ({"after": "loop"}, r"make the last key \(1\) equal to the first \(0\)"),
        ({"before": "loop"}, "make the last key"),
    ],
)
def test_bad_options_are_named(options, message):
    with pytest.raises(KeyingError, match=message):
        keyed([0, 1], [0, 1], **options)
    assert issubclass(KeyingError, PantographError)


def test_a_time_must_be_a_number():
    with pytest.raises(KeyingError, match="not a finite number"):
        keyed([0, 1], [0, 1])([0.5, np.nan])
