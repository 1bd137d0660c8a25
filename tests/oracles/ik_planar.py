"""Planar arms in closed form, by trigonometry: all solutions, and how far a target is out of reach."""

import numpy as np


def forward(lengths, q):
    """Points (n + 1, 2) of a planar chain with joint angles q: base, elbows, tip."""
    angles = np.cumsum(q)
    steps = np.asarray(lengths)[:, None] * np.column_stack([np.cos(angles), np.sin(angles)])
    return np.vstack([np.zeros(2), np.cumsum(steps, axis=0)])


def two_links(lengths, target):
    """Both solutions (2, 2) for a point within reach: law of cosines."""
    a, b = lengths
    x, y = target
    c = (x * x + y * y - a * a - b * b) / (2 * a * b)
    out = []
    for sign in (1, -1):
        elbow = sign * np.arccos(np.clip(c, -1, 1))
        shoulder = np.arctan2(y, x) - np.arctan2(b * np.sin(elbow), a + b * np.cos(elbow))
        out.append([wrap(shoulder), elbow])
    return np.array(out)


def three_links_pose(lengths, target, heading):
    """Both solutions (2, 3) for a point and the last link's heading, when the wrist is within reach."""
    wrist = np.asarray(target) - lengths[2] * np.array([np.cos(heading), np.sin(heading)])
    pairs = two_links(lengths[:2], wrist)
    return np.column_stack([pairs, wrap(heading - pairs.sum(axis=1))])


def gap(lengths, distance):
    """How far a point at this distance from the base is outside the reachable ring."""
    longest = max(lengths)
    inner = max(0.0, 2 * longest - sum(lengths))
    return max(0.0, distance - sum(lengths), inner - distance)


def wrap(angle):
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
