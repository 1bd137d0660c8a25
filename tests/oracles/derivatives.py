"""Derivatives on the manifold of configurations by central differences."""

import numpy as np


def differences(residuals, space, q, h=1e-6):
    """Derivative (n, m, nv) of `residuals` (n, m) at q (n, nq) by tangents of q; `space` without limits."""
    columns = []
    for v in range(space.nv):
        d = np.zeros((len(q), space.nv))
        d[:, v] = h
        plus, minus = (residuals(space.step(q, sign * d)) for sign in (1, -1))
        columns.append((plus - minus) / (2 * h))
    return np.stack(columns, axis=2) if columns else np.zeros((*residuals(q).shape, 0))


def assert_derivative(rows, space, q):
    """That rows(q).J is the derivative of rows(q).r, to what differences of rows of this size can tell."""
    J = rows(q).J
    size = (1 + np.abs(J).max(initial=0.0)) ** 2
    np.testing.assert_allclose(differences(lambda x: rows(x).r, space, q), J, atol=3e-7 * size)
