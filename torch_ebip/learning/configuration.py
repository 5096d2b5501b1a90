"""What belongs together in a tuning, and what a checkpoint is one of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import torch
from torch import nn

from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.recordings.demonstrations import Demonstrations

if TYPE_CHECKING:
    from torch_ebip.learning.tuner import Tuner


def check_parts(filter: InteractionFilter, demonstrations: Demonstrations, primitive: InteractionPrimitive) -> None:
    """ValueError unless a filter is one of a primitive, and that one of some demonstrations."""
    if len(primitive) != len(demonstrations):
        raise ValueError(f"{len(demonstrations)} demonstrations, but the primitive has {len(primitive)}")
    if demonstrations.layout != primitive.layout or abs(demonstrations.rate / primitive.rate - 1) > 1e-6:
        raise ValueError("the demonstrations have another layout or rate than the primitive")
    if filter.dof_names is not None and filter.dof_names != primitive.layout.dofs:
        raise ValueError("the filter has other columns than the primitive, or in another order")
    states = getattr(filter.prior, "states", None)
    if states is None or not torch.equal(states[:, filter.phase_model.moving :], primitive.weights):
        raise ValueError("the filter's prior does not hold the demonstrations of this primitive")


def configuration(tuner: Tuner) -> dict[str, Any]:
    """Everything on which the numbers of a tuning depend; a checkpoint of another one is refused."""
    settings = {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(tuner.settings).items()}
    shapes: Sequence[str] = [f"{name} {list(p.shape)}" for name, p in tuner.parameters.items()]
    interactions = int(tuner.lengths.sum())
    masks = {name: mask.tolist() for name, mask in {**tuner.subsets, "targets": tuner.targets}.items()}
    return {
        **settings,
        "parameters": list(shapes),
        "samples": interactions,
        "masks": masks,
        "filter": f"{type(tuner.filter).__name__}({tuner.filter.extra_repr()})",
        "parts": nn.Module.__repr__(tuner.filter),
        "objective_weights": list(tuner.objective.weights),
        "filter_buffers": _fingerprint(tuner.filter),
        "objective_buffers": _fingerprint(tuner.objective),
    }


def _fingerprint(module: nn.Module) -> dict[str, str]:
    """The norm of every buffer to four digits: starting points, prior states, scales; blind to rounding."""
    return {name: f"{float(buffer.double().norm()):.4g}" for name, buffer in module.named_buffers()}
