"""Where interactions begin, by where those that were demonstrated do."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.course import within


def begin_of(first: Tensor, phases: Tensor, periodic: bool) -> Tensor:
    """[P], probability of phases [P], evenly spaced from 0, by first phases [N], each as likely: shared linearly
    between its neighbours."""
    P = len(phases)
    place = within(first, periodic) / phases[1]
    low = place.floor()
    part = place - low
    begin = torch.zeros_like(phases)
    for cell, share in ((low, 1 - part), (low + 1, part)):
        index = cell.long() % P if periodic else cell.long().clamp(max=P - 1)
        begin = begin.index_add(0, index, share)
    return begin / len(first)


def spread_of(begin: Tensor, phases: Tensor) -> float:
    """Deviation of phases [P] with probabilities ``begin`` [P]."""
    middle = (begin * phases).sum()
    return float((begin * (phases - middle).square()).sum().sqrt())
