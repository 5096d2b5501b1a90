"""What one would try without a filter: regression, a recurrent network, and for a ball the laws of motion."""

from experiments.baselines.ballistic import BallisticMethod
from experiments.baselines.network import RecurrentSettings
from experiments.baselines.recurrent import RecurrentMethod
from experiments.baselines.regression import RidgeMethod, TreesMethod, UntoldTreesMethod

__all__ = [
    "BallisticMethod",
    "RecurrentMethod",
    "RecurrentSettings",
    "RidgeMethod",
    "TreesMethod",
    "UntoldTreesMethod",
]
