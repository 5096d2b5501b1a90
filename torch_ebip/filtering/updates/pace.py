"""Pace: how much of the time that passes a model goes through, and where its moving entries are found again.

The dynamics of a model go on while time does. People stop, start over, or were under way before anybody looked. A
part that follows where a sequence is by other means than the members can hold the clock of the model, and lead
members back that are lost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from functools import lru_cache
from typing import Any, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.common.draws import GOLDEN
from torch_ebip.filtering.updates.part import Part
from torch_ebip.filtering.updates.weighting import Seen


class Placement(NamedTuple):
    """Where members are led: a share of the first of their entries that move, x, is there, the rest where it was.

    x becomes mean + offset + (1 - share) (x - mean) + share deviation z, z evenly spread quantiles of a normal
    distribution: members may all have been at one place. What stands still was learned where a sequence was not: of
    it a share becomes what it was at first.

    Attributes:
        offset: [...].
        share: [...], in [0, 1].
        deviation: [...].
        renewed: [...], in [0, 1].
    """

    offset: Tensor
    share: Tensor
    deviation: Tensor
    renewed: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Pace(Part, ABC):
    """Says how much of a step the model goes through, and where members are to be."""

    @abstractmethod
    def start(self, members: Tensor, origin: Tensor | None, known: Tensor | None = None) -> Any:
        """What is remembered of members [..., E, n] that have seen nothing: a NamedTuple of tensors.

        Args:
            members: [..., E, n].
            origin: int64 [..., E], as which of the prior's states they start, if only those are known.
            known: bool [..., N], which of the prior's states are known; default: those, or all.
        """

    @abstractmethod
    def elapse(self, memory: Any, dt: Tensor) -> tuple[Any, Tensor]:
        """The memory after dt [...] seconds, and how many of them the model goes through, [...]."""

    @abstractmethod
    def notice(self, memory: Any, seen: Seen) -> tuple[Any, Placement | None]:
        """The memory after a sample that was ``seen``, and where members are led before they take it in."""

    @abstractmethod
    def counts(self, memory: Any) -> Tensor | None:
        """[...], in (0, 1], what a sample counts: of what stands still every further one says the same. None: 1."""


def led(first: Tensor, mean: Tensor, placement: Placement) -> Tensor:
    """The first entry [..., E] of members, with a mean [...], where a placement leads it."""
    share, mean = placement.share.unsqueeze(-1), mean.unsqueeze(-1)
    there = placement.deviation.unsqueeze(-1) * quantiles(first.shape[-1], first)
    return mean + placement.offset.unsqueeze(-1) + torch.lerp(first - mean, there, share)


def quantiles(count: int, like: Tensor) -> Tensor:
    """[E], of a normal distribution, evenly spread, in no order that states of a prior might have; mean 0."""
    return _quantiles(count, like.dtype, like.device)


@lru_cache(maxsize=16)
def _quantiles(count: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    with torch.inference_mode(False):  # kept: whatever the caller's mode, others may need gradients
        place = (torch.arange(count, device="cpu", dtype=torch.float64) * GOLDEN).remainder(1).argsort().argsort()
        found: Tensor = torch.special.ndtri((place + 0.5) / count).to(device, dtype)
        return found
