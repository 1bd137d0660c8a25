"""Rotations by definition: series and integrals that share no formula with the code under test."""

import numpy as np
from scipy.linalg import expm


def skew(x):
    return np.array([[0, -x[2], x[1]], [x[2], 0, -x[0]], [-x[1], x[0], 0]])


def matrix(phi):
    """Rotation matrix of a rotation vector, by the matrix exponential."""
    return expm(skew(phi))


def right_jacobian(phi):
    """J = ∫ exp(-s [phi]) ds over [0, 1]: body velocity of exp(phi(t)) is J phi' (24-point Gauss rule)."""
    x, w = np.polynomial.legendre.leggauss(24)
    return sum(0.5 * wk * matrix(-0.5 * (1 + xk) * np.asarray(phi)) for xk, wk in zip(x, w, strict=True))


def body_rates(phi, dphi, ddphi, h=1e-2):
    """Body velocity and acceleration of exp(phi(t)), the latter by eighth-order central differences."""
    phi, dphi, ddphi = (np.asarray(x, dtype=float) for x in (phi, dphi, ddphi))
    weights = {1: 4 / 5, 2: -1 / 5, 3: 4 / 105, 4: -1 / 280}

    def velocity(t):
        return right_jacobian(phi + dphi * t + ddphi * t**2 / 2) @ (dphi + ddphi * t)

    return velocity(0.0), sum(c * (velocity(k * h) - velocity(-k * h)) for k, c in weights.items()) / h
