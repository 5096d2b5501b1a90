"""What all filters of an interaction share: phase dynamics, basis projection, Q and R; whole or for some DoFs."""

from __future__ import annotations

import copy
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_ebip.ambient import in_own_modes
from torch_ebip.arguments import as_mask, as_number, as_values
from torch_ebip.basis.base import Basis
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.noise.measurement import MeasurementNoise, SelectedNoise
from torch_ebip.noise.pair import FilterNoise
from torch_ebip.noise.process import InteractionNoise, PhaseNoise, WeightNoise
from torch_ebip.noise.robust import RobustWeights
from torch_ebip.primitive import InteractionPrimitive


class InteractionModel(NamedTuple):
    """g, h, and their noise; the state is phase, phase velocity, weights.

    Attributes:
        dynamics: g.
        observation: h.
        noise: Q and R.
        n_dofs: D.
        dt: seconds between samples.
        dof_names: D of them, for error messages.
        state: int64 [n], which entries of the state these are of the model that this one was selected from.
        dofs: int64 [D], which of its DoFs.
    """

    dynamics: ConstantVelocityPhase
    observation: BasisProjection
    noise: FilterNoise
    n_dofs: int
    dt: float
    dof_names: tuple[str, ...] | None
    state: Tensor
    dofs: Tensor


@in_own_modes
def interaction_model(
    primitive: InteractionPrimitive,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    robust: RobustWeights | None = None,
) -> InteractionModel:
    """A model with parameters of its own, in the dtype and on the device of the primitive.

    Raises:
        ValueError: a variance that is not [D] or not positive; a rate that is not.

    Args:
        primitive: of the demonstrations.
        residual_variance: [D], R at the start, squared units; default: the paper's closed form. The corrected one is
            ``primitive.correlated_residual_variance``.
        weight_noise: rate of the weights' random walk at the start, 1/sqrt(s), see `WeightNoise`; default: none.
        context: functions of phase for an R that depends on it; see `MeasurementNoise`.
        robust: what surprising measurements count, such as `StudentT`; default: as much as others.
    """
    layout, weights = primitive.layout, primitive.weights
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
    noise = FilterNoise(
        InteractionNoise(PhaseNoise(_acceleration(primitive)), walk),
        MeasurementNoise(variance.to(weights), context, modality_of_dof),
        None if robust is None else copy.deepcopy(robust).to(weights),
    )
    state = torch.arange(2 + basis.n_weights, device=weights.device)
    dofs = torch.arange(layout.n_dofs, device=weights.device)
    return InteractionModel(
        ConstantVelocityPhase(),
        BasisProjection(basis),
        noise,
        layout.n_dofs,
        1 / primitive.rate,
        layout.dofs,
        state,
        dofs,
    )


def demonstration_states(primitive: InteractionPrimitive) -> Tensor:
    """[N, n]: phase 0, phase velocity and weights of each demonstration."""
    velocity = primitive.phase_velocity
    return torch.cat([torch.zeros_like(velocity)[:, None], velocity[:, None], primitive.weights], dim=-1)


def select_dofs(
    dynamics: nn.Module,
    observation: nn.Module,
    noise: FilterNoise,
    dt: float,
    dof_names: tuple[str, ...] | None,
    dofs: Tensor,
    thinning: int,
) -> InteractionModel:
    """The model of some DoFs, with the same parameters, not a copy; see `Filter.restrict`.

    Raises:
        TypeError: not the parts of an `InteractionModel`.
    """
    process = noise.process
    if (
        not isinstance(dynamics, ConstantVelocityPhase)
        or not isinstance(observation, BasisProjection)
        or not isinstance(process, InteractionNoise)
    ):
        raise TypeError("only filters of an interaction primitive can be restricted to some DoFs")
    device = process.phase.acceleration.start.device
    dofs = as_mask("dofs", dofs, observation.basis.n_dofs).to(device)
    index = dofs.nonzero().squeeze(-1)
    weights = dofs[observation.basis.dof_of_weight().to(device)].nonzero().squeeze(-1)
    return InteractionModel(
        dynamics,
        BasisProjection(observation.basis.select(dofs.cpu())),
        FilterNoise(process.select(weights, thinning), SelectedNoise(noise.measurement, index), noise.robust),
        len(index),
        dt * thinning,
        None if dof_names is None else tuple(dof_names[i] for i in index.tolist()),
        torch.cat([torch.arange(2, device=device), weights + 2]),
        index,
    )


def _acceleration(primitive: InteractionPrimitive) -> Tensor:
    """Phase acceleration noise, 1/s^2, that over one interaction adds a tenth of the demonstrations' spread.

    The paper leaves Q open. White accelerations over steps dt move the velocity by sigma sqrt(dt T) in T
    seconds; that is set to 0.1 of the standard deviation of the phase velocities (at least 1 % of their mean).
    """
    velocity = primitive.phase_velocity
    spread = torch.maximum(velocity.std(), 0.01 * velocity.mean())
    return 0.1 * spread * (primitive.rate * velocity.mean()).sqrt()
