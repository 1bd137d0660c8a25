"""Exact derivatives of a Runge-Kutta step, by the chain rule over its stages."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..integrate.tableau import Tableau
from .layout import Layout
from .motion.fixed import stage_times
from .motion.rows import Prescribed, prescribed_rows
from .rigid.tree import BALL, FREE

if TYPE_CHECKING:
    from .motion.rows import Start
    from .smooth import Smooth

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Derivatives:
    """Accelerations `a` and their derivatives by q (tangent space), v and tau, (..., nv, nv) each."""

    a: Array
    dq: Array
    dv: Array
    dtau: Array


@dataclass(frozen=True)
class StepDerivatives:
    """State after one step and its derivatives.

    Attributes:
        x: (q, v, act) after the step, shape (..., nx).
        A: by the state before, both ends in the tangent space (2 nv + na), as mjd_transitionFD.
        B: by the controls, shape (..., 2 nv + na, nu).
        P: by the parameters, shape (..., 2 nv + na, np).
    """

    x: Array
    A: Array
    B: Array
    P: Array


def _tangent_map(layout: Layout, x: Array) -> Array:
    """d(q, v, act) / d(tangent) at states `x` (batch, nx), shape (batch, nx, 2 nv + na)."""
    count, nt = len(x), layout.nx - layout.nq + layout.nv
    E = np.zeros((count, layout.nx, nt))
    for kind, at, dof in layout.blocks:
        if kind == FREE:
            E[:, range(at, at + 3), range(dof, dof + 3)] = 1.0
            at, dof = at + 3, dof + 3
        if kind in (FREE, BALL):
            w, a, b, c = x[:, at : at + 4].T
            columns = [(-a, w, c, -b), (-b, -c, w, a), (-c, b, -a, w)]
            for k, column in enumerate(columns):
                E[:, at : at + 4, dof + k] = 0.5 * np.stack(column, axis=1)
        else:
            E[:, at, dof] = 1.0
    rest = range(layout.nx - layout.nq)
    E[:, [layout.nq + i for i in rest], [layout.nv + i for i in rest]] = 1.0
    return E


def _tangent_inverse(layout: Layout, x: Array) -> Array:
    """Left inverse of `_tangent_map` at unit quaternions: its transpose with rotations scaled by 4."""
    E = _tangent_map(layout, x)
    for at in layout.quaternions:
        E[:, at : at + 4] *= 4.0
    return np.swapaxes(E, 1, 2)


def _scaled(layout: Layout, x: Array, D: Array) -> Array:
    """States with unit quaternions; `D` (derivatives of x) follows."""
    for at in layout.quaternions:
        part = slice(at, at + 4)
        norm = np.linalg.norm(x[:, part], axis=1)[:, None]
        unit = x[:, part] / norm
        inner = np.einsum("bi,bij->bj", unit, D[:, part])
        D[:, part] = (D[:, part] - unit[:, :, None] * inner[:, None]) / norm[:, :, None]
        x[:, part] = unit
    return x


def step_derivatives(
    smooth: Smooth,
    start: Start,
    u: ArrayLike | None,
    *,
    step: float,
    method: Tableau,
    w: Prescribed,
    p: ArrayLike | None,
    t0: float,
) -> StepDerivatives:
    """Derivatives of one step from each state of `start`; see `Smooth.step_derivatives`."""
    lay, x0 = smooth.layout, start.x
    count, nu, npar = len(x0), lay.nu, len(smooth.parameters)
    rows = prescribed_rows(smooth, w, lambda: stage_times(method, t0, step, 1), count).array
    motion = np.broadcast_to(rows, (method.stages, lay.nw)) if rows.ndim < 3 else np.swapaxes(rows, 0, 1)
    E = _tangent_map(lay, x0)
    nt = E.shape[2]
    width = nt + nu + npar
    D0 = np.concatenate([E, np.zeros((count, lay.nx, nu + npar))], axis=2)
    K: list[Array] = []
    DK: list[Array] = []
    for row, now in zip(method.A, motion, strict=True):
        x, D = x0.copy(), D0.copy()
        for a, k, dk in zip(row, K, DK, strict=False):
            if a:
                x, D = x + step * a * k, D + step * a * dk
        rate, by = _rate(smooth, x, u, now, p)
        full = by["x"] @ D
        full[:, :, nt : nt + nu] += by["u"]
        full[:, :, nt + nu :] += by["p"]
        K.append(rate)
        DK.append(full)
    x = x0 + step * sum(b * k for b, k in zip(method.b, K, strict=True))
    D = D0 + step * sum(b * dk for b, dk in zip(method.b, DK, strict=True))
    x = _scaled(lay, x, D)
    J = _tangent_inverse(lay, x) @ D
    assert J.shape[2] == width
    parts = (x, J[:, :, :nt], J[:, :, nt : nt + nu], J[:, :, nt + nu :])
    return StepDerivatives(*(part[0] if start.single else part for part in parts))


def _rate(
    smooth: Smooth, x: Array, u: ArrayLike | None, w: Array, p: ArrayLike | None
) -> tuple[Array, dict[str, Array]]:
    lay = smooth.layout
    q, v, act = x[:, : lay.nq], x[:, lay.nq : lay.nq + lay.nv], x[:, lay.nq + lay.nv :]
    out = smooth.evaluate("rate_jacobian", q=q, v=v, act=act, u=u, w=w, p=p)
    widths = {"x": lay.nx, "u": lay.nu, "p": len(smooth.parameters)}
    return out["rate"], {name: out["d" + name].reshape(len(x), lay.nx, n) for name, n in widths.items()}
