"""Whether demonstrations repeat, so that their phase goes round a circle: by validation."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.basis.regression import samples_of
from torch_ebip.interaction.pace.phase_bank import PhaseBank
from torch_ebip.interaction.presets import ebip
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.crps import crps_of
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.partition import generator_of
from torch_ebip.recordings.demonstrations import Demonstrations

FACTORS = (1.0, 10.0, 100.0)
"""On R, that are tried with either phase."""


def why_not_periodic(demonstrations: Demonstrations) -> str | None:
    """Why demonstrations cannot be ones that repeat; None if they can."""
    try:
        samples_of(demonstrations, periodic=True)
    except ValueError as error:
        return str(error)
    return None


def bank_of(primitive: InteractionPrimitive) -> PhaseBank | None:
    """The bank with which demonstrations that repeat are filtered at first, because they may begin anywhere; None for
    others, and where no sensor moves."""
    if not primitive.periodic:
        return None
    try:
        return PhaseBank.of(primitive)
    except ValueError:
        return None


@without_autocast
@torch.no_grad()
def course_error(held_out: HeldOut, scale: Tensor) -> float:
    """CRPS of the best of a few filters that nobody tuned, with the phase that a primitive has.

    Args:
        held_out: demonstrations on that phase, and what is asked of them.
        scale: [P, D_targets], units of the errors: the same for both phases.
    """
    primitive = held_out.task.primitive
    bank = bank_of(primitive)
    draws = generator_of(held_out.settings.seed, -6)
    order = torch.randperm(len(primitive), generator=draws, device="cpu")
    errors = []
    for factor in FACTORS:
        variance = factor * primitive.residual_variance
        filter = ebip(primitive, residual_variance=variance, square_root=True, weigh=True, pace=bank)
        errors.append(crps_of(held_out, filter, order, scale))
    return min(errors)
