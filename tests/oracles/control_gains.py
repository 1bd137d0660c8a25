"""Gains, poles and responses known in closed form or computed to 25 digits."""

import numpy as np

G = 9.81

# dx/dt = A x + B u, Q, R, K: (name, A, B, Q, R, K)


def double_integrator():
    return (
        np.array([[0.0, 1.0], [0.0, 0.0]]),
        np.array([[0.0], [1.0]]),
        np.eye(2),
        np.eye(1),
        [1.0, np.sqrt(3.0)],
    )


def inverted_pendulum():
    """m = l = 1, torque at the pivot: th'' = g th + u."""
    k1 = G + np.sqrt(G**2 + 1.0)
    A = np.array([[0.0, 1.0], [G, 0.0]])
    return A, np.array([[0.0], [1.0]]), np.eye(2), np.eye(1), [k1, np.sqrt(1.0 + 2.0 * k1)]


def ctms_cart_pendulum():
    """Cart-pendulum of the CTMS tutorials (University of Michigan), states x, x', phi, phi'."""
    M, m, b, inertia, g, length = 0.5, 0.2, 0.1, 0.006, 9.8, 0.3
    p = inertia * (M + m) + M * m * length**2
    A = np.zeros((4, 4))
    A[0, 1] = A[2, 3] = 1.0
    A[1, 1], A[1, 2] = -(inertia + m * length**2) * b / p, m**2 * g * length**2 / p
    A[3, 1], A[3, 2] = -m * length * b / p, m * g * length * (M + m) / p
    B = np.array([[0.0], [(inertia + m * length**2) / p], [0.0], [m * length / p]])
    K = [-70.7106781186547524, -37.8344539934957775, 105.529781916036666, 20.9238437492099308]
    return A, B, np.diag([5000.0, 0.0, 100.0, 0.0]), np.eye(1), K


def second_order_step(w, zeta, t):
    """Unit step response of w^2 / (s^2 + 2 zeta w s + w^2), zeta < 1."""
    wd = w * np.sqrt(1.0 - zeta**2)
    return 1.0 - np.exp(-zeta * w * t) * (np.cos(wd * t) + zeta * w / wd * np.sin(wd * t))


def lead_of_pd_double_integrator(k1, k2):
    """Crossover [rad/s] and phase margin [rad] of the loop (k1 + k2 s) / s^2."""
    w = np.sqrt(0.5 * (k2**2 + np.sqrt(k2**4 + 4.0 * k1**2)))
    return w, np.arctan(k2 * w / k1)
