"""The machine code of a scene, and the motion it is prescribed, as the smooth engine steps it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .interface import Array, Held, Problem, Role
from .limits import Limit, Limits, slack
from .timed import Timed

if TYPE_CHECKING:
    from ..dynamics.laws import CompiledLaw
    from ..dynamics.motion.guards import Guards
    from ..dynamics.motion.prescribed import Pieces
    from ..dynamics.motion.stepper import ControlledStepper
    from ..integrate import Tableau

CHUNK = 512  # steps computed in one call at most, and steps whose prescribed motion is evaluated at once


class Compiled:
    """The machine code of a run for one set of joints at rest, and the motion it is prescribed."""

    def __init__(
        self,
        problem: Problem,
        timed: Timed,
        t0: float,
        method: Tableau,
        *,
        width: float | None,
        resting: tuple[Limit, ...],
    ) -> None:
        from ..dynamics.motion.stepper import Stepper
        from ..dynamics.smooth import compile_model

        keyed = np.flatnonzero(problem.roles == Role.KEYED).tolist()
        self.timed, self.t0, self.h, self.resting = timed, t0, problem.step, resting
        self.smooth = compile_model(
            problem.model,
            keyed=[*keyed, *(limit.joint for limit in resting)],
            friction_width=width,
            timed=timed.servos.tolist(),
            wrenches=list(zip(timed.bodies.tolist(), timed.body_frame.tolist(), strict=True)),
            forces=True,
        )
        lay = self.smooth.layout
        self.nq, self.nv, self.nw = lay.nq, lay.nv, lay.nw
        self.q_free, self.v_free = np.array(lay.q_free, dtype=int), np.array(lay.v_free, dtype=int)
        self.q_keyed, self.v_keyed = np.array(lay.q_keyed, dtype=int), np.array(lay.v_keyed, dtype=int)
        self.u_held = np.array(lay.u_held, dtype=int)
        self.whole = not (len(self.q_keyed) or len(self.v_keyed))
        self.method, self.stepper = method, Stepper(self.smooth, method, CHUNK)
        self.nodes = np.asarray(method.c)
        self.timed_q = np.isin(self.q_keyed, timed.qpos)
        self.timed_v = np.isin(self.v_keyed, timed.keyed)
        self.grid: tuple[int, Array] = (-1, np.zeros((0, self.nw)))

    def gather(self, q: Array, v: Array, act: Array) -> Array:
        """The compiled model's state (nx,) of the whole model's."""
        return np.concatenate([q, v, act] if self.whole else [q[self.q_free], v[self.v_free], act])

    def spread(self, x: Array, w: Array) -> tuple[Array, Array, Array]:
        """The whole model's q, v, act of the compiled model's state and a prescribed row."""
        q, v = np.empty(self.nq + len(self.q_keyed)), np.empty(self.nv + len(self.v_keyed))
        q[self.q_free], v[self.v_free] = x[: self.nq], x[self.nq : self.nq + self.nv]
        q[self.q_keyed], v[self.v_keyed] = (part[0] for part in self.motion(w[None]))
        return q, v, x[self.nq + self.nv :].copy()

    def held(self, held: Held) -> Array:
        """Held controls and joint forces, of one time or of many, as the compiled model takes them."""
        own = held.ctrl[..., self.u_held] if len(self.u_held) else held.ctrl[..., :0]
        return np.concatenate([own, held.qfrc if self.whole else held.qfrc[..., self.v_free]], axis=-1)

    def controlled(self, law: CompiledLaw, gains: Array) -> ControlledStepper:
        """Steps in which ``law`` with ``gains`` is sampled."""
        from ..dynamics.motion.stepper import ControlledStepper

        return ControlledStepper(self.smooth, self.method, law, gains)

    def whole_held(self, u: Array) -> Held:
        """The whole model's controls and joint forces (n, ...) of rows that the compiled model takes."""
        m, own = self.smooth.model, len(self.u_held)
        ctrl, qfrc = np.zeros((len(u), m.nu)), np.zeros((len(u), m.nv))
        ctrl[:, self.u_held], qfrc[:, self.v_free] = u[:, :own], u[:, own:]
        return Held(ctrl, qfrc)

    def motion(self, w: Array) -> tuple[Array, Array]:
        """Positions and velocities of the prescribed joints in rows ``w``."""
        nqk, nvk = len(self.q_keyed), len(self.v_keyed)
        return w[:, :nqk], w[:, nqk : nqk + nvk]

    def accelerations(self, w: Array) -> Array:
        """Accelerations of the prescribed joints in rows ``w``."""
        nqk, nvk = len(self.q_keyed), len(self.v_keyed)
        return w[:, nqk + nvk : nqk + 2 * nvk]

    def at(self, offsets: Array) -> Array:
        """Prescribed rows (n, nw) at times ``offsets`` (n,) [s] after the run's start."""
        return self._rows(offsets, left=False)

    def on_grid(self, k: int, n: int) -> Array:
        """Prescribed rows of steps ``k`` to ``k + n`` of the run, a chunk of them evaluated at once."""
        first = k - k % CHUNK
        if first != self.grid[0]:
            # one chunk more than asked, since spans may straddle two
            starts = self.h * np.arange(first, first + 2 * CHUNK)
            self.grid = (first, self.prescribed(starts, self.h))
        rows = self.stepper.rows
        return self.grid[1][(k - first) * rows : (k - first + n) * rows]

    def end(self, k: int) -> Array:
        """The prescribed row (1, nw) where step ``k`` of the run begins."""
        if 0 <= self.grid[0] <= k < self.grid[0] + 2 * CHUNK:
            return np.asarray(self.grid[1][(k - self.grid[0]) * self.stepper.rows][None])
        return self._rows(np.array([k * self.h]), left=False)

    def polynomials(self, end: float) -> Pieces:
        """The prescribed motion as polynomials in time since the run's start, up to ``end``."""
        from ..dynamics.motion.adaptive import motion_of

        span = self.t0, self.t0 + end
        breaks, knots = self.timed.breaks(*span) - self.t0, self.timed.knots(*span) - self.t0
        return motion_of(self.smooth, self.at if self.nw else None, 0.0, end, breaks, knots)

    def guards(self, limits: Limits) -> Guards | None:
        """What steps of any length must not pass unseen: limits of free joints, the pull of those at rest."""
        from ..dynamics.motion.guards import Bound, Guards, Rest

        q, v, keyed = (at.tolist().index for at in (self.q_free, self.v_free, self.v_keyed))
        bounds = [Bound(q(at.qpos), v(at.dof), at.bound, at.side) for at in self._free(limits)]
        rests = [Rest(keyed(at.dof), at.side) for at in self.resting]
        return Guards(tuple(bounds), tuple(rests)) if bounds or rests else None

    def guard_offsets(self, held: Held, limits: Limits) -> Array:
        """What is added to the guards under held inputs: a controller's forces on joints at rest."""
        free = np.zeros(len(self._free(limits)))
        pushed = np.array([limit.side * held.qfrc[limit.dof] for limit in self.resting])
        return np.concatenate([free, pushed + slack(pushed)])

    def _free(self, limits: Limits) -> list[Limit]:
        """Limits of the joints that do not rest."""
        still = {limit.joint for limit in self.resting}
        return [limit for limit in limits.each if limit.joint not in still]

    def prescribed(self, starts: NDArray[np.floating], step: float) -> Array:
        """Rows (n * stages, nw) for steps that begin ``starts`` (n,) seconds after the run's start, stage by
        stage; stages at a step's end take the limit from the left, where keys may bend."""
        out = np.zeros((len(starts), len(self.nodes), self.nw))
        if self.nw:
            for i, node in enumerate(self.nodes):
                out[:, i] = self._rows(starts + node * step, left=bool(node == 1.0))
        return out.reshape(len(starts) * len(self.nodes), self.nw)

    def _rows(self, offsets: NDArray[np.floating], *, left: bool) -> Array:
        nqk, nvk, out = len(self.q_keyed), len(self.v_keyed), np.zeros((len(offsets), self.nw))
        inputs = self.timed.at(self.t0 + offsets, left=left)
        q, v, a = out[:, :nqk], out[:, nqk : nqk + nvk], out[:, nqk + nvk : nqk + 2 * nvk]
        q[:, self.timed_q], v[:, self.timed_v], a[:, self.timed_v] = inputs.q, inputs.v, inputs.a
        for limit in self.resting:
            q[:, self.q_keyed == limit.qpos] = limit.bound
        lay = self.smooth.layout
        out[:, lay.w_timed : lay.w_wrenches] = inputs.ctrl
        out[:, lay.w_wrenches :] = inputs.wrench.reshape(len(offsets), -1)
        return out
