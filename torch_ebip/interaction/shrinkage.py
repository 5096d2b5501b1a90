"""Forecasts drawn towards the mean of the demonstrations, as far as those left out say that they should be.

A filter that is shown little, or sensors that say little, forecasts worse than the mean of all demonstrations would:
its errors are those of what it took for evidence. With a share s of the way from the mean m to the forecast f,
m + s (f - m), the mean is the worst that it can do (James & Stein 1961; learned from interactions left out, it is
Breiman's stacking of the two, 1996).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_values
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.readout import Lead, moved, widths_of

LEADS = (0.0, 0.125, 0.25, 0.5, 1.0)
"""How far ahead a share is learned for, in phase: nothing, and from an eighth of the interaction to all of it."""


class Shrinkage(nn.Module):
    """Mean m + s (f - m), standard deviation (1 - s) sigma_m + s sigma_f; s by DoF and by how far ahead it is.

    What `learn` made before `HorizonShrinkage`; older model files have it.

    Members keep their order and their weights: they are moved with the mean and stretched with the deviation.

    Args:
        share: [D, K], s at the leads, from 0 (the demonstrations' mean) to 1 (the filter).
        leads: [K] increasing, in phase; between them s is linear.

    Raises:
        ValueError: shares outside [0, 1], or not one for each lead; leads that do not increase.

    Example:
        >>> import torch
        >>> from torch_ebip.interaction import Forecast, Shrinkage
        >>> from torch_ebip.interaction.readout import Lead
        >>> half = Shrinkage(torch.full((1, 5), 0.5))
        >>> forecast = Forecast(torch.tensor([[2.0]]), torch.tensor([[1.0]]), torch.ones(1))
        >>> lead = Lead(*torch.tensor([[0.3], [0.5], [1.0], [0.0]]))
        >>> half(forecast, lead, torch.tensor([[0.0]]), torch.tensor([[9.0]])).mean.tolist()
        [[1.0]]
    """

    reads_present = False
    share: Tensor
    leads: Tensor

    def __init__(self, share: Tensor, leads: Sequence[float] = LEADS) -> None:
        super().__init__()
        places = as_values("leads", list(leads), None, share)
        if share.ndim != 2 or share.shape[1] != len(places) or not bool(((share >= 0) & (share <= 1)).all()):
            raise ValueError(f"share must be [D, {len(places)}] between 0 and 1, got {list(share.shape)}")
        if len(places) < 2 or not bool((places.diff() > 0).all()):
            raise ValueError(f"leads must be at least two, and increase, got {list(leads)}")
        self.register_buffer("share", owned(share))
        self.register_buffer("leads", owned(places))

    def at(self, lead: Tensor) -> Tensor:
        """s [..., D] at leads [...] in phase."""
        leads, share = self.leads, self.share.T
        right = torch.searchsorted(leads, lead.contiguous(), right=True).clamp(1, len(leads) - 1)
        left = right - 1
        start = leads[left]
        part = ((lead - start) / (leads[right] - start)).clamp(0, 1).unsqueeze(-1)
        return torch.lerp(share[left], share[right], part)

    def forward(
        self, forecast: Forecast, lead: Lead, mean: Tensor, variance: Tensor, present: Present | None = None
    ) -> Forecast:
        """Draw a forecast towards the demonstrations.

        Args:
            forecast: of the filter, mean [..., P, D].
            lead: of it, how far ahead it is.
            mean: [..., P, D], of the demonstrations at the phases of the forecast, units of the DoFs.
            variance: [..., P, D], of the demonstrations there, squared units.
            present: not looked at.
        """
        share = self.at(lead.ahead)
        drawn = mean + share * (forecast.mean - mean)
        widths = widths_of(forecast, variance)
        deviation = (1 - share) * widths.demonstrated + share * widths.own
        return moved(forecast, drawn, deviation, share, widths)

    def select(self, view: View) -> Shrinkage:
        """The same for a view of the model: of its DoFs."""
        part = Shrinkage.__new__(Shrinkage)
        nn.Module.__init__(part)
        part.register_buffer("share", self.share[view.dofs.to(self.share.device)])
        part.register_buffer("leads", self.leads)
        return part

    def extra_repr(self) -> str:
        """Sizes and range."""
        return f"{len(self.share)} DoFs, shares {float(self.share.min()):.2g} to {float(self.share.max()):.2g}"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""
