"""Bases on a circle: what is at phase 1 is at phase 0 again, with its slope and its curvature."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_count
from torch_ebip.interaction.basis.base import Basis
from torch_ebip.interaction.basis.bspline import BSplineBasis


class PeriodicBasis(Basis):
    """Functions of a phase on a circle: whole cycles make no difference."""

    periodic = True

    def forward(self, phase: Tensor) -> Tensor:
        """Features [..., n_features] at phases [...] (any real number)."""
        features: Tensor = self.within(phase - phase.detach().floor())
        return features

    def derivative(self, phase: Tensor) -> Tensor:
        """d features / d phase, [..., n_features], at phases [...]."""
        return self.evaluate(phase - phase.detach().floor())[1]


class PeriodicBSplineBasis(PeriodicBasis, BSplineBasis):
    """B-splines on a circle of evenly spaced knots: one curve, shifted; everywhere they sum to 1.

    Of degree 3 values, slopes and curvatures are continuous everywhere, the seam at phase 1 included.

    Args:
        n_features: number of functions, at least degree + 1.
        degree: of the polynomial pieces; 3 for cubic splines.

    Raises:
        ValueError: a negative degree, or fewer functions than degree + 1.

    Example:
        >>> import torch
        >>> from torch_ebip import PeriodicBSplineBasis
        >>> basis = PeriodicBSplineBasis(6)
        >>> bool(torch.allclose(basis(torch.tensor(1.2)), basis(torch.tensor(0.2))))
        True
    """

    def _pieces(self) -> Tensor:
        """See `BSplineBasis._pieces`: of the first piece, shifted."""
        n, degree = self.n_features, self.degree
        powers = torch.arange(degree + 1, dtype=torch.float64, device="cpu")
        points = (powers + 0.5) / (degree + 1)
        # Function j of the piece is the cardinal spline from its knot degree - j on.
        places = points.unsqueeze(-1) + degree - powers
        values = _cardinal(places, degree)
        own = torch.linalg.solve(points.unsqueeze(-1) ** powers, values)  # [degree + 1, functions]
        pieces: Tensor = own.new_zeros(n, degree + 1, n)
        for piece in range(n):
            pieces[piece][:, (piece + torch.arange(degree + 1)) % n] = own
        return pieces


class FourierBasis(PeriodicBasis):
    """1, cos(2 pi k phi) and sin(2 pi k phi) for k = 1 to so many harmonics: smooth to every order.

    Args:
        harmonics: how many; there are 2 harmonics + 1 functions.

    Raises:
        ValueError: no harmonic.

    Example:
        >>> import torch
        >>> from torch_ebip import FourierBasis
        >>> FourierBasis(1)(torch.tensor(0.25)).round(decimals=3).abs().tolist()
        [1.0, 0.0, 1.0]
    """

    rates: Tensor

    def __init__(self, harmonics: int) -> None:
        self.harmonics = as_count("harmonics of FourierBasis", harmonics)
        super().__init__(2 * self.harmonics + 1)
        order = torch.arange(1, self.harmonics + 1, dtype=torch.float64, device="cpu")
        self.register_buffer("rates", owned(2 * math.pi * order), persistent=False)

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes; see `Basis.evaluate`."""
        rates = self.rates.to(phase)
        angle = phase.unsqueeze(-1) * rates
        cosine, sine = angle.cos(), angle.sin()
        one = torch.ones_like(phase).unsqueeze(-1)
        values = torch.cat([one, cosine, sine], -1)
        return values, torch.cat([0 * one, -rates * sine, rates * cosine], -1)

    def settings(self) -> dict[str, int | float | bool]:
        """See `Basis.settings`."""
        return {"harmonics": self.harmonics}

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"harmonics={self.harmonics}"


def _cardinal(x: Tensor, degree: int) -> Tensor:
    """The B-spline of a degree on the knots 0, 1, ..., degree + 1 at points [...], by its recurrence."""
    values = [((x >= k) & (x < k + 1)).to(x) for k in range(degree + 1)]
    for d in range(1, degree + 1):
        values = [((x - k) * values[k] + (k + d + 1 - x) * values[k + 1]) / d for k in range(degree + 1 - d)]
    return values[0]
