"""The problem of a nonlinear MPC formulated plainly: multiple shooting over RK4 in CasADi, by IPOPT."""

import casadi as ca
import numpy as np

TOLERANT = {
    "tol": 1e-4, "warm_start_init_point": "yes", "mu_init": 1e-4,
    "warm_start_bound_push": 1e-6, "warm_start_mult_bound_push": 1e-6,
}  # fmt: skip
"""IPOPT's options for an answer good to about 1 % from a guess that is nearly one."""


def formulate(law, ipopt=None):
    """A solver (x0, reference, guess) -> (forces, cost) of an NMPC's problem; the cost is infinite where it
    fails. ``ipopt``: options beside the plain ones."""
    model, n, m, h, c = law.model, law.n, len(law.inputs), ca.SX.sym("h"), law.shooting.weights
    nv = model.nv
    x, u = ca.SX.sym("x", 2 * nv), ca.SX.sym("u", m)
    tau = ca.SX.zeros(nv)
    for k, dof in enumerate(law.inputs):
        tau[int(dof)] = u[k]
    forward = law.nominal.smooth.tape("forward").casadi("forward")

    def rate(x):
        return ca.vertcat(x[nv:], forward(x[:nv], x[nv:], [], ca.DM.zeros(model.nu), tau, [], []))

    k1 = rate(x)
    k2 = rate(x + h / 2 * k1)
    k3 = rate(x + h / 2 * k2)
    k4 = rate(x + h * k3)
    step = ca.Function("step", [x, u, h], [x + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)])
    X, U = ca.MX.sym("X", 2 * nv, n + 1), ca.MX.sym("U", m, n)
    start, Xr, Ur, H = (
        ca.MX.sym(*a) for a in (("x0", 2 * nv), ("Xr", 2 * nv, n + 1), ("Ur", m, n), ("h", 1, n))
    )
    dx, du = X - Xr, U - Ur
    cost = ca.dot(ca.DM(c.Q).T @ dx[:, :-1] ** 2 + ca.DM(c.R).T @ du**2, H) / law.step
    cost += dx[:, -1].T @ ca.DM(c.final) @ dx[:, -1]
    for dof in np.flatnonzero(np.isfinite(c.q_high)):
        over = (
            ca.fmax(X[int(dof), :] - c.q_high[dof], 0) ** 2 + ca.fmax(c.q_low[dof] - X[int(dof), :], 0) ** 2
        )
        cost += c.soft[dof] * ca.sum2(over)
    g = ca.veccat(X[:, 0] - start, X[:, 1:] - step.map(n)(X[:, :-1], U, H))
    slack = []  # >= 0: what is left of motors' forces at speed
    for i in np.flatnonzero(np.isfinite(c.top)):
        v = X[nv + int(law.inputs[i]), :-1] / c.top[i]
        slack += [c.high[i] * ca.fmax(1 - v, 0) - U[int(i), :], U[int(i), :] - c.low[i] * ca.fmax(1 + v, 0)]
    spare = np.full(n * len(slack), np.inf)
    g, most = ca.veccat(g, *slack), np.concatenate([np.zeros(2 * nv * (n + 1)), spare])
    problem = {"x": ca.veccat(X, U), "p": ca.veccat(start, Xr, Ur, H), "f": cost, "g": g}
    plain = {"print_level": 0, "sb": "yes", "tol": 1e-8}
    options = {"print_time": False, "expand": True, "error_on_fail": False, "ipopt": plain | (ipopt or {})}
    solver = ca.nlpsol("mpc", "ipopt", problem, options)
    free = np.full(2 * nv * (n + 1), np.inf)
    low = np.concatenate([-free, np.tile(c.low, n)])
    high = np.concatenate([free, np.tile(c.high, n)])

    def solve(x0, ref, guess_x, guess_u):
        p = np.concatenate([x0, ref.x.ravel(), ref.u.ravel(), ref.h])
        guess = np.concatenate([guess_x.ravel(), guess_u.ravel()])
        done = solver(x0=guess, p=p, lbx=low, ubx=high, lbg=0, ubg=most)
        u = np.asarray(done["x"]).ravel()[2 * nv * (n + 1) :].reshape(n, m)
        return u, float(done["f"]) if solver.stats()["success"] else np.inf

    return solve
