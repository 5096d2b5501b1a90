"""States of filters: immutable tuples of tensors with leading batch dimensions."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering import functional

State = Any
"""A NamedTuple of tensors with leading batch dimensions; every filter has its own."""


def map_state(function: Callable[..., Tensor], *states: State) -> State:
    """Apply a function to the corresponding tensors [...] of states, which may be nested and hold None."""
    first = states[0]
    if first is None:
        return None
    if isinstance(first, Tensor):
        return function(*states)
    return type(first)(*(map_state(function, *parts) for parts in zip(*states, strict=True)))


class Memory(NamedTuple):
    """What the parts of an update remember, by part, and where members came from.

    Attributes:
        weighting: a NamedTuple of tensors with ``weights`` [..., E]; None where all members count alike.
        inflation: what a `SpreadRule` remembers, [...]; None if nothing.
        origin: int64 [..., E], as which of the prior's states each member started; None where the prior does not
        know.
        surprise: a NamedTuple of tensors with ``level`` and ``counts`` [..., S]; None where nobody asks.
        recent: sums [..., 5 W, D] over what was seen of late, see `Recent`; None where nobody asks.
        pace: a NamedTuple of tensors, what a `Pace` remembers; None where there is none.
    """

    weighting: Any = None
    inflation: Tensor | None = None
    origin: Tensor | None = None
    surprise: Any = None
    recent: Tensor | None = None
    pace: Any = None

    def __repr__(self) -> str:
        return brief(self)


class EnsembleState(NamedTuple):
    """An ensemble.

    What of a state stands still between measurements is stored as deviations from the middle of the first ensemble:
    float32 then holds how members differ, not where they are. `EnsembleState(members)` is a state made by hand.

    Attributes:
        deviations: [..., E, n], the members less the centre.
        memory: what the parts of the update remember.
        centre: [..., n], never changed by a step, 0 where the dynamics move a state; None: nothing was taken out.

    Example:
        >>> import torch
        >>> from torch_ebip import EnsembleState
        >>> EnsembleState(torch.tensor([[0.0, 1.0], [2.0, 3.0]])).mean.tolist()
        [1.0, 2.0]
    """

    deviations: Tensor
    memory: Memory = Memory()
    centre: Tensor | None = None

    def __repr__(self) -> str:
        return brief(self)

    @property
    def members(self) -> Tensor:
        """[..., E, n], with the centre."""
        return self.deviations if self.centre is None else self.deviations + self.centre.unsqueeze(-2)

    @property
    def weights(self) -> Tensor | None:
        """[..., E], summing to 1; None where all members count alike."""
        weighting = self.memory.weighting
        return None if weighting is None else weighting.weights

    @property
    def mean(self) -> Tensor:
        """[..., n]."""
        mean = functional.ensemble_mean(self.deviations, self.weights)
        return mean if self.centre is None else mean + self.centre

    @property
    def covariance(self) -> Tensor:
        """[..., n, n], A'A / (E - 1), or its weighted form."""
        return functional.ensemble_covariance(self.deviations, self.weights)
