"""Gaussian basis functions (Bishop 2006, section 3.1), the usual choice for interaction primitives."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ebip.interaction.basis.centred import CentredBasis


class GaussianBasis(CentredBasis):
    """exp(-(phi - c_b)^2 / (2 width^2)); arguments and errors as `CentredBasis`, width the standard deviation."""

    stretch = math.sqrt(2)

    def curve(self, distance: Tensor) -> Tensor:
        """See `CentredBasis.curve`."""
        # Far functions are 4e-18, not denormal: products with denormal numbers take a hundred times as long.
        return torch.mul(distance, distance).neg_().clamp_(min=-40).exp_()

    def slope(self, distance: Tensor, values: Tensor) -> Tensor:
        """See `CentredBasis.slope`."""
        return -(distance + distance) * values
