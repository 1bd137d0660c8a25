"""What a resolved scene needs, found once: what its plan rests on."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..models import name_of
from .control import keyed_by_servo
from .engines.interface import Array, Drive, Role
from .engines.stiffness import Look, fastest_rate
from .engines.touch import can_touch
from .kinds import SCALAR
from .scene.build import Setup

_DEFAULT_PERIOD = 0.002  # s; period of the controller of tracked joints when the scene names none
_STIFF = 1.75  # rate times step; RK4 is stable up to 2.78, of which smoothed dry friction may take 1
_LOOKS = 5  # moments of the keys at which springs and servos are looked at


@dataclass(frozen=True)
class Needs:
    """What a scene's physics consists of."""

    setup: Setup

    @cached_property
    def touch(self) -> bool:
        """Whether any two bodies could touch."""
        return can_touch(self.setup.model)

    @cached_property
    def moved(self) -> list[str]:
        """Names of the joints that physics moves."""
        keyed = self.setup.roles == Role.KEYED
        return [name_of(self.setup.model, "joint", int(j)) for j in np.flatnonzero(~keyed)]

    @cached_property
    def period(self) -> float | None:
        """The controller's period [s] when something needs a controller."""
        setup = self.setup
        tracked = setup.roles == Role.TRACKED
        by_servo = keyed_by_servo(setup.model, setup.drives)
        needed = [j for j in np.flatnonzero(tracked) if int(j) not in by_servo]
        if not needed and not (setup.drives == Drive.CONTROLLER).any():
            return None
        return setup.scene.controller.period if setup.scene.controller else _DEFAULT_PERIOD

    @cached_property
    def fastest(self) -> float:
        """Largest natural frequency [rad/s] or rate of decay [1/s] of springs, dampers and servos: at the
        start, along the keys and at the ends of the joints' ranges."""
        setup = self.setup
        moving = np.asarray(setup.roles[setup.model.dof_jntid] != Role.KEYED)
        return fastest_rate(setup.model, self._looks(), moving)

    def _looks(self) -> list[Look]:
        setup, m = self.setup, self.setup.model
        ends = m.actuator_ctrlrange[np.arange(m.nu), np.abs(m.actuator_ctrlrange).argmax(axis=1)]
        largest: Array = np.where(m.actuator_ctrllimited, ends, 0.0)
        q0, v0 = setup.state0.q, setup.state0.v
        looks = []
        moments = _LOOKS if setup.clip.tracks or setup.servo else 1
        for t in np.linspace(0.0, setup.scene.duration, moments):
            motion, q, v, ctrl = setup.clip.evaluate(float(t)), q0.copy(), v0.copy(), largest.copy()
            q[setup.clip.qpos_mask], v[setup.clip.dofs] = (
                motion.q[setup.clip.qpos_mask],
                motion.v[setup.clip.dofs],
            )
            for i, command in setup.servo.items():
                ctrl[i] = command(np.array([t]))[0]
            looks.append(Look(q, v, ctrl))
        limited = (m.jnt_limited != 0) & np.isin(m.jnt_type, SCALAR) & (setup.roles != Role.KEYED)
        for end in (0, 1) if limited.any() and setup.scene.physics.limits else ():
            q = q0.copy()
            q[m.jnt_qposadr[limited]] = m.jnt_range[limited, end]
            looks.append(Look(q, v0, largest))
        return looks

    def why_not_smooth(self, *, touch: bool | None = None) -> list[str]:
        """Why the smooth engine cannot run the scene, if bodies could `touch`; empty when it can."""
        from .dynamics.support import unlocated, unsupported

        setup = self.setup
        m, solver, keyed = setup.model, setup.scene.solver, np.flatnonzero(setup.roles == Role.KEYED).tolist()
        reasons = []
        if self.touch if touch is None else touch:
            reasons.append('bodies can touch (physics.contacts = "none" leaves that out)')
        if limited := unlocated(m, keyed=keyed):
            reasons.append(f"{'; '.join(limited)} (physics.limits = false leaves them out)")
        h = float(m.opt.timestep) if solver.step == "auto" else solver.step
        if self.is_stiff(h) and solver.tolerance is None:
            stiff = f"{self.stiff} are stiff for an explicit method at a step of {h:g} s"
            reasons.append(f"{stiff} (solver.tolerance lets it choose its steps)")
        return reasons + unsupported(m, keyed=keyed)

    def is_stiff(self, step: float) -> bool:
        """Whether springs, dampers and servos are too fast for RK4 at a step [s]."""
        return self.fastest * step > _STIFF

    @property
    def stiff(self) -> str:
        """What is fastest, in words."""
        return f"springs, dampers or servos at {self.fastest:.3g} rad/s"
