"""Whether anything in a model can touch, which decides if contacts have to be computed."""

from __future__ import annotations

import mujoco
import numpy as np


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
