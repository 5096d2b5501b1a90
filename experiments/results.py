"""The table of an experiment: means, standard errors, tests; as JSON and as text. Nothing is computed elsewhere."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.stats import mannwhitneyu


class Cell(NamedTuple):
    """What a value was measured on."""

    subset: str
    observed: float
    metric: str
    modality: str | None
    unit: str


Values = dict[Cell, dict[str, NDArray[np.float64]]]
"""For each cell and method one value an interaction; NaN where there is none."""


def summarise(values: Values, reference: str) -> dict[str, Any]:
    """``rows``, ``comparisons`` of every method with the reference, and ``summary``, means over the cells.

    Comparisons are two-sided Mann-Whitney U tests, as in the paper.
    """
    rows, comparisons = [], []
    for cell, methods in values.items():
        key = {"subset": cell.subset, "observed": cell.observed, "metric": cell.metric, "modality": cell.modality}
        measured = {name: array[~np.isnan(array)] for name, array in methods.items()}
        for name, array in measured.items():
            if len(array):
                error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else None
                statistics = {"mean": float(array.mean()), "standard_error": error, "n": len(array)}
                rows.append({"method": name, **key, "unit": cell.unit, **statistics})
        for name, array in measured.items():
            if name != reference and len(array) and len(measured.get(reference, ())):
                p_value = float(mannwhitneyu(measured[reference], array).pvalue)
                comparisons.append({**key, "a": reference, "b": name, "p_value": p_value})
    return {"rows": rows, "comparisons": comparisons, "summary": _over_cells(rows)}


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


def tables(results: Mapping[str, Any]) -> list[Table]:
    """One table for each metric and modality: methods down, subsets and fractions across, the best in bold.

    ``*`` marks what differs from the reference of the comparisons with p < 0.05.
    """
    rows, made = results["rows"], []
    columns = list(dict.fromkeys((row["subset"], row["observed"]) for row in rows))
    differing = {
        (c["subset"], c["observed"], c["metric"], c["modality"], c["b"])
        for c in results["comparisons"]
        if c["p_value"] < 0.05
    }
    for metric, modality, unit in dict.fromkeys((row["metric"], row["modality"], row["unit"]) for row in rows):
        title = " ".join(part for part in (metric, modality, f"[{unit}]".replace("[", "\\[")) if part)
        table = Table(title=title, title_justify="left")
        table.add_column("method")
        for subset, observed in columns:
            table.add_column(f"{subset}\n{observed:.0%}", justify="right")
        table.add_column("mean of\ncells", justify="right")
        group = [row for row in rows if (row["metric"], row["modality"]) == (metric, modality)]
        best = {
            column: _best(metric, [row["mean"] for row in group if (row["subset"], row["observed"]) == column])
            for column in columns
        }
        for method in dict.fromkeys(row["method"] for row in group):
            line = {(row["subset"], row["observed"]): row for row in group if row["method"] == method}
            cells = []
            for column in columns:
                if column not in line:
                    cells.append("-")
                    continue
                row = line[column]
                text = f"{row['mean']:.3g}"
                if row["standard_error"] is not None:
                    text += f" ±{row['standard_error']:.1g}"
                text += "*" if (*column, metric, modality, method) in differing else ""
                cells.append(f"[bold]{text}[/bold]" if row["mean"] == best[column] else text)
            mean = next(
                s["mean"]
                for s in results["summary"]
                if (s["method"], s["metric"], s["modality"]) == (method, metric, modality)
            )
            table.add_row(method, *cells, f"{mean:.3g}")
        made.append(table)
    return made


def _best(metric: str, means: Sequence[float]) -> float | None:
    if not means:
        return None
    return min(means, key=lambda mean: abs(mean - 0.95)) if metric == "coverage_95" else min(means)


def print_tables(results: Mapping[str, Any], console: Console | None = None) -> None:
    """Print every table of the results."""
    console = Console() if console is None else console
    if not console.is_terminal:
        console.width = max(console.width, 160)
    for table in tables(results):
        console.print(table)
    console.print("* differs from ebip_tuned, Mann-Whitney U, p < 0.05; bold: best; ±: standard error")
