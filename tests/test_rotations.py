import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from oracles import rotations as oracle
from pantograph.sim import rotations as rot
from pantograph.sim.curves import KINDS, keyed
from pantograph.sim.easings import EASINGS
from pantograph.sim.errors import KeyingError
from pantograph.sim.rotation_curves import keyed_rotation
from scipy.spatial.transform import Rotation

laws = settings(deadline=None, max_examples=100)
seeds = st.integers(0, 2**32 - 1)
SHAPES = [{"kind": kind} for kind in KINDS] + [{"ease": name} for name in EASINGS]
shapes = st.sampled_from(SHAPES)
angles = st.sampled_from(
    [0.0, 1e-300, 1e-160, 1e-9, 1e-4, 0.04, 1.4999, 1.5, 1.5001, np.pi - 1e-9]
) | st.floats(0, 3.14)


def vectors(seed, angle):
    x = np.random.default_rng([seed, 1]).normal(size=3)  # independent of other draws from the same seed
    return angle * x / np.linalg.norm(x)


def quats(seed, n):
    return rot.normalize(np.random.default_rng(seed).normal(size=(n, 4)))


def angle_between(p, q):
    return np.linalg.norm(rot.log(rot.multiply(rot.conjugate(p), q)), axis=-1)


# Quaternions ------------------------------------------------------------------------------------------


@laws
@given(seeds)
def test_quaternion_algebra_agrees_with_scipy(seed):
    p, q = quats(seed, 10).reshape(2, 5, 4)
    P, Q = (Rotation.from_quat(x, scalar_first=True) for x in (p, q))
    x = np.random.default_rng(seed).normal(size=(5, 3))
    assert np.allclose(angle_between(rot.multiply(p, q), (P * Q).as_quat(scalar_first=True)), 0, atol=1e-14)
    assert np.allclose(rot.rotate(p, x), P.apply(x), rtol=0, atol=1e-14)
    assert np.allclose(rot.to_matrix(p), P.as_matrix(), rtol=0, atol=4e-15)
    assert np.allclose(angle_between(rot.from_matrix(P.as_matrix()), p), 0, atol=1e-14)
    assert np.allclose(rot.multiply(p, rot.conjugate(p)), [1, 0, 0, 0], rtol=0, atol=4e-15)
    assert np.allclose(rot.log(p), P.as_rotvec(), rtol=0, atol=1e-14)


@laws
@given(seeds, angles)
def test_exp_and_log_undo_each_other_near_identity_and_near_half_a_turn(seed, angle):
    phi = vectors(seed, angle)
    q = rot.exp(phi)
    assert np.linalg.norm(q) == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(rot.to_matrix(q), oracle.matrix(phi), rtol=0, atol=4e-15)
    np.testing.assert_allclose(rot.log(q), phi, rtol=1e-14, atol=1e-15 * angle + 1e-300)
    np.testing.assert_array_equal(rot.log(-q), rot.log(q))


@laws
@given(seeds, angles, st.sampled_from([1e-3, 1.0, 2.0]))
def test_body_rates_are_those_of_the_definition(seed, angle, speed):
    rng = np.random.default_rng(seed)
    phi, dphi, ddphi = vectors(seed, angle), speed * rng.normal(size=3), speed * rng.normal(size=3)
    v, a = rot.body_rates(phi, dphi, ddphi)
    v_oracle, a_oracle = oracle.body_rates(phi, dphi, ddphi)
    size = 1 + np.abs(dphi).max() ** 2 + np.abs(ddphi).max()
    np.testing.assert_allclose(v, v_oracle, rtol=0, atol=1e-14 * size)
    np.testing.assert_allclose(a, a_oracle, rtol=0, atol=1e-11 * size)
    J = rot.right_jacobian(phi)
    np.testing.assert_allclose(J, oracle.right_jacobian(phi), rtol=0, atol=1e-14)
    np.testing.assert_allclose(J @ rot.inverse_right_jacobian(phi), np.eye(3), rtol=0, atol=1e-13)


