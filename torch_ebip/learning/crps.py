"""One number for how well a filter forecasts interactions left out, by which options are chosen."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.filtering.functional.scores import gaussian_crps
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.learning.held_out import HeldOut

MOST, FEWEST = 32, 6
"""Interactions that decide, at most in all and at least of each set of sensors."""
SHARES = (0.3, 0.5, 0.7, 0.9)
"""Of recordings, up to which they are shown."""


def crps_of(held_out: HeldOut, filter: InteractionFilter, order: Tensor, scale: Tensor | None = None) -> float:
    """CRPS of forecasts over all horizons and DoFs, of some interactions of each set of sensors.

    Args:
        held_out: the demonstrations, and what is asked of them.
        filter: over all DoFs.
        order: int64 [N], the interactions, of which the first decide; each set of sensors has its own.
        scale: [P, D_targets], units in which errors of the first P horizons are measured, and no others; default:
            the targets' spread, of all.
    """
    task = held_out.task
    scale = task.objective.scale if scale is None else scale
    each = max(FEWEST, MOST // len(task.subsets))
    shares = torch.tensor(SHARES, device="cpu")
    total = count = 0.0
    for i, subset in enumerate(task.subsets.values()):
        some = order.roll(-i * each)[:each]
        for trial in held_out.trials(filter, some, subset, shares):
            forecast, truth = trial.forecast(task.objective), trial.shown.truth[:, :, : len(scale)]
            measured = ~truth.isnan()
            mean, variance = forecast.mean[:, :, : len(scale)], forecast.variance[:, :, : len(scale)]
            found = gaussian_crps(mean, variance, torch.where(measured, truth, 0))
            found = found / scale.expand_as(truth)
            total += float(found[measured].double().sum())
            count += float(measured.sum())
    parts = held_out.ranks.gather([torch.tensor([total, count], dtype=torch.float64, device="cpu")])
    sums = torch.stack([part for share in parts for part in share]).sum(0)
    return float(sums[0] / sums[1])
