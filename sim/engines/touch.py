"""What in a model can touch, which decides if contacts have to be computed, and what does, step by step."""

from __future__ import annotations

from functools import cache, partial

import mujoco
import numpy as np

from ...models import Kind, name_of
from .interface import Event

_LIMITS: dict[int, Kind] = {
    int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT): "joint",
    int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON): "tendon",
}
_CONTACT = int(mujoco.mjtConstraint.mjCNSTR_CONTACT_FRICTIONLESS)  # the first of the kinds of contacts


def can_touch(model: mujoco.MjModel) -> bool:
    """Whether any two geoms of the model could make a contact."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT):
        return False
    if model.npair:
        return True
    excluded = {int(s) for s in model.exclude_signature}
    active = np.flatnonzero((model.geom_contype != 0) | (model.geom_conaffinity != 0))
    weld, parent = model.body_weldid, model.body_parentid
    for i, g1 in enumerate(active):
        for g2 in active[i + 1 :]:
            if not (
                model.geom_contype[g1] & model.geom_conaffinity[g2]
                or model.geom_contype[g2] & model.geom_conaffinity[g1]
            ):
                continue
            b1, b2 = sorted((int(model.geom_bodyid[g1]), int(model.geom_bodyid[g2])))
            w1, w2 = int(weld[b1]), int(weld[b2])
            if w1 == w2 or (b1 << 16) + b2 in excluded:
                continue
            # MuJoCo lets parent and child pass through each other, except for the world
            if w1 and w2 and (weld[parent[w1]] == w2 or weld[parent[w2]] == w1):
                continue
            return True
    return False


class Touch:
    """Contacts and limits that push, followed over the steps of a run.

    One begins with the first step that feels its force, so that before its event no step has, and ends with
    the first that does not.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        self.events: list[Event] = []
        self._now: set[tuple[str, str]] = set()
        self._seen = b""
        self._limit, self._contact = cache(partial(_limit, model)), cache(partial(_contact, model))

    def look(self, data: mujoco.MjData, t: float) -> None:
        """Note what has begun and ended, after the last evaluation of the step that starts at ``t`` [s]."""
        if not (data.ncon or data.nl or self._now):
            return
        pushing, kind, which = data.efc_force.astype(bool), data.efc_type, data.efc_id
        geoms = data.contact.geom
        seen = b"".join((pushing.tobytes(), kind.tobytes(), which.tobytes(), geoms.tobytes()))
        if seen == self._seen:
            return
        self._seen = seen
        rows, pairs = set(zip(kind[pushing].tolist(), which[pushing].tolist(), strict=True)), geoms.tolist()
        now = {self._limit(k, i) for k, i in rows if k in _LIMITS}
        now |= {self._contact(*pairs[i]) for k, i in rows if k >= _CONTACT}
        self.events += [Event(t, begun, what) for begun, what in sorted(now - self._now)]
        self.events += [Event(t, f"{ended} end", what) for ended, what in sorted(self._now - now)]
        self._now = now


def _limit(model: mujoco.MjModel, kind: int, index: int) -> tuple[str, str]:
    """Kind and name of the limit of a joint or tendon."""
    return "limit", name_of(model, _LIMITS[kind], index)


def _contact(model: mujoco.MjModel, *geoms: int) -> tuple[str, str]:
    """Kind and name of a contact of two geoms."""
    bodies = sorted(name_of(model, "body", int(model.geom_bodyid[g])) for g in geoms)
    return "contact", " - ".join(bodies)
