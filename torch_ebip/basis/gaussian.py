"""Gaussian basis functions (Bishop 2006, section 3.1), the usual choice for interaction primitives."""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.basis.base import Basis, checked_width, spaced_centres, with_offset


class GaussianBasis(Basis):
    """exp(-(phi - c_b)^2 / (2 width^2)) with centres c_b evenly from 0 to 1.

    Args:
        n_features: number of functions, the constant of `offset` included.
        width: standard deviation, in phase; default: the spacing of the centres.
        offset: make one of the functions a constant, which plain Gaussians represent badly.

    Raises:
        ValueError: too few functions, or a width that is not positive.
    """

    centres: Tensor

    def __init__(self, n_features: int, width: float | None = None, offset: bool = False) -> None:
        super().__init__(n_features)
        count = n_features - offset
        if count < 1:
            raise ValueError(f"GaussianBasis: n_features={n_features} leaves no function beside the offset")
        self.offset = offset
        self.width = checked_width("GaussianBasis", count, width)
        self.register_buffer("centres", spaced_centres(count), persistent=False)

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes; see `Basis.evaluate`."""
        distance = (phase.unsqueeze(-1) - self.centres.to(phase)) / self.width
        exponent = -0.5 * distance.square()
        # Far functions are zero, not denormal: products with denormal numbers take a hundred times as long.
        values = torch.where(exponent > -40, exponent, -torch.inf).exp()
        return with_offset(values, -distance / self.width * values, self.offset)

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"n_features={self.n_features}, width={self.width:.6g}, offset={self.offset}"
