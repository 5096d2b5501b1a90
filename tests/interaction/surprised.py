"""A filter whose surprise is calibrated by hand, so strictly that interactions of conftest surprise it a little."""

from __future__ import annotations

import torch

from torch_ebip import InteractionPrimitive, ebip
from torch_ebip.interaction import Bounds, Doubt, InteractionEnsembleFilter, InteractionSurprise
from torch_ebip.interaction.surprise import POINTS


def strict(primitive: InteractionPrimitive, above: float = 0.0, **settings: float) -> InteractionSurprise:
    """Calibrated with draws: sensors are suspect from about the usual on, or from a level above that."""
    surprise = InteractionSurprise.of(primitive, **{"suspect": 0.01, "rejected": 0.001, **settings})
    draws = torch.Generator().manual_seed(0)
    like, S = primitive.weights, surprise.n_sensors
    usual = 0.5 + torch.rand(POINTS, 2, S, generator=draws, dtype=torch.float64)
    largest = 0.3 * torch.rand(60, S, generator=draws, dtype=torch.float64) - 0.2 + above
    largest[:, -1] = torch.nan  # what the robot controls is not shown
    whole = torch.rand(60, 1, generator=draws, dtype=torch.float64) - 0.5
    usual_bias = 0.05 + 0.1 * torch.rand(POINTS, S, generator=draws, dtype=torch.float64)
    # Biases and the pace on scales of their own, which must not matter.
    both = torch.stack([largest, 1.7 * largest + 0.4], -1)
    surprise.usual.copy_(usual)
    surprise.usual_bias.copy_(usual_bias)
    surprise.know(both.to(like))
    surprise.know_pace(torch.cat([whole, 0.6 * whole + 0.3], -1).to(like))
    surprise.know_whole(whole.squeeze(-1).to(like))
    return surprise


def cautious(primitive: InteractionPrimitive, above: float = 0.0, **options: object) -> InteractionEnsembleFilter:
    """A filter with all that `learn` gives it."""
    filter = ebip(primitive, **options)  # type: ignore[arg-type]
    filter.analysis.surprise = strict(primitive, above=above)
    like = primitive.weights
    levels = (0.8, 1.0, 2.0)
    filter.doubt = Doubt(
        like.new_tensor([1.0, 0.8, 0.4]),
        like.new_tensor([0.0, 0.5, 2.0]),
        primitive.value_variance,
        levels,
        like.new_tensor([0.0, 0.3, 0.6]),
    )
    filter.bounds = Bounds.of(primitive)
    return filter
