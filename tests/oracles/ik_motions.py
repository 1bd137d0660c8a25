"""Motions to master: a figure-eight through a singularity, a walk of sliding feet."""

import numpy as np
from pantograph.sim.ik import Pose

from . import ik_cases


def wrist_arm(limits=2.9):
    """Six hinges with a spherical wrist that is singular at zero."""
    axes = [(0, 0, 1), (0, 1, 0), (0, 1, 0), (0, 0, 1), (0, 1, 0), (0, 0, 1)]
    offsets = [[0, 0, 0], [0, 0, 0.3], [0, 0, 0.4], [0, 0, 0.35], [0, 0, 0], [0, 0, 0]]
    links = [(o, ik_cases.HINGE, a, (-limits, limits)) for o, a in zip(offsets, axes, strict=True)]
    return ik_cases.chain([*links, ([0, 0, 0.1], None, None, None)])


def figure_eight(model, *, period=4.0):
    """A figure-eight of the tip whose middle has the wrist exactly singular, orientation kept."""
    q = np.array([0.2, 0.7, 1.1, 0.3, 0.0, 0.0])
    p, quat = ik_cases.pose_of(model, q, "tip")

    def goals(t):
        w = 2 * np.pi * t / period
        return [Pose("tip", np.add(p, [0.02 * np.sin(2 * w), 0.06 * np.sin(w), 0.0]), quat)]

    return q, goals


def walk(model, times):
    """A puppet that drifts forward while its legs swing: feet slide unless they are locked."""
    q = np.tile(model.qpos0, (len(times), 1))
    w = 2 * np.pi * times
    q[:, 0] += 0.1 * times
    q[:, 2] -= 0.02 + 0.01 * np.sin(w)
    for side, phase in (("left", 0.0), ("right", np.pi)):
        for joint, wave in (
            ("hip_pitch", 0.25 * np.sin(w + phase)),
            ("knee", 0.3 + 0.25 * np.sin(w + phase + 1)),
        ):
            q[:, model.joint(f"{side}_{joint}").qposadr[0]] += wave
    return q
