"""What the throws add up to: rates with Wilson intervals, paired tests, medians; as rows, as text, as Markdown."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest

from experiments.catch.jobs import Results

BUDGET = 1000 / 60
"""ms a control cycle has."""


def summarise(results: Results, reference: str) -> dict[str, Any]:
    """``rows``, one a method, condition and metric, and ``comparisons`` of all methods with the reference.

    The same throws were thrown at all methods, so the test is McNemar's: the exact binomial test on the throws that
    one of the two caught and the other did not.
    """
    rows, comparisons = [], []
    for (method, condition), throws in results.items():
        key = {"method": method, "condition": condition}
        rows += [{**key, **row} for row in _rows(throws)]
        if method != reference and (reference, condition) in results:
            for within in (False, True):
                pairs = zip(results[reference, condition], throws, strict=True)
                kept = [(a["caught"], b["caught"]) for a, b in pairs if a["catchable"] or not within]
                better, worse = sum(a and not b for a, b in kept), sum(b and not a for a, b in kept)
                p_value = float(binomtest(better, better + worse).pvalue) if better + worse else 1.0
                metric = "caught_within_reach" if within else "caught"
                comparisons.append(
                    {
                        "condition": condition,
                        "metric": metric,
                        "a": reference,
                        "b": method,
                        "only_a": better,
                        "only_b": worse,
                        "p_value": p_value,
                    }
                )
    return {"rows": rows, "comparisons": comparisons, "reference": reference}


def _rows(throws: list[dict[str, Any]]) -> Iterator[dict[str, Any]]:
    near = [throw for throw in throws if throw["catchable"]]
    for metric, group, name in (
        ("caught", throws, "caught"),
        ("caught_within_reach", near, "caught"),
        ("touched", throws, "touched"),
    ):
        count, n = sum(throw[name] for throw in group), len(group)
        if n:
            interval = binomtest(count, n).proportion_ci(method="wilson")
            yield _row(metric, "1", count / n, n, float(interval.low), float(interval.high))
    distances = np.array([throw["distance"] for throw in throws if throw["distance"] is not None])
    ahead = np.array([throw["ahead"] for throw in throws])
    for metric, unit, values in (("distance", "m", distances), ("ahead_of_release", "s", ahead)):
        low, middle, high = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
        yield _row(metric, unit, middle, len(values), low, high)
    yield _row("settled_before_release", "1", float((ahead > 0).mean()), len(ahead))
    cycles = 1e3 * np.concatenate([throw["seconds"] for throw in throws])
    if len(cycles):
        median, slowest = np.quantile(cycles, (0.5, 0.99)).tolist()
        yield _row("cycle_median", "ms", median, len(cycles))
        yield _row("cycle_p99", "ms", slowest, len(cycles))
        yield _row("cycle_over_budget", "1", float((cycles > BUDGET).mean()), len(cycles))


def _row(
    metric: str, unit: str, value: float, n: int, low: float | None = None, high: float | None = None
) -> dict[str, Any]:
    return {"metric": metric, "unit": unit, "value": value, "low": low, "high": high, "n": n}


HEADS = (
    "condition",
    "method",
    "caught",
    "p",
    "caught within reach",
    "distance [m]",
    "ahead of release [s]",
    "before release",
    "cycle [ms]",
)


def lines(summary: Mapping[str, Any]) -> list[tuple[str, ...]]:
    """The table, a line a method and condition; see `HEADS`."""
    found: dict[tuple[str, str], dict[str, Any]] = {}
    for row in summary["rows"]:
        found.setdefault((row["condition"], row["method"]), {})[row["metric"]] = row
    p_values = {(c["condition"], c["b"]): c["p_value"] for c in summary["comparisons"] if c["metric"] == "caught"}
    made = []
    for (condition, method), metrics in found.items():
        p = p_values.get((condition, method))
        cycle = "-"
        if "cycle_median" in metrics:
            cycle = f"{metrics['cycle_median']['value']:.1f}, {metrics['cycle_p99']['value']:.1f}"
        distance, ahead = metrics["distance"], metrics["ahead_of_release"]
        made.append(
            (
                condition,
                method,
                _rate(metrics.get("caught")),
                "" if p is None else f"{p:.2g}",
                _rate(metrics.get("caught_within_reach")),
                f"{distance['value']:.3f} ({distance['low']:.3f} to {distance['high']:.3f})",
                f"{ahead['value']:+.2f} ({ahead['low']:+.2f} to {ahead['high']:+.2f})",
                f"{metrics['settled_before_release']['value']:.0%}",
                cycle,
            )
        )
    return sorted(made, key=lambda line: line[0])


def _rate(row: Mapping[str, Any] | None) -> str:
    if row is None:
        return "-"
    return f"{row['value']:.0%} ({100 * row['low']:.0f} to {100 * row['high']:.0f} %, n = {row['n']})"


def legend(summary: Mapping[str, Any]) -> str:
    """What the columns mean."""
    return (
        "caught: in the box a second after it touched it, with Wilson's 95 % interval; p: exact McNemar test against "
        f"{summary['reference']}; within reach: an arm that sets out at the release can get there; distance: of the "
        "ball from the box's centre at its closest, median and quartiles; ahead of release: how long before it the "
        "box stayed within 20 cm of its final place, median and quartiles; before release: share of throws in which "
        "that was before it (an arm that never moves has that in all); cycle: median and 99th percentile, "
        f"of {BUDGET:.1f} ms"
    )


def print_table(summary: Mapping[str, Any]) -> None:
    """To the terminal."""
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, 190)
    table = Table()
    for head in HEADS:
        table.add_column(head.replace("[", "\\["))
    for line in lines(summary):
        table.add_row(*line)
    console.print(table)
    console.print(legend(summary))


def markdown(summary: Mapping[str, Any]) -> str:
    """The table in Markdown."""
    body = [f"| {' | '.join((line[0], f'`{line[1]}`', *line[2:]))} |" for line in lines(summary)]
    return "\n".join([f"| {' | '.join(HEADS)} |", f"|{'---|' * len(HEADS)}", *body, "", legend(summary), ""])
