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
from typing import TYPE_CHECKING, NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.arguments import as_number
from torch_ebip.common.brief import brief
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.noise.constraints import Positive
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.updates.part import Part
from torch_ebip.recordings.layout import Layout

if TYPE_CHECKING:
    from typing_extensions import Self  # typing has it from Python 3.11 on

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

    def __repr__(self) -> str:
        return brief(self)


class RobustWeights(Part, ABC):
    """Weights of measured values by their innovations; a subclass says which.

    Args:
        scale: where the weights begin to fall, at the start; learned.

    Raises:
        ValueError: a scale that is not positive.
    """

    def __init__(self, scale: float) -> None:
        super().__init__()
        self.scale = Positive(torch.tensor(as_number("scale", scale), device="cpu"))
        self.stride = 1

    def select(self, view: View) -> Self:
        """See `Part.select`."""
        if view.stride == 1:
            return self
        part = sharing(self)
        part.stride = self.stride * view.stride
        return part

    def named_values(self, layout: Layout) -> dict[str, float]:
        """See `Part.named_values`: ``R_robust/KIND``, where the weights begin to fall."""
        return {f"R_robust/{type(self).__name__}": float(self.scale.value)}

    @abstractmethod
    def inverse(self, z: Tensor) -> Tensor:
        """1 / w [...], at least 1, of innovations [...] in standard deviations; differentiable."""

    def forward(self, y: Tensor, mean: Tensor, spread: Tensor, deviation: Tensor) -> Trusted:
        """Weigh one sample.

        One that stands for several (see `View`) has the mean of their noise, each is judged by its own.

        Args:
            y: [..., D], units of the DoFs, finite; what was not measured may be anything finite.
            mean: [..., D], of h(x), in the same units.
            spread: [..., D], variance of h(x), squared units.
            deviation: [D] or [..., D], standard deviations of the noise, in the same units.
        """
        noise = deviation.square() * self.stride
        variance = spread + noise
        residual = y - mean
        # Masked before the division: its gradient would not survive a quotient that overflows.
        far = residual.abs() > FAR * variance.sqrt()
        inverse = self.inverse(torch.where(far, 0, residual) / variance.sqrt())
        inverse = torch.where(far, 1 / LEAST, inverse)
        wider = ((noise + variance * (inverse - 1)) / self.stride).sqrt()
        return Trusted(torch.where(far, mean, y), wider, 1 / inverse)

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: where it starts is one of them."""
        return ""

    def extra_repr(self) -> str:
        """Where the weights begin to fall."""
        return f"scale={float(self.scale.start):g}"
