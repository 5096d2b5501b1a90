"""What each fault costs each filter: rows, costs with intervals, as text and as Markdown."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table
from scipy.stats import bootstrap

from experiments.faults.faults import Fault
from experiments.results import Cell, Values

Array = NDArray[np.float64]


def summarise(values: Values, faults: Sequence[Fault], target: str, seed: int) -> dict[str, Any]:
    """``rows`` of the results, ``costs`` of the faults in the error of one modality, ``faults`` by group.

    The cost of a fault is its mean squared error over that of what it is compared with, less 1: a lost sensor with
    the same sensors without it from the start, all else with the clean recording. The interval is that of a paired
    bootstrap, 95 %, percentiles. A filter that gives up on an interaction has no cost, but the number of them.

    Args:
        values: of all faults; the subset of a cell is the name of the fault; infinite where a filter gave up.
        faults: in the order of the table.
        target: modality whose error counts.
        seed: of the bootstrap.
    """
    rows = [_row(cell, name, array) for cell, methods in values.items() for name, array in methods.items()]
    errors = {cell.subset: methods for cell, methods in values.items() if _is_error(cell, target)}
    names = {fault.name for fault in faults}
    costs = []
    for fault in faults:
        reference = f"without {fault.sensor}" if fault.group == "lost" else "clean"
        if fault.name == reference or reference not in names:
            continue
        for method, array in errors[fault.name].items():
            base = errors[reference].get(method)
            if base is None:
                continue
            asked = ~np.isnan(array)
            pairs = np.stack([array[asked], base[asked]])
            failed = int((~np.isfinite(pairs[0])).sum())
            key = {"fault": fault.name, "group": fault.group, "method": method, "against": reference}
            if failed:
                costs.append({**key, "cost": None, "low": None, "high": None, "gave_up": failed})
            elif pairs.size and np.isfinite(pairs).all():
                cost, low, high = _cost(pairs[0], pairs[1], seed)
                costs.append({**key, "cost": cost, "low": low, "high": high, "gave_up": 0})
    listed = [{"name": fault.name, "group": fault.group, "sensor": fault.sensor} for fault in faults]
    return {"rows": rows, "comparisons": [], "costs": costs, "faults": listed, "target": target}


def _is_error(cell: Cell, target: str) -> bool:
    return cell.metric == "mse" and cell.modality == target


def _row(cell: Cell, method: str, array: Array) -> dict[str, Any]:
    asked = array[~np.isnan(array)]
    answered = asked[np.isfinite(asked)]
    count = len(answered)
    return {
        "method": method,
        **cell._asdict(),
        "mean": float(answered.mean()) if count else None,
        "standard_error": float(answered.std(ddof=1) / math.sqrt(count)) if count > 1 else None,
        "n": count,
        "gave_up": len(asked) - count,
    }


def _cost(array: Array, base: Array, seed: int) -> tuple[float, float, float]:
    def ratio(a: Array, b: Array, axis: int) -> Array:
        """Of the means."""
        quotient: Array = a.mean(axis) / b.mean(axis) - 1
        return quotient

    cost = float(ratio(array, base, 0))
    if len(array) < 2 or np.array_equal(array, base):
        return cost, cost, cost
    found = bootstrap(
        (array, base), ratio, paired=True, vectorized=True, method="percentile", n_resamples=2000,
        rng=np.random.default_rng(seed),
    )  # fmt: skip
    return cost, float(found.confidence_interval.low), float(found.confidence_interval.high)


def worst(results: Mapping[str, Any], group: str, method: str) -> dict[str, Any] | None:
    """The most expensive fault of a group for a method, one that it gives up on before others; None without any."""
    found = [cost for cost in results["costs"] if (cost["group"], cost["method"]) == (group, method)]
    return max(found, key=lambda cost: (cost["gave_up"], cost["cost"] or 0.0), default=None)


def lines(results: Mapping[str, Any], coverage: bool = True) -> tuple[list[str], list[list[str]]]:
    """Heads and lines of the table: joint error, and coverage of the 95 % interval, of every fault and method."""
    target = results["target"]
    cells: dict[tuple[str, str, str], dict[str, Any]] = {
        (row["subset"], row["method"], row["metric"]): row for row in results["rows"] if row["modality"] == target
    }
    methods = list(dict.fromkeys(row["method"] for row in results["rows"]))
    body = []
    for fault in results["faults"]:
        line = [fault["name"]]
        for method in methods:
            row = cells.get((fault["name"], method, "mse"))
            if row is None or row["mean"] is None:
                line.append("gives up" if row is not None else "-")
                continue
            text = _number(row["mean"])
            if row["gave_up"]:
                text += f" ({row['gave_up']} of {row['n'] + row['gave_up']} given up)"
            inside = cells.get((fault["name"], method, "coverage_95"))
            if coverage and inside is not None and inside["mean"] is not None:
                text += f", {inside['mean']:.0%}"
            line.append(text)
        body.append(line)
    asked = {
        name: max((row["n"] + row["gave_up"] for row in results["rows"] if row["method"] == name), default=0)
        for name in methods
    }
    most = max(asked.values(), default=0)
    heads = [name if asked[name] == most else f"{name} (n = {asked[name]})" for name in methods]
    return ["fault", *heads], body


def _number(value: float) -> str:
    return f"{value:.3g}" if 1e-3 <= value < 1e3 else f"{value:.0e}"


def _share(cost: float) -> str:
    """More than ten times as much is said as a factor."""
    return f"{100 * cost:+.0f} %" if cost < 9 else f"x {cost + 1:.2g}"


def print_table(results: Mapping[str, Any]) -> None:
    """To the terminal, with what single losses cost."""
    heads, body = lines(results)
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, 180)
    table = Table(title=escape(_title(results)), title_justify="left")
    for head in heads:
        table.add_column(escape(head), justify="left" if head == "fault" else "right")
    groups = [fault["group"] for fault in results["faults"]]
    for i, line in enumerate(body):
        table.add_row(*map(escape, line), end_section=i + 1 < len(groups) and groups[i + 1] != groups[i])
    console.print(table)
    for line in verdicts(results):
        console.print(line, markup=False)


def verdicts(results: Mapping[str, Any]) -> list[str]:
    """The most expensive fault of each group, for each method."""
    found = []
    for group in dict.fromkeys(fault["group"] for fault in results["faults"]):
        parts = []
        for method in dict.fromkeys(cost["method"] for cost in results["costs"]):
            cost = worst(results, group, method)
            if cost is not None and cost["gave_up"]:
                parts.append(f"{method} gives up on {cost['gave_up']} interactions ({cost['fault']})")
            elif cost is not None:
                interval = f"{_share(cost['low'])} to {_share(cost['high'])}"
                parts.append(f"{method} {_share(cost['cost'])} ({interval}; {cost['fault']})")
        if parts:
            against = "the same sensors without it from the start" if group == "lost" else "clean"
            found.append(f"{group}, worst against {against}: " + "; ".join(parts))
    return found


def markdown(results: Mapping[str, Any]) -> str:
    """The table and the verdicts."""
    heads, body = lines(results)
    head = f"| {' | '.join(heads)} |\n|{'---|' * len(heads)}\n"
    table = head + "\n".join(f"| {' | '.join(line)} |" for line in body)
    return f"**{_title(results)}**\n\n{table}\n\n" + "\n".join(f"- {line}" for line in verdicts(results)) + "\n"


def _title(results: Mapping[str, Any]) -> str:
    unit = next(
        row["unit"] for row in results["rows"] if (row["metric"], row["modality"]) == ("mse", results["target"])
    )
    return f"mean squared error of {results['target']} at the end [{unit}], coverage of 95 % intervals"
