"""How hypotheses of a phase bank pass from one period to the next."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.interaction.pace.leading import moments_of

RATES = (0.35, 0.6, 0.85, 1.0, 1.2, 1.6, 2.2, 3.0)
"""Of a person, as multiples of a demonstration's phase velocity."""
CHANCES = (0.04, 0.1, 0.2, 0.3, 0.2, 0.1, 0.04, 0.02)
"""Of these, at each step anew: a person's pace changes."""


class Moves(NamedTuple):
    """What depends on the settings alone.

    Attributes:
        passes: [N, 2 P, 2 P], from one period to the next, without those who leap.
        leap: [], share of those.
        moments: [2 P, 3], see `moments_of`, and 1 where a person stands still.
        slowness: [2], 1/s, at which a mode is forgotten, and how many stand still in the long run.
    """

    passes: Tensor
    leap: Tensor
    moments: Tensor
    slowness: Tensor

    def __repr__(self) -> str:
        return brief(self)


def moves_of(rates: Tensor, transition: Tensor, phases: Tensor, period: float, periodic: bool = False) -> Moves:
    """Of people who stop, go on and leap so many times a second.

    Args:
        rates: [3], 1/s.
        transition: [N, P, P], of those who go, see `transition_of`.
        phases: [P].
        period: s.
        periodic: whether phases are those of a circle.
    """
    stop, go, leap = (1 - torch.exp(-rates * period)).unbind()
    one, none = torch.eye(len(phases), dtype=rates.dtype, device=rates.device), torch.zeros_like(phases)
    going = torch.cat([(1 - stop) * transition, stop * transition], -1)
    standing = torch.cat([go * one, (1 - go) * one], -1).expand_as(going)
    kinds = moments_of(phases, periodic)
    moments = torch.cat([torch.cat([kinds, mode.unsqueeze(-1)], -1) for mode in (none, none + 1)])
    rate = rates[:2].sum()
    slowness = torch.stack([rate, rates[0] / rate])
    return Moves((1 - leap) * torch.cat([going, standing], -2), leap, moments, slowness)


def transition_of(pace: Tensor, phases: int, period: float, periodic: bool = False) -> Tensor:
    """[N, P, P], where of P phases who goes is after a period from each; behind the last is the last, or the first.

    Args:
        pace: [N], phase velocities, 1/s.
        phases: P.
        period: s.
        periodic: whether phases are those of a circle.
    """
    rates, chances = pace.new_tensor(RATES), pace.new_tensor(CHANCES)
    places = torch.arange(phases, device=pace.device, dtype=pace.dtype)
    cells = phases if periodic else phases - 1
    ahead = pace[:, None] * period * cells * rates  # [N, rates], in cells
    at = places[:, None] + ahead[:, None, :]  # [N, P, rates]
    at = at if periodic else at.clamp(max=phases - 1)
    low = at.floor() if periodic else at.floor().clamp(max=phases - 2)
    moves = pace.new_zeros(len(pace), phases, phases)
    for cell, part in ((low, 1 - (at - low)), (low + 1, at - low)):
        moves.scatter_add_(-1, cell.long() % phases, part * chances)
    return moves / moves.sum(-1, keepdim=True)
