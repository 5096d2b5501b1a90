"""Measurement errors that are not normal: how much a value counts, by how surprising it is.

A value whose innovation is z standard deviations of what was expected gets a weight w(z) in (0, 1], and enters the
update with the noise R' = R + S (1/w - 1) of its own, S = var h(x) + R. So its innovation variance becomes S / w, its
gain is w times what it was, and it moves the mean of what it measures by w z deviations, whatever z is. That is one
step of iteratively reweighted least squares from the prediction; see Gandhi & Mili (2010) for such Kalman filters.

The log-likelihood of such an update is the normal one with R', which is no density in y: it always asks for heavier
tails. Tune the scales on forecasts.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.arguments import as_number
from torch_ebip.noise.constraints import Positive

FAR = 1e5
"""Standard deviations; a value further off is no measurement at all, whatever the tails are."""
LEAST = 1e-10
"""Smallest weight, so that a variance divided by it is finite in float32."""


class Trusted(NamedTuple):
    """Measured values with the noise that they deserve.

    Attributes:
        y: [..., D]; what is `FAR` off is replaced by what was expected.
        deviation: [..., D], standard deviations of their noise, units of the DoFs.
        weight: [..., D], in (0, 1].
    """

    y: Tensor
    deviation: Tensor
    weight: Tensor


class RobustWeights(nn.Module, ABC):
    """Weights of measured values by their innovations; a subclass says which.

    Args:
        scale: where the weights begin to fall, at the start; learned.

    Raises:
        ValueError: a scale that is not positive.
    """

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = Positive(torch.tensor(as_number("scale", scale), device="cpu"))

    @abstractmethod
    def inverse(self, z: Tensor) -> Tensor:
        """1 / w [...], at least 1, of innovations [...] in standard deviations; differentiable."""

    def forward(self, y: Tensor, mean: Tensor, spread: Tensor, deviation: Tensor, thinning: int = 1) -> Trusted:
        """Weigh one sample.

        Args:
            y: [..., D], units of the DoFs, finite; what was not measured may be anything finite.
            mean: [..., D], of h(x), in the same units.
            spread: [..., D], variance of h(x), squared units.
            deviation: [D] or [..., D], standard deviations of the noise, in the same units.
            thinning: how many samples this one stands for; the noise is that of all of them together, each is
                judged by its own.
        """
        noise = deviation.square() * thinning
        variance = spread + noise
        residual = y - mean
        # Masked before the division: its gradient would not survive a quotient that overflows.
        far = residual.abs() > FAR * variance.sqrt()
        inverse = self.inverse(torch.where(far, 0, residual) / variance.sqrt())
        inverse = torch.where(far, 1 / LEAST, inverse)
        wider = ((noise + variance * (inverse - 1)) / thinning).sqrt()
        return Trusted(torch.where(far, mean, y), wider, 1 / inverse)

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: where it starts is one of them."""
        return ""

    def extra_repr(self) -> str:
        """Where the weights begin to fall."""
        return f"scale={float(self.scale.start):g}"


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
