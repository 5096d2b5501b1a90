"""How long it takes until a person who stands still goes on, and how far they get meanwhile."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.common.draws import GOLDEN


class Waits(NamedTuple):
    """A person stands still with some probability, and then goes on after a time that is exponentially distributed.

    Attributes:
        held: [...], in [0, 1], how far they are believed to stand still.
        go: [], times a second that one who stands goes on.
    """

    held: Tensor
    go: Tensor

    def __repr__(self) -> str:
        return brief(self)

    @property
    def rest(self) -> Tensor:
        """[...], s until they go on, on the average."""
        return self.held / self.go

    def gone(self, seconds: Tensor) -> Tensor:
        """[..., P], s, how long of so many seconds [P] they go, on the average; of infinity, infinity."""
        plain = seconds.isinf() | (seconds < 0)  # what is past is past
        finite = torch.where(plain, 0, seconds)
        after = finite - (1 - torch.exp(-self.go * finite)) / self.go
        return torch.where(plain, seconds, torch.lerp(finite, after, self.held.unsqueeze(-1)))

    def gone_apart(self, seconds: Tensor, count: int) -> Tensor:
        """[..., P, E], s, the same in a case of its own for each of E members: it goes, or waits a time of its own.

        Args:
            seconds: [P].
            count: E.
        """
        held = self.held[..., None, None]
        place = (torch.arange(count, device=held.device, dtype=held.dtype) + 0.5) * GOLDEN % 1
        waits = place < held
        part = torch.where(waits, place / torch.where(held > 0, held, 1), 0).clamp(max=1 - 1e-6)
        rest = torch.where(waits, -torch.log1p(-part) / self.go, 0)
        return (seconds.unsqueeze(-1) - rest).clamp(min=0)
