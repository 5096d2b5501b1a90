"""Gaussian basis functions (Bishop 2006, section 3.1), the usual choice for interaction primitives."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.basis.centred import CentredBasis


class GaussianBasis(CentredBasis):
    """exp(-(phi - c_b)^2 / (2 width^2)); arguments and errors as `CentredBasis`, width the standard deviation."""

    def curve(self, distance: Tensor) -> tuple[Tensor, Tensor]:
        """See `CentredBasis.curve`."""
        exponent = -0.5 * distance.square()
        # Far functions are zero, not denormal: products with denormal numbers take a hundred times as long.
        values = torch.where(exponent > -40, exponent, -torch.inf).exp()
        return values, -distance * values
