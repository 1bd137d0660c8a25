"""A retimed motion judged by nothing of ours but its positions.

On each piece the motion is a polynomial of time: positions at Chebyshev's points give its derivatives there,
and SciPy's own spline of the keys says where it has to be; forces are MuJoCo's inverse dynamics.
"""

from typing import NamedTuple

import mujoco
import numpy as np
from numpy.polynomial import chebyshev
from scipy.interpolate import CubicSpline

ROUNDING = 2e-7  # part of a limit, beyond which rounding of positions makes a piece a rough one
BEND = 10.0  # rad/s^2, by which rounding is judged where forces are limited alone
EPS = 4.0 * np.finfo(float).eps


class Judged(NamedTuple):
    """By how much limits are exceeded at least at worst, relative; the part of the time on which rounding of
    positions hides more than 2e-7 of that, and where forces are not judged; how far [rad] beginnings of
    pieces are from the spline through the keys."""

    excess: float
    rough: float
    off: float


def judged(found, path, limits, *, degree, model=None, force=None, friction=None):
    """Judge what was ``found`` for a ``path``: (times, keys (k, n)) of its first n freedoms, by ``limits``
    {order of derivative: limit}, and by ``force`` (n,) with dry ``friction`` (n,) of the ``model``."""
    times, keys = path
    n, h = keys.shape[1], np.diff(found.t)
    x = chebyshev.chebpts2(degree + 1)
    t = found.t[:-1, None] + 0.5 * h[:, None] * (x + 1.0)
    t[:, -1] = found.t[1:]
    q = found.clip.evaluate(t, left=True).q
    q[:, 0] = found.clip.evaluate(found.t[:-1]).q
    off = np.abs(q[:, 0, :n] - CubicSpline(times, keys, bc_type="natural")(found.s[:-1])).max()
    excess, rough = -np.inf, np.zeros(len(h), dtype=bool)
    size = EPS * np.abs(q[:, :, :n]).max()
    ways = {}
    for order in {1, 2, *limits}:
        matrix = _derivative(x, order)
        scale = (2.0 / h[:, None, None]) ** order
        ways[order] = scale * np.einsum("ij,pjk->pik", matrix, q[:, :, :n])
        if order in limits:
            noise = size * np.abs(matrix).sum(axis=1).max() * scale[:, 0, 0] / limits[order]
            rough |= noise > ROUNDING
            used = np.abs(ways[order]).max(axis=(1, 2)) / limits[order]
            excess = max(excess, float((used - noise).max() - 1.0))
        elif order == 2 and force is not None:
            rough |= size * np.abs(matrix).sum(axis=1).max() * scale[:, 0, 0] > ROUNDING * BEND
    if force is not None:
        tau = _forces(model, q[~rough], ways[1][~rough], ways[2][~rough])[:, :, :n]
        v = ways[1][~rough]
        tau = tau + np.where(np.abs(v) > 1e-6, friction * np.sign(v), -np.clip(tau, -friction, friction))
        excess = max(excess, float((np.abs(tau) / force).max() - 1.0))
    return Judged(excess, float(h[rough].sum() / h.sum()), float(off))


def _derivative(x, order):
    """Matrix (k, k) from values at points ``x`` (k,) to the derivative of their polynomial there."""
    back = np.linalg.inv(chebyshev.chebvander(x, len(x) - 1))
    return np.array([chebyshev.chebval(x, chebyshev.chebder(column, order)) for column in back.T]).T


def _forces(model, q, v, a):
    still = mujoco.MjModel.__copy__(model)
    disable = mujoco.mjtDisableBit
    still.opt.disableflags |= int(disable.mjDSBL_CONTACT | disable.mjDSBL_CONSTRAINT)
    data, out = mujoco.MjData(still), np.zeros((*q.shape[:2], still.nv))
    for i in np.ndindex(*q.shape[:2]):
        data.qpos[:] = q[i]
        data.qvel[: v.shape[-1]], data.qacc[: v.shape[-1]] = v[i], a[i]
        mujoco.mj_inverse(still, data)
        out[i] = data.qfrc_inverse
    return out
