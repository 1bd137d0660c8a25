"""Linear systems from mechanisms: exact derivatives of the smooth dynamics, differences with contacts."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...models import dof_names
from ...sim.engines.prescribe import Prescriber
from ...sim.kinds import BALL, FREE
from ..nominal import Nominal, moved

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class LinearSystem:
    """dx/dt = A x + B u, or x+ = A x + B u when ``period`` [s] is not None.

    x = (tangent of q, v) about the point of linearisation, over the freedoms that are not keyed;
    A (n, n), B (n, m); ``states`` and ``inputs`` name rows and columns.
    """

    A: Array
    B: Array
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    period: float | None = None

    def __post_init__(self) -> None:
        for array in (self.A, self.B):
            array.setflags(write=False)


def linearise(
    model: mujoco.MjModel,
    q: ArrayLike,
    v: ArrayLike | None = None,
    tau: ArrayLike | None = None,
    *,
    inputs: NDArray[np.bool_] | None = None,
    keyed: NDArray[np.bool_] | None = None,
    a_keyed: ArrayLike | None = None,
) -> LinearSystem:
    """The mechanism about a state q (nq,), v (nv,) under joint forces ``tau`` (nv,), by exact derivatives.

    ``inputs`` (nv,) masks the joint forces that are inputs (default: all); ``keyed`` (nv,) the freedoms that
    move as prescribed, with accelerations ``a_keyed`` (nv,). ``v`` defaults to rest, ``tau`` to the forces
    that hold q and v there. Contacts and limits are left out. Raises EngineError for what the smooth engine
    cannot do.
    """
    nv, nominal = model.nv, Nominal(model)
    q, v = np.asarray(q, dtype=float), np.zeros(nv) if v is None else np.asarray(v, dtype=float)
    acc = np.zeros(nv) if a_keyed is None else np.asarray(a_keyed, dtype=float)
    tau = nominal.inverse(q, v, acc) if tau is None else np.asarray(tau, dtype=float)
    path = (q[None], v[None], acc[None], tau[None])
    A, B = linearise_path(nominal, *path, inputs=inputs, keyed=keyed)
    free = np.ones(nv, dtype=bool) if keyed is None else ~keyed
    return _named(model, free, free if inputs is None else inputs & free, A[0], B[0])


def linearise_path(
    nominal: Nominal,
    q: Array,
    v: Array,
    a: Array,
    tau: Array,
    *,
    inputs: NDArray[np.bool_] | None = None,
    keyed: NDArray[np.bool_] | None = None,
) -> tuple[Array, Array]:
    """A (s, n, n) and B (s, n, m) of :func:`linearise` at the s states of a path, rows of q, v, a and tau."""
    model, smooth = nominal.model, nominal.smooth_with(keyed)
    free = np.ones(model.nv, dtype=bool) if keyed is None else ~keyed
    lay = smooth.layout
    w = None if free.all() else np.hstack([q[:, lay.q_keyed], v[:, lay.v_keyed], a[:, lay.v_keyed]])
    d = smooth.derivatives(q[:, lay.q_free], v[:, free], tau=tau[:, free], w=w)
    chosen = free if inputs is None else inputs & free
    return _blocks(model, free, v, d.dq, d.dv, d.dtau[:, :, chosen[free]])


def linearise_contact(
    model: mujoco.MjModel,
    q: ArrayLike,
    v: ArrayLike | None = None,
    tau: ArrayLike | None = None,
    *,
    inputs: NDArray[np.bool_] | None = None,
    keyed: NDArray[np.bool_] | None = None,
    a_keyed: ArrayLike | None = None,
    step: float = 1e-6,
) -> LinearSystem:
    """As :func:`linearise`, by centred differences of MuJoCo's accelerations, contacts and limits included.

    Without ``tau`` no joint force acts. ``step`` is the difference in rad, m and (scaled by the joint's
    weight) N m: errors are about its square and 1e-10/step, ten times that with keyed joints. What touches
    and slides at the point is taken to go on doing so.
    """
    bare = Nominal(model).model
    bare.opt.disableflags = int(model.opt.disableflags)
    nv, data = model.nv, mujoco.MjData(bare)
    q, v = np.asarray(q, dtype=float), np.zeros(nv) if v is None else np.asarray(v, dtype=float)
    tau = np.zeros(nv) if tau is None else np.asarray(tau, dtype=float)
    acc = np.zeros(nv) if a_keyed is None else np.asarray(a_keyed, dtype=float)
    free = np.ones(nv, dtype=bool) if keyed is None else ~keyed
    prescribed = Prescriber(bare, ~free)

    def acceleration(dq: Array, dv: Array, dtau: Array) -> Array:
        mujoco.mj_resetData(prescribed.model, data)
        data.qpos[:], data.qvel[:] = moved(model, q, dq), v + dv
        prescribed.settle(data, tau + dtau, acc[~free])
        return np.array(data.qacc)[free]

    none, size = np.zeros(nv), step * max(1.0, float(np.abs(tau).max(initial=0.0)))
    blocks = []
    for place, h in ((0, step), (1, step), (2, size)):
        columns = []
        for unit in h * np.eye(nv)[free]:
            plus, minus = [none] * 3, [none] * 3
            plus[place], minus[place] = unit, -unit
            columns.append((acceleration(*plus) - acceleration(*minus)) / (2.0 * h))
        blocks.append(np.column_stack(columns))
    chosen = free if inputs is None else inputs & free
    by_q, by_v, by_tau = (block[None] for block in blocks)
    A, B = _blocks(model, free, v[None], by_q, by_v, by_tau[:, :, chosen[free]])
    return _named(model, free, chosen, A[0], B[0])


def held(system: LinearSystem, period: float) -> LinearSystem:
    """``system`` sampled every ``period`` [s] with its inputs held in between."""
    A, B = held_matrices(system.A, system.B, period)
    return LinearSystem(A, B, system.states, system.inputs, period)


def held_matrices(A: Array, B: Array, period: float) -> tuple[Array, Array]:
    """A (..., n, n) and B (..., n, m) over a held period, by the exponential of (A B; 0 0)."""
    n, m = B.shape[-2:]
    block = np.zeros((*A.shape[:-2], n + m, n + m))
    block[..., :n, :n], block[..., :n, n:] = A, B
    step = exponential(block * period)
    return step[..., :n, :n].copy(), step[..., :n, n:].copy()


def exponential(M: Array) -> Array:
    """exp(M) of matrices (..., n, n), by Taylor's series of M / 2^s (error below 1e-19) squared s times.

    SciPy's works matrix by matrix; this does thousands along a trajectory at once.
    """
    size = float(np.abs(M).sum(axis=-1).max(initial=0.0))
    halvings = max(0, int(np.ceil(np.log2(max(size, 1e-300) / 0.5))))
    M, eye = M / 2.0**halvings, np.eye(M.shape[-1])
    out = eye + M / 16.0
    for k in range(15, 0, -1):
        out = eye + M @ out / k
    for _ in range(halvings):
        out = out @ out
    return np.asarray(out)


def _blocks(
    model: mujoco.MjModel, free: NDArray[np.bool_], v: Array, by_q: Array, by_v: Array, by_tau: Array
) -> tuple[Array, Array]:
    """A and B of each row from the derivatives of its accelerations."""
    s, n = len(v), int(free.sum())
    turning = np.array([_turning(model, row)[np.ix_(free, free)] for row in v])
    A = np.block([[turning, np.broadcast_to(np.eye(n), (s, n, n))], [by_q, by_v]])
    return A, np.concatenate([np.zeros((s, n, by_tau.shape[2])), by_tau], axis=1)


def _named(
    model: mujoco.MjModel, free: NDArray[np.bool_], inputs: NDArray[np.bool_], A: Array, B: Array
) -> LinearSystem:
    names = dof_names(model)
    states = [names[i] for i in np.flatnonzero(free)]
    rates = [f"{name} rate" for name in states]
    return LinearSystem(A, B, (*states, *rates), tuple(names[i] for i in np.flatnonzero(inputs)))


def _turning(model: mujoco.MjModel, v: Array) -> Array:
    """Rate of the tangent by the tangent itself: -w x for rotations that turn at w in their own frame."""
    out = np.zeros((model.nv, model.nv))
    for joint in np.flatnonzero(np.isin(model.jnt_type, (FREE, BALL))):
        at = int(model.jnt_dofadr[joint]) + (3 if model.jnt_type[joint] == FREE else 0)
        x, y, z = v[at : at + 3]
        out[at : at + 3, at : at + 3] = -np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return out
