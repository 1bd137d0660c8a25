"""Exact derivatives of the accelerations and of the state's rate, as programs by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from ..compile.diff import directional, gradient, grouped, merged
from ..compile.graph import Node, Scalar
from ..compile.tape import Tape
from .rigid import spatial
from .symbolic import STATE, Equations


class _Implicit:
    """Derivatives of the accelerations from those of the equations' residual with the accelerations held.

    r(a_local, s) = 0 gives d a_local = -M^-1 dr; the world sees d(R a_local) = R d a_local + dR a_local.
    Up to `columns` of them are computed side by side.
    """

    def __init__(self, eq: Equations, kind: str, tau: Sequence[Scalar], columns: int = 1):
        self.eq, self.kind, self.columns = eq, kind, columns
        a_local = eq.acceleration_local(kind, tau)
        self.a = eq.seen(a_local)
        held = [eq.graph.hold(x) for x in a_local]
        self.residual, self.seen = eq.residual_local(held, tau), eq.seen(held)

    def along(self, seeds: Sequence[Mapping[Node, Scalar]]) -> list[list[Scalar]]:
        """Derivatives along `seeds`, one column each."""
        eq, out = self.eq, []
        for group in grouped([*self.residual, *self.seen], seeds, self.columns):
            seed = [merged(eq.graph, [seeds[k] for k in group])]
            (column,), (turned,) = directional(self.residual, seed), directional(self.seen, seed)
            solved = eq.free(eq.world(eq.factor.solve([-x for x in column])))
            total = spatial.add(solved, turned)
            out += [[eq.graph.lane(x, lane) for x in total] for lane in range(len(group))]
        return out

    def weighted(self, bar: Sequence[Scalar]) -> tuple[list[Scalar], list[Scalar]]:
        """Rows and weights whose weighted sum has the gradient of bar . a."""
        eq = self.eq
        solved = eq.solve_local(eq.local(eq.spread(bar)), self.kind)
        return [*self.residual, *self.seen], [*(-eq.graph.hold(x) for x in solved), *bar]


def _inverse_mass(eq: Equations, columns: int) -> list[Scalar]:
    """M^-1 over the state's freedoms, row-major; only one triangle is computed, `columns` side by side."""
    nv = eq.layout.nv
    solved: list[list[Scalar]] = []
    for first in range(0, nv, columns):
        here = range(first, min(first + columns, nv))
        units = [[1.0 if i == k else 0.0 for k in here] for i in range(nv)]
        unit = eq.spread([eq.graph.vector(row) for row in units])
        x = eq.free(eq.world(eq.factor.solve(eq.local(unit))))
        solved += [[eq.graph.lane(entry, lane) for entry in x] for lane in range(len(here))]
    return [solved[max(i, j)][min(i, j)] for i in range(nv) for j in range(nv)]


def _rows(columns: list[list[Scalar]], height: int) -> list[Scalar]:
    """Row-major matrix of `columns`."""
    return [column[i] for i in range(height) for column in columns]


def _derivatives(eq: Equations, columns: int) -> Tape:
    """Of the accelerations by q (tangent), v and tau."""
    lay = eq.layout
    implicit = _Implicit(eq, "composite", eq.inputs["tau"], columns)
    by_q = implicit.along([eq.tangent(k) for k in range(lay.nv)])
    by_v = implicit.along([{x: 1.0} for x in eq.inputs["v"]])
    outputs = {"a": implicit.a, "dq": _rows(by_q, lay.nv), "dv": _rows(by_v, lay.nv)}
    return eq.tape(STATE, outputs | {"dtau": _inverse_mass(eq, columns)})


def _control_derivatives(eq: Equations, columns: int) -> Tape:
    """Of the accelerations by activations, controls and parameters."""
    lay = eq.layout
    implicit = _Implicit(eq, "composite", eq.inputs["tau"], columns)
    outputs = {}
    for name in ("act", "u", "p"):
        outputs["d" + name] = _rows(implicit.along([{x: 1.0} for x in eq.inputs[name]]), lay.nv)
    return eq.tape(STATE, outputs)


def _rate_jacobian(eq: Equations, columns: int) -> Tape:
    """Of dx/dt by x (plain coordinates, quaternions included), u and p."""
    zero: list[Scalar] = [0.0] * eq.layout.nv
    implicit = _Implicit(eq, "composite", zero, columns)
    outputs = {"rate": eq.rate("composite")}
    kinematic, activation = eq.coordinate_rate(), eq.actuation[1]
    for name, keys in (("x", ("q", "v", "act")), ("u", ("u",)), ("p", ("p",))):
        seeds = [{node: 1.0} for key in keys for node in eq.inputs[key]]
        q_part, act_part = directional(kinematic, seeds), directional(activation, seeds)
        full = [[*q, *a, *s] for q, a, s in zip(q_part, implicit.along(seeds), act_part, strict=True)]
        outputs["d" + name] = _rows(full, eq.layout.nx)
    return eq.tape("q v act u w p", outputs)


def _pulled_back(eq: Equations, by_q: Sequence[Scalar]) -> list[Scalar]:
    """Gradient by q in the tangent space."""
    place = {node: k for k, node in enumerate(eq.inputs["q"])}
    return [
        spatial.dot(list(seed.values()), [by_q[place[node]] for node in seed])
        for seed in (eq.tangent(k) for k in range(eq.layout.nv))
    ]


def _vjp(eq: Equations, kind: str) -> Tape:
    """bar . d(accelerations): by q (tangent), v, act, u, tau and p."""
    bar = eq.inputs["bar"][: eq.layout.nv]
    rows, weights = _Implicit(eq, kind, eq.inputs["tau"]).weighted(bar)
    names = ("q", "v", "act", "u", "tau", "p")
    by = _gradients(eq, rows, weights, names)
    return eq.tape(STATE + " bar", {"q": _pulled_back(eq, by["q"])} | {n: by[n] for n in names[1:]})


def _rate_vjp(eq: Equations, kind: str) -> Tape:
    """bar . d(dx/dt): by x (plain coordinates), u and p."""
    lay, bar = eq.layout, eq.inputs["bar"]
    zero: list[Scalar] = [0.0] * lay.nv
    rows, weights = _Implicit(eq, kind, zero).weighted(bar[lay.nq : lay.nq + lay.nv])
    rows = [*eq.coordinate_rate(), *rows, *eq.actuation[1]]
    by = _gradients(
        eq, rows, [*bar[: lay.nq], *weights, *bar[lay.nq + lay.nv : lay.nx]], ("q", "v", "act", "u", "p")
    )
    outputs = {"x": by["q"] + by["v"] + by["act"], "u": by["u"], "p": by["p"]}
    return eq.tape("q v act u w p bar", outputs, bar="x")


def _gradients(
    eq: Equations, rows: Sequence[Scalar], weights: Sequence[Scalar], names: Sequence[str]
) -> dict[str, list[Scalar]]:
    flat = gradient(rows, weights, [node for name in names for node in eq.inputs[name]])
    out, at = {}, 0
    for name in names:
        size = len(eq.inputs[name])
        out[name] = flat[at : at + size]
        at += size
    return out


# by columns: the equations, and how many columns stand side by side; with the inertia matrix's factor, which
# every column needs
JACOBIANS: Mapping[str, Callable[[Equations, int], Tape]] = {
    "derivatives": _derivatives,
    "control_derivatives": _control_derivatives,
    "rate_jacobian": _rate_jacobian,
}
VJPS: Mapping[str, Callable[[Equations, str], Tape]] = {"vjp": _vjp, "rate_vjp": _rate_vjp}
