"""Tuning of a filter's noise by gradient."""

from torch_ebip.tuning.settings import TuningResult, TuningSettings
from torch_ebip.tuning.tuner import Tuner

__all__ = ["Tuner", "TuningResult", "TuningSettings"]
