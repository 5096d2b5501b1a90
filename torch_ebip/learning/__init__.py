"""Learning: losses, what tuning minimises, the tuner, and what is kept and shown of it."""

from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.learning.losses import (
    CRPSLoss,
    EnergyScoreLoss,
    ForwardKinematicsLoss,
    InnovationLikelihoodLoss,
    TrajectoryLoss,
)
from torch_ebip.learning.monitor import Monitor, noise_scalars
from torch_ebip.learning.objective import ForecastObjective, Weights
from torch_ebip.learning.ranks import RankLostError, Ranks
from torch_ebip.learning.settings import TuningResult, TuningSettings
from torch_ebip.learning.tuner import Tuner

__all__ = [
    "CRPSLoss",
    "EnergyScoreLoss",
    "ForecastObjective",
    "ForwardKinematicsLoss",
    "InnovationLikelihoodLoss",
    "Monitor",
    "RankLostError",
    "Ranks",
    "TrajectoryLoss",
    "Tuner",
    "TuningResult",
    "TuningSettings",
    "Weights",
    "load_checkpoint",
    "noise_scalars",
    "save_checkpoint",
]
