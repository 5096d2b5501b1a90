"""Inflation: what keeps the spread of an ensemble from collapsing after updates."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_number
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.functional import Spread
from torch_ebip.filtering.noise.constraints import AboveOne
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.part import Part
from torch_ebip.recordings.layout import Layout

if TYPE_CHECKING:
    from typing_extensions import Self


class SpreadRule(Part, ABC):
    """What becomes of the anomalies after an update, as coefficients that both carriers apply within its product."""

    def start(self, members: Tensor) -> Tensor | None:
        """What is remembered for members [..., E, n] that have seen nothing: a tensor [...], or None."""
        return None

    @abstractmethod
    def forward(self, memory: Tensor | None, share: Tensor) -> tuple[Spread, Tensor | None]:
        """The coefficients of one update, and what is remembered after it.

        Args:
            memory: [...], as `start` made it.
            share: [...], in [0, 1], what the sample counts: 0 where nothing was measured.
        """


class Inflation(SpreadRule):
    """Multiplicative inflation of the anomalies after each update that measured something.

    Args:
        factor: at least 1 as a rule: a number, or a module with a ``value`` such as `AboveOne` to learn it.
        most: what all inflations of one sequence may come to: entries that no dynamics draw in and no sensor reduces
            would end in infinity otherwise; default: no bound.

    Raises:
        ValueError: a factor that is not positive, a bound below 1.

    Example:
        >>> from torch_ebip import Inflation, Update
        >>> update = Update(inflation=Inflation(1.01, most=10.0))
    """

    def __init__(self, factor: float | nn.Module, most: float | None = None) -> None:
        super().__init__()
        self.factor = factor if isinstance(factor, nn.Module) else as_number("inflation", factor, 0, above=True)
        self.most = None if most is None else as_number("most", most, 1)
        self.stride = 1

    def extra_repr(self) -> str:
        """Its settings."""
        fixed = "" if isinstance(self.factor, nn.Module) else f"factor={self.factor:g}, "
        return f"{fixed}most={self.most}"

    def meant(self) -> str | None:
        """What its tensors mean, see `Meaning`: nothing beside themselves, and no part of it where it has none."""
        return "" if isinstance(self.factor, nn.Module) else None

    def select(self, view: View) -> Self:
        """See `Part.select`: what stands for k samples inflates k times."""
        if view.stride == 1:
            return self
        part = sharing(self)
        part.stride = self.stride * view.stride
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``inflation``, if it is learned."""
        return {"inflation": float(self.factor.value)} if isinstance(self.factor, AboveOne) else {}

    def start(self, members: Tensor) -> Tensor | None:
        """The product of all inflations so far, [...], for members [..., E, n]: 1, or None if it has no bound."""
        return None if self.most is None else members.new_ones(members.shape[:-2])

    def forward(self, memory: Tensor | None, share: Tensor) -> tuple[Spread, Tensor | None]:
        """See `SpreadRule.forward`: product so far [...], share [...] -> scale and new product [...]."""
        value = self.factor.value if isinstance(self.factor, nn.Module) else self.factor
        factor = torch.as_tensor(value, dtype=share.dtype, device=share.device) ** self.stride
        scale = 1 + (factor - 1) * share
        if memory is None or self.most is None:
            return Spread(scale=scale), memory
        scale = torch.minimum(scale, (self.most / memory).clamp(min=1))
        return Spread(scale=scale), memory * scale
