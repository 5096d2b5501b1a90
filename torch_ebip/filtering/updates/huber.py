"""Huber's errors."""

from __future__ import annotations

from torch import Tensor

from torch_ebip.filtering.updates.trust import RobustWeights


class Huber(RobustWeights):
    """Huber's weights: w = c / |z|, never above 1 (Huber 1964).

    What is far off moves the mean by c deviations, however far it is, up to `FAR`.

    Args:
        threshold: c, standard deviations at the start; learned.
    """

    def __init__(self, threshold: float = 2.0) -> None:
        super().__init__(threshold)

    def inverse(self, z: Tensor) -> Tensor:
        """See `RobustWeights.inverse`."""
        return (z.abs() / self.scale.value).clamp(min=1)
