"""Ensemble Bayesian Interaction Primitives: the ensemble filter of an interaction primitive."""

from __future__ import annotations

import copy

import torch
from torch import Tensor, nn

from torch_ebip.basis.base import Basis
from torch_ebip.filters.ensemble import EnsembleFilter, FilterNoise
from torch_ebip.filters.evidence import EvidenceWeighting
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.localisation import Localisation
from torch_ebip.filters.priors import DemonstrationPrior
from torch_ebip.noise.measurement import MeasurementNoise, SelectedNoise
from torch_ebip.noise.process import InteractionNoise, PhaseNoise, WeightNoise
from torch_ebip.primitive import InteractionPrimitive


def ebip(
    primitive: InteractionPrimitive,
    n_members: int | None = None,
    *,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    localise: bool = False,
    inflation: float | nn.Module | None = None,
    square_root: bool = False,
    weigh: bool = False,
) -> EnsembleFilter:
    """The paper's eBIP (Section IV): members are demonstrations, R is the closed form.

    Everything but the first argument is an option that the paper does not have, off by default.

    Args:
        primitive: of the demonstrations.
        n_members: E; default: N, each demonstration once. Otherwise members are drawn with replacement.
        residual_variance: [D], R at the start; default: the paper's closed form. The corrected one is
            ``primitive.correlated_residual_variance``.
        weight_noise: rate of the weights' random walk at the start, 1/sqrt(s); see `WeightNoise`.
        context: functions of phase for an R that depends on it; see `MeasurementNoise`.
        localise: learn factors between modalities; see `Localisation`.
        inflation: of the anomalies; see `EnsembleFilter`.
        square_root: deterministic update.
        weigh: weigh members by the evidence for their demonstrations; see `EvidenceWeighting`.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.
    """
    layout, basis = primitive.layout, copy.deepcopy(primitive.basis)
    weights, velocity = primitive.weights, primitive.phase_velocity
    states = torch.cat([torch.zeros_like(velocity)[:, None], velocity[:, None], weights], dim=-1)
    modality_of_dof = layout.modality_of_dof.to(weights.device)
    modality_of_weight = modality_of_dof[basis.dof_of_weight().to(weights.device)]
    walk = None
    if weight_noise is not None:
        rates = weights.new_full((len(layout.modalities),), weight_noise)
        walk = WeightNoise(rates, weights.std(0), modality_of_weight)
    variance = primitive.residual_variance if residual_variance is None else residual_variance
    noise = FilterNoise(
        InteractionNoise(PhaseNoise(_acceleration(primitive)), walk),
        MeasurementNoise(variance.to(weights), context, modality_of_dof),
    )
    localisation = None
    if localise:
        block = torch.cat([modality_of_weight.new_zeros(2), modality_of_weight + 1])
        localisation = Localisation(("phase", *layout.names), block, modality_of_dof + 1).to(weights)
    return EnsembleFilter(
        ConstantVelocityPhase(),
        BasisProjection(basis),
        noise,
        DemonstrationPrior(states),
        len(primitive) if n_members is None else n_members,
        layout.n_dofs,
        1 / primitive.rate,
        square_root,
        inflation,
        localisation,
        EvidenceWeighting(primitive.value_variance, modality_of_dof) if weigh else None,
        dof_names=layout.dofs,
    )


def _acceleration(primitive: InteractionPrimitive) -> Tensor:
    """Phase acceleration noise, 1/s^2, that over one interaction adds a tenth of the demonstrations' spread.

    The paper leaves Q open. White accelerations over steps dt move the velocity by sigma sqrt(dt T) in T
    seconds; that is set to 0.1 of the standard deviation of the phase velocities (at least 1 % of their mean).
    """
    velocity = primitive.phase_velocity
    spread = torch.maximum(velocity.std(), 0.01 * velocity.mean())
    return 0.1 * spread * (primitive.rate * velocity.mean()).sqrt()


def restrict(whole: EnsembleFilter, dofs: Tensor, thinning: int = 1) -> EnsembleFilter:
    """The same eBIP filter for some of the DoFs, bool [D], sharing its parameters: not a copy.

    DoFs that are neither measured nor asked for influence nothing, so leaving out their weights is exact, and
    it saves their share of every update.

    Args:
        whole: made by `ebip`.
        dofs: bool [D], those to keep.
        thinning: see `EnsembleFilter`; the time between samples grows with it.

    Raises:
        TypeError: the filter is not an eBIP.
    """
    observation, prior, process = whole.observation, whole.prior, whole.noise.process
    if not isinstance(observation, BasisProjection) or not isinstance(process, InteractionNoise):
        raise TypeError("only filters made by ebip can be restricted to some DoFs")
    if not isinstance(prior, DemonstrationPrior):
        raise TypeError("only a prior of demonstrations can be restricted to some DoFs")
    dofs = dofs.to(prior.states.device)
    index = dofs.nonzero().squeeze(-1)
    weights = dofs[observation.basis.dof_of_weight().to(dofs.device)].nonzero().squeeze(-1)
    state = torch.cat([torch.arange(2, device=weights.device), weights + 2])
    localisation = whole.localisation
    names = whole.dof_names
    part = EnsembleFilter(
        whole.dynamics,
        BasisProjection(observation.basis.select(dofs.cpu())),
        FilterNoise(process.select(weights, thinning), SelectedNoise(whole.noise.measurement, index)),
        prior.select(state),
        whole.n_members,
        len(index),
        whole.dt * thinning,
        whole.square_root,
        whole.inflation,
        None if localisation is None else localisation.select(state, index),
        whole.weighting,
        thinning * whole.thinning,
        index if whole.columns is None else whole.columns[index],
        None if names is None else tuple(names[i] for i in index.tolist()),
    )
    return part.train(whole.training)
