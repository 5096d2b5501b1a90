"""Cauchy errors."""

from __future__ import annotations

from torch import Tensor

from torch_ebip.filtering.updates.trust import RobustWeights


class Cauchy(RobustWeights):
    """Cauchy's weights: w = 1 / (1 + (z/c)^2) (Holland & Welsch 1977).

    Heavier tails than Student's t of any freedom above 1: what is far off moves the mean by about c^2 / z deviations,
    and what is near counts a little less, too.

    Args:
        threshold: c, standard deviations at the start; learned.

    Example:
        >>> import torch
        >>> from torch_ebip import Cauchy
        >>> one = torch.ones(1)
        >>> Cauchy(2.0)(torch.tensor([2.0]), 0 * one, 0.5 * one, one * 0.5**0.5).weight.tolist()
        [0.5]
    """

    def __init__(self, threshold: float = 2.385) -> None:
        super().__init__(threshold)

    def inverse(self, z: Tensor) -> Tensor:
        """See `RobustWeights.inverse`: 1 + (z/c)^2 of innovations [...]."""
        return 1 + (z / self.scale.value).square()
