"""Several goals at once by mink; run in an environment of its own.

python ik_goals.py MODEL.xml QUESTIONS.npz BUDGET_S RESULT.npz

Questions: names of the sites whose position or pose is wanted (`points`, `poses`), targets `p`
(k, points, 3), `X` (k, poses, 4, 4), `com` (k, 3) or (k, 0), `start` (nq,), `tolerance`. Iterates as mink's
documentation does, from the start, until every component of every error is below the tolerance or the time is
over; a start that has stalled for ten steps is replaced by one nearby.
"""

import sys
import time

import mink
import mujoco
import numpy as np


def main():
    path, questions, budget, result = sys.argv[1:]
    model, data = mujoco.MjModel.from_xml_path(path), np.load(questions)
    limit, tolerance = float(budget), float(data["tolerance"])
    points = [mink.FrameTask(str(n), "site", position_cost=1.0, orientation_cost=0.0, lm_damping=1e-6)
              for n in data["points"]]  # fmt: skip
    poses = [mink.FrameTask(str(n), "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
             for n in data["poses"]]  # fmt: skip
    tasks = [*points, *poses]
    center = mink.ComTask(cost=1.0, lm_damping=1e-6) if data["com"].shape[1] else None
    tasks += [] if center is None else [center]
    limits = [mink.ConfigurationLimit(model)]
    rng = np.random.default_rng(0)

    def errors(configuration):
        parts = [np.abs(t.compute_error(configuration)[:3]).max() for t in points]
        parts += [np.abs(t.compute_error(configuration)).max() for t in tasks[len(points) :]]
        return max(parts)

    seconds, met, q, steps = [], [], [], []
    for i in [*range(3), *range(len(data["p"]))]:
        begin = time.thread_time()
        for task, p in zip(points, data["p"][i], strict=True):
            X = np.eye(4)
            X[:3, 3] = p
            task.set_target(mink.SE3.from_matrix(X))
        for task, X in zip(poses, data["X"][i], strict=True):
            task.set_target(mink.SE3.from_matrix(X))
        if center is not None:
            center.set_target(data["com"][i])
        c = mink.Configuration(model, data["start"].copy())
        best, stalled, taken = np.inf, 0, 0
        while True:
            error = errors(c)
            spent = time.thread_time() - begin
            if error <= tolerance or spent > limit:
                break
            best, stalled = (error, 0) if error < 0.9 * best else (best, stalled + 1)
            if stalled >= 10:
                away = data["start"].copy()
                mujoco.mj_integratePos(model, away, 0.5 * rng.normal(size=model.nv), 1.0)
                c.update(away)
                best, stalled = np.inf, 0
                continue
            try:
                v = mink.solve_ik(c, tasks, 1.0, solver="daqp", damping=1e-9, limits=limits)
                c.integrate_inplace(v, 1.0)
                taken += 1
            except Exception:
                stalled = 10
        seconds.append(spent)
        met.append(error <= tolerance)
        q.append(c.q.copy())
        steps.append(taken)
    np.savez(result, seconds=seconds[3:], met=met[3:], q=q[3:], steps=steps[3:])


main()
