"""Proper scores of an ensemble forecast (Gneiting & Raftery 2007): calibration and accuracy in one number."""

from __future__ import annotations

import torch
from torch import Tensor


def crps(members: Tensor, target: Tensor) -> Tensor:
    """Continuous ranked probability score, fair for finite ensembles (Ferro 2014).

    mean_j |x_j - y| - sum_jk |x_j - x_k| / (2 E (E - 1)), in O(E log E) by sorting.

    Args:
        members: [..., E, D], E >= 2.
        target: [..., D].

    Returns:
        [..., D], units of the DoFs; smaller is better.
    """
    E = members.shape[-2]
    if E < 2:
        raise ValueError(f"a score of an ensemble needs at least 2 members, got {E}")
    ordered = members.sort(dim=-2).values
    ranks = torch.arange(1, E + 1, dtype=members.dtype, device=members.device).unsqueeze(-1)
    spread = ((2 * ranks - E - 1) * ordered).sum(-2) / (E * (E - 1))
    return (members - target.unsqueeze(-2)).abs().mean(-2) - spread


def energy_score(members: Tensor, target: Tensor) -> Tensor:
    """The CRPS of a vector: mean_j |x_j - y| - sum_jk |x_j - x_k| / (2 E (E - 1)), Euclidean norms.

    Args:
        members: [..., E, D], E >= 2, in comparable units.
        target: [..., D].

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
