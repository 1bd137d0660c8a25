"""The figure of a report: error against what it costs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from .work_precision import Row

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_SHADES = {"smooth": "Blues", "mujoco": "Reds", "contact": "Reds", "scipy": "Greens", "torch": "Purples"}
_MARKERS = "osv^<>DPX*dph"
_FLOOR, _CEILING = 1e-17, 1e2  # errors beyond are not drawn


def draw(
    name: str,
    measure: str,
    methods: Mapping[tuple[str, str, str], Sequence[Row]],
    unsure: Sequence[tuple[str, float]],
) -> Figure:
    """Error over processor time and over evaluations, a line for each (engine, method, knob).

    `measure` says what an error is; `unsure` are the references' own errors with their engine ("": all).
    """
    from matplotlib import colormaps
    from matplotlib.figure import Figure

    figure = Figure(figsize=(11, 5), layout="constrained")
    axes = figure.subplots(1, 2, sharey=True)
    for n, (key, rows) in enumerate(methods.items()):
        kin = [other for other in methods if other[0] == key[0]]
        shade = 0.4 + 0.6 * (kin.index(key) + 1) / len(kin)
        seen = [row for row in rows if row.error > 0]
        style = {
            "color": colormaps[_SHADES[key[0]]](shade),
            "marker": _MARKERS[n % len(_MARKERS)],
            "markersize": 4,
            "linestyle": "-" if key[2] == "tolerance" else ":",
            "linewidth": 1,
        }
        label = f"{key[0]} {key[1]}" + (" (adaptive)" if key[2] == "tolerance" else "")
        axes[0].loglog([1e3 * row.cpu_s for row in seen], [row.error for row in seen], label=label, **style)
        axes[1].loglog([row.evaluations for row in seen], [row.error for row in seen], **style)
    for ax, what in zip(axes, ("processor time [ms]", "evaluations of the equations of motion"), strict=True):
        for engine, error in unsure:
            color = colormaps[_SHADES[engine]](0.7) if engine else "0.5"
            ax.axhspan(_FLOOR, max(_FLOOR, error), color=color, alpha=0.12, linewidth=0, zorder=0)
        ax.set_xlabel(what)
        _ticks(ax)
        ax.grid(alpha=0.3)
    shown = [row.error for rows in methods.values() for row in rows if 0 < row.error < math.inf]
    shown = [x for x in [*shown, *(error for _, error in unsure)] if x > _FLOOR] or [1e-3]
    axes[0].set_ylim(min(shown) / 3, min(max(shown) * 3, _CEILING))
    axes[0].set_ylabel(f"{measure}; shaded: the reference's own")
    figure.suptitle(name)
    if methods:
        figure.legend(loc="outside right upper", fontsize=7)
    else:
        for ax in axes:
            ax.set_axis_off()
        figure.text(0.5, 0.5, "nothing is integrated", ha="center")
    return figure


def _ticks(ax: Axes) -> None:
    """Numbers along a logarithmic axis that do not run into each other, also over less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    low, high = ax.get_xlim()
    if low > 0 and high < 50 * low:
        ax.xaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        ax.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
