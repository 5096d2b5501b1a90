"""Filters: nn.Modules over the kernels of `torch_ebip.functional`."""

from torch_ebip.filters.base import Filter, Forecast, Trace
from torch_ebip.filters.ebip import ebip
from torch_ebip.filters.ensemble import EnsembleFilter, EnsembleState, FilterNoise
from torch_ebip.filters.evidence import Evidence, EvidenceWeighting
from torch_ebip.filters.interaction import BasisProjection, ConstantVelocityPhase
from torch_ebip.filters.localisation import Localisation
from torch_ebip.filters.priors import DemonstrationPrior, GaussianPrior

__all__ = [
    "BasisProjection",
    "ConstantVelocityPhase",
    "DemonstrationPrior",
    "EnsembleFilter",
    "EnsembleState",
    "Evidence",
    "EvidenceWeighting",
    "Filter",
    "FilterNoise",
    "Forecast",
    "GaussianPrior",
    "Localisation",
    "Trace",
    "ebip",
]
