"""The table of an experiment: means, standard errors, tests; as JSON and as text. Nothing is computed elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table


class Cell(NamedTuple):
    """What a value was measured on."""

    subset: str
    observed: float
    metric: str
    modality: str | None
    unit: str


Values = dict[Cell, dict[str, NDArray[np.float64]]]
"""For each cell and method one value an interaction; NaN where there is none."""


def summarise(values: Values, reference: str | None = None) -> dict[str, Any]:
    """``rows``, ``comparisons`` and ``summary``, means over the cells.

    Comparisons are two-sided Mann-Whitney U tests, as in the paper: of every method with the reference; without
    one, with the best method of each cell.
    """
    rows, comparisons = [], []
    for cell, methods in values.items():
        key = {"subset": cell.subset, "observed": cell.observed, "metric": cell.metric, "modality": cell.modality}
        measured = {name: array[~np.isnan(array)] for name, array in methods.items()}
        measured = {name: array for name, array in measured.items() if len(array)}
        for name, array in measured.items():
            error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else None
            statistics = {"mean": float(array.mean()), "standard_error": error, "n": len(array)}
            rows.append({"method": name, **key, "unit": cell.unit, **statistics})
        from scipy.stats import mannwhitneyu  # half a second that no process without a table should wait for

        against = reference
        if against is None and measured:
            against = min(measured, key=lambda name: _badness(cell.metric, float(measured[name].mean())))
        for name, array in measured.items():
            if name != against and against in measured:
                p_value = float(mannwhitneyu(measured[against], array).pvalue)
                comparisons.append({**key, "a": against, "b": name, "p_value": p_value})
    return {"rows": rows, "comparisons": comparisons, "summary": _over_cells(rows), "reference": reference}


def _over_cells(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    groups: dict[tuple[Any, ...], list[float]] = {}
    for row in rows:
        groups.setdefault((row["method"], row["metric"], row["modality"], row["unit"]), []).append(row["mean"])
    return [
        {
            "method": method,
            "metric": metric,
            "modality": modality,
            "unit": unit,
            "mean": sum(m) / len(m),
            "cells": len(m),
        }
        for (method, metric, modality, unit), m in groups.items()
    ]


class Grid(NamedTuple):
    """One table: methods down, cells across, with the mean over cells at the end.

    Attributes:
        title: metric, modality and unit.
        columns: (subset, fraction) of each cell.
        lines: for each method a text for each cell, and whether it is the best.
    """

    title: str
    columns: list[tuple[str, float]]
    lines: dict[str, list[tuple[str, bool]]]


def grids(results: Mapping[str, Any], only: Sequence[tuple[str, str | None]] | None = None) -> list[Grid]:
    """A table for each metric and modality, or for ``only`` some of these pairs.

    With a reference, ``*`` marks what differs from it with p < 0.05; without, ``°`` marks what is not
    significantly worse than the best of the cell.
    """
    rows, made = results["rows"], []
    columns = list(dict.fromkeys((row["subset"], row["observed"]) for row in rows))
    differing = {
        (c["subset"], c["observed"], c["metric"], c["modality"], c["b"])
        for c in results["comparisons"]
        if c["p_value"] < 0.05
    }
    for metric, modality, unit in dict.fromkeys((row["metric"], row["modality"], row["unit"]) for row in rows):
        if only is not None and (metric, modality) not in only:
            continue
        group = [row for row in rows if (row["metric"], row["modality"]) == (metric, modality)]
        # Millimetres where all is below a decimetre: as people speak of it.
        factor, shown = (1e3, "mm") if unit == "m" and max(row["mean"] for row in group) < 0.1 else (1.0, unit)
        best = {
            column: min(
                (row["mean"] for row in group if (row["subset"], row["observed"]) == column),
                key=lambda mean: _badness(metric, mean),
                default=None,
            )
            for column in columns
        }
        lines: dict[str, list[tuple[str, bool]]] = {}
        for method in dict.fromkeys(row["method"] for row in group):
            line = {(row["subset"], row["observed"]): row for row in group if row["method"] == method}
            cells = []
            for column in columns:
                if column not in line:
                    cells.append(("-", False))
                    continue
                row = line[column]
                first = row["mean"] == best[column]
                text = f"{factor * row['mean']:.3g}"
                if row["standard_error"] is not None:
                    text += f" ±{factor * row['standard_error']:.1g}"
                differs = (*column, metric, modality, method) in differing
                if results["reference"] is None:
                    text += "" if differs or first else "°"
                else:
                    text += "*" if differs else ""
                cells.append((text, first))
            mean = next(
                s
                for s in results["summary"]
                if (s["method"], s["metric"], s["modality"]) == (method, metric, modality)
            )
            # A mean over fewer cells than others have would not compare with theirs.
            whole = mean["cells"] == sum(best[column] is not None for column in columns)
            lines[method] = [*cells, (f"{factor * mean['mean']:.3g}" if whole else "-", False)]
        title = " ".join(part for part in (metric, modality, f"[{shown}]") if part)
        made.append(Grid(title, columns, lines))
    return made


def legend(results: Mapping[str, Any]) -> str:
    """What the marks in the tables mean."""
    reference = results["reference"]
    if reference is None:
        return "bold: best of the cell; °: not significantly worse (Mann-Whitney U, p >= 0.05); ±: standard error"
    return f"bold: best; *: differs from {reference} (Mann-Whitney U, p < 0.05); ±: standard error"


def _badness(metric: str, mean: float) -> float:
    return abs(mean - 0.95) if metric == "coverage_95" else mean


def print_tables(
    results: Mapping[str, Any],
    console: Console | None = None,
    only: Sequence[tuple[str, str | None]] | None = None,
) -> None:
    """Print the tables of the results, or only those of some (metric, modality)."""
    console = Console() if console is None else console
    if not console.is_terminal:
        console.width = max(console.width, 160)
    for grid in grids(results, only):
        table = Table(title=escape(grid.title), title_justify="left")
        table.add_column("method")
        for subset, observed in grid.columns:
            table.add_column(escape(f"{subset}\n{observed:.0%}"), justify="right")
        table.add_column("mean of\ncells", justify="right")
        for method, cells in grid.lines.items():
            table.add_row(escape(method), *(f"[bold]{text}[/bold]" if best else text for text, best in cells))
        console.print(table)
    console.print(legend(results), markup=False)


def _cell(text: str) -> str:
    """Text of a cell of a table in Markdown."""
    return text.replace("|", "\\|")


def markdown(results: Mapping[str, Any]) -> str:
    """Every table of the results in Markdown."""
    parts = []
    for grid in grids(results):
        heads = ["method", *(_cell(f"{subset} {observed:.0%}") for subset, observed in grid.columns), "mean"]
        lines = [f"**{grid.title}**", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        for method, cells in grid.lines.items():
            texts = (f"**{text}**" if best else text.replace("*", "\\*") for text, best in cells)
            lines.append(f"| `{method}` | {' | '.join(texts)} |")
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, legend(results)]) + "\n"
