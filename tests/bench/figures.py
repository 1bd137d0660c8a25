"""Figures of a benchmark: measured numbers, their bars, how they are told, and peers' environments.

A part of a benchmark is a function of a `Console` that returns, or yields, figures.
"""

import json
import math
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.table import Table

ENVIRONMENTS = Path(__file__).resolve().parents[2] / ".bench"


@dataclass(frozen=True)
class Figure:
    """One measured number (None: not to be had), its bar in words, whether it holds (None: not judged)."""

    name: str
    value: float | None
    unit: str = ""
    bar: str = ""
    holds: bool | None = None
    detail: str = ""

    def __post_init__(self):
        if self.value is not None:
            number = float(self.value)
            object.__setattr__(self, "value", float(f"{number:.6g}") if math.isfinite(number) else None)


def at_least(name: str, value: float, bar: float, unit: str = "", detail: str = "") -> Figure:
    return Figure(name, value, unit, f">= {bar:g}", bool(value >= bar), detail)


def at_most(name: str, value: float, bar: float, unit: str = "", detail: str = "") -> Figure:
    return Figure(name, value, unit, f"<= {bar:g}", bool(value <= bar), detail)


def told(name: str, value: float, unit: str = "", detail: str = "") -> Figure:
    """A number without a bar."""
    return Figure(name, value, unit, detail=detail)


def absent(name: str, why: str) -> Figure:
    """A number that could not be measured; it does not hold."""
    return Figure(name, None, "", "present", False, why)


def ratio(times: Mapping[str, np.ndarray], slow: str, fast: str) -> tuple[float, str]:
    """Median ratio of times measured in turn, and its quartiles in words."""
    low, middle, high = np.quantile(times[slow] / times[fast], [0.25, 0.5, 0.75])
    return float(middle), f"quartiles {low:.3g} to {high:.3g}"


def conclude(bench: str, figures: Iterable[Figure], console: Console) -> int:
    """Print the table, then one JSON object as the last line; the exit status is 0 when no bar is missed."""
    figures = list(figures)
    table = Table(title=bench)
    for column in ("figure", "value", "unit", "bar", "holds", "detail"):
        table.add_column(column, overflow="fold")
    said = {None: "", True: "yes", False: "[bold red]NO[/]"}
    for f in figures:
        value = "absent" if f.value is None else f"{f.value:.4g}"
        table.add_row(f.name, value, f.unit, f.bar, said[f.holds], f.detail)
    console.print(table)
    holds = all(f.holds is not False for f in figures)
    print(json.dumps({"bench": bench, "holds": holds, "figures": [asdict(f) for f in figures]}), flush=True)
    return 0 if holds else 1


def main(bench: str, parts: Mapping[str, Callable[[Console], Iterable[Figure]]]) -> int:
    """Run the parts named on the command line, or all."""
    chosen = sys.argv[1:] or list(parts)
    if unknown := [name for name in chosen if name not in parts]:
        raise SystemExit(f"{bench} has no part {', '.join(unknown)}; its parts: {', '.join(parts)}")
    console = Console(width=None if sys.stdout.isatty() else 150)
    return conclude(bench, [figure for name in chosen for figure in parts[name](console)], console)


def last_line(text: str) -> str:
    """What a program that failed said last."""
    said = text.strip().splitlines()
    return said[-1] if said else "failed without a word"


def environment(name: str, *packages: str) -> Path | str:
    """The Python of a peer's own environment, made and filled when it is not there; else why not."""
    folder = ENVIRONMENTS / name
    python, done = folder / "bin" / "python", folder / ".done"
    if done.is_file():
        return python
    pip = [python, "-m", "pip", "install", "--quiet", *packages]
    for command in ([sys.executable, "-m", "venv", "--clear", folder], pip):
        made = subprocess.run(command, capture_output=True, text=True, check=False)
        if made.returncode:
            shutil.rmtree(folder, ignore_errors=True)
            return f"absent: {last_line(made.stderr)}"
    done.touch()
    return python
