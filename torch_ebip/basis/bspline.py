"""Clamped B-splines: local as Gaussians, but exact at both ends, where the robot must be right.

C. de Boor, A Practical Guide to Splines (2001), chapters IX and X.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.basis.base import Basis


class BSplineBasis(Basis):
    """B-splines of one degree on evenly spaced knots in [0, 1], the end knots repeated degree + 1 times.

    At phase 0 the first function alone is 1, at phase 1 the last; everywhere they sum to 1.

    Args:
        n_features: number of functions, at least degree + 1.
        degree: of the polynomial pieces; 3 for cubic splines.

    Raises:
        ValueError: a negative degree, or fewer functions than degree + 1.
    """

    knots: Tensor

    def __init__(self, n_features: int, degree: int = 3) -> None:
        if degree < 0 or n_features < degree + 1:
            raise ValueError(f"BSplineBasis: degree {degree} needs n_features >= {degree + 1}, got {n_features}")
        super().__init__(n_features)
        self.degree = degree
        inner = torch.linspace(0, 1, n_features - degree + 1, dtype=torch.float64)
        knots = torch.cat([inner.new_zeros(degree), inner, inner.new_ones(degree)])
        self.register_buffer("knots", knots, persistent=False)

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes by the Cox-de Boor recurrence; see `Basis.evaluate`."""
        knots, degree = self.knots.to(phase), self.degree
        pieces = self.n_features - degree
        piece = (phase.detach() * pieces).floor().long().clamp(0, pieces - 1) + degree
        values = torch.nn.functional.one_hot(piece, len(knots) - 1).to(phase.dtype)
        slopes = torch.zeros_like(values)
        x = phase.unsqueeze(-1)
        for k in range(1, degree + 1):
            left, right = knots[: -k - 1], knots[k + 1 :]
            rising = _reciprocal(knots[k:-1] - left)
            falling = _reciprocal(right - knots[1:-k])
            if k == degree:
                slopes = k * (values[..., :-1] * rising - values[..., 1:] * falling)
            values = (x - left) * rising * values[..., :-1] + (right - x) * falling * values[..., 1:]
        return values, slopes[..., : self.n_features]

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"n_features={self.n_features}, degree={self.degree}"


def _reciprocal(width: Tensor) -> Tensor:
    # Repeated knots: the function of an empty interval is zero, and so must its coefficient be.
    return torch.where(width > 0, 1 / torch.where(width > 0, width, 1), 0)
