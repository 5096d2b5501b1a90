"""When an ensemble is led where a phase bank has it, and how far."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.filtering.updates.pace import Placement
from torch_ebip.filtering.updates.weighting import Seen
from torch_ebip.interaction.course import apart, circular_of

FLOOR = 0.02
"""Deviation of the phase, beside those of ensemble and bank, within which the two agree."""
DIFFER = 2.0
"""Deviations beyond those up to which the ensemble is believed, from which on the bank is."""
STRANGE = 3.0, 6.0
"""Squared distance from what was demonstrated, 1 for what is usual, up to which a bank knows where a person is, and
from which on it does not: who moves as nobody did is followed by the ensemble alone."""
ANEW = 0.2
"""Phases by which an ensemble was wrong when all is forgotten that it has learned; of less a part is."""
WIDER = 2.0, 4.0
"""Times as wide as the bank up to which an ensemble that may be anywhere is left alone, and from which on it is made
as wide as that."""


def moments_of(phases: Tensor, periodic: bool) -> Tensor:
    """[P, 2], of which expectations `belief_of` asks, at phases [P]: themselves and their squares, or sides on a
    circle."""
    if periodic:
        angle = 2 * torch.pi * phases
        return torch.stack([angle.cos(), angle.sin()], -1)
    return torch.stack([phases, phases.square()], -1)


def belief_of(moments: Tensor, phases: Tensor, periodic: bool) -> tuple[Tensor, Tensor]:
    """Mean and deviation [...] of a phase by its moments [..., 3]: no less than half a cell of phases [P]."""
    first, second, least = moments[..., 0], moments[..., 1], 0.5 * float(phases[1])
    if periodic:
        mean, deviation = circular_of(first, second)
        return mean, deviation.clamp(min=least)
    return first, (second - first.square()).clamp(min=least**2).sqrt()


def placement_of(
    belief: tuple[Tensor, Tensor],
    strange: Tensor,
    some: Tensor,
    seen: Seen,
    agree: Tensor,
    periodic: bool = False,
    narrows: bool = False,
) -> Placement | None:
    """Where members are led; None where nobody is.

    Args:
        belief: of the bank: mean and deviation of the phase, [...].
        strange: [...], squared distance from all that was demonstrated, 1 for what is usual.
        some: [...], in [0, 1], how much news there is of each entry of a batch.
        seen: the sample, and the members.
        agree: [], deviations up to which the ensemble is believed.
        periodic: whether phases are those of a circle.
        narrows: whether members may be at phases far from each other, because they begin there, or by coming round a
            circle: who is much wider than the bank is led, too. Linear updates are of no use to them.
    """
    mean, deviation = belief
    variance = seen.moving[..., 0].var(-1, correction=0)
    between = apart(mean - seen.mean[..., 0], periodic)
    far = between.abs() / (deviation.square() + variance + FLOOR**2).sqrt()
    known = ((STRANGE[1] - strange) / (STRANGE[1] - STRANGE[0])).clamp(0, 1) * some
    share = ((far - agree) / DIFFER).clamp(0, 1) * known
    wide = torch.maximum(deviation.square(), variance).sqrt()
    forgets = (between.abs() / ANEW).clamp(max=1)
    if narrows:
        own = variance.sqrt()
        excess = (own / deviation.clamp(min=FLOOR) - WIDER[0]) / (WIDER[1] - WIDER[0])
        narrowed = excess.clamp(0, 1) * known
        more = narrowed > share
        share, wide = torch.where(more, narrowed, share), torch.where(more, deviation, wide)
        forgets = torch.where(more, (own / ANEW).clamp(max=1), forgets)
    if not bool((share > 0).any()):
        return None
    return Placement(share * between, share, wide, share * forgets)
