"""What filters have in common whose belief is a set of members, weighted or not."""

from __future__ import annotations

from typing import Any, Protocol, runtime_checkable

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import eager
from torch_ebip.common.arguments import as_count
from torch_ebip.common.draws import Generators
from torch_ebip.filtering.base import Filter
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.states import State
from torch_ebip.filtering.updates.pace import Pace


@runtime_checkable
class NumbersItsStates(Protocol):
    """A prior whose members start as states of its own."""

    def start(
        self, batch_shape: tuple[int, ...], n_members: int, chosen: Tensor | None, generator: Generators
    ) -> tuple[Tensor, Tensor]:
        """Members [*batch_shape, E, n] and as which of the prior's states each starts, int64 [*batch_shape, E]."""


class MemberFilter(Filter):
    """Means of members; a subclass says how they are predicted and updated.

    Its states begin with members [..., E, n] or their deviations from a centre, and have ``weights`` [..., E], None
    where all members count alike.

    Args:
        model: g, h and their noise.
        prior: maps (batch_shape, n_members, chosen, generator) to initial members.
        n_members: E.

    Raises:
        ValueError: fewer than two members.
    """

    fair = True
    """Whether members are draws of equal standing: variances and scores are then corrected for their number."""

    def __init__(self, model: StateSpace, prior: nn.Module, n_members: int) -> None:
        super().__init__(model, prior)
        if as_count("n_members", n_members) < 2:
            raise ValueError(f"an ensemble needs at least 2 members to have a spread, got {n_members}")
        self.n_members = as_count("n_members", n_members)

    def _members(
        self, batch_shape: tuple[int, ...], chosen: Tensor | None, generator: Generators
    ) -> tuple[Tensor, Tensor | None]:
        """Members of the prior, and as which of its states they start, where it knows."""
        if isinstance(self.prior, NumbersItsStates):
            return self.prior.start(batch_shape, self.n_members, chosen, generator)
        return self.prior(batch_shape, self.n_members, chosen, generator), None

    def _paced(self, pace: Pace, members: Tensor, chosen: Tensor | None, known: Tensor | None) -> Any:
        """What a pace remembers at first; see `Filter.initial_state`."""
        if known is not None and known.dtype is not torch.bool:
            raise ValueError(f"known must be bool [..., N], got {known.dtype} {list(known.shape)}")
        return pace.start(members, None if known is not None else chosen, known)

    def _centre(self, state: State) -> Tensor | None:
        """What the members of a state are deviations from, [..., n]; None if they are none."""
        return None

    @eager
    def project(self, state: State) -> Tensor:
        """[..., D], mean of h(x) over the members of a state; see `Filter.project`."""
        return self.model.mean(self.model.project(state[0], None, self._centre(state)), state.weights)

    def moving(self, state: State) -> Tensor:
        """[..., m], mean of what moves of a state; see `Filter.moving`."""
        return self.model.mean(self.model.split(state[0])[0], state.weights)
