"""Saturated linear feedback about an equilibrium: its value, and from where it comes home, by simulation."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..sim.errors import PantographError
from .design.linear import held_matrices, linearise_path
from .design.riccati import Regulator, dlqr
from .nominal import Nominal

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]


class Catch:
    """LQR about rest at ``goal`` (nq,), forces cut at what the drives ``tracked`` (nv,) give, for batches.

    Cost per second: |q - goal|^2 / ``reach``^2 + |v|^2 / ``speed``^2 + (u / limit)^2, with reach and speed
    one number, or (nv,), in rad and m. Hinge angles count modulo a turn. Scalar joints only.
    """

    def __init__(
        self,
        nominal: Nominal,
        tracked: NDArray[np.bool_],
        goal: Array,
        period: float,
        *,
        reach: float | Array = 0.3,
        speed: float | Array = 1.0,
    ) -> None:
        m = nominal.model
        if m.nq != m.nv:
            raise PantographError("a catch works on hinges and slides; this model has ball or free joints")
        self.nominal, self.tracked, self.goal, self.period = nominal, tracked, goal, period
        self.hinge = np.asarray(m.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
        self.hold = nominal.weight(goal)
        if np.abs(self.hold[~tracked]).max(initial=0.0) > 1e-6 * (1.0 + np.abs(self.hold).max()):
            raise PantographError("the goal is no equilibrium: a joint without a drive would fall from it")
        self.design(reach, speed)

    def design(self, reach: float | Array, speed: float | Array) -> None:
        """Gains for these weights."""
        n = self.nominal.model.nv
        still = np.zeros((1, n))
        path = (self.goal[None], still, still, self.hold[None])
        A, B = held_matrices(*linearise_path(self.nominal, *path, inputs=self.tracked), self.period)
        scale = np.concatenate([np.broadcast_to(reach, n), np.broadcast_to(speed, n)])
        self.regulator: Regulator = dlqr(A[0], B[0], np.diag(1.0 / scale**2), np.eye(int(self.tracked.sum())))

    def state(self, q: Array, v: Array) -> Array:
        """Deviation (..., 2 nv) from the goal, angles in [-pi, pi]."""
        d = q - self.goal
        turns = np.rint(d[..., self.hinge] / (2.0 * np.pi))
        d[..., self.hinge] -= 2.0 * np.pi * turns
        return np.concatenate([d, v], axis=-1)

    def value(self, x: Array) -> Array:
        """x'P x (...,) of deviations x (..., 2 nv): the cost to come if nothing saturated."""
        return np.asarray(np.einsum("...i,...i->...", x @ self.regulator.P, x))

    def force(self, x: Array) -> Array:
        """Joint forces (..., nv) at deviations x (..., 2 nv), not yet cut."""
        tau = np.zeros((*x.shape[:-1], len(self.tracked)))
        tau[..., self.tracked] = -x @ self.regulator.K.T
        return np.asarray(np.where(self.tracked, tau + self.hold, 0.0))


def advance(nominal: Nominal, q: Array, v: Array, tau: Array, step: float, steps: int) -> tuple[Array, Array]:
    """A batch of states q, v (b, n) after ``steps`` RK4 steps under held joint forces (b, n)."""
    u = np.concatenate([np.zeros((len(q), nominal.model.nu)), tau], axis=1)
    path = nominal.pushed.rollout(q, v, u[:, None], step=step, steps=steps, hold=steps, every=steps)
    return path.q[:, -1], path.v[:, -1]


def comes_home(
    catch: Catch, q: Array, v: Array, limits: tuple[Array, Array], *, seconds: float, steps: int = 2
) -> NDArray[np.bool_]:
    """Whether each state (b, n) is brought to the goal within ``seconds`` by forces cut at
    ``limits``, least and greatest (nv,)."""
    low, high = limits
    ok = np.ones(len(q), dtype=bool)
    begin = catch.value(catch.state(q, v))
    for _ in range(int(seconds / catch.period)):
        tau = np.clip(catch.force(catch.state(q, v)), low, high)
        q, v = advance(catch.nominal, q, v, tau, catch.period / steps, steps)
        with np.errstate(invalid="ignore"):
            lost = ~np.isfinite(q).all(axis=1) | (np.abs(v).max(axis=1) > 1e3)
        q, v = np.where(lost[:, None], catch.goal, q), np.where(lost[:, None], 0.0, v)
        ok &= ~lost
    return np.asarray(ok & (catch.value(catch.state(q, v)) <= np.maximum(1e-3 * begin, 1e-9)))


@dataclass(frozen=True, eq=False)
class Basin:
    """Which starts in a plane of two coordinates come home: ``x`` (a,), ``y`` (b,), evenly spaced, and
    ``home`` (b, a)."""

    x: Array
    y: Array
    home: NDArray[np.bool_]

    @property
    def area(self) -> float:
        """Area of the starts that come home, in units of x times y: each stands for the cell around it."""
        return float(self.home.sum() * (self.x[1] - self.x[0]) * (self.y[1] - self.y[0]))


def map_basin(
    catch: Catch,
    limits: tuple[Array, Array],
    plane: tuple[int, int],
    extent: tuple[float, float],
    *,
    points: int = 81,
    seconds: float = 8.0,
) -> Basin:
    """The basin in the plane of two entries of the deviation (q, v), up to +-``extent``, by simulation.

    The other coordinates start at the goal.
    """
    n = catch.nominal.model.nv
    x, y = (np.linspace(-e, e, points) for e in extent)
    states = np.zeros((points * points, 2 * n))
    states[:, plane[0]], states[:, plane[1]] = np.tile(x, points), np.repeat(y, points)
    home = comes_home(catch, catch.goal + states[:, :n], states[:, n:], limits, seconds=seconds)
    return Basin(x, y, home.reshape(points, points))


def picture(basin: Basin, names: tuple[str, str]) -> Figure:
    """The basin as a picture with its area; ``names`` of the axes with their units."""
    from matplotlib.figure import Figure

    chart = Figure(figsize=(6, 5), layout="constrained")
    ax = chart.subplots()
    ax.pcolormesh(basin.x, basin.y, basin.home, cmap="Blues", vmin=0.0, vmax=1.5, shading="nearest")
    ax.plot(0.0, 0.0, "k+")
    ax.set_xlabel(names[0])
    ax.set_ylabel(names[1])
    says = f"comes home: area {basin.area:.4g}, {basin.home.mean():.1%} of the starts"
    ax.set_title(f"{says}; all else at rest at the goal", fontsize=10)
    return chart
