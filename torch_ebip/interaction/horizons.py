"""A read-out by horizon: forecasts drawn towards the demonstrations' mean, and as wide as they turned out to err.

What a filter says of the next tenth of a second and what it says of an end that is far off deserve different trust:
where all interactions end alike the mean is the best forecast of the end, and says little of the next moment. And it
deserves less, the less the filter has found out. So the share s of the way from the mean m to the forecast f,
m + s (f - m), is learned by how many seconds ahead it is, and by how wide the filter's belief still is, as a share of
how far demonstrations lie apart (James & Stein 1961; Breiman's stacking, 1996).

The end is a horizon of its own, however near the filter takes it to be: one that believes in an end that is not there
is as sure of it as of the next moment.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.present import Present
from torch_ebip.interaction.readout import Lead, Widths, hats, increasing, moved, widths_of

SECONDS = (0.1, 0.25, 0.5, 1.0, math.inf)
"""Horizons, s, that have shares; infinity is the end."""
LEVELS = (0.25, 0.6, 1.0)
"""Widths of the filter's belief, as shares of the demonstrations' deviation, for which they are learned."""


class HorizonShrinkage(nn.Module):
    """Mean m + s (f - m), deviation c ((1 - s) sigma_m + s sigma_f), by DoF and horizon, s by sigma_f / sigma_m too.

    Members keep their order and their weights: they are moved with the mean and stretched with the deviation.

    Args:
        share: [D, K, J], s at the seconds and the levels; from 0 (the demonstrations' mean) to 1 (the filter).
        widening: [D, K], c, above 0.
        seconds: [K] increasing; between them s is linear, before the first and behind the last as there. Infinity,
            the last, is the end; without it the end is as far ahead as the filter says.
        levels: [J] increasing, of sigma_f / sigma_m; as the seconds.

    Raises:
        ValueError: shares outside [0, 1], factors that are not positive, shapes that do not fit; seconds or levels
            that do not increase.

    Example:
        >>> import torch
        >>> from torch_ebip.interaction import Forecast, HorizonShrinkage
        >>> from torch_ebip.interaction.readout import Lead
        >>> half = HorizonShrinkage(torch.full((1, 5, 3), 0.5), torch.ones(1, 5))
        >>> forecast = Forecast(torch.tensor([[2.0]]), torch.tensor([[1.0]]), torch.ones(1))
        >>> lead = Lead(*torch.tensor([[0.3], [0.5], [0.9], [0.0]]))
        >>> half(forecast, lead, torch.tensor([[0.0]]), torch.tensor([[9.0]])).mean.tolist()
        [[1.0]]
    """

    reads_present = False
    share: Tensor
    widening: Tensor
    seconds: Tensor
    levels: Tensor

    def __init__(
        self,
        share: Tensor,
        widening: Tensor,
        seconds: Sequence[float] = SECONDS,
        levels: Sequence[float] = LEVELS,
    ) -> None:
        super().__init__()
        places = {"seconds": increasing("seconds", seconds, share), "levels": increasing("levels", levels, share)}
        shape = (len(places["seconds"]), len(places["levels"]))
        if share.ndim != 3 or share.shape[1:] != shape or not bool(((share >= 0) & (share <= 1)).all()):
            raise ValueError(f"share must be [D, {shape[0]}, {shape[1]}] between 0 and 1, got {list(share.shape)}")
        if widening.shape != share.shape[:2] or not bool((widening > 0).all() & widening.isfinite().all()):
            raise ValueError(f"widening must be {list(share.shape[:2])} and positive, got {list(widening.shape)}")
        self.register_buffer("share", owned(share))
        self.register_buffer("widening", owned(widening))
        self.register_buffer("seconds", owned(places["seconds"]))
        self.register_buffer("levels", owned(places["levels"]))

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
        widths = widths_of(forecast, variance)
        at = horizon_hats(lead, self.seconds)  # [..., P, K]
        level = level_hats(widths, self.levels)  # [..., P, D, J]
        share = (torch.einsum("...k,dkj->...dj", at, self.share) * level).sum(-1)
        drawn = mean + share * (forecast.mean - mean)
        deviation = ((1 - share) * widths.demonstrated + share * widths.own) * (at @ self.widening.T)
        return moved(forecast, drawn, deviation, share, widths)

    def select(self, view: View) -> HorizonShrinkage:
        """The same for a view of the model: of its DoFs."""
        part = HorizonShrinkage.__new__(HorizonShrinkage)
        nn.Module.__init__(part)
        dofs = view.dofs.to(self.share.device)
        part.register_buffer("share", self.share[dofs])
        part.register_buffer("widening", self.widening[dofs])
        part.register_buffer("seconds", self.seconds)
        part.register_buffer("levels", self.levels)
        return part

    def extra_repr(self) -> str:
        """Sizes and range."""
        return f"{len(self.share)} DoFs, shares {float(self.share.min()):.2g} to {float(self.share.max()):.2g}"

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""


def horizon_hats(lead: Lead, seconds: Tensor) -> Tensor:
    """Weights [..., P, K] of the shares at ``seconds`` [K], s, perhaps infinity last, at a lead; they sum to 1."""
    if not seconds[-1].isinf():
        return hats(lead.seconds.clamp(seconds[0], seconds[-1]), seconds)
    if len(seconds) == 1:
        return hats(lead.seconds, seconds)
    near, end = seconds[:-1], lead.end.unsqueeze(-1)
    return torch.cat([(1 - end) * hats(lead.seconds.clamp(near[0], near[-1]), near), end], -1)


def level_hats(widths: Widths, levels: Tensor) -> Tensor:
    """Weights [..., P, D, J] of the shares at levels [J] for how wide a belief still is; they sum to 1."""
    apart = widths.demonstrated > 0
    ratio = torch.where(apart, widths.own / torch.where(apart, widths.demonstrated, 1), levels[-1])
    return hats(ratio.clamp(levels[0], levels[-1]), levels)
