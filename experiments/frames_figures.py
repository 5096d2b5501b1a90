"""Pictures of one interaction: what a filter expects as it goes on, and which demonstrations that rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import gaussian_kde
from torch import Tensor

from experiments.figures import colour, plain, whole_modalities
from torch_ebip import Filter, Forecast, Layout

FRACTIONS = (0.1, 0.3, 0.43, 0.6, 0.82, 0.95)
PAST = 10
"""How many earlier predictions are drawn."""


def frames_figure(name: str, filter: Filter, trajectory: Tensor, layout: Layout, shown: Tensor, dof: str) -> Figure:
    """The paper's figure of uncertainty: a column a moment, density of a DoF's last value above, trajectory below.

    Args:
        name: of the method.
        filter: over all DoFs of the layout.
        trajectory: [T, D], the interaction.
        layout: of its columns.
        shown: bool [D], sensors.
        dof: what is drawn.
    """
    used = shown | whole_modalities(layout, [dof])
    column = [d for d, kept in zip(layout.dofs, used.tolist(), strict=True) if kept].index(dof)
    unit = layout.units[layout.dofs.index(dof)]
    last = len(trajectory) - 1
    nows = [max(PAST, round(fraction * (last + 1)) - 1) for fraction in FRACTIONS]
    keep = torch.tensor([now - past for now in nows for past in range(PAST, -1, -1)])
    part = filter.restrict(used)
    y = trajectory[: nows[-1] + 1, used]
    with torch.no_grad():
        observed = shown[used] & ~y.isnan()
        trace = part(y, observed, generator=torch.Generator().manual_seed(0), keep=keep, project=False)
        phase = torch.linspace(0, 1, 80)
        forecast = part.forecast(trace.kept, phase).select(torch.tensor([column]))
    truth = trajectory[:, layout.dofs.index(dof)]
    figure, axes = plt.subplots(
        2, len(nows), figsize=(2.5 * len(nows), 4.6), squeeze=False, sharey="row", layout="constrained"
    )
    spread = (
        float((forecast.mean[:, -1, 0] - truth[-1]).abs().max()) + 3 * float(forecast.variance[:, -1].max()) ** 0.5
    )
    values = np.linspace(float(truth[-1]) - spread, float(truth[-1]) + spread, 300)
    for i, now in enumerate(nows):
        here = (i + 1) * (PAST + 1) - 1
        density, path = axes[0, i], axes[1, i]
        # A collapsed belief has a density without end: shown up to that of a normal one a fiftieth as wide.
        density.fill_between(values, _density(forecast, here, values), color="tab:blue", alpha=0.4, lw=0)
        density.axvline(float(truth[-1]), color="tab:green", ls="--", lw=1)
        density.set_title(f"{(now + 1) / (last + 1):.0%} observed", fontsize=9)
        density.set_xlabel(plain(f"{dof} at the end [{unit}]"), fontsize=8)
        for past in range(PAST):
            path.plot(
                phase, forecast.mean[here - PAST + past, :, 0], color="tab:red", lw=0.6, alpha=0.2 + 0.06 * past
            )
        path.plot(phase, forecast.mean[here, :, 0], color="tab:blue", lw=1.8, label="prediction")
        path.plot(torch.linspace(0, 1, last + 1), truth, color="tab:green", ls="--", lw=1.2, label="truth")
        path.axvline(now / last, color="0.5", lw=0.8)
        path.set_xlabel("phase", fontsize=8)
        path.grid(alpha=0.3)
    axes[0, 0].set_ylabel(plain(f"density [1/{unit}]"))
    axes[1, 0].set_ylabel(plain(f"{dof} [{unit}]"))
    axes[1, 0].plot([], [], color="tab:red", lw=0.6, label=f"last {PAST} predictions")
    axes[1, 0].legend(fontsize=7)
    figure.suptitle(name, fontsize=10)
    return figure


def _density(forecast: Forecast, index: int, values: np.ndarray) -> np.ndarray:
    """Density of the last value at some values, from the members where there are any."""
    mean, variance = float(forecast.mean[index, -1, 0]), float(forecast.variance[index, -1, 0])
    floor = (values[-1] - values[0]) / 50
    if forecast.members is None or variance < (0.2 * floor) ** 2:
        deviation = max(variance**0.5, 0.2 * floor)
        return np.exp(-0.5 * ((values - mean) / deviation) ** 2) / (deviation * (2 * np.pi) ** 0.5)
    members = forecast.members[index, -1, :, 0].double().numpy()
    weights = None if forecast.weights is None else forecast.weights[index, -1].double().numpy()
    estimate: np.ndarray = gaussian_kde(members, weights=weights)(values)
    return estimate


def attribution_figure(filters: Mapping[str, Filter], trajectory: Tensor, shown: Tensor, lines: int = 6) -> Figure:
    """Coefficients of the demonstrations over the interaction, a row a filter, and how many speak.

    Args:
        filters: over all DoFs.
        trajectory: [T, D], the interaction.
        shown: bool [D], sensors.
        lines: how many of the largest are named.
    """
    last = len(trajectory) - 1
    keep = torch.linspace(0, last, 60).round().long()
    figure, axes = plt.subplots(
        len(filters), 2, figsize=(10, 2.9 * len(filters)), squeeze=False, width_ratios=(3, 2), layout="constrained"
    )
    for (coefficients_axis, count_axis), (name, filter) in zip(axes, filters.items(), strict=True):
        with torch.no_grad():
            observed = shown & ~trajectory.isnan()
            generator = torch.Generator().manual_seed(0)
            trace = filter(trajectory, observed, generator=generator, keep=keep, project=False)
            coefficients = filter.attribution(trace.kept)
        at = keep / last
        largest: Sequence[int] = coefficients.abs().mean(0).argsort(descending=True)[:lines].tolist()
        coefficients_axis.plot(at, coefficients, color="0.75", lw=0.5)
        for demonstration in largest:
            coefficients_axis.plot(at, coefficients[:, demonstration], lw=1.6, label=f"demonstration {demonstration}")
        coefficients_axis.axhline(1 / coefficients.shape[1], color="black", lw=0.7, ls=":")
        coefficients_axis.set_ylabel(f"{name}\ncoefficient")
        coefficients_axis.legend(fontsize=7, ncols=2)
        norms = coefficients.square().sum(-1)
        count_axis.semilogy(at, 1 / norms, color=colour(name))
        count_axis.set_ylabel("1 / sum of squared\ncoefficients")
        for axis in (coefficients_axis, count_axis):
            axis.set_xlabel("share of the interaction")
            axis.grid(alpha=0.3)
    return figure
