"""Pace: how much of the time that passes a model goes through, and where its moving entries are found again.

The dynamics of a model go on while time does. People stop, start over, or were under way before anybody looked. A
part that follows where a sequence is by other means than the members can hold the clock of the model, and lead
members back that are lost.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.updates.part import Part
from torch_ebip.filtering.updates.weighting import Seen


class Placement(NamedTuple):
    """Where members are led: the first of their entries that move, x, becomes mean + offset + stretch (x - mean).

    What stands still was learned where a sequence was not: of it a share becomes what it was at first.

    Attributes:
        offset: [...].
        stretch: [...], not negative.
        renewed: [...], in [0, 1].
    """

    offset: Tensor
    stretch: Tensor
    renewed: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Pace(Part, ABC):
    """Says how much of a step the model goes through, and where members are to be."""

    @abstractmethod
    def start(self, members: Tensor, origin: Tensor | None) -> Any:
        """What is remembered of members [..., E, n] that have seen nothing: a NamedTuple of tensors.

        Args:
            members: [..., E, n].
            origin: int64 [..., E], as which of the prior's states they start; None where it does not know.
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
    apart = (first - mean.unsqueeze(-1)) * placement.stretch.unsqueeze(-1)
    return apart + (mean + placement.offset).unsqueeze(-1)
