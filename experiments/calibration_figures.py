"""Pictures of errors over the observed share, and of how well uncertainty matches them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from experiments.figures import colour, plain
from experiments.results import Values


def error_figure(values: Values, panels: Sequence[tuple[str, str]]) -> Figure:
    """Error over the observed share: mean (line) and 10 to 90 % of the interactions (band); a panel a modality."""
    figure, axes = plt.subplots(1, len(panels), figsize=(5.2 * len(panels), 3.6), squeeze=False, layout="constrained")
    for axis, (modality, metric) in zip(axes[0], panels, strict=True):
        cells = sorted((c for c in values if (c.metric, c.modality) == (metric, modality)), key=lambda c: c.observed)
        for name in values[cells[0]]:
            arrays = [values[cell][name] for cell in cells]
            at = [cell.observed for cell in cells]
            low, high = (np.array([np.nanpercentile(array, q) for array in arrays]) for q in (10, 90))
            axis.plot(at, [np.nanmean(array) for array in arrays], color=colour(name), label=name)
            axis.fill_between(at, low, high, color=colour(name), alpha=0.15, lw=0)
        axis.set_xlabel("observed share of the interaction")
        axis.set_ylabel(plain(f"{metric} of the end of {modality} [{cells[0].unit}]"))
        axis.set_ylim(bottom=0)
        axis.grid(alpha=0.3)
    axes[0, 0].legend(fontsize=8)
    observed = plain(cells[0].subset)
    figure.suptitle(f"observed: {observed}; band: 10 to 90 % of the held-out interactions", fontsize=9)
    return figure


def calibration_figure(reports: Mapping[str, Mapping[str, Any]], modality: str) -> Figure:
    """Rank histograms, flat if calibrated, and empirical over nominal coverage of central intervals."""
    figure, axes = plt.subplots(
        1, len(reports) + 1, figsize=(3.1 * (len(reports) + 1), 3.2), squeeze=False, layout="constrained"
    )
    curve = axes[0, -1]
    curve.plot([0, 1], [0, 1], color="0.4", lw=0.8, ls="--")
    top = max(max(report["rank_histogram"]) for report in reports.values())
    for axis, (name, report) in zip(axes[0], reports.items(), strict=False):
        heights = report["rank_histogram"]
        axis.bar((np.arange(10) + 0.5) / 10, heights, 0.09, color=colour(name))
        axis.axhline(0.1, color="0.4", lw=0.8, ls="--")
        axis.set_title(name, fontsize=9)
        axis.set_xlabel("predicted probability of less")
        axis.set_ylim(0, 1.05 * top)
        curve.plot(report["nominal"], report["empirical"], "o-", ms=3, color=colour(name), label=name)
    axes[0, 0].set_ylabel(plain(f"share of the ends of {modality}"))
    curve.set_xlabel("nominal coverage")
    curve.set_ylabel("empirical coverage")
    curve.legend(fontsize=8)
    curve.grid(alpha=0.3)
    return figure