def test_euler_angles_and_orders_of_numbers():
    half = np.sqrt(0.5)
    assert np.allclose(rot.from_euler("x", [np.pi / 2]), [half, half, 0, 0])
    fixed = rot.from_euler("xyz", [0.1, 0.2, 0.3])
    x, y, z = (rot.exp(a * e) for a, e in zip((0.1, 0.2, 0.3), np.eye(3), strict=True))
    assert np.allclose(fixed, rot.multiply(z, rot.multiply(y, x)))
    assert np.allclose(rot.from_euler("XYZ", [0.1, 0.2, 0.3]), rot.multiply(x, rot.multiply(y, z)))
    assert rot.from_euler("zyx", np.zeros((2, 5, 3))).shape == (2, 5, 4)
    np.testing.assert_array_equal(rot.wxyz_from_xyzw([1, 2, 3, 4]), [4, 1, 2, 3])
    np.testing.assert_array_equal(rot.xyzw_from_wxyz([4, 1, 2, 3]), [1, 2, 3, 4])
    with pytest.raises(KeyingError, match=r"Euler angles 'xyz' are 3 numbers, not an array of shape \(2,\)"):
        rot.from_euler("xyz", [1, 2])
    with pytest.raises(KeyingError, match="Euler sequence 'xyq'"):
        rot.from_euler("xyq", [1, 2, 3])


def test_any_length_of_a_quaternion_but_zero_normalizes():
    for size in (1e-300, 1e-200, 1.0, 1e200, 1e300):
        np.testing.assert_allclose(rot.normalize(size * np.array([1, 1, 1, 1.0])), 0.5)
    for bad in ([0, 0, 0, 0], [np.nan, 0, 0, 1], [np.inf, 0, 0, 1]):
        with pytest.raises(KeyingError, match="zero or not finite"):
            rot.normalize(bad)
    with pytest.raises(KeyingError, match="four numbers w, x, y, z"):
        rot.normalize([1, 0, 0])


# Curves -----------------------------------------------------------------------------------------------


@st.composite
def keys(draw, min_keys=2, loops=False):
    """Times with gaps over two decades; rotations all over, or in small steps, some repeated, signs mixed."""
    k, rng = draw(st.integers(min_keys, 8)), np.random.default_rng(draw(seeds))
    times = rng.uniform(-10, 10) + np.cumsum(10 ** rng.uniform(-1, 1, k))
    steps = draw(st.sampled_from([1e-6, 0.3, 1.0, None]))
    if steps is None:
        q = rot.normalize(rng.normal(size=(k, 4)))
    else:
        q = rot.exp(np.zeros((k, 3)))
        for i in range(1, k):
            q[i] = rot.multiply(q[i - 1], rot.exp(steps * rng.normal(size=3) * rng.integers(0, 2)))
    if loops:
        q[-1] = q[0]
    assume(np.all(angle_between(q[:-1], q[1:]) < np.pi - 0.02))
    return times, q * rng.choice([-1, 1], k)[:, None]


def speed_scale(curve):
    """Largest angular velocity and acceleration at the knots, as yardsticks for rounding."""
    h = np.diff(curve.knots).min()
    samples = [*curve(curve.knots), *curve(curve.knots, left=True)]
    return tuple(max(0.1 / h**k, np.abs(samples[k]).max(), np.abs(samples[k + 3]).max()) for k in (1, 2))


def test_reference_slerp_keeps_to_the_shortest_arc_when_a_key_is_negated():
    third, twelfth = rot.exp([0, 0, 2 * np.pi / 3]), rot.exp([0, 0, np.pi / 6])
    for sign in (1, -1):
        curve = keyed_rotation([0, 1], [[1, 0, 0, 0], sign * third], kind="linear")
        np.testing.assert_allclose(curve(0.25).q, twelfth, rtol=0, atol=1e-15)


