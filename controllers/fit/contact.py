"""Contacts as declared phases: which sites rest when, and what may push on them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.linalg import qr
from scipy.optimize import nnls

from ...models import lookup
from ...sim.errors import PantographError

Array = NDArray[np.float64]
_EDGE = 1e-9  # s: times nearer than this are the same


@dataclass(frozen=True)
class Phase:
    """Contact from ``start`` to ``stop`` [s]: the ``sites`` rest where they are, pushed within the friction
    pyramid |x| + |y| <= ``friction`` z (inside of the cone) on level ground at height ``ground`` [m]; None
    leaves the height free."""

    start: float
    stop: float
    sites: tuple[str, ...]
    friction: float = 0.8
    ground: float | None = 0.0

    def __post_init__(self) -> None:
        if not self.stop > self.start:
            raise PantographError(
                f"a contact phase ends after it begins, not {self.start:g} to {self.stop:g} s"
            )
        if not self.sites:
            raise PantographError("a contact phase names the sites that touch")
        if not self.friction > 0:
            raise PantographError(f"friction of a contact phase must be positive, got {self.friction!r}")

    def holds(self, t: Array) -> NDArray[np.bool_]:
        """Whether times t (n,) lie in the phase, ends included."""
        return np.asarray((t >= self.start - _EDGE) & (t <= self.stop + _EDGE))


def sites_of(model: mujoco.MjModel, phases: Sequence[Phase]) -> tuple[str, ...]:
    """All sites that ever touch, in the order of their first contact; raises for a name of no site."""
    sites = tuple(dict.fromkeys(s for p in phases for s in p.sites))
    for site in sites:
        lookup(model, "site", site)
    return sites


def carried(model: mujoco.MjModel, phases: Sequence[Phase]) -> NDArray[np.bool_]:
    """Freedoms (nv,) of the mechanisms that rest on the ground in ``phases``."""
    bodies = [model.site_bodyid[lookup(model, "site", site)] for site in sites_of(model, phases)]
    return np.asarray(np.isin(model.dof_treeid, model.body_treeid[bodies]))


def touching(phases: Sequence[Phase], site: str, t: Array) -> NDArray[np.bool_]:
    """Whether a site touches at times t (n,)."""
    on = np.zeros(len(t), dtype=bool)
    for p in phases:
        if site in p.sites:
            on |= p.holds(t)
    return on


def places(model: mujoco.MjModel, sites: Sequence[str], q: Array) -> tuple[Array, Array]:
    """Positions (n, 3 s) [m] of sites at q (n, nq), and their Jacobians (n, 3 s, nv) to the world's axes."""
    data = mujoco.MjData(model)
    rows = [lookup(model, "site", s) for s in sites]
    p, J = np.empty((len(q), 3 * len(rows))), np.zeros((len(q), 3 * len(rows), model.nv))
    for i, now in enumerate(q):
        data.qpos[:] = now
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        for k, site in enumerate(rows):
            p[i, 3 * k : 3 * k + 3] = data.site_xpos[site]
            mujoco.mj_jacSite(model, data, J[i, 3 * k : 3 * k + 3], None, site)
    return p, J


def independent(model: mujoco.MjModel, sites: Sequence[str], q: Array) -> list[int]:
    """Rows (of 3 a site: x, y, z) that hold the sites of each body at q (nq,) without saying anything twice.

    Points of one body do not move apart, and in a plane nothing moves across it: asking for that again would
    make the conditions of a fit dependent. Heights are preferred, then what remains by pivoting.
    """
    rng, data = np.random.default_rng(0), mujoco.MjData(model)
    chosen: list[int] = []
    rows = [lookup(model, "site", s) for s in sites]
    for body in dict.fromkeys(int(model.site_bodyid[r]) for r in rows):
        mine = [k for k, r in enumerate(rows) if model.site_bodyid[r] == body]
        ways = []
        for _ in range(4):  # all motions that the body can make, at poses of no special kind
            data.qpos[:] = q
            mujoco.mj_integratePos(model, data.qpos, rng.uniform(-1, 1, model.nv), 1.0)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_comPos(model, data)
            at, turn = np.zeros((3, model.nv)), np.zeros((3, model.nv))
            mujoco.mj_jacSite(model, data, at, turn, rows[mine[0]])
            ways.append(np.vstack([at, turn]))
        u, s, _ = np.linalg.svd(np.hstack(ways))
        basis = u[:, : int((s > 1e-8 * max(s[0], 1e-12)).sum())]
        p, _ = places(model, [sites[k] for k in mine], q[None])
        arms = p.reshape(-1, 3) - p[0, :3]
        rigid = np.vstack([np.hstack([np.eye(3), -_cross(r)]) for r in arms]) @ basis
        heights = np.tile([1.0, 1.0, 10.0], len(mine))
        _, R, order = qr((heights[:, None] * rigid).T, mode="economic", pivoting=True)
        size = np.abs(np.diag(R))
        rank = int((size > 1e-6 * max(size.max(initial=0.0), 1e-12)).sum())
        chosen += sorted(3 * mine[int(r) // 3] + int(r) % 3 for r in order[:rank])
    return chosen


def missing(
    model: mujoco.MjModel, phases: Sequence[Phase], t: Array, q: Array, need: Array, loose: NDArray[np.intp]
) -> tuple[Array, Array]:
    """What is left (n, nv) of joint forces ``need`` once contacts push as well as they can, and their forces.

    At each time the contact forces (n, 3 s) within the pyramids come nearest to what the freedoms ``loose``,
    which nothing drives, need. The left over is zero there where the motion is possible.
    """
    sites = sites_of(model, phases)
    left, forces = need.copy(), np.zeros((len(t), 3 * len(sites)))
    if not (sites and len(loose)):
        return left, forces
    _, J = places(model, sites, q)
    on = np.stack([p.holds(t) for p in phases])
    for i in np.flatnonzero(on.any(axis=0)):
        edges = []
        for p in (p for k, p in enumerate(phases) if on[k, i]):
            for site in p.sites:
                for x, y in ((1, 0), (-1, 0), (0, 1), (0, -1)):
                    edge = np.zeros(3 * len(sites))
                    at = 3 * sites.index(site)
                    edge[at : at + 3] = p.friction * x, p.friction * y, 1.0
                    edges.append(edge)
        spread = np.array(edges)
        share, _ = nnls((spread @ J[i])[:, loose].T, need[i, loose])
        forces[i] = share @ spread
        left[i] -= forces[i] @ J[i]
    return left, forces


def _cross(r: Array) -> Array:
    return np.array([[0.0, -r[2], r[1]], [r[2], 0.0, -r[0]], [-r[1], r[0], 0.0]])
