"""What a filter makes of interactions: how far off it is, how sure, and whether it noticed that something is off."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from experiments.results import Cell, Values
from torch_ebip import Demonstrations, Forecast, InteractionModel, Layout
from torch_ebip.common.draws import seeded
from torch_ebip.learning.metrics import Z95

SHARES = (0.2, 0.43, 0.5, 0.82)
"""Of an interaction that were seen, where forecasts of the end are asked for."""
HALF = 2
"""Which of them is the half."""
ALARM = 0.01
"""Familiarity below which an interaction counts as unfamiliar: the rate of false alarms that is asked for."""
PORTION = 100
"""Interactions that are filtered at once."""


class Noticed(NamedTuple):
    """What was noticed of B interactions, beside S sensors.

    Attributes:
        familiarity: [B, K], after each share.
        largest: [B], by the half, of what familiarity is the chance of: larger is stranger.
        delay: [B, S + 1], s until a sensor is rejected, or the interaction is unfamiliar; infinite if never.
    """

    familiarity: NDArray[np.float64]
    largest: NDArray[np.float64]
    delay: NDArray[np.float64]


@torch.no_grad()
def measure(
    name: str, model: InteractionModel, truth: Demonstrations, said: Demonstrations, subset: str, seed: int
) -> tuple[Values, Noticed | None]:
    """Values of one method on one set, and what it noticed; None where it does not judge.

    Args:
        name: of the method.
        model: whose filter is asked.
        truth: B interactions.
        said: what sensors say of them.
        subset: name of the set.
        seed: of the filter's draws, with the interaction.
    """
    parts: list[tuple[Values, Noticed | None]] = []
    for first in range(0, len(truth), PORTION):
        some = range(first, min(first + PORTION, len(truth)))
        parts.append(_portion(name, model, truth.subset(some), said.subset(some), subset, seed, first))
    values: Values = {cell: {name: np.concatenate([part[cell][name] for part, _ in parts])} for cell in parts[0][0]}
    seen = [noticed for _, noticed in parts if noticed is not None]
    return values, Noticed(*(np.concatenate(arrays) for arrays in zip(*seen, strict=True))) if seen else None


def _portion(
    name: str,
    model: InteractionModel,
    truth: Demonstrations,
    said: Demonstrations,
    subset: str,
    seed: int,
    first: int,
) -> tuple[Values, Noticed | None]:
    """The same of a few."""
    filter, layout = model.filter, model.layout
    y, observed = said.pad()
    observed = observed & ~layout.controlled
    draws = [seeded(seed, first + i) for i in range(len(y))]
    steps = torch.stack([(said.lengths * share).round().long() - 1 for share in SHARES], -1).clamp(min=0)
    trace = filter(torch.where(observed, y, torch.nan), observed, generator=draws, keep=steps, project=False)
    forecast = filter.forecast(trace.kept, 1.0).select(layout.controlled)
    end = torch.stack([trajectory[-1] for trajectory in truth])[:, layout.controlled]
    values = scores(name, forecast, end, subset, unit_of(layout))
    if trace.familiarity is None or trace.counts is None:
        return values, None
    within = torch.arange(y.shape[1]) < said.lengths.unsqueeze(-1)
    alarms = torch.cat([trace.counts == 0, (trace.familiarity < ALARM).unsqueeze(-1)], -1) & within.unsqueeze(-1)
    delay = torch.where(alarms.any(1), alarms.double().argmax(1) / model.rate, torch.inf)
    familiarity = trace.familiarity.gather(1, steps).double()
    largest = trace.kept.memory.surprise.largest[:, HALF].double()
    return values, Noticed(familiarity.numpy(), largest.numpy(), delay.numpy())


def scores(name: str, forecast: Forecast, end: Tensor, subset: str, unit: str) -> Values:
    """Of forecasts of the end [B, K, 1, D], where it was [B, D]: error, CRPS, coverage, how sure and how wrong."""
    mean, deviation = forecast.mean[:, :, 0], forecast.variance[:, :, 0].sqrt()
    miss = (mean - end.unsqueeze(1)).abs()
    crps = forecast.crps(end[:, None, None, :].expand_as(forecast.mean))[:, :, 0]
    found = {
        ("mae", unit): miss,
        ("mse", "1" if unit == "1" else f"({unit})^2"): miss.square(),
        ("crps", unit): crps,
        ("coverage_95", "1"): (miss <= Z95 * deviation).double(),
        ("beyond_4", "1"): (miss > 4 * deviation).double(),
        ("deviation", unit): deviation,
    }
    return {
        Cell(subset, share, metric, "targets", its): {name: value[:, k].double().mean(-1).numpy()}
        for (metric, its), value in found.items()
        for k, share in enumerate(SHARES)
    }


def undisturbed(values: Values, subset: str) -> dict[str, dict[str, float]]:
    """What caution costs on a set, after each share: cautious as a multiple of sure, CRPS and median deviation."""
    found: dict[str, dict[str, float]] = {}
    for cell, arrays in values.items():
        if cell.subset == subset and cell.metric in ("crps", "deviation"):
            its, others = arrays["ebip_cautious"], arrays["ebip_sure"]
            middle = np.mean if cell.metric == "crps" else np.median
            name = "CRPS" if cell.metric == "crps" else "median deviation"
            found.setdefault(str(cell.observed), {})[name] = float(middle(its) / middle(others))
    return found


def unit_of(layout: Layout) -> str:
    """Of what is forecast; several where it has several."""
    return ", ".join(dict.fromkeys(m.unit for m in layout.modalities if m.controlled))


def auc(strange: NDArray[np.float64], familiar: NDArray[np.float64]) -> float:
    """Chance that a strange one is more surprising than a familiar one, ties counting half."""
    from scipy.stats import mannwhitneyu

    return float(mannwhitneyu(strange, familiar).statistic / (len(strange) * len(familiar)))
