"""A filter whose read-out has analogues, with numbers made by hand, of interactions of conftest."""

from __future__ import annotations

from collections.abc import Sequence

import torch

from torch_ebip import InteractionPrimitive, ebip
from torch_ebip.interaction import InteractionEnsembleFilter
from torch_ebip.interaction.analogue_readout import AnalogueReadout
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.expert import SLOWER, Expert, Layers
from torch_ebip.interaction.horizons import LEVELS
from torch_ebip.interaction.present import recent_of


def bent(primitive: InteractionPrimitive, **options: object) -> InteractionEnsembleFilter:
    """The two controlled DoFs are forecast together."""
    filter = ebip(primitive, **options)  # type: ignore[arg-type]
    filter.analysis.recent = recent_of(primitive)
    like, D, draws = primitive.weights, primitive.layout.n_dofs, torch.Generator().manual_seed(0)
    follow, correct = torch.eye(D).repeat(5, len(LEVELS), 1, 1), torch.zeros(5, D, D)
    controlled = primitive.layout.controlled.nonzero().squeeze(-1)
    n = len(controlled)
    for j in range(len(LEVELS)):
        random = 0.3 * torch.randn(5, n, n, generator=draws)
        follow[:, j, controlled.unsqueeze(-1), controlled] = random + 0.3 * torch.eye(n)
    correct[:, controlled.unsqueeze(-1), controlled] = 0.1 * torch.randn(5, n, n, generator=draws)
    width = torch.rand(5, D, 3, generator=draws)
    analogues = Analogues.of(primitive)
    with torch.no_grad():
        for parameter in analogues.parameters():
            parameter.add_(0.3 * torch.randn(parameter.shape, generator=draws).to(parameter))
    parts = (follow.transpose(1, 2).flatten(-2), correct, width)
    more = {
        "surest": 0.06 * torch.rand(5, D, generator=draws).to(like),
        "stretch": 0.5 + torch.rand(5, D, len(LEVELS), generator=draws).to(like),
    }
    filter.readout = AnalogueReadout(analogues, *(part.to(like) for part in parts), levels=LEVELS, **more)
    return filter


def heard(
    primitive: InteractionPrimitive, slower: Sequence[float] = SLOWER, **options: object
) -> InteractionEnsembleFilter:
    """The same with an expert, of random numbers, that reads the sensors and speaks of the controlled DoFs."""
    filter = bent(primitive, **options)
    filter.analysis.recent = recent_of(primitive, slower=slower)
    draws, controlled, D = torch.Generator().manual_seed(1), primitive.layout.controlled, primitive.layout.n_dofs
    expert = Expert.of(primitive, ~controlled, controlled, hidden=8)
    for name, part in expert.named_buffers(recurse=False):
        if name in Layers._fields or name in ("middle", "centre"):
            part.copy_(0.3 * torch.randn(part.shape, generator=draws).to(part))
        elif name in ("scale", "unit"):
            part.copy_(0.5 + torch.rand(part.shape, generator=draws).to(part))
    like = primitive.weights
    heed = torch.where(controlled.unsqueeze(-1), torch.rand(5, D, len(LEVELS), generator=draws), 0)
    bending = filter.readout
    more = {"surest": bending.surest, "stretch": bending.stretch}
    parts = (bending.analogues, bending.follow, bending.correct, bending.width)
    filter.readout = AnalogueReadout(*parts, levels=LEVELS, expert=expert, heed=heed.to(like), **more)
    return filter
