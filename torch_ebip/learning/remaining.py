"""How much a filter knows: what is left of the training mean's error, whatever it says of its own certainty."""

from __future__ import annotations

from itertools import product

import torch
from torch import Tensor

from torch_ebip.common.ambient import without_autocast
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.learning.held_out import HeldOut
from torch_ebip.learning.said import what_it_says


@without_autocast
@torch.no_grad()
def remaining_error(held_out: HeldOut, filter: InteractionFilter, interactions: Tensor) -> float:
    """What is left of the training mean's absolute error once forecasts are drawn towards it, 0 to about 1.

    The mean over horizons and DoFs, each modality drawn by the share that is best by least squares; where there is an
    arm, of its tool at the end too, weighed as in the objective. Filters are told apart by what they know, not by how
    sure they are of it, which the read-out says after them.

    Args:
        held_out: the demonstrations, and what is asked of them.
        filter: without a read-out.
        interactions: int64 [B].
    """
    said, task = what_it_says(held_out, filter, interactions), held_out.task
    modality = task.primitive.layout.modality_of_dof.to(said.towards.device)[task.targets]
    drawn = torch.zeros_like(said.towards)
    left, count = 0.0, 0
    for m, p in product(sorted(set(modality.tolist())), range(drawn.shape[2])):
        ours = modality == m
        wanted, towards = said.wanted[:, :, p, ours], said.towards[:, :, p, ours]
        measured = ~wanted.isnan()
        known, told = wanted[measured].double(), towards[measured].double()
        if len(known) and bool(known.any()):
            share = ((told @ known) / (told @ told).clamp(min=1e-12)).clamp(0, 1)
            left += int(ours.sum()) * float((known - share * told).abs().mean() / known.abs().mean())
            count += int(ours.sum())
            drawn[:, :, p, ours] = share.to(towards) * towards
    left = left / max(count, 1)
    objective = task.objective
    weights = objective.weights
    if objective.arm is None or objective.joints is None or not weights.tool:
        return left
    scale = objective.scale.expand_as(drawn[0, 0])[-1]
    joints = [(said.mean[:, :, -1] + of[:, :, -1]) * scale for of in (drawn, torch.zeros_like(drawn), said.wanted)]
    ours, means, true = (of[..., objective.joints] for of in joints)
    tool = float(objective.arm(ours, true) / objective.arm(means, true))
    values = weights.crps + weights.squared_error
    return (values * left + weights.tool * tool) / (values + weights.tool)
