"""Polynomial basis functions, as Legendre polynomials shifted to [0, 1].

Raw powers up to degree 20 have a Gram matrix of condition 1e25 and more; these are orthonormal on [0, 1], so
a regression on dense samples is well conditioned at every degree.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ebip.common.arguments import as_count
from torch_ebip.interaction.basis.base import Basis


class PolynomialBasis(Basis):
    """sqrt(2k + 1) P_k(2 phi - 1) for k = 0..degree, by Bonnet's recurrence.

    Args:
        degree: 0 to 20; there are degree + 1 functions.

    Raises:
        ValueError: a degree outside that range.
    """

    def __init__(self, degree: int) -> None:
        if as_count("degree of PolynomialBasis", degree, 0) > 20:
            raise ValueError(f"PolynomialBasis: degree must be between 0 and 20, got {degree}")
        super().__init__(degree + 1)
        self.degree = degree

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes; see `Basis.evaluate`."""
        x = 2 * phase - 1
        values, slopes = [torch.ones_like(x), x], [torch.zeros_like(x), torch.ones_like(x)]
        for k in range(1, self.degree):
            values.append(((2 * k + 1) * x * values[k] - k * values[k - 1]) / (k + 1))
            slopes.append(slopes[k - 1] + (2 * k + 1) * values[k])
        norms = [math.sqrt(2 * k + 1) for k in range(self.n_features)]
        scale = torch.tensor(norms, dtype=x.dtype, device=x.device)
        value = torch.stack(values[: self.n_features], dim=-1) * scale
        return value, 2 * torch.stack(slopes[: self.n_features], dim=-1) * scale

    def settings(self) -> dict[str, int | float | bool]:
        """See `Basis.settings`."""
        return {"degree": self.degree}

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"degree={self.degree}"
