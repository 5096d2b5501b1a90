"""What a forecast passes through before it is said: the protocol, what it is told, how it moves one."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.forecast import Forecast


class Lead(NamedTuple):
    """How far ahead a forecast is.

    Attributes:
        ahead: [..., P], in phase.
        seconds: [..., P], s.
        phase: [..., P], of what is forecast.
    """

    ahead: Tensor
    seconds: Tensor
    phase: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Widths(NamedTuple):
    """Deviations behind a forecast, units of the DoFs.

    Attributes:
        own: [..., P, D], of the filter.
        demonstrated: [..., P, D], over the demonstrations.
    """

    own: Tensor
    demonstrated: Tensor

    def __repr__(self) -> str:
        return brief(self)


class Readout(Protocol):
    """What forecasts pass through."""

    def __call__(self, forecast: Forecast, lead: Lead, mean: Tensor, variance: Tensor) -> Forecast:
        """The forecast [..., P, D] that far ahead, where the demonstrations have this mean and variance."""

    def select(self, view: View) -> Readout:
        """The same for a view of the model."""


def lead_of(phase: Tensor, velocity: Tensor, of: Tensor) -> Lead:
    """How far phases ``of`` [..., P] lie ahead of a phase [...] at a velocity [...], 1/s; at rest: for ever."""
    of, velocity = of.clamp(0, 1), velocity.unsqueeze(-1)
    ahead = (of - phase.clamp(0, 1).unsqueeze(-1)).clamp(min=0)
    going = velocity > 0
    seconds = torch.where(going, ahead / torch.where(going, velocity, 1), torch.inf)
    return Lead(ahead, torch.where(ahead > 0, seconds, 0), of)


def hats(lead: Tensor, leads: Tensor) -> Tensor:
    """Weights [..., K] of linear interpolation between leads [K], increasing, at a lead [...] within them."""
    right = torch.searchsorted(leads, lead.contiguous(), right=True).clamp(1, len(leads) - 1)
    left = right - 1
    part = ((lead - leads[left]) / (leads[right] - leads[left])).unsqueeze(-1)
    one = torch.nn.functional.one_hot
    return one(left, len(leads)) * (1 - part) + one(right, len(leads)) * part


def widths_of(forecast: Forecast, variance: Tensor) -> Widths:
    """Deviations of a forecast and of the demonstrations, whose ``variance`` is [..., P, D] in squared units."""
    least = torch.finfo(variance.dtype).tiny
    return Widths(forecast.variance.clamp(min=least).sqrt(), variance.clamp(min=0).sqrt())


def moved(forecast: Forecast, mean: Tensor, deviation: Tensor, share: Tensor, widths: Widths) -> Forecast:
    """A forecast with another mean and deviation [..., P, D], units of the DoFs; its members go with them."""
    members = forecast.members
    if members is not None:
        # Where all members say the same there is nothing to stretch.
        spread = widths.own > 1e-6 * widths.demonstrated
        factor = torch.where(spread, deviation / widths.own, share).unsqueeze(-2)
        members = mean.unsqueeze(-2) + (members - forecast.mean.unsqueeze(-2)) * factor
    return forecast._replace(mean=mean, variance=deviation.square(), members=members)
