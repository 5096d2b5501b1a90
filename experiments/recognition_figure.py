"""Pictures of recognition: accuracy and error over the share that was seen, and how often the sure are right."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.figure import Figure

from experiments.figures import colour, plain


def recognition_figure(results: Mapping[str, Any]) -> Figure:
    """Three panels: accuracy, reliability, and the error of the end."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    _curves(axes[0], results, "accuracy", None)
    axes[0].set_ylabel("share that is recognised")
    axes[0].set_ylim(0, 1.02)
    axes[1].plot([0, 1], [0, 1], color="0.5", lw=0.8, ls="--")
    for name, report in results["calibration"].items():
        bins = report["reliability"]
        label = f"{name}: error {report['expected_calibration_error']:.3f}"
        axes[1].plot(
            [b["confidence"] for b in bins],
            [b["accuracy"] for b in bins],
            "o-",
            ms=4,
            color=colour(name),
            label=label,
        )
    axes[1].set_xlabel("probability of the most probable label")
    axes[1].set_ylabel("share that is right")
    target, unit = next((row["modality"], row["unit"]) for row in results["rows"] if row["metric"] == "mae")
    _curves(axes[2], results, "mae", target)
    axes[2].set_ylabel(plain(f"error of the end, {target} [{unit}]"))
    axes[2].set_ylim(bottom=0)
    for axis in axes:
        axis.grid(alpha=0.3)
        axis.legend(fontsize=8)
    return figure


def _curves(axis: Any, results: Mapping[str, Any], metric: str, modality: str | None) -> None:
    rows = [row for row in results["rows"] if (row["metric"], row["modality"]) == (metric, modality)]
    for name in dict.fromkeys(row["method"] for row in rows):
        mine = [row for row in rows if row["method"] == name]
        errors = [row["standard_error"] or 0.0 for row in mine]
        axis.errorbar(
            [row["observed"] for row in mine], [row["mean"] for row in mine], errors,
            marker="o", ms=4, capsize=2, color=colour(name), label=name,
        )  # fmt: skip
    axis.set_xlabel("share of the interaction that was seen")
