"""Learnable noise: constrained parameters that start where they are told to."""

from torch_ebip.filtering.noise.constraints import AboveOne, Constrained, Positive
from torch_ebip.filtering.noise.measurement import MeasurementNoise
from torch_ebip.filtering.noise.process import NoProcessNoise

__all__ = ["AboveOne", "Constrained", "MeasurementNoise", "NoProcessNoise", "Positive"]
