"""Clamped B-splines: local as Gaussians, but exact at both ends, where the robot must be right.

C. de Boor, A Practical Guide to Splines (2001), chapters IX and X.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torch_ebip.common.ambient import owned
from torch_ebip.common.arguments import as_count
from torch_ebip.interaction.basis.base import Basis


class BSplineBasis(Basis):
    """B-splines of one degree on evenly spaced knots in [0, 1], the end knots repeated degree + 1 times.

    At phase 0 the first function alone is 1, at phase 1 the last; everywhere they sum to 1.

    Args:
        n_features: number of functions, at least degree + 1.
        degree: of the polynomial pieces; 3 for cubic splines.

    Raises:
        ValueError: a negative degree, or fewer functions than degree + 1.
    """

    pieces: Tensor

    def __init__(self, n_features: int, degree: int = 3) -> None:
        degree, n_features = as_count("degree of BSplineBasis", degree, 0), as_count("n_features", n_features)
        if n_features < degree + 1:
            raise ValueError(
                f"{type(self).__name__}: degree {degree} needs n_features >= {degree + 1}, got {n_features}"
            )
        super().__init__(n_features)
        self.degree = degree
        self.register_buffer("pieces", owned(self._pieces()), persistent=False)

    def _pieces(self) -> Tensor:
        """[n_pieces, degree + 1, n_features], coefficients of powers of the local coordinate."""
        n_features, degree = self.n_features, self.degree
        pieces = n_features - degree
        # A piece is a polynomial of this degree in the local coordinate u in [0, 1]: found from degree + 1 points.
        points = torch.linspace(0, 1, degree + 2, dtype=torch.float64, device="cpu")[:-1] + 0.5 / (degree + 1)
        phases = (torch.arange(pieces, dtype=torch.float64, device="cpu")[:, None] + points) / pieces
        vandermonde = points[:, None] ** torch.arange(degree + 1, device="cpu")
        found: Tensor = torch.linalg.solve(vandermonde, _cox_de_boor(phases, n_features, degree))
        return found.contiguous()

    def evaluate(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Values and slopes, from the polynomial pieces; see `Basis.evaluate`."""
        coefficients, local = self._pieces_at(phase)
        *rest, values = coefficients.unbind(-2)
        slopes = None
        for coefficient in reversed(rest):  # Horner's scheme, for the value and its derivative
            slopes = values if slopes is None else torch.addcmul(values, slopes, local)
            values = torch.addcmul(coefficient, values, local)
        slopes = torch.zeros_like(values) if slopes is None else slopes
        return values, slopes * len(self.pieces)

    def within(self, phase: Tensor) -> Tensor:
        """See `Basis.within`: without the slopes."""
        coefficients, local = self._pieces_at(phase)
        *rest, values = coefficients.unbind(-2)
        for coefficient in reversed(rest):
            values = torch.addcmul(coefficient, values, local)
        return values

    def _pieces_at(self, phase: Tensor) -> tuple[Tensor, Tensor]:
        """Coefficients [..., degree + 1, n_features] at phases [...], and the local coordinates [..., 1] there."""
        pieces = len(self.pieces)
        scaled = phase * pieces
        piece = scaled.detach().floor().long().clamp(0, pieces - 1)  # a phase that is NaN has one, too
        found = self.pieces.to(phase).index_select(0, piece.reshape(-1))
        return found.view(*phase.shape, *found.shape[1:]), (scaled - piece).unsqueeze(-1)

    def settings(self) -> dict[str, int | float | bool]:
        """See `Basis.settings`."""
        return {"n_features": self.n_features, "degree": self.degree}

    def extra_repr(self) -> str:
        """The settings; see `Basis.extra_repr`."""
        return f"n_features={self.n_features}, degree={self.degree}"


def _cox_de_boor(phase: Tensor, n_features: int, degree: int) -> Tensor:
    """Values [..., n_features] at phases [...] inside pieces, by the Cox-de Boor recurrence."""
    pieces = n_features - degree
    inner = torch.linspace(0, 1, pieces + 1, dtype=phase.dtype, device=phase.device)
    knots = torch.cat([inner.new_zeros(degree), inner, inner.new_ones(degree)])
    piece = (phase * pieces).floor().long() + degree
    values = torch.nn.functional.one_hot(piece, len(knots) - 1).to(phase)
    x = phase.unsqueeze(-1)
    for k in range(1, degree + 1):
        left, right = knots[: -k - 1], knots[k + 1 :]
        rising, falling = _reciprocal(knots[k:-1] - left), _reciprocal(right - knots[1:-k])
        values = (x - left) * rising * values[..., :-1] + (right - x) * falling * values[..., 1:]
    return values


def _reciprocal(width: Tensor) -> Tensor:
    # Repeated knots: the function of an empty interval is zero, and so must its coefficient be.
    return torch.where(width > 0, 1 / torch.where(width > 0, width, 1), 0)
