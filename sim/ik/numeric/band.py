"""Quadratic programmes over whole motions: banded, by an interior-point method (Mehrotra 1992)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from numpy.typing import NDArray

from ..space import Space

Array = NDArray[np.float64]
_REFERENCE = 10.0  # [rad/s^2]
_MARGIN = 1e-6  # of the limits, kept for rounding


@dataclass(frozen=True, eq=False)
class Limits:
    """Limits of a motion at steps of `dt`: v_max, a_max (nv,), and whether its first instant is fixed."""

    space: Space
    dt: float
    v_max: Array
    a_max: Array
    fixed: bool

    @property
    def scale(self) -> Array:
        """Second difference (nv,) that costs one: reference acceleration times dt^2."""
        return np.asarray(np.where(np.isfinite(self.a_max), self.a_max, _REFERENCE) * self.dt**2)

    def cost(self, q: Array, rows: list[tuple[Array, Array]]) -> float:
        """What a motion q (k, nq) with these goal rows costs."""
        bend = np.diff(self.space.difference(q[1:], q[:-1]), axis=0) / self.scale
        return float(sum(r @ r for r, _ in rows)) + float(np.sum(bend**2))

    def broken(self, q: Array) -> float:
        """Largest excess over velocity and acceleration limits, relative."""
        steps = self.space.difference(q[1:], q[:-1]) / self.dt
        ratio = max(self.ratio(steps, self.v_max), self.ratio(np.diff(steps, axis=0) / self.dt, self.a_max))
        return max(0.0, ratio - 1.0)

    @staticmethod
    def ratio(x: Array, bound: Array) -> float:
        """Largest |x| over its bound."""
        return float((np.abs(x) / bound).max(initial=0.0))


def smoothest_step(
    space: Space,
    q: Array,
    rows: list[tuple[Array, Array]],
    limits: Limits,
    moved: NDArray[np.bool_],
    reach: float,
) -> Array:
    """Step (k, nv) to the least of the quadratic model of a motion's cost within its limits."""
    columns = np.flatnonzero(moved)
    k, n = len(q), len(columns)
    dt = limits.dt
    first = space.difference(q[1:], q[:-1])[:, columns]
    second = np.diff(first, axis=0)
    scale = limits.scale[columns]
    H = _Banded(k, n)
    g = np.zeros((k, n))
    for i, (r, J) in enumerate(rows):
        Jc = J[:, columns]
        H.add_block(i, Jc.T @ Jc + 1e-6 * np.eye(n))
        g[i] = Jc.T @ r
    H.add_differences((1.0, -2.0, 1.0), np.broadcast_to(1.0 / scale**2, (k - 2, n)))
    g += _transposed((1.0, -2.0, 1.0), second / scale**2, k)
    low, high = _ranges(space, q, columns, reach)
    if limits.fixed:
        low[0] = high[0] = 0.0
        low[0] -= 1e-9
        high[0] += 1e-9
    v_room = limits.v_max[columns] * dt * (1 - _MARGIN)
    a_room = limits.a_max[columns] * dt * dt * (1 - _MARGIN)
    sets = [
        ((1.0,), low, high, np.full(n, reach)),
        ((-1.0, 1.0), -v_room - first, v_room - first, np.where(np.isfinite(v_room), v_room, 1.0)),
        ((1.0, -2.0, 1.0), -a_room - second, a_room - second, np.where(np.isfinite(a_room), a_room, 1.0)),
    ]
    step = np.zeros((k, space.nv))
    step[:, columns] = _interior(H, g, sets)
    return step


def _ranges(space: Space, q: Array, columns: NDArray[np.intp], reach: float) -> tuple[Array, Array]:
    """Least and greatest step (k, n) inside joint ranges and at most `reach`."""
    x = np.zeros((len(q), space.nv))
    x[:, space.scalar_v] = q[:, space.scalar_q]
    low, high = np.maximum(space.low - x, -reach), np.minimum(space.high - x, reach)
    return low[:, columns], high[:, columns]


class _Banded:
    """A symmetric matrix over k instants of n freedoms, coupled to the second next instant; lower bands."""

    def __init__(self, k: int, n: int):
        self.k, self.n = k, n
        self.bands = np.zeros((2 * n + 1, k * n))

    def copy(self) -> _Banded:
        """Another of the same content."""
        out = _Banded(self.k, self.n)
        out.bands[:] = self.bands
        return out

    def add_block(self, i: int, block: Array) -> None:
        """A symmetric block (n, n) at instant i."""
        for d in range(self.n):
            self.bands[d, i * self.n : (i + 1) * self.n - d] += np.diagonal(block, -d)

    def add_differences(self, stencil: tuple[float, ...], weight: Array) -> None:
        """S' diag(weight) S for differences over instants, weight (k - len(stencil) + 1, n)."""
        n, m = self.n, len(weight)
        for i, a in enumerate(stencil):
            for j in range(i + 1):
                band = self.bands[(i - j) * n].reshape(self.k, n)
                band[j : j + m] += a * stencil[j] * weight

    def factor(self) -> Array:
        """Cholesky factor in bands, with a little more on the diagonal where rounding asks for it."""
        bands, more = self.bands, 0.0
        for _ in range(8):
            try:
                return np.asarray(scipy.linalg.cholesky_banded(bands, lower=True, check_finite=False))
            except np.linalg.LinAlgError:
                more = max(10 * more, 1e-12 * float(bands[0].max()))
                bands = self.bands.copy()
                bands[0] += more
        raise np.linalg.LinAlgError("no factor of a banded matrix")


def _difference(stencil: tuple[float, ...], x: Array) -> Array:
    m = len(x) - len(stencil) + 1
    return np.asarray(sum(a * x[i : i + m] for i, a in enumerate(stencil)))


