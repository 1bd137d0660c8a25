"""Linear-quadratic regulators: SciPy's Riccati solvers, polished by Newton's method, with their residual.

Newton's method for the Riccati equation: D. Kleinman, IEEE Trans. Automatic Control 13 (1968); G. Hewer,
ibid. 16 (1971).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import linalg

from ...sim.errors import PantographError
from .analysis import Mode
from .reach import hidden_modes, unsteerable_modes

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Regulator:
    """u = -K x minimises the cost, whose value from x is x'P x.

    K (m, n); P (n, n); ``poles`` (n,) of the closed loop, continuous or discrete; ``residual``: what is left
    of the Riccati equation, relative to P.
    """

    K: Array
    P: Array
    poles: NDArray[np.complex128]
    residual: float

    def __post_init__(self) -> None:
        for array in (self.K, self.P, self.poles):
            array.setflags(write=False)


def lqr(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    N: ArrayLike | None = None,
    *,
    states: tuple[str, ...] = (),
) -> Regulator:
    """Least integral of x'Q x + u'R u + 2 x'N u under dx/dt = A x + B u.

    Raises PantographError for weights that make no sense, and naming the modes (with ``states``, where they
    are seen) that no input can steer or no weight sees when these do not die out by themselves.
    """
    A, B, Q, R, N = _checked(A, B, Q, R, N)
    _solvable(A, B, Q, R, N, states, discrete=False)
    P = linalg.solve_continuous_are(A, B, Q, R, s=N)
    for _ in range(2):
        K = linalg.solve(R, B.T @ P + N.T, assume_a="pos")
        closed = A - B @ K
        P = linalg.solve_continuous_lyapunov(closed.T, -(Q + K.T @ R @ K - N @ K - (N @ K).T))
        P = 0.5 * (P + P.T)
    K = linalg.solve(R, B.T @ P + N.T, assume_a="pos")
    rest = A.T @ P + P @ A - K.T @ R @ K + Q
    return _regulator(A, B, K, P, rest)


def dlqr(
    A: ArrayLike,
    B: ArrayLike,
    Q: ArrayLike,
    R: ArrayLike,
    N: ArrayLike | None = None,
    *,
    states: tuple[str, ...] = (),
) -> Regulator:
    """Least sum of x'Q x + u'R u + 2 x'N u under x+ = A x + B u; raises as :func:`lqr`."""
    A, B, Q, R, N = _checked(A, B, Q, R, N)
    _solvable(A, B, Q, R, N, states, discrete=True)
    P = linalg.solve_discrete_are(A, B, Q, R, s=N)
    for _ in range(2):
        K = _gain(A, B, P, R, N)
        closed = A - B @ K
        P = linalg.solve_discrete_lyapunov(closed.T, Q + K.T @ R @ K - N @ K - (N @ K).T)
        P = 0.5 * (P + P.T)
    K = _gain(A, B, P, R, N)
    rest = A.T @ P @ A - P - (A.T @ P @ B + N) @ K + Q
    return _regulator(A, B, K, P, rest)


def finite_horizon(
    A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, final: ArrayLike, steps: int
) -> tuple[Array, Array]:
    """Gains K (steps, m, n) and values P (steps + 1, n, n) of ``steps`` steps x+ = A x + B u with the cost
    x'``final`` x at their end."""
    A, B = np.asarray(A, dtype=float), np.asarray(B, dtype=float)
    return along(np.broadcast_to(A, (steps, *A.shape)), np.broadcast_to(B, (steps, *B.shape)), Q, R, final)


def along(
    A: Sequence[Array] | Array, B: Sequence[Array] | Array, Q: ArrayLike, R: ArrayLike, final: ArrayLike
) -> tuple[Array, Array]:
    """As :func:`finite_horizon` with A (s, n, n), B (s, m, n) of each step: regulation along a trajectory.

    Joseph's form keeps P symmetric and positive.
    """
    Q, R, P = (np.asarray(x, dtype=float) for x in (Q, R, final))
    gains, values = [], [P]
    for a, b in zip(reversed(A), reversed(B), strict=True):
        K = _gain(a, b, P, R, np.zeros(b.shape))
        closed = a - b @ K
        P = Q + K.T @ R @ K + closed.T @ P @ closed
        gains.append(K)
        values.append(P)
    return np.array(gains[::-1]), np.array(values[::-1])


def _gain(A: Array, B: Array, P: Array, R: Array, N: Array) -> Array:
    return np.asarray(linalg.solve(R + B.T @ P @ B, B.T @ P @ A + N.T, assume_a="pos"))


def _regulator(A: Array, B: Array, K: Array, P: Array, rest: Array) -> Regulator:
    poles = linalg.eigvals(A - B @ K)
    return Regulator(K, P, poles, float(np.linalg.norm(rest) / np.linalg.norm(P)))


def _checked(A: ArrayLike, B: ArrayLike, Q: ArrayLike, R: ArrayLike, N: ArrayLike | None) -> list[Array]:
    """The matrices as arrays of fitting shapes, Q >= 0 and R > 0, or PantographError."""
    A, B, Q, R = (np.atleast_2d(np.asarray(x, dtype=float)) for x in (A, B, Q, R))
    n, m = B.shape
    cross = np.zeros((n, m)) if N is None else np.asarray(N, dtype=float)
    for name, array, shape in (("A", A, (n, n)), ("Q", Q, (n, n)), ("R", R, (m, m)), ("N", cross, (n, m))):
        if array.shape != shape:
            raise PantographError(f"{name} has shape {array.shape}; B of shape {B.shape} needs {shape}")
        if not np.isfinite(array).all():
            raise PantographError(f"{name} has entries that are no finite numbers")
    for name, array in (("Q", Q), ("R", R)):
        if not np.allclose(array, array.T, rtol=1e-10, atol=0.0):
            raise PantographError(f"the weight {name} must be symmetric")
    if np.linalg.eigvalsh(R).min() <= 0.0:
        raise PantographError("the weight R of the inputs must be positive definite: every input must cost")
    if np.linalg.eigvalsh(Q).min() < -1e-10 * np.abs(Q).max():
        raise PantographError("the weight Q of the states must not be negative in any direction")
    return [A, B, Q, R, cross]


def _solvable(
    A: Array, B: Array, Q: Array, R: Array, N: Array, states: tuple[str, ...], *, discrete: bool
) -> None:
    stuck = [m for m in unsteerable_modes(A, B, discrete=discrete, states=states) if not m.stable]
    if stuck:
        raise PantographError(f"no regulator exists: no input can steer {_seen(stuck, 'the mode ')}")
    inner = A - B @ np.linalg.solve(R, N.T)
    unseen = [
        m
        for m in hidden_modes(inner, Q - N @ np.linalg.solve(R, N.T), discrete=discrete, states=states)
        if abs(m.damped if not discrete else 1.0 - abs(m.pole)) < 1e-9
    ]
    if unseen:
        raise PantographError(f"no regulator exists: no weight sees {_seen(unseen, 'the mode ')}")


def _seen(modes: list[Mode], otherwise: str) -> str:
    """The states where modes are seen, or the modes."""
    names = dict.fromkeys(mode.of for mode in modes if mode.of)
    return ", ".join(names) or otherwise + "; ".join(map(str, modes))
