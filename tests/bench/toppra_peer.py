"""Retiming by toppra, in its own environment: reads batches of paths and limits, prints results (JSON).

Interpreted by another Python than ours: it must not import pantograph.
"""

import json
import logging
import sys
import time

import numpy as np
import toppra
import toppra.algorithm as algo
import toppra.constraint as constraint

logging.disable(logging.CRITICAL)


def retime(times, keys, velocity, acceleration, points, fine):
    path = toppra.SplineInterpolator(times, keys, bc_type="natural")
    begun = time.perf_counter()
    limits = [
        constraint.JointVelocityConstraint(np.stack([-velocity, velocity], axis=1)),
        constraint.JointAccelerationConstraint(
            np.stack([-acceleration, acceleration], axis=1),
            discretization_scheme=constraint.DiscretizationType.Interpolation,
        ),
    ]
    grid = np.linspace(times[0], times[-1], points + 1)
    instance = algo.TOPPRA(limits, path, gridpoints=grid, parametrizer="ParametrizeConstAccel")
    found = instance.compute_trajectory(0, 0)
    # ten points a piece, as ours: the worst are at the ends of pieces; scaling is part of the work
    t = np.interp(np.arange(fine) / 10.0, np.arange(points + 1), found._ts)
    speed = np.abs(found(t, 1) / velocity).max()
    bend = np.sqrt(np.abs(found(t, 2) / acceleration).max())
    seconds = time.perf_counter() - begun
    return {"duration": found.duration, "scale": float(max(1.0, speed, bend)), "seconds": seconds}


def main():
    """A line for each batch of paths, answered by a line."""
    for line in sys.stdin:
        job = json.loads(line)
        limits = np.array(job["velocity"]), np.array(job["acceleration"])
        rows = []
        for keys in job["paths"]:
            at = np.array(job["times"]), np.array(keys)
            rows.append([retime(*at, *limits, n, 10 * n + 1) for n in job["points"]])
        print(json.dumps(rows), flush=True)


main()
