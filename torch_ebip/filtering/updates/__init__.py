"""What happens at a measurement, one idea a file."""

from torch_ebip.filtering.updates.gate import Gate
from torch_ebip.filtering.updates.huber import Huber
from torch_ebip.filtering.updates.inflation import Inflation, SpreadRule
from torch_ebip.filtering.updates.localisation import Localisation
from torch_ebip.filtering.updates.part import Part
from torch_ebip.filtering.updates.rules import Rule, SquareRoot, Stochastic
from torch_ebip.filtering.updates.student_t import StudentT
from torch_ebip.filtering.updates.trust import RobustWeights
from torch_ebip.filtering.updates.update import Update
from torch_ebip.filtering.updates.weighting import Weighting

__all__ = [
    "Gate",
    "Huber",
    "Inflation",
    "Localisation",
    "Part",
    "RobustWeights",
    "Rule",
    "SpreadRule",
    "SquareRoot",
    "Stochastic",
    "StudentT",
    "Update",
    "Weighting",
]
