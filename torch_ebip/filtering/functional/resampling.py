"""Resampling of particles."""

from __future__ import annotations

import torch
from torch import Tensor


def systematic_resample(log_weights: Tensor, u: Tensor) -> Tensor:
    """Ancestors of E particles by systematic resampling (Kitagawa 1996): one uniform draw for all.

    Particle j has floor(E w_j) or ceil(E w_j) offspring, E w_j in the mean; ancestors come in ascending order.

    Args:
        log_weights: [..., E], need not be normalised; at least one of them finite.
        u: [...], uniform in [0, 1).

    Returns:
        int64 [..., E], indices of the particles that the new ones are copies of.

    Raises:
        ValueError: shapes that do not fit, or weights of which none is positive.
    """
    if u.shape != log_weights.shape[:-1]:
        raise ValueError(
            f"u must have one number for each row of log_weights, {list(log_weights.shape[:-1])}, got {list(u.shape)}"
        )
    E = log_weights.shape[-1]
    cumulative = torch.softmax(log_weights, dim=-1).cumsum(-1)
    if not bool(cumulative.isfinite().all()):
        raise ValueError("log_weights hold NaN, or a row without any positive weight")
    positions = (u.unsqueeze(-1) + torch.arange(E, dtype=u.dtype, device=u.device)) / E
    # Rounding can leave the last sum below 1 and the last position above it.
    cumulative = cumulative / cumulative[..., -1:]
    return torch.searchsorted(cumulative.contiguous(), positions.contiguous(), right=True).clamp(max=E - 1)