def _transposed(stencil: tuple[float, ...], y: Array, k: int) -> Array:
    out = np.zeros((k, y.shape[1]))
    for i, a in enumerate(stencil):
        out[i : i + len(y)] += a * y
    return out


class _Wall(NamedTuple):
    """One-sided constraints S x / width <= bound where `on`, over all instants."""

    stencil: tuple[float, ...]
    bound: Array
    on: NDArray[np.bool_]
    width: Array

    def of(self, x: Array) -> Array:
        return _difference(self.stencil, x) / self.width

    def back(self, y: Array, k: int) -> Array:
        return _transposed(self.stencil, y / self.width, k)


def _walls(k: int, n: int, sets: list[tuple[tuple[float, ...], Array, Array, Array]]) -> list[_Wall]:
    out = []
    for stencil, low, high, width in sets:
        for sign, bound in ((1.0, high), (-1.0, -low)):
            b = np.broadcast_to(bound / width, (k - len(stencil) + 1, n))
            on = np.isfinite(b)
            if on.any():
                out.append(_Wall(tuple(sign * a for a in stencil), np.where(on, b, 0.0), on, width))
    return out


def _interior(
    H: _Banded, g: Array, sets: list[tuple[tuple[float, ...], Array, Array, Array]], *, steps: int = 60
) -> Array:
    """Least 1/2 x'Hx + g'x with low <= S x <= high for every stencil S; infinite bounds bind nothing.

    `sets` are (stencil, low, high, width); rows are divided by their width, so that slacks are of order one.
    """
    k, n = H.k, H.n
    walls = _walls(k, n, sets)
    x = np.zeros((k, n))
    s = [np.where(w.on, np.maximum(w.bound, 0.1), 1.0) for w in walls]
    z = [np.where(w.on, max(1e-6, 0.1 * float(np.abs(g).mean() * w.width.mean())), 0.0) for w in walls]
    count = max(1, sum(int(w.on.sum()) for w in walls))
    first = sum(float(np.sum(si * zi)) for si, zi in zip(s, z, strict=True)) / count
    for _ in range(steps):
        stationary = g + _times(H.bands, x, n)
        for w, zi in zip(walls, z, strict=True):
            stationary = stationary + w.back(zi, k)
        gaps = [np.where(w.on, w.of(x) + si - w.bound, 0.0) for w, si in zip(walls, s, strict=True)]
        mu = sum(float(np.sum(si * zi)) for si, zi in zip(s, z, strict=True)) / count
        open_by = max((float(np.abs(gap).max()) for gap in gaps), default=0.0)
        if mu < 1e-10 * first and open_by < 1e-10:
            break
        M = H.copy()
        for w, si, zi in zip(walls, s, z, strict=True):
            M.add_differences(w.stencil, zi / si / w.width**2)
        newton = _Newton(M.factor(), stationary, gaps, s, z, walls, (k, n))
        dx, ds, dz = newton.direction([np.zeros_like(si) for si in s])
        share = _share(s, ds, z, dz, 1.0)
        ahead = sum(
            float(np.sum((si + share * d) * (zi + share * e)))
            for si, d, zi, e in zip(s, ds, z, dz, strict=True)
        )
        center = (max(ahead, 0.0) / count / mu) ** 3 * mu if mu > 0 else 0.0
        dx, ds, dz = newton.direction(
            [np.where(w.on, center - d * e, 0.0) for d, e, w in zip(ds, dz, walls, strict=True)]
        )
        share = _share(s, ds, z, dz, 0.995)
        x = x + share * dx
        s = [np.maximum(si + share * d, 1e-300) for si, d in zip(s, ds, strict=True)]
        z = [zi + share * e for zi, e in zip(z, dz, strict=True)]
    return x


class _Newton(NamedTuple):
    """The linear system of one interior-point step."""

    factor: Array
    stationary: Array
    gaps: list[Array]
    s: list[Array]
    z: list[Array]
    walls: list[_Wall]
    shape: tuple[int, int]

    def direction(self, targets: list[Array]) -> tuple[Array, list[Array], list[Array]]:
        """Steps of x, slacks and multipliers towards s z = targets."""
        right = -self.stationary
        for w, si, zi, gap, t in zip(self.walls, self.s, self.z, self.gaps, targets, strict=True):
            right = right - w.back((t + zi * gap) / si - zi, self.shape[0])
        dx = scipy.linalg.cho_solve_banded((self.factor, True), right.ravel(), check_finite=False).reshape(
            self.shape
        )
        ds = [np.where(w.on, -gap - w.of(dx), 0.0) for w, gap in zip(self.walls, self.gaps, strict=True)]
        dz = [(t - zi * d) / si - zi for t, zi, d, si in zip(targets, self.z, ds, self.s, strict=True)]
        return dx, ds, [np.where(w.on, d, 0.0) for w, d in zip(self.walls, dz, strict=True)]


def _share(s: list[Array], ds: list[Array], z: list[Array], dz: list[Array], back: float) -> float:
    """Largest step that keeps slacks and multipliers positive, times `back`."""
    share = 1.0
    for x, dx in zip([*s, *z], [*ds, *dz], strict=True):
        down = dx < 0
        if down.any():
            share = min(share, back * float((-x[down] / dx[down]).min()))
    return share


def _times(bands: Array, x: Array, n: int) -> Array:
    """Symmetric banded matrix times x (k, n)."""
    flat = x.ravel()
    out = bands[0] * flat
    for d in range(1, len(bands)):
        band = bands[d, : len(flat) - d]
        out[d:] += band * flat[:-d]
        out[:-d] += band * flat[d:]
    return np.asarray(out.reshape(x.shape))
