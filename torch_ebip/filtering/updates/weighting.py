"""Weighting: members that count more or less, by what was seen."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, NamedTuple, Protocol

from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.updates.part import Part


class WeightMemory(Protocol):
    """What a weighting remembers: a NamedTuple of tensors, among them the weights as they are."""

    @property
    def weights(self) -> Tensor:
        """[..., E], of the members, summing to 1."""


class Seen(NamedTuple):
    """A sample as a weighting sees it.

    Attributes:
        y: [..., K], units of the DoFs; ignored where not observed.
        observed: bool [..., K]; None for all.
        trust: [..., K], in [0, 1], what each value counts, 0 where not observed; None: all alike.
        rows: int64 [K], which of the filter's DoFs these are; None for all.
        moving: [..., E, m], what moves of each member.
        mean: [..., m], its mean.
        origin: int64 [..., E], as which of the prior's states each member started; None where the prior does not
            know.
    """

    y: Tensor
    observed: Tensor | None
    trust: Tensor | None
    rows: Tensor | None
    moving: Tensor
    mean: Tensor
    origin: Tensor | None

    def __repr__(self) -> str:
        return brief(self)


class Weighting(Part, ABC):
    """Weighs members by what they, or the states they started as, make of what is seen."""

    def at_work(self) -> None:
        """Called of a part that one carrier has for itself: what parameters alone decide may be kept from now on."""

    @abstractmethod
    def start(self, origin: Tensor) -> Any:
        """A `WeightMemory` of members that have seen nothing and started as ``origin``, int64 [..., E]."""

    @abstractmethod
    def forget(self, memory: Any, dt: Tensor) -> Any:
        """What is left of a memory after dt [...] seconds."""

    @abstractmethod
    def learn(self, memory: Any, seen: Seen) -> Any:
        """The memory after a sample that was ``seen``."""
