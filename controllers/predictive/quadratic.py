"""The least change that meets limits: min |z|^2 + sum_r s_r^2 / give_r, low - s <= M z <= high + s, by DAQP.

Only rows that hold a solution back shape it, and those of the sample before are a good guess at them. DAQP
(D. Arnstrom, A. Bemporad, D. Axehall, IEEE Trans. Automatic Control 67, 2022), as it comes with CasADi,
solves for the guess and for what its solution crosses, until nothing is crossed. That is the warm start,
since CasADi hands DAQP no working set. Solutions lie in the span of the k rows looked at: with (M, root of
give) of these factored as L Q', (z, s / root of give) = Q y, and the program has k unknowns, however long
the horizon.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...sim.errors import PantographError

Array = NDArray[np.float64]
Rows = NDArray[np.intp]
NOTHING: Rows = np.zeros(0, dtype=np.intp)
_ROOM = 16  # programs are made for multiples of so many rows
_EXACT = 1e-10  # what a limit may be crossed by, of the size of the terms in its row


class Daqp:
    """min |y|^2 / 2 with low <= L y <= high for L (k, k), k at most ``size``; ``size`` unknowns and rows.

    One instance serves one thread. It starts from nothing every time: calls do not feel each other.
    """

    def __init__(self, size: int) -> None:
        import casadi as ca

        shape = {"h": ca.Sparsity.diag(size), "a": ca.Sparsity.dense(size, size)}
        exact = {"primal_tol": 0.1 * _EXACT, "iter_limit": 100 * size}
        program = ca.conic("least_change", "daqp", shape, {"error_on_fail": False, "daqp": exact})
        buffer: Any
        buffer, self._solve = program.buffer()
        self._buffer = buffer
        given: dict[str, Array] = {}
        for i, name in enumerate(program.name_in()):
            if name in ("h", "a", "lba", "uba", "lbx", "ubx"):
                given[name] = np.zeros(program.nnz_in(i))
                buffer.set_arg(i, given[name].data)
        self._y, self._pushes = np.zeros(size), np.zeros(size)
        for out, into in (("x", self._y), ("lam_a", self._pushes)):
            buffer.set_res(program.name_out().index(out), into.data)
        given["h"][:], given["lbx"][:], given["ubx"][:] = 1.0, -np.inf, np.inf
        self._kept = given  # the program reads these arrays where they lie
        self._low, self._high = given["lba"], given["uba"]
        self._L = given["a"].reshape(size, size, order="F")

    def __call__(self, L: Array, low: Array, high: Array) -> tuple[Array, Array]:
        """y (k,), and the pushes (k,) of the rows: not zero where these hold it back."""
        k = len(L)
        self._L[:], self._low[:], self._high[:] = 0.0, -np.inf, np.inf
        self._L[:k, :k], self._low[:k], self._high[:k] = L, low, high
        self._solve()
        return self._y[:k].copy(), self._pushes[:k].copy()


class LeastChange:
    """Solves programs of any size, with a :class:`Daqp` for each number of rows that it met."""

    def __init__(self) -> None:
        self._programs: dict[int, Any] = {}

    def __call__(
        self, M: Array, low: Array, high: Array, give: Array, before: Rows = NOTHING
    ) -> tuple[Array, Rows, int]:
        """z (n,), the rows that hold it back, and how many programs that took.

        M (r, n); ``low`` <= ``high`` (r,), infinite where there is no limit; ``give`` (r,) >= 0: softness of
        a row, 0: hard; ``before``: a guess of the rows that will hold. Raises PantographError when hard rows
        contradict each other, which soft ones never do.
        """
        size = np.sqrt(np.einsum("ij,ij->i", M, M) + give) + 1e-300
        slack, z = np.zeros(len(M)), np.zeros(M.shape[1])
        rows, pushes = np.asarray(before, dtype=np.intp), np.zeros(len(before))
        for rounds in range(len(M) + 1):
            at = M @ z + slack
            crossed = np.maximum(at - high, low - at)
            bound = np.where(at > high, high, low)
            terms = size * np.sqrt(1.0 + z @ z + slack @ (slack / np.where(give > 0.0, give, 1.0)))
            beyond = crossed > _EXACT * (terms + np.abs(np.where(np.isfinite(bound), bound, 0.0)))
            if beyond[rows].any() and rounds:
                break
            beyond[rows] = False
            if not beyond.any() and (rounds or not len(rows)):
                return z, rows[pushes != 0.0], rounds
            rows = np.concatenate([rows, np.flatnonzero(beyond)])
            z, slack, pushes = self._with(M, low, high, give, rows)
        raise PantographError("limits of the prediction contradict each other")

    def _with(self, M: Array, low: Array, high: Array, give: Array, rows: Rows) -> tuple[Array, Array, Array]:
        """z (n,), how far rows give (r,), and pushes (k,), with ``rows`` (k,) as the only ones."""
        soft = np.flatnonzero(give[rows])
        every = np.zeros((len(rows), M.shape[1] + len(soft)))
        every[:, : M.shape[1]] = M[rows]
        every[soft, M.shape[1] + np.arange(len(soft))] = np.sqrt(give[rows[soft]])
        Q, R = np.linalg.qr(every.T)
        room = -(-len(rows) // _ROOM) * _ROOM
        if room not in self._programs:
            self._programs[room] = Daqp(room)
        L = np.zeros((len(rows), len(rows)))
        L[:, : len(R)] = R.T
        y, pushes = self._programs[room](L, low[rows], high[rows])
        w, slack = Q @ y[: len(R)], np.zeros(len(M))
        slack[rows[soft]] = np.sqrt(give[rows[soft]]) * w[M.shape[1] :]
        return w[: M.shape[1]], slack, pushes
