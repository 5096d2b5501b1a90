"""What a state remembers for a phase bank."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torch_ebip.common.brief import brief
from torch_ebip.filtering.updates.weighting import Seen


class Whereabouts(NamedTuple):
    """What a state remembers of N demonstrations at P phases, of all D DoFs of the layout.

    Attributes:
        share: [..., N, 2 P], probability of each phase, going, and then of each, standing still; all sum to 1.
        anywhere: [..., N, 2 P], that of who leaps: of the demonstrations that are known.
        sums: [..., 3, D], of the samples since the last step their number, times since then and values.
        before: [..., 3, D], of the last period that had any 1, their mean time, before the last step, and value.
        standing: [...], probability that a person stood still at the last step.
        clock: [...], s since then.
    """

    share: Tensor
    anywhere: Tensor
    sums: Tensor
    before: Tensor
    standing: Tensor
    clock: Tensor

    def __repr__(self) -> str:
        return brief(self)


def summed(memory: Whereabouts, seen: Seen, columns: Tensor) -> Tensor:
    """Sums [..., 3, D] of a memory with a sample of the DoFs int64 [k] that are its ``columns``."""
    value, sums = seen.y, memory.sums
    one = torch.ones_like(value)
    if seen.observed is not None:
        value, one = torch.where(seen.observed, value, 0), seen.observed.to(value)
    added = torch.stack([one, one * memory.clock.unsqueeze(-1), value], -2)
    return sums.index_add(-1, columns, added.expand(*sums.shape[:-1], added.shape[-1]))


def closed(memory: Whereabouts, clock: Tensor) -> Tensor:
    """[..., 3, D], what is before when a period of a memory is over, and ``clock`` [...] s of the next are gone."""
    number, time, value = memory.sums.unbind(-2)
    ago = (memory.clock - clock).unsqueeze(-1)
    known, older, before = memory.before.unbind(-2)
    some, number = number > 0, number.clamp(min=1)
    now = torch.stack([some.to(number), ago - time / number, value / number], -2)
    return torch.where(some.unsqueeze(-2), now, torch.stack([known, older + ago, before], -2))


def chosen(some: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """``new`` [..., *] of some entries of a batch, bool [...], of the others ``old``."""
    if bool(some.all()):
        return new
    return torch.where(some.reshape(*some.shape, *[1] * (new.ndim - some.ndim)), new, old)
