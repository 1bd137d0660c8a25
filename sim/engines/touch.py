"""What in a model can touch, which decides if contacts have to be computed, and what does, step by step."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from ...models import name_of
from .interface import Event

_JOINT_LIMIT = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)
_TENDON_LIMIT = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_TENDON)


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
        self.model = model
        self.events: list[Event] = []
        self._now: set[tuple[str, str]] = set()
        self._seen = b""

    def look(self, data: mujoco.MjData, t: float) -> None:
        """Note what has begun and ended, after the last evaluation of the step that starts at ``t`` [s]."""
        if not (data.ncon or data.nl or self._now):
            return
        force, kind, which = data.efc_force, data.efc_type, data.efc_id
        pushing = np.flatnonzero(force)
        geoms = data.contact.geom
        seen = b"".join((kind[pushing].tobytes(), which[pushing].tobytes(), geoms.tobytes()))
        if seen == self._seen:
            return
        self._seen = seen
        rows = zip(kind[pushing].tolist(), which[pushing].tolist(), strict=True)
        now = {self._what(k, i, geoms) for k, i in rows if k >= _JOINT_LIMIT}
        self.events += [Event(t, begun, what) for begun, what in sorted(now - self._now)]
        self.events += [Event(t, f"{ended} end", what) for ended, what in sorted(self._now - now)]
        self._now = now

    def _what(self, kind: int, index: int, geoms: NDArray[np.int32]) -> tuple[str, str]:
        """Kind and name of a row of MuJoCo's constraints: a limit's or a contact's."""
        m = self.model
        if kind in (_JOINT_LIMIT, _TENDON_LIMIT):
            return "limit", name_of(m, "joint" if kind == _JOINT_LIMIT else "tendon", index)
        return "contact", " - ".join(sorted(name_of(m, "body", int(m.geom_bodyid[g])) for g in geoms[index]))
