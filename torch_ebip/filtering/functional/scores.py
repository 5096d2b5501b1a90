"""Proper scores of a forecast (Gneiting & Raftery 2007): calibration and accuracy in one number."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast


@without_autocast
def crps(members: Tensor, target: Tensor, weights: Tensor | None = None, fair: bool = True) -> Tensor:
    """Continuous ranked probability score, fair for finite ensembles (Ferro 2014), in O(E log E) by sorting.

    sum_j w_j |x_j - y| - sum_jk w_j w_k |x_j - x_k| / (2 (1 - 1 / E)).

    The last divisor is that of E draws also where they have weights. With 2 (1 - sum_j w_j^2), which is fair to
    weights that do not depend on the members, a filter that chooses its weights gains by naming one or two of them.

    Args:
        members: [..., E, D], E >= 2.
        target: [..., D], units of the DoFs.
        weights: of the members, [..., E], summing to 1; default: equal.
        fair: without it the last divisor is 2, the score of the members as a distribution of their own.

    Returns:
        [..., D], units of the DoFs; smaller is better.
    """
    E = members.shape[-2]
    if E < 2:
        raise ValueError(f"a score of an ensemble needs at least 2 members, got {E}")
    if weights is None:
        weights = members.new_full(members.shape[-2:-1], 1 / E)
    shares = weights.unsqueeze(-1).expand(members.shape)
    # From the target on: the sums below cancel, and would lose what lies far from 0.
    distances = members - target.unsqueeze(-2)
    ordered, order = distances.sort(dim=-2)
    sorted_shares = shares.gather(-2, order)
    below = sorted_shares.cumsum(-2) - sorted_shares / 2
    # Half of sum_jk w_j w_k |x_j - x_k| is sum_j w_j x_(j) (2 W_j - 1), W_j the weight up to the middle of j.
    spread = (sorted_shares * (2 * below - 1) * ordered).sum(-2)
    error = (shares * distances.abs()).sum(-2)
    return error - (spread / (1 - 1 / E) if fair else spread)


def gaussian_crps(mean: Tensor, variance: Tensor, target: Tensor) -> Tensor:
    """The CRPS of a normal distribution (Gneiting & Raftery 2007, equation 21).

    Args:
        mean: [..., D].
        variance: [..., D], squared units; where it is 0 the score is the absolute error.
        target: [..., D], units of the DoFs.

    Returns:
        [..., D], units of the DoFs; smaller is better.
    """
    positive = variance > 0
    deviation = torch.where(positive, variance, 1).sqrt()
    z = (target - mean) / deviation
    density = torch.exp(-0.5 * z.square()) / math.sqrt(2 * math.pi)
    score = deviation * (z * (2 * torch.special.ndtr(z) - 1) + 2 * density - 1 / math.sqrt(math.pi))
    return torch.where(positive, score, (target - mean).abs())


@without_autocast
def energy_score(members: Tensor, target: Tensor) -> Tensor:
    """The CRPS of a vector: mean_j |x_j - y| - sum_jk |x_j - x_k| / (2 E (E - 1)), Euclidean norms.

    Args:
        members: [..., E, D], E >= 2, in comparable units.
        target: [..., D], in those units.

    Returns:
        [...], in those units; smaller is better.
    """
    E = members.shape[-2]
    if E < 2:
        raise ValueError(f"a score of an ensemble needs at least 2 members, got {E}")
    # The norm of a zero difference has no gradient; this floor, far below any unit, gives it the value 0.
    tiny = torch.finfo(members.dtype).tiny
    error = ((members - target.unsqueeze(-2)).square().sum(-1) + tiny).sqrt().mean(-1)
    pairs = members.unsqueeze(-2) - members.unsqueeze(-3)
    distances = (pairs.square().sum(-1) + tiny).sqrt()
    return error - distances.sum((-1, -2)) / (2 * E * (E - 1))
