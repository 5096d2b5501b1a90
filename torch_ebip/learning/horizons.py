"""Horizons in seconds: which are asked for, which demonstrations reach them, what one may err there."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from torch_ebip.common.arguments import as_values
from torch_ebip.interaction.primitive import InteractionPrimitive

AHEAD = (0.1, 0.25, 0.5, 1.0, math.inf)
"""Seconds: what a partner needs, the next moments, and the end."""
HORIZONS = (0.2, 0.95)
"""Shares of an interaction between which a present moment lies, for `goes_on`."""
LEAST = 0.05
"""Share of the present moments from which an interaction must go on for as long as a horizon asks for."""
LEAST_END = 0.1
"""Least scale of a horizon, as a share of the largest."""


def horizon_name(ahead: float) -> str:
    """How a number of seconds is called in tables; infinity is the end."""
    return "end" if math.isinf(ahead) else f"{ahead:g} s"


def spread_ahead(primitive: InteractionPrimitive, ahead: Tensor) -> Tensor:
    """[P, D], squared units: mean squared distance from the demonstrations' mean at the same time since they began.

    At the times that lie so many seconds ``ahead`` [P] of a present moment; what the training mean errs there.
    """
    weights, durations = primitive.weights, primitive.durations
    time = torch.linspace(0, float(durations.max()), 201, dtype=weights.dtype, device=weights.device)
    share = time / durations.unsqueeze(-1)  # [N, 201]
    paths = primitive.basis.project(primitive.phase_after(time.unsqueeze(-1)).T, weights.unsqueeze(1))
    N = len(weights)
    squares = (paths - paths.mean(0)).square() * (N / (N - 1))
    now = share - torch.where(ahead.isinf(), 0, ahead).view(-1, 1, 1) / durations.unsqueeze(-1)
    first, last = HORIZONS
    asked = ((now >= first) & (now <= last) & (share <= 1)).to(weights)  # [P, N, 201]
    found = torch.einsum("pnt,ntd->pd", asked, squares) / asked.sum((1, 2)).clamp(min=1).unsqueeze(-1)
    return torch.where(ahead.isinf().unsqueeze(-1), primitive.end_variance, found)


def goes_on(primitive: InteractionPrimitive, ahead: Tensor) -> Tensor:
    """[P]: share of the present moments of demonstrations after which they go on for so many seconds [P]."""
    first, last = HORIZONS
    there = ((1 - ahead / primitive.durations.unsqueeze(-1) - first) / (last - first)).clamp(0, 1).mean(0)
    return torch.where(ahead.isinf(), 1, there)


def reached(primitive: InteractionPrimitive, ahead: Sequence[float]) -> list[float]:
    """Those of some seconds for which demonstrations go on often enough to be scored."""
    there = goes_on(primitive, primitive.weights.new_tensor(list(ahead))) >= LEAST
    return [a for a, enough in zip(ahead, there.tolist(), strict=True) if enough]


def as_ahead(ahead: Sequence[float] | Tensor, like: Tensor) -> Tensor:
    """Seconds [P], increasing, in the dtype and on the device of ``like``."""
    seconds = ahead.to(like) if isinstance(ahead, Tensor) else as_values("ahead", list(ahead), None, like)
    if seconds.ndim != 1 or len(seconds) == 0 or not bool((seconds >= 0).all() & (seconds.diff() > 0).all()):
        raise ValueError(f"ahead must be increasing numbers of seconds, 0 or more, got {seconds.tolist()}")
    return seconds
