"""One wave as both phases foresee it, and what their errors come to."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from matplotlib.figure import Figure

from experiments.cyclic.jobs import AHEAD, METHODS, Job
from experiments.figures import plain
from torch_ebip import load_model

SHOWN = ("ebip_tuned", "tuned_once")


def cyclic_figure(rows: Sequence[Mapping[str, Any]], job: Job, number: int = 0) -> Figure:
    """Above one partner's hand and what was said of it half a second before; below errors by horizon.

    Args:
        rows: of the table.
        job: a set that was learned.
        number: which of its tests is shown.
    """
    _, tests = job.made()
    values, layout, rate = tests.recordings[number], tests.recordings.layout, tests.recordings.rate
    dof = int(values[:, layout.controlled].std(0).argmax()) + int(layout.controlled.nonzero()[0])
    ahead = AHEAD[-1]
    beginnings = list(dict.fromkeys(row["beginning"] for row in rows))
    figure = Figure(figsize=(11, 8), layout="constrained")
    top, bottom = figure.subfigures(2, 1, height_ratios=[1, 1])
    axis = top.subplots()
    time = torch.arange(len(values)) / rate
    axis.plot(time, 100 * values[:, dof], color="black", linewidth=1.5, label="measured")
    for i, name in enumerate(SHOWN):
        said = load_model(job.place / name).forecast(values, [ahead])
        mean, deviation = 100 * said.mean[:, 0, dof], 100 * said.variance[:, 0, dof].sqrt()
        label = f"{plain(name)}, said {ahead:g} s before"
        axis.plot(time + ahead, mean, color=f"C{i}", linewidth=1.2, label=label)
        axis.fill_between(time + ahead, mean - 2 * deviation, mean + 2 * deviation, color=f"C{i}", alpha=0.15, lw=0)
    axis.set_xlim(0, float(time[-1]))
    axis.set_xlabel("time [s]")
    axis.set_ylabel(f"{layout.dofs[dof]} [cm]")
    axis.set_title(f"a person who was not recorded, begun {job.beginning}; bands: two deviations", fontsize=10)
    axis.legend(fontsize=8, ncols=3, loc="upper right")
    found = {(row["beginning"], row["method"], row["ahead"]): row for row in rows}
    for axis, beginning in zip(
        bottom.subplots(1, len(beginnings), sharey=True, squeeze=False)[0], beginnings, strict=True
    ):
        for i, method in enumerate(METHODS):
            errors = [100 * found[beginning, method, a]["error"] for a in AHEAD]
            places = [k + 0.2 * (i - 1.5) for k in range(len(AHEAD))]
            axis.bar(places, errors, 0.18, color=f"C{i}", label=plain(method))
        axis.set_xticks(range(len(AHEAD)), [f"{a:g}" for a in AHEAD])
        axis.set_xlabel("ahead [s]")
        axis.set_title(f"begun {beginning}", fontsize=10)
        axis.grid(axis="y", alpha=0.2)
        axis.spines[["top", "right"]].set_visible(False)
    bottom.axes[0].set_ylabel("error of the partner's hand,\nroot mean square [cm]")
    bottom.axes[0].legend(fontsize=8)
    return figure
