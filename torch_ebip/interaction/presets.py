"""The paper's filters of an interaction primitive, ready-made: thin, so that what they put together can be seen."""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.updates.inflation import Inflation
from torch_ebip.filtering.updates.localisation import Localisation
from torch_ebip.filtering.updates.rules import SquareRoot, Stochastic
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.filtering.updates.update import Update
from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.evidence import EvidenceWeighting
from torch_ebip.interaction.filter_kinds import (
    InteractionEnsembleFilter,
    InteractionExtendedFilter,
    InteractionParticleFilter,
)
from torch_ebip.interaction.mixture import MixturePrior, fit_responsibilities
from torch_ebip.interaction.model import demonstration_states, interaction_model
from torch_ebip.interaction.pace.phase_bank import PhaseBank
from torch_ebip.interaction.phases.phase import PhaseModel
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.priors import DemonstrationPrior, MomentPrior
from torch_ebip.interaction.recognition import Recognition
from torch_ebip.interaction.table import DemonstrationTable

MOST_GROWTH = 10.0
"""What all inflations of one interaction may come to. Weights have no dynamics that would draw in what no sensor
reduces, and an interaction lasts a hundred samples; a filter that is left running must not end in infinity."""


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
    sharpness: float | Sequence[float] = 10.0,
    forgetting: float | Sequence[float] = 6.0,
    primacy: float | Sequence[float] = 0.0,
    slope: float | Sequence[float] = 2.0,
    relative: float = 0.0,
    phase: PhaseModel | None = None,
    pace: PhaseBank | None = None,
) -> InteractionEnsembleFilter:
    """The paper's eBIP (Section IV): members are demonstrations, R is the closed form.

    Everything but the first argument is an option that the paper does not have, off by default.

    Args:
        primitive: of the demonstrations.
        n_members: E; default: N, each demonstration once. Otherwise members are drawn with replacement.
        residual_variance: [D], R at the start, squared units; default: the paper's closed form. The corrected one is
            ``primitive.correlated_residual_variance``.
        weight_noise: rate of the weights' random walk at the start, 1/sqrt(s); see `WeightNoise`.
        context: functions of phase for an R that depends on it; see `PhaseGatedNoise`.
        robust: what surprising measurements count: `StudentT`, `Huber` or `Gate`, see `RobustWeights`.
        localise: learn factors between modalities; see `Localisation`.
        inflation: of the anomalies, at most `MOST_GROWTH` in all; see `Inflation`.
        square_root: deterministic update.
        weigh: weigh members by the evidence for their demonstrations; see `EvidenceWeighting`.
        sharpness: of that evidence at the start, of each memory or of all.
        forgetting: rates of its memories at the start, 1/s: several look back by several lengths of time.
        primacy: how much more they hold of what came first, at the start.
        slope: how much more that evidence counts late than early, at the start.
        relative: how far its distances are relative to the spread of the demonstrations there, at the start.
        phase: how the phase moves; default: the paper's `ConstantVelocityPhase`, or `CyclicPhase` where it repeats.
        pace: of the primitive, for people who pause, start late or start over: see `PhaseBank`.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.

    Raises:
        ValueError: an option outside its range, by name.
    """
    model = interaction_model(primitive, residual_variance, weight_noise, context, phase)
    weighting = None
    if weigh:
        modality_of_dof = primitive.layout.modality_of_dof.to(primitive.weights.device)
        table = DemonstrationTable.of(primitive)
        weighting = EvidenceWeighting(
            table, primitive.value_variance, modality_of_dof, sharpness, forgetting, slope, primacy, relative
        )
    update = Update(
        SquareRoot() if square_root else Stochastic(),
        _trust(robust, primitive),
        weighting,
        _localisation(primitive, model) if localise else None,
        None if inflation is None else Inflation(inflation, MOST_GROWTH),
        pace=_own(pace, primitive),
    )
    prior = DemonstrationPrior(demonstration_states(primitive, phase))
    filter = InteractionEnsembleFilter(model, prior, len(primitive) if n_members is None else n_members, update)
    if primitive.labels is not None:
        filter.recognition = Recognition(primitive.labels).to(primitive.weights)
    return filter


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
    phase: PhaseModel | None = None,
) -> InteractionEnsembleFilter:
    """The paper's eBIP-: members are drawn from a Gaussian mixture over the demonstrations' weights.

    Expectation maximisation with the number of components by BIC; where no mixture is positive definite, the
    sample mean and covariance, with a warning. See `MixturePrior`.

    Args:
        primitive: of the demonstrations.
        n_members: E; may be more than there are demonstrations.
        max_components: largest number of components to try.
        seed: of the initialisation of EM.
        residual_variance, weight_noise, context, robust, localise, inflation, square_root, phase: see `ebip`.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.

    Raises:
        ImportError: scikit-learn is not installed.
    """
    model = interaction_model(primitive, residual_variance, weight_noise, context, phase)
    update = Update(
        SquareRoot() if square_root else Stochastic(),
        _trust(robust, primitive),
        localisation=_localisation(primitive, model) if localise else None,
        inflation=None if inflation is None else Inflation(inflation, MOST_GROWTH),
    )
    shares = fit_responsibilities(primitive.weights, max_components, seed)
    prior = MixturePrior(demonstration_states(primitive, phase), shares, _moving(model))
    return InteractionEnsembleFilter(model, prior, n_members, update)


