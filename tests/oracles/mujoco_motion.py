"""Motion of a MuJoCo model without contacts by SciPy's DOP853 on mj_forward's accelerations."""

import mujoco
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]


def motion(
    model: mujoco.MjModel, q0: Array, v0: Array, t: Array, *, rtol: float = 1e-10, atol: float = 1e-12
) -> Array:
    """Configurations (n, nq) at times ``t`` (n,) [s] from t[0], of a model that nothing but itself drives."""
    data = mujoco.MjData(model)
    nq = model.nq

    def rate(_: float, y: Array) -> Array:
        data.qpos[:], data.qvel[:] = y[:nq], y[nq:]
        mujoco.mj_normalizeQuat(model, data.qpos)
        mujoco.mj_forward(model, data)
        return np.concatenate([_qdot(model, data.qpos, data.qvel), data.qacc])

    y = solve_ivp(rate, (t[0], t[-1]), np.concatenate([q0, v0]), "DOP853", t, rtol=rtol, atol=atol).y
    q = np.ascontiguousarray(y[:nq].T)
    for row in q:
        mujoco.mj_normalizeQuat(model, row)
    return q


def _qdot(model: mujoco.MjModel, q: Array, v: Array) -> Array:
    out = np.zeros(model.nq)
    for kind, iq, iv in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        if kind in (2, 3):  # slide, hinge
            out[iq] = v[iv]
            continue
        if kind == 0:  # free
            out[iq : iq + 3] = v[iv : iv + 3]
            iq, iv = iq + 3, iv + 3
        # velocities of ball and free joints are in the body's frame: qdot = q * (0, w) / 2
        mujoco.mju_mulQuat(out[iq : iq + 4], q[iq : iq + 4], np.concatenate([[0.0], v[iv : iv + 3] / 2]))
    return out
