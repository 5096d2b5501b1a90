"""A picture of surprise: who is found, and what forecasts are worth that were made meanwhile."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from experiments.figures import plain

COLOURS = {"ebip_cautious": "tab:blue", "ebip_sure": "tab:red", "mean": "0.6"}


def surprise_figure(results: Mapping[str, Any]) -> Figure:
    """Three panels: the share of interactions with an alarm, the error of the end, and how often it is covered."""
    sets = list(results["detection"])
    places = np.arange(len(sets))
    figure, axes = plt.subplots(1, 3, figsize=(14, 0.3 * len(sets) + 1.6), layout="constrained", sharey=True)
    for k, who in enumerate(_who(results)):
        rates = [results["detection"][name]["rate"][who] for name in sets]
        axes[0].plot(rates, places, "osD^v<>"[k % 7], ms=5, label=who if who == "the whole" else f"{who} rejected")
    axes[0].set_xlabel("share of interactions with an alarm")
    axes[0].set_yticks(places, sets)
    axes[0].invert_yaxis()
    for axis, metric in zip(axes[1:], ("mae", "coverage_95"), strict=True):
        rows = [r for r in results["rows"] if r["metric"] == metric and r["observed"] == 0.82]
        for method in dict.fromkeys(row["method"] for row in rows):
            mine = {row["subset"]: row["mean"] for row in rows if row["method"] == method}
            there = [i for i, name in enumerate(sets) if name in mine]
            axis.plot([mine[sets[i]] for i in there], there, "o", ms=5, color=COLOURS[method], label=method)
        unit = f" [{rows[0]['unit']}]" if metric == "mae" else ""
        axis.set_xlabel(plain(f"{'error of the end' if metric == 'mae' else 'covered by 95 %'}, 82 % seen{unit}"))
    axes[1].set_xscale("log")
    axes[2].axvline(0.95, color="0.5", lw=0.8, ls="--")
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return figure


def _who(results: Mapping[str, Any]) -> list[str]:
    """Whoever raised an alarm."""
    found = next(iter(results["detection"].values()))["rate"]
    return [w for w in found if any(d["rate"][w] > 0 for d in results["detection"].values())]
