"""The model that all filters of an interaction share: phase dynamics, basis projection, Q and R."""

from __future__ import annotations

import copy

import torch
from torch import Tensor

from torch_ebip.common.ambient import in_own_modes
from torch_ebip.common.arguments import as_number, as_values
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.noise.measurement import MeasurementNoise
from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.gated_noise import PhaseGatedNoise
from torch_ebip.interaction.noise import InteractionNoise, WeightNoise
from torch_ebip.interaction.phases.constant_velocity import ConstantVelocityPhase
from torch_ebip.interaction.phases.cyclic import CyclicPhase
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.projection import BasisProjection


@in_own_modes
def interaction_model(
    primitive: InteractionPrimitive,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    phase: PhaseModel | None = None,
) -> StateSpace:
    """A model with parameters of its own, in the dtype and on the device of the primitive.

    Args:
        primitive: of the demonstrations.
        residual_variance: [D], R at the start, squared units; default: the paper's closed form. The corrected one is
            ``primitive.correlated_residual_variance``.
        weight_noise: rate of the weights' random walk at the start, 1/sqrt(s), see `WeightNoise`; default: none.
        context: functions of phase for an R that depends on it; see `PhaseGatedNoise`.
        phase: how the phase moves; default: see `usual_phase`.

    Raises:
        ValueError: a variance that is not [D] or not positive; a rate that is not.
    """
    layout, weights = primitive.layout, primitive.weights
    phase = usual_phase(primitive) if phase is None else copy.deepcopy(phase).to(weights)
    basis = copy.deepcopy(primitive.basis).to(weights)
    modality_of_dof = layout.modality_of_dof.to(weights.device)
    walk = None
    if weight_noise is not None:
        weight_noise = as_number("weight_noise", weight_noise, 0, above=True)
        rates = weights.new_full((len(layout.modalities),), weight_noise)
        modality_of_weight = modality_of_dof[basis.dof_of_weight().to(weights.device)]
        walk = WeightNoise(rates, weights.std(0), modality_of_weight)
    variance = primitive.residual_variance if residual_variance is None else residual_variance
    variance = as_values("residual_variance", variance, None, weights)
    if variance.shape != (layout.n_dofs,):
        raise ValueError(
            f"residual_variance must be [{layout.n_dofs}], one variance for each of {', '.join(layout.dofs[:8])}, "
            f"got {list(variance.shape)}"
        )
    variance = variance.to(weights)
    return StateSpace(
        phase,
        BasisProjection(basis, phase.moving),
        InteractionNoise(phase.noise(primitive), walk, phase.moving),
        MeasurementNoise(variance) if context is None else PhaseGatedNoise(variance, context, modality_of_dof),
        layout.dofs,
        1 / primitive.rate,
    )


def usual_phase(primitive: InteractionPrimitive) -> PhaseModel:
    """The paper's phase, or that on a circle for a primitive of demonstrations that repeat."""
    return CyclicPhase() if primitive.periodic else ConstantVelocityPhase()


def demonstration_states(primitive: InteractionPrimitive, phase: PhaseModel | None = None) -> Tensor:
    """[N, n]: what moves, with the first phase, and the weights of each demonstration.

    Args:
        primitive: of the demonstrations.
        phase: how the phase moves; default: see `usual_phase`.
    """
    phase = usual_phase(primitive) if phase is None else phase
    return torch.cat([phase.first(primitive), primitive.weights], dim=-1)
