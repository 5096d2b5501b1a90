"""Basis functions of phase, the paper's Section III-A, and their choice by BIC."""

from torch_ebip.basis.base import Basis
from torch_ebip.basis.bspline import BSplineBasis
from torch_ebip.basis.gaussian import GaussianBasis
from torch_ebip.basis.polynomial import PolynomialBasis
from torch_ebip.basis.selection import (
    CandidateFit,
    default_candidates,
    rank_candidates,
    select_basis,
    selection_table,
)
from torch_ebip.basis.sigmoid import SigmoidBasis
from torch_ebip.basis.stacked import StackedBasis

__all__ = [
    "BSplineBasis",
    "Basis",
    "CandidateFit",
    "GaussianBasis",
    "PolynomialBasis",
    "SigmoidBasis",
    "StackedBasis",
    "default_candidates",
    "rank_candidates",
    "select_basis",
    "selection_table",
]
