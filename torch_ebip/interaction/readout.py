"""What a forecast passes through before it is said: the protocol, and what it is told of the forecast."""

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