@laws
@given(keys(min_keys=1), shapes)
def test_a_curve_passes_its_keys_at_unit_norm(keyframes, shape):
    times, q = keyframes
    curve = keyed_rotation(times, q, **shape)
    assert np.all(angle_between(curve(times).q, q) < 1e-14)
    between = curve(np.linspace(times[0] - 1, times[-1] + 1, 200)).q
    np.testing.assert_allclose(np.linalg.norm(between, axis=1), 1, rtol=0, atol=1e-14)


@laws
@given(keys(), shapes, st.integers(0, 255))
def test_signs_and_lengths_of_keys_mean_nothing(keyframes, shape, bits):
    times, q = keyframes
    sign = np.where([bits >> i & 1 for i in range(len(times))], -3.0, 2.0)
    t = np.linspace(times[0], times[-1], 50)
    first, second = keyed_rotation(times, q, **shape)(t), keyed_rotation(times, sign[:, None] * q, **shape)(t)
    assert np.all(angle_between(first.q, second.q) < 1e-12)
    np.testing.assert_allclose(first.v, second.v, rtol=0, atol=1e-11 * (1 + np.abs(first.v).max()))


@laws
@given(keys(), st.sampled_from([shape for shape in SHAPES if shape != {"kind": "step"}]))
def test_samples_do_not_change_sign_along_the_way(keyframes, shape):
    curve = keyed_rotation(*keyframes, **shape)
    left, right = curve(curve.knots, left=True).q, curve(curve.knots).q
    assert np.all(np.sum(left * right, axis=1) > 0)


@laws
@given(keys(), shapes, st.data())
def test_v_and_a_are_the_derivatives_in_the_bodys_frame(keyframes, shape, data):
    """Eighth-order central differences, inside a piece, at steps that turn 0.03 rad or less."""
    curve = keyed_rotation(*keyframes, **shape)
    i = data.draw(st.integers(0, len(curve.knots) - 2))
    length = curve.knots[i + 1] - curve.knots[i]
    t = curve.knots[i] + data.draw(st.floats(0.15, 0.85)) * length
    q0, v0, a0 = curve(t)
    around = curve(t + length * np.linspace(-0.15, 0.15, 9))
    scale = 1 + (np.abs(around.v).max() + np.sqrt(np.abs(around.a).max())) * length
    h = 0.03 * length / scale
    steps = curve(t + h * np.arange(-4, 5))
    weights = np.array([1 / 280, -4 / 105, 1 / 5, -4 / 5, 0, 4 / 5, -1 / 5, 4 / 105, -1 / 280]) / h
    phi = rot.log(rot.multiply(rot.conjugate(q0), steps.q))  # phi = 0 at t: its derivative is v there
    np.testing.assert_allclose(weights @ phi * length, v0 * length, rtol=0, atol=1e-11 * scale)
    np.testing.assert_allclose(weights @ steps.v * length**2, a0 * length**2, rtol=0, atol=1e-10 * scale**2)


@laws
@given(keys(), st.sampled_from(["linear", "natural", "clamped", "auto"]))
def test_each_kind_is_as_smooth_as_it_promises(keyframes, kind):
    curve = keyed_rotation(*keyframes, kind=kind)
    left, right = curve(curve.times, left=True), curve(curve.times)
    speed, push = speed_scale(curve)
    swing = 1 + speed * (curve.end - curve.start)
    assert np.all(angle_between(left.q, right.q) < 1e-14 * swing)
    if kind in ("auto", "clamped"):  # held ends included
        np.testing.assert_allclose(left.v, right.v, rtol=0, atol=1e-12 * speed)
    if kind in ("natural", "clamped"):
        np.testing.assert_allclose(left.v[1:-1], right.v[1:-1], rtol=0, atol=1e-12 * speed)
        np.testing.assert_allclose(left.a[1:-1], right.a[1:-1], rtol=0, atol=1e-10 * push)
    if kind == "natural":
        np.testing.assert_allclose(right.a[0], 0, rtol=0, atol=1e-10 * push)
        np.testing.assert_allclose(left.a[-1], 0, rtol=0, atol=1e-10 * push)


