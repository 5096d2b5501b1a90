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

from experiments.comparisons import LEVEL, compared, corrected, verdicts


class Cell(NamedTuple):
    """What a value was measured on."""

    subset: str
    observed: float
    metric: str
    modality: str | None
    unit: str
    ahead: float | None = None
    """Seconds after the last sample that was shown; None: the end."""


TEST = "Mann-Whitney U, Holm's p over the cells of a line"
"""What decides on the marks of a table."""

Values = dict[Cell, dict[str, NDArray[np.float64]]]
"""For each cell and method one value an interaction; NaN where there is none."""


def summarise(values: Values, reference: str | None = None) -> dict[str, Any]:
    """``rows``, ``comparisons`` and ``summary``, means over the cells.

    Comparisons are of every method with the reference; without one, with the best method of each cell, see
    `experiments.comparisons`.
    """
    rows, comparisons = [], list[dict[str, Any]]()
    for cell, methods in values.items():
        key = {"subset": cell.subset, "observed": cell.observed, "metric": cell.metric, "modality": cell.modality}
        key |= {} if cell.ahead is None else {"ahead": cell.ahead}
        measured = {name: array[~np.isnan(array)] for name, array in methods.items()}
        measured = {name: array for name, array in measured.items() if len(array)}
        for name, array in measured.items():
            error = float(array.std(ddof=1) / math.sqrt(len(array))) if len(array) > 1 else None
            statistics = {"mean": float(array.mean()), "standard_error": error, "n": len(array)}
            rows.append({"method": name, **key, "unit": cell.unit, **statistics})
        against = reference
        if against is None and measured:
            against = min(measured, key=lambda name: _badness(cell.metric, float(measured[name].mean())))
        if against in measured:
            tests = compared({name: methods[name] for name in measured}, against)
            comparisons += [{**key, **test} for test in tests]
    results = {"rows": rows, "comparisons": corrected(comparisons), "summary": _over_cells(rows)}
    return results | {"reference": reference}


