"""A general filter layer: any dynamics g, any measurement h; it knows nothing of interactions."""

from torch_ebip.common.exports import exported
from torch_ebip.filtering import functional, updates
from torch_ebip.filtering.base import Filter
from torch_ebip.filtering.ensemble import EnsembleFilter
from torch_ebip.filtering.extended import ExtendedFilter, GaussianState
from torch_ebip.filtering.model import StateSpace
from torch_ebip.filtering.noise import AboveOne, Constrained, MeasurementNoise, NoProcessNoise, Positive
from torch_ebip.filtering.particle import ParticleFilter, ParticleState
from torch_ebip.filtering.priors import GaussianPrior
from torch_ebip.filtering.protocols import View
from torch_ebip.filtering.states import EnsembleState, Memory
from torch_ebip.filtering.trace import Trace
from torch_ebip.filtering.updates import *

__all__ = [
    "AboveOne",
    "Constrained",
    "EnsembleFilter",
    "EnsembleState",
    "ExtendedFilter",
    "Filter",
    "GaussianPrior",
    "GaussianState",
    "MeasurementNoise",
    "Memory",
    "NoProcessNoise",
    "ParticleFilter",
    "ParticleState",
    "Positive",
    "StateSpace",
    "Trace",
    "View",
    "functional",
]
__all__ += exported(vars(updates))
