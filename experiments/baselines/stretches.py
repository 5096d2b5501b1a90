"""What the recurrent network sees: short stretches of samples, their means and changes, whether there were any."""

from __future__ import annotations

import torch
from torch import Tensor, nn


def cumulative(values: Tensor, seen: Tensor) -> tuple[Tensor, Tensor]:
    """Cumulative sums and counts over time of values [B, T, I] where seen, [B, T + 1, I]: stretches at no cost."""
    parts = (torch.where(seen, values, 0.0), seen.to(values.dtype))
    # float64, since differences of long sums are taken.
    sums, counts = (nn.functional.pad(part.double().cumsum(1), (0, 0, 1, 0)) for part in parts)
    return sums, counts


def stretches(sums: Tensor, counts: Tensor, first: Tensor, steps: int, every: int) -> tuple[Tensor, Tensor]:
    """Means of stretches of samples, 0 where none was measured, and whether any was: float32 [B, S, I] each.

    Args:
        sums, counts: see `cumulative`.
        first: samples in the first stretch of each, [B], 1 to `every`.
        steps: S, how many stretches; past the end nothing is measured.
        every: samples in the other stretches.
    """
    stop = first.unsqueeze(-1) + every * torch.arange(steps)
    length = sums.shape[1] - 1
    rows = torch.arange(len(sums)).unsqueeze(-1)
    high, low = stop.clamp(max=length), (stop - every).clamp(min=0, max=length)
    total, count = (part[rows, high] - part[rows, low] for part in (sums, counts))
    return (total / count.clamp(min=1)).float(), (count > 0).float()


def features_of(sums: Tensor, counts: Tensor, first: Tensor, steps: int, every: int) -> Tensor:
    """float32 [B, S, 3 I]: of each stretch the mean, or the last one before it, whether it was measured, the change.

    Arguments: see `stretches`.
    """
    values, mask = stretches(sums, counts, first, steps, every)
    change = torch.zeros_like(values)
    # From one stretch to the next a DoF changes by a part of its deviation: brought to the size of the other inputs.
    change[:, 1:] = 4.0 * (values[:, 1:] - values[:, :-1]) * mask[:, 1:] * mask[:, :-1]
    last = torch.where(mask > 0, torch.arange(steps).view(1, -1, 1), 0).cummax(1).values
    return torch.cat([values.gather(1, last), mask, change], -1)


def all_features(values: Tensor, measured: Tensor, every: int) -> Tensor:
    """[every, N, S, 3 I]: the features of values [N, T, I] where measured, for every length of the first stretch."""
    sums, counts = cumulative(values, measured)
    steps = -(-values.shape[1] // every)
    firsts = torch.arange(1, every + 1).unsqueeze(-1).expand(-1, len(values))
    return torch.stack([features_of(sums, counts, first, steps, every) for first in firsts])


def moments(values: Tensor, present: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation [F] of values [N, F] where present; deviation 1 for what never varies."""
    count = present.sum(0).clamp(min=1)
    values = torch.where(present, values, 0.0).double()
    mean = values.sum(0) / count
    deviation = (torch.where(present, values - mean, 0.0).square().sum(0) / count).sqrt()
    scale = torch.where(deviation > 1e-7 * mean.abs(), deviation, 1.0)
    return mean.float(), scale.float()
