"""Energy shaping of a machine with one driven joint, and the catch that waits at its goal.

After R. Lozano, I. Fantoni, D. Block (Systems & Control Letters 40, 2000) and X. Xin, M. Kaneda (Int. J.
Robust Nonlinear Control 17, 2007), for any driven joint a: with E the energy,
V = (E - E_up)^2 / 2 + kd v_a^2 / 2 + kp q_a^2 / 2 falls as -kv v_a^2 under
tau = -(kv v_a + kp q_a + kd b) / (E - E_up + kd c), where v_a' = c tau + b.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from itertools import product

import mujoco
import numpy as np
from numpy.typing import NDArray

from ..models import joint_names
from ..sim.errors import PantographError, unknown
from .basin import Catch, comes_home
from .design.linear import held_matrices, linearise_path
from .gains import force_limits, number
from .nominal import Nominal

Array = NDArray[np.float64]

_REACH = 0.6  # states that cost as much as all force, as multiples of what it moves in the machine's own time
_PACE = 0.3  # of the way home in that time
_SETTLED = 10.0  # time scales until forces are no longer cut
_LONGEST = 100.0  # time scales that a way home may take
_HOME = 3.5  # time constants in which a value falls to a thousandth


class EnergyShaping:
    """What brings the energy of a machine to that of its goal, with ``tries`` sets of gains to choose from.

    ``given``: joint -> value of the goal, its highest equilibrium for joints that are not named. Raises
    PantographError when the machine has not exactly one driven joint ``tracked`` (nv,) of limited force, or
    no such goal.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        tracked: NDArray[np.bool_],
        period: float,
        given: Mapping[str, float],
        tries: int,
        seed: int,
    ) -> None:
        if int(tracked.sum()) != 1:
            raise PantographError(f"swing-up needs exactly one tracked joint, got {int(tracked.sum())}")
        self.model, self.tracked, self.period, self.tries, self.seed = model, tracked, period, tries, seed
        self.nominal, self.a = Nominal(model), int(np.flatnonzero(tracked)[0])
        self.low, self.high = force_limits(model)
        self.weakest, self.strongest = float(self.low[self.a]), float(self.high[self.a])
        if not np.isfinite(self.strongest - self.weakest):
            raise PantographError(
                "swing-up needs to know what the drive can give: set the actuator's ctrlrange"
            )
        if not isinstance(given, Mapping):
            raise PantographError(f"goal is a value for each joint, as {{elbow = 0.0}}, not {given!r}")
        names = joint_names(model)
        for name in given:
            if name not in names:
                raise PantographError(unknown("joint", name, names))
        self.given = {name: number(f"goal of {name!r}", value) for name, value in given.items()}

    @cached_property
    def goal(self) -> Array:
        """The equilibrium to reach, (nq,): every hinge at 0 or pi, highest in energy, unless it was given."""
        m, names = self.model, joint_names(self.model)
        free = [
            j
            for j in range(m.njnt)
            if m.jnt_type[j] == mujoco.mjtJoint.mjJNT_HINGE and names[j] not in self.given
        ]
        base = np.zeros(m.nq)
        for name, value in self.given.items():
            base[m.jnt_qposadr[names.index(name)]] = value
        ends = [[x for x in (0.0, np.pi, -np.pi) if _in_range(m, j, x)][:2] for j in free]
        if not all(ends):
            lost = ", ".join(names[j] for j, x in zip(free, ends, strict=True) if not x)
            raise PantographError(f"neither 0 nor a half turn is in the range of {lost}: name a goal there")
        choices = []
        for turn in product(*ends):
            q = base.copy()
            q[m.jnt_qposadr[free]] = turn
            choices.append(q)
        heights = [float(self.nominal.smooth.energy(q, np.zeros(m.nv))[1]) for q in choices]
        return choices[int(np.argmax(heights))]

    @cached_property
    def top(self) -> float:
        """Energy at the goal [J]."""
        return float(self.nominal.smooth.energy(self.goal, np.zeros(self.model.nv))[1])

    @cached_property
    def gains(self) -> Array:
        """Sets of gains (tries, 4): natural frequency [rad/s] and damping of the driven joint, weight of its
        motion in V relative to the energy to be gained, and part of the pull to its middle while pumping."""
        rng = np.random.default_rng(self.seed)
        w = self.rate * np.exp(rng.uniform(np.log(0.2), np.log(1.5), self.tries))
        zeta = np.exp(rng.uniform(np.log(0.05), np.log(0.7), self.tries))
        weight = np.exp(rng.uniform(np.log(0.01), np.log(1.0), self.tries))
        pull = np.exp(rng.uniform(np.log(0.02), np.log(0.7), self.tries))
        return np.stack([w, zeta, weight, pull], axis=1)

    @cached_property
    def rate(self) -> float:
        """How fast the machine falls from its goal, or swings about one that is stable [rad/s]."""
        poles = np.log(np.linalg.eigvals(self.catch_open).astype(complex)) / self.period
        return float(max(poles.real.max(), np.abs(poles.imag).max(), 1e-3))

    @cached_property
    def catch_open(self) -> Array:
        """A of the machine about its goal over one period."""

        still = np.zeros((1, self.model.nv))
        path = (self.goal[None], still, still, self.nominal.weight(self.goal)[None])
        return held_matrices(*linearise_path(self.nominal, *path, inputs=self.tracked), self.period)[0]

    @cached_property
    def spare(self) -> float:
        """Force [N m, N] that the drive has in both directions beside what holds the goal."""
        hold = float(self.nominal.weight(self.goal)[self.a])
        spare = min(hold - self.weakest, self.strongest - hold)
        if spare > 0.0:
            return spare
        raise PantographError(
            f"the drive cannot hold the goal ({self.goal_says}): that takes {hold:.4g} and some to spare in "
            f"both directions, but it gives {self.weakest:.4g} to {self.strongest:.4g} [N m, N]"
        )

    @property
    def goal_says(self) -> str:
        """The goal in words."""
        values = zip(joint_names(self.model), self.goal, strict=False)
        return ", ".join(f"{name} = {value:.4g}" for name, value in values)

    @cached_property
    def catch(self) -> tuple[Catch, float]:
        """The LQR about the goal and the value below which it brings the machine home.

        States cost little beside forces: that makes the basin of cut forces wide; of some weights those with
        the largest basin are taken. The level is the highest at which 95 % of random states come home in
        simulation. Raises PantographError when nothing does.
        """
        inverse = np.linalg.inv(self.nominal.mass_matrix(self.goal))
        # |M^-1|_ia <= sqrt(M^-1_ii M^-1_aa): how fast the drive may move each joint
        pull = self.spare * np.sqrt(np.diag(inverse) * inverse[self.a, self.a]) / self.rate**2
        alike = np.full_like(pull, np.exp(np.mean(np.log(pull))))
        found: list[tuple[float, Catch, float]] = []
        for reach in (_REACH * pull, _REACH * alike, alike):
            speed = _PACE * self.rate * reach
            catch = Catch(self.nominal, self.tracked, self.goal, self.period, reach=reach, speed=speed)
            if size := self._size(catch):
                n, P = self.model.nv, catch.regulator.P
                found.append((2 * n * np.log(size) - 0.5 * np.linalg.slogdet(P)[1], catch, size))
        if not found:
            raise PantographError(
                f"no LQR about the goal ({self.goal_says}) brings the machine home within "
                f"{_LONGEST / self.rate:.3g} s, from however near, with {self.weakest:.4g} to "
                f"{self.strongest:.4g} [N m, N]: give the drive more, or name another goal"
            )
        _, catch, size = max(found, key=lambda one: one[0])
        return catch, size**2

    def _size(self, catch: Catch) -> float:
        """The square root of the level of a catch; 0 when nothing comes home."""
        n, rng = self.model.nv, np.random.default_rng(self.seed)
        P, K, poles = catch.regulator.P, catch.regulator.K, catch.regulator.poles
        root = np.linalg.cholesky(np.linalg.inv(P))
        x = rng.normal(size=(128, 2 * n))
        x = (x / np.linalg.norm(x, axis=1)[:, None]) @ root.T
        slowest = float(-np.log(np.abs(poles).max()) / self.period)
        seconds = _SETTLED / self.rate + min(_HOME / slowest, _LONGEST / self.rate)

        def works(size: float) -> bool:
            q, v = self.goal + size * x[:, :n], size * x[:, n:]
            home = comes_home(catch, q, v, (self.low, self.high), seconds=seconds)
            return bool(home.mean() >= 0.95)

        # where |K x| reaches the limit: max K x on x'P x = s^2 is s |K P^-1/2|
        size = linear = self.spare / float(np.linalg.norm(K @ root))
        while not works(size):
            size *= 0.5
            if size < 1e-3 * linear:
                return 0.0
        while size < 1e3 * linear and size >= linear and works(2.0 * size):
            size *= 2.0
        for factor in (2.0**0.5, 2.0**0.25):
            size *= factor if works(factor * size) else 1.0
        return size

    def push(self, q: Array, v: Array, where: Array, gains: Array) -> Array:
        """Energy shaping, (b, nv), with the driven joints ``where`` (b,) from their goals."""
        smooth, a = self.nominal.smooth, self.a
        w, zeta, weight, pull = gains.T
        kinetic, potential = smooth.energy(q, v)
        missing = self.top - kinetic - potential
        unit = np.zeros((2 * len(q), self.model.nv))
        unit[len(q) :, a] = 1.0
        b, pushed = np.split(smooth.forward(np.tile(q, (2, 1)), np.tile(v, (2, 1)), tau=unit)[:, a], 2)
        c = pushed - b
        scale = self.lift * weight / self.mobility
        spring = w**2 * where + 2.0 * zeta * w * v[:, a]
        # while energy is missing the denominator may vanish: the sign of the pump is what counts then
        below = scale * c - missing
        safe = np.where(
            np.abs(below) < 0.05 * scale * c, 0.05 * scale * c * np.where(below < 0, -1.0, 1.0), below
        )
        shaped = -(scale * (spring + b)) / safe
        way = np.clip(5.0 * missing / self.lift, -1.0, 1.0) * np.where(v[:, a] < 0.0, -1.0, 1.0)
        push = way * np.where(way < 0.0, -self.weakest, self.strongest)
        pumped = push - pull * spring / c
        tau = np.zeros_like(v)
        tau[:, a] = np.where(below > 0.05 * scale * c, shaped, pumped)
        return tau

    @cached_property
    def lift(self) -> float:
        """Energy between the lowest and the highest equilibrium [J]."""
        low = self.goal.copy()
        heights = []
        hinges = np.flatnonzero(self.model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE)
        for turn in product((0.0, np.pi), repeat=len(hinges)):
            low[self.model.jnt_qposadr[hinges]] = turn
            heights.append(float(self.nominal.smooth.energy(low, np.zeros(self.model.nv))[1]))
        return max(self.top - min(heights), 1e-9)

    @cached_property
    def mobility(self) -> float:
        """Acceleration of the driven joint by its force at the goal [1/(kg m^2), 1/kg]."""
        return float(np.linalg.inv(self.nominal.mass_matrix(self.goal))[self.a, self.a])


def _in_range(model: mujoco.MjModel, joint: int, value: float) -> bool:
    """Whether a joint's range, if it has one, holds a value."""
    low, high = model.jnt_range[joint]
    return bool(not model.jnt_limited[joint] or low < value < high)
