"""Small dense quadratic programmes by the dual active-set method of Goldfarb & Idnani (1983)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Minimum(NamedTuple):
    """Minimiser x (n,), whether the constraints can be met, active constraints, and steps taken."""

    x: Array
    feasible: bool
    active: tuple[int, ...]
    steps: int


def minimise(H: Array, g: Array, A: Array, b: Array, *, steps: int = 200) -> Minimum:
    """Least 1/2 x'Hx + g'x with A x <= b, for positive definite H (n, n) and A (k, n).

    Starts at the free minimum and takes in the most violated constraint until none is; ends early, not
    feasible, when the constraints contradict each other.
    """
    n = len(g)
    L = np.linalg.cholesky(H)
    back = np.linalg.inv(L)  # H^-1 = back' back
    x = -back.T @ (back @ g)
    size = np.maximum(np.linalg.norm(A, axis=1), 1e-300)
    active: list[int] = []
    u = np.zeros(0)
    for done in range(steps):
        violation = (A @ x - b) / size
        violation[active] = -np.inf
        p = int(np.argmax(violation)) if len(violation) else -1
        if p < 0 or violation[p] <= 1e-12 * (1.0 + abs(b[p]) / size[p]):
            return Minimum(x, True, tuple(active), done)
        u_p = 0.0
        while True:  # until constraint p is active or others had to leave
            normal = -(back @ A[p])  # in the space where H is unity, constraints read N' y >= ...
            N = -(back @ A[active].T) if active else np.zeros((n, 0))
            r = np.linalg.lstsq(N, normal, rcond=1e-12)[0] if active else np.zeros(0)
            z = normal - N @ r
            leaving = [k for k in range(len(active)) if r[k] > 1e-14]
            t_dual = min((u[k] / r[k] for k in leaving), default=np.inf)
            blocker = min(leaving, key=lambda k: u[k] / r[k], default=-1)
            zz = float(z @ z)
            moves = zz > 1e-20 * float(normal @ normal)
            t_primal = float(A[p] @ x - b[p]) / zz if moves else np.inf
            t = min(t_dual, t_primal)
            if not np.isfinite(t):
                return Minimum(x, False, tuple(active), done)
            if moves:
                x = x + t * (back.T @ z)
            u, u_p = u - t * r, u_p + t
            if t == t_primal:
                active.append(p)
                u = np.append(u, u_p)
                break
            del active[blocker]
            u = np.delete(u, blocker)
    return Minimum(x, False, tuple(active), steps)
