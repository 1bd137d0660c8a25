"""The problem of a linear MPC written out plainly, with states as unknowns, by a QP solver of CasADi."""

import casadi as ca
import numpy as np


def solve(A, B, Q, R, P, x0, *, needed, force, slew, before, states, soft):
    """Forces (n, m) and cost of n steps x+ = A x + B (u - needed) from x0 (k,), with the cost of a step
    x'Q x + (u - needed)'R (u - needed), and x'P x at the end.

    A (n, k, k), B (n, k, m), needed (n, m); force (2, m): hard limits of u; slew (m,): of its changes,
    counted from before (m,) unless None; states (2, n, k): soft limits of the states after each step, which
    cost soft times the square of what is beyond.
    """
    n, k, m = len(A), A.shape[1], B.shape[2]
    opti = ca.Opti("conic")
    X, U, S = opti.variable(k, n + 1), opti.variable(m, n), opti.variable(k, n)
    cost = ca.bilin(P, X[:, n], X[:, n])
    opti.subject_to(X[:, 0] == x0)
    last = before
    for i in range(n):
        du = U[:, i] - needed[i]
        cost += ca.bilin(Q, X[:, i], X[:, i]) + ca.bilin(R, du, du) + soft * ca.sumsqr(S[:, i])
        opti.subject_to(X[:, i + 1] == ca.DM(A[i]) @ X[:, i] + ca.DM(B[i]) @ du)
        for j in range(m):
            if np.isfinite(force[1, j]):
                opti.subject_to(opti.bounded(force[0, j], U[j, i], force[1, j]))
            if np.isfinite(slew[j]) and last is not None:
                opti.subject_to(opti.bounded(-slew[j], U[j, i] - last[j], slew[j]))
        for j in range(k):
            if np.isfinite(states[1, i, j]):
                opti.subject_to(X[j, i + 1] - S[j, i] <= states[1, i, j])
                opti.subject_to(X[j, i + 1] + S[j, i] >= states[0, i, j])
        last = U[:, i]
    opti.minimize(cost)
    opti.solver("qpoases", {"print_time": False, "printLevel": "none", "error_on_fail": True})
    done = opti.solve()
    return np.asarray(done.value(U)).reshape(m, n).T, float(done.value(cost))