def bip(
    primitive: InteractionPrimitive,
    *,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    shrinkage: float = 0.0,
    robust: RobustWeights | None = None,
    phase: PhaseModel | None = None,
) -> InteractionExtendedFilter:
    """The paper's BIP: a Gaussian prior with the demonstrations' moments and an extended Kalman filter.

    The paper writes Q with ones on the diagonal of the weights. In the units of a robot that would be noise of
    one radian a sample; as in the other filters here, weights have no process noise unless it is asked for.

    Args:
        primitive: of the demonstrations.
        residual_variance, weight_noise, context, robust, phase: see `ebip`.
        shrinkage: of the prior covariance towards its diagonal, in [0, 1]; see `MomentPrior`. With fewer
            demonstrations than weights the covariance is rank deficient, in the paper and by default.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.
    """
    model = interaction_model(primitive, residual_variance, weight_noise, context, phase)
    prior = MomentPrior(demonstration_states(primitive, phase), shrinkage, _moving(model))
    return InteractionExtendedFilter(model, prior, _trust(robust, primitive))


def particle_filter(
    primitive: InteractionPrimitive,
    n_members: int | None = None,
    *,
    residual_variance: Tensor | None = None,
    weight_noise: float | None = None,
    context: Basis | None = None,
    softness: float = 0.0,
    robust: RobustWeights | None = None,
    phase: PhaseModel | None = None,
    pace: PhaseBank | None = None,
) -> InteractionParticleFilter:
    """The paper's PF: particles are demonstrations, systematic resampling where N_eff < E/2.

    Args:
        primitive: of the demonstrations.
        n_members: E; default: N, each demonstration once. Otherwise they are drawn with replacement.
        residual_variance, weight_noise, context, robust, phase, pace: see `ebip`.
        softness: of the resampling, see `ParticleFilter`; needed for gradients through it.

    Returns:
        A filter with parameters of its own, in the dtype and on the device of the primitive.
    """
    model = interaction_model(primitive, residual_variance, weight_noise, context, phase)
    prior = DemonstrationPrior(demonstration_states(primitive, phase))
    count = len(primitive) if n_members is None else n_members
    trust = _trust(robust, primitive)
    return InteractionParticleFilter(model, prior, count, softness=softness, trust=trust, pace=_own(pace, primitive))


def _own(pace: PhaseBank | None, primitive: InteractionPrimitive) -> PhaseBank | None:
    """A bank of one filter alone."""
    if pace is not None and pace.n_all != len(primitive):
        raise ValueError(f"the phase bank is of {pace.n_all} demonstrations, the primitive has {len(primitive)}")
    return None if pace is None else copy.deepcopy(pace).to(primitive.weights)


def _trust(robust: RobustWeights | None, primitive: InteractionPrimitive) -> list[RobustWeights]:
    """Robust weights with parameters of their own."""
    return [] if robust is None else [copy.deepcopy(robust).to(primitive.weights)]


def _moving(model: StateSpace) -> int:
    assert model.leading is not None
    return model.leading


def _localisation(primitive: InteractionPrimitive, model: StateSpace) -> Localisation:
    """Between the modalities of a primitive, and what moves."""
    layout, basis = primitive.layout, primitive.basis
    modality_of_weight = layout.modality_of_dof[basis.dof_of_weight()]
    block = torch.cat([modality_of_weight.new_zeros(_moving(model)), modality_of_weight + 1])
    return Localisation(("phase", *layout.names), block, layout.modality_of_dof + 1).to(primitive.weights)
