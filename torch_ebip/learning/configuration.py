"""What belongs together in a tuning, and what a checkpoint is one of."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.common.arguments import as_mask
from torch_ebip.common.brief import brief
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.learning.objective import ForecastObjective
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


class Task(NamedTuple):
    """What is tuned for.

    Attributes:
        primitive: of the demonstrations.
        objective: what is minimised.
        targets: bool [D], the DoFs to forecast.
        subsets: bool [D] of the sensors that may be shown together, by name.
    """

    primitive: InteractionPrimitive
    objective: ForecastObjective
    targets: Tensor
    subsets: Mapping[str, Tensor]

    def __repr__(self) -> str:
        return brief(self)


def complete(
    filter: InteractionFilter,
    demonstrations: Demonstrations,
    primitive: InteractionPrimitive | None,
    objective: ForecastObjective | None,
    targets: Tensor | None,
    subsets: Mapping[str, Tensor] | None,
) -> Task:
    """What a caller left out, from what they gave; see `Tuner`.

    Raises:
        ValueError: parts that do not belong together.
    """
    if primitive is None:
        primitive = _primitive_of(filter, demonstrations)
    check_parts(filter, demonstrations, primitive)
    layout, device = primitive.layout, primitive.weights.device
    if targets is None:
        targets = layout.controlled if objective is None else layout.mask(objective.names)
    targets = as_mask("targets", targets, layout.n_dofs).to(device)
    if objective is None:
        objective = ForecastObjective(primitive, targets).to(device)
    if targets.tolist() != [dof in objective.names for dof in layout.dofs]:
        raise ValueError(f"the objective scores {', '.join(objective.names)}, which are not the targets")
    if subsets is None:
        subsets = {"all": ~targets.cpu()}
        if not bool(subsets["all"].any()):
            raise ValueError("every DoF is a target: say in `subsets` which of them sensors show")
    if not subsets:
        raise ValueError("subsets must be at least one set of sensors that are shown together")
    masks = {name: as_mask(f"subset {name!r}", subset, layout.n_dofs).to(device) for name, subset in subsets.items()}
    return Task(primitive, objective, targets, masks)


def _primitive_of(filter: InteractionFilter, demonstrations: Demonstrations) -> InteractionPrimitive:
    """The primitive that a filter's members are of, fitted again."""
    states: Tensor = filter.prior.states[:, filter.phase_model.moving :]  # type: ignore[index]
    moved = demonstrations.to(dtype=states.dtype, device=states.device)
    primitive = InteractionPrimitive.fit(moved, filter.basis_projection.basis)
    # The filter's basis is in its own precision, so that a fit in float64 differs by rounding.
    spread = states.std(0).clamp(min=torch.finfo(states.dtype).tiny)
    if primitive.weights.shape == states.shape and bool(((primitive.weights - states).abs() <= 1e-3 * spread).all()):
        primitive.weights.copy_(states)
    return primitive


def configuration(tuner: Tuner) -> dict[str, Any]:
    """Everything on which the numbers of a tuning depend; a checkpoint of another one is refused."""
    settings = {key: list(v) if isinstance(v, tuple) else v for key, v in asdict(tuner.settings).items()}
    shapes: Sequence[str] = [f"{name} {list(p.shape)}" for name, p in tuner.parameters.items()]
    interactions = int(tuner.held_out.lengths.sum())
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
