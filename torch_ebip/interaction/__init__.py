"""Interactions: phase, bases, primitives, and the filters of the paper over them."""

from torch_ebip.common.exports import exported
from torch_ebip.interaction import phases
from torch_ebip.interaction.analogue_readout import AnalogueReadout
from torch_ebip.interaction.analogues import Analogues
from torch_ebip.interaction.basis import (
    Basis,
    BSplineBasis,
    CandidateFit,
    FourierBasis,
    GaussianBasis,
    PeriodicBSplineBasis,
    PolynomialBasis,
    SigmoidBasis,
    StackedBasis,
    default_candidates,
    periodic_candidates,
    rank_candidates,
    select_basis,
    selection_table,
)
from torch_ebip.interaction.bounds import Bounds
from torch_ebip.interaction.doubt import Doubt
from torch_ebip.interaction.evidence import Evidence, EvidenceWeighting
from torch_ebip.interaction.expert import Expert
from torch_ebip.interaction.filter_kinds import (
    InteractionEnsembleFilter,
    InteractionExtendedFilter,
    InteractionParticleFilter,
)
from torch_ebip.interaction.filters import InteractionFilter
from torch_ebip.interaction.forecast import Forecast
from torch_ebip.interaction.gated_noise import PhaseGatedNoise
from torch_ebip.interaction.horizons import HorizonShrinkage
from torch_ebip.interaction.mixture import MixturePrior
from torch_ebip.interaction.model import demonstration_states, interaction_model
from torch_ebip.interaction.noise import InteractionNoise, PhaseNoise, WeightNoise
from torch_ebip.interaction.pace.phase_bank import PhaseBank
from torch_ebip.interaction.phases import *
from torch_ebip.interaction.presets import bip, ebip, ebip_minus, particle_filter
from torch_ebip.interaction.primitive import InteractionPrimitive
from torch_ebip.interaction.priors import DemonstrationPrior, MomentPrior
from torch_ebip.interaction.projection import BasisProjection
from torch_ebip.interaction.recognition import Recognition
from torch_ebip.interaction.shrinkage import Shrinkage
from torch_ebip.interaction.surprise import InteractionSurprise
from torch_ebip.interaction.table import DemonstrationTable
from torch_ebip.interaction.trace import InteractionTrace

__all__ = [
    "AnalogueReadout",
    "Analogues",
    "BSplineBasis",
    "Basis",
    "BasisProjection",
    "Bounds",
    "CandidateFit",
    "DemonstrationPrior",
    "DemonstrationTable",
    "Doubt",
    "Evidence",
    "EvidenceWeighting",
    "Expert",
    "Forecast",
    "FourierBasis",
    "GaussianBasis",
    "HorizonShrinkage",
    "InteractionEnsembleFilter",
    "InteractionExtendedFilter",
    "InteractionFilter",
    "InteractionNoise",
    "InteractionParticleFilter",
    "InteractionPrimitive",
    "InteractionSurprise",
    "InteractionTrace",
    "MixturePrior",
    "MomentPrior",
    "PeriodicBSplineBasis",
    "PhaseBank",
    "PhaseGatedNoise",
    "PhaseNoise",
    "PolynomialBasis",
    "Recognition",
    "Shrinkage",
    "SigmoidBasis",
    "StackedBasis",
    "WeightNoise",
    "bip",
    "default_candidates",
    "demonstration_states",
    "ebip",
    "ebip_minus",
    "interaction_model",
    "particle_filter",
    "periodic_candidates",
    "rank_candidates",
    "select_basis",
    "selection_table",
]
__all__ += exported(vars(phases))
