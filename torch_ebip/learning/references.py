"""What can be said without a filter: the training mean, and the demonstration that is nearest so far."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.primitive import InteractionPrimitive


def ends(primitive: InteractionPrimitive) -> Tensor:
    """[N, D]: where the demonstrations of a primitive end, units of the DoFs."""
    one = primitive.weights.new_ones(len(primitive))
    return primitive.basis.project(one, primitive.weights)


def nearest(
    primitive: InteractionPrimitive,
    y: Tensor,
    observed: Tensor,
    keep: Tensor,
    dt: float,
    among: Tensor | None = None,
) -> Tensor:
    """The demonstrations that are nearest to what was seen, each running at its own speed.

    Distance: mean squared difference over what was measured, DoFs in units of their deviation.

    Args:
        primitive: of the demonstrations.
        y: [B, T, D], units of the DoFs.
        observed: bool [B, T, D].
        keep: int64 [B, K], up to which samples each is seen.
        dt: seconds between samples.
        among: int64 [B, E], which demonstrations may be chosen; default: all.

    Returns:
        int64 [B, K], which demonstrations.
    """
    used = observed.any(0).any(0)
    basis = primitive.basis.select(used)
    weights = primitive.weights[:, used.to(primitive.weights.device)[primitive.basis.dof_of_weight()]]
    phase = torch.arange(y.shape[1], device=weights.device)[:, None] * dt * primitive.phase_velocity
    variance = primitive.value_variance[used]
    deviation = torch.where(variance > 0, variance, torch.inf).sqrt()
    paths = basis.project(phase, weights) / deviation
    chosen = torch.empty_like(keep)
    for i in range(len(y)):
        seen = observed[i][:, used]
        values = torch.where(seen, y[i][:, used], 0) / deviation
        theirs = paths if among is None else paths[:, among[i]]
        squares = (torch.where(seen.unsqueeze(1), theirs - values.unsqueeze(1), 0)).square().sum(-1)
        found = squares.cumsum(0)[keep[i]].argmin(-1)
        chosen[i] = found if among is None else among[i][found]
    return chosen