@laws
@given(keys(loops=True), st.sampled_from(["natural", "clamped", "auto"]), st.integers(1, 50))
def test_a_loop_repeats_and_is_as_smooth_across_its_seam_as_at_a_key(keyframes, kind, turns):
    curve = keyed_rotation(*keyframes, kind=kind, before="loop", after="loop")
    period = curve.end - curve.start
    left, right = curve(curve.end, left=True), curve(curve.end)
    speed, push = speed_scale(curve)
    assert angle_between(left.q, right.q) < 1e-14 * (1 + speed * period)
    assert 0 not in curve.break_orders  # also where the loop comes back to the first key with the other sign
    np.testing.assert_allclose(left.v, right.v, rtol=0, atol=1e-12 * speed)
    if kind == "natural":
        np.testing.assert_allclose(left.a, right.a, rtol=0, atol=1e-10 * push)
    t = np.linspace(curve.start, curve.end, 20)[1:-1]
    for far in (t + turns * period, t - turns * period):
        assert np.all(angle_between(curve(far).q, curve(t).q) < 1e-12 * (1 + speed * turns * period))


@laws
@given(keys(), st.booleans())
def test_auto_never_falls_back_nor_passes_the_key(keyframes, loops):
    times, q = keyframes
    if loops:
        q[-1] = q[0]
        assume(np.all(angle_between(q[:-1], q[1:]) < np.pi - 0.02))
    curve = keyed_rotation(times, q, after="loop" if loops else "hold")
    s = np.linspace(0, 1, 201)[:-1]
    for i in range(len(times) - 1):
        arc = rot.log(rot.multiply(rot.conjugate(q[i]), q[i + 1]))
        angle = np.linalg.norm(arc)
        way = curve(times[i] + s * (times[i + 1] - times[i])).q
        if angle < 1e-9:
            assert np.all(angle_between(q[i], way) <= 2e-9)
            continue
        made_good = rot.log(rot.multiply(rot.conjugate(q[i]), way)) @ (arc / angle)
        assert np.all(np.diff(made_good) > -1e-13)
        assert made_good[0] > -1e-13
        assert made_good[-1] < angle + 1e-13
        assert np.all(angle_between(q[i], way) < angle + 1e-12)
        assert np.all(angle_between(way, q[i + 1]) < angle + 1e-12)


@laws
@given(seeds, st.integers(2, 8), shapes, st.booleans())
def test_about_a_fixed_axis_rotations_are_keyed_like_numbers(seed, k, shape, loops):
    rng = np.random.default_rng(seed)
    times, steps = np.cumsum(10 ** rng.uniform(-1, 1, k)), rng.uniform(-2.5, 2.5, k - 1)
    turns = np.concatenate([[0.0], np.cumsum(steps)])
    if loops:
        turns[-1] = 0.0
        assume(abs(turns[-2]) < 2.5)
    axis, base, after = vectors(seed, 1.0), quats(seed, 1)[0], "loop" if loops else "hold"
    q = rot.multiply(base, rot.exp(turns[:, None] * axis))
    t = np.linspace(times[0] - 0.5, times[-1] + 3.3, 97)
    number = keyed(times, turns, **shape, after=after)
    rotation = keyed_rotation(times, q, **shape, after=after)
    expected, found = number(t), rotation(t)
    assert np.all(angle_between(found.q, rot.multiply(base, rot.exp(expected.q * axis))) < 1e-12)
    for size, ours, theirs in zip(speed_scale(rotation), found[1:], expected[1:], strict=True):
        np.testing.assert_allclose(ours, theirs * axis, rtol=0, atol=1e-11 * size)
    np.testing.assert_array_equal(number.breaks, rotation.breaks)
    np.testing.assert_array_equal(number.break_orders, rotation.break_orders)


