"""An innovation gate."""

from __future__ import annotations

from torch import Tensor

from torch_ebip.filtering.updates.trust import LEAST, RobustWeights


class Gate(RobustWeights):
    """An innovation gate: w = 1 / (1 + (z/c)^8), about 1 inside the gate and about 0 outside.

    Smooth where a gate of a text book is a step, so that its width can be learned. A filter whose own belief is
    wrong and narrow closes its gate to the truth; `StudentT` is the more forgiving choice.

    Args:
        threshold: c, standard deviations at the start; learned.
    """

    def __init__(self, threshold: float = 5.0) -> None:
        super().__init__(threshold)

    def inverse(self, z: Tensor) -> Tensor:
        """See `RobustWeights.inverse`."""
        return 1 + (z / self.scale.value).square().clamp(max=LEAST**-0.25).square().square()
