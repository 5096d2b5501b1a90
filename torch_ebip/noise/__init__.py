"""Learnable process and measurement noise: constrained parameters that start at the closed form."""

from torch_ebip.noise.constraints import AboveOne, Constrained, Positive
from torch_ebip.noise.measurement import MeasurementNoise
from torch_ebip.noise.pair import FilterNoise
from torch_ebip.noise.process import InteractionNoise, NoProcessNoise, PhaseNoise, WeightNoise
from torch_ebip.noise.robust import Gate, Huber, RobustWeights, StudentT

__all__ = [
    "AboveOne",
    "Constrained",
    "FilterNoise",
    "Gate",
    "Huber",
    "InteractionNoise",
    "MeasurementNoise",
    "NoProcessNoise",
    "PhaseNoise",
    "Positive",
    "RobustWeights",
    "StudentT",
    "WeightNoise",
]
