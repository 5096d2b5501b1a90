"""The two courses of a phase: from 0 to 1, where an interaction is over, or round a circle, where it goes on.

On a circle phases are real numbers, too, and those that differ by whole cycles mean the same.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.basis.stacked import StackedBasis

TURNS = 360
"""That are tried, evenly round the circle."""


def within(phase: Tensor, periodic: bool) -> Tensor:
    """Phases [...] as they are looked up in tables from 0 to 1: held at both ends, or without whole cycles."""
    return phase - phase.detach().floor() if periodic else phase.clamp(0, 1)


def apart(difference: Tensor, periodic: bool) -> Tensor:
    """Differences [...] of phases: as they are, or the shorter way round, within -1/2 and 1/2."""
    return difference - difference.detach().round() if periodic else difference


def ends(phase: Tensor, end: Tensor, periodic: bool) -> Tensor:
    """Phases [..., K] of K cases, where an ``end`` [..., K] is asked for 1; on a circle, which has no end, evenly
    spread over it."""
    if not periodic:
        return torch.where(end, 1, phase)
    K = phase.shape[-1]
    even = (torch.arange(K, device=phase.device, dtype=phase.dtype) + 0.5) / K
    return torch.where(end, even, phase)


def circular_of(cosine: Tensor, sine: Tensor) -> tuple[Tensor, Tensor]:
    """Mean in [0, 1) and deviation, [...] each, in cycles, by the mean ``cosine`` and ``sine`` [...] of phases.

    The deviation is that of the wrapped normal distribution with as long a mean vector (Mardia & Jupp 2000, section
    2.3).
    """
    turn = 2 * torch.pi
    mean = torch.atan2(sine, cosine) / turn
    length = torch.hypot(cosine, sine).clamp(1e-6, 1 - 1e-9)
    return mean - mean.detach().floor(), (-2 * length.log()).sqrt() / turn


def turn_between(basis: StackedBasis, these: Tensor, others: Tensor) -> float:
    """Cycles by which phases of some sets of weights [N, n_weights] must be further on to mean what those of others,
    [M, n_weights], do: their mean paths are then most alike, every DoF in its own deviation."""
    phase = torch.arange(TURNS, dtype=these.dtype, device=these.device) / TURNS
    paths = [basis.project_paths(phase, weights.mean(0)).double() for weights in (these, others)]
    apart = [path - path.mean(0) for path in paths]
    size = [path.square().mean(0).sqrt() for path in apart]
    scale = size[0] * size[1]
    products = [torch.fft.rfft(path, dim=0) for path in apart]
    alike = torch.fft.irfft(products[1] * products[0].conj(), n=TURNS, dim=0)
    return int((alike / torch.where(scale > 0, scale, torch.inf)).sum(-1).argmax()) / TURNS
