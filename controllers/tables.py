"""Comparisons as tables: a row a variant, or a row a run, as CSV or Parquet."""

from __future__ import annotations

import csv
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib import import_module
from pathlib import Path
from typing import Any

from ..sim.errors import PantographError, unknown
from ..sim.recording import check_writable
from .experiments import Comparison
from .experiments.variants import shown

FORMATS = ("csv", "parquet")


def summary(comparison: Comparison) -> list[dict[str, Any]]:
    """A row a variant: its parameters, figures of the run as modelled, and how the disturbed runs went."""
    out = []
    for row in comparison.rows:
        spread = {"disturbed": len(row.disturbed), "failed": row.failed, "worst_rms": row.robust}
        share = {"period": row.period, "tick99_of_period": row.nominal.tick99 / row.period}
        out.append(_head(comparison, row.variant) | asdict(row.nominal) | share | spread)
    return out


def runs(comparison: Comparison) -> list[dict[str, Any]]:
    """A row a run: the variant's parameters, what disturbed it, its figures."""
    says = ("as modelled", *(d.say for d in comparison.disturbances))
    return [
        _head(comparison, row.variant) | {"disturbance": say} | asdict(figures)
        for row in comparison.rows
        for say, figures in zip(says, (row.nominal, *row.disturbed), strict=True)
    ]


def _head(comparison: Comparison, variant: Any) -> dict[str, Any]:
    """The law and a column for every parameter that any variant has."""
    words = dict.fromkeys(word for row in comparison.rows for word in row.variant.words)
    return {"law": variant.law} | {word: _plain(variant.words.get(word)) for word in words}


def _plain(value: Any) -> Any:
    """A parameter as one number or text."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    return shown(value)


def check_format(ending: str) -> None:
    """Raise PantographError when tables cannot be saved as "csv", "parquet" (needs pyarrow) or whatever."""
    if ending not in FORMATS:
        raise PantographError(unknown("kind of table", ending, FORMATS, where="Pantograph"))
    if ending == "parquet":
        _arrow()


def check_outputs(folder: Path, paths: Sequence[Path]) -> None:
    """Raise PantographError when ``paths`` in ``folder`` cannot be written, before work is spent on them."""
    check_writable(folder)
    for path in paths:
        if path.is_dir() or (path.exists() and not os.access(path, os.W_OK)):
            raise PantographError(
                f"cannot write {path}: it is {'a folder' if path.is_dir() else 'protected'}"
            )


def save(rows: Sequence[Mapping[str, Any]], path: str | Path) -> Path:
    """Write rows of equal columns; the path's ending chooses the format.

    Raises PantographError as :func:`check_format`, and when the file cannot be written.
    """
    path = Path(path)
    check_format(path.suffix.removeprefix("."))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        (_parquet if path.suffix == ".parquet" else _csv)(rows, path)
    except OSError as e:
        raise PantographError(f"cannot write {path}: {e.strerror or e}") from None
    return path


def _csv(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    with path.open("w", newline="", encoding="utf-8") as f:
        writer = csv.DictWriter(f, fieldnames=list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)


def _arrow() -> tuple[Any, Any]:
    """The modules pyarrow and pyarrow.parquet."""
    try:
        return import_module("pyarrow"), import_module("pyarrow.parquet")
    except ImportError:
        raise PantographError(
            "tables as Parquet need pyarrow: pip install 'pantograph-sim[parquet]', or save as CSV"
        ) from None


def _parquet(rows: Sequence[Mapping[str, Any]], path: Path) -> None:
    arrow, parquet = _arrow()
    parquet.write_table(arrow.table({name: _column([row[name] for row in rows]) for name in rows[0]}), path)


def _column(values: list[Any]) -> list[Any]:
    """Values of one kind: numbers, or texts where any is one."""
    if any(isinstance(x, str) for x in values):
        return [None if x is None else str(x) for x in values]
    return values