def _over_cells(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    groups: dict[tuple[Any, ...], list[float]] = {}
    for row in rows:
        key = (row["method"], row["metric"], row["modality"], row["unit"], row.get("ahead"))
        groups.setdefault(key, []).append(row["mean"])
    return [
        {
            "method": method,
            "metric": metric,
            "modality": modality,
            "unit": unit,
            "mean": sum(m) / len(m),
            "cells": len(m),
            **({} if ahead is None else {"ahead": ahead}),
        }
        for (method, metric, modality, unit, ahead), m in groups.items()
    ]


class Grid(NamedTuple):
    """One table: methods down, cells or horizons across; of cells, with the mean over them at the end.

    Attributes:
        title: metric, modality, unit and how far ahead.
        columns: names of the cells or horizons, of a line or two.
        lines: for each method a text for each cell, and whether it is the best.
    """

    title: str
    columns: list[str]
    lines: dict[str, list[tuple[str, bool]]]


def grids(results: Mapping[str, Any], only: Sequence[tuple[str, str | None]] | None = None) -> list[Grid]:
    """A table for each metric and modality, or for ``only`` some of these pairs.

    With a reference, ``*`` marks what differs from it, and ``†`` what does when interactions are compared in pairs;
    without, ``°`` marks what is not significantly worse than the best of the cell. Corrected for the cells of the
    table, see `experiments.comparisons`.
    """
    rows, made = results["rows"], []
    differing, in_pairs = (
        {
            (c["subset"], c["observed"], c["metric"], c["modality"], c.get("ahead"), c["b"])
            for c in results["comparisons"]
            if c[p] < LEVEL
        }
        for p in ("p_holm", "p_paired_holm")
    )
    kinds = dict.fromkeys((row["metric"], row["modality"], row["unit"], row.get("ahead")) for row in rows)
    for metric, modality, unit, ahead in kinds:
        if only is not None and ((metric, modality) not in only or ahead is not None):
            continue
        kind = (metric, modality, ahead)
        group = [row for row in rows if (row["metric"], row["modality"], row.get("ahead")) == kind]
        columns = list(dict.fromkeys((row["subset"], row["observed"]) for row in group))
        factor, shown = _unit(unit, group)
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
                differs = (*column, *kind, method) in differing
                if results["reference"] is None:
                    text += "" if differs or first else "°"
                else:
                    text += "*" if differs else "†" if (*column, *kind, method) in in_pairs else ""
                cells.append((text, first))
            mean = next(
                s
                for s in results["summary"]
                if (s["method"], s["metric"], s["modality"], s.get("ahead")) == (method, *kind)
            )
            # A mean over fewer cells than others have would not compare with theirs.
            whole = mean["cells"] == sum(best[column] is not None for column in columns)
            lines[method] = [*cells, (f"{factor * mean['mean']:.3g}" if whole else "-", False)]
        title = " ".join(part for part in (metric, modality, f"[{shown}]") if part)
        title += "" if ahead is None else f", {ahead:g} s ahead"
        names = [f"{subset}\n{observed:.0%}" for subset, observed in columns]
        made.append(Grid(title, [*names, "mean of\ncells"], lines))
    return made


def horizon_grids(results: Mapping[str, Any], only: Sequence[tuple[str, str | None]] | None = None) -> list[Grid]:
    """A table for each metric and modality that has horizons: the means over cells, a column a horizon.

    Over those cells that all horizons have, so that the columns can be compared.
    """
    rows, made = results["rows"], []
    for metric, modality, unit in dict.fromkeys((row["metric"], row["modality"], row["unit"]) for row in rows):
        group = [row for row in rows if (row["metric"], row["modality"]) == (metric, modality)]
        horizons = sorted({row.get("ahead", math.inf) for row in group})
        if len(horizons) < 2 or (only is not None and (metric, modality) not in only):
            continue
        cells = [
            {(row["subset"], row["observed"]) for row in group if row.get("ahead", math.inf) == h} for h in horizons
        ]
        shared = set.intersection(*cells)
        group = [row for row in group if (row["subset"], row["observed"]) in shared]
        factor, shown = _unit(unit, group)
        means: dict[str, list[float | None]] = {}
        for method in dict.fromkeys(row["method"] for row in group):
            mine = [row for row in group if row["method"] == method]
            each = [[row["mean"] for row in mine if row.get("ahead", math.inf) == h] for h in horizons]
            means[method] = [sum(m) / len(m) if len(m) == len(shared) else None for m in each]
        best = [
            min((m[i] for m in means.values() if m[i] is not None), key=lambda v: _badness(metric, v), default=None)  # type: ignore[arg-type]
            for i in range(len(horizons))
        ]
        lines = {
            method: [("-", False) if v is None else (f"{factor * v:.3g}", v == best[i]) for i, v in enumerate(values)]
            for method, values in means.items()
        }
        title = " ".join(part for part in (metric, modality, f"[{shown}] by seconds ahead") if part)
        made.append(Grid(title, ["end" if math.isinf(h) else f"{h:g} s" for h in horizons], lines))
    return made


def verdict_grids(results: Mapping[str, Any], only: Sequence[tuple[str, str | None]] | None = None) -> list[Grid]:
    """Of a reference, in how many cells it is better and worse than each other method: a column a table."""
    rows = [row for row in verdicts(results) if only is None or (row["metric"], row["modality"]) in only]
    columns = list(dict.fromkeys((row["metric"], row["modality"], row["ahead"]) for row in rows))
    lines: dict[str, list[tuple[str, bool]]] = {}
    for row in rows:
        line = lines.setdefault(row["method"], [("-", False)] * len(columns))
        text = f"{row['better']} / {row['worse']} of {row['cells']}, p {row['p_worse']:.2g}"
        line[columns.index((row["metric"], row["modality"], row["ahead"]))] = text, False
    heads = [
        " ".join(part for part in (metric, modality) if part) + ("" if ahead is None else f"\n{ahead:g} s")
        for metric, modality, ahead in columns
    ]
    title = f"{results['reference']}: cells better / worse (Holm's p < {LEVEL}), smallest p of one that is worse"
    return [Grid(title, heads, lines)] if lines else []


def _unit(unit: str, rows: Sequence[Mapping[str, Any]]) -> tuple[float, str]:
    """Factor and name: millimetres where all is below a decimetre, as people speak of it."""
    return (1e3, "mm") if unit == "m" and max(row["mean"] for row in rows) < 0.1 else (1.0, unit)


def legend(results: Mapping[str, Any]) -> str:
    """What the marks in the tables mean."""
    reference = results["reference"]
    if reference is None:
        return f"bold: best of the cell; °: not significantly worse ({TEST} >= {LEVEL}); ±: standard error"
    pairs = "†: only in pairs, Wilcoxon's signed ranks"
    return f"bold: best; *: differs from {reference} ({TEST} < {LEVEL}); {pairs}; ±: standard error"


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
    for grid in (*grids(results, only), *horizon_grids(results, only), *verdict_grids(results, only)):
        table = Table(title=escape(grid.title), title_justify="left")
        table.add_column("method")
        for column in grid.columns:
            table.add_column(escape(column), justify="right")
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
    for grid in (*horizon_grids(results), *grids(results), *verdict_grids(results)):
        heads = ["method", *(_cell(column.replace("\n", " ")) for column in grid.columns)]
        lines = [f"**{grid.title}**", "", f"| {' | '.join(heads)} |", f"|{'---|' * len(heads)}"]
        for method, cells in grid.lines.items():
            texts = (f"**{text}**" if best else text.replace("*", "\\*") for text, best in cells)
            lines.append(f"| `{method}` | {' | '.join(texts)} |")
        parts.append("\n".join(lines))
    return "\n\n".join([*parts, legend(results)]) + "\n"
