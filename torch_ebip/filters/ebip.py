"""Ensemble Bayesian Interaction Primitives: the ensemble filter of an interaction primitive."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from torch_ebip.basis.base import Basis
from torch_ebip.filters.ensemble import EnsembleFilter
from torch_ebip.filters.evidence import EvidenceWeighting
from torch_ebip.filters.localisation import Localisation
from torch_ebip.filters.mixture import MixturePrior, fit_responsibilities
from torch_ebip.filters.model import demonstration_states, interaction_model
from torch_ebip.filters.priors import DemonstrationPrior
from torch_ebip.noise.robust import RobustWeights
from torch_ebip.primitive import InteractionPrimitive


def ebip(
    primitive: InteractionPrimitive,
    n_members: int | None = None,
    *,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    robust: RobustWeights | None = None,
    localise: bool = False,
    inflation: float | nn.Module | None = None,
    square_root: bool = False,
    weigh: bool = False,
    sharpness: float = 10.0,
) -> EnsembleFilter:
    """The paper's eBIP (Section IV): members are demonstrations, R is the closed form.

    Everything but the first argument is an option that the paper does not have, off by default.

    Args:
        primitive: of the demonstrations.
        n_members: E; default: N, each demonstration once. Otherwise members are drawn with replacement.
        residual_variance: [D], R at the start, squared units; default: the paper's closed form. The corrected one is
            ``primitive.correlated_residual_variance``.
        weight_noise: rate of the weights' random walk at the start, 1/sqrt(s); see `WeightNoise`.
        context: functions of phase for an R that depends on it; see `MeasurementNoise`.
        robust: what surprising measurements count: `StudentT`, `Huber` or `Gate`, see `RobustWeights`.
        localise: learn factors between modalities; see `Localisation`.
        inflation: of the anomalies; see `EnsembleFilter`.
        square_root: deterministic update.
        weigh: weigh members by the evidence for their demonstrations; see `EvidenceWeighting`.
        sharpness: of that evidence at the start.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.
    """
    prior = DemonstrationPrior(demonstration_states(primitive))
    count = len(primitive) if n_members is None else n_members
    options = (residual_variance, weight_noise, context, robust, localise, inflation, square_root, weigh, sharpness)
    return _build(primitive, prior, count, *options)


def ebip_minus(
    primitive: InteractionPrimitive,
    n_members: int,
    *,
    max_components: int = 4,
    seed: int = 0,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    robust: RobustWeights | None = None,
    localise: bool = False,
    inflation: float | nn.Module | None = None,
    square_root: bool = False,
) -> EnsembleFilter:
    """The paper's eBIP-: members are drawn from a Gaussian mixture over the demonstrations' weights.

    Expectation maximisation with the number of components by BIC; where no mixture is positive definite, the
    sample mean and covariance, with a warning. See `MixturePrior`.

    Args:
        primitive: of the demonstrations.
        n_members: E; may be more than there are demonstrations.
        max_components: largest number of components to try.
        seed: of the initialisation of EM.
        residual_variance, weight_noise, context, robust, localise, inflation, square_root: see `ebip`.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.

    Raises:
        ImportError: scikit-learn is not installed.
    """
    states = demonstration_states(primitive)
    prior = MixturePrior(states, fit_responsibilities(primitive.weights, max_components, seed))
    options = (residual_variance, weight_noise, context, robust, localise, inflation, square_root)
    return _build(primitive, prior, n_members, *options)


def _build(
    primitive: InteractionPrimitive,
    prior: nn.Module,
    n_members: int,
    residual_variance: Tensor | None,
    weight_noise: float | None,
    context: Basis | None,
    robust: RobustWeights | None,
    localise: bool,
    inflation: float | nn.Module | None,
    square_root: bool,
    weigh: bool = False,
    sharpness: float = 1.0,
) -> EnsembleFilter:
    model = interaction_model(primitive, residual_variance, weight_noise, context, robust)
    layout = primitive.layout
    localisation = None
    if localise:
        modality_of_weight = layout.modality_of_dof[model.observation.basis.dof_of_weight()]
        block = torch.cat([modality_of_weight.new_zeros(2), modality_of_weight + 1])
        localisation = Localisation(("phase", *layout.names), block, layout.modality_of_dof + 1)
        localisation = localisation.to(primitive.weights)
    weighting = None
    if weigh:
        modality_of_dof = layout.modality_of_dof.to(primitive.weights.device)
        weighting = EvidenceWeighting(primitive.value_variance, modality_of_dof, sharpness)
    return EnsembleFilter(
        model.dynamics,
        model.observation,
        model.noise,
        prior,
        n_members,
        model.n_dofs,
        model.dt,
        square_root,
        inflation,
        localisation,
        weighting,
        dof_names=model.dof_names,
    )
