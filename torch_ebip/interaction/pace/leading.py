"""When an ensemble is led where a phase bank has it, and how far."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.filtering.updates.pace import Placement
from torch_ebip.filtering.updates.weighting import Seen

FLOOR = 0.02
"""Deviation of the phase, beside those of ensemble and bank, within which the two agree."""
DIFFER = 2.0
"""Deviations beyond those up to which the ensemble is believed, from which on the bank is."""
STRANGE = 3.0, 6.0
"""Squared distance from what was demonstrated, 1 for what is usual, up to which a bank knows where a person is, and
from which on it does not: who moves as nobody did is followed by the ensemble alone."""
ANEW = 0.2
"""Phases by which an ensemble was wrong when all is forgotten that it has learned; of less a part is."""


def belief_of(moments: Tensor, phases: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and deviation [...] of a phase by its moments [..., 3]: no less than half a cell of phases [P]."""
    mean, square = moments[..., 0], moments[..., 1]
    return mean, (square - mean.square()).clamp(min=0.25 * float(phases[1]) ** 2).sqrt()


def placement_of(
    belief: tuple[Tensor, Tensor], strange: Tensor, some: Tensor, seen: Seen, agree: Tensor
) -> Placement | None:
    """Where members are led; None where nobody is.

    Args:
        belief: of the bank: mean and deviation of the phase, [...].
        strange: [...], squared distance from all that was demonstrated, 1 for what is usual.
        some: [...], in [0, 1], how much news there is of each entry of a batch.
        seen: the sample, and the members.
        agree: [], deviations up to which the ensemble is believed.
    """
    mean, deviation = belief
    variance = seen.moving[..., 0].var(-1, correction=0)
    apart = mean - seen.mean[..., 0]
    far = apart.abs() / (deviation.square() + variance + FLOOR**2).sqrt()
    known = ((STRANGE[1] - strange) / (STRANGE[1] - STRANGE[0])).clamp(0, 1)
    share = ((far - agree) / DIFFER).clamp(0, 1) * known * some
    if not bool((share > 0).any()):
        return None
    wide = torch.maximum(deviation.square(), variance).sqrt()
    return Placement(share * apart, share, wide, share * (apart.abs() / ANEW).clamp(max=1))
