"""What a machine can do: limits of every degree of freedom, and of its battery."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import lookup
from ...sim.engines.derive import dry_friction
from ...sim.errors import PantographError
from ...sim.kinds import SCALAR
from ..gains import force_limits, limit_per_joint, per_joint
from ..nominal import Nominal

Array = NDArray[np.float64]
Limit = float | Mapping[str, float] | NDArray[np.float64] | None
WIDTH = 0.01
"""Speed w [rad/s, m/s] below which dry friction f is smoothed in programs: f v / sqrt(v^2 + w^2)."""


@dataclass(frozen=True, eq=False)
class Machine:
    """Limits of each degree of freedom (nv,); infinite where there is none.

    ``low``, ``high`` [rad, m]; ``velocity`` [rad/s, m/s]; ``acceleration`` [rad/s^2, m/s^2]; ``jerk``
    [rad/s^3, m/s^3]; ``force_low``, ``force_high`` at standstill [N m, N]; ``top_speed``: where a motor gives
    nothing more (its force falls in a straight line); ``current`` [A] of the battery, drawn at ``ampere``
    [A/(N m), A/N] of each joint's force. ``driven`` (nv,): freedoms with a drive; the others take no force.
    ``friction``: dry friction of the model [N m, N], which opposes motion and holds what rests; ``width``:
    the speed [rad/s, m/s] below which it is smoothed where nothing drives.
    """

    nominal: Nominal
    low: Array
    high: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    force_low: Array
    force_high: Array
    top_speed: Array
    ampere: Array
    current: float
    driven: NDArray[np.bool_]
    friction: Array
    width: float = WIDTH

    @property
    def asks_forces(self) -> bool:
        """Whether any limit is one of forces."""
        limited = np.isfinite(self.force_high - self.force_low) & self.driven
        return bool(limited.any() or not self.driven.all() or np.isfinite(self.current))

    @property
    def rubs(self) -> NDArray[np.bool_]:
        """Freedoms (nv,) whose dry friction counts: their forces are limited."""
        limited = np.isfinite(self.force_high - self.force_low)
        fed = (self.ampere > 0) & np.isfinite(self.current)
        return np.asarray((self.friction > 0) & self.driven & (limited | fed))

    @property
    def asks_jerk(self) -> bool:
        """Whether any joint has a limit on jerk."""
        return bool(np.isfinite(self.jerk).any())

    @property
    def model(self) -> mujoco.MjModel:
        """The machine's model, without its actuators."""
        return self.nominal.model


def machine(
    model: mujoco.MjModel,
    *,
    position: Mapping[str, tuple[float, float]] | None = None,
    velocity: Limit = None,
    acceleration: Limit = None,
    jerk: Limit = None,
    force: Limit = None,
    top_speed: Limit = None,
    ampere: Limit = None,
    current: float = np.inf,
    driven: NDArray[np.bool_] | None = None,
) -> Machine:
    """The machine of a model: ranges and forces as its file says, the rest as given (None: no limit).

    A limit is one number for all that is ``driven``, (nv,), or one a joint by name (other joints have none);
    ``force`` replaces the file's, and so does ``position``, joint -> (low, high), for the joints that it
    names. Raises PantographError for limits that are not positive, for names of no
    joint, and for a battery that feeds nothing.
    """
    low, high = np.full(model.nv, -np.inf), np.full(model.nv, np.inf)
    for joint in np.flatnonzero(model.jnt_limited):
        if int(model.jnt_type[joint]) in SCALAR:
            low[model.jnt_dofadr[joint]], high[model.jnt_dofadr[joint]] = model.jnt_range[joint]
    for name, ends in ({} if position is None else position).items():
        named = lookup(model, "joint", name)
        if int(model.jnt_type[named]) not in SCALAR or not ends[0] < ends[1]:
            raise PantographError(
                f"position of {name!r} is the range of a hinge or slide, low before high, not {tuple(ends)}"
            )
        low[model.jnt_dofadr[named]], high[model.jnt_dofadr[named]] = ends
    force_low, force_high = force_limits(model)
    if force is not None:
        force_high = _limit(model, "force", force)
        force_low = -force_high
    driven = np.ones(model.nv, dtype=bool) if driven is None else np.asarray(driven, dtype=bool)
    if not current > 0:
        raise PantographError(
            f"current of the battery must be a positive number, got {current!r}: leave it out for no limit"
        )
    if np.isfinite(current) and ampere is None:
        raise PantographError(
            "current of the battery limits nothing without what it feeds: give 'ampere', the current that "
            "a joint's drive draws for each N m or N, too"
        )

    return Machine(
        Nominal(model),
        low,
        high,
        _moving(model, "velocity", velocity, driven),
        _moving(model, "acceleration", acceleration, driven),
        _moving(model, "jerk", jerk, driven),
        force_low,
        force_high,
        _limit(model, "top_speed", top_speed),
        np.zeros(model.nv) if ampere is None else per_joint(model, "ampere", ampere),
        float(current),
        driven,
        dry_friction(model),
    )


def _moving(model: mujoco.MjModel, what: str, limit: Limit, driven: NDArray[np.bool_]) -> Array:
    """One number for all is no limit of what nothing drives."""
    out = _limit(model, what, limit)
    return out if isinstance(limit, Mapping) else np.where(driven, out, np.inf)


def _limit(model: mujoco.MjModel, what: str, limit: Limit) -> Array:
    return limit_per_joint(model, what, None if isinstance(limit, float) and limit == np.inf else limit)
