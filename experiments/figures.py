"""Pictures of results, forecasts and learned noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import torch
from matplotlib.figure import Figure
from torch import Tensor

from experiments.results import horizon_grids
from torch_ebip import Demonstrations, Filter, Layout, MeasurementNoise
from torch_ebip.learning.metrics import Z95

COLOURS = {
    "mean": "0.7",
    "nearest": "0.45",
    "ballistic": "black",
    "ridge": "tab:olive",
    "trees": "tab:green",
    "trees_untold": "yellowgreen",
    "gru": "tab:cyan",
    "bip": "tab:brown",
    "particle_filter": "tab:purple",
    "particle_filter_tuned": "plum",
    "ebip_minus": "tab:pink",
    "ebip": "tab:red",
    "ebip_scaled": "tab:orange",
    "ebip_tuned": "tab:blue",
}


def plain(text: str) -> str:
    """Text as it is: names may have dollars in them, which are no formulas, and begin with what legends leave out."""
    return ("\u200a" if text.startswith("_") else "") + text.replace("$", r"\$")


def colour(method: str) -> str:
    """The same colour for a method in every picture."""
    return COLOURS.get(method, "black")


def results_figure(results: Mapping[str, Any], panels: Sequence[tuple[str, str | None]]) -> Figure:
    """Mean and standard error of every method in every cell, a panel for each (metric, modality)."""
    methods = list(dict.fromkeys(row["method"] for row in results["rows"]))
    figure, axes = plt.subplots(len(panels), 1, figsize=(9, 2.6 * len(panels)), squeeze=False, layout="constrained")
    step, handles = min(0.14, 0.8 / len(methods)), {}
    for axis, (metric, modality) in zip(axes[:, 0], panels, strict=True):
        rows = [row for row in results["rows"] if (row["metric"], row["modality"]) == (metric, modality)]
        rows = [row for row in rows if "ahead" not in row]
        if not rows:
            axis.set_axis_off()
            continue
        cells = list(dict.fromkeys((row["subset"], row["observed"]) for row in rows))
        for i, method in enumerate(methods):
            mine = [row for row in rows if row["method"] == method]
            if not mine:
                continue
            at = [cells.index((row["subset"], row["observed"])) + step * (i - (len(methods) - 1) / 2) for row in mine]
            errors = [row["standard_error"] or 0.0 for row in mine]
            means = [row["mean"] for row in mine]
            drawn = axis.errorbar(at, means, errors, fmt="o", ms=4, capsize=2, color=colour(method), label=method)
            handles.setdefault(method, drawn)
        axis.set_xticks(range(len(cells)), [plain(_label(*cell)) for cell in cells], fontsize=8)
        unit = "" if rows[0]["unit"] == "1" else f" [{rows[0]['unit']}]"
        axis.set_ylabel(plain(f"{metric}{'' if modality is None else ' ' + modality}{unit}"), fontsize=9)
        axis.grid(axis="y", alpha=0.3)
        if metric == "coverage_95":
            axis.axhline(0.95, color="0.3", lw=0.8, ls="--")
        elif max(row["mean"] for row in rows) > 10 * min(row["mean"] for row in rows) > 0:
            axis.set_yscale("log")
        else:
            axis.set_ylim(bottom=0)
        for edge in range(len(cells) - 1):
            axis.axvline(edge + 0.5, color="0.85", lw=0.6)
    shown = [method for method in methods if method in handles]
    figure.legend([handles[m] for m in shown], shown, ncols=5, fontsize=8, loc="outside upper center", frameon=False)
    axes[-1, 0].set_xlabel("observed modalities and share of the interaction")
    return figure


def horizons_figure(results: Mapping[str, Any], panels: Sequence[tuple[str, str | None]]) -> Figure:
    """Means over cells by how far ahead, the end last: a panel for each (metric, modality), a line a method."""
    tables = {grid.title: grid for grid in horizon_grids(results, panels)}
    figure, axes = plt.subplots(
        1, max(len(tables), 1), figsize=(4.2 * max(len(tables), 1), 3.6), squeeze=False, layout="constrained"
    )
    for axis, (title, grid) in zip(axes[0], tables.items(), strict=False):
        for method, cells in grid.lines.items():
            there = [(i, float(text)) for i, (text, _) in enumerate(cells) if text != "-"]
            if there:
                axis.plot(*zip(*there, strict=True), "o-", ms=4, color=colour(method), label=method)
        axis.set_xticks(range(len(grid.columns)), grid.columns)
        axis.set_xlabel("seconds ahead")
        axis.set_ylabel(plain(title.removesuffix(" by seconds ahead")), fontsize=9)
        axis.grid(alpha=0.3)
        if title.startswith("coverage_95"):
            axis.axhline(0.95, color="0.3", lw=0.8, ls="--")
        else:
            axis.set_ylim(bottom=0)
    if tables:
        handles, labels = axes[0, 0].get_legend_handles_labels()
        figure.legend(handles, labels, ncols=5, fontsize=8, loc="outside upper center", frameon=False)
    return figure


def whole_modalities(layout: Layout, dofs: Sequence[str]) -> Tensor:
    """Bool [D], the modalities of some DoFs: those of one are forecast together."""
    modalities = [int(layout.modality_of_dof[layout.dofs.index(dof)]) for dof in dofs]
    return layout.mask([layout.names[m] for m in sorted(set(modalities))])


def forecast_figure(
    filters: Mapping[str, Filter],
    tests: Demonstrations,
    index: int,
    subset: Tensor,
    dofs: Sequence[str],
    fractions: Sequence[float],
) -> Figure:
    """Forecasts of some DoFs of one test interaction with 95 % intervals: a row a DoF, a column a fraction."""
    layout, trajectory = tests.layout, tests[index]
    last = len(trajectory) - 1
    figure, axes = plt.subplots(
        len(dofs), len(fractions), figsize=(4.5 * len(fractions), 2.4 * len(dofs)), squeeze=False,
        sharex=True, sharey="row", layout="constrained",
    )  # fmt: skip
    used = subset | whole_modalities(layout, dofs)
    names = [dof for dof, kept in zip(layout.dofs, used.tolist(), strict=True) if kept]
    for column, fraction in enumerate(fractions):
        now = round(fraction * (last + 1)) - 1
        y = trajectory[: now + 1, used]
        observed = subset[used] & ~y.isnan()
        for label, whole in filters.items():
            part = whole.restrict(used)
            with torch.no_grad():
                trace = part(y, observed, generator=torch.Generator().manual_seed(0), project=False)
                phase = torch.linspace(now / last, 1, 60)
                forecast = part.forecast(trace.state, phase)
            for row, dof in enumerate(dofs):
                mean = forecast.mean[:, names.index(dof)]
                half = Z95 * forecast.variance[:, names.index(dof)].sqrt()
                axis, shade = axes[row, column], colour(label)
                axis.plot(phase, mean, color=shade, lw=1.5, label=label)
                axis.fill_between(phase, mean - half, mean + half, color=shade, alpha=0.18, lw=0)
        for row, dof in enumerate(dofs):
            axis = axes[row, column]
            truth = trajectory[:, layout.dofs.index(dof)]
            axis.plot(torch.linspace(0, 1, last + 1), truth, color="black", lw=1, ls="--", label="truth")
            axis.axvline(now / last, color="0.5", lw=0.8)
            unit = layout.units[layout.dofs.index(dof)]
            axis.set_ylabel(plain(f"{dof} [{unit}]") if column == 0 else "", fontsize=9)
            axis.grid(alpha=0.3)
        axes[0, column].set_title(f"{fraction:.0%} observed", fontsize=10)
        axes[-1, column].set_xlabel("phase")
    axes[0, 0].legend(fontsize=8)
    return figure


def noise_figure(filter: Filter, closed_form: Tensor, layout: Layout, shown: Sequence[str]) -> Figure:
    """The learned R relative to the closed form over phase, a line a modality (geometric mean over its DoFs)."""
    noise = filter.model.measurement_noise
    if not isinstance(noise, MeasurementNoise):
        raise TypeError("the filter's measurement noise is not one that is learned")
    figure, axis = plt.subplots(figsize=(6, 3.5), layout="constrained")
    phases = torch.linspace(0, 1, 100)
    with torch.no_grad():
        variance = noise(phases.unsqueeze(-1)).square().expand(100, -1)
    for name in shown:
        part = layout.slice(name)
        ratio = (variance[:, part] / closed_form[part]).log().mean(-1).exp()
        axis.semilogy(phases, ratio, label=plain(name))
    axis.set_xlabel("phase")
    axis.set_ylabel("R / closed-form R")
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8, ncols=2)
    return figure


def _label(subset: str, observed: float) -> str:
    return f"{subset.replace('+', '+' + chr(10), 2)}\n{observed:.0%}"
