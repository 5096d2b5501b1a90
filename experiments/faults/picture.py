"""What losing each sensor costs, as a picture."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from experiments.figures import plain

GROUPS = {
    "without": "never there",
    "lost": "lost at",
    "back": "lost for a fifth, from",
    "frozen": "frozen",
    "drift": "drifts to 1 sd",
}


def faults_figure(results: Mapping[str, Any], method: str) -> Figure:
    """Error of each fault of a single sensor for one method, over that of the clean recording."""
    target = results["target"]
    error = {
        row["subset"]: row
        for row in results["rows"]
        if (row["method"], row["metric"], row["modality"]) == (method, "mse", target) and row["mean"] is not None
    }
    sensors = list(dict.fromkeys(fault["sensor"] for fault in results["faults"] if fault["sensor"]))
    kinds: dict[str, dict[str, str]] = {}
    for fault in results["faults"]:
        if fault["sensor"] and fault["name"] in error:
            when = fault["name"].removeprefix(f"{fault['sensor']} lost").removeprefix(" at").strip(" ,")
            label = GROUPS[fault["group"]] + (f" {when}" if fault["group"] in ("lost", "back") else "")
            kinds.setdefault(label, {})[fault["sensor"]] = fault["name"]
    figure = Figure(figsize=(11, 5), layout="constrained")
    axis = figure.subplots()
    width = 0.8 / max(1, len(kinds))
    colours = matplotlib.colormaps["turbo"](np.linspace(0.05, 0.95, max(1, len(kinds))))
    for i, (label, names) in enumerate(kinds.items()):
        places = [k + (i - (len(kinds) - 1) / 2) * width for k, sensor in enumerate(sensors) if sensor in names]
        rows = [error[names[sensor]] for sensor in sensors if sensor in names]
        spread = [row["standard_error"] or 0.0 for row in rows]
        axis.errorbar(
            places, [row["mean"] for row in rows], spread, fmt="o", ms=5, elinewidth=1, label=label, color=colours[i]
        )
    axis.axhline(error["clean"]["mean"], color="black", linewidth=1, label="clean")
    axis.set_yscale("log")
    axis.grid(axis="y", which="both", alpha=0.2)
    axis.set_xticks(range(len(sensors)), [plain(sensor) for sensor in sensors], rotation=20, ha="right")
    axis.set_ylabel(plain(f"{method}: mean squared error\nof {target} at the end [{error['clean']['unit']}]"))
    axis.legend(fontsize=8, ncols=2, loc="upper left")
    axis.spines[["top", "right"]].set_visible(False)
    return figure
