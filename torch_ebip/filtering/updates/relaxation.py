"""Relaxation to the prior's perturbations."""

from __future__ import annotations

from typing import TYPE_CHECKING

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_number
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.functional import Spread
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.inflation import SpreadRule

if TYPE_CHECKING:
    from typing_extensions import Self


class RelaxationToPrior(SpreadRule):
    """Anomalies (1 - alpha) A_updated + alpha A (Zhang, Snyder & Sun 2004): some of the prior's spread is kept.

    Unlike `Inflation` it acts only where an update did, so it cannot run away, and needs no bound.

    Args:
        alpha: share of the prior's anomalies, from 0 (none) to 1 (the anomalies do not shrink); a number, or a module
            with a ``value`` to learn it.

    Raises:
        ValueError: a share outside [0, 1].

    Example:
        >>> from torch_ebip import RelaxationToPrior, SquareRoot, Update
        >>> update = Update(SquareRoot(), inflation=RelaxationToPrior(0.3))
    """

    def __init__(self, alpha: float | nn.Module) -> None:
        super().__init__()
        self.alpha = alpha if isinstance(alpha, nn.Module) else as_number("alpha", alpha, 0, 1)
        self.stride = 1

    def extra_repr(self) -> str:
        """Its setting."""
        return "" if isinstance(self.alpha, nn.Module) else f"alpha={self.alpha:g}"

    def select(self, view: View) -> Self:
        """See `Part.select`: what stands for k samples relaxes k times."""
        part = sharing(self)
        part.stride = self.stride * view.stride
        return part

    def forward(self, memory: Tensor | None, share: Tensor) -> tuple[Spread, Tensor | None]:
        """See `SpreadRule.forward`: it remembers nothing; whatever the share [...], what did not move stays."""
        value = self.alpha.value if isinstance(self.alpha, nn.Module) else self.alpha
        alpha = torch.as_tensor(value, dtype=share.dtype, device=share.device)
        return Spread(keep=(1 - alpha).expand(share.shape) ** self.stride), memory
