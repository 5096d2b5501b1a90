"""Learning: losses, what tuning minimises, the tuner, and what is kept and shown of it."""

from torch_ebip.learning.checkpoint import load_checkpoint, save_checkpoint
from torch_ebip.learning.interaction_model import InteractionModel
from torch_ebip.learning.loading import load_model
from torch_ebip.learning.losses import (
    CRPSLoss,
    EnergyScoreLoss,
    ForwardKinematicsLoss,
    InnovationLikelihoodLoss,
    TrajectoryLoss,
)
from torch_ebip.learning.monitor import Monitor, noise_scalars
from torch_ebip.learning.objective import ForecastObjective, Weights
from torch_ebip.learning.progress import Progress
from torch_ebip.learning.ranks import RankLostError, Ranks
from torch_ebip.learning.recipe import learn
from torch_ebip.learning.report import Report
from torch_ebip.learning.settings import TuningResult, TuningSettings
from torch_ebip.learning.tuner import Tuner

__all__ = [
    "CRPSLoss",
    "EnergyScoreLoss",
    "ForecastObjective",
    "ForwardKinematicsLoss",
    "InnovationLikelihoodLoss",
    "InteractionModel",
    "Monitor",
    "Progress",
    "RankLostError",
    "Ranks",
    "Report",
    "TrajectoryLoss",
    "Tuner",
    "TuningResult",
    "TuningSettings",
    "Weights",
    "learn",
    "load_checkpoint",
    "load_model",
    "noise_scalars",
    "save_checkpoint",
]
