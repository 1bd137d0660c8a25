"""Control laws that run inside compiled integrations, sampled at their period and held."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeGuard

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..compile.graph import Graph, Scalar
from ..compile.tape import Tape
from ..errors import EngineError
from .layout import Layout
from .rigid import spatial
from .rigid.tree import BALL, FREE
from .tangent import difference

Array = NDArray[np.float64]


class LawSizes(NamedTuple):
    """Sizes of a compiled law's rows, one a period, its gains, and its memory."""

    row: int
    gains: int
    memory: int


class CompiledLaw(Protocol):
    """A law that compiled integrations sample; what its key says is all that its program depends on."""

    @property
    def key(self) -> str:
        """What the program is, for the compiled code's key."""
        ...

    def sizes(self, layout: Layout) -> LawSizes:
        """Sizes of the arguments r, g, m."""
        ...

    def tape(self, layout: Layout) -> Tape:
        """The program (q, v, act, r, g, m) -> u, and the new m."""
        ...


class GivenLaw(CompiledLaw, Protocol):
    """A compiled law without memory that brings its numbers along, for rollouts and integrations."""

    def gains(self) -> Array:
        """The argument g, shape (ng,) or (batch, ng)."""
        ...

    def references(self, layout: Layout, home: Array, periods: int) -> Array:
        """The argument r, shape (nr,), (periods, nr) or (batch, periods, nr); `home` is the model's qpos0."""
        ...


def is_law(controls: object) -> TypeGuard[GivenLaw]:
    """Whether controls are a law; a tenth of the time of an isinstance of the protocol."""
    return hasattr(controls, "references")


@dataclass(frozen=True)
class LinearFeedback:
    """u = u_ref + K ((q_ref - q), (v_ref - v)), with the difference of q taken in the tangent space.

    Attributes:
        K: gains, shape (nu, 2 nv) or (batch, nu, 2 nv); where it is zero nothing is computed.
        q_ref, v_ref, u_ref: references, shape (n,), (periods, n) or (batch, periods, n); None stands for zero
            (for q: the model's qpos0).
    """

    K: ArrayLike
    q_ref: ArrayLike | None = None
    v_ref: ArrayLike | None = None
    u_ref: ArrayLike | None = None

    @property
    def key(self) -> str:
        """Where gains are: the gains themselves are an argument."""
        return self.pattern().tobytes().hex()

    def sizes(self, layout: Layout) -> LawSizes:
        """See `CompiledLaw`."""
        return LawSizes(layout.nq + layout.nv + layout.nu, int(self.pattern().sum()), 0)

    def pattern(self) -> NDArray[np.bool_]:
        """Where gains are."""
        K = np.asarray(self.K)
        mask: NDArray[np.bool_] = (K if K.ndim == 2 else np.abs(K).max(axis=0)) != 0
        return mask

    def gains(self) -> Array:
        """The gains of the pattern, shape (ng,) or (batch, ng)."""
        return np.ascontiguousarray(np.asarray(self.K, dtype=float)[..., self.pattern()])

    def references(self, layout: Layout, home: Array, periods: int) -> Array:
        """Rows (q_ref, v_ref, u_ref), shape (nr,), (periods, nr) or (batch, periods, nr)."""
        parts = []
        for name, value, size in (
            ("q_ref", home if self.q_ref is None else self.q_ref, layout.nq),
            ("v_ref", np.zeros(layout.nv) if self.v_ref is None else self.v_ref, layout.nv),
            ("u_ref", np.zeros(layout.nu) if self.u_ref is None else self.u_ref, layout.nu),
        ):
            array = np.asarray(value, dtype=float)
            if (
                array.ndim not in (1, 2, 3)
                or array.shape[-1] != size
                or array.shape[-2:-1] not in ((), (periods,))
            ):
                raise EngineError(
                    f"{name} has shape {array.shape}; expected ({size},) or (..., {periods}, {size})"
                )
            parts.append(array)
        lead = np.broadcast_shapes(*(p.shape[:-1] for p in parts))
        return np.ascontiguousarray(
            np.concatenate([np.broadcast_to(p, (*lead, p.shape[-1])) for p in parts], axis=-1)
        )

    def tape(self, layout: Layout) -> Tape:
        """See `CompiledLaw`."""
        mask = self.pattern()
        if mask.shape != (layout.nu, 2 * layout.nv):
            raise EngineError(f"K has shape {mask.shape}; expected ({layout.nu}, {2 * layout.nv})")
        graph, sizes = Graph(), {"q": layout.nq, "v": layout.nv, "act": layout.na}
        sizes |= dict(zip("rgm", self.sizes(layout), strict=True))
        nodes = {name: graph.inputs(name, size) for name, size in sizes.items()}
        r = nodes["r"]
        error = difference(layout.blocks, nodes["q"], r[: layout.nq])
        error += spatial.sub(r[layout.nq : layout.nq + layout.nv], nodes["v"])
        gains, out = iter(nodes["g"]), []
        for row, feedforward in zip(mask, r[layout.nq + layout.nv :], strict=True):
            total: Scalar = feedforward
            for j in np.flatnonzero(row):
                total = total + next(gains) * error[j]
            out.append(total)
        return Tape.build(sizes, {"u": out, "m": []})


def joint_pd(model: mujoco.MjModel, kp: ArrayLike, kd: ArrayLike) -> Array:
    """Gains K of a PD law, force kp (q_ref - q) + kd (v_ref - v), for motors on one hinge or slide each.

    `kp`, `kd` are per actuator (or one number for all) at the joint; gear and gain are divided out.
    Raises EngineError for an actuator that is not a motor on a hinge or slide.
    """
    kp, kd = (np.broadcast_to(np.asarray(k, dtype=float), (model.nu,)) for k in (kp, kd))
    K = np.zeros((model.nu, 2 * model.nv))
    for actuator in range(model.nactuator):
        joint = model.actuator_trnid[actuator, 0]
        on_joint = model.actuator_trntype[actuator] == int(mujoco.mjtTrn.mjTRN_JOINT)
        plain = model.actuator_biastype[actuator] == int(mujoco.mjtBias.mjBIAS_NONE)
        if not (on_joint and plain and model.jnt_type[joint] not in (FREE, BALL)):
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_ACTUATOR, actuator) or f"#{actuator}"
            raise EngineError(f"actuator {name} is not a motor on a hinge or slide: give the gains K in full")
        unit = model.actuator_gear[actuator, 0] * model.actuator_gainprm[actuator, 0]
        dof = model.jnt_dofadr[joint]
        K[actuator, dof], K[actuator, model.nv + dof] = kp[actuator] / unit, kd[actuator] / unit
    return K
