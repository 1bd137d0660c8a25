"""Inverse kinematics by mink and by pink on targets from a file; run in an environment of their own.

python ik_peers.py NAME MODEL.xml TARGETS.npz BUDGET_MS RESULT.npz

Both iterate their differential inverse kinematics from mid-range as their documentation does, until every
component of the error is below the tolerance or the time is over; a start that has stalled for ten steps is
replaced by a random one, as TRAC-IK does for KDL.
"""

import sys
import time

import numpy as np


def with_mink(path):
    import mink
    import mujoco

    model = mujoco.MjModel.from_xml_path(path)
    low, high = model.jnt_range.T
    task = mink.FrameTask("tip", "site", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
    limits = [mink.ConfigurationLimit(model)]

    def start(R, p):
        X = np.eye(4)
        X[:3, :3], X[:3, 3] = R, p
        task.set_target(mink.SE3.from_matrix(X))
        return mink.Configuration(model, 0.5 * (low + high))

    def step(configuration):
        v = mink.solve_ik(configuration, [task], 1.0, solver="daqp", damping=1e-9, limits=limits)
        configuration.integrate_inplace(v, 1.0)

    def pose(configuration):
        X = configuration.get_transform_frame_to_world("tip", "site").as_matrix()
        return X[:3, :3], X[:3, 3]

    return start, step, pose, lambda c, q: c.update(q), lambda c: c.q.copy(), low, high


def with_pink(path):
    import pink
    import pinocchio as pin

    model = pin.buildModelFromMJCF(path)
    data = model.createData()
    low, high = model.lowerPositionLimit, model.upperPositionLimit
    task = pink.tasks.FrameTask("tip", position_cost=1.0, orientation_cost=1.0, lm_damping=1e-6)
    state = {}

    def start(R, p):
        task.set_target(pin.SE3(R, p))
        state["c"] = pink.Configuration(model, data, 0.5 * (low + high))
        return state

    def step(s):
        v = pink.solve_ik(s["c"], [task], 1.0, solver="daqp", damping=1e-9, safety_break=False)
        q = np.clip(pin.integrate(model, s["c"].q, v), low, high)
        s["c"] = pink.Configuration(model, data, q)

    def pose(s):
        X = s["c"].get_transform_frame_to_world("tip")
        return X.rotation, X.translation

    def update(s, q):
        s["c"] = pink.Configuration(model, data, q)

    return start, step, pose, update, lambda s: s["c"].q.copy(), low, high


def error_of(R, p, R_T, p_T):
    E = R @ R_T.T
    s = 0.5 * np.array([E[2, 1] - E[1, 2], E[0, 2] - E[2, 0], E[1, 0] - E[0, 1]])
    angle = np.arctan2(np.linalg.norm(s), 0.5 * (np.trace(E) - 1))
    turn = s if angle < 1e-3 else s / max(np.linalg.norm(s), 1e-12) * angle
    return max(np.abs(p - p_T).max(), np.abs(turn).max())


def main():
    name, path, targets, budget, result = sys.argv[1:]
    data = np.load(targets)
    limit, tolerance = float(budget) * 1e-3, float(data["tolerance"])
    start, step, pose, update, position, low, high = {"mink": with_mink, "pink": with_pink}[name](path)
    rng = np.random.default_rng(0)
    seconds, met, q = [], [], []
    for warm in (True, False):
        for R_T, p_T in zip(data["R"][: 5 if warm else None], data["p"][: 5 if warm else None], strict=True):
            begin = time.thread_time()
            c = start(R_T, p_T)
            best, stalled = np.inf, 0
            while True:
                error = error_of(*pose(c), R_T, p_T)
                spent = time.thread_time() - begin
                if error <= tolerance or spent > limit:
                    break
                best, stalled = (error, 0) if error < 0.9 * best else (best, stalled + 1)
                if stalled >= 10:
                    update(c, rng.uniform(low, high))
                    best, stalled = np.inf, 0
                    continue
                try:
                    step(c)
                except Exception:
                    update(c, rng.uniform(low, high))
            if not warm:
                seconds.append(spent)
                met.append(error <= tolerance and spent <= limit)
                q.append(position(c))
    np.savez(result, seconds=seconds, met=met, q=q)


main()
