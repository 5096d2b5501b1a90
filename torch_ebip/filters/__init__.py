"""Filters: nn.Modules over the kernels of `torch_ebip.functional`."""

from torch_ebip.filters.base import Filter, Trace
from torch_ebip.filters.ebip import ebip, ebip_minus
from torch_ebip.filters.ensemble import EnsembleFilter
from torch_ebip.filters.evidence import Evidence, EvidenceWeighting
from torch_ebip.filters.extended import ExtendedFilter, GaussianState, bip
from torch_ebip.filters.forecast import Forecast
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.live import LiveFilter, LiveSnapshot
from torch_ebip.filters.localisation import Localisation
from torch_ebip.filters.members import EnsembleState
from torch_ebip.filters.mixture import MixturePrior
from torch_ebip.filters.particle import ParticleFilter, ParticleState, particle_filter
from torch_ebip.filters.priors import DemonstrationPrior, GaussianPrior, MomentPrior

__all__ = [
    "BasisProjection",
    "ConstantVelocityPhase",
    "DemonstrationPrior",
    "EnsembleFilter",
    "EnsembleState",
    "Evidence",
    "EvidenceWeighting",
    "ExtendedFilter",
    "Filter",
    "Forecast",
    "GaussianPrior",
    "GaussianState",
    "LiveFilter",
    "LiveSnapshot",
    "Localisation",
    "MixturePrior",
    "MomentPrior",
    "ParticleFilter",
    "ParticleState",
    "Trace",
    "bip",
    "ebip",
    "ebip_minus",
    "particle_filter",
]
