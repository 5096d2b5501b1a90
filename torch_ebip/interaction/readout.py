"""What a forecast passes through before it is said: the protocol, what it is told, how it moves one."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from torch_ebip.common.arguments import as_values
from torch_ebip.common.brief import brief
from torch_ebip.filtering.protocols import View
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.present import Present

NEAR = 0.95
"""Phase from which a path that is asked for by its phases becomes its end."""


class Lead(NamedTuple):
    """How far ahead a forecast is.

    Attributes:
        ahead: [..., P], in phase.
        seconds: [..., P], s.
        phase: [..., P], of what is forecast.
        end: [..., P], 0 to 1: how far it is the interaction's end that is asked for, whenever that may be.
        asked: [P], the seconds that were asked for, infinity the end; None where phases were.
        gone: [..., P], how long of these the interaction goes on the average, s; None: all the time.
    """

    ahead: Tensor
    seconds: Tensor
    phase: Tensor
    end: Tensor
    asked: Tensor | None = None
    gone: Tensor | None = None

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

    reads_present: bool
    """Whether it asks for the present; otherwise it is told None."""

    def __call__(
        self, forecast: Forecast, lead: Lead, mean: Tensor, variance: Tensor, present: Present | None = None
    ) -> Forecast:
        """The forecast [..., P, D] that far ahead of the ``present``, where the demonstrations have this mean and
        variance."""

    def select(self, view: View) -> Readout:
        """The same for a view of the model."""


def lead_of(phase: Tensor, velocity: Tensor, of: Tensor, asked: Tensor | None = None, periodic: bool = False) -> Lead:
    """How far phases ``of`` [..., P] lie ahead of a phase [...] at a velocity [...], 1/s; at rest: for ever.

    Args:
        phase: [...], where the interaction is.
        velocity: [...], 1/s.
        of: [..., P], what is forecast.
        asked: [P], the seconds ahead that were asked for; infinity is the end. Default: phases were, and the end is
            the last of them, which others approach from `NEAR` on.
        periodic: whether phases are those of a circle, which have no end unless it is asked for.
    """
    velocity = velocity.unsqueeze(-1)
    if periodic:
        end = torch.zeros_like(of) if asked is None else asked.isinf().to(of).expand_as(of)
        ahead = (of - phase.unsqueeze(-1)).clamp(min=0)
    else:
        of = of.clamp(0, 1)
        end = (of - NEAR) / (1 - NEAR) if asked is None else asked.isinf().to(of).expand_as(of)
        ahead = (of - phase.clamp(0, 1).unsqueeze(-1)).clamp(min=0)
    going = velocity > 0
    seconds = torch.where(going, ahead / torch.where(going, velocity, 1), torch.inf)
    return Lead(ahead, torch.where(ahead > 0, seconds, 0), of, end.clamp(0, 1), asked)


def increasing(name: str, values: Sequence[float], like: Tensor) -> Tensor:
    """Places [K] between which something is linear, in the dtype and on the device of ``like``.

    Raises:
        ValueError: none at all, negative ones, or some that do not increase.
    """
    places = as_values(name, list(values), None, like)
    if not len(places) or not bool((places.diff() > 0).all() & (places >= 0).all()):
        raise ValueError(f"{name} must increase from 0 or more, got {places.tolist()}")
    return places


def hats(lead: Tensor, leads: Tensor) -> Tensor:
    """Weights [..., K] of linear interpolation between leads [K], increasing, at a lead [...] within them."""
    if len(leads) == 1:
        return leads.new_ones(*lead.shape, 1)
    # Of each interval the part that was gone: 1 up to the one where the lead is, 0 from there on.
    part = ((lead.unsqueeze(-1) - leads[:-1]) / leads.diff()).clamp(0, 1)
    end = torch.zeros_like(part[..., :1])
    return torch.cat([end + 1, part], -1) - torch.cat([part, end], -1)


def widths_of(forecast: Forecast, variance: Tensor) -> Widths:
    """Deviations of a forecast and of the demonstrations, whose ``variance`` is [..., P, D] in squared units."""
    least = torch.finfo(variance.dtype).tiny
    return Widths(forecast.variance.clamp(min=least).sqrt(), root(variance))


def surer(widths: Widths, surest: Tensor) -> Tensor:
    """1 - (sigma_f / (r sigma_m))^2, [..., P, D], by how much a filter is surer than r: 0 where it is not.

    Args:
        widths: sigma_f of the filter, sigma_m of the demonstrations.
        surest: r, [..., P, D]; 0: nothing is.
    """
    least = surest * widths.demonstrated
    some = least > 0
    ratio = torch.where(some, widths.own / torch.where(some, least, 1), 1)
    return 1 - ratio.clamp(max=1).square()


def root(variance: Tensor) -> Tensor:
    """Deviations [...] of variances [...], 0 of what is not above 0."""
    # The root of 0 has no gradient, and one that is infinite would make those of all parameters NaN.
    apart = variance > 0
    return torch.where(apart, torch.where(apart, variance, 1).sqrt(), 0)


def moved(forecast: Forecast, mean: Tensor, deviation: Tensor, share: Tensor, widths: Widths) -> Forecast:
    """A forecast with another mean and deviation [..., P, D], units of the DoFs; its members go with them."""
    members = forecast.members
    if members is not None:
        # Where all members say the same there is nothing to stretch.
        spread = widths.own > 1e-6 * widths.demonstrated
        factor = torch.where(spread, deviation / widths.own, share).unsqueeze(-2)
        members = mean.unsqueeze(-2) + (members - forecast.mean.unsqueeze(-2)) * factor
    return forecast._replace(mean=mean, variance=deviation.square(), members=members)
