"""Student's t errors."""

from __future__ import annotations

from torch import Tensor

from torch_ebip.filtering.updates.trust import RobustWeights


class StudentT(RobustWeights):
    """Student's t errors: w = (nu + 1) / (nu + z^2), never above 1 (West 1981).

    What is far off counts less the farther it is: z deviations move the mean by about (nu + 1) / z.

    Args:
        freedom: nu, degrees of freedom at the start; learned.
    """

    def __init__(self, freedom: float = 4.0) -> None:
        super().__init__(freedom)

    def inverse(self, z: Tensor) -> Tensor:
        """See `RobustWeights.inverse`."""
        nu = self.scale.value
        return ((nu + z.square()) / (nu + 1)).clamp(min=1)
