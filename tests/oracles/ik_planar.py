"""Planar arms in closed form, by trigonometry: all solutions, and how far a target is out of reach."""

from itertools import product

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


def nearest_within(lengths, ranges, target):
    """Least distance of the tip from a point that cannot be met within ranges (n, 2).

    At the nearest pose every joint is at an end of its range, or its anchor lies on the line through tip and
    target; all such poses are tried.
    """
    n, p, best = len(lengths), complex(*target), np.inf
    for ends in product((0, 1, None), repeat=n):  # None: free
        for signs in product((1, -1), repeat=ends.count(None)):
            q, v, turn = np.zeros(n), 0j, iter(signs)
            for k in range(
                n - 1, -1, -1
            ):  # v: from the anchor of joint k to the tip, in the frame of its link
                v = lengths[k] + v
                if ends[k] is not None:
                    q[k] = ranges[k][ends[k]]
                elif (first := ends.index(None)) == k:
                    base = forward(lengths[:k], [ranges[j][ends[j]] for j in range(k)])[-1] if k else (0, 0)
                    before = sum(ranges[j][ends[j]] for j in range(k))
                    q[k] = wrap(np.angle(next(turn) * (p - complex(*base))) - before - np.angle(v))
                else:
                    j = max(i for i in range(first, k) if ends[i] is None)
                    held = [0.0, *(ranges[i][ends[i]] for i in range(j + 1, k))]
                    link = complex(*forward(lengths[j:k], held)[-1])  # between both anchors
                    q[k] = wrap(np.angle(next(turn) * link) - sum(held) - np.angle(v))
                v = v * np.exp(1j * q[k])
            if all(low - 1e-12 <= x <= high + 1e-12 for x, (low, high) in zip(q, ranges, strict=True)):
                best = min(best, abs(complex(*forward(lengths, q)[-1]) - p))
    return best


def wrap(angle):
    return (np.asarray(angle) + np.pi) % (2 * np.pi) - np.pi
