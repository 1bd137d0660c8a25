"""Every Runge-Kutta method meets all order conditions up to its order and misses one of the next."""

from dataclasses import replace

import numpy as np
import pytest
from oracles.rooted_trees import OrderConditions, gamma, trees
from pantograph.sim.integrate.tableaus import DOP853, DOPRI5, RK4, TABLEAUS, Tableau
from scipy.integrate import DOP853 as SCIPY_DOP853
from scipy.integrate import RK45 as SCIPY_RK45

METHODS = list(TABLEAUS.values())
PAIRS = [method for method in METHODS if method.adaptive]
NAMED = {"argvalues": METHODS, "ids": [m.name for m in METHODS]}
NAMED_PAIRS = {"argvalues": PAIRS, "ids": [m.name for m in PAIRS]}


def extended(method: Tableau) -> np.ndarray:
    """Coefficients of all stages, those of the dense output included."""
    s, m = method.stages, len(method.dense.c)
    return np.vstack([np.hstack([method.A, np.zeros((s, m))]), method.dense.A])


def order_of(A: np.ndarray, weights: np.ndarray, up_to: int) -> int:
    conditions = OrderConditions(A)
    for order in range(1, up_to + 1):
        residual, rounding = conditions.residuals(weights, order).T
        if np.any(residual > rounding):
            assert np.any(residual > 1e4 * rounding), "neither met nor clearly missed"
            return order - 1
    return up_to


def test_trees_are_counted_as_in_the_encyclopedia():
    assert [len(trees(n)) for n in range(1, 11)] == [1, 1, 2, 4, 9, 20, 48, 115, 286, 719]  # OEIS A000081
    assert sorted(gamma(t) for t in trees(4)) == [4, 8, 12, 24]


@pytest.mark.parametrize("method", **NAMED)
def test_solution_has_exactly_the_stated_order(method):
    assert order_of(method.A, method.b, method.order + 1) == method.order


@pytest.mark.parametrize("method", **NAMED_PAIRS)
def test_embedded_solution_has_exactly_the_stated_order(method):
    assert order_of(method.A, method.b - method.b_error, method.order + 1) == method.error_order


def test_cruder_estimate_of_dop853_has_order_3():
    assert order_of(DOP853.A, DOP853.b - DOP853.b_error_low, 5) == 3
    assert 2 * (DOP853.error_order + 1) - (3 + 1) == DOP853.error_exponent


@pytest.mark.parametrize("theta", [0.1, 0.5, 0.83])
@pytest.mark.parametrize("method", **NAMED)
def test_dense_output_has_exactly_the_stated_order(method, theta):
    dense = method.dense
    A = extended(method)
    powers = theta * (2 * theta - 1) ** np.arange(dense.P.shape[1])
    conditions = OrderConditions(A)
    # The polynomials cancel: evaluating them rounds by up to `terms` units of theta sum_j |P_ij x^j|.
    cancellation = 2 * len(powers) * (np.abs(dense.P) @ np.abs(powers))
    for order in range(1, dense.order + 2):
        residual, rounding = conditions.residuals(
            dense.P @ powers, order, target=theta, magnitude=cancellation
        ).T
        if order <= dense.order:
            assert np.all(residual <= rounding), (order, np.max(residual / rounding))
        else:
            assert np.any(residual > 1e4 * rounding)


@pytest.mark.parametrize("method", **NAMED)
def test_dense_output_joins_smoothly(method):
    """At both ends the slope is the first stage and the stage at the end of the step."""
    P = method.dense.P
    degrees = np.arange(P.shape[1])
    end = method.stages - 1 if method.fsal else method.stages
    rounding = 1e-15 * (np.abs(P) @ (1 + 2 * degrees))
    at_start, at_end = P @ (-1.0) ** degrees, P @ (1 + 2 * degrees)
    assert np.all(np.abs(at_start - np.eye(len(P))[0]) <= rounding)
    assert np.all(np.abs(at_end - np.eye(len(P))[end]) <= rounding)


def test_coefficients_are_those_of_an_independent_library():
    np.testing.assert_allclose(DOPRI5.A[:6, :5], SCIPY_RK45.A, rtol=1e-15)
    np.testing.assert_allclose(DOPRI5.b[:6], SCIPY_RK45.B, rtol=1e-15)
    theta = np.linspace(0, 1, 9)
    np.testing.assert_allclose(
        DOPRI5.dense.P @ (theta * (2 * theta - 1) ** np.arange(4)[:, None]),
        SCIPY_RK45.P @ theta ** np.arange(1, 5)[:, None],
        rtol=0,
        atol=1e-14,
    )
    np.testing.assert_allclose(DOPRI5.b_error, -SCIPY_RK45.E, rtol=1e-15)
    np.testing.assert_array_equal(DOP853.A, SCIPY_DOP853.A)
    np.testing.assert_array_equal(DOP853.b, SCIPY_DOP853.B)


@pytest.mark.parametrize("method", **NAMED)
def test_coefficients_cannot_be_written(method):
    for array in (method.A, method.b, method.c, method.dense.P, method.dense.A):
        with pytest.raises(ValueError, match="read-only"):
            array[...] = 0


@pytest.mark.parametrize(
    ("field", "index", "law"),
    [
        ("A", (2, 1), "row sums"),
        ("A", (1, 2), "triangular"),
        ("b", (0,), "b sums to 1"),
        ("c", (3,), "row sums"),
    ],
)
def test_a_wrong_coefficient_is_refused(field, index, law):
    array = np.array(getattr(RK4, field))
    array[index] += 1e-9
    with pytest.raises(ValueError, match=law):
        replace(RK4, **{field: array})


def test_wrong_shapes_and_halves_of_an_estimate_are_refused():
    with pytest.raises(ValueError, match="c has shape"):
        replace(RK4, c=RK4.c[:3])
    with pytest.raises(ValueError, match="go together"):
        replace(RK4, b_error=RK4.b)
