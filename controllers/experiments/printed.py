"""Comparisons as text for a terminal."""

from __future__ import annotations

import math
from collections.abc import Iterator

from rich.box import SIMPLE_HEAD
from rich.table import Table

from .comparison import Comparison
from .variants import PERIOD, shown

_MOST = 8  # lines of one kind


def tables(result: Comparison) -> tuple[Table, Table]:
    """How well each law follows, and what it takes."""
    count = len(result.disturbances)
    well = _columns("law", "RMS", "max", "worst RMS", "failed", "settling", "overshoot")
    well.title = f"errors (rad, m), settling (s); worst of {count} disturbed runs"
    cost = _columns("law", "effort", "work J", "at limit", "build ms", "tick us", "of T")
    cost.title = "what it takes; processor time of ticks: median, 99 % (of the period T), longest"
    if result.status != "done":
        for table in (well, cost):
            table.title = f"{table.title}; PARTIAL: {result.done} of {result.asked} runs"
    for row in result.rows:
        f, name = row.nominal, row.variant.name
        settled = (
            "-" if math.isnan(f.settling) else "never" if math.isinf(f.settling) else f"{f.settling:.3f}"
        )
        robust = f"{row.robust:.2e}" if count else "-"
        well.add_row(
            name, f"{f.rms:.2e}", f"{f.worst:.2e}", robust, str(row.failed), settled, f"{f.overshoot:.1%}"
        )
        cost.add_row(
            name,
            f"{f.effort:.4g}",
            f"{f.work:.4g}",
            f"{f.saturated:.1%}",
            f"{f.build * 1e3:.3g}",
            f"{f.tick * 1e6:.0f}, {f.tick99 * 1e6:.0f}, {f.longest * 1e6:.0f}",
            f"{(share := f.tick99 / row.period):.{0 if share > 1.0 else 1}%}",
        )
    return well, cost


def notes(result: Comparison) -> Iterator[str]:
    """What counts and what does not, what each law was told, and which cannot or did not reach the end."""
    joints = {name: None for trial in result.trials.values() for name in trial.joints}
    largest = ", ".join(f"{row.variant.name} at {row.nominal.where}" for row in result.rows[:_MOST])
    if len(joints) > 1 and largest:
        yield f"errors are of {', '.join(joints)}; largest: {largest}"
    if result.uncounted:
        left = ", ".join(result.uncounted[:_MOST]) + (", ..." if len(result.uncounted) > _MOST else "")
        yield f"not counted: {left}: no keys, no goal (a word of laws such as lqr and mpc)"
    codes = [(r.variant.name, r.nominal.code) for r in result.rows if not math.isnan(r.nominal.code)]
    if codes:
        times = ", ".join(f"{name} {code * 1e6:.2g} us" for name, code in codes[:_MOST])
        yield f"ticks are Python's; in their place engines run machine code, of which a call takes: {times}"
    for law in dict.fromkeys(row.variant.law for row in result.rows):
        told = [row.variant.words for row in result.rows if row.variant.law == law]
        common = [w for w in told[0] if w != PERIOD and all(words.get(w) == told[0][w] for words in told)]
        if common:
            yield f"{law} is told: {', '.join(f'{w} = {shown(told[0][w])}' for w in common)}"
    for name, why in result.unfit.items():
        yield f"{name}: cannot, because {why}"
    yield from _failures(result)


def _failures(result: Comparison) -> list[str]:
    """Which runs did not reach their end, and why."""
    says = ("as modelled", *(d.say for d in result.disturbances))
    lines = [
        f"{row.variant.name}, {say}: {figures.message or figures.status}"
        for row in result.rows
        for say, figures in zip(says, (row.nominal, *row.disturbed), strict=True)
        if figures.status != "done"
    ]
    return lines if len(lines) <= _MOST else [*lines[:_MOST], f"and {len(lines) - _MOST} more: see the table"]


def _columns(*heads: str) -> Table:
    table = Table(box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for head in heads:
        if head == "law":
            table.add_column(head, overflow="fold", min_width=15)
        else:
            table.add_column(head, justify="right", no_wrap=True)
    return table
