"""What interruptions cost, as a picture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.figure import Figure

from experiments.figures import plain
from experiments.interruptions.kinds import KINDS
from experiments.interruptions.table import TITLES


def interruptions_figure(rows: Sequence[Mapping[str, Any]]) -> Figure:
    """Ratios of errors above, shares far off below; a column a moment, a colour a method."""
    methods = list(dict.fromkeys(row["method"] for row in rows))
    asked = [moment for moment in TITLES if any(row["moment"] == moment for row in rows)]
    figure = Figure(figsize=(5 * len(asked) + 1, 8), layout="constrained")
    axes = figure.subplots(2, len(asked), squeeze=False, sharey="row", sharex="col")
    for column, moment in enumerate(asked):
        found = {(row["method"], row["kind"]): row for row in rows if row["moment"] == moment}
        kinds = [kind for kind in KINDS if any((method, kind) in found for method in methods)]
        above, below = axes[0, column], axes[1, column]
        for i, method in enumerate(methods):
            there = [(k, found[method, kind]) for k, kind in enumerate(kinds) if (method, kind) in found]
            places = [k + 0.18 * (i - (len(methods) - 1) / 2) for k, _ in there]
            ratios = [row["ratio"] for _, row in there]
            bars = [[row["ratio"] - row["low"] for _, row in there], [row["high"] - row["ratio"] for _, row in there]]
            above.errorbar(places, ratios, bars, fmt="o", ms=5, elinewidth=1, color=f"C{i}", label=plain(method))
            below.plot(places, [100 * row["far"] for _, row in there], "o", ms=5, color=f"C{i}")
        above.axhline(1, color="black", linewidth=1)
        above.axhline(1.5, color="black", linewidth=1, linestyle=":")
        above.set_yscale("log")
        above.set_title(TITLES[moment], fontsize=10)
        below.set_yscale("symlog", linthresh=1)
        below.set_xticks(range(len(kinds)), [plain(kind) for kind in kinds], rotation=40, ha="right", fontsize=8)
        for axis in (above, below):
            axis.grid(axis="y", which="both", alpha=0.2)
            axis.spines[["top", "right"]].set_visible(False)
    axes[0, 0].set_ylabel("mean absolute error of the end,\nover that undisturbed [1]")
    axes[1, 0].set_ylabel("further off than 4 deviations [%]")
    axes[0, 0].legend(fontsize=8)
    return figure
