"""What every family of basis functions shares: the contract, and what happens outside the interval [0, 1]."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_count


class Basis(nn.Module, ABC):
    """B functions of phase, Phi(phi): the paper's Section III-A.

    A filter's members run past both ends of the interaction. There every family continues in the direction of
    its slope at the end, ever more slowly: Phi(c) + Phi'(c) s, with c the nearer end and s the softsign of the
    distance to it, which stays below `margin`. So a member beyond the end keeps a gradient and can be called
    back, and no polynomial explodes.

    Args:
        n_features: B, how many functions there are.
    """

    margin = 0.1
    periodic: ClassVar[bool] = False
    """Whether phases are those of a circle."""
    n_features: int

    def __init__(self, n_features: int) -> None:
        super().__init__()
        self.n_features = as_count(f"n_features of {type(self).__name__}", n_features)

    @abstractmethod
    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes d/dphi, [..., n_features] each, at phases [...] within [0, 1]."""

    def within(self, phase: Tensor) -> Tensor:
        """`forward` at phases [...] known to lie within [0, 1]: what happens outside need not be looked at."""
        return self.evaluate(phase)[0]

    def by_function(self, phase: Tensor) -> Tensor:
        """`forward` the other way round, [..., n_features, E], at phases [..., E] known to lie within [0, 1]."""
        return self.within(phase).transpose(-1, -2).contiguous()

    def forward(self, phase: Tensor) -> Tensor:
        """Features [..., n_features] at phases [...] (any real number)."""
        inside, excess = _split(phase)
        values, slopes = self.evaluate(inside)
        softsign = (excess / (excess.abs() + self.margin)).unsqueeze(-1)
        return torch.addcmul(values, slopes, softsign, value=self.margin)

    def derivative(self, phase: Tensor) -> Tensor:
        """d features / d phase, [..., n_features], at phases [...]; the exact derivative of `forward`."""
        inside, excess = _split(phase)
        _, slopes = self.evaluate(inside)
        return slopes * (1 + excess.abs() / self.margin).pow(-2).unsqueeze(-1)

    def settings(self) -> dict[str, int | float | bool]:
        """The arguments, exactly, that make an equal basis: what a model file keeps of it.

        Raises:
            TypeError: a family that does not say.
        """
        raise TypeError(f"{type(self).__name__} does not say how it is made: it has no method `settings`")

    def extra_repr(self) -> str:
        """The settings, as they are written in a constructor call; equal ones make equal bases."""
        return f"n_features={self.n_features}"

    def __eq__(self, other: object) -> bool:
        return type(self) is type(other) and isinstance(other, Basis) and self.extra_repr() == other.extra_repr()

    def __hash__(self) -> int:
        return hash((type(self).__name__, self.extra_repr()))


def _split(phase: Tensor) -> tuple[Tensor, Tensor]:
    inside = phase.clamp(0, 1)
    return inside, phase - inside
