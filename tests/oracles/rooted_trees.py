"""Order conditions of Runge-Kutta methods from rooted trees (Hairer, Norsett & Wanner I, II.2).

A tree is the sorted tuple of its root's subtrees; () is the single node. A method with coefficients A and
weights b has order p when sum_i b_i Phi_i(tau) = 1 / gamma(tau) for every tree tau of up to p nodes; a
continuous one when sum_i b_i(theta) Phi_i(tau) = theta^|tau| / gamma(tau).
"""

from functools import cache

import mpmath as mp
import numpy as np

Tree = tuple["Tree", ...]


@cache
def trees(nodes: int) -> tuple[Tree, ...]:
    """All rooted trees with that many nodes."""
    return tuple(sorted(set(_forests(nodes - 1, nodes - 1))))


@cache
def _forests(nodes: int, largest: int) -> tuple[tuple[Tree, ...], ...]:
    if nodes == 0:
        return ((),)
    return tuple(
        {
            tuple(sorted((tree, *rest)))
            for k in range(1, min(nodes, largest) + 1)
            for tree in trees(k)
            for rest in _forests(nodes - k, k)
        }
    )


@cache
def size(tree: Tree) -> int:
    return 1 + sum(map(size, tree))


@cache
def gamma(tree: Tree) -> int:
    """Density of the tree: product over all nodes of the size of the subtree below."""
    product = size(tree)
    for branch in tree:
        product *= gamma(branch)
    return product


class OrderConditions:
    """The order conditions of a method whose coefficients A are doubles, evaluated in 40 digits."""

    def __init__(self, A: np.ndarray) -> None:
        with mp.workdps(40):
            self.A_exact = np.vectorize(mp.mpf, otypes=[object])(A)
        self.A = np.asarray(A)
        self.memo: dict[Tree, np.ndarray] = {}

    def phi(self, tree: Tree) -> np.ndarray:
        """Phi_i(tau) of all stages i (mpf)."""
        if tree not in self.memo:
            product = np.full(len(self.A), mp.mpf(1), dtype=object)
            for branch in tree:
                product = product * (self.A_exact @ self.phi(branch))
            self.memo[tree] = product
        return self.memo[tree]

    def sensitivity(self, weights: np.ndarray, tree: Tree) -> float:
        """Sum over all coefficients of |a_ij d(weights Phi(tau))/d a_ij|, by the chain rule down the tree."""
        values = [self.A @ self.phi(branch).astype(float) for branch in tree]
        total = 0.0
        for k, branch in enumerate(tree):
            adjoint = weights * np.prod([v for j, v in enumerate(values) if j != k], axis=0)
            total += float(np.abs(adjoint) @ np.abs(self.A) @ np.abs(self.phi(branch).astype(float)))
            total += self.sensitivity(adjoint @ self.A, branch)
        return total

    def residuals(
        self, weights: np.ndarray, order: int, *, target: float = 1.0, magnitude: np.ndarray | None = None
    ) -> np.ndarray:
        """Rows (|residual|, rounding) of the conditions of exactly `order` nodes at theta = target.

        `rounding` bounds what coefficients known to half a unit in the last place can do, to first order;
        `magnitude` is the size of the terms whose sum the weights are (default: the weights themselves).
        """
        magnitude = np.abs(weights) if magnitude is None else magnitude
        rows = []
        with mp.workdps(40):
            b = np.vectorize(mp.mpf, otypes=[object])(weights)
            for tree in trees(order):
                phi = self.phi(tree)
                residual = abs(float(b @ phi - mp.mpf(target) ** order / gamma(tree)))
                spread = float(magnitude @ np.abs(phi.astype(float))) + self.sensitivity(weights, tree)
                rows.append((residual, 2.0**-53 * spread))
        return np.array(rows)
