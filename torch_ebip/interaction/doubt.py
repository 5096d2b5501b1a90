"""Forecasts of an interaction that surprises: nearer to what was demonstrated, and wider.

How far and how wide is learned from strangers made of the demonstrations themselves: see
`torch_ebip.learning.strangers`.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_values
from torch_ebip.common.modules import sharing
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.readout import Lead, hats, moved, widths_of

LEVELS = (1.5, 2.1, 3.0, 4.5, 6.0)
"""Of doubt, -log10 of the chance of such a surprise: below the first of them, one in thirty, there is none."""
ELSEWHERE = 0.05
"""Share of the variance over all phases."""


class Doubt(nn.Module):
    """Mean m + s (f - m), variance s^2 (1 + c) sigma_f^2 + a u^2; s, c and a by how surprising the interaction is.

    m are the demonstrations, f and sigma_f the forecast; u^2 is the variance of the demonstrations there and
    `ELSEWHERE` of that over all phases: nobody knows the phase well. From the last level on it may be any moment of
    an interaction: what is asked for in seconds then is as wide as they are over all phases.

    Args:
        share: [K], s at the levels, from 1 on not increasing; the first is 1.
        widening: [K], a, from 0 on not decreasing; the first is 0.
        anywhere: [D], variance of each DoF over all phases of all demonstrations, squared units.
        levels: [K], increasing.
        inflation: [K], c, from 0 on not decreasing; the first is 0; default: 0.

    Raises:
        ValueError: shapes that do not fit, shares outside [0, 1], a widening or an inflation below 0.

    Example:
        >>> import torch
        >>> from torch_ebip.interaction import Forecast
        >>> from torch_ebip.interaction.doubt import Doubt
        >>> from torch_ebip.interaction.readout import Lead
        >>> doubt = Doubt(torch.tensor([1.0, 0.5]), torch.tensor([0.0, 1.0]), torch.ones(1), (1.0, 2.0))
        >>> forecast = Forecast(torch.tensor([[2.0]]), torch.tensor([[0.0]]), torch.ones(1))
        >>> lead = Lead(*torch.tensor([[0.0], [0.0], [1.0], [1.0]]))
        >>> doubt(forecast, lead, torch.zeros(1, 1), torch.ones(1, 1), torch.tensor(1.5)).mean.tolist()
        [[1.5]]
    """

    share: Tensor
    widening: Tensor
    inflation: Tensor
    levels: Tensor
    anywhere: Tensor

    def __init__(
        self,
        share: Tensor,
        widening: Tensor,
        anywhere: Tensor,
        levels: Sequence[float] = LEVELS,
        inflation: Tensor | None = None,
    ) -> None:
        super().__init__()
        inflation = torch.zeros_like(share) if inflation is None else inflation
        places = as_values("levels", list(levels), None, share)
        sizes = {tuple(values.shape) for values in (share, widening, inflation, places)}
        if len(sizes) > 1 or not bool((places.diff() > 0).all()):
            raise ValueError(
                f"levels must increase, one for each share, widening and inflation, got {list(levels)} for "
                f"{list(share.shape)}, {list(widening.shape)} and {list(inflation.shape)}"
            )
        wider = torch.cat([widening, inflation])
        if not bool(((share >= 0) & (share <= 1)).all()) or not bool((wider >= 0).all() & wider.isfinite().all()):
            raise ValueError("shares must lie between 0 and 1, widenings and inflations be finite and not negative")
        self.register_buffer("share", owned(share))
        self.register_buffer("widening", owned(widening))
        self.register_buffer("inflation", owned(inflation))
        self.register_buffer("levels", owned(places))
        self.register_buffer("anywhere", owned(anywhere))

    def forward(self, forecast: Forecast, lead: Lead, mean: Tensor, variance: Tensor, doubt: Tensor) -> Forecast:
        """Doubt a forecast.

        Args:
            forecast: mean [..., P, D].
            lead: how far ahead it is.
            mean: [..., P, D], of the demonstrations there, units of the DoFs.
            variance: [..., P, D], of the demonstrations there, squared units.
            doubt: [...], see `InteractionSurprise.doubt`.
        """
        levels = self.levels
        if not bool((doubt > levels[0]).any()):
            return forecast
        at = hats(doubt.clamp(levels[0], levels[-1]), levels)
        values = torch.stack([self.share, self.widening, self.inflation], -1)
        share, widening, inflation = (at @ values)[..., None, None, :].unbind(-1)
        lost = (at[..., -1:] * (1 - lead.end)).unsqueeze(-1)
        widths = widths_of(forecast, variance)
        spread = share.square() * (1 + inflation) * forecast.variance + widening * torch.maximum(
            self.unit(variance), lost * self.anywhere
        )
        doubted = (doubt > levels[0])[..., None, None]
        share = torch.where(doubted, share, 1).expand_as(forecast.mean)
        deviation = torch.where(doubted, spread, forecast.variance).sqrt()
        drawn = torch.where(doubted, mean + share * (forecast.mean - mean), forecast.mean)
        return moved(forecast, drawn, deviation, share, widths)

    def unit(self, variance: Tensor) -> Tensor:
        """u^2 [..., D] of a variance [..., D] of the demonstrations, squared units of the DoFs."""
        return variance + ELSEWHERE * self.anywhere

    def select(self, view: View) -> Doubt:
        """The same for a view of the model: of its DoFs."""
        part = sharing(self)
        part.register_buffer("anywhere", self.anywhere[view.dofs])
        return part

    def meant(self) -> str:
        """What its tensors mean, see `Meaning`: nothing beside themselves."""
        return ""

    def extra_repr(self) -> str:
        """Shares and widenings."""
        rows = zip(*(v.tolist() for v in (self.levels, self.share, self.inflation, self.widening)), strict=True)
        return "; ".join(
            f"from {level:g}: share {s:.2f}, inflation {c:.2f}, widening {a:.2f}" for level, s, c, a in rows
        )
