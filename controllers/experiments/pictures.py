"""Comparisons as pictures."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .comparison import Comparison

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]
_PANELS = 6  # of forces, a joint each
_DEEP = 0.02  # part of the samples below what a logarithmic axis of errors shows


def figure(comparison: Comparison) -> Figure:
    """Errors over time and forces of the undisturbed runs, and the RMS error of all runs, a law a colour.

    Forces are what drives gave, signed, a joint a panel, with what they can give as dashed lines; of many
    joints those that came nearest to that, or are the strongest.
    """
    from matplotlib.figure import Figure

    some = next(iter(comparison.trials.values()))
    shown = _busiest(comparison)
    columns = 1 if len(shown) == 1 else 2 if len(shown) in (2, 4) else 3
    lines = -(-len(shown) // columns)
    chart = Figure(figsize=(11, 6.5 + 2.2 * lines), layout="constrained")
    grid = chart.add_gridspec(2 + lines, columns, height_ratios=[1.3, *[1] * lines, 1.1])
    top = chart.add_subplot(grid[0, :])
    panels = [chart.add_subplot(grid[1 + k // columns, k % columns], sharex=top) for k in range(len(shown))]
    bottom = chart.add_subplot(grid[-1, :])
    _errors(top, comparison, some.joints)
    _forces(panels, comparison, shown)
    if len(shown) < len(some.inputs):
        panels[0].set_ylabel(f"{len(shown)} of {len(some.inputs)} forces [N m, N]")
    _robust(bottom, comparison)
    chart.legend(*top.get_legend_handles_labels(), loc="outside upper center", fontsize=8, ncols=4)
    for ax in (top, *panels, bottom):
        ax.grid(alpha=0.3)
    return chart


def learning(comparison: Comparison) -> Figure:
    """RMS error of every repeat from which laws of the comparison learned."""
    from matplotlib.figure import Figure
    from matplotlib.ticker import MaxNLocator

    chart = Figure(figsize=(8, 4), layout="constrained")
    ax = chart.subplots()
    ax.xaxis.set_major_locator(MaxNLocator(integer=True))
    for name, trial in comparison.trials.items():
        if trial.learned is not None:
            errors = trial.learned.errors
            ax.semilogy(range(1, len(errors) + 1), errors, "o-", label=name)
    ax.set_xlabel("repeat")
    ax.set_ylabel("RMS error of tracked joints [rad, m]")
    ax.legend(fontsize=8)
    ax.grid(alpha=0.3, which="both")
    return chart


def _look(i: int) -> dict[str, Any]:
    """Colour and stroke of the ``i``-th law: equal motions stay both visible."""
    from matplotlib import colormaps

    return {"color": colormaps["tab10"](i % 10), "ls": ("-", "--", ":")[i % 3], "lw": 1.2}


def _errors(ax: Axes, comparison: Comparison, joints: tuple[str, ...]) -> None:
    floor, most = np.inf, 0.0
    for i, row in enumerate(comparison.rows):
        trial = comparison.trials[row.variant.name]
        size = np.maximum(np.sqrt(np.sum(trial.error**2, axis=1)), 1e-15)
        ax.semilogy(trial.t, size, label=row.variant.name, **_look(i))
        floor, most = min(floor, float(np.percentile(size, 100 * _DEEP))), max(most, float(size.max()))
    if most > floor:
        ax.set_ylim(floor, most * (most / floor) ** 0.05)
    names = ", ".join(joints) if len(joints) <= _PANELS else f"{len(joints)} joints"
    ax.set_ylabel("error [rad, m]")
    ax.set_title(f"error of {names}", fontsize=10)


def _forces(panels: list[Axes], comparison: Comparison, shown: list[int]) -> None:
    some = next(iter(comparison.trials.values()))
    for ax, joint in zip(panels, shown, strict=True):
        for i, row in enumerate(comparison.rows):
            trial = comparison.trials[row.variant.name]
            ax.plot(trial.t, trial.tau[:, joint], **_look(i))
        seen = ax.get_ylim()
        limits = [float(x[joint]) for x in (some.low, some.high)]
        for limit in limits:
            if np.isfinite(limit):
                ax.axhline(limit, color="0.35", ls=(0, (6, 3)), lw=1.0)
        room = 0.3 * (seen[1] - seen[0])
        low = min(seen[0], limits[0] - 0.2 * room) if limits[0] > seen[0] - room else seen[0]
        high = max(seen[1], limits[1] + 0.2 * room) if limits[1] < seen[1] + room else seen[1]
        ax.set_ylim(low, high)
        within = f" (of {limits[0]:.4g} to {limits[1]:.4g})" if np.isfinite(limits).all() else ""
        ax.set_title(f"force of {some.inputs[joint]}{within}", fontsize=9)
        ax.locator_params(axis="x", nbins=6)
        ax.set_xlabel("time [s]", fontsize=9)
    panels[0].set_ylabel("forces [N m, N]")


def _busiest(comparison: Comparison) -> list[int]:
    """Inputs to draw: all, or those that came nearest to their limits; without limits the strongest."""
    trials = list(comparison.trials.values())
    size = np.max([np.nanmax(np.abs(trial.tau), axis=0, initial=0.0) for trial in trials], axis=0)
    able = np.maximum(np.abs(trials[0].low), np.abs(trials[0].high))
    part = np.where(np.isfinite(able), size / np.where(able > 0.0, able, 1.0), 0.0)
    order = np.lexsort((-size, -part))
    return sorted(int(k) for k in order[:_PANELS])


def _robust(ax: Axes, comparison: Comparison) -> None:
    for i, row in enumerate(comparison.rows):
        colour, dots = _look(i)["color"], [f.rms for f in row.disturbed]
        ax.plot([i] * len(dots), dots, "o", color=colour, alpha=0.4, ms=5)
        ax.plot([i], [row.nominal.rms], "_", color=colour, ms=24, mew=3)
        if lost := sum(not np.isfinite(x) for x in (*dots, row.nominal.rms)):
            at = ax.get_xaxis_transform()
            ax.text(i, 0.97, f"{lost} failed", color=colour, transform=at, ha="center", va="top", fontsize=8)
    names = [row.variant.name.replace(" ", "\n", 1) for row in comparison.rows]
    ax.set_xticks(range(len(names)), names, fontsize=9)
    if len(names) > 6:
        ax.tick_params(axis="x", rotation=20)
    ax.set_xlim(-0.6, len(names) - 0.4)
    if any(0.0 < f.rms < np.inf for row in comparison.rows for f in (row.nominal, *row.disturbed)):
        ax.set_yscale("log")
    ax.set_ylabel("RMS error [rad, m]")
    ax.set_title("as modelled (bars) and disturbed (dots)", fontsize=10)