@laws
@given(keys(), shapes, seeds)
def test_turning_the_world_or_the_body_turns_the_curve(keyframes, shape, seed):
    times, q = keyframes
    p, r = quats(seed, 2)
    t = np.linspace(times[0], times[-1], 30)
    plain = keyed_rotation(times, q, **shape)(t)
    world = keyed_rotation(times, rot.multiply(p, q), **shape)(t)
    body = keyed_rotation(times, rot.multiply(q, r), **shape)(t)
    size = 1 + np.abs(plain.v).max()
    assert np.all(angle_between(world.q, rot.multiply(p, plain.q)) < 1e-11)
    np.testing.assert_allclose(world.v, plain.v, rtol=0, atol=1e-10 * size)
    assert np.all(angle_between(body.q, rot.multiply(plain.q, r)) < 1e-11)
    np.testing.assert_allclose(body.v, rot.rotate(rot.conjugate(r), plain.v), rtol=0, atol=1e-10 * size)


def test_splines_through_thousands_of_rotations_anywhere_are_found():
    rng = np.random.default_rng(5)
    times, q = np.cumsum(rng.uniform(0.1, 2, 2000)), rng.normal(size=(2000, 4))
    for kind in ("natural", "clamped"):
        assert set(keyed_rotation(times, q, kind=kind).breaks) <= {times[0], times[-1]}


@pytest.mark.parametrize("seed", [16, 311, 379, 1437])
def test_splines_that_plain_newton_does_not_find_are_found(seed):
    """Arcs near half a turn, where the residual has local minima."""
    rng = np.random.default_rng(seed)
    k = rng.integers(2, 12)
    times, q = np.cumsum(rng.uniform(0.1, 2, k)), rng.normal(size=(k, 4))
    assert set(keyed_rotation(times, q, kind="natural").breaks) <= {times[0], times[-1]}


@pytest.mark.parametrize("kind", ["linear", "natural", "clamped", "auto"])
def test_half_a_turn_between_keys_has_no_shortest_arc(kind):
    times, q = [0, 1, 2], rot.exp(np.array([0, 0, 1.0]) * np.array([[0], [0.5], [0.5 + np.pi]]))
    with pytest.raises(KeyingError, match=r"keys 2 and 3 \(t = 1 s, 2 s\) are half a turn apart"):
        keyed_rotation(times, q, kind=kind)
    keyed_rotation(times, q, kind="step")
    almost = rot.exp(np.array([[0, 0, 0], [0, 0, np.pi - 1e-6]]))
    assert np.allclose(
        rot.log(keyed_rotation([0, 1], almost, kind=kind)(0.5).q), [0, 0, np.pi / 2], atol=1e-6
    )


@pytest.mark.parametrize(
    ("quaternions", "options", "message"),
    [
        ([[1, 0, 0, 0], [0, 0, 0, 0]], {}, "zero or not finite"),
        ([[1, 0, 0], [1, 0, 0]], {}, "four numbers w, x, y, z"),
        ([[1, 0, 0, 0], rot.exp([0.1, 0, 0])], {"after": "loop"}, "the last rotation is 5.73 degrees from"),
        ([[1, 0, 0, 0], [1, 0, 0, 0]], {"kind": "slerp"}, "no kind of curve 'slerp'"),
    ],
)
def test_bad_keys_and_options_are_named(quaternions, options, message):
    with pytest.raises(KeyingError, match=message):
        keyed_rotation([0, 1], quaternions, **options)


def test_the_interface_is_that_of_all_curves():
    curve = keyed_rotation([0, 1, 3], rot.exp([[0, 0, 0], [0, 1, 0], [0, 0, 1]]))
    assert (curve.dim, curve.dof, curve.start, curve.end) == (4, 3, 0, 3)
    assert [x.shape for x in curve(np.zeros((2, 5)))] == [(2, 5, 4), (2, 5, 3), (2, 5, 3)]
    np.testing.assert_array_equal(curve.breaks, [0, 1, 3])
    np.testing.assert_array_equal(curve.break_orders, [2, 2, 2])
