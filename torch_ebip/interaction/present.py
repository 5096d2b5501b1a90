"""The present as a state knows it: where the interaction is, which demonstrations speak, what was seen of late."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.states import Memory
from torch_ebip.filtering.updates.recent import WINDOW, Line, Recent
from torch_ebip.interaction.primitive import InteractionPrimitive


class Present(NamedTuple):
    """What a state says of the present.

    Attributes:
        phase: [...], mean over members.
        variance: [...], of the phase over members.
        prior: [..., N], logarithm of what the members count that started as each demonstration, by what was seen so
            far; minus infinity for demonstrations that are none of the ensemble.
        line: over all D DoFs of the layout, see `Line`.
        before: of every window that is remembered, [..., W, D], where there is more than one.
    """

    phase: Tensor
    variance: Tensor
    prior: Tensor
    line: Line
    before: Line | None = None

    def __repr__(self) -> str:
        return brief(self)


def recent_of(primitive: InteractionPrimitive, window: float = WINDOW, slower: Sequence[float] = ()) -> Recent:
    """What remembers what was seen of late, for filters of a primitive.

    Args:
        primitive: of the demonstrations.
        window, slower: s, see `Recent`.
    """
    weights = primitive.weights
    middle = primitive.basis.project(weights.new_full((), 0.5), weights.mean(0))
    return Recent(middle, window, slower)


def present_of(phase: Tensor, memory: Memory, recent: Recent, count: int) -> Present:
    """The present of members at phases [..., E] and of their memory.

    Args:
        phase: [..., E].
        memory: of members that started as some of ``count`` demonstrations.
        recent: of the update, that knows what is remembered of late.
        count: N.

    Raises:
        ValueError: see `prior_of`.
    """
    assert memory.recent is not None
    weighting = memory.weighting
    weights = torch.full_like(phase, 1 / phase.shape[-1]) if weighting is None else weighting.weights
    mean = (weights * phase).sum(-1)
    square = (weights * (phase - mean.unsqueeze(-1)).square()).sum(-1)
    several = 1 - weights.square().sum(-1)
    variance = square / several.clamp(min=torch.finfo(several.dtype).eps)  # as that of an ensemble
    before = recent.lines(memory.recent) if len(recent.windows) > 1 else None
    line = recent.line(memory.recent) if before is None else Line(*(part[..., 0, :] for part in before))
    return Present(mean, variance, prior_of(memory, count), line, before)


def prior_of(memory: Memory, count: int) -> Tensor:
    """[..., N], see `Present.prior`, of a memory of members that started as some of ``count`` demonstrations.

    Raises:
        ValueError: a state made by hand, which does not say as which demonstrations its members started.
    """
    origin = memory.origin
    if origin is None:
        raise ValueError(
            "a state made by hand does not say as which demonstrations its members started: `initial_state` does"
        )
    if memory.weighting is None:
        weights = torch.full(origin.shape, 1 / origin.shape[-1], device=origin.device)
    else:
        weights = memory.weighting.weights
    origin = origin.expand(weights.shape)
    shares = weights.new_zeros(*weights.shape[:-1], count).scatter_add(-1, origin, weights)
    there = shares > 0
    return torch.where(there, torch.where(there, shares, 1).log(), -torch.inf)
