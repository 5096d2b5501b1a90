"""Forecasts that stay near what was demonstrated, and are unsure where they would not."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_number
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.readout import moved, widths_of

PORTION = 64
"""Demonstrations that are looked at together: all at once would be large."""
POINTS = 51


class Bounds(nn.Module):
    """Draws the mean of a forecast back where it leaves the demonstrated range, and widens it by as much.

    A mean that is e outside of a range w wide becomes M tanh(e / M) outside, M = margin w; its variance grows by the
    square of what was taken away, w at most, and towards that of the demonstrations, which it has from e = M on.
    Within the range nothing changes.

    Args:
        low, high: [D], units of the DoFs.
        margin: share of the width by which the mean may be outside, at most.

    Raises:
        ValueError: a range that is none, or a margin that is negative.

    Example:
        >>> import torch
        >>> from torch_ebip.interaction import Forecast
        >>> from torch_ebip.interaction.bounds import Bounds
        >>> bounds = Bounds(torch.tensor([0.0]), torch.tensor([2.0]))
        >>> far = Forecast(torch.tensor([[18.5]]), torch.tensor([[0.01]]), torch.ones(1))
        >>> said = bounds(far, torch.tensor([[0.04]]))
        >>> said.mean.tolist(), round(float(said.variance.sqrt()), 2)
        ([[2.5]], 2.01)
    """

    low: Tensor
    high: Tensor

    def __init__(self, low: Tensor, high: Tensor, margin: float = 0.25) -> None:
        super().__init__()
        if low.ndim != 1 or low.shape != high.shape or not bool((low <= high).all()):
            raise ValueError(f"low and high must be [D], the first not above the second, got {low} and {high}")
        self.margin = as_number("margin", margin, 0)
        self.register_buffer("low", owned(low))
        self.register_buffer("high", owned(high))

    @classmethod
    def of(cls, primitive: InteractionPrimitive, margin: float = 0.25) -> Bounds:
        """Those of a primitive's demonstrations.

        Args:
            primitive: of the demonstrations.
            margin: see the class.
        """
        return cls(*demonstrated_range(primitive), margin)

    def forward(self, forecast: Forecast, variance: Tensor) -> Forecast:
        """Hold a forecast.

        Args:
            forecast: mean [..., P, D].
            variance: [..., P, D], of the demonstrations at the phases of the forecast, squared units.
        """
        mean, width = forecast.mean, self.high - self.low
        inside = torch.minimum(torch.maximum(mean, self.low), self.high)
        outside = mean - inside
        out = outside != 0
        if not bool(out.any()):
            return forecast
        most = (self.margin * width).clamp(min=torch.finfo(mean.dtype).tiny)
        part = torch.where(out, outside, 0) / most
        kept = torch.where(out, most * torch.tanh(part), 0)
        taken = torch.minimum((outside - kept).abs(), width)
        growth = taken.square() + part.abs().clamp(max=1).square() * variance
        deviation = torch.where(out, forecast.variance + growth, forecast.variance).sqrt()
        widths = widths_of(forecast, variance)
        return moved(forecast, inside + kept, deviation, torch.ones_like(mean), widths)

    def select(self, view: View) -> Bounds:
        """The same for a view of the model: of its DoFs."""
        part = sharing(self)
        part.register_buffer("low", self.low[view.dofs])
        part.register_buffer("high", self.high[view.dofs])
        return part

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`."""
        return f"margin={self.margin:g}"

    def extra_repr(self) -> str:
        """Its margin."""
        return self.meant()


def demonstrated_range(primitive: InteractionPrimitive) -> tuple[Tensor, Tensor]:
    """The least and the largest value of each DoF in any demonstration, as their regressions have them: [D] each.

    Args:
        primitive: of the demonstrations.
    """
    phase = torch.linspace(0, 1, POINTS, dtype=primitive.weights.dtype, device=primitive.weights.device)
    least = torch.full_like(primitive.residual_variance, torch.inf)
    most = -least
    for weights in torch.split(primitive.weights, PORTION):
        paths = primitive.basis.project(phase[:, None], weights)
        least = torch.minimum(least, paths.amin((0, 1)))
        most = torch.maximum(most, paths.amax((0, 1)))
    return least, most
