"""Basis functions of phase, the paper's Section III-A, and their choice by BIC."""

from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.basis.bspline import BSplineBasis
from torch_ebip.interaction.basis.gaussian import GaussianBasis
from torch_ebip.interaction.basis.periodic import FourierBasis, PeriodicBasis, PeriodicBSplineBasis
from torch_ebip.interaction.basis.polynomial import PolynomialBasis
from torch_ebip.interaction.basis.selection import (
    CandidateFit,
    default_candidates,
    periodic_candidates,
    rank_candidates,
    select_basis,
    selection_table,
)
from torch_ebip.interaction.basis.sigmoid import SigmoidBasis
from torch_ebip.interaction.basis.stacked import StackedBasis

__all__ = [
    "BSplineBasis",
    "Basis",
    "CandidateFit",
    "FourierBasis",
    "GaussianBasis",
    "PeriodicBSplineBasis",
    "PeriodicBasis",
    "PolynomialBasis",
    "SigmoidBasis",
    "StackedBasis",
    "default_candidates",
    "periodic_candidates",
    "rank_candidates",
    "select_basis",
    "selection_table",
]
