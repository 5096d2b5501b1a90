"""Sigmoid basis functions (Bishop 2006, section 3.1)."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.interaction.basis.centred import CentredBasis


class SigmoidBasis(CentredBasis):
    """1 / (1 + exp(-(phi - c_b) / width)); arguments and errors as `CentredBasis`."""

    share_of_spacing = 0.5

    def curve(self, distance: Tensor) -> Tensor:
        """See `CentredBasis.curve`."""
        return torch.sigmoid(distance)

    def slope(self, distance: Tensor, values: Tensor) -> Tensor:
        """See `CentredBasis.slope`."""
        return values * (1 - values)
