"""A general filter layer: any dynamics g, any measurement h; it knows nothing of interactions."""

from torch_ebip.filtering import functional
from torch_ebip.filtering.base import Filter
from torch_ebip.filtering.ensemble import EnsembleFilter
from torch_ebip.filtering.extended import ExtendedFilter, GaussianState
from torch_ebip.filtering.model import StateSpace, View
from torch_ebip.filtering.noise import AboveOne, Constrained, MeasurementNoise, NoProcessNoise, Positive
from torch_ebip.filtering.particle import ParticleFilter, ParticleState
from torch_ebip.filtering.priors import GaussianPrior
from torch_ebip.filtering.states import EnsembleState, Memory
from torch_ebip.filtering.trace import Trace
from torch_ebip.filtering.updates import (
    Gate,
    Huber,
    Inflation,
    Localisation,
    Part,
    RobustWeights,
    Rule,
    SpreadRule,
    SquareRoot,
    Stochastic,
    StudentT,
    Update,
    Weighting,
)

__all__ = [
    "AboveOne",
    "Constrained",
    "EnsembleFilter",
    "EnsembleState",
    "ExtendedFilter",
    "Filter",
    "Gate",
    "GaussianPrior",
    "GaussianState",
    "Huber",
    "Inflation",
    "Localisation",
    "MeasurementNoise",
    "Memory",
    "NoProcessNoise",
    "Part",
    "ParticleFilter",
    "ParticleState",
    "Positive",
    "RobustWeights",
    "Rule",
    "SpreadRule",
    "SquareRoot",
    "StateSpace",
    "Stochastic",
    "StudentT",
    "Trace",
    "Update",
    "View",
    "Weighting",
    "functional",
]
